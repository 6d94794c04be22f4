//! Rays of a packet in structure-of-arrays layout, for vectorization.
//!
//! Operations on all rays are compiled for several instruction sets, and one is selected at run
//! time. None of them fuses multiplication and addition, so all give identical bits.

#[cfg(feature = "embree")]
use super::part_bounds::PacketCoherence;
use super::part_bounds::PartBounds;
use super::refine::{PlaneIntersection, intersect_plane};
use super::{Ray, WIDTH};
use crate::math::{Aabb, DVec3};
use multiversion::multiversion;

/// One number per ray.
pub(super) type Lane = [f64; WIDTH];

/// One vector per ray.
#[derive(Clone, Copy, Default)]
pub(super) struct Lanes3([Lane; 3]);

impl Lanes3 {
    pub const ZERO: Lanes3 = Lanes3([[0.0; WIDTH]; 3]);

    #[inline(always)]
    pub fn get(&self, i: usize) -> DVec3 {
        let [x, y, z] = &self.0;
        DVec3::new(x[i], y[i], z[i])
    }

    #[inline(always)]
    pub fn set(&mut self, i: usize, v: DVec3) {
        let [x, y, z] = &mut self.0;
        (x[i], y[i], z[i]) = (v.x, v.y, v.z);
    }
}

/// 1 to 16 rays; the last ray fills the unused lanes.
#[derive(Default)]
pub(super) struct RayPacketSoA {
    origin: Lanes3,
    direction: Lanes3,
    t_max: Lane,
    #[cfg(feature = "embree")]
    count: usize,
}

impl RayPacketSoA {
    pub fn new(rays: &[Ray]) -> RayPacketSoA {
        let mut lanes = RayPacketSoA::default();
        lanes.set(rays);
        lanes
    }

    /// Replaces the content by these rays.
    pub fn set(&mut self, rays: &[Ray]) {
        assert!(rays.len() <= WIDTH, "a packet holds {WIDTH} rays");
        #[cfg(feature = "embree")]
        {
            self.count = rays.len();
        }
        for i in 0..WIDTH {
            let ray = &rays[i.min(rays.len() - 1)];
            self.origin.set(i, ray.origin);
            self.direction.set(i, ray.direction);
            self.t_max[i] = ray.t_max;
        }
    }

    /// Returns one ray.
    pub fn ray(&self, i: usize) -> Ray {
        Ray {
            origin: self.origin.get(i),
            direction: self.direction.get(i),
            t_max: self.t_max[i],
        }
    }

    /// Returns the bits of the lanes in use.
    #[cfg(feature = "embree")]
    pub fn there(&self) -> u16 {
        u16::MAX >> (WIDTH - self.count)
    }

    /// Clips the rays to the box. With `approach`, all rays are advanced by this distance, even if
    /// they miss the box, since the traversal of the hierarchy detects the miss at lower cost.
    #[inline(always)]
    pub fn inside(&self, part: &PartBounds, approach: Option<f64>) -> ClippedPacket {
        let mut inside = ClippedPacket {
            origin: [[0.0; WIDTH]; 3],
            direction: [[0.0; WIDTH]; 3],
            advanced: [0.0; WIDTH],
            length: [0.0; WIDTH],
        };
        enter(self, part, approach, &mut inside);
        inside
    }

    /// Computes [`PacketCoherence`] from all rays of a packet in f64. The result is independent of the
    /// requested rays and of the instruction set.
    #[cfg(feature = "embree")]
    pub fn together(&self, part: &PartBounds) -> PacketCoherence {
        let [low, high] = extent(&self.origin);
        part.together(self.origin.get(0), high - low, extent(&self.direction))
    }

    /// Intersects the rays with the planes of the triangles that the backend reported at `t_found`,
    /// with tolerance `along`: see [`intersect_plane`].
    #[inline(always)]
    pub fn intersect_plane(
        &self,
        corners: &[Lanes3; 3],
        t_found: &Lane,
        along: f64,
    ) -> PlaneIntersections {
        let mut meetings = PlaneIntersections {
            on: [0; WIDTH],
            t: [0.0; WIDTH],
            point: Lanes3::ZERO,
            normal: Lanes3::ZERO,
        };
        meet_all(self, corners, t_found, along, &mut meetings);
        meetings
    }
}

