use super::{ForceArguments, Output, STOP};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::RunControl;
use crate::study;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Sensor file or scene (TOML)
    sensor: PathBuf,
    /// Seed of noise and pixel patterns [default: the seed of the scene; 1 for a sensor file]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let bar = output.progress(study::emva_images(), "images");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let Arguments {
        sensor,
        seed,
        output: folder,
        force,
    } = &arguments;
    let summary = study::emva(sensor, *seed, force.folder(folder), &control);
    bar.finish_and_clear();
    let summary = summary?;
    let mut text = String::new();
    for warning in &summary.warnings {
        text += &format!("warning: {warning}\n");
    }
    text += &format!(
        "{} images of {} × {} pixels for the tool of EMVA 1288\n{}\n",
        summary.images,
        summary.resolution[0],
        summary.resolution[1],
        path(&summary.descriptor)
    );
    output.result(&summary, &text)
}
