use super::{Output, STOP, SceneArguments};
use crate::run::Control;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Frame of the scan, from 0
    #[arg(long, value_name = "K", default_value_t = 0)]
    frame: u32,
    /// Seeds of speckle and noise, 2 or more, from the scene's own on
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u64).range(2..100_000))]
    seeds: u64,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let bar = output.progress(arguments.seeds, "seeds");
    let control = Control {
        progress: &|done| bar.set_position(done),
        building: None,
        stop: &STOP,
    };
    let Arguments {
        frame,
        seeds,
        output: folder,
        ..
    } = &arguments;
    let summary = study::monte_carlo(scene, *frame, *seeds, folder, &control);
    bar.finish_and_clear();
    let summary = summary?;
    let [first, second] = summary.headline();
    let text = format!("{first}\n{second}\n{}\n", path(&summary.picture));
    output.result(&summary, &text)
}
