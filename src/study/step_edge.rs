//! Height and lateral resolution of the image of a step across the profiles.

use super::least_squares::{derivatives, minimum};
use super::round::Profile;
use super::sampled::{SampledStatistics, Statistic, median};
use crate::math::{Aabb, DVec3};
use nalgebra::DVector;
use std::f64::consts::SQRT_2;

/// Fewest points of a profile.
const MIN_POINTS: usize = 20;
/// Fewest profiles of a block.
const MIN_BLOCK: usize = 4;
/// Number of blocks.
const BLOCKS: usize = 16;
/// Fewest profiles.
pub const MIN_PROFILES: usize = MIN_BLOCK * BLOCKS;
/// Fraction of the points at each end of a profile that are the first estimates of both planes.
const END: f64 = 0.2;

/// Statistics of a step.
pub const STATISTICS: [Statistic; 2] = [
    Statistic {
        name: "step_height_mm",
        terms: "size of the part, scale of z, residual calibration error",
    },
    Statistic {
        name: "edge_sigma_mm",
        terms: "grain and width of the line, filters along the profile, resampling",
    },
];

/// Step of a block of profiles.
#[derive(Debug, Clone, Copy)]
pub struct Edge {
    /// Height of the plane at greater x above the other, mm.
    pub height: f64,
    /// Standard deviation of the normal distribution whose integral fits the edge along x, mm.
    pub sigma: f64,
}

/// Fits blocks of adjacent profiles with z = a + b·x + c·y + h·Φ((x − x₀ − s·y)/σ).
///
/// # Errors
/// Returns the number of usable profiles if there are fewer than [`MIN_PROFILES`], or if a block
/// has no edge.
pub fn edges(profiles: &[Profile]) -> Result<Vec<Edge>, usize> {
    let long: Vec<&Profile> = profiles.iter().filter(|p| p.len() >= MIN_POINTS).collect();
    if long.len() < MIN_PROFILES {
        return Err(long.len());
    }
    let block = |i: usize| {
        let range = i * long.len() / BLOCKS..(i + 1) * long.len() / BLOCKS;
        let points = long[range].iter().flat_map(|profile| profile.iter());
        edge(&points.map(|&(_, point)| point).collect::<Vec<DVec3>>())
    };
    let found: Vec<Edge> = (0..BLOCKS).filter_map(block).collect();
    match found.len() {
        BLOCKS => Ok(found),
        _ => Err(long.len() * found.len() / BLOCKS),
    }
}

/// Fits a block. Returns `None` if the step does not exceed the deviations from it.
fn edge(points: &[DVec3]) -> Option<Edge> {
    let bounds = Aabb::of(points.iter().copied());
    let size = bounds.size().max(DVec3::splat(f64::MIN_POSITIVE));
    // Coordinates of order 1.
    let scaled: Vec<DVec3> = points
        .iter()
        .map(|&p| (p - bounds.min) / size - 0.5)
        .collect();
    let heights = |inside: &dyn Fn(f64) -> bool| {
        let inside = scaled.iter().filter(|p| inside(p.x));
        median(inside.map(|p| p.z).collect())
    };
    let [first, last] = [heights(&|x| x < END - 0.5), heights(&|x| x > 0.5 - END)];
    let middle = (first + last) / 2.0;
    let upper = scaled.iter().filter(|p| (p.z > middle) == (last > first));
    let fraction = upper.count() as f64 / scaled.len() as f64;
    let start = [
        first,
        0.0,
        last - first,
        0.5 - fraction,
        0.0,
        0.02f64.ln(),
        0.0,
    ];
    let model = |at: &DVector<f64>| {
        let heights = scaled.iter().map(|p| {
            let u = (p.x - at[3] - at[4] * p.y) / at[5].exp();
            at[0] + at[1] * p.x + at[6] * p.y + at[2] * 0.5 * (1.0 + libm::erf(u / SQRT_2))
        });
        DVector::from_iterator(scaled.len(), heights)
    };
    let found = DVector::from_iterator(scaled.len(), scaled.iter().map(|p| p.z));
    let residual = |at: &DVector<f64>| &found - model(at);
    let start = DVector::from_row_slice(&start);
    let (at, squares) = minimum(start, residual, |at| derivatives(at, model));
    let rest = (squares / scaled.len() as f64).sqrt();
    let is_step = at[2].abs() > 2.0 * rest && at[3].abs() < 0.5 && at[5].exp() < 0.5;
    is_step.then(|| Edge {
        height: at[2] * size.z,
        sigma: at[5].exp() * size.x,
    })
}

/// Computes the medians of the blocks. `seed` selects the bootstrap samples.
///
/// # Errors
/// Returns the errors of [`edges`].
pub fn step_statistics(profiles: &[Profile], seed: u64) -> Result<SampledStatistics, usize> {
    let edges = edges(profiles)?;
    Ok(SampledStatistics::of(
        &edges,
        profiles.len(),
        seed,
        |edges| {
            let of =
                |value: fn(&Edge) -> f64| median(edges.iter().map(|edge| value(edge)).collect());
            vec![of(|edge| edge.height), of(|edge| edge.sigma)]
        },
    ))
}
