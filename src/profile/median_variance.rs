//! Variance of a moving median of correlated errors.

use crate::math::rng::{KeyStream, Purpose, RngKey};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Variance ratio of a moving median to a moving average of Gaussian errors, for lines of different
/// slopes.
///
/// Correlated errors on a slope have no closed form. Windows are simulated with a fixed seed. For
/// independent errors on a level line, the ratio is 1.35 for 3 columns and tends to π/2. On a steep
/// line, the median is the central row. Noise has a separate ratio: if speckle decides which row is
/// the median, the median has the noise of that row.
#[derive(Debug, Clone)]
pub(super) struct MedianVariance {
    /// Ratios at [`SHARES`] and [`CLIMBS`].
    over_mean: [Ratios; SHARES.len()],
    /// Ratios of the long-run variances at [`CLIMBS`], for the typical noise fraction.
    long_run_variance_ratio: [f64; CLIMBS.len()],
}

/// Ratios of the variances of medians to the variances of means, at [`CLIMBS`].
#[derive(Debug, Clone, Copy)]
struct Ratios {
    all: [f64; CLIMBS.len()],
    noise: [f64; CLIMBS.len()],
}

/// Fractions of the variance of a row that are noise, which differs in each image. The first
/// represents no noise.
const SHARES: [f64; 7] = [1e-4, 0.01, 0.04, 0.1, 0.3, 0.6, 1.0];
/// Slopes of the line in rows per column, in standard deviations of a row.
const CLIMBS: [f64; 8] = [0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4];
/// Number of simulated windows. The ratio of two variances from common windows is accurate to 2 %,
/// the standard deviation to 1 %.
const WINDOWS: usize = 8192;
/// Number of simulated profiles for the long-run variance, and length of each in window lengths.
const STRETCHES: usize = 1024;
const LONG: usize = 4;

impl MedianVariance {
    /// Simulates windows of `columns`, an odd number, for speckle with the given correlation
    /// between columns (lag 0 first). `noise_share` is the typical fraction of the variance of a
    /// row that is noise.
    pub fn new(columns: usize, correlation: &[f64], noise_share: f64) -> MedianVariance {
        let mut mixed: Vec<f64> = correlation
            .iter()
            .map(|c| c * (1.0 - noise_share))
            .collect();
        mixed[0] = 1.0;
        MedianVariance {
            over_mean: ratios(columns, correlation),
            long_run_variance_ratio: long_run_variance_ratio(columns, &mixed),
        }
    }

    /// Returns the ratios of the total variance and of the noise variance.
    ///
    /// `climb` is the slope of the line in standard deviations of a row per column. `noise_share`
    /// is the fraction of the variance of a row that is noise. Values between the simulated ones
    /// are interpolated.
    pub fn over_mean(&self, climb: f64, noise_share: f64) -> [f64; 2] {
        let [all, noise] = [
            self.over_mean.map(|r| at(climb, &CLIMBS, &r.all)),
            self.over_mean.map(|r| at(climb, &CLIMBS, &r.noise)),
        ];
        // The number of rows reordered by noise is proportional to the standard deviation of the
        // noise.
        let roots = SHARES.map(f64::sqrt);
        [all, noise].map(|values| at(noise_share.sqrt(), &roots, &values))
    }

    /// Returns the ratio of the sums of covariances over all lags, which determine the variance of
    /// long means.
    pub fn long_run_variance_ratio(&self, climb: f64) -> f64 {
        at(climb, &CLIMBS, &self.long_run_variance_ratio)
    }
}

/// Interpolates linearly between `nodes`, with constant extrapolation.
fn at<const N: usize>(x: f64, nodes: &[f64; N], values: &[f64; N]) -> f64 {
    match nodes.iter().position(|&node| node > x) {
        Some(0) => values[0],
        Some(after) => {
            let [low, high] = [nodes[after - 1], nodes[after]];
            let share = (x - low) / (high - low);
            values[after - 1] * (1.0 - share) + values[after] * share
        }
        None => values[N - 1],
    }
}

/// Returns the lower triangular root of the correlation matrix of `length` rows.
fn root(length: usize, correlation: &[f64]) -> DMatrix<f64> {
    let rho = |i: usize, j: usize| correlation.get(i.abs_diff(j)).copied().unwrap_or(0.0);
    // Truncation of the correlation may make the matrix indefinite.
    let root = (0..).find_map(|k| {
        let more = 1e-6 * 4f64.powi(k);
        let of = |i: usize, j: usize| rho(i, j) + if i == j { more } else { 0.0 };
        DMatrix::from_fn(length, length, of)
            .cholesky()
            .map(|c| c.l())
    });
    root.expect("a diagonal that outweighs all else is positive")
}

fn white(length: usize, stream: &mut KeyStream) -> DVector<f64> {
    DVector::from_fn(length, |_, _| StandardNormal.sample(stream))
}

