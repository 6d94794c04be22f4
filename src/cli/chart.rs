use super::{ForceArguments, Output, STOP, SceneArguments, show};
use crate::run::RunControl;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::short;
use crate::study::{Chart, ChartEffort, ChartFigures, ExternalRender};
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Number of frames, distributed over the scan
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..1000))]
    frames: u32,
    /// Number of timed repetitions of each frame for each combination of methods
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..1000))]
    rounds: u32,
    /// Frames rendered by another program, shown as a point of the chart: a JSON file with `name`
    /// and `frames`, where each frame has `frame`, `ms` (times on one core) and `image` (PNG of the
    /// sensor counts). The chart uses these frames
    #[arg(long, value_name = "FILE", conflicts_with = "frames")]
    beside: Option<PathBuf>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let beside = arguments
        .beside
        .as_deref()
        .map(ExternalRender::read)
        .transpose()?;
    let effort = ChartEffort {
        frames: (beside.as_ref()).map_or(arguments.frames, |beside| beside.frames.len() as u32),
        rounds: arguments.rounds,
    };
    let building = output.share("prepared");
    let bar = output.progress(study::chart_steps(&scene, effort), "frames");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let chart = study::chart(
        &scene,
        effort,
        beside.as_ref(),
        arguments.force.folder(&arguments.output),
        &control,
    );
    bar.finish_and_clear();
    let chart = chart?;
    output.result(&chart, &text(&chart))
}

fn text(chart: &Chart) -> String {
    let mut text = format!(
        "{}\n\n{:>10} {:>9} {:>11} {:>9} {:>9} {:>7}  method\n",
        chart.headline(),
        "ms",
        "speed-up",
        "99 %, µm",
        "bias, µm",
        "noise, µm",
        "lost, %"
    );
    let mut line = |mark: &str, figures: &ChartFigures| {
        let _ = writeln!(
            text,
            "{:>10} {:>9} {:>11} {:>9} {:>9} {:>7}  {mark}{}",
            short(figures.ms[1]),
            short(figures.speed_up),
            figures.error.percentile_99_um.map_or("-".into(), short),
            short(figures.error.median_error_um),
            short(figures.error.half_width_68_um),
            short(100.0 * figures.error.lost),
            figures.name
        );
    };
    for row in &chart.rows {
        let mark = match (row.chosen, row.pareto_optimal) {
            (true, _) => "* ",
            (_, true) => "+ ",
            _ => "  ",
        };
        line(mark, &row.figures);
    }
    if let Some(figures) = &chart.beside {
        line("  ", figures);
    }
    let (picture, json) = (path(&chart.picture), path(&chart.json));
    text + &format!("(* chosen, + on the front)\n{picture}\n{json}\n")
}
