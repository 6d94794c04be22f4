//! Sensitivity of peak estimators to pixel errors, and their bias.

use super::PeakFinder;
use super::peak_estimators::{FILTER_SIGMAS, WINDOW_SIGMAS};
use std::f64::consts::{PI, SQRT_2};

/// Returns the light and the weight w of each pixel for a Gaussian line of `sigma` px and unit
/// light at `row`, which must be 0 or ½. Pixel i covers [i, i+1], and the pixels are symmetric
/// about the line.
///
/// - Centroid: w = y within its window.
/// - Least squares: G'/ΣG'².
/// - Log-parabola, upper half weighted by squared counts: s²·G·y/ΣG²y².
/// - Zero crossing: the filter divided by its slope at the crossing.
pub(super) fn estimator_weights(finder: PeakFinder, sigma: f64, row: f64) -> Vec<(f64, f64)> {
    let [first, after] = pixels(sigma, row);
    let (reach, last) = (-first, after - 1);
    let edge = |i: i64| (i as f64 - row) / sigma;
    let share = |i: i64| 0.5 * (libm::erf(edge(i + 1) / SQRT_2) - libm::erf(edge(i) / SQRT_2));
    let density = |i: i64| (-0.5 * edge(i).powi(2)).exp() / ((2.0 * PI).sqrt() * sigma);
    let middle = |i: i64| i as f64 + 0.5 - row;
    let weights: Vec<f64> = match finder {
        PeakFinder::Centroid => {
            let half = (WINDOW_SIGMAS * sigma).max(1.0);
            let inside = |i| (half + 0.5 - middle(i).abs()).clamp(0.0, 1.0);
            (-reach..=last).map(|i| middle(i) * inside(i)).collect()
        }
        PeakFinder::GaussianFit => {
            let slope = |i| density(i) - density(i + 1);
            let squares: f64 = (-reach..=last).map(|i| slope(i).powi(2)).sum();
            (-reach..=last).map(|i| slope(i) / squares).collect()
        }
        PeakFinder::LogParabola => {
            let top = share(if row == 0.0 { -1 } else { 0 });
            let used = |i: &i64| share(*i) >= 0.5 * top || middle(*i).abs() < 1.6;
            let moment = |i| share(i) * middle(i);
            let squares: f64 = (-reach..=last)
                .filter(used)
                .map(|i| moment(i).powi(2))
                .sum();
            let scale = (sigma * sigma + 1.0 / 12.0) / squares;
            let weight = |i| if used(&i) { scale * moment(i) } else { 0.0 };
            (-reach..=last).map(weight).collect()
        }
        PeakFinder::DerivativeZero => {
            let n = (FILTER_SIGMAS * sigma).round().max(1.0) as i64;
            let filter = |i: i64, at: i64| match i - at {
                k if k.abs() <= n => k.signum() as f64,
                _ => 0.0,
            };
            let derivative =
                |at| -> f64 { (-reach..=last).map(|i| share(i) * filter(i, at)).sum() };
            let slope = derivative(-1) - derivative(0);
            let other = if row == 0.0 { -1 } else { 0 };
            let mean = |i| (filter(i, other) + filter(i, 0)) / 2.0;
            (-reach..=last).map(|i| mean(i) / slope).collect()
        }
    };
    pixel_fractions(sigma, row, 1).zip(weights).collect()
}

/// Divides every pixel of [`estimator_weights`] into `parts` parts and returns the light of each
/// part.
pub(super) fn pixel_fractions(sigma: f64, row: f64, parts: usize) -> impl Iterator<Item = f64> {
    let [first, last] = pixels(sigma, row).map(|i| i * parts as i64);
    let below = move |part: i64| {
        let edge = (part as f64 / parts as f64 - row) / sigma;
        0.5 * libm::erf(edge / SQRT_2)
    };
    (first..last).map(move |part| below(part + 1) - below(part))
}

/// Returns the first pixel of the line and the pixel after the last.
fn pixels(sigma: f64, row: f64) -> [i64; 2] {
    let reach = (5.0 * sigma).ceil() as i64 + 2;
    [-reach, if row == 0.0 { reach } else { reach + 1 }]
}

/// Returns the maximum error for an ideal line of at least 0.7 px; see `tests/points/peaks.rs`. The
/// centroid of narrower lines has an error given by the first alias of the pixel grid,
/// e^(−2π²σ²)/π.
pub(super) fn bias(finder: PeakFinder, sigma: f64) -> f64 {
    match finder {
        PeakFinder::Centroid => 0.002 + (-2.0 * (PI * sigma).powi(2)).exp() / PI,
        PeakFinder::LogParabola => 0.005,
        PeakFinder::GaussianFit => 1e-4,
        PeakFinder::DerivativeZero => 0.07 / (sigma * sigma) + 1e-3,
    }
}
