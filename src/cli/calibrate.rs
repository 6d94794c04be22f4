use super::{ForceArguments, Output, STOP, SceneArguments};
use crate::run::RunControl;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::short;
use crate::study::CalibrationSummary;
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let bar = output.progress(study::CALIBRATION_VIEWS as u64, "views");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let summary = study::calibrate(scene, arguments.force.folder(&arguments.output), &control);
    bar.finish_and_clear();
    let summary = summary?;
    output.result(&summary, &text(&summary))
}

fn text(summary: &CalibrationSummary) -> String {
    let mut text = format!(
        "{} views: {} dots (σ = {} px), {} points of the laser line (σ = {} px)\n\n\
         {:<24}{:>14}{:>14}{:>10}\n",
        summary.views,
        summary.dots,
        short(summary.dot_sigma_px),
        summary.line_points,
        short(summary.line_sigma_px),
        "parameter",
        "error",
        "uncertainty",
        "ratio"
    );
    for p in &summary.parameters {
        let _ = writeln!(
            text,
            "{:<24}{:>14.3e}{:>14.3e}{:>10.2}",
            p.parameter, p.error, p.standard_uncertainty, p.normalised_error
        );
    }
    text + &format!(
        "\nχ² of all errors {:.1} (expected: mean {}, standard deviation {:.1})\n\
         points of the laser plane: off by {} µm, uncertain by {} µm (rms over the sensor)\n\
         {}\n{}\n",
        summary.chi_squared,
        summary.parameters.len(),
        (2.0 * summary.parameters.len() as f64).sqrt(),
        short(summary.point_error_um),
        short(summary.point_uncertainty_um),
        path(&summary.calibration),
        path(&summary.picture)
    )
}
