//! All hits along rays, in order of distance.
//!
//! Both backends visit the triangles with the Rust hierarchy and decide in f64, therefore their
//! results are identical. Embree reports only triangles that its f32 test hits, and this test loses
//! some at vertices.

use super::cast::{in_shares, normalized};
use super::crossings::{Crossing, Crossings};
use super::refine::refine;
use super::{Accel, CAST_ALONE, Hit, Ray, SurfacePoint, TriangleId};
use crate::error::{Error, Result};
use crate::math::{DVec3, Rigid};
use crate::mesh::memory;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Hits of several rays, as returned by [`Accel::all_hits`].
#[derive(Debug, Clone, PartialEq)]
pub struct AllHits {
    /// Index of the first hit of each ray in `points`, followed by the number of hits.
    pub starts: Vec<usize>,
    /// Hits of all rays, in the order of the rays. The hits of one ray are in order of distance.
    pub points: Vec<SurfacePoint>,
    /// True for each hit where the ray hits the front of the triangle, on which its corners are
    /// counter-clockwise. On a mesh wound outward, the ray enters the material there.
    pub entering: Vec<bool>,
}

impl AllHits {
    fn new() -> AllHits {
        AllHits {
            starts: vec![0],
            points: Vec::new(),
            entering: Vec::new(),
        }
    }

    /// Returns the hits of one ray.
    pub fn of(&self, ray: usize) -> &[SurfacePoint] {
        &self.points[self.starts[ray]..self.starts[ray + 1]]
    }
}

/// Crossing of a ray with a triangle of an instance.
#[derive(Clone, Copy)]
pub(super) struct PartCrossing {
    pub copy: u32,
    pub crossing: Crossing,
}

/// Memory that hits may take.
struct Budget {
    available: Option<u64>,
    taken: AtomicU64,
}

impl Budget {
    /// Bytes per hit: a crossing, then the point and its side in a group and in the result.
    const PER_HIT: u64 = (size_of::<PartCrossing>() + 2 * size_of::<SurfacePoint>() + 2) as u64;
    /// Bytes per ray: the start of its hits in a group and in the result.
    const PER_RAY: u64 = 2 * size_of::<usize>() as u64;

    fn new() -> Budget {
        Budget {
            available: memory::available(),
            taken: AtomicU64::new(0),
        }
    }

    /// Reserves memory. Returns false if it is not available.
    fn take(&self, count: usize, bytes: u64) -> bool {
        let bytes = (count as u64).saturating_mul(bytes);
        let add = |taken: u64| Some(taken.saturating_add(bytes));
        let before = self.taken.fetch_update(Relaxed, Relaxed, add);
        let taken = before.unwrap_or_else(|taken| taken).saturating_add(bytes);
        self.available.is_none_or(|available| taken <= available)
    }

    fn exceeded(&self) -> Error {
        let need = self.taken.load(Relaxed);
        let work = "listing all hits of these rays".to_owned();
        match self.available {
            Some(available) => Error::Memory {
                work,
                need,
                available,
            },
            None => Error::Exhausted(work),
        }
    }
}

