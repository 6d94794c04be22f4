//! Sub-pixel position of a line.

use super::PeakFinder;
use super::fit::{gaussian_fit, solve};
use super::line::{DetectedLine, PeakEstimate};
use crate::camera::ColumnView;
use nalgebra::{Matrix3, Vector3};

/// Half width of the centroid window, in standard deviations of the line. At 3, the light of the
/// partial pixels at the ends of the window shifts the centroid of a line of σ = 1 px by 0.003 px.
pub(super) const WINDOW_SIGMAS: f64 = 4.0;

/// Variance that pixel integration adds to a line, px².
pub(super) const PIXEL_VARIANCE: f64 = 1.0 / 12.0;

/// Returns the position of the line and the sum of its counts above background.
///
/// An estimator falls back to the centroid if the line does not fit its model, for example with too
/// few lit pixels below saturation. Returns `None` if the window contains no light.
pub(super) fn locate(line: &DetectedLine, finder: PeakFinder) -> Option<(PeakEstimate, f64)> {
    let (centroid, intensity) = centroid(line)?;
    let better = match finder {
        PeakFinder::Centroid => None,
        PeakFinder::LogParabola => log_parabola(line),
        PeakFinder::GaussianFit => gaussian_fit(line, centroid),
        PeakFinder::DerivativeZero => {
            derivative_zero(line).map(|row| PeakEstimate { row, ..centroid })
        }
    };
    Some((better.unwrap_or(centroid), intensity))
}

/// Returns the rows around `top` whose counts reach `level`.
fn run(column: &ColumnView, top: usize, level: f64) -> std::ops::Range<usize> {
    let above = |row: &usize| column.at(*row) as f64 >= level;
    let before = (0..top).rev().take_while(above).count();
    let after = (top..column.rows()).take_while(above).count();
    top - before..top + after
}

/// Returns the standard deviation of a Gaussian with the width at half height of the line around
/// `top`. Counts are interpolated linearly between pixels.
pub(super) fn half_height_sigma(column: &ColumnView, top: usize, background: f64) -> f64 {
    let half = background + (column.at(top) as f64 - background) / 2.0;
    let rows = run(column, top, half);
    let end = |inner: usize, outer: Option<usize>| {
        let inner = column.at(inner) as f64;
        let outer = outer.map_or(background, |row| column.at(row) as f64);
        (inner - half) / (inner - outer)
    };
    let before = end(rows.start, rows.start.checked_sub(1));
    let after = (rows.end < column.rows()).then_some(rows.end);
    let after = end(rows.end - 1, after);
    ((rows.len() - 1) as f64 + before + after) / 2.354_82
}

/// Returns whether a pixel in the upper half of the line reaches `max_count`.
pub(super) fn is_saturated(line: &DetectedLine) -> bool {
    let half = line.background.mean + line.height / 2.0;
    let pixels = line.column.between(run(&line.column, line.top, half));
    pixels.iter().any(|&count| count >= line.max_count)
}

/// Returns the centroid of the counts above background within four line widths.
fn centroid(line: &DetectedLine) -> Option<(PeakEstimate, f64)> {
    let background = line.background.mean;
    let half = (WINDOW_SIGMAS * line.sigma).max(1.0);
    // The window is centred on the resulting centroid, so truncation is symmetric and causes no
    // bias. From an error of half a pixel, the iteration converges in a few steps.
    let mut row = line.top as f64 + 0.5;
    let mut intensity = 0.0;
    for _ in 0..20 {
        let moved = windowed_centroid(&line.column, background, row - half, row + half)?;
        let step = moved.0 - row;
        (row, intensity) = moved;
        if step.abs() < 1e-6 {
            break;
        }
    }
    let variance = windowed_variance(&line.column, background, row, half) / intensity;
    let sigma = match variance > PIXEL_VARIANCE {
        true => (variance - PIXEL_VARIANCE).sqrt(),
        false => 0.0,
    };
    Some((PeakEstimate { row, sigma }, intensity))
}

/// Returns the centroid and the sum of the counts above background from row `low` to row `high`.
/// Partial pixels are weighted by the covered fraction, at its centre.
fn windowed_centroid(
    column: &ColumnView,
    background: f64,
    low: f64,
    high: f64,
) -> Option<(f64, f64)> {
    let low = low.max(0.0);
    let high = high.min(column.rows() as f64);
    let (mut sum, mut moment) = (0.0, 0.0);
    let first = low as usize;
    let counts = column.between(first..(high.ceil() as usize).max(first));
    for (i, &count) in (first..).zip(counts) {
        let (from, to) = (low.max(i as f64), high.min(i as f64 + 1.0));
        let weight = (count as f64 - background) * (to - from);
        sum += weight;
        moment += weight * (from + to) / 2.0;
    }
    let row = moment / sum;
    (sum > 0.0 && (low..=high).contains(&row)).then_some((row, sum))
}

