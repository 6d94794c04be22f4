//! The box around a part, and the side of a triangle: what the backends share.

use super::Ray;
use super::refine::Tolerance;
use crate::math::{Aabb, DVec3};
use glam::Vec3;

/// The box around a mesh or an assembly, and what f32 relative to its middle is good for.
#[derive(Debug, Clone, Copy)]
pub(super) struct PartBox {
    pub bounds: Aabb,
    pub center: DVec3,
}

/// The part of a ray inside the box, narrowed to f32.
pub(super) struct Inside {
    /// Where the ray enters, relative to the middle of the box, mm.
    pub origin: Vec3,
    /// Distance from the ray's origin to there, mm.
    pub advanced: f64,
    pub length: f64,
}

/// What rays of a packet have in common.
#[cfg(feature = "embree")]
pub(super) struct Together {
    /// Whether they run so close to each other through the box that they are best traced
    /// as one packet.
    pub coherent: bool,
    /// A distance, mm, by which all may be advanced; see [`PartBox::approach`].
    pub approach: Option<f64>,
}

/// Rays that stay within a box of this many half sizes of the part are traced as a packet, in which
/// Embree asks a node for all of them; others each by itself. Where the two take the same
/// time on spheres of 500, 14 000 and 358 000 triangles: 0.7, 0.35, 0.25.
#[cfg(feature = "embree")]
const COHERENT: f64 = 0.25;

impl PartBox {
    pub fn new(bounds: Aabb) -> PartBox {
        PartBox {
            bounds,
            center: bounds.center(),
        }
    }

    /// See [`super::Accel::resolution`].
    pub fn resolution(&self) -> f64 {
        (self.bounds.size() / 2.0).max_element() * 2f64.powi(-20)
    }

    /// How far beside a triangle f32 may take a ray to meet it, mm: some 60 roundings
    /// (2⁻¹⁸ of the half size), and on a plane seen at an angle θ from edge-on 1/sin θ
    /// times as far: down to 1° nothing is left out, and below only what lies beside an
    /// edge.
    #[cfg(feature = "embree")]
    pub fn overshoot(&self) -> f64 {
        self.resolution() * 256.0
    }

    /// See [`super::Accel::refinement`].
    pub fn refinement(&self) -> f64 {
        self.bounds.size().length() * 1e-3
    }

    /// What refinement makes of a hit that f32 reports.
    #[cfg(feature = "embree")]
    pub fn tolerance(&self) -> Tolerance {
        Tolerance {
            along: self.refinement(),
            beside: self.overshoot(),
        }
    }

    /// And of one that f64 reports, which is final.
    pub fn final_tolerance(&self) -> Tolerance {
        Tolerance {
            along: self.refinement(),
            beside: self.resolution(),
        }
    }

    /// Distances between which the ray is inside the box.
    fn interval(&self, ray: &Ray) -> Option<(f64, f64)> {
        let margin = DVec3::splat(2.0 * self.resolution());
        let inverse = ray.direction.recip();
        let near = (self.bounds.min - margin - ray.origin) * inverse;
        let far = (self.bounds.max + margin - ray.origin) * inverse;
        // A ray parallel to a slab and on its very face gives 0·∞ = NaN, which
        // these comparisons pass over. It is on the widened box, so it meets
        // nothing, and kept or dropped is the same. (f64::min and max cost four
        // times as much for what they promise about NaN.)
        let (mut enter, mut leave) = (0.0f64, ray.t_max);
        for axis in 0..3 {
            let (a, b) = (near[axis], far[axis]);
            let (first, last) = if a < b { (a, b) } else { (b, a) };
            enter = if first > enter { first } else { enter };
            leave = if last < leave { last } else { leave };
        }
        (enter <= leave).then_some((enter, leave))
    }

    /// See [`Together`]. By all rays of a packet and in f64, so that it depends neither on
    /// which of them are asked for nor on the machine's vectors.
    #[cfg(feature = "embree")]
    pub fn together(&self, rays: &[Ray]) -> Together {
        let start = rays.first().map_or(self.center, |ray| ray.origin);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let mut one_start = true;
        for ray in rays {
            one_start &= ray.origin == start;
            (low, high) = (low.min(ray.direction), high.max(ray.direction));
        }
        let half = (self.bounds.size() / 2.0).max_element();
        // Behind the part no ray is wanted.
        let reach = start.distance(self.center) + self.bounds.size().length() / 2.0;
        let mut spread = (high - low) * reach;
        if !one_start {
            let starts = || rays.iter().map(|ray| ray.origin);
            let (low, high) = (starts().reduce(DVec3::min), starts().reduce(DVec3::max));
            spread += high.unwrap_or(start) - low.unwrap_or(start);
        }
        Together {
            coherent: spread.max_element() <= COHERENT * half,
            approach: one_start.then(|| self.approach(start, low, high)).flatten(),
        }
    }

    /// A distance, mm, after which none of the rays from one point, whose directions are
    /// from `low` to `high`, is further than an eighth of the half size before the box, and
    /// none past where it enters. `None` if there is no such distance.
    #[cfg(feature = "embree")]
    fn approach(&self, start: DVec3, low: DVec3, high: DVec3) -> Option<f64> {
        let margin = DVec3::splat(2.0 * self.resolution());
        let (below, above) = (
            self.bounds.min - margin - start,
            start - self.bounds.max - margin,
        );
        // The least and the greatest distance of each axis' plane.
        let (mut nearest, mut furthest) = (0.0f64, 0.0f64);
        for axis in 0..3 {
            let (gap, slow, fast) = match below[axis] > above[axis] {
                true => (below[axis], low[axis], high[axis]),
                false => (above[axis], -high[axis], -low[axis]),
            };
            if gap > 0.0 {
                // A ray that runs past the box never comes to the plane.
                if slow <= 0.0 {
                    return None;
                }
                nearest = nearest.max(gap / fast);
                furthest = furthest.max(gap / slow);
            }
        }
        let half = (self.bounds.size() / 2.0).max_element();
        (furthest - nearest <= half / 8.0).then_some(nearest)
    }

    /// A ray advanced in f64 to the box, so that a long standoff costs no digits.
    pub fn inside(&self, ray: &Ray) -> Option<Inside> {
        let (advanced, leave) = self.interval(ray)?;
        Some(self.advanced(ray, advanced, leave))
    }

    /// The same of a ray that enters after `advanced` mm and leaves after `leave`.
    pub fn advanced(&self, ray: &Ray, advanced: f64, leave: f64) -> Inside {
        Inside {
            origin: (ray.origin + ray.direction * advanced - self.center).as_vec3(),
            advanced,
            length: leave - advanced,
        }
    }
}

/// The side of a triangle that a ray meets: front if its corners are seen in
/// counter-clockwise order.
#[cfg(feature = "embree")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Front,
    Back,
}
