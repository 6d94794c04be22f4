//! The part as the rest of the program sees it: one mesh, or copies of it that share
//! its hierarchy.

use super::copies::{self, Copies};
use super::hierarchy::{Backend, Hierarchy, Unsettled};
use super::{Clusters, Face, Found, HalfSpace, Hit, Nearest, Ray, WIDTH};
use crate::error::{Error, Result};
use crate::math::{Aabb, DVec3, Rigid};
use crate::mesh::{LARGEST_MM, Mesh, Shell, Watch, memory};
use smallvec::SmallVec;
use std::cell::Cell;
use std::sync::{Arc, OnceLock};

/// Bounding-volume hierarchy over a part: a mesh or copies of it. All points, rays
/// and planes are in the part's frame, in which the copies are posed.
pub struct Accel {
    hierarchy: Hierarchy,
    /// `None`: the mesh itself, unmoved.
    copies: Option<Copies>,
    /// Made when it is first asked for; `None`: the mesh has no inside.
    shell: OnceLock<Option<Shell>>,
}

/// What a ray has met so far.
#[derive(Clone, Copy)]
struct Met {
    t: f64,
    copy: u32,
    /// `None`: nothing that is wanted.
    hit: Option<Hit>,
}

impl Accel {
    /// [`Self::build_with`] the default backend: Embree if it is built in.
    pub fn build(mesh: &Arc<Mesh>, threads: usize) -> Result<Accel> {
        Accel::build_with(Backend::default(), mesh, threads, &|_| Ok(()))
    }

    /// Builds the hierarchy of a part that is the mesh; Embree with `threads` threads,
    /// Rust with those of rayon's pool and without a word to `watch` before the end.
    /// Errors: `Error::Memory` if there is too little; what Embree reports; `watch`'s.
    pub fn build_with(
        backend: Backend,
        mesh: &Arc<Mesh>,
        threads: usize,
        watch: &Watch,
    ) -> Result<Accel> {
        Ok(Accel {
            hierarchy: Hierarchy::build(backend, mesh, threads, watch)?,
            copies: None,
            shell: OnceLock::new(),
        })
    }

    /// The same hierarchy for copies of the mesh at these poses (at least one,
    /// part_from_copy), which takes some 80 bytes a copy beside them. Errors:
    /// `Error::Memory` if there is too little; `Error::Usage` for no pose, 2³² − 1 and
    /// more, and one beyond 10¹² mm, with its number.
    pub fn with_copies(self, poses: impl Into<Arc<[Rigid]>>) -> Result<Accel> {
        let poses = poses.into();
        let beyond = |pose: &Rigid| {
            pose.translation.is_nan() || pose.translation.abs().max_element() > LARGEST_MM
        };
        if poses.is_empty() || poses.len() >= u32::MAX as usize {
            return Err(Error::Usage(format!(
                "{} instances, expected 1 to 4294967294",
                poses.len()
            )));
        }
        if let Some(wrong) = poses.iter().position(beyond) {
            return Err(Error::Usage(format!(
                "instance {wrong} is moved by {}, expected finite lengths within 1e12 mm",
                poses[wrong].translation
            )));
        }
        let copies = match &*poses {
            [pose] if *pose == Rigid::IDENTITY => None,
            _ => {
                let (count, bytes) = (poses.len() as u64, copies::BUILD);
                let work = format!("placing {count} copies at {bytes} bytes each");
                memory::require(work, count * bytes, memory::available())?;
                Some(Copies::new(poses.clone(), &self.hierarchy.part().bounds))
            }
        };
        Ok(Accel { copies, ..self })
    }

    /// The mesh, in its own frame.
    pub fn mesh(&self) -> &Arc<Mesh> {
        self.hierarchy.mesh()
    }

    /// Where copies of the mesh are: part_from_copy.
    pub fn poses(&self) -> &[Rigid] {
        match &self.copies {
            None => &[Rigid::IDENTITY],
            Some(copies) => copies.poses(),
        }
    }

    /// Corners of a triangle.
    pub fn corners(&self, face: Face) -> [DVec3; 3] {
        let corners = self.mesh().triangle(face.triangle as usize);
        match &self.copies {
            None => corners,
            Some(copies) => corners.map(|corner| copies.poses()[face.copy as usize].point(corner)),
        }
    }

