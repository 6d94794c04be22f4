//! Watertight ray–triangle test in f64.

use super::Ray;
use crate::math::DVec3;
use glam::Vec3Swizzles;

/// Ray prepared for triangle tests: its dominant axis becomes z, and a shear aligns the ray with it
/// (Woop, Benthin & Wald 2013, "Watertight ray/triangle intersection").
pub(super) struct Sheared {
    origin: DVec3,
    /// Axis that becomes z.
    axis: usize,
    shear: DVec3,
    t_max: f64,
}

/// Rotates the axes cyclically, so that `axis` becomes z.
fn turned(p: DVec3, axis: usize) -> DVec3 {
    match axis {
        0 => p.yzx(),
        1 => p.zxy(),
        _ => p,
    }
}

impl Sheared {
    pub fn new(ray: &Ray) -> Sheared {
        let axis = ray.direction.abs().max_position();
        let d = turned(ray.direction, axis);
        Sheared {
            origin: ray.origin,
            axis,
            shear: DVec3::new(d.x, d.y, 1.0) / d.z,
            t_max: ray.t_max,
        }
    }

    /// True if the ray runs in the negative direction of its dominant axis.
    pub fn is_reversed(&self) -> bool {
        self.shear.z < 0.0
    }

    /// Returns the coordinates of a point: its offset from the ray along x and y, and its distance
    /// along the ray as z.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        let p = turned(p - self.origin, self.axis);
        let s = self.shear;
        DVec3::new(p.x - s.x * p.z, p.y - s.y * p.z, s.z * p.z)
    }

    /// Returns the distance to a triangle.
    ///
    /// Each corner is rounded once, for all triangles that share it. The sign of an edge function
    /// of rounded corners is never wrong; it is sometimes zero, which counts as inside. No ray
    /// therefore passes between neighbours.
    pub fn distance(&self, [a, b, c]: [DVec3; 3]) -> Option<f64> {
        let (a, b, c) = (self.apply(a), self.apply(b), self.apply(c));
        let u = c.x * b.y - c.y * b.x;
        let v = a.x * c.y - a.y * c.x;
        let w = b.x * a.y - b.y * a.x;
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let t = (u * a.z + v * b.z + w * c.z) / (u + v + w);
        // Also false for NaN: a triangle exactly parallel to the ray.
        (t >= 0.0 && t <= self.t_max).then_some(t)
    }
}
