//! Samples of a pixel, processed in groups of four.

use crate::math::DVec2;
use crate::math::quadrature::gauss_legendre;
use std::f64::consts::{PI, SQRT_2, TAU};
use std::sync::OnceLock;
use wide::f32x4;

/// Four samples of a pixel.
pub(super) struct SampleQuad {
    /// Positions relative to the pixel's centre, pixels.
    pub columns: f32x4,
    pub rows: f32x4,
    /// Number of valid samples; the remaining lanes are padding.
    pub count: usize,
    /// Weights, zero for padding. The weights of all samples of the pixel sum to 1.
    pub weights: f32x4,
    /// Centers (column, row) and half sides of the cells, relative to the pixel's centre, pixels. Cells of
    /// padding are outside the pixel.
    pub cell_center: [f32x4; 2],
    pub cell_half: [f32x4; 2],
}

/// Rectangle of a pixel that a sample represents. Its area is the weight of the sample. The
/// rectangles of all samples tile the pixel.
#[derive(Clone, Copy)]
pub(super) struct SampleCell {
    /// Centre of the rectangle relative to the pixel's centre, pixels.
    pub centre: DVec2,
    /// Half side lengths, pixels.
    pub half: DVec2,
}

/// Sample positions within each pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelQuadrature {
    /// Nodes of Gauss–Legendre quadrature along both sides, for integrals. For speckle of the size
    /// of a pixel, 2 × 2 nodes are as accurate as a uniform grid of 4 × 4.
    Gauss {
        /// Nodes along each side of a pixel, at least 1.
        per_side: u32,
    },
    /// Uniform grid that continues across pixel borders, for Fourier transforms.
    Even {
        /// Samples along each side of a pixel, at least 1.
        per_side: u32,
    },
}

impl PixelQuadrature {
    /// Returns positions along a side, 0 to 1, and their weights.
    fn quadrature_rule(self) -> Vec<(f64, f64)> {
        match self {
            PixelQuadrature::Gauss { per_side } => gauss_legendre(per_side as usize),
            PixelQuadrature::Even { per_side } => {
                let n = per_side as f64;
                let node = |i| ((i as f64 + 0.5) / n, 1.0 / n);
                (0..per_side).map(node).collect()
            }
        }
    }

    /// Returns the standard deviation (pixels) of the narrowest Gaussian whose sampled centroid has
    /// an error of at most [`SAMPLING_TOLERANCE_PX`]. A uniform grid is treated as smaller pixels
    /// with one sample per pixel.
    fn narrowest(self) -> f64 {
        match self {
            PixelQuadrature::Gauss { per_side } => narrowest(per_side),
            PixelQuadrature::Even { per_side } => narrowest(1) / per_side as f64,
        }
    }
}

/// Maximum centroid error of the line due to sampling, pixels.
pub(crate) const SAMPLING_TOLERANCE_PX: f64 = 1e-3;

/// Returns the standard deviation (pixels) of the narrowest Gaussian whose sampled centroid has an
/// error of at most [`SAMPLING_TOLERANCE_PX`]. The samples are the `n` nodes of Gauss–Legendre
/// quadrature in each pixel. For more than 16 nodes, the value for 16 nodes is returned.
pub(crate) fn narrowest(n: u32) -> f64 {
    static NARROWEST: [OnceLock<f64>; 16] = [const { OnceLock::new() }; 16];
    let n = n.clamp(1, NARROWEST.len() as u32);
    *NARROWEST[n as usize - 1].get_or_init(|| {
        // The search starts at a width for which one node suffices and proceeds in steps of 1 %.
        let widths = (0..).map(|k| 0.99f64.powi(k));
        let wide_enough = |sigma: &f64| sampling_error(*sigma, n) < SAMPLING_TOLERANCE_PX;
        widths.take_while(wide_enough).last().unwrap_or(1.0)
    })
}

/// Returns values of up to four items as lanes; the others are `padding`.
fn lanes<T>(padding: f32, items: &[T], value: fn(&T) -> f64) -> f32x4 {
    let mut lanes = [padding; 4];
    for (lane, item) in lanes.iter_mut().zip(items) {
        *lane = value(item) as f32;
    }
    f32x4::from(lanes)
}

