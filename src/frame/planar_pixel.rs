//! Light over a pixel whose neighbourhood is planar, from a single ray.

use super::pixel_quadrature::{SampleCell, SampleQuad};
use super::rays::{CameraRayCaster, SurfaceElement};
use crate::math::quadrature::gauss_legendre;
use crate::math::{DVec2, DVec3};
use std::f64::consts::{PI, SQRT_2};
use std::sync::LazyLock;
use wide::f32x4;

/// Gaussian profile of the laser over a pixel on a plane.
///
/// Let d be the direction from the eye to the pixel's centre, with the hit at w·d on the plane with
/// normal n. At an offset of Δ pixels, the direction changes by G = g_x·Δx + g_y·Δy. The hit then
/// moves by w·(G − d·(n·G)/(n·d)) / (1 + (n·G)/(n·d)). The distortion of the lens is linearised
/// within a pixel.
pub(super) struct PlanarBeamProfile {
    /// Offset (x, y) of the pixel's centre from the beam axis in units of √½·w, and numerators of
    /// its change per column and per row. x is zero for a fan.
    centre: [f32; 2],
    by_column: [f32; 2],
    by_row: [f32; 2],
    /// (n·g)/(n·d)
    denominator: [f32; 2],
    direction: DVec3,
    steps: [DVec3; 2],
    moves: [DVec3; 2],
}

impl PlanarBeamProfile {
    /// Returns the profile of a beam with the given 1/e² radius (mm). `None` if the plane is
    /// edge-on to the viewing direction.
    pub fn new(
        centre: DVec2,
        radius: f64,
        plane: &SurfaceElement,
        rays: &CameraRayCaster,
    ) -> Option<PlanarBeamProfile> {
        let sight = &rays.pinhole_in_laser;
        let (direction, steps) = sight.around(centre);
        let along = plane.normal.dot(direction);
        let way = plane.normal.dot(plane.point - sight.camera_center) / along;
        if !(way > 0.0 && way < f64::MAX) {
            return None;
        }
        let (moves, ratios) = plane.image_jacobian(direction, steps);
        let moves = moves.map(|step| way * step);
        let scale = SQRT_2 / radius;
        let across = |p: DVec3| {
            let off = rays.view.laser.off_middle(p) * scale;
            [off.x as f32, off.y as f32]
        };
        Some(PlanarBeamProfile {
            centre: across(plane.point),
            by_column: across(moves[0]),
            by_row: across(moves[1]),
            denominator: ratios.map(|ratio| ratio as f32),
            direction,
            steps,
            moves,
        })
    }

    /// Returns true if all factors of the light, except the laser profile across the line, are
    /// constant over the pixel. They depend on the surface and the laser.
    pub fn is_constant(&self, plane: &SurfaceElement, rays: &CameraRayCaster) -> bool {
        rays.is_constant_over(plane, self.moves, self.steps, self.direction)
    }

    /// Returns the largest change per column or row, in units of √½·w.
    pub fn steepness(&self) -> f32 {
        let change = |[x, y]: [f32; 2]| x.hypot(y);
        change(self.by_column).max(change(self.by_row))
    }

    /// Returns the brightest position in a cell, pixels from the profile's centre.
    ///
    /// `middle` is the centre of the cell, also relative to the profile's centre. The squared
    /// distance to the beam axis is minimised by steepest descent, clamped to the cell. For a light
    /// plane, one step reaches the axis. Further steps are needed if a step leaves the cell.
    pub fn brightest(&self, middle: DVec2, half: DVec2) -> DVec2 {
        let [centre, by_column, by_row] =
            [self.centre, self.by_column, self.by_row].map(|[x, y]| DVec2::new(x as f64, y as f64));
        let [by_x, by_y] = self.denominator.map(|ratio| ratio as f64);
        let mut at = middle;
        for _ in 0..DESCENT_STEPS {
            let denominator = (1.0 + at.x * by_x + at.y * by_y).max(1e-6);
            let moved = (by_column * at.x + by_row * at.y) / denominator;
            let off = centre + moved;
            let jacobian = [by_column - moved * by_x, by_row - moved * by_y]
                .map(|change| change / denominator);
            let gradient = DVec2::new(jacobian[0].dot(off), jacobian[1].dot(off));
            let change = jacobian[0] * gradient.x + jacobian[1] * gradient.y;
            let step = gradient * (gradient.length_squared() / change.length_squared());
            if !step.is_finite() {
                break;
            }
            at = (at - step).clamp(middle - half, middle + half);
        }
        at
    }

    /// Returns the mean of the profile over a cell whose centre is at `off` (pixels) from the
    /// profile's centre.
    pub fn mean(&self, off: DVec2, cell: &SampleCell) -> f32 {
        let [x, y] = off.to_array().map(|off| off as f32);
        let [by_x, by_y] = self.denominator;
        let denominator = (1.0 + x * by_x + y * by_y).max(1e-6);
        let moved =
            [0, 1].map(|axis| (x * self.by_column[axis] + y * self.by_row[axis]) / denominator);
        let centre = [0, 1].map(|axis| self.centre[axis] + moved[axis]);
        let half = cell.half.to_array().map(|half| half as f32 / denominator);
        let change = |by: [f32; 2], ratio: f32, half: f32| {
            [0, 1].map(|axis| half * (by[axis] - moved[axis] * ratio))
        };
        let by_column = change(self.by_column, by_x, half[0]);
        let by_row = change(self.by_row, by_y, half[1]);
        mean_of_gaussian(centre, by_column, by_row)
    }

