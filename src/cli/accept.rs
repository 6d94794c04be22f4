use super::{ForceArguments, Output, STOP, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::Control;
use crate::study::Acceptance;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// File of a sensor, or a scene (TOML), whose surface, speckle and calibration are then meant too
    sensor: PathBuf,
    /// Seeds of speckle, noise and patterns of pixels, 2 or more: as many tests
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u64).range(2..100_000))]
    seeds: u64,
    /// First seed [default: the scene's, of a sensor 1]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Folder to write to
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
    let before = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let acceptance = Acceptance::of(sensor, *seed, &before)?;
    let bar = output.progress(acceptance.steps(*seeds), "profiles");
    let control = Control {
        progress: &|done| bar.set_position(done),
        building: None,
        stop: &STOP,
    };
    let summary = acceptance.run(*seeds, force.folder(folder), &control);
    bar.finish_and_clear();
    let summary = summary?;
    let text = format!("{}{}\n", summary.text(), path(&summary.report));
    output.result(&summary, &text)
}
