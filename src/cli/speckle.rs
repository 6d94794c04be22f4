use super::{ForceArguments, Output, STOP};
use crate::run::RunControl;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use crate::math::Aperture;
use crate::speckle::pattern::PatternSpec;
use crate::speckle::statistics::StatisticalCheck;
use crate::study::SpeckleSummary;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Number of texels along each side of the pattern, a power of two
    #[arg(long, value_name = "N", default_value_t = 512)]
    size: usize,
    /// Texels per minimal speckle size
    #[arg(long, value_name = "X", default_value_t = 4.0)]
    texels_per_speckle: f64,
    /// Number of correlation slices, a power of two
    #[arg(long, value_name = "N", default_value_t = 32)]
    slices: usize,
    /// Shape of the lens aperture
    #[arg(long, value_enum, default_value_t = ApertureShape::Circle)]
    aperture: ApertureShape,
    /// Ratio of height to width of an elliptical aperture
    #[arg(long, value_name = "R", default_value_t = 0.5)]
    ratio: f64,
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum ApertureShape {
    Circle,
    Ellipse,
    Square,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let spec = PatternSpec {
        size: arguments.size,
        texels_per_speckle: arguments.texels_per_speckle,
        aperture: match arguments.aperture {
            ApertureShape::Circle => Aperture::Circle,
            ApertureShape::Ellipse => Aperture::Ellipse(arguments.ratio),
            ApertureShape::Square => Aperture::Square,
        },
        slices: arguments.slices,
        seed: arguments.seed,
    };
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let summary = study::speckle(&spec, arguments.force.folder(&arguments.output), &control)?;
    output.result(&summary, &text(&summary))
}

/// Formats a row of the table: measured value, theory, and the tolerance if there is one.
fn row(name: &str, measured: f64, theory: f64, tolerance: Option<(f64, bool)>) -> String {
    let within = match tolerance {
        Some((tolerance, pass)) => {
            format!("{tolerance:>9.4}{}", if pass { "" } else { "  FAILED" })
        }
        None => String::new(),
    };
    format!("{name:<44} {measured:>9.4} {theory:>9.4} {within}\n")
}

fn check(name: &str, c: &StatisticalCheck) -> String {
    row(name, c.measured, c.theory, Some((c.tolerance, c.pass)))
}

fn text(summary: &SpeckleSummary) -> String {
    let s = &summary.statistics;
    let mut text = format!(
        "{} slices in {:.2} s, {:.0} MB; statistics over {} speckles\n\n{:<44} {:>9} {:>9} {:>9}\n",
        s.spec.slices,
        summary.seconds_patterns,
        summary.megabytes_patterns,
        s.independent_speckles,
        "",
        "measured",
        "theory",
        "within"
    );
    text += &check("contrast", &s.contrast);
    for p in &s.pixel_integration {
        let name = format!("contrast over pixels of {} grains", p.q);
        text += &check(&name, &p.contrast);
    }
    text += &check("contrast of interpolated fields", &s.slices.field_contrast);
    let trilinear = s.slices.trilinear_contrast;
    text += &row("contrast of the trilinear method", trilinear, 1.0, None);
    for (name, error, tolerance, pass) in [
        (
            "distance to exponential intensities",
            s.exponential.distance,
            s.exponential.critical,
            s.exponential.pass,
        ),
        (
            "autocovariance, largest error",
            s.autocovariance.largest_error,
            s.autocovariance.tolerance,
            s.autocovariance.pass,
        ),
        (
            "correlation of slices, largest error",
            s.slices.correlation.largest_error,
            s.slices.correlation.tolerance,
            s.slices.correlation.pass,
        ),
    ] {
        text += &row(name, error, 0.0, Some((tolerance, pass)));
    }
    for grain in &summary.grains {
        let name = format!("grain of 300 mm at f/{} (FWHM), µm", grain.f_number);
        text += &row(&name, grain.fwhm_um, grain.fwhm_theory_um, None);
    }
    let (pattern, picture) = (path(&summary.pattern), path(&summary.picture));
    text + &format!("\n{pattern}\n{picture}\n")
}
