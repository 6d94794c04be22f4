//! Ray–mesh intersection.
//!
//! Embree or a hierarchy in Rust finds the triangle, and `refine` computes the hit point in f64.
//! `edge_repair` finds the triangle if the f32 result of Embree is ambiguous. `brute` is the slow
//! reference for tests. All coordinates are in the frame of the part (mm).

mod all_hits;
mod assembly;
pub mod brute;
mod cast;
mod clusters;
mod crossings;
#[cfg(feature = "embree")]
mod edge_repair;
#[cfg(feature = "embree")]
mod embree;
#[cfg(feature = "embree")]
mod embree_device;
#[cfg(feature = "race")]
pub mod embree_race;
mod hierarchy;
mod instances;
mod packet_soa;
mod part_bounds;
mod prefetch;
#[cfg(feature = "embree")]
mod quads;
mod refine;
mod rust_bvh;
mod solid;
mod watertight;

pub use all_hits::AllHits;
pub use assembly::Accel;
pub use cast::{CAST_ALONE, SurfacePoint};
pub use clusters::{ClusterHit, HalfSpace, TriangleClusters};
pub use hierarchy::Backend;
pub use refine::{Tolerance, facing_normal, refine};

use crate::math::DVec3;

/// Rays per packet.
pub const WIDTH: usize = 16;

/// Half-line from `origin` along `direction`, up to `t_max`.
///
/// [`Accel::closest_hits`] and [`Accel::occluded_batch`] accept directions of any length, which is
/// then the unit of `t_max`. Within the simulator, directions have length 1.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// Origin in the frame of the part, mm.
    pub origin: DVec3,
    /// Direction of length 1, or of any length as described above.
    pub direction: DVec3,
    /// End of the ray, in mm or in units of the direction length; may be infinite.
    pub t_max: f64,
}

impl Ray {
    /// Returns the segment from `a` to `b`, or `None` if they coincide.
    pub fn between(a: DVec3, b: DVec3) -> Option<Ray> {
        let length = (b - a).length();
        // Also false for NaN.
        (length > 0.0).then(|| Ray {
            origin: a,
            direction: (b - a) / length,
            t_max: length,
        })
    }
}

/// Triangle of the part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct TriangleId {
    /// Index of the instance, in the order of the poses.
    pub copy: u32,
    /// Index of the triangle in the mesh.
    pub triangle: u32,
}

impl TriangleId {
    /// Returns a triangle of the mesh itself, or of its first instance.
    pub fn of_mesh(triangle: u32) -> TriangleId {
        TriangleId { copy: 0, triangle }
    }
}

/// Intersection of a ray with the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance along the ray, mm.
    pub t: f64,
    /// Triangle that is hit.
    pub face: TriangleId,
    /// Hit point in the frame of the part, mm.
    pub point: DVec3,
    /// Unit normal of the triangle, on the side of the ray origin.
    pub normal: DVec3,
}

/// Point of the part nearest to a query point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Triangle that contains the point.
    pub face: TriangleId,
    /// Position in the frame of the part, mm.
    pub point: DVec3,
    /// Distance from the query point, mm.
    pub distance: f64,
}