    /// A box around the part; around one mesh unmoved the smallest, else that around
    /// the moved boxes of the copies.
    pub fn bounds(&self) -> Aabb {
        match &self.copies {
            None => self.hierarchy.part().bounds,
            Some(copies) => copies.bounds(),
        }
    }

    /// The largest coordinate in play, mm: of the part, of the mesh in its own frame,
    /// and of the poses between them.
    #[doc(hidden)]
    pub fn largest_coordinate(&self) -> f64 {
        let (mesh, part) = (self.hierarchy.part().bounds, self.bounds());
        let moved = self
            .copies
            .as_ref()
            .map_or(0.0, Copies::largest_translation);
        let places = [mesh.min, mesh.max, part.min, part.max];
        places
            .map(|p| p.abs().max_element())
            .into_iter()
            .fold(moved, f64::max)
    }

    /// A length (mm) that f32 cannot resolve on this mesh: 2⁻²⁰ of the largest
    /// coordinate from its middle, eight roundings of a vertex. Shadow rays start this
    /// far off their surface, and no hit's point is further from its triangle.
    pub fn resolution(&self) -> f64 {
        self.hierarchy.part().resolution()
    }

    /// Greatest difference between the distance the backend finds and the one that
    /// is taken after refinement, mm.
    #[doc(hidden)]
    pub fn refinement(&self) -> f64 {
        self.hierarchy.part().refinement()
    }

    /// Nearest hit of each of up to 16 coherent rays, refined in f64 if
    /// `wanted(ray, t)` holds, where t is within [`Self::refinement`] of the final
    /// distance; else as if nothing were hit. Where copies touch, of the first. A triangle
    /// that f64 passes is not met; what may be lost is what a ray at an outline meets
    /// within f32's steps of it, and at a vertex of an open mesh (LIMITS.md).
    ///
    /// ```
    /// use lasertrace::accel::{Accel, Ray};
    /// use lasertrace::math::{DVec2, DVec3};
    /// use lasertrace::mesh::shapes;
    /// use std::sync::Arc;
    ///
    /// let square = shapes::plane(DVec2::new(10.0, 10.0)).expect("a size above 0");
    /// let accel = Accel::build(&Arc::new(square), 1)?;
    /// let ray = Ray {
    ///     origin: DVec3::new(2.0, 1.0, 5.0),
    ///     direction: -DVec3::Z,
    ///     t_max: f64::INFINITY,
    /// };
    /// let hit = accel.closest(&[ray], |_, _| true)[0].expect("it meets the square");
    /// assert_eq!((hit.t, hit.normal), (5.0, DVec3::Z));
    ///
    /// let nearest = accel.nearest(DVec3::new(8.0, 1.0, 4.0), None);
    /// assert_eq!((nearest.point, nearest.distance), (DVec3::new(5.0, 1.0, 0.0), 5.0));
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    #[doc(hidden)]
    pub fn closest(
        &self,
        rays: &[Ray],
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        self.closest_some(rays, u16::MAX, wanted)
    }

    /// The same of some of the rays (as bits); of the others as if they hit nothing. What
    /// one hits does not depend on which others are asked for.
    #[doc(hidden)]
    pub fn closest_some(
        &self,
        rays: &[Ray],
        some: u16,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        self.trace(rays, some, false, wanted)
    }

    /// The same of rays that start outside the part, or `anywhere`.
    pub(super) fn trace(
        &self,
        rays: &[Ray],
        some: u16,
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        if rays.is_empty() {
            return [None; WIDTH];
        }
        match &self.copies {
            None => self.hierarchy.closest(rays, some, anywhere, wanted),
            Some(copies) => {
                let wanted = |i: usize, t| some >> i & 1 == 1 && wanted(i, t);
                self.closest_of(copies, rays, anywhere, wanted)
            }
        }
    }

