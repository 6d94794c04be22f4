use super::{CoverageArguments, Output, STOP, SceneArguments};
use crate::batch::{self, Control, ScanOptions};
use crate::error::Result;
use crate::inspect::chart::short;
use std::ops::Range;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    #[command(flatten)]
    coverage: CoverageArguments,
    /// Only the frames from A up to and without B
    #[arg(long, value_name = "A..B", value_parser = frames)]
    frames: Option<Range<u32>>,
    /// Keep the frames that an earlier run in this folder finished
    #[arg(long)]
    resume: bool,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

fn frames(text: &str) -> std::result::Result<Range<u32>, String> {
    let number = |text: &str| text.parse::<u32>().ok();
    text.split_once("..")
        .and_then(|(a, b)| Some(number(a)?..number(b)?))
        .ok_or_else(|| "expected two frame numbers as in 10..20".to_owned())
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load()?;
    let options = ScanOptions {
        coverage: arguments.coverage.coverage(),
        frames: arguments.frames,
        resume: arguments.resume,
    };
    let count = options
        .frames
        .as_ref()
        .map_or(scene.scan.frames as usize, |f| f.len());
    let bar = output.progress(count as u64, "frames");
    let control = Control {
        progress: &|done| bar.set_position(done),
        stop: &STOP,
    };
    let summary = batch::scan(&scene, &options, &arguments.output, &control);
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
