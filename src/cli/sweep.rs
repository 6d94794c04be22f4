use super::{ForceArguments, Output, STOP, scan, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::{self, Plot, RunControl, Shard};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Sweep (TOML): a scene and its varied values, on a grid, in a list or sampled at random
    sweep: PathBuf,
    /// Run only the scans I, I + N, …; all N shards share the output folder. With auto/N, I is the
    /// array index set by Slurm, Kubernetes or AWS Batch
    #[arg(long, value_name = "I/N", value_parser = scan::shard, default_value = "0/1")]
    shard: Shard,
    /// Do not scan; write the table of the scans of all shards, or list the shards that must be run
    /// again
    #[arg(long, conflicts_with = "shard")]
    merge: bool,
    /// Plot a figure over a key or over another figure, by their names in the table; may be
    /// repeated
    #[arg(long, value_name = "FIGURE:KEY", value_parser = plot)]
    plot: Vec<Plot>,
    /// Output folder; completed scans are not repeated
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

fn plot(text: &str) -> std::result::Result<Plot, String> {
    let expected = "expected FIGURE:KEY, as deviation.std_um:camera.f_number";
    let (figure, over) = text.split_once(':').ok_or(expected)?;
    Ok(Plot {
        figure: figure.to_owned(),
        over: over.to_owned(),
    })
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let Arguments {
        sweep,
        shard,
        merge,
        plot,
        output: out,
        force,
    } = arguments;
    let bar = output.progress(run::sweep_places(&sweep, shard)?, "runs");
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let done = match merge {
        true => run::sweep_merge(&sweep, &plot, force.folder(&out), &control),
        false => run::sweep(&sweep, shard, &plot, force.folder(&out), &control),
    };
    bar.finish_and_clear();
    let done = done?;
    let mut text = format!(
        "job {}: {} runs, {} of them simulated now",
        done.job, done.places, done.places_taken
    );
    if done.refused > 0 {
        text += &format!(", {} refused (why is in the table)", done.refused);
    }
    match &done.table {
        Some(table) => text += &format!("\ntable:  {}", path(table)),
        None => {
            text += &format!(
                "\n{} runs are missing; after the last shard:  lasertrace sweep {} -o {} --merge",
                done.missing,
                path(&sweep),
                path(&out)
            );
        }
    }
    if let Some(plots) = &done.plots {
        text += &format!("\nplots:  {}", path(plots));
    }
    output.result(&done, &text)
}
