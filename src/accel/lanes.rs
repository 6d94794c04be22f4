//! The rays of a packet coordinate by coordinate, so that vectors hold several of them. What is
//! done to all is compiled for several sets of instructions, of which the machine's is chosen at
//! run time; none of them joins multiplication and addition, so all give the same bits.

use super::part_box::PartBox;
#[cfg(feature = "embree")]
use super::part_box::Together;
use super::refine::{Meeting, meet};
use super::{Ray, WIDTH};
use crate::math::{Aabb, DVec3};
use multiversion::multiversion;

/// One number of each ray.
pub(super) type Lane = [f64; WIDTH];

/// One vector of each ray.
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

/// 1 to 16 rays; the last stands in the places of those that are missing.
#[derive(Default)]
pub(super) struct Lanes {
    origin: Lanes3,
    direction: Lanes3,
    t_max: Lane,
    #[cfg(feature = "embree")]
    count: usize,
}

impl Lanes {
    pub fn new(rays: &[Ray]) -> Lanes {
        let mut lanes = Lanes::default();
        lanes.set(rays);
        lanes
    }

    /// Takes these in the place of those there were.
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

    /// One of them.
    pub fn ray(&self, i: usize) -> Ray {
        Ray {
            origin: self.origin.get(i),
            direction: self.direction.get(i),
            t_max: self.t_max[i],
        }
    }

    /// The rays that there are, as bits.
    #[cfg(feature = "embree")]
    pub fn there(&self) -> u16 {
        u16::MAX >> (WIDTH - self.count)
    }

    /// The rays in the box. `approach`: a distance by which all are advanced, whether they
    /// meet the box or not, which the hierarchy finds out for less.
    #[inline(always)]
    pub fn inside(&self, part: &PartBox, approach: Option<f64>) -> Inside {
        let mut inside = Inside {
            origin: [[0.0; WIDTH]; 3],
            direction: [[0.0; WIDTH]; 3],
            advanced: [0.0; WIDTH],
            length: [0.0; WIDTH],
        };
        enter(self, part, approach, &mut inside);
        inside
    }

    /// See [`Together`]. By all rays of a packet and in f64, so that it depends neither on
    /// which of them are asked for nor on the machine's vectors.
    #[cfg(feature = "embree")]
    pub fn together(&self, part: &PartBox) -> Together {
        let [low, high] = extent(&self.origin);
        part.together(self.origin.get(0), high - low, extent(&self.direction))
    }

    /// What the rays make of the triangles that they are said to meet at `t_found`, within
    /// `along`: see [`meet`].
    #[inline(always)]
    pub fn meet(&self, corners: &[Lanes3; 3], t_found: &Lane, along: f64) -> Meetings {
        let mut meetings = Meetings {
            on: [0; WIDTH],
            t: [0.0; WIDTH],
            point: Lanes3::ZERO,
            normal: Lanes3::ZERO,
        };
        meet_all(self, corners, t_found, along, &mut meetings);
        meetings
    }
}

/// The parts of rays inside a box, narrowed to f32.
pub(super) struct Inside {
    /// Where each enters, relative to the middle of the box, mm.
    pub origin: [[f32; WIDTH]; 3],
    pub direction: [[f32; WIDTH]; 3],
    /// Distance from its origin to there, mm.
    pub advanced: Lane,
    /// From there on, mm; negative of a ray that does not meet the box.
    pub length: Lane,
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn enter(rays: &Lanes, part: &PartBox, approach: Option<f64>, inside: &mut Inside) {
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
                // Nothing infinite of a ray that passes the box.
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

/// Distances between which a ray is inside a box; the second is less if it passes it.
#[inline(always)]
fn interval(bounds: &Aabb, origin: DVec3, direction: DVec3, t_max: f64) -> (f64, f64) {
    let inverse = direction.recip();
    let near = (bounds.min - origin) * inverse;
    let far = (bounds.max - origin) * inverse;
    // A ray parallel to a slab and on its very face gives 0·∞ = NaN, which these
    // comparisons pass over. It is on the widened box, so it meets nothing, and kept or
    // dropped is the same. (f64::min and max cost four times as much for what they promise
    // about NaN.)
    let (mut enter, mut leave) = (0.0f64, t_max);
    for axis in 0..3 {
        let (a, b) = (near[axis], far[axis]);
        let (first, last) = if a < b { (a, b) } else { (b, a) };
        enter = if first > enter { first } else { enter };
        leave = if last < leave { last } else { leave };
    }
    (enter, leave)
}

/// The least and the greatest of each coordinate.
#[cfg(feature = "embree")]
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn extent(of: &Lanes3) -> [DVec3; 2] {
    let [mut low, mut high] = [of.0; 2];
    // By halves, and not one after the other, which no vectors could do.
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

/// Of each ray a [`Meeting`].
pub(super) struct Meetings {
    on: [u64; WIDTH],
    t: Lane,
    point: Lanes3,
    normal: Lanes3,
}

impl Meetings {
    pub fn get(&self, i: usize) -> Option<Meeting> {
        (self.on[i] != 0).then(|| Meeting {
            on: true,
            t: self.t[i],
            point: self.point.get(i),
            normal: self.normal.get(i),
        })
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn meet_all(
    rays: &Lanes,
    corners: &[Lanes3; 3],
    t_found: &Lane,
    along: f64,
    meetings: &mut Meetings,
) {
    let [a, b, c] = corners;
    for (i, &t_found) in t_found.iter().enumerate() {
        let (origin, direction) = (rays.origin.get(i), rays.direction.get(i));
        let corners = [a.get(i), b.get(i), c.get(i)];
        let met = meet(origin, direction, corners, t_found, along);
        meetings.on[i] = u64::from(met.on);
        meetings.t[i] = met.t;
        meetings.point.set(i, met.point);
        meetings.normal.set(i, met.normal);
    }
}

#[cfg(all(test, feature = "embree"))]
#[path = "lanes_tests.rs"]
mod tests;
