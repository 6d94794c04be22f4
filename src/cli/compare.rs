use super::{ForceArguments, Output, STOP, SceneArguments};
use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::with_interval;
use crate::run::RunControl;
use crate::study::{self, Comparison};
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Recording file: a height map (file, z_scale_um, x_step_mm, y_step_mm) or images of a line
    /// (images)
    recording: PathBuf,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: &Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let bar = output.progress(u64::from(scene.scan.frames), "frames");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let out = arguments.force.folder(&arguments.output);
    let comparison = study::compare(scene, &arguments.recording, out, &control);
    bar.finish_and_clear();
    let comparison = comparison?;
    output.result(&comparison, &text(&comparison))
}

fn text(comparison: &Comparison) -> String {
    let mut text = format!(
        "{:<36}{:>32}{:>32}\n",
        "", "measured (95 %)", "simulated (95 %)"
    );
    for s in &comparison.statistics {
        let cell = |values: [f64; 3]| {
            let [value, low, high] = with_interval(values);
            format!("{value} ({low} to {high})")
        };
        let differs = match s.differs {
            true => format!("  differs: {}", s.terms),
            false => String::new(),
        };
        let (measured, simulated) = (cell(s.measured), cell(s.simulated));
        let _ = writeln!(text, "{:<36}{measured:>32}{simulated:>32}{differs}", s.name);
    }
    text + &format!("\n{}\n", path(&comparison.page))
}
