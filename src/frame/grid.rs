//! The samples of a pixel, four at a time.

use crate::math::DVec2;
use crate::math::quadrature::gauss_legendre;
use std::f64::consts::{PI, SQRT_2, TAU};
use std::sync::OnceLock;
use wide::f32x4;

/// Four of a pixel's samples.
pub(super) struct Four {
    /// From the pixel's centre, pixels.
    pub columns: f32x4,
    pub rows: f32x4,
    /// Those after the first so many only fill up the last four.
    pub count: usize,
    /// Zero for these; of all others the sum is 1.
    pub weights: f32x4,
}

/// The rectangle of a pixel that a sample represents, as large as the sample's weight. All rectangles fill the pixel.
#[derive(Clone, Copy)]
pub(super) struct Cell {
    /// The rectangle's centre relative to the pixel's, pixels.
    pub centre: DVec2,
    /// Half its sides, pixels.
    pub half: DVec2,
}

/// Where in each pixel light is sampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grid {
    /// At the nodes of Gauss–Legendre quadrature along both sides, for integrals: of speckle as
    /// large as the pixel 2 × 2 keep what an even grid needs 4 × 4 for.
    Gauss {
        /// Nodes along each side of a pixel, at least 1.
        per_side: u32,
    },
    /// Evenly, also from pixel to pixel, for transforms.
    Even {
        /// Samples along each side of a pixel, at least 1.
        per_side: u32,
    },
}

impl Grid {
    /// Places along a side, 0 to 1, and their weights.
    fn rule(self) -> Vec<(f64, f64)> {
        match self {
            Grid::Gauss { per_side } => gauss_legendre(per_side as usize),
            Grid::Even { per_side } => {
                let n = per_side as f64;
                let node = |i| ((i as f64 + 0.5) / n, 1.0 / n);
                (0..per_side).map(node).collect()
            }
        }
    }

    /// Standard deviation (pixels) of the narrowest Gaussian whose centroid samples at points do not move by
    /// more than [`SAMPLING_TOLERANCE_PX`]. Even samples are one a pixel of smaller pixels.
    fn narrowest(self) -> f64 {
        match self {
            Grid::Gauss { per_side } => narrowest(per_side),
            Grid::Even { per_side } => narrowest(1) / per_side as f64,
        }
    }
}

/// Error of the line's centroid that sampling may cause, pixels.
pub(crate) const SAMPLING_TOLERANCE_PX: f64 = 1e-3;

/// Standard deviation (pixels) of the narrowest Gaussian whose centroid the `n` nodes of Gauss–Legendre quadrature in
/// each pixel do not move by more than [`SAMPLING_TOLERANCE_PX`]; 16 for more nodes than that.
pub(crate) fn narrowest(n: u32) -> f64 {
    static NARROWEST: [OnceLock<f64>; 16] = [const { OnceLock::new() }; 16];
    let n = n.clamp(1, NARROWEST.len() as u32);
    *NARROWEST[n as usize - 1].get_or_init(|| {
        // In steps of 1 % from a width at which one node does.
        let widths = (0..).map(|k| 0.99f64.powi(k));
        let wide_enough = |sigma: &f64| sampling_error(*sigma, n) < SAMPLING_TOLERANCE_PX;
        widths.take_while(wide_enough).last().unwrap_or(1.0)
    })
}

/// The samples of a pixel, row by row.
pub(super) struct Nodes {
    /// Place from the pixel's centre, pixels.
    places: Vec<DVec2>,
    weights: Vec<f32>,
    fours: Vec<Four>,
    cells: Vec<Cell>,
    is_even: bool,
    /// Change of a Gaussian's argument u, exp(-u²), from pixel to pixel, up to which samples at points do.
    pub steepest: f32,
}

