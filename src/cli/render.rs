use super::{CoverageArguments, ForceArguments, Output, STOP, SceneArguments, show};
use crate::run;
use crate::run::RunControl;

use crate::error::Result;
use crate::error::printable::path;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    #[command(flatten)]
    coverage: CoverageArguments,
    /// Frame of the scan, starting at 0
    #[arg(long, value_name = "K", default_value_t = 0)]
    frame: u32,
    /// Also write up to N lines of each column to frame-KKKKKK-lines.csv: row, width, height, sum of
    /// counts and flags
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=4))]
    lines: Option<u8>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|_| {},
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let summary = run::render(
        &scene,
        (arguments.frame, arguments.lines.map(usize::from)),
        arguments.coverage.coverage(),
        arguments.force.folder(&arguments.output),
        &control,
    )?;
    let text = format!(
        "frame {}: counts up to {}, {:.3} on average\n{}\n{}",
        summary.frame,
        summary.max_count,
        summary.mean_count,
        path(&summary.png),
        path(&summary.exr)
    );
    output.result(&summary, &text)
}
