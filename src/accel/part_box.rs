//! The box around a part, and the side of a triangle: what the backends share.

use super::refine::Tolerance;
use crate::math::{Aabb, DVec3};

/// The box around a mesh or an assembly, and what f32 relative to its middle is good for.
#[derive(Debug, Clone, Copy)]
pub(super) struct PartBox {
    pub bounds: Aabb,
    pub center: DVec3,
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

    fn margin(&self) -> DVec3 {
        DVec3::splat(2.0 * self.resolution())
    }

    /// The box as rays meet it.
    pub fn widened(&self) -> Aabb {
        let margin = self.margin();
        Aabb {
            min: self.bounds.min - margin,
            max: self.bounds.max + margin,
        }
    }

    /// See [`Together`]: of rays of which one starts at `start` and all that far `apart` at
    /// most, in directions from `low` to `high`.
    #[cfg(feature = "embree")]
    pub fn together(&self, start: DVec3, apart: DVec3, [low, high]: [DVec3; 2]) -> Together {
        let half = (self.bounds.size() / 2.0).max_element();
        // Behind the part no ray is wanted.
        let reach = start.distance(self.center) + self.bounds.size().length() / 2.0;
        let spread = (high - low) * reach + apart;
        let approach = || self.approach(start, low, high, reach);
        Together {
            coherent: spread.max_element() <= COHERENT * half,
            approach: (apart == DVec3::ZERO).then(approach).flatten(),
        }
    }

    /// Returns a distance, mm, after which no ray from `start` with a direction from `low` to
    /// `high` is further than an eighth of the half size before the box, and none has passed
    /// the point at which it enters. Returns `None` if there is no such distance up to `reach`,
    /// beyond which every ray has passed the box. Without this limit a ray that is almost
    /// parallel to a face of the box would be moved to coordinates that f32 cannot hold.
    #[cfg(feature = "embree")]
    fn approach(&self, start: DVec3, low: DVec3, high: DVec3, reach: f64) -> Option<f64> {
        let margin = self.margin();
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
        // False for NaN too, which a gap or a direction of denormal size can give.
        (nearest <= reach && furthest - nearest <= half / 8.0).then_some(nearest)
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
