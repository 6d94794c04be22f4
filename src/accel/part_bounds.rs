//! Box around a part, and sides of a triangle, common to all backends.

use super::refine::Tolerance;
use crate::math::{Aabb, DVec3};

/// Box around a mesh or an assembly, with the error bounds of f32 relative to its center.
#[derive(Debug, Clone, Copy)]
pub(super) struct PartBounds {
    pub bounds: Aabb,
    pub center: DVec3,
}

/// Common properties of the rays of a packet.
#[cfg(feature = "embree")]
pub(super) struct PacketCoherence {
    /// True if the rays are so close to each other within the box that packet traversal is fastest.
    pub coherent: bool,
    /// Distance, mm, by which all rays may be advanced; see [`PartBounds::approach`].
    pub approach: Option<f64>,
}

/// Largest extent of a packet for packet traversal, in half sizes of the part.
///
/// Embree then tests a node with all rays together, and otherwise with each ray separately. Both
/// take equal time at 0.7, 0.35 and 0.25 on spheres of 500, 14 000 and 358 000 triangles.
#[cfg(feature = "embree")]
const COHERENT: f64 = 0.25;

impl PartBounds {
    pub fn new(bounds: Aabb) -> PartBounds {
        PartBounds {
            bounds,
            center: bounds.center(),
        }
    }

    /// Returns the resolution of f32; see [`super::Accel::resolution`].
    pub fn resolution(&self) -> f64 {
        (self.bounds.size() / 2.0).max_element() * 2f64.powi(-20)
    }

    /// Returns the largest lateral distance from a triangle at which f32 may report a hit, mm.
    ///
    /// It is about 60 rounding errors (2⁻¹⁸ of the half size), divided by sin θ for a plane at an
    /// angle θ to the ray. It covers all cases down to 1°; below, it omits only triangles next to
    /// an edge.
    #[cfg(feature = "embree")]
    pub fn overshoot(&self) -> f64 {
        self.resolution() * 256.0
    }

    /// Returns the refinement limit; see [`super::Accel::refinement`].
    pub fn refinement(&self) -> f64 {
        self.bounds.size().length() * 1e-3
    }

    /// Returns the tolerance for refining a hit reported in f32.
    #[cfg(feature = "embree")]
    pub fn tolerance(&self) -> Tolerance {
        Tolerance {
            depth_mm: self.refinement(),
            lateral_mm: self.overshoot(),
        }
    }

    /// Returns the tolerance for refining a hit reported in f64, which is final.
    pub fn final_tolerance(&self) -> Tolerance {
        Tolerance {
            depth_mm: self.refinement(),
            lateral_mm: self.resolution(),
        }
    }

    fn margin(&self) -> DVec3 {
        DVec3::splat(2.0 * self.resolution())
    }

    /// Returns the box with a margin for rounding, as used for rays.
    pub fn widened(&self) -> Aabb {
        let margin = self.margin();
        Aabb {
            min: self.bounds.min - margin,
            max: self.bounds.max + margin,
        }
    }

    /// Computes [`PacketCoherence`] for rays with origins within `apart` of `start` and directions from
    /// `low` to `high`.
    #[cfg(feature = "embree")]
    pub fn together(&self, start: DVec3, apart: DVec3, [low, high]: [DVec3; 2]) -> PacketCoherence {
        let half = (self.bounds.size() / 2.0).max_element();
        // Limits the rays to the far side of the part.
        let reach = start.distance(self.center) + self.bounds.size().length() / 2.0;
        let spread = (high - low) * reach + apart;
        let approach = || self.approach(start, low, high, reach);
        PacketCoherence {
            coherent: spread.max_element() <= COHERENT * half,
            approach: (apart == DVec3::ZERO).then(approach).flatten(),
        }
    }

    /// Returns a distance, mm, by which all rays from `start` with directions from `low` to `high`
    /// may be advanced.
    ///
    /// After this distance no ray is more than an eighth of the half size before the box, and none
    /// has passed its entry point. Returns `None` if no such distance exists up to `reach`, beyond
    /// which every ray has passed the box. Without this limit, a ray nearly parallel to a face of
    /// the box would be advanced to coordinates that f32 cannot represent.
    #[cfg(feature = "embree")]
    fn approach(&self, start: DVec3, low: DVec3, high: DVec3, reach: f64) -> Option<f64> {
        let margin = self.margin();
        let (below, above) = (
            self.bounds.min - margin - start,
            start - self.bounds.max - margin,
        );
        // Smallest and largest distance to the plane of each axis.
        let (mut nearest, mut furthest) = (0.0f64, 0.0f64);
        for axis in 0..3 {
            let (gap, slow, fast) = match below[axis] > above[axis] {
                true => (below[axis], low[axis], high[axis]),
                false => (above[axis], -high[axis], -low[axis]),
            };
            if gap > 0.0 {
                // A ray that passes the box laterally never reaches the plane.
                if slow <= 0.0 {
                    return None;
                }
                nearest = nearest.max(gap / fast);
                furthest = furthest.max(gap / slow);
            }
        }
        let half = (self.bounds.size() / 2.0).max_element();
        // Also false for NaN, which can result from denormal gaps or directions.
        (nearest <= reach && furthest - nearest <= half / 8.0).then_some(nearest)
    }
}

/// Side of a triangle that a ray hits: front if the corners are counter-clockwise as viewed from
/// the ray origin.
#[cfg(feature = "embree")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Facing {
    Front,
    Back,
}