/// Sections of rays inside a box, in f32.
pub(super) struct ClippedPacket {
    /// Entry points relative to the center of the box, mm.
    pub origin: [[f32; WIDTH]; 3],
    pub direction: [[f32; WIDTH]; 3],
    /// Distance from the origin of each ray to its entry point, mm.
    pub advanced: Lane,
    /// Length inside the box, mm; negative if a ray misses the box.
    pub length: Lane,
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn enter(
    rays: &RayPacketSoA,
    part: &PartBounds,
    approach: Option<f64>,
    inside: &mut ClippedPacket,
) {
    match approach {
        Some(distance) => {
            for i in 0..WIDTH {
                inside.advanced[i] = distance;
                inside.length[i] = rays.t_max[i] - distance;
            }
        }
        None => {
            let bounds = part.widened();
            for i in 0..WIDTH {
                let (origin, direction) = (rays.origin.get(i), rays.direction.get(i));
                let (enter, leave) = interval(&bounds, origin, direction, rays.t_max[i]);
                // Finite values for a ray that misses the box.
                let meets = enter <= leave;
                inside.advanced[i] = if meets { enter } else { 0.0 };
                inside.length[i] = if meets { leave - enter } else { -1.0 };
            }
        }
    }
    for i in 0..WIDTH {
        let direction = rays.direction.get(i);
        let start = rays.origin.get(i) + direction * inside.advanced[i] - part.center;
        for axis in 0..3 {
            inside.origin[axis][i] = start[axis] as f32;
            inside.direction[axis][i] = direction[axis] as f32;
        }
    }
}

/// Returns the distances at which a ray enters and leaves a box; the second is smaller if the ray
/// misses it.
#[inline(always)]
fn interval(bounds: &Aabb, origin: DVec3, direction: DVec3, t_max: f64) -> (f64, f64) {
    let inverse = direction.recip();
    let near = (bounds.min - origin) * inverse;
    let far = (bounds.max - origin) * inverse;
    // A ray parallel to a slab and exactly on its face gives 0·∞ = NaN, which these comparisons
    // ignore. It runs on the widened box and hits nothing, so its treatment is irrelevant.
    // (f64::min and max take four times longer because of their NaN rules.)
    let (mut enter, mut leave) = (0.0f64, t_max);
    for axis in 0..3 {
        let (a, b) = (near[axis], far[axis]);
        let (first, last) = if a < b { (a, b) } else { (b, a) };
        enter = if first > enter { first } else { enter };
        leave = if last < leave { last } else { leave };
    }
    (enter, leave)
}

/// Returns the minimum and the maximum of each coordinate.
#[cfg(feature = "embree")]
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn extent(of: &Lanes3) -> [DVec3; 2] {
    let [mut low, mut high] = [of.0; 2];
    // Reduces by halves, since a sequential reduction cannot be vectorized.
    for half in [8, 4, 2, 1] {
        for axis in 0..3 {
            for i in 0..half {
                let (a, b) = (low[axis][i], low[axis][i + half]);
                low[axis][i] = if b < a { b } else { a };
                let (a, b) = (high[axis][i], high[axis][i + half]);
                high[axis][i] = if b > a { b } else { a };
            }
        }
    }
    [low, high].map(|lanes| Lanes3(lanes).get(0))
}

/// A [`PlaneIntersection`] per ray.
pub(super) struct PlaneIntersections {
    on: [u64; WIDTH],
    t: Lane,
    point: Lanes3,
    normal: Lanes3,
}

impl PlaneIntersections {
    pub fn get(&self, i: usize) -> Option<PlaneIntersection> {
        (self.on[i] != 0).then(|| PlaneIntersection {
            on: true,
            t: self.t[i],
            point: self.point.get(i),
            normal: self.normal.get(i),
        })
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn meet_all(
    rays: &RayPacketSoA,
    corners: &[Lanes3; 3],
    t_found: &Lane,
    along: f64,
    meetings: &mut PlaneIntersections,
) {
    let [a, b, c] = corners;
    for (i, &t_found) in t_found.iter().enumerate() {
        let (origin, direction) = (rays.origin.get(i), rays.direction.get(i));
        let corners = [a.get(i), b.get(i), c.get(i)];
        let met = intersect_plane(origin, direction, corners, t_found, along);
        meetings.on[i] = u64::from(met.on);
        meetings.t[i] = met.t;
        meetings.point.set(i, met.point);
        meetings.normal.set(i, met.normal);
    }
}

#[cfg(all(test, feature = "embree"))]
#[path = "packet_soa_tests.rs"]
mod tests;
