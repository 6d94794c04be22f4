use super::{ForceArguments, Output, STOP};
use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::with_interval;
use crate::run::RunControl;
use crate::study::{self, FitSummary};
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Sensor file (TOML) whose keys are fitted
    sensor: PathBuf,
    /// Recording files: height maps (file, z_scale_um, x_step_mm, y_step_mm) or images of a line
    /// (images)
    #[arg(required = true, value_name = "DATA")]
    recordings: Vec<PathBuf>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: &Arguments, output: &Output) -> Result<()> {
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let out = arguments.force.folder(&arguments.output);
    let summary = study::fit(&arguments.sensor, &arguments.recordings, out, &control)?;
    output.result(&summary, &text(&summary))
}

fn text(summary: &FitSummary) -> String {
    let mut text = String::new();
    for fitted in &summary.values {
        let [low, high] = fitted.interval;
        let [value, low, high] = with_interval([fitted.value, low, high]);
        let value = format!("{value} ({low} to {high}) {}", fitted.unit.symbol());
        let key = fitted.key.unwrap_or("");
        let _ = writeln!(text, "{:<62}{value:<36}{key}", fitted.name);
    }
    for (title, lines) in [
        ("misfit", &summary.misfits),
        ("not separable", &summary.inseparable),
    ] {
        for line in lines {
            let _ = writeln!(text, "{title}: {line}");
        }
    }
    let _ = write!(text, "\n{}\n", path(&summary.sensor));
    if let Some(surface) = &summary.surface {
        let _ = writeln!(text, "{}", path(surface));
    }
    text + &format!("{}\n", path(&summary.page))
}
