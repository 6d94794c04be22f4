use super::{ForceArguments, Output};
use crate::error::Result;
use crate::error::printable::path;
use crate::scene::Unit;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Mesh file (STL, OBJ, PLY, glTF or 3MF)
    mesh: PathBuf,
    /// Length unit of the mesh file; not needed for 3MF and glTF (metres)
    #[arg(long, value_enum)]
    unit: Option<Unit>,
    /// Number of rays of each kind
    #[arg(long, value_name = "N", default_value_t = 1 << 18, value_parser = clap::value_parser!(u32).range(1..))]
    rays: u32,
    /// Number of rounds; every structure is built and timed once per round
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    rounds: u16,
    /// Time limit for each hierarchy, s; measurements omitted for lack of time are reported
    #[arg(long, value_name = "S", default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..))]
    seconds: u32,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

#[cfg(feature = "race")]
pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    use super::STOP;
    use crate::run::RunControl;
    use crate::study;

    use crate::race::{BenchmarkBudget, table};

    // Builds by other crates cannot be interrupted. All files are written after the race has ended.
    let effort = BenchmarkBudget {
        rays: arguments.rays as usize,
        rounds: arguments.rounds.into(),
        seconds: arguments.seconds.into(),
    };
    let mesh = crate::mesh::load(&arguments.mesh, arguments.unit.map(Unit::mm))?;
    let bar = output.progress(effort.steps() as u64, "builds and rounds");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let forecast = |seconds: f64| {
        let minutes = (seconds / 60.0).max(0.1);
        output.say(&format!(
            "the race takes at most about {minutes:.1} minutes, {} s for each racer",
            effort.seconds
        ));
    };
    let (mesh_file, out) = (&arguments.mesh, arguments.force.folder(&arguments.output));
    let bench = study::bench_bvh(mesh_file, &mesh, effort, out, &forecast, &control);
    bar.finish_and_clear();
    let bench = bench?;
    let (picture, json) = (path(&bench.picture), path(&bench.json));
    let text = format!("{}\n{picture}\n{json}", table(&bench.race));
    output.result(&bench, &text)
}

/// Returns an error, because this program was built without the competing crates.
#[cfg(not(feature = "race"))]
pub fn run(arguments: Arguments, _: &Output) -> Result<()> {
    let unit = arguments.unit.map(|unit| format!(" --unit {unit}"));
    Err(crate::error::Error::Usage(format!(
        "bench-bvh races against crates that lasertrace itself does without, and this \
         program was built without them; in lasertrace's folder, run:\n\
         cargo run --release --features race -- bench-bvh {}{} --rays {} --rounds {} --seconds {} -o {}",
        path(&arguments.mesh),
        unit.unwrap_or_default(),
        arguments.rays,
        arguments.rounds,
        arguments.seconds,
        path(&arguments.output)
    )))
}
