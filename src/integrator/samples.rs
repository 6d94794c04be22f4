//! The samples of a pixel on a plane, four at a time.

use super::lit::{Light, LitRays, Plane};
use super::reference::Seen;
use super::speckle::Reader;
use crate::math::quadrature::gauss_legendre;
use crate::math::{DVec2, DVec3};
use std::f64::consts::{PI, SQRT_2, TAU};
use wide::f32x4;

/// Four of a pixel's samples.
pub(super) struct Four {
    /// From the pixel's centre, pixels.
    columns: f32x4,
    rows: f32x4,
    /// Those after the first so many only fill up the last four.
    count: usize,
    /// Zero for these; of all others the sum is 1.
    weights: f32x4,
}

/// Samples over a pixel, at the nodes of Gauss–Legendre quadrature along both sides: of
/// speckle as large as the pixel 2 × 2 keep what an even grid needs 4 × 4 for.
pub(super) struct Grid {
    /// Place from the pixel's centre, pixels, and weight.
    samples: Vec<(DVec2, f64)>,
    fours: Vec<Four>,
}

impl Grid {
    pub fn new(side: usize) -> Grid {
        let rule = gauss_legendre(side);
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
        Grid {
            fours: samples.chunks(4).map(four).collect(),
            samples,
        }
    }

    pub fn samples(&self) -> &[(DVec2, f64)] {
        &self.samples
    }

    /// Mean over the samples of the pixel around `centre` of the laser's profile,
    /// as a share of its middle, times speckle, if all lie on the plane that the
    /// centre sees.
    pub fn mean(
        &self,
        centre: DVec2,
        light: &Light,
        plane: &Plane,
        rays: &LitRays,
        speckle: Option<&Reader>,
    ) -> f64 {
        let Some(profile) = Profile::new(centre, light, plane, rays) else {
            return 0.0;
        };
        let shares = self.fours.iter().map(|four| (four, profile.shares(four)));
        let sum: f32x4 = match speckle.map(|reader| reader.pixel(centre)) {
            None => shares.map(|(four, shares)| four.weights * shares).sum(),
            Some(reader) => shares
                .map(|(four, shares)| {
                    four.weights
                        * shares
                        * reader.four(
                            four.columns,
                            four.rows,
                            [Seen::new(light, plane); 4],
                            four.count,
                        )
                })
                .sum(),
        };
        sum.reduce_add() as f64
    }
}

/// Greatest error (pixels) of the centroid of a Gaussian of standard deviation
/// `sigma` pixels sampled at the `n` nodes of Gauss–Legendre quadrature in each pixel: by
/// Poisson's summation formula the aliases of the first moment,
/// Σ 4πσ²j·|a_j|·exp(-2π²σ²j²), with a_j = Σ w·cos(2πj·(x - ½)) over the nodes.
pub(super) fn sampling_error(sigma: f64, n: u32) -> f64 {
    let rule = gauss_legendre(n as usize);
    let alias = |j: u32| {
        let j = j as f64;
        let nodes = rule.iter().map(|(x, w)| w * (TAU * j * (x - 0.5)).cos());
        let amplitude = nodes.sum::<f64>().abs();
        4.0 * PI * sigma * sigma * j * amplitude * (-2.0 * (PI * sigma * j).powi(2)).exp()
    };
    (1..=4 * n).map(alias).sum()
}

/// The laser's Gaussian profile over a pixel that sees a plane.
///
/// With d the direction from the eye to the pixel's centre, which meets the plane
/// (normal n) after the way w·d, and G = g_x·Δx + g_y·Δy the change of direction Δ
/// pixels away, the point seen there is w·(G − d·(n·G)/(n·d)) / (1 + (n·G)/(n·d))
/// from the one at the centre. The lens's distortion is taken as linear within a
/// pixel.
struct Profile {
    /// Distance from the middle of the beam in units of √½·w: of the centre, and
    /// numerators by column and row. (x, y); x is zero for a fan.
    centre: [f32; 2],
    by_column: [f32; 2],
    by_row: [f32; 2],
    /// (n·g)/(n·d)
    denominator: [f32; 2],
}

impl Profile {
    /// `None` for a plane seen edge-on.
    fn new(centre: DVec2, light: &Light, plane: &Plane, rays: &LitRays) -> Option<Profile> {
        let sight = &rays.from_laser;
        let (direction, steps) = sight.around(centre);
        let along = plane.normal.dot(direction);
        let way = plane.normal.dot(plane.point - sight.eye) / along;
        if !(way > 0.0 && way < f64::MAX) {
            return None;
        }
        let ratios = steps.map(|step| plane.normal.dot(step) / along);
        let scale = SQRT_2 / light.radius;
        let across = |p: DVec3| {
            let off = rays.view.laser.off_middle(p) * scale;
            [off.x as f32, off.y as f32]
        };
        let move_by = |i: usize| across(way * (steps[i] - direction * ratios[i]));
        Some(Profile {
            centre: across(plane.point),
            by_column: move_by(0),
            by_row: move_by(1),
            denominator: ratios.map(|ratio| ratio as f32),
        })
    }

    #[inline(always)]
    fn shares(&self, four: &Four) -> f32x4 {
        let (x, y) = (four.columns, four.rows);
        let [by_x, by_y] = self.denominator;
        // Where a pixel reaches past the plane's horizon nothing of it is seen.
        let denominator = (1.0 + x * by_x + y * by_y).max(f32x4::splat(1e-6));
        let off = |axis: usize| {
            let moved = x * self.by_column[axis] + y * self.by_row[axis];
            self.centre[axis] + moved / denominator
        };
        let (a, b) = (off(0), off(1));
        // e⁻⁸⁷ is the least that f32 holds in full.
        (-(a * a + b * b)).max(f32x4::splat(-87.0)).exp()
    }
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