impl Nodes {
    pub fn new(grid: Grid) -> Nodes {
        let rule = grid.rule();
        let rows = rule
            .iter()
            .flat_map(|row| rule.iter().map(move |column| (column, row)));
        let sample =
            |((x, v), (y, w)): (&(f64, f64), &(f64, f64))| (DVec2::new(*x, *y) - 0.5, v * w);
        let samples: Vec<(DVec2, f64)> = rows.map(sample).collect();
        let four = |samples: &[(DVec2, f64)]| {
            let of = |value: fn(&(DVec2, f64)) -> f64| {
                let mut lanes = [0.0; 4];
                for (lane, sample) in lanes.iter_mut().zip(samples) {
                    *lane = value(sample) as f32;
                }
                f32x4::from(lanes)
            };
            Four {
                columns: of(|(place, _)| place.x),
                rows: of(|(place, _)| place.y),
                count: samples.len(),
                weights: of(|(_, weight)| *weight),
            }
        };
        let mut end = -0.5;
        let sides = rule.iter().map(|&(_, weight)| {
            end += weight;
            (end - weight / 2.0, weight / 2.0)
        });
        let sides: Vec<(f64, f64)> = sides.collect();
        let rows = (sides.iter()).flat_map(|row| sides.iter().map(move |column| (column, row)));
        let cell = |((x, across), (y, along)): (&(f64, f64), &(f64, f64))| Cell {
            centre: DVec2::new(*x, *y),
            half: DVec2::new(*across, *along),
        };
        Nodes {
            cells: rows.map(cell).collect(),
            steepest: (SQRT_2 * grid.narrowest()).recip() as f32,
            fours: samples.chunks(4).map(four).collect(),
            weights: samples.iter().map(|(_, weight)| *weight as f32).collect(),
            is_even: matches!(grid, Grid::Even { .. }),
            places: samples.into_iter().map(|(place, _)| place).collect(),
        }
    }

    /// Samples along a side.
    pub fn side(&self) -> usize {
        self.places.len().isqrt()
    }

    /// Samples along a side that transforms take: those of an even grid, and the mean of all others.
    pub fn transformed(&self) -> usize {
        if self.is_even { self.side() } else { 1 }
    }

    /// Of the samples; their sum is 1.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    pub fn places(&self) -> &[DVec2] {
        &self.places
    }

    /// The parts of the pixel that they stand for.
    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    /// How far the border of its cell lies from a sample in column or in row at most, pixels.
    pub fn reach(&self) -> f64 {
        let both = self.places.iter().zip(&self.cells);
        let reach = |(place, cell): (&DVec2, &Cell)| {
            ((cell.centre - place).abs() + cell.half).max_element()
        };
        both.map(reach).fold(0.0, f64::max)
    }

    pub fn fours(&self) -> &[Four] {
        &self.fours
    }
}

/// Greatest error (pixels) of the centroid of a Gaussian of standard deviation
/// `sigma` pixels sampled at the `n` nodes of Gauss–Legendre quadrature in each pixel: by
/// Poisson's summation formula the aliases of the first moment,
/// Σ 4πσ²j·|a_j|·exp(-2π²σ²j²), with a_j = Σ w·cos(2πj·(x - ½)) over the nodes.
pub(crate) fn sampling_error(sigma: f64, n: u32) -> f64 {
    let rule = gauss_legendre(n as usize);
    let alias = |j: u32| {
        let j = j as f64;
        let nodes = rule.iter().map(|(x, w)| w * (TAU * j * (x - 0.5)).cos());
        let amplitude = nodes.sum::<f64>().abs();
        4.0 * PI * sigma * sigma * j * amplitude * (-2.0 * (PI * sigma * j).powi(2)).exp()
    };
    (1..=4 * n).map(alias).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bound against brute force over all phases of the line in its pixel: reached where
    /// one alias is all there is, and never passed by more than the second order of them.
    #[test]
    fn the_sampling_error_is_what_sampling_does() {
        for (sigma, n) in [(0.5, 1), (0.7, 1), (0.5, 2), (0.7, 2), (0.4, 3), (0.35, 4)] {
            let rule = gauss_legendre(n as usize);
            let worst = (0..200)
                .map(|i| {
                    let phase = i as f64 / 200.0;
                    let (mut sum, mut moment) = (0.0, 0.0);
                    for (k, (x, w)) in
                        (-60..60).flat_map(|k| rule.iter().map(move |node| (k, node)))
                    {
                        let y = k as f64 + x + phase;
                        let g = w * (-y * y / (2.0 * sigma * sigma)).exp();
                        sum += g;
                        moment += g * y;
                    }
                    (moment / sum).abs()
                })
                .fold(0.0, f64::max);
            let bound = sampling_error(sigma, n);
            assert!(
                (0.75..1.05).contains(&(worst / bound)),
                "{sigma} {n}: {worst} {bound}"
            );
        }
    }
}
