//! The variance of a running median over correlated errors.

use crate::math::rng::{Key, Purpose};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Variance of the median of a window of Gaussian errors over that of their mean, for lines of each climb.
///
/// There is no closed form for correlated errors on a slope: windows are drawn, always the same ones. Of independent errors on
/// a level line it is 1.35 for 3 columns and tends to π/2; on a steep line the median is the row in the middle.
#[derive(Debug, Clone)]
pub(super) struct MedianVariance {
    /// At [`CLIMBS`].
    over_mean: [f64; CLIMBS.len()],
    long_run: [f64; CLIMBS.len()],
}

/// Rows a column that the line climbs, in standard deviations of a row.
const CLIMBS: [f64; 8] = [0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4];
/// Windows drawn: the ratio of two variances of the same ones is then good to 2 %, the standard deviation to 1 %.
const WINDOWS: usize = 8192;
/// Stretches drawn of which the means of all medians and of all means are compared, and windows in each, in columns of one.
const STRETCHES: usize = 1024;
const LONG: usize = 4;

impl MedianVariance {
    /// For windows of so many columns (odd) under errors of this correlation between columns, from 0 apart on.
    pub fn new(columns: usize, correlation: &[f64]) -> MedianVariance {
        MedianVariance {
            over_mean: ratios(columns, 1, WINDOWS, correlation),
            long_run: ratios(columns, LONG * columns, STRETCHES, correlation),
        }
    }

    /// On a line that climbs so many standard deviations of a row from column to column, between the climbs drawn.
    pub fn over_mean(&self, climb: f64) -> f64 {
        at(climb, &self.over_mean)
    }

    /// The same of the sum over all k of the covariance of medians k columns apart, which says how the mean of many scatters.
    pub fn long_run(&self, climb: f64) -> f64 {
        at(climb, &self.long_run)
    }
}

fn at(climb: f64, values: &[f64; CLIMBS.len()]) -> f64 {
    match CLIMBS.iter().position(|&c| c > climb) {
        Some(after) => {
            let [low, high] = [CLIMBS[after - 1], CLIMBS[after]];
            let share = (climb - low) / (high - low);
            values[after - 1] * (1.0 - share) + values[after] * share
        }
        None => values[CLIMBS.len() - 1],
    }
}

/// Mean square of the mean of so many running medians over that of as many running means, of `draws`, at each climb.
fn ratios(
    columns: usize,
    windows: usize,
    draws: usize,
    correlation: &[f64],
) -> [f64; CLIMBS.len()] {
    let length = columns + windows - 1;
    let rho = |i: usize, j: usize| correlation.get(i.abs_diff(j)).copied().unwrap_or(0.0);
    // What is cut off beyond the last correlation may leave it not quite positive.
    let root = (0..).find_map(|k| {
        let more = 1e-6 * 4f64.powi(k);
        let of = |i: usize, j: usize| rho(i, j) + if i == j { more } else { 0.0 };
        DMatrix::from_fn(length, length, of)
            .cholesky()
            .map(|c| c.l())
    });
    let root = root.expect("a diagonal that outweighs all else is positive");
    let key = Key::new(0, Purpose::Median).with(windows as u64);
    let squares = (0..draws).into_par_iter().map(|draw| {
        let mut stream = key.with(draw as u64).stream();
        let white = DVector::from_fn(length, |_, _| StandardNormal.sample(&mut stream));
        let errors = &root * white;
        let mut values = vec![0.0; columns];
        let mut squares = [0.0; CLIMBS.len() + 1];
        for (climb, square) in CLIMBS.iter().zip(&mut squares) {
            let median = |window: &[f64]| {
                for (i, (value, error)) in values.iter_mut().zip(window).enumerate() {
                    *value = error + (i as f64 - (columns / 2) as f64) * climb;
                }
                *values.select_nth_unstable_by(columns / 2, f64::total_cmp).1
            };
            let sum: f64 = errors.as_slice().windows(columns).map(median).sum();
            *square = sum * sum;
        }
        let means = errors.as_slice().windows(columns);
        let sum: f64 = means.map(|w| w.iter().sum::<f64>() / columns as f64).sum();
        squares[CLIMBS.len()] = sum * sum;
        squares
    });
    // Summed in the order of draws, whatever the threads.
    let squares: Vec<_> = squares.collect();
    let total = |i: usize| squares.iter().map(|s| s[i]).sum::<f64>();
    std::array::from_fn(|i| total(i) / total(CLIMBS.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Var(median)/Var(mean) of 3, 5 and 9 independent Gaussians: 3·0.44867, 5·0.28683, 9·0.16610 (Sarhan and Greenberg 1962,
    /// tables of order statistics). Drawn to 2 %, four of its standard errors.
    #[test]
    fn it_is_that_of_order_statistics() {
        for (columns, known) in [(3, 1.3460), (5, 1.4342), (9, 1.4949)] {
            let found = MedianVariance::new(columns, &[1.0]);
            let ratio = found.over_mean(0.0);
            assert!((ratio / known - 1.0).abs() < 0.04, "{columns}: {ratio}");
            // On a steep line it is one row: n times the mean's variance.
            let steep = found.over_mean(100.0) / columns as f64;
            assert!((steep - 1.0).abs() < 0.06, "{columns}: {steep}");
        }
    }
}
