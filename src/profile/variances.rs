//! Variances of the rows of lines by their width: what speckle and noise make of a unit of light.

use super::PeakFinder;
use super::influence::{influence, shares};
use crate::speckle::pattern::Aperture;
use crate::speckle::theory::strip_covariance;

/// Speckle of the light on the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeckleGrain {
    /// Minimal speckle size h = λ·d_PI/D, px.
    pub size_px: f64,
    /// Contrast of the light before pixels integrate it; below 1 if it is
    /// depolarised or of several wavelengths.
    pub contrast: f64,
    pub aperture: Aperture,
}

/// Parts into which a pixel's height is divided so that a line of σ lights each all but evenly.
/// Of the mean square of light, a part s·σ high leaves out s²/12·(dG/dx)²/G², s²/24 on average
/// over the line; of σ/4 that is 0.3 %.
fn parts(sigma: f64) -> usize {
    (4.0 / sigma).ceil() as usize
}

/// Variances of the row of a line of one width, px².
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Variances {
    pub speckle: f64,
    /// Over K/N.
    pub shot: f64,
    /// Over (s/N)².
    pub white: f64,
    /// Relative, of the line's light, from speckle.
    pub light: f64,
}

/// Covariance of the light of parts 0, 1, … apart of pixels that have so many each, until what is
/// left is below a thousandth of it all, as ∫μ² beyond r falls as (h/r)²/60, or past what any line
/// of that many parts lights.
pub(super) fn covariances(grain: &SpeckleGrain, parts: usize) -> Vec<f64> {
    let most = if parts > 1 { 64.0 } else { 512.0 };
    let lags = (8.0 * grain.size_px * parts as f64).ceil().min(most) as usize + 1;
    let high = 1.0 / parts as f64;
    let covariance = |lag| {
        let q = 1.0 / grain.size_px;
        grain.contrast.powi(2) * strip_covariance(grain.aperture, q, high, lag as f64 * high)
    };
    (0..=lags).map(covariance).collect()
}

/// Variances of lines of these widths, in ascending order.
pub(super) fn variances(
    finder: PeakFinder,
    grain: Option<SpeckleGrain>,
    sigmas: impl Iterator<Item = f64>,
) -> Vec<Variances> {
    let mut known = (0, Vec::new());
    let of = |sigma| {
        let parts = parts(sigma);
        if known.0 != parts {
            let covariance = grain.map_or(vec![0.0], |grain| covariances(&grain, parts));
            known = (parts, covariance);
        }
        Variances::of(finder, sigma, parts, &known.1)
    };
    sigmas.map(of).collect()
}

impl Variances {
    /// Mean over a line at a pixel's middle and one at its edge; `covariance` is that of parts.
    fn of(finder: PeakFinder, sigma: f64, parts: usize, covariance: &[f64]) -> Variances {
        let mut sum = Variances::default();
        for row in [0.0, 0.5] {
            let pixels = influence(finder, sigma, row);
            for &(light, weight) in &pixels {
                sum.shot += weight * weight * light / 2.0;
                sum.white += weight * weight / 2.0;
            }
            // A part moves the finder as its pixel does.
            let weights = pixels.iter().flat_map(|p| std::iter::repeat_n(p.1, parts));
            let parts: Vec<(f64, f64)> = shares(sigma, row, parts).zip(weights).collect();
            for (lag, c) in covariance.iter().enumerate().take(parts.len()) {
                // Both signs of a lag.
                let c = if lag == 0 { c / 2.0 } else { *c };
                for (a, b) in parts.iter().zip(&parts[lag..]) {
                    sum.speckle += c * a.0 * a.1 * b.0 * b.1;
                    sum.light += c * a.0 * b.0;
                }
            }
        }
        sum
    }
}
