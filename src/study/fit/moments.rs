//! Covariances of heights in the flat areas of a height map.

use crate::inspect::HeightMap;
use crate::math::median_of_sorted;
use crate::study::patches::{FlatArea, SIDE, StatisticValues};
use nalgebra::DMatrix;
use std::collections::BTreeMap;

/// Number of lags along a profile and between profiles.
pub const LAGS: [usize; 2] = [8, 6];
/// Number of covariances.
pub const COUNT: usize = LAGS[0] * LAGS[1];
/// Ratio of the scatter of the roughest and the flattest areas of a surface that is flat
/// everywhere. The scatter of an area with ten independent heights varies by less than this.
const ONE_SURFACE: f64 = 2.0;

/// Covariances at the lags of [`LAGS`], µm²; the lag along the profile varies fastest.
pub type Moments = [f64; COUNT];

/// Returns the position of a lag in [`Moments`].
pub const fn index(columns: usize, profiles: usize) -> usize {
    profiles * LAGS[0] + columns
}

/// Smallest number of blocks of a half that are not divided. The scatter of fewer blocks does not
/// determine intervals.
const MIN_UNDIVIDED_BLOCKS: usize = 8;

/// Mean covariances of the flat areas in a block of [`SIDE`] columns and [`SIDE`] profiles, or half
/// as many profiles.
#[derive(Debug, Clone)]
pub struct Block {
    pub moments: Moments,
    /// Mean square deviation of the area from its plane minus that from the parabolas, µm².
    pub slow: f64,
}

/// Flat area of a map.
pub struct Area {
    /// Indices of the block of profiles and of columns that contain the first point.
    at: [usize; 2],
    /// Whether the area extends into the next block.
    overlaps: bool,
    /// Statistics of the area.
    pub values: StatisticValues,
    /// Covariances of the first and the second half of the profiles.
    parts: [Moments; 2],
    /// See [`Block::slow`].
    slow: f64,
}

impl Area {
    fn scale(&mut self, by: f64) {
        self.parts
            .iter_mut()
            .flatten()
            .for_each(|moment| *moment *= by);
        self.slow *= by;
    }
}

/// Returns the flat areas of a map: those with enough heights or, if they differ in scatter by more
/// than twofold, the flattest quarter.
pub fn flat_areas(map: &HeightMap) -> Vec<Area> {
    let columns = (0..(map.columns + 1).saturating_sub(SIDE)).step_by(SIDE / 2);
    let starts = (0..map.rows / SIDE).flat_map(|row| columns.clone().map(move |x| (row, x)));
    let mut areas: Vec<Area> = starts
        .filter_map(|(row, column)| {
            let area = FlatArea::of(map, row * SIDE, column)?;
            let (first, second) = area.along.split_at(SIDE * SIDE / 2);
            let parts = [first, second].map(moments);
            let values = area.values();
            let slow = values[0].powi(2) - values[1].powi(2);
            let at = [row, column / SIDE];
            let all = parts.iter().flatten().chain(&values);
            let valid = all.copied().all(f64::is_finite);
            valid.then_some(Area {
                at,
                overlaps: column % SIDE != 0,
                values,
                parts,
                slow,
            })
        })
        .collect();
    areas.sort_by(|a, b| a.values[0].total_cmp(&b.values[0]));
    let quarter = areas.len().div_ceil(4);
    if let (Some(flat), Some(rough)) = (areas.get(quarter / 2), areas.get(areas.len() * 9 / 10))
        && rough.values[0] > ONE_SURFACE * flat.values[0]
    {
        areas.truncate(quarter);
        for half in [0, 1] {
            scale_to_median(&mut areas, half);
        }
    }
    areas
}

/// Scales the covariances of areas of different scatter so that their mean variance is the median
/// variance. `areas` are sorted by scatter.
fn scale_to_median(areas: &mut [Area], half: usize) {
    let variances: Vec<f64> = in_half(areas, half)
        .map(|area| area.values[0].powi(2))
        .collect();
    if variances.is_empty() {
        return;
    }
    let mean = variances.iter().sum::<f64>() / variances.len() as f64;
    let by = median_of_sorted(variances.into_iter()) / mean;
    let of_half = areas.iter_mut().filter(|area| area.at[0] % 2 == half);
    of_half.for_each(|area| area.scale(by));
}

/// Returns the areas of a half of the map: every second block of [`SIDE`] profiles, from block
/// `half`.
pub fn in_half(areas: &[Area], half: usize) -> impl Iterator<Item = &Area> {
    areas.iter().filter(move |area| area.at[0] % 2 == half)
}

