//! Scatter and correlation of heights in the flat areas of a height map.

use super::sampled::{SampledStatistics, Statistic, median};
use crate::inspect::HeightMap;
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Columns and profiles of a patch.
pub const SIDE: usize = 48;
/// Smallest fraction of a patch with heights.
const LEAST_VALID: f64 = 0.98;
/// Fewest patches from which statistics are computed: one in the flattest quarter.
const MIN_PATCHES: usize = 4;

const NOISE: &str = "noise of a height (laser power, exposure, gain, speckle contrast), topography";
const ALONG: &str = "grain of the speckle, filters along the profile, resampling, topography";

/// Statistics of the flattest quarter of the patches.
pub const STATISTICS: [Statistic; 5] = [
    Statistic {
        name: "scatter_um",
        terms: NOISE,
    },
    Statistic {
        name: "scatter_along_profile_um",
        terms: NOISE,
    },
    Statistic {
        name: "correlation_of_adjacent_columns",
        terms: ALONG,
    },
    Statistic {
        name: "correlation_two_columns_apart",
        terms: ALONG,
    },
    Statistic {
        name: "correlation_of_adjacent_profiles",
        terms: "topography, speckle that repeats between frames, averaged frames",
    },
];

/// Values of all statistics, in the order of [`STATISTICS`].
pub type StatisticValues = [f64; STATISTICS.len()];

/// Square area of a height map.
struct Patch {
    /// Indices of the disjoint block that contains the first point.
    block: [usize; 2],
    values: StatisticValues,
}

/// Computes the medians over the flattest quarter of the patches with heights in at least 98 % of
/// their area. Neighbouring patches overlap by half. `seed` selects the bootstrap samples.
///
/// # Errors
/// Returns the number of usable patches if there are fewer than four.
pub fn patch_statistics(map: &HeightMap, seed: u64) -> Result<SampledStatistics, usize> {
    let starts = |size: usize| (0..(size + 1).saturating_sub(SIDE)).step_by(SIDE / 2);
    let patches: Vec<Patch> = starts(map.rows)
        .flat_map(|row| starts(map.columns).map(move |column| (row, column)))
        .filter_map(|(row, column)| Patch::of(map, row, column))
        .collect();
    let count = patches.len();
    if count < MIN_PATCHES {
        return Err(count);
    }
    let mut blocks: BTreeMap<[usize; 2], Vec<Patch>> = BTreeMap::new();
    for patch in patches {
        blocks.entry(patch.block).or_default().push(patch);
    }
    let blocks: Vec<Vec<Patch>> = blocks.into_values().collect();
    Ok(SampledStatistics::of(&blocks, count, seed, |blocks| {
        medians(blocks.iter().flat_map(|block| block.iter()).collect())
    }))
}

/// Returns the medians over the quarter of the patches with the smallest scatter.
fn medians(mut patches: Vec<&Patch>) -> Vec<f64> {
    patches.sort_by(|a, b| a.values[0].total_cmp(&b.values[0]));
    patches.truncate((patches.len() / 4).max(1));
    (0..STATISTICS.len())
        .map(|i| median(patches.iter().map(|patch| patch.values[i]).collect()))
        .collect()
}

impl Patch {
    /// Returns the statistics of the patch at a point, if it has enough heights.
    fn of(map: &HeightMap, row: usize, column: usize) -> Option<Patch> {
        let values = FlatArea::of(map, row, column)?.values();
        values
            .iter()
            .all(|value| value.is_finite())
            .then_some(Patch {
                block: [row / SIDE, column / SIDE],
                values,
            })
    }
}

/// Deviations of the heights of a square area of [`SIDE`] columns and profiles.
pub(super) struct FlatArea {
    /// Root mean square deviation from the plane that fits the area, mm.
    pub scatter: f64,
    /// Deviations from the parabola that fits each profile, profile by profile, mm; NaN for missing
    /// heights.
    pub along: Vec<f64>,
}

impl FlatArea {
    /// Returns the deviations in the area at a point, if it has enough heights.
    pub fn of(map: &HeightMap, row: usize, column: usize) -> Option<FlatArea> {
        let at = |y: usize, x: usize| map.heights[(row + y) * map.columns + column + x];
        let grid = || (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (y, x)));
        let valid: Vec<(usize, usize)> = grid().filter(|&(y, x)| at(y, x).is_finite()).collect();
        if (valid.len() as f64) < LEAST_VALID * (SIDE * SIDE) as f64 {
            return None;
        }
        let unit = |i: usize| i as f64 / SIDE as f64 - 0.5;
        let plane = |&(y, x): &(usize, usize)| [1.0, unit(x), unit(y)];
        let rest = residuals(&valid, plane, |&(y, x)| at(y, x))?;
        let scatter = mean_square(&rest).sqrt();
        let mut along = vec![f64::NAN; SIDE * SIDE];
        for profile in valid.chunk_by(|a, b| a.0 == b.0) {
            let parabola = |&(_, x): &(usize, usize)| [1.0, unit(x), unit(x) * unit(x)];
            if let Some(rest) = residuals(profile, parabola, |&(y, x)| at(y, x)) {
                for (&(y, x), value) in profile.iter().zip(rest) {
                    along[y * SIDE + x] = value;
                }
            }
        }
        Some(FlatArea { scatter, along })
    }

    /// Returns the statistics of the area.
    pub fn values(&self) -> StatisticValues {
        let along = &self.along;
        let grid = || (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (y, x)));
        let mean_square = mean_square(along);
        let correlation = |columns: usize, profiles: usize| {
            let pairs = grid().filter(|&(y, x)| y + profiles < SIDE && x + columns < SIDE);
            let product = |(y, x)| along[y * SIDE + x] * along[(y + profiles) * SIDE + x + columns];
            let products: Vec<f64> = pairs.map(product).filter(|v| v.is_finite()).collect();
            products.iter().sum::<f64>() / products.len() as f64 / mean_square
        };
        [
            1e3 * self.scatter,
            1e3 * mean_square.sqrt(),
            correlation(1, 0),
            correlation(2, 0),
            correlation(0, 1),
        ]
    }
}

/// Returns the residuals of a least-squares fit of three functions. Returns `None` if the points do
/// not determine them.
pub(super) fn residuals<P>(
    points: &[P],
    functions: impl Fn(&P) -> [f64; 3],
    value: impl Fn(&P) -> f64,
) -> Option<Vec<f64>> {
    let rows: Vec<[f64; 3]> = points.iter().map(functions).collect();
    let design = DMatrix::from_fn(points.len(), 3, |i, j| rows[i][j]);
    let values = DVector::from_iterator(points.len(), points.iter().map(value));
    let normal = (design.transpose() * &design).cholesky()?;
    let fit = normal.solve(&(design.transpose() * &values));
    Some((values - design * fit).iter().copied().collect())
}

/// Returns the mean square of the finite values.
fn mean_square(values: &[f64]) -> f64 {
    let squares = (values.iter().filter(|value| value.is_finite())).map(|value| value * value);
    squares.clone().sum::<f64>() / squares.count() as f64
}
