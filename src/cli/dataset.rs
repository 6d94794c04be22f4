use super::{ForceArguments, Output, STOP, scan, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::{self, RunControl, Shard};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Recipe (TOML): a scene, a number of samples, and the scene values that are randomised for
    /// each sample
    recipe: PathBuf,
    /// Write only the tar files I, I + N, …; all N shards share the output folder. With auto/N, I
    /// is the array index set by Slurm, Kubernetes or AWS Batch
    #[arg(long, value_name = "I/N", value_parser = scan::shard, default_value = "0/1")]
    shard: Shard,
    /// Output folder; existing tar files are kept
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let Arguments {
        recipe,
        shard,
        output: out,
        force,
    } = arguments;
    let bar = output.progress(run::dataset_samples(&recipe, shard)?, "samples");
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let done = run::dataset(&recipe, shard, force.folder(&out), &control);
    bar.finish_and_clear();
    let done = done?;
    let all = match &done.index {
        Some(index) => format!("the set is whole: {}", path(index)),
        None => "other shards are not there yet; the last to end writes index.json".to_owned(),
    };
    let text = format!(
        "job {}: {} tar files, {} of them made now\n{all}",
        done.job, done.files, done.files_made
    );
    output.result(&done, &text)
}
