//! Variances of a running median over correlated errors.

use crate::math::rng::{Key, Purpose, Stream};
use nalgebra::{DMatrix, DVector};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Variances of a running median of Gaussian errors over the variances of a running mean, for lines of each climb.
///
/// There is no closed form for correlated errors on a slope: windows are sampled, from a fixed seed. For independent
/// errors on a level line the ratio is 1.35 for 3 columns and tends to π/2. On a steep line the median is the central row.
/// Noise has a ratio of its own: where speckle decides which row is the median, the median has the noise of that row.
#[derive(Debug, Clone)]
pub(super) struct MedianVariance {
    /// At [`SHARES`] and [`CLIMBS`].
    over_mean: [Ratios; SHARES.len()],
    /// At [`CLIMBS`], of the typical share.
    long_run: [f64; CLIMBS.len()],
}

/// Variances of medians over those of means, at [`CLIMBS`].
#[derive(Debug, Clone, Copy)]
struct Ratios {
    all: [f64; CLIMBS.len()],
    noise: [f64; CLIMBS.len()],
}

/// Fractions of a row's variance that are noise, which differs in each image. The first represents no noise.
const SHARES: [f64; 7] = [1e-4, 0.01, 0.04, 0.1, 0.3, 0.6, 1.0];
/// Rows a column that the line climbs, in standard deviations of a row.
const CLIMBS: [f64; 8] = [0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4];
/// Windows drawn: the ratio of two variances of the same windows is then good to 2 %, the standard deviation to 1 %.
const WINDOWS: usize = 8192;
/// Stretches drawn of which the means of all medians and of all means are compared, and windows in each, in columns of one.
const STRETCHES: usize = 1024;
const LONG: usize = 4;

impl MedianVariance {
    /// Samples windows of `columns`, an odd number, under speckle with this correlation between columns, lag 0 first.
    /// `noise_share` is the typical fraction of a row's variance that is noise.
    pub fn new(columns: usize, correlation: &[f64], noise_share: f64) -> MedianVariance {
        let mut mixed: Vec<f64> = correlation
            .iter()
            .map(|c| c * (1.0 - noise_share))
            .collect();
        mixed[0] = 1.0;
        MedianVariance {
            over_mean: ratios(columns, correlation),
            long_run: long_run(columns, &mixed),
        }
    }

    /// Returns the ratios of the total variance and of the noise.
    ///
    /// `climb` is the slope of the line in standard deviations of a row per column, `noise_share` the fraction of a row's
    /// variance that is noise. Values between the sampled ones are interpolated.
    pub fn over_mean(&self, climb: f64, noise_share: f64) -> [f64; 2] {
        let [all, noise] = [
            self.over_mean.map(|r| at(climb, &CLIMBS, &r.all)),
            self.over_mean.map(|r| at(climb, &CLIMBS, &r.noise)),
        ];
        // Rows that noise reorders are as frequent as noise is wide, the root of its variance.
        let roots = SHARES.map(f64::sqrt);
        [all, noise].map(|values| at(noise_share.sqrt(), &roots, &values))
    }

    /// Returns the ratio of the sums of covariances over all lags, which determine the variance of long means.
    pub fn long_run(&self, climb: f64) -> f64 {
        at(climb, &CLIMBS, &self.long_run)
    }
}

/// Linear between `nodes`, constant beyond.
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
    // What is cut off beyond the last correlation may leave it not quite positive.
    let root = (0..).find_map(|k| {
        let more = 1e-6 * 4f64.powi(k);
        let of = |i: usize, j: usize| rho(i, j) + if i == j { more } else { 0.0 };
        DMatrix::from_fn(length, length, of)
            .cholesky()
            .map(|c| c.l())
    });
    root.expect("a diagonal that outweighs all else is positive")
}

fn white(length: usize, stream: &mut Stream) -> DVector<f64> {
    DVector::from_fn(length, |_, _| StandardNormal.sample(stream))
}

/// The median of a window on a line of this climb; `values` is room for it.
fn median(window: impl Iterator<Item = f64>, climb: f64, values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    for (i, (value, error)) in values.iter_mut().zip(window).enumerate() {
        *value = error + (i as f64 - middle as f64) * climb;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Sums over draws.
type Squares = [[f64; 2]; CLIMBS.len() + 1];

/// Samples each window twice with one speckle: half the mean square of the difference of the medians is their noise.
fn ratios(columns: usize, correlation: &[f64]) -> [Ratios; SHARES.len()] {
    let root = root(columns, correlation);
    let key = Key::new(0, Purpose::Median).with(1);
    let draws = (0..WINDOWS).into_par_iter().map(|draw| {
        let mut stream = key.with(draw as u64).stream();
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
    // Summed in the order of draws, whatever the threads.
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

/// Returns the mean square of the mean of `LONG·columns` running medians, over the mean square of the running means' mean.
fn long_run(columns: usize, correlation: &[f64]) -> [f64; CLIMBS.len()] {
    let length = columns + LONG * columns - 1;
    let root = root(length, correlation);
    let key = Key::new(0, Purpose::Median).with((LONG * columns) as u64);
    let squares = (0..STRETCHES).into_par_iter().map(|draw| {
        let errors = &root * white(length, &mut key.with(draw as u64).stream());
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

    /// Var(median)/Var(mean) of 3, 5 and 9 independent Gaussians: 3·0.44867, 5·0.28683, 9·0.16610 (Sarhan and Greenberg 1962,
    /// tables of order statistics). Drawn to 2 %, four of its standard errors.
    #[test]
    fn it_is_that_of_order_statistics() {
        for (columns, known) in [(3, 1.3460), (5, 1.4342), (9, 1.4949)] {
            let found = MedianVariance::new(columns, &[1.0], 1.0);
            let [ratio, noise] = found.over_mean(0.0, 1.0);
            assert!((ratio / known - 1.0).abs() < 0.04, "{columns}: {ratio}");
            assert!((noise / known - 1.0).abs() < 0.06, "{columns}: {noise}");
            // On a steep line it is one row: n times the mean's variance.
            let steep = found.over_mean(100.0, 0.5).map(|r| r / columns as f64);
            assert!(
                steep.iter().all(|r| (r - 1.0).abs() < 0.06),
                "{columns}: {steep:?}"
            );
        }
    }

    /// Where the order of the rows is decided by speckle, the median has the noise of one row, n times the noise of the mean.
    /// The ratio of total variances is 1.49. Noise of a hundredth of the speckle reorders the central rows of nine, which lie
    /// 0.3 of the speckle apart, in some 10 % of windows; their noise is then halved, which takes 5 %.
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