impl Accel {
    /// Finds all hits of `count` rays, at most `limit` for each. `rays` returns ray i in the frame
    /// of the part, as for [`Self::closest_hits`].
    ///
    /// Each surface is hit once. If a ray passes exactly through an edge or a vertex, one of the
    /// adjacent triangles is returned: the one that the ray hits after an infinitesimal
    /// displacement. Where a ray touches the outline of a closed surface, it therefore enters and
    /// leaves at one distance, or has no hit. The border of an open surface is hit. A triangle
    /// parallel to the ray is not hit. Two triangles with equal corners are two surfaces.
    ///
    /// On a closed mesh, the number of hits of an infinite ray is even if the ray starts outside
    /// and odd if it starts inside. Both backends return identical results. With Embree, the first
    /// call builds the Rust hierarchy in addition, which takes its build time and up to 200 bytes
    /// per triangle.
    ///
    /// # Errors
    /// Returns `Error::Usage` with the index of the first invalid ray, and `Error::Memory` if
    /// memory for the hits or the hierarchy is insufficient.
    ///
    /// ```
    /// use lasertrace::accel::{Accel, Ray};
    /// use lasertrace::math::DVec3;
    /// use lasertrace::mesh::shapes;
    /// use std::sync::Arc;
    ///
    /// let block = shapes::step_block(DVec3::new(30.0, 20.0, 9.0), 2.0).expect("a valid size");
    /// let accel = Accel::build(&Arc::new(block), 1)?;
    /// let (bounds, size) = (accel.bounds(), accel.bounds().size());
    /// let ray = Ray {
    ///     origin: bounds.center() - 50.0 * DVec3::Y - 0.1 * size.z * DVec3::Z,
    ///     direction: DVec3::Y,
    ///     t_max: f64::INFINITY,
    /// };
    /// let hits = accel.all_hits(|_| ray, 1, usize::MAX)?;
    /// let [near, far] = hits.of(0) else { panic!("two hits") };
    /// assert_eq!((far.distance - near.distance, &hits.entering[..]), (size.y, &[true, false][..]));
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn all_hits(
        &self,
        rays: impl Fn(usize) -> Ray + Sync,
        count: usize,
        limit: usize,
    ) -> Result<AllHits> {
        self.prepare_crossings()?;
        let budget = Budget::new();
        if !budget.take(count, Budget::PER_RAY) {
            return Err(budget.exceeded());
        }
        let group = |group: usize| {
            let first = group * CAST_ALONE;
            self.group_of_hits(&rays, first..count.min(first + CAST_ALONE), limit, &budget)
        };
        let groups = count.div_ceil(CAST_ALONE);
        let groups: Vec<Result<AllHits>> = match groups {
            0 | 1 => (0..groups).map(group).collect(),
            _ => (0..groups).into_par_iter().map(group).collect(),
        };
        let mut all = AllHits::new();
        all.starts.reserve_exact(count);
        for group in groups {
            let group = group?;
            let first = all.points.len();
            (all.starts).extend(group.starts[1..].iter().map(|start| first + start));
            all.points.extend(group.points);
            all.entering.extend(group.entering);
        }
        Ok(all)
    }

    /// Counts the hits of each of `counts.len()` rays, as [`Self::all_hits`] finds them without a
    /// limit. The errors are equal too (`counts` is then 0).
    pub fn count_hits(&self, rays: impl Fn(usize) -> Ray + Sync, counts: &mut [u64]) -> Result<()> {
        self.prepare_crossings()?;
        in_shares(counts, 0, |first, counts| {
            for (i, count) in (first..).zip(counts) {
                let (ray, _) =
                    normalized(rays(i)).map_err(|what| (i, format!("ray {i}: {what}")))?;
                *count = self.number_of_crossings(&ray);
            }
            Ok(())
        })
    }

    /// Returns the hits of a group of rays, or the error of the first invalid ray.
    fn group_of_hits(
        &self,
        rays: &(impl Fn(usize) -> Ray + Sync),
        group: Range<usize>,
        limit: usize,
        budget: &Budget,
    ) -> Result<AllHits> {
        let mut all = AllHits::new();
        for i in group {
            let ray = normalized(rays(i));
            let (ray, length) = ray.map_err(|what| Error::Usage(format!("ray {i}: {what}")))?;
            let mut crossings = self.crossings(&ray, |count| budget.take(count, Budget::PER_HIT));
            let Some(crossings) = &mut crossings else {
                return Err(budget.exceeded());
            };
            let mut least = 0.0f64;
            for found in crossings.iter().take(limit) {
                let hit = self.hit_of(&ray, found);
                // Refinement may exchange distances that are equal within rounding.
                least = hit.t.clamp(least, ray.t_max);
                all.points.push(SurfacePoint {
                    distance: least / length,
                    ..self.surface_point(hit.face, hit.point)
                });
                all.entering.push(found.crossing.entering);
            }
            all.starts.push(all.points.len());
        }
        Ok(all)
    }