/// Returns the second moment about `row` of the counts above background. Pixels whose centres are
/// within `half` of `row` contribute.
fn windowed_variance(column: &ColumnView, background: f64, row: f64, half: f64) -> f64 {
    let low = (row - half).max(0.0) as usize;
    let high = ((row + half).ceil() as usize).min(column.rows());
    let counts = column.between(low..high).iter();
    (low..)
        .zip(counts)
        .map(|(i, &count)| (i as f64 + 0.5 - row, count as f64 - background))
        .filter(|(x, _)| x.abs() <= half)
        .map(|(x, weight)| weight * x * x)
        .sum()
}

/// Fits a Gaussian to the upper half of the line by a parabola through the logarithms of the
/// counts.
///
/// At least three pixels are used (Naidu & Fisher 1991 use three). The fit is weighted by the
/// squared counts, because the logarithm of a noisy count has a standard deviation of noise/count
/// (Guo 2011). Pixel integration adds 1/12 px² to the variance, which is subtracted. It also adds a
/// fourth cumulant of -1/120 px⁴, which moves the vertex of three points by less than 0.001 px for
/// σ ≥ 0.7 px.
fn log_parabola(line: &DetectedLine) -> Option<PeakEstimate> {
    let level = line.background.mean + line.height / 2.0;
    let mut rows = run(&line.column, line.top, level);
    let usable = |row: usize| {
        let count = line.column.at(row);
        let height = count as f64 - line.background.mean;
        let lit = count < line.max_count && height > line.background.noise;
        lit.then_some((row as f64 - line.top as f64, height))
    };
    let mut pixels: Vec<(f64, f64)> = rows.clone().filter_map(usable).collect();
    // Lines of one or two pixels, or lines with a saturated top.
    while pixels.len() < 3 || rows.len() < 3 {
        let grown = rows.start.saturating_sub(1)..(rows.end + 1).min(line.column.rows());
        if grown == rows || grown.len() > rows.len().max(1) * 4 + 4 {
            return None;
        }
        rows = grown;
        pixels = rows.clone().filter_map(usable).collect();
    }
    let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (x, height) in pixels {
        let powers = Vector3::new(1.0, x, x * x);
        let weight = (height / line.height).powi(2);
        right += powers * (weight * (height / line.height).ln());
        matrix += powers * powers.transpose() * weight;
    }
    let [_, slope, curvature] = solve(matrix, &right)?.into();
    let vertex = -slope / (2.0 * curvature) + line.top as f64 + 0.5;
    let inside = (rows.start as f64..=rows.end as f64).contains(&vertex);
    let variance = -0.5 / curvature - PIXEL_VARIANCE;
    (curvature < 0.0 && inside).then_some(PeakEstimate {
        row: vertex,
        sigma: variance.max(0.0).sqrt(),
    })
}

/// Half length of the derivative filter, in line widths. For a half length of n σ, the noise of the
/// zero crossing of a Gaussian line is proportional to √n/(1 - exp(-n²/2)). The minimum at 2.2 is
/// flat.
pub(super) const FILTER_SIGMAS: f64 = 2.0;

/// Returns the zero crossing of g(i) = Σ_{k=1..n} (c[i+k] - c[i-k]) (Blais & Rioux 1986, extended
/// to any length n).
///
/// The crossing is interpolated linearly between pixels. If speckle causes several crossings, the
/// steepest is used. Counts outside the image are set to the background.
fn derivative_zero(line: &DetectedLine) -> Option<f64> {
    let n = (FILTER_SIGMAS * line.sigma).round().max(1.0) as isize;
    let top = line.top as isize;
    let at = |row: isize| match usize::try_from(row) {
        Ok(row) if row < line.column.rows() => line.column.at(row) as f64 - line.background.mean,
        _ => 0.0,
    };
    let derivative = |row: isize| (1..=n).map(|k| at(row + k) - at(row - k)).sum::<f64>();
    let mut steepest = 0.0;
    let mut crossing = None;
    let mut here = derivative(top - n);
    for row in top - n..top + n {
        let next = derivative(row + 1);
        let slope = here - next;
        if here >= 0.0 && next < 0.0 && slope > steepest {
            steepest = slope;
            crossing = Some(row as f64 + 0.5 + here / slope);
        }
        here = next;
    }
    crossing.filter(|row| (0.0..=line.column.rows() as f64).contains(row))
}