    #[inline(always)]
    pub fn profile_weights(&self, four: &SampleQuad) -> f32x4 {
        let (x, y) = (four.columns, four.rows);
        let [by_x, by_y] = self.denominator;
        // Parts of a pixel beyond the horizon of the plane are dark.
        let denominator = (1.0 + x * by_x + y * by_y).max(f32x4::splat(1e-6));
        let off = |axis: usize| {
            let moved = x * self.by_column[axis] + y * self.by_row[axis];
            self.centre[axis] + moved / denominator
        };
        let (a, b) = (off(0), off(1));
        // e⁻⁸⁷ is the smallest value that f32 holds with full precision.
        (-(a * a + b * b)).max(f32x4::splat(-87.0)).exp()
    }
}

/// Number of steps in [`PlanarBeamProfile::brightest`], a chosen value.
const DESCENT_STEPS: usize = 8;

fn dot(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

/// Returns the mean of exp(−|c + p·s + q·t|²) for s and t from −1 to 1: ¼·∫∫ ds dt.
///
/// The integral along the steeper of both directions has a closed form. The other integral is a
/// Gauss–Legendre rule with an error below 2·10⁻⁴ of the maximum. If p and q are small, the mean is
/// expanded to second order, with an error of p⁴/10.
pub(super) fn mean_of_gaussian(c: [f32; 2], p: [f32; 2], q: [f32; 2]) -> f32 {
    let (mut p, mut q) = (p, q);
    let (mut pp, mut qq) = (dot(p, p), dot(q, q));
    let square = dot(c, c);
    if pp + qq < 0.04 {
        let (cp, cq) = (dot(c, p), dot(c, q));
        let bend = (2.0 * (cp * cp + cq * cq) - pp - qq) / 3.0;
        return (-square).max(-87.0).exp() * (1.0 + bend);
    }
    if pp < qq {
        (p, q, pp, qq) = (q, p, qq, pp);
    }
    // e⁻⁸⁷ is the smallest value that f32 holds with full precision.
    if square.sqrt() - pp.sqrt() - qq.sqrt() > 9.4 {
        return 0.0;
    }
    let [c, p, q] = [c, p, q].map(|v| DVec2::new(v[0] as f64, v[1] as f64));
    let slope = p.length();
    let along = p / slope;
    let node = |&(x, weight): &(f64, f64)| {
        let at = c + q * (2.0 * x - 1.0);
        let (middle, aside) = (at.dot(along), at.perp_dot(along));
        let stretch = libm::erf(middle + slope) - libm::erf(middle - slope);
        weight * (-aside * aside).exp() * stretch
    };
    let sum: f64 = rule((qq as f64).sqrt()).iter().map(node).sum();
    (sum * PI.sqrt() / (4.0 * slope)) as f32
}

/// Maximum number of nodes of [`rule`], sufficient up to q = 24.
const MOST_NODES: usize = 64;

/// Returns nodes and weights for the mean over t from −1 to 1 of a function of q·t. The function
/// has no finer detail than exp(−u²).
///
/// Two nodes have an error of q⁴·12/270, three nodes of q⁶·120/31 500.
fn rule(q: f64) -> &'static [(f64, f64)] {
    static RULES: LazyLock<[Vec<(f64, f64)>; MOST_NODES + 1]> =
        LazyLock::new(|| std::array::from_fn(gauss_legendre));
    let nodes = match q {
        ..0.25 => 2,
        0.25..0.6 => 3,
        _ => (3 + (2.5 * q).ceil() as usize).min(MOST_NODES),
    };
    &RULES[nodes]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Compares means with sums over 400 × 400 points. The error of the sums is at most (2/400)²/24
    /// of the largest second derivative, 2·|p|², hence 10⁻⁴ for |p| = 5.
    #[test]
    fn means_are_those_of_many_places() {
        const SIDE: usize = 400;
        for i in 0..200 {
            let key = RngKey::new(31, Purpose::SensorNoise).with(i);
            let vector = |k: u64, most: f64| {
                let length = most * 0.01f64.powf(key.uniform(k));
                (DVec2::from_angle(6.3 * key.uniform(k + 1)) * length).to_array()
            };
            let is_fan = |v: [f64; 2]| if i % 2 == 0 { [0.0, v[1]] } else { v };
            let [c, p, q] = [vector(0, 4.0), vector(2, 5.0), vector(4, 5.0)].map(is_fan);
            let at = |k: usize| (2 * k + 1) as f64 / SIDE as f64 - 1.0;
            let value = |k: usize| {
                let (s, t) = (at(k % SIDE), at(k / SIDE));
                let u = [0, 1].map(|axis| c[axis] + p[axis] * s + q[axis] * t);
                (-u[0] * u[0] - u[1] * u[1]).exp()
            };
            let expected = (0..SIDE * SIDE).map(value).sum::<f64>() / (SIDE * SIDE) as f64;
            let [c, p, q] = [c, p, q].map(|v| v.map(|x| x as f32));
            let found = mean_of_gaussian(c, p, q) as f64;
            assert!(
                (found - expected).abs() < 4e-4,
                "{c:?} {p:?} {q:?}: {found} {expected}"
            );
        }
    }
}
