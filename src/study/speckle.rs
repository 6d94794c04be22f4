//! Speckle patterns as images, and their statistics compared with theory.

use crate::error::{Result, printable};
use crate::math::DVec2;
use crate::report::picture::encode_for_eyes;
use crate::report::svg::Svg;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, files};
use crate::speckle::coordinate::Coordinate;
use crate::speckle::lookup::{Coherence, Method, SpeckleTexture};
use crate::speckle::pattern::{PatternSpec, PhasorPlane};
use crate::speckle::statistics::{SpeckleStatistics, measure};
use exr::prelude::FlatSamples;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Results of `lasertrace speckle`.
#[derive(Debug, Serialize)]
pub struct SpeckleSummary {
    /// Statistics compared with theory.
    pub statistics: SpeckleStatistics,
    /// Time to generate all slices for the field method once, s.
    pub seconds_patterns: f64,
    /// Memory of the slices, MB.
    pub megabytes_patterns: f64,
    /// Grain sizes for each lens of the plot.
    pub grains: Vec<GrainMeasurement>,
    /// Path of the pattern.
    #[serde(serialize_with = "printable::in_json")]
    pub pattern: PathBuf,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Theoretical and measured grain size for one lens.
#[derive(Debug, Clone, Serialize)]
pub struct GrainMeasurement {
    /// F-number N of the lens.
    pub f_number: f64,
    /// Minimal speckle size h = λN(1 + m), µm.
    pub h_um: f64,
    /// Full width at half maximum of the autocovariance, mean of both axes, µm.
    pub fwhm_um: f64,
    /// Theoretical full width at half maximum, µm: |2J₁(x)/x|² falls to ½ at 0.5145·h.
    pub fwhm_theory_um: f64,
}

/// Lens of the plot, as in Bergmann et al. (2016): 300 mm at two f-numbers, with a target at 3 m.
/// Lengths are in mm.
const FOCAL_LENGTH: f64 = 300.0;
const TARGET: f64 = 3000.0;
const WAVELENGTH: f64 = 660e-6;
const F_NUMBERS: [f64; 2] = [11.0, 45.0];
/// Sampling of the plot: 1 µm, a small fraction of the grain size.
const SAMPLE_SPACING_MM: f64 = 1e-3;
const SIDE: usize = 512;

/// Writes `pattern.exr` (intensity of slice 0, and its field), `statistics.json` and
/// `f-numbers.svg`.
pub fn speckle<'a>(
    spec: &PatternSpec,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<SpeckleSummary> {
    spec.validate()?;
    let names = Names::of(["pattern.exr", "statistics.json", "f-numbers.svg"]);
    let out = out.into().claim(&[], &names)?.path;
    let start = Instant::now();
    let lookup = SpeckleTexture::new(spec, Method::Field, Coherence::FULL)?;
    let seconds_patterns = start.elapsed().as_secs_f64();
    control.check()?;
    let summary = SpeckleSummary {
        seconds_patterns,
        megabytes_patterns: lookup.memory() as f64 / 1e6,
        statistics: measure(spec)?,
        grains: Vec::new(),
        pattern: out.join("pattern.exr"),
        picture: out.join("f-numbers.svg"),
    };
    drop(lookup);
    control.check()?;
    write_pattern(&summary.pattern, spec)?;
    let summary = SpeckleSummary {
        grains: picture(&summary.picture, spec.seed)?,
        ..summary
    };
    files::write_json(&out.join("statistics.json"), &summary)?;
    Ok(summary)
}

fn write_pattern(path: &Path, spec: &PatternSpec) -> Result<()> {
    let pattern = PhasorPlane::new(spec).pattern(DVec2::ZERO);
    let of = |channel: fn(&rustfft::num_complex::Complex32) -> f32| {
        FlatSamples::F32(pattern.field.iter().map(channel).collect())
    };
    let channels = [
        ("intensity", of(|a| a.norm_sqr())),
        ("field.re", of(|a| a.re)),
        ("field.im", of(|a| a.im)),
    ];
    files::write_exr(path, (spec.size, spec.size), channels)
}

/// Plots the grains of both f-numbers next to each other, and measures their size.
fn picture(path: &Path, seed: u64) -> Result<Vec<GrainMeasurement>> {
    let spec = PatternSpec {
        seed,
        slices: 8,
        ..PatternSpec::default()
    };
    let lookup = SpeckleTexture::new(&spec, Method::Field, Coherence::FULL)?;
    let magnification = FOCAL_LENGTH / (TARGET - FOCAL_LENGTH);
    let width = SIDE as f64 * 1.15;
    let mut svg = Svg::file([2.0 * width, SIDE as f64 + 100.0], 17.0);
    let mut grains = Vec::new();
    for (i, f_number) in F_NUMBERS.into_iter().enumerate() {
        let h = WAVELENGTH * f_number * (1.0 + magnification);
        let texels_per_mm = spec.texels_per_speckle / h;
        let intensity: Vec<f64> = (0..SIDE * SIDE)
            .map(|k| {
                let texels = |step: usize| step as f64 * SAMPLE_SPACING_MM * texels_per_mm;
                let (s, t) = (texels(k % SIDE), texels(k / SIDE));
                lookup.intensity(Coordinate { s, t, u: 0.0 }) as f64
            })
            .collect();
        let grain = GrainMeasurement {
            f_number,
            h_um: h * 1e3,
            fwhm_um: half_width(&intensity) * 2.0 * SAMPLE_SPACING_MM * 1e3,
            fwhm_theory_um: 2.0 * 0.514_5 * h * 1e3,
        };
        panel(&mut svg, (i as f64 + 0.065) * width, &intensity, &grain);
        grains.push(grain);
    }
    files::write_bytes(path, svg.finish().as_bytes())?;
    Ok(grains)
}

fn panel(svg: &mut Svg, x: f64, intensity: &[f64], grain: &GrainMeasurement) {
    // For exponential intensities with mean 1, 2 % exceed 4.
    let counts: Vec<u16> = intensity
        .iter()
        .map(|i| (i / 4.0 * 65535.0).min(65535.0) as u16)
        .collect();
    let png = encode_for_eyes(&counts, SIDE, u16::MAX);
    let side = SIDE as f64;
    svg.image([x, 16.0, side, side], &png);
    let lens = format!(
        "{FOCAL_LENGTH} mm, f/{}: h = {:.1} µm ({:.2} mm of sensor shown)",
        grain.f_number,
        grain.h_um,
        side * SAMPLE_SPACING_MM
    );
    svg.text([x, side + 44.0], "", &lens);
    let found = format!(
        "grain (FWHM of autocovariance): {:.1} µm measured, {:.1} µm in theory",
        grain.fwhm_um, grain.fwhm_theory_um
    );
    svg.text([x, side + 70.0], "", &found);
}

/// Returns the lag at which the autocovariance falls to half, in samples, with linear interpolation
/// between lags. It is the mean of both axes. The ensemble mean 1 is subtracted, because the mean
/// of an image with few grains would lower the autocovariance.
fn half_width(intensity: &[f64]) -> f64 {
    let covariance = |along: usize, lag: usize| {
        let (mut sum, mut n) = (0.0, 0.0);
        for y in 0..SIDE - if along == 1 { lag } else { 0 } {
            for x in 0..SIDE - if along == 0 { lag } else { 0 } {
                let a = intensity[y * SIDE + x];
                let b = match along {
                    0 => intensity[y * SIDE + x + lag],
                    _ => intensity[(y + lag) * SIDE + x],
                };
                sum += (a - 1.0) * (b - 1.0);
                n += 1.0;
            }
        }
        sum / n
    };
    let half = |along: usize| {
        let zero = covariance(along, 0);
        let mut last = 1.0;
        for lag in 1..SIDE {
            let now = covariance(along, lag) / zero;
            if now < 0.5 {
                return lag as f64 - (0.5 - now) / (last - now);
            }
            last = now;
        }
        SIDE as f64
    };
    (half(0) + half(1)) / 2.0
}
