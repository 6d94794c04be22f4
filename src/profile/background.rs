//! The background of a column, and what stands out from it.

/// Peaks expected per frame in which no light falls on the sensor.
pub const FALSE_PEAKS_PER_FRAME: f64 = 1e-3;

/// Standard deviation of rounding to whole counts.
const ROUNDING: f64 = 0.288_675_134_594_812_9;

/// What a column holds without its line, counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Background {
    pub mean: f64,
    pub noise: f64,
    /// Height above the mean from which on a pixel is no noise.
    pub threshold: f64,
}

/// Standard deviations that normal noise passes [`FALSE_PEAKS_PER_FRAME`] times in
/// a frame of `pixels`: 6.0 for 1280 × 512.
pub(super) fn detection_sigmas(pixels: usize) -> f64 {
    let chance = FALSE_PEAKS_PER_FRAME / pixels as f64;
    let exceeds = |z: f64| 0.5 * libm::erfc(z / std::f64::consts::SQRT_2);
    let (mut low, mut high) = (0.0, 40.0);
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        if exceeds(middle) > chance {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// The same quantile `z` where the deviation is itself estimated with `freedom`
/// degrees of freedom: Student's t, by the first two terms of Fisher & Cornish
/// (1960).
fn students_quantile(z: f64, freedom: f64) -> f64 {
    let first = (z.powi(3) + z) / 4.0;
    let second = (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0;
    z + first / freedom + second / (freedom * freedom)
}

/// Background of the column, whose greatest count is `highest`: from the median
/// and its absolute deviation (×1.4826 for normal noise, and one count for what
/// rounding hides), what lies further than four deviations off is left out, again
/// and again until nothing changes. The threshold is [`students_quantile`] of `z`.
pub(super) fn background(
    column: &[u16],
    highest: u16,
    z: f64,
    scratch: &mut Vec<u16>,
) -> Background {
    scratch.clear();
    scratch.extend_from_slice(column);
    let middle = scratch.len() / 2;
    let median = *scratch.select_nth_unstable(middle).1;
    scratch.iter_mut().for_each(|c| *c = c.abs_diff(median));
    let deviation = *scratch.select_nth_unstable(middle).1;
    let (mut mean, mut sigma) = (median as f64, 1.4826 * deviation as f64 + 1.0);
    let mut kept = 0;
    // Each round ends with other counts kept or is the last; ten are plenty.
    for _ in 0..10 {
        // Casts saturate.
        let low = (mean - 4.0 * sigma).ceil() as u16;
        let high = ((mean + 4.0 * sigma).floor() as u16).min(highest);
        let (n, sum, squares) = moments(column, low, high);
        if n == kept || n == 0 {
            break;
        }
        kept = n;
        mean = sum as f64 / n as f64;
        sigma = (squares as f64 / n as f64 - mean * mean).max(0.0).sqrt();
    }
    let mut freedom = column.len() as f64;
    if sigma > 0.0 && mean < 3.0 * sigma {
        sigma = sigma.max(upper_deviation(column, median, sigma));
        freedom /= ONE_SIDED_VARIANCE;
    }
    let noise = sigma.max(ROUNDING);
    Background {
        mean,
        noise,
        threshold: students_quantile(z, freedom) * noise,
    }
}

/// Variance of a variance that is estimated from one half of normal noise over
/// that from both: 5σ⁴ against 2σ⁴.
const ONE_SIDED_VARIANCE: f64 = 2.5;

/// Standard deviation by the counts above the median alone, half of all: where the
/// black level lies in the noise, the sensor cuts the lower half off, and the
/// deviation from the mean, `sigma`, is too small by up to 1.7.
fn upper_deviation(column: &[u16], median: u16, mut sigma: f64) -> f64 {
    sigma *= 1.7;
    for _ in 0..3 {
        let high = (median as f64 + 4.0 * sigma) as u16;
        let (mut n, mut squares) = (0u64, 0u64);
        for &count in column.iter().filter(|&&count| count <= high) {
            n += 1;
            squares += (count.saturating_sub(median) as u64).pow(2);
        }
        sigma = (2.0 * squares as f64 / n as f64).sqrt();
    }
    sigma
}

/// Number, sum and sum of squares of the counts from `low` to `high`.
fn moments(column: &[u16], low: u16, high: u16) -> (u64, u64, u64) {
    // Runs so short that 32 bits hold their sums: then and without branches the
    // loop is vectorised.
    let largest = (high as u32).max(1);
    let run = (u32::MAX / (largest * largest)).min(256) as usize;
    let (mut n, mut sum, mut squares) = (0u64, 0u64, 0u64);
    for run in column.chunks(run) {
        let mut of_run = (0u32, 0u32, 0u32);
        for &count in run {
            let inside = (low <= count) & (count <= high);
            let count = if inside { count as u32 } else { 0 };
            of_run.0 += inside as u32;
            of_run.1 += count;
            of_run.2 += count * count;
        }
        n += of_run.0 as u64;
        sum += of_run.1 as u64;
        squares += of_run.2 as u64;
    }
    (n, sum, squares)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};
    use rand_distr::{Distribution, Normal};

    /// ½·erfc(6/√2) = 9.866e-10.
    #[test]
    fn the_threshold_is_the_quantile() {
        let pixels = (FALSE_PEAKS_PER_FRAME / 9.866e-10) as usize;
        assert!((detection_sigmas(pixels) - 6.0).abs() < 1e-3);
        // One-sided 0.0005 of Student's t with 30 degrees of freedom, by tables;
        // the third term is 0.01.
        assert!((students_quantile(3.2905, 30.0) - 3.646).abs() < 0.02);
    }

    /// Noise of 3 counts on a black level amid the range, and cut at zero: the
    /// estimate has standard error 3/√(2·n) two-sided and √2.5 times as much from
    /// one half (fourth moment 3σ⁴ over a half: variance of 2x² over one half is
    /// 5σ⁴, of x² 2σ⁴), plus what lies beyond four sigmas, 0.05 %. Bounds: 5
    /// standard errors of 100 columns of 500 pixels, false alarm under 1e-6, and
    /// the bias of the cut at the median, which rounding moves by up to half a
    /// count: (½/3)² of the deviation and the trimming at 4 sigmas of a narrower
    /// noise: 3 %.
    #[test]
    fn noise_is_measured_also_where_the_black_level_cuts_it() {
        let normal = Normal::new(0.0, 3.0).unwrap();
        for (black, bias) in [(100.0_f64, 0.001), (0.0, 0.03)] {
            let mut sum = 0.0;
            for column in 0..100 {
                let mut stream = Key::new(1, Purpose::SensorNoise).with(column).stream();
                let counts: Vec<u16> = (0..500)
                    .map(|_| (black + normal.sample(&mut stream)).max(0.0).round() as u16)
                    .collect();
                let highest = *counts.iter().max().unwrap();
                sum += background(&counts, highest, 6.0, &mut Vec::new()).noise / 100.0;
            }
            let truth = (9.0f64 + 1.0 / 12.0).sqrt();
            let bound = bias + 5.0 * (2.5f64 / (2.0 * 50_000.0)).sqrt();
            assert!((sum / truth - 1.0).abs() < bound, "{black}: {sum}");
        }
    }
}
