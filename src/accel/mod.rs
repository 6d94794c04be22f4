//! Ray–mesh intersection: Embree or a tree in Rust finds the triangle, `refine`
//! the point on it in f64, and `astray` the triangle where Embree's f32 leaves it in
//! doubt; `brute` is the slow oracle they are tested against.
//! Everything here is in the part's own frame (mm).

mod ask_for;
mod assembly;
#[cfg(feature = "embree")]
mod astray;
pub mod brute;
mod cast;
mod clusters;
mod copies;
#[cfg(feature = "embree")]
mod embree;
#[cfg(feature = "embree")]
mod embree_device;
#[cfg(feature = "race")]
pub mod embree_race;
mod hierarchy;
mod lanes;
mod part_box;
#[cfg(feature = "embree")]
mod quads;
mod refine;
mod rust_bvh;
mod watertight;

pub use assembly::Accel;
pub use cast::{CAST_ALONE, SurfacePoint};
pub use clusters::{Clusters, Found, HalfSpace};
pub use hierarchy::Backend;
pub use refine::{Tolerance, facing_normal, refine};

use crate::math::DVec3;

/// Rays per packet.
pub const WIDTH: usize = 16;

/// Half-line from `origin` along `direction`, up to `t_max`. [`Accel::closest_hits`] and
/// [`Accel::any_hits`] take directions of any length, which is then the unit of `t_max`; within the
/// simulator they are of length 1.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// mm, in the part's frame.
    pub origin: DVec3,
    /// Of length 1, or as said above.
    pub direction: DVec3,
    /// mm, or lengths of the direction; may be infinite.
    pub t_max: f64,
}

impl Ray {
    /// The segment from `a` to `b`; `None` if they coincide.
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

/// A triangle of the part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Face {
    /// Which copy of the mesh, in the order of their poses.
    pub copy: u32,
    /// Which triangle of the mesh.
    pub triangle: u32,
}

impl Face {
    /// A triangle of a mesh that is the part, or of its first copy.
    pub fn of_mesh(triangle: u32) -> Face {
        Face { copy: 0, triangle }
    }
}

/// Where a ray meets the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance along the ray, mm.
    pub t: f64,
    /// The triangle that was met.
    pub face: Face,
    /// Where, mm, in the part's frame.
    pub point: DVec3,
    /// Unit normal of the triangle, on the side the ray came from.
    pub normal: DVec3,
}

/// The point of the part nearest to a query point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// The triangle it lies on.
    pub face: Face,
    /// mm, in the part's frame.
    pub point: DVec3,
    /// Distance from the query point, mm.
    pub distance: f64,
}
