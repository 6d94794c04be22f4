//! Statistics of recordings, with bootstrap samples for their intervals.

use crate::math::rng::{Purpose, RngKey};
use rayon::prelude::*;

/// Number of bootstrap samples.
const DRAWS: usize = 2000;

/// Name of a statistic and the terms of the model that determine it.
#[derive(Debug)]
pub struct Statistic {
    /// Name with unit.
    pub name: &'static str,
    /// Terms of sensor and surface on which the statistic depends.
    pub terms: &'static str,
}

/// Values of statistics, and their values in bootstrap samples of independent blocks of the data.
#[derive(Debug, Clone)]
pub struct SampledStatistics {
    /// Number of areas, profiles or columns that were evaluated.
    pub evaluated: usize,
    /// Values in the order of the statistics.
    pub values: Vec<f64>,
    samples: Vec<Vec<f64>>,
}

impl SampledStatistics {
    /// Computes the statistics of blocks. `values` returns them for a selection of blocks. `seed`
    /// selects the bootstrap samples.
    pub(super) fn of<B: Sync>(
        blocks: &[B],
        evaluated: usize,
        seed: u64,
        values: impl Fn(&[&B]) -> Vec<f64> + Sync,
    ) -> SampledStatistics {
        let key = RngKey::new(seed, Purpose::Bootstrap);
        let sample = |draw: usize| {
            let key = key.with(draw as u64);
            let index = |i: usize| (key.uniform(i as u64) * blocks.len() as f64) as usize;
            let drawn: Vec<&B> = (0..blocks.len()).map(|i| &blocks[index(i)]).collect();
            values(&drawn)
        };
        SampledStatistics {
            evaluated,
            values: values(&blocks.iter().collect::<Vec<&B>>()),
            samples: (0..DRAWS).into_par_iter().map(sample).collect(),
        }
    }

    /// Returns the interval of a statistic that excludes the fraction `beyond` of the bootstrap
    /// samples on both sides together.
    pub fn interval(&self, statistic: usize, beyond: f64) -> [f64; 2] {
        quantiles(self.samples.iter().map(|values| values[statistic]), beyond)
    }

    /// Returns the interval of the difference `other` − `self` of a statistic.
    pub fn difference(&self, other: &SampledStatistics, statistic: usize, beyond: f64) -> [f64; 2] {
        let pairs = self.samples.iter().zip(&other.samples);
        quantiles(pairs.map(|(a, b)| b[statistic] - a[statistic]), beyond)
    }
}

/// Returns the quantiles of the finite values; 0 if there are none.
fn quantiles(values: impl Iterator<Item = f64>, beyond: f64) -> [f64; 2] {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1) as f64;
    [beyond / 2.0, 1.0 - beyond / 2.0].map(|at| {
        let index = (at * last).round() as usize;
        sorted.get(index).copied().unwrap_or(0.0)
    })
}

/// Returns the median; NaN for no values.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.is_empty() {
        true => f64::NAN,
        false => crate::math::median_of_sorted(values.into_iter()),
    }
}
