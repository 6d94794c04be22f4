use super::{ForceArguments, Output, STOP, scan, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::{self, Control, Plot, Shard};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Sweep (TOML): a scene, and the values it is to have, on a grid, in a list or drawn
    sweep: PathBuf,
    /// Scan the places I, I + N, … alone, into a folder that all N shards share. auto/N: I is the number that
    /// Slurm, Kubernetes or AWS Batch gives a job of an array
    #[arg(long, value_name = "I/N", value_parser = scan::shard, default_value = "0/1")]
    shard: Shard,
    /// Scan nothing: write the table of what the shards have scanned, or say which of them are to run again
    #[arg(long, conflicts_with = "shard")]
    merge: bool,
    /// A figure over a key or over another figure, by their names in the table; may be given again
    #[arg(long, value_name = "FIGURE:KEY", value_parser = plot)]
    plot: Vec<Plot>,
    /// Folder to write to; places that are done there are not scanned again
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
    let bar = output.progress(run::sweep_places(&sweep, shard)?, "places");
    let building = output.share("prepared");
    let control = Control {
        progress: &|done| bar.set_position(done),
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let done = match merge {
        true => run::sweep_merge(&sweep, &plot, force.folder(&out), &control),
        false => run::sweep(&sweep, shard, &plot, force.folder(&out), &control),
    };
    bar.finish_and_clear();
    let done = done?;
    let mut text = format!(
        "job {}: {} places, {} of them scanned now",
        done.job, done.places, done.places_taken
    );
    if done.refused > 0 {
        text += &format!(", {} refused (why is in the table)", done.refused);
    }
    match &done.table {
        Some(table) => text += &format!("\ntable:  {}", path(table)),
        None => {
            text += &format!(
                "\n{} places are not there yet; when all shards have ended:  lasertrace sweep {} -o {} --merge",
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
