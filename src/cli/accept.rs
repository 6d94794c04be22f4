use super::{ForceArguments, Output, STOP, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::RunControl;
use crate::study::Acceptance;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Sensor file, or scene (TOML) whose surface, speckle and calibration are then used as well
    sensor: PathBuf,
    /// Number of simulated tests, 2 or more; each has its own seed of speckle, noise and pixel
    /// patterns
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u64).range(2..100_000))]
    seeds: u64,
    /// First seed [default: the seed of the scene; 1 for a sensor file]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let Arguments {
        sensor,
        seeds,
        seed,
        output: folder,
        force,
    } = &arguments;
    let building = output.share("prepared");
    let before = RunControl {
        progress: &|_| {},
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let acceptance = Acceptance::of(sensor, *seed, &before)?;
    let bar = output.progress(acceptance.steps(*seeds), "profiles");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let summary = acceptance.run(*seeds, force.folder(folder), &control);
    bar.finish_and_clear();
    let summary = summary?;
    let text = format!("{}{}\n", summary.text(), path(&summary.report));
    output.result(&summary, &text)
}