/// Returns the median of a window on a line of slope `climb`; `values` is a scratch buffer.
fn median(window: impl Iterator<Item = f64>, climb: f64, values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    for (i, (value, error)) in values.iter_mut().zip(window).enumerate() {
        *value = error + (i as f64 - middle as f64) * climb;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Mean squares for each slope, and for the mean.
type Squares = [[f64; 2]; CLIMBS.len() + 1];

/// Simulates each window twice with common speckle. Half the mean square difference of the two
/// medians is the noise variance.
fn ratios(columns: usize, correlation: &[f64]) -> [Ratios; SHARES.len()] {
    let root = root(columns, correlation);
    let key = RngKey::new(0, Purpose::Median).with(1);
    let draws = (0..WINDOWS).into_par_iter().map(|draw| {
        let mut stream = key.with(draw as u64).counter_stream();
        let speckle = &root * white(columns, &mut stream);
        let noise = [(); 2].map(|()| white(columns, &mut stream));
        let mut values = vec![0.0; columns];
        SHARES.map(|share| {
            let errors = |i: usize| {
                let parts = speckle.iter().zip(&noise[i]);
                parts.map(move |(s, n)| (1.0 - share).sqrt() * s + share.sqrt() * n)
            };
            let square = |[a, b]: [f64; 2]| [(a * a + b * b) / 2.0, (a - b).powi(2) / 2.0];
            let mut squares: Squares = [[0.0; 2]; CLIMBS.len() + 1];
            for (climb, sum) in CLIMBS.iter().zip(&mut squares) {
                *sum = square([0, 1].map(|i| median(errors(i), *climb, &mut values)));
            }
            let mean = |i: usize| errors(i).sum::<f64>() / columns as f64;
            squares[CLIMBS.len()] = square([mean(0), mean(1)]);
            squares
        })
    });
    // Sums are in the order of samples, independent of the number of threads.
    let draws: Vec<[Squares; SHARES.len()]> = draws.collect();
    std::array::from_fn(|share| {
        let total = |i: usize, of: usize| draws.iter().map(|d| d[share][i][of]).sum::<f64>();
        let ratios = |of: usize| std::array::from_fn(|i| total(i, of) / total(CLIMBS.len(), of));
        Ratios {
            all: ratios(0),
            noise: ratios(1),
        }
    })
}

/// Returns the variance of the mean of `LONG·columns` moving medians, relative to the variance for
/// moving averages.
fn long_run_variance_ratio(columns: usize, correlation: &[f64]) -> [f64; CLIMBS.len()] {
    let length = columns + LONG * columns - 1;
    let root = root(length, correlation);
    let key = RngKey::new(0, Purpose::Median).with((LONG * columns) as u64);
    let squares = (0..STRETCHES).into_par_iter().map(|draw| {
        let errors = &root * white(length, &mut key.with(draw as u64).counter_stream());
        let mut values = vec![0.0; columns];
        let mut squares = [0.0; CLIMBS.len() + 1];
        for (climb, square) in CLIMBS.iter().zip(&mut squares) {
            let windows = errors.as_slice().windows(columns);
            let sum: f64 = windows
                .map(|window| median(window.iter().copied(), *climb, &mut values))
                .sum();
            *square = sum * sum;
        }
        let means = errors.as_slice().windows(columns);
        let sum: f64 = means.map(|w| w.iter().sum::<f64>() / columns as f64).sum();
        squares[CLIMBS.len()] = sum * sum;
        squares
    });
    let squares: Vec<_> = squares.collect();
    let total = |i: usize| squares.iter().map(|s| s[i]).sum::<f64>();
    std::array::from_fn(|i| total(i) / total(CLIMBS.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The ratio Var(median)/Var(mean) of 3, 5 and 9 independent Gaussians agrees with tables of
    /// order statistics (Sarhan and Greenberg 1962): 3·0.44867, 5·0.28683, 9·0.16610. The tolerance
    /// of 4 % is four standard errors.
    #[test]
    fn it_is_that_of_order_statistics() {
        for (columns, known) in [(3, 1.3460), (5, 1.4342), (9, 1.4949)] {
            let found = MedianVariance::new(columns, &[1.0], 1.0);
            let [ratio, noise] = found.over_mean(0.0, 1.0);
            assert!((ratio / known - 1.0).abs() < 0.04, "{columns}: {ratio}");
            assert!((noise / known - 1.0).abs() < 0.06, "{columns}: {noise}");
            // On a steep line, the median is one row, with n times the variance of the mean.
            let steep = found.over_mean(100.0, 0.5).map(|r| r / columns as f64);
            assert!(
                steep.iter().all(|r| (r - 1.0).abs() < 0.06),
                "{columns}: {steep:?}"
            );
        }
    }

    /// If speckle decides the order of the rows, the median has the noise of one row, n times the
    /// noise of the mean.
    ///
    /// The ratio of total variances is 1.49. The central rows of nine differ by 0.3 of the speckle.
    /// Noise of a hundredth of the speckle changes their order in about 10 % of the windows. The
    /// noise is then halved, which reduces the mean by 5 %.
    #[test]
    fn a_median_that_speckle_chooses_has_the_noise_of_one_row() {
        for columns in [3, 5, 9] {
            let found = MedianVariance::new(columns, &[1.0], 1e-4);
            for climb in [0.0, 0.5, 4.0] {
                let [_, noise] = found.over_mean(climb, 1e-4);
                let of_one = noise / columns as f64;
                assert!((of_one - 1.0).abs() < 0.1, "{columns}, {climb}: {of_one}");
            }
        }
    }
}