/// Returns the blocks of a half of a map. Areas that overlap the next block are used only if the
/// others are few. Few blocks are divided in two.
pub fn blocks(areas: &[Area], half: usize) -> Vec<Block> {
    let by_block = |overlapping: bool| {
        let mut by_block: BTreeMap<[usize; 2], Vec<&Area>> = BTreeMap::new();
        for area in in_half(areas, half).filter(|area| overlapping || !area.overlaps) {
            by_block.entry(area.at).or_default().push(area);
        }
        by_block
    };
    let disjoint = by_block(false);
    let by_block = match disjoint.len() < MIN_UNDIVIDED_BLOCKS {
        true => by_block(true),
        false => disjoint,
    };
    let of_part = |areas: &[&Area], part: usize| {
        let blocks = areas.iter().map(|area| Block {
            moments: area.parts[part],
            slow: area.slow,
        });
        mean(&blocks.collect::<Vec<Block>>())
    };
    let divided = by_block
        .values()
        .map(|areas| [0, 1].map(|part| of_part(areas, part)));
    match by_block.len() < MIN_UNDIVIDED_BLOCKS {
        true => divided.flatten().collect(),
        false => divided.map(|parts| mean(&parts)).collect(),
    }
}

/// Returns the mean of blocks; at least one.
pub fn mean(blocks: &[Block]) -> Block {
    let n = blocks.len() as f64;
    Block {
        moments: std::array::from_fn(|i| blocks.iter().map(|b| b.moments[i]).sum::<f64>() / n),
        slow: blocks.iter().map(|block| block.slow).sum::<f64>() / n,
    }
}

/// Returns the covariances of the deviations (mm) of profiles of [`SIDE`] points.
fn moments(along: &[f64]) -> Moments {
    let mut moments = [0.0; COUNT];
    for profiles in 0..LAGS[1] {
        for columns in 0..LAGS[0] {
            let (mut sum, mut count) = (0.0, 0.0);
            for y in 0..along.len() / SIDE - profiles {
                for x in 0..SIDE - columns {
                    let (first, second) = (y * SIDE + x, (y + profiles) * SIDE + x);
                    let pairs = [(first, second + columns), (first + columns, second)];
                    for product in pairs.map(|(a, b)| along[a] * along[b]) {
                        if product.is_finite() {
                            sum += product;
                            count += 1.0;
                        }
                    }
                }
            }
            moments[index(columns, profiles)] = 1e6 * sum / count;
        }
    }
    moments
}

/// Matrix that maps the covariances of a profile at a lag of 0 to [`SIDE`] − 1 columns to the
/// expected values of the covariances of the deviations from its parabola.
///
/// The deviations of a profile are R·z, with the projection R = 1 − D·(DᵀD)⁻¹·Dᵀ. Their covariance
/// is R·C·R, and the value at a lag is the mean of a diagonal of it.
pub struct Detrending(DMatrix<f64>);

impl Detrending {
    pub fn new() -> Detrending {
        let design = DMatrix::from_fn(SIDE, 3, |i, j| {
            (i as f64 / SIDE as f64 - 0.5).powi(j as i32)
        });
        let normal = (design.transpose() * &design).try_inverse();
        let normal = normal.expect("a parabola has independent coefficients");
        let rest = DMatrix::identity(SIDE, SIDE) - &design * normal * design.transpose();
        let mut of_lag = DMatrix::zeros(LAGS[0], SIDE);
        for columns in 0..LAGS[0] {
            for i in 0..SIDE - columns {
                for a in 0..SIDE {
                    for b in 0..SIDE {
                        of_lag[(columns, a.abs_diff(b))] +=
                            rest[(i, a)] * rest[(b, i + columns)] / (SIDE - columns) as f64;
                    }
                }
            }
        }
        Detrending(of_lag)
    }

    /// Returns the expected covariances. `covariances` returns the covariances of heights at a lag in
    /// profiles, for lags of 0 to [`SIDE`] − 1 columns.
    pub fn expected(&self, covariances: impl Fn(usize) -> Vec<f64>) -> Moments {
        let mut expected = [0.0; COUNT];
        for profiles in 0..LAGS[1] {
            let of_profile = covariances(profiles);
            for columns in 0..LAGS[0] {
                let row = self.0.row(columns);
                expected[index(columns, profiles)] =
                    row.iter().zip(&of_profile).map(|(a, c)| a * c).sum();
            }
        }
        expected
    }
}