    /// Calls `each` with what the rays of each packet meet, as [`Self::closest`] has it, packet by
    /// packet; they start outside the part, or `anywhere`. The memory with the triangles of one packet is on its way
    /// while the next are traced.
    pub(crate) fn trace_in_turn<P: AsRef<[Ray]>>(
        &self,
        packets: impl Iterator<Item = P>,
        anywhere: bool,
        mut each: impl FnMut(&[Option<Hit>; WIDTH]),
    ) {
        let all = |_, _| true;
        if self.copies.is_some() {
            return packets
                .for_each(|rays| each(&self.trace(rays.as_ref(), u16::MAX, anywhere, all)));
        }
        // One is traced, one before it waits for its triangles, and one for their corners.
        let mut found: [Unsettled; 3] = Default::default();
        let mut count = 0;
        for rays in packets {
            let [this, last, before] = [0, 2, 1].map(|back| (count + back) % 3);
            (self.hierarchy).find(rays.as_ref(), u16::MAX, anywhere, all, &mut found[this]);
            if count > 0 {
                self.hierarchy.fetch(&mut found[last]);
            }
            if count > 1 {
                each(&self.hierarchy.settle(&found[before], all));
            }
            count += 1;
        }
        if let Some(last) = count.checked_sub(1) {
            self.hierarchy.fetch(&mut found[last % 3]);
        }
        for packet in count.saturating_sub(2)..count {
            each(&self.hierarchy.settle(&found[packet % 3], all));
        }
    }

    fn closest_of(
        &self,
        copies: &Copies,
        rays: &[Ray],
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let nothing = Met {
            t: f64::INFINITY,
            copy: u32::MAX,
            hit: None,
        };
        let mut met = [nothing; WIDTH];
        copies.along(rays, |copy, some, packet| {
            let pose = &copies.poses()[copy as usize];
            // Beyond what is met by more than f32 rounds, since a hit nearer by less
            // counts.
            let slack = 4.0 * self.resolution();
            let mut local = Local::new(rays, some, pose);
            for k in 0..local.count {
                let ray = &mut local.rays[k];
                ray.t_max = ray.t_max.min(met[local.of[k]].t + slack);
            }
            let unwanted = [const { Cell::new(f64::INFINITY) }; WIDTH];
            let hits = self
                .hierarchy
                .closest(local.rays(), u16::MAX, anywhere, |k, t| {
                    let wanted = wanted(local.of[k], t);
                    if !wanted {
                        unwanted[k].set(t);
                    }
                    wanted
                });
            for (k, &i) in local.of().iter().enumerate() {
                // Of a hit that is not wanted it still counts that it hides others.
                let hit = hits[k].filter(|hit| hit.t <= unwanted[k].get());
                let t = hit.map_or(unwanted[k].get(), |hit| hit.t);
                if (t, copy) < (met[i].t, met[i].copy) {
                    let hit = hit.map(|hit| moved(hit, copy, pose));
                    met[i] = Met { t, copy, hit };
                    packet.shorten(i, t);
                }
            }
        });
        met.map(|met| met.hit)
    }

    /// Whether each of up to 16 coherent rays meets anything, as bits.
    #[doc(hidden)]
    pub fn occluded(&self, rays: &[Ray]) -> u16 {
        if rays.is_empty() {
            return 0;
        }
        let Some(copies) = &self.copies else {
            return self.hierarchy.occluded(rays);
        };
        let mut blocked = 0;
        copies.along(rays, |copy, some, packet| {
            let local = Local::new(rays, some, &copies.poses()[copy as usize]);
            let bits = self.hierarchy.occluded(local.rays());
            for (k, &i) in local.of().iter().enumerate() {
                if bits >> k & 1 == 1 {
                    blocked |= 1 << i;
                    packet.end(i);
                }
            }
        });
        blocked
    }

