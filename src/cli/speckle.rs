use super::{Output, STOP};
use crate::batch::{self, Control, SpeckleSummary};
use crate::error::Result;
use crate::speckle::pattern::{Aperture, PatternSpec};
use crate::speckle::statistics::Check;
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Texels along each side of the pattern, a power of two
    #[arg(long, value_name = "N", default_value_t = 512)]
    size: usize,
    /// Texels per minimal speckle size
    #[arg(long, value_name = "X", default_value_t = 4.0)]
    texels_per_speckle: f64,
    /// Correlation slices, a power of two
    #[arg(long, value_name = "N", default_value_t = 32)]
    slices: usize,
    /// Shape of the lens aperture
    #[arg(long, value_enum, default_value_t = Shape::Circle)]
    aperture: Shape,
    /// Height / width of an ellipse
    #[arg(long, value_name = "R", default_value_t = 0.5)]
    ratio: f64,
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Shape {
    Circle,
    Ellipse,
    Square,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let spec = PatternSpec {
        size: arguments.size,
        texels_per_speckle: arguments.texels_per_speckle,
        aperture: match arguments.aperture {
            Shape::Circle => Aperture::Circle,
            Shape::Ellipse => Aperture::Ellipse {
                ratio: arguments.ratio,
            },
            Shape::Square => Aperture::Square,
        },
        slices: arguments.slices,
        seed: arguments.seed,
    };
    let control = Control {
        progress: &|_| {},
        stop: &STOP,
    };
    let summary = batch::speckle(&spec, &arguments.output, &control)?;
    output.result(&summary, &text(&summary))
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
    let mut row = |name: &str, measured: f64, theory: f64, tolerance: f64, pass: bool| {
        let verdict = if pass { "" } else { "  FAILED" };
        let _ = writeln!(
            text,
            "{name:<44} {measured:>9.4} {theory:>9.4} {tolerance:>9.4}{verdict}"
        );
    };
    let mut check = |name: &str, c: &Check| row(name, c.measured, c.theory, c.tolerance, c.pass);
    check("contrast", &s.contrast);
    for p in &s.pixel_integration {
        check(
            &format!("contrast over pixels of {} grains", p.q),
            &p.contrast,
        );
    }
    check("contrast of interpolated fields", &s.slices.field_contrast);
    row(
        "contrast of the trilinear method",
        s.slices.trilinear_contrast,
        1.0,
        f64::NAN,
        true,
    );
    let ks = &s.exponential;
    row(
        "distance to exponential intensities",
        ks.distance,
        0.0,
        ks.critical,
        ks.pass,
    );
    let a = &s.autocovariance;
    row(
        "autocovariance, largest error",
        a.largest_error,
        0.0,
        a.tolerance,
        a.pass,
    );
    let c = &s.slices.correlation;
    row(
        "correlation of slices, largest error",
        c.largest_error,
        0.0,
        c.tolerance,
        c.pass,
    );
    for grain in &summary.grains {
        let name = format!("grain of 300 mm at f/{} (FWHM), µm", grain.f_number);
        row(&name, grain.fwhm_um, grain.fwhm_theory_um, f64::NAN, true);
    }
    let _ = writeln!(
        text,
        "\n{}\n{}",
        summary.pattern.display(),
        summary.picture.display()
    );
    text.replace("      NaN", "        –")
}