/// Samples of a pixel, row by row.
pub(super) struct QuadratureNodes {
    /// Position relative to the pixel's centre, pixels.
    places: Vec<DVec2>,
    weights: Vec<f32>,
    quads: Vec<SampleQuad>,
    cells: Vec<SampleCell>,
    is_even: bool,
    /// Largest change per pixel of a Gaussian's argument u, exp(-u²), for which point samples are
    /// accurate.
    pub steepest: f32,
}

impl QuadratureNodes {
    pub fn new(grid: PixelQuadrature) -> QuadratureNodes {
        let rule = grid.quadrature_rule();
        let rows = rule
            .iter()
            .flat_map(|row| rule.iter().map(move |column| (column, row)));
        let sample =
            |((x, v), (y, w)): (&(f64, f64), &(f64, f64))| (DVec2::new(*x, *y) - 0.5, v * w);
        let samples: Vec<(DVec2, f64)> = rows.map(sample).collect();
        let mut end = -0.5;
        let sides = rule.iter().map(|&(_, weight)| {
            end += weight;
            (end - weight / 2.0, weight / 2.0)
        });
        let sides: Vec<(f64, f64)> = sides.collect();
        let rows = (sides.iter()).flat_map(|row| sides.iter().map(move |column| (column, row)));
        let cell = |((x, across), (y, along)): (&(f64, f64), &(f64, f64))| SampleCell {
            centre: DVec2::new(*x, *y),
            half: DVec2::new(*across, *along),
        };
        let cells: Vec<SampleCell> = rows.map(cell).collect();
        let quad = |(samples, cells): (&[(DVec2, f64)], &[SampleCell])| SampleQuad {
            columns: lanes(0.0, samples, |(place, _)| place.x),
            rows: lanes(0.0, samples, |(place, _)| place.y),
            count: samples.len(),
            weights: lanes(0.0, samples, |(_, weight)| *weight),
            cell_center: [
                lanes(0.0, cells, |cell| cell.centre.x),
                lanes(9.0, cells, |cell| cell.centre.y),
            ],
            cell_half: [
                lanes(0.5, cells, |cell| cell.half.x),
                lanes(0.5, cells, |cell| cell.half.y),
            ],
        };
        QuadratureNodes {
            steepest: (SQRT_2 * grid.narrowest()).recip() as f32,
            quads: samples.chunks(4).zip(cells.chunks(4)).map(quad).collect(),
            cells,
            weights: samples.iter().map(|(_, weight)| *weight as f32).collect(),
            is_even: matches!(grid, PixelQuadrature::Even { .. }),
            places: samples.into_iter().map(|(place, _)| place).collect(),
        }
    }

    /// Returns the number of samples along a side.
    pub fn side(&self) -> usize {
        self.places.len().isqrt()
    }

    /// Returns the number of samples along a side for Fourier transforms. Non-uniform grids are
    /// averaged to one sample per pixel.
    pub fn transformed(&self) -> usize {
        if self.is_even { self.side() } else { 1 }
    }

    /// Returns the sample weights; their sum is 1.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    pub fn places(&self) -> &[DVec2] {
        &self.places
    }

    /// Returns the rectangles of the pixel that the samples represent.
    pub fn cells(&self) -> &[SampleCell] {
        &self.cells
    }

    /// Returns the largest distance, in column or row, between a sample and the border of its cell,
    /// pixels.
    pub fn reach(&self) -> f64 {
        let both = self.places.iter().zip(&self.cells);
        let reach = |(place, cell): (&DVec2, &SampleCell)| {
            ((cell.centre - place).abs() + cell.half).max_element()
        };
        both.map(reach).fold(0.0, f64::max)
    }

    pub fn quads(&self) -> &[SampleQuad] {
        &self.quads
    }
}

/// Returns an upper bound of the centroid error (pixels) of a sampled Gaussian of standard
/// deviation `sigma` pixels. The samples are the `n` nodes of Gauss–Legendre quadrature in each
/// pixel. Poisson's summation formula gives the aliases of the first moment: Σ
/// 4πσ²j·|a_j|·exp(-2π²σ²j²), with a_j = Σ w·cos(2πj·(x - ½)) over the nodes.
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

    /// Compares the bound with the maximum error over all sub-pixel positions of the line. The
    /// bound is reached if one alias dominates. It is exceeded at most by the second order of the
    /// aliases.
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
