use super::{Output, STOP, SceneArguments};
use crate::batch::{self, Control};
use crate::error::Result;
use crate::inspect::chart::short;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load()?;
    let bar = output.progress(scene.scan.frames as u64, "frames");
    let control = Control {
        progress: &|done| bar.set_position(done),
        stop: &STOP,
    };
    let summary = batch::scan(&scene, &arguments.output, &control);
    bar.finish_and_clear();
    let summary = summary?;
    let deviation = match &summary.deviation {
        Some(d) => format!(
            "{} points, deviation from CAD: mean {} µm, standard deviation {} µm",
            d.points,
            short(d.mean_um),
            short(d.std_um)
        ),
        None => "no point was measured: no line was found in any frame".to_owned(),
    };
    let text = format!(
        "{deviation}\nopen the report:  {}\nsensor frame:     {}\ncloud over part:  {}\npoint cloud:      {}",
        summary.report.display(),
        summary.pictures[0].display(),
        summary.pictures[1].display(),
        summary.cloud.display()
    );
    output.result(&summary, &text)
}
