//! The light over a pixel whose neighbourhood lies on one plane, from one ray.

use super::grid::Four;
use super::rays::{Lit, LitRays, Plane};
use crate::math::{DVec2, DVec3};
use std::f64::consts::SQRT_2;
use wide::f32x4;

/// The laser's Gaussian profile over a pixel that sees a plane.
///
/// With d the direction from the eye to the pixel's centre, which meets the plane
/// (normal n) after the way w·d, and G = g_x·Δx + g_y·Δy the change of direction Δ
/// pixels away, the point seen there is w·(G − d·(n·G)/(n·d)) / (1 + (n·G)/(n·d))
/// from the one at the centre. The lens's distortion is taken as linear within a
/// pixel.
pub(super) struct Profile {
    /// Distance from the middle of the beam in units of √½·w: of the centre, and
    /// numerators by column and row. (x, y); x is zero for a fan.
    centre: [f32; 2],
    by_column: [f32; 2],
    by_row: [f32; 2],
    /// (n·g)/(n·d)
    denominator: [f32; 2],
    /// Whether surface and laser, but for its profile across the line, may be taken as the same
    /// all over the pixel.
    pub is_constant: bool,
}

impl Profile {
    /// `None` for a plane seen edge-on.
    pub fn new(centre: DVec2, light: &Lit, plane: &Plane, rays: &LitRays) -> Option<Profile> {
        let sight = &rays.from_laser;
        let (direction, steps) = sight.around(centre);
        let along = plane.normal.dot(direction);
        let way = plane.normal.dot(plane.point - sight.eye) / along;
        if !(way > 0.0 && way < f64::MAX) {
            return None;
        }
        let (moves, ratios) = plane.moves(direction, steps);
        let moves = moves.map(|step| way * step);
        let scale = SQRT_2 / light.radius;
        let across = |p: DVec3| {
            let off = rays.view.laser.off_middle(p) * scale;
            [off.x as f32, off.y as f32]
        };
        Some(Profile {
            centre: across(plane.point),
            by_column: across(moves[0]),
            by_row: across(moves[1]),
            is_constant: rays.is_constant_over(plane, moves, steps, direction),
            denominator: ratios.map(|ratio| ratio as f32),
        })
    }

    #[inline(always)]
    pub fn shares(&self, four: &Four) -> f32x4 {
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
