//! The samples of a pixel on a plane, four at a time.

use super::lit::{Light, LitRays, Plane};
use super::speckle::Reader;
use crate::math::{DVec2, DVec3};
use std::f64::consts::SQRT_2;
use wide::f32x4;

/// Four of a pixel's samples.
pub(super) struct Four {
    /// From the pixel's centre, pixels.
    columns: f32x4,
    rows: f32x4,
    /// Those after the first so many only fill up the last four.
    count: usize,
    /// One, and zero for these.
    weights: f32x4,
}

/// A grid of samples over a pixel.
pub(super) struct Grid {
    side: usize,
    fours: Vec<Four>,
}

impl Grid {
    pub fn new(side: usize) -> Grid {
        let count = side * side;
        let place = |i: usize| (i as f64 + 0.5) / side as f64 - 0.5;
        let four = |first: usize| {
            let lanes = [0, 1, 2, 3].map(|k| first + k);
            Four {
                columns: lanes.map(|i| place(i % side) as f32).into(),
                rows: lanes.map(|i| place(i / side % side) as f32).into(),
                count: (count - first).min(4),
                weights: lanes.map(|i| f32::from(u8::from(i < count))).into(),
            }
        };
        Grid {
            side,
            fours: (0..count).step_by(4).map(four).collect(),
        }
    }

    pub fn count(&self) -> usize {
        self.side * self.side
    }

    /// The samples' places on the sensor.
    pub fn places(&self, column: usize, row: usize) -> impl Iterator<Item = DVec2> + use<> {
        let side = self.side;
        let corner = DVec2::new(column as f64, row as f64);
        (0..side * side).map(move |i| {
            let place = DVec2::new((i % side) as f64 + 0.5, (i / side) as f64 + 0.5);
            corner + place / side as f64
        })
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
                        * reader.four(four.columns, four.rows, [light.depth; 4], four.count)
                })
                .sum(),
        };
        sum.reduce_add() as f64 / self.count() as f64
    }
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