    /// The point of the part nearest to `p`, in f64; of several, that of the first
    /// triangle. A triangle close to `p`, if one is known, makes the search shorter.
    #[doc(hidden)]
    pub fn nearest(&self, p: DVec3, close: Option<Face>) -> Nearest {
        let nothing = |point| Nearest {
            face: Face {
                copy: u32::MAX,
                triangle: u32::MAX,
            },
            point,
            distance: f64::INFINITY,
        };
        let Some(copies) = &self.copies else {
            let known = close.map(|face| self.hierarchy.nearest_on(face.triangle, p));
            return self.hierarchy.nearest(p, known.unwrap_or(nothing(p)));
        };
        let pose = |copy: u32| &copies.poses()[copy as usize];
        let placed = |copy: u32, found: Nearest| Nearest {
            face: Face { copy, ..found.face },
            point: pose(copy).point(found.point),
            ..found
        };
        let known = close.map(|Face { copy, triangle }| {
            let local = pose(copy).inverse().point(p);
            placed(copy, self.hierarchy.nearest_on(triangle, local))
        });
        let mut best = known.unwrap_or(nothing(p));
        copies.around(p, best.distance, |copy| {
            let local = pose(copy).inverse().point(p);
            let bound = Nearest {
                distance: best.distance,
                ..nothing(local)
            };
            let found = self.hierarchy.nearest(local, bound);
            let found = placed(copy, found);
            if found.face.triangle != u32::MAX
                && (found.distance, found.face) < (best.distance, best.face)
            {
                best = found;
            }
            best.distance
        });
        best
    }

    /// The way out of the part at a point of a face, any length: the part of its surface to
    /// which the face belongs has a point outside it, whose nearest point this is, on that
    /// side (see [`Shell::outward`]). `None` where the mesh is open or wound both ways, so
    /// that it has no inside.
    #[doc(hidden)]
    pub fn outward(&self, face: Face, point: DVec3) -> Option<DVec3> {
        let shell = self.shell.get_or_init(|| Shell::of(self.mesh())).as_ref()?;
        let outward = |point| shell.outward(self.mesh(), face.triangle, point);
        let normal = match &self.copies {
            None => outward(point),
            Some(copies) => {
                let pose = &copies.poses()[face.copy as usize];
                pose.vector(outward(pose.inverse().point(point)))
            }
        };
        (normal != DVec3::ZERO).then_some(normal)
    }

    /// Reports every triangle that may touch all of `volume` (at most 32 half-spaces),
    /// as [`Clusters::touching`] does; `clusters` are the mesh's. Costs what the copies
    /// that are touched cost.
    #[doc(hidden)]
    pub fn touching(
        &self,
        clusters: &Clusters,
        volume: &[HalfSpace],
        detail: f64,
        mut found: impl FnMut(Found),
    ) {
        let Some(copies) = &self.copies else {
            return clusters.touching(volume, detail, found);
        };
        copies.touching(volume, |copy| {
            let pose = &copies.poses()[copy as usize];
            let volume: SmallVec<[HalfSpace; 32]> =
                volume.iter().map(|half| half.seen_from(pose)).collect();
            clusters.touching(&volume, detail, |what| {
                found(match what {
                    Found::Triangle { face, crossed } => Found::Triangle {
                        face: Face { copy, ..face },
                        crossed,
                    },
                    Found::Ball { center, radius } => Found::Ball {
                        center: pose.point(center),
                        radius,
                    },
                });
            });
        });
    }
}

/// Some rays of a packet, in a copy's frame.
struct Local {
    rays: [Ray; WIDTH],
    /// Their numbers in the packet.
    of: [usize; WIDTH],
    count: usize,
}

impl Local {
    /// Those of the set bits.
    #[inline(always)]
    fn new(rays: &[Ray], some: u16, pose: &Rigid) -> Local {
        let copy_from_part = pose.inverse();
        let mut local = Local {
            rays: [rays[0]; WIDTH],
            of: [0; WIDTH],
            count: 0,
        };
        for (i, ray) in rays.iter().enumerate() {
            if some >> i & 1 == 1 {
                local.rays[local.count] = Ray {
                    origin: copy_from_part.point(ray.origin),
                    direction: copy_from_part.vector(ray.direction),
                    ..*ray
                };
                local.of[local.count] = i;
                local.count += 1;
            }
        }
        local
    }

    fn rays(&self) -> &[Ray] {
        &self.rays[..self.count]
    }

    fn of(&self) -> &[usize] {
        &self.of[..self.count]
    }
}

/// A copy's hit in the part's frame.
fn moved(hit: Hit, copy: u32, pose: &Rigid) -> Hit {
    Hit {
        face: Face { copy, ..hit.face },
        point: pose.point(hit.point),
        normal: pose.vector(hit.normal),
        ..hit
    }
}

#[cfg(test)]
#[path = "assembly_tests.rs"]
mod tests;