    /// Returns the crossings of a ray with a direction of length 1, in order. `reserve` reserves
    /// memory for a number of crossings; if it returns false, there is no result.
    pub(super) fn crossings(
        &self,
        ray: &Ray,
        mut reserve: impl FnMut(usize) -> bool,
    ) -> Option<Vec<PartCrossing>> {
        let (mut all, mut enough) = (Vec::new(), true);
        self.each_copy(ray, |copy, local| {
            if !enough {
                return;
            }
            let found = self.crossings_of_mesh(local);
            enough = reserve(found.len());
            all.extend(
                found
                    .into_iter()
                    .map(|crossing| PartCrossing { copy, crossing }),
            );
        });
        if self.copies.is_some() {
            // The slope has a meaning within one instance only.
            let distance = |found: &PartCrossing| found.crossing.t;
            all.sort_by(|a, b| {
                let order = distance(a).total_cmp(&distance(b));
                order.then(a.copy.cmp(&b.copy))
            });
        }
        enough.then_some(all)
    }

    /// Returns the number of crossings of a ray with a direction of length 1.
    pub(super) fn number_of_crossings(&self, ray: &Ray) -> u64 {
        let mut number = 0;
        self.each_copy(ray, |_, local| {
            number += self.crossings_of_mesh(local).len() as u64
        });
        number
    }

    /// Calls `visit` with each instance that the ray may cross, and the ray in its frame.
    fn each_copy(&self, ray: &Ray, mut visit: impl FnMut(u32, &Ray)) {
        match &self.copies {
            None => visit(0, ray),
            Some(copies) => copies.along(&[*ray], |copy, _, _| {
                visit(copy, &seen_from(&copies.poses()[copy as usize], ray));
            }),
        }
    }

    /// Returns the crossings with the mesh of a ray in its frame, in order.
    fn crossings_of_mesh(&self, ray: &Ray) -> Vec<Crossing> {
        let mesh = self.mesh();
        let mut crossings = Crossings::new(ray);
        self.hierarchy.along(ray, |triangle| {
            crossings.add(triangle, mesh.triangle(triangle as usize));
        });
        crossings.finish()
    }

    /// Returns the hit at a crossing, refined as a first hit is.
    fn hit_of(&self, ray: &Ray, found: &PartCrossing) -> Hit {
        let PartCrossing { copy, crossing } = *found;
        let pose = self.poses()[copy as usize];
        let local = match &self.copies {
            None => *ray,
            Some(_) => seen_from(&pose, ray),
        };
        let (triangle, t) = (crossing.triangle, crossing.t);
        let corners = self.mesh().triangle(triangle as usize);
        let tolerance = self.hierarchy.part().final_tolerance();
        // Not refined, for a triangle without area at a joint of its neighbours.
        let unrefined = Hit {
            t,
            face: TriangleId { copy, triangle },
            point: ray.origin + ray.direction * t,
            normal: DVec3::ZERO,
        };
        match refine(&local, triangle, corners, t, tolerance).hit() {
            None => unrefined,
            Some(hit) if self.copies.is_none() => hit,
            Some(hit) => Hit {
                t: hit.t,
                point: pose.point(hit.point),
                ..unrefined
            },
        }
    }
}

/// Transforms a ray into the frame of an instance.
fn seen_from(part_from_copy: &Rigid, ray: &Ray) -> Ray {
    let copy_from_part = part_from_copy.inverse();
    Ray {
        origin: copy_from_part.point(ray.origin),
        direction: copy_from_part.vector(ray.direction),
        ..*ray
    }
}

#[cfg(test)]
#[path = "all_hits_tests.rs"]
mod tests;
