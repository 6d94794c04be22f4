//! Public view of the part: one mesh, or instances of it that share its hierarchy.

use super::hierarchy::{Backend, Hierarchy, PacketCandidates};
use super::instances::{self, InstanceBvh};
use super::{ClusterHit, HalfSpace, Hit, Nearest, Ray, TriangleClusters, TriangleId, WIDTH};
use crate::error::{Error, Result};
use crate::math::{Aabb, DVec3, Rigid};
use crate::mesh::{MAX_COORDINATE_MM, Mesh, ProgressFn, Pseudonormals, check_positions, memory};
use smallvec::SmallVec;
use std::cell::Cell;
use std::ops::ControlFlow;
use std::sync::{Arc, OnceLock};

/// Bounding volume hierarchy over a part: a mesh or instances of it.
///
/// All points, rays and planes are in the frame of the part, in which the instances are posed.
pub struct Accel {
    pub(super) hierarchy: Hierarchy,
    /// Instances; `None` for the mesh itself in its own frame.
    pub(super) copies: Option<InstanceBvh>,
    /// Pseudonormals, computed at the first use; `None` if the mesh has no inside.
    shell: OnceLock<Option<Pseudonormals>>,
    /// Number of edges with an odd number of triangles, counted at the first use.
    pub(super) odd_edges: OnceLock<usize>,
    /// Hierarchy of the nominal geometry; `None` for a part that is its own reference.
    nominal: Option<Arc<Accel>>,
}

/// Nearest hit of a ray until now.
#[derive(Clone, Copy)]
struct PacketHit {
    t: f64,
    copy: u32,
    /// Hit; `None` if nothing is hit, or if the hit is not wanted.
    hit: Option<Hit>,
}

impl Accel {
    /// Builds the hierarchy by [`Self::build_with`] and the default backend: Embree if it is
    /// compiled in.
    pub fn build(mesh: &Arc<Mesh>, threads: usize) -> Result<Accel> {
        Accel::build_with(Backend::default(), mesh, threads, &|_| Ok(()))
    }

    /// Builds the hierarchy of a part that consists of the mesh.
    ///
    /// Embree uses `threads` threads. The Rust backend uses the rayon pool and calls `watch` only
    /// at the end. Returns `Error::Memory` if memory is insufficient, the errors of Embree, and the
    /// errors of `watch`.
    pub fn build_with(
        backend: Backend,
        mesh: &Arc<Mesh>,
        threads: usize,
        watch: &ProgressFn,
    ) -> Result<Accel> {
        Ok(Accel {
            hierarchy: Hierarchy::build(backend, mesh, threads, watch)?,
            copies: None,
            shell: OnceLock::new(),
            odd_edges: OnceLock::new(),
            nominal: None,
        })
    }

    /// Sets the nominal geometry, in the frame of the part, that measured points are compared with.
    pub(crate) fn with_nominal(self, nominal: Accel) -> Accel {
        Accel {
            nominal: Some(Arc::new(nominal)),
            ..self
        }
    }

    /// Returns the nominal geometry; the part itself if it has no other.
    pub fn nominal(&self) -> &Accel {
        self.nominal.as_deref().unwrap_or(self)
    }

    /// Reuses the hierarchy for instances of the mesh at these poses (part_from_copy, at least
    /// one).
    ///
    /// This takes about 80 bytes per instance in addition to the poses. Returns `Error::Memory` if
    /// memory is insufficient. Returns `Error::Usage` for no pose, for 2³² − 1 poses or more, and
    /// for a pose beyond 10¹² mm, with its index.
    pub fn with_copies(self, poses: impl Into<Arc<[Rigid]>>) -> Result<Accel> {
        let poses = poses.into();
        if poses.is_empty() || poses.len() >= u32::MAX as usize {
            return Err(Error::Usage(format!(
                "{} instances, expected 1 to 4294967294",
                poses.len()
            )));
        }
        for (i, pose) in poses.iter().enumerate() {
            check_pose(i, pose)?;
        }
        let copies = match is_mesh_alone(&poses) {
            true => None,
            false => {
                let (count, bytes) = (poses.len() as u64, instances::BUILD);
                let work = format!("placing {count} copies at {bytes} bytes each");
                memory::require(work, count * bytes, memory::available())?;
                Some(InstanceBvh::new(poses, &self.hierarchy.part().bounds))
            }
        };
        Ok(Accel { copies, ..self })
    }

    /// Moves instances to new poses (part_from_copy), given with their indices. A mesh without
    /// instances is instance 0.
    ///
    /// The hierarchy of the mesh stays, and only boxes around the instances are computed.
    /// Results are equal to the results after [`Self::with_copies`] with all poses.
    ///
    /// # Errors
    /// Returns `Error::Usage` for an index without an instance, and for a pose beyond 10¹² mm. No
    /// instance is then moved.
    ///
    /// ```
    /// use lasertrace::{Accel, DVec3, Mesh, Rigid};
    ///
    /// let mesh = Mesh::from_triangles([DVec3::ZERO, DVec3::X, DVec3::Y], [[0, 1, 2]])?;
    /// let mut accel = Accel::build(&mesh.into(), 1)?.with_copies(vec![Rigid::IDENTITY; 2])?;
    /// accel.move_instances([(1, Rigid::translation(4.0 * DVec3::Z))])?;
    /// assert_eq!(accel.bounds().max.z, 4.0);
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn move_instances(
        &mut self,
        moves: impl IntoIterator<Item = (usize, Rigid)>,
    ) -> Result<()> {
        let mut poses = self.poses().to_vec();
        let count = poses.len();
        for (i, pose) in moves {
            check_pose(i, &pose)?;
            *poses.get_mut(i).ok_or_else(|| {
                Error::Usage(format!(
                    "instance {i} does not exist, expected an index below {count}"
                ))
            })? = pose;
        }
        let mesh = self.hierarchy.part().bounds;
        match &mut self.copies {
            _ if is_mesh_alone(&poses) => self.copies = None,
            None => self.copies = Some(InstanceBvh::new(poses.into(), &mesh)),
            Some(copies) => copies.update(poses.into(), &mesh),
        }
        Ok(())
    }

    /// Adapts the hierarchy to moved vertices: `positions` (mm) in the frame of the mesh, one for
    /// each vertex. The triangles stay.
    ///
    /// The tree keeps its shape, and its boxes are fitted to the new positions. With Embree, the first
    /// refit builds the hierarchy in the form that Embree can refit. Hits are equal to the hits after
    /// a new build.
    ///
    /// # Errors
    /// Returns `Error::Usage` with the index of the vertex if it is not finite or beyond 10¹² mm,
    /// or if it is farther from its position at the build than 5 % of the largest side of the
    /// part at the build. Rays would then be slow to trace. Returns `Error::Usage` for a different
    /// number of positions, and the errors of Embree.
    ///
    /// ```
    /// use lasertrace::{Accel, DVec3, Mesh};
    ///
    /// let corners = [DVec3::ZERO, 10.0 * DVec3::X, 10.0 * DVec3::Y];
    /// let accel = Accel::build(&Mesh::from_triangles(corners, [[0, 1, 2]])?.into(), 1)?;
    /// let accel = accel.refit(corners.map(|corner| corner + 0.3 * DVec3::Z))?;
    /// assert_eq!(accel.bounds().min.z, 0.3);
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn refit(self, positions: impl IntoIterator<Item = DVec3>) -> Result<Accel> {
        let positions: Vec<DVec3> = positions.into_iter().collect();
        let (found, expected) = (positions.len(), self.mesh().positions.len());
        if found != expected {
            return Err(Error::Usage(format!(
                "{found} positions, expected {expected}, one for each vertex of the mesh"
            )));
        }
        check_positions(&positions)?;
        let hierarchy = self.hierarchy.refit(positions)?;
        let mut copies = self.copies;
        if let Some(copies) = &mut copies {
            copies.update(copies.poses().into(), &hierarchy.part().bounds);
        }
        Ok(Accel {
            hierarchy,
            copies,
            shell: OnceLock::new(),
            odd_edges: OnceLock::new(),
            nominal: self.nominal,
        })
    }

    /// Returns the mesh, in its own frame.
    pub fn mesh(&self) -> &Arc<Mesh> {
        self.hierarchy.mesh()
    }

    /// Returns the poses of the instances: part_from_copy.
    pub fn poses(&self) -> &[Rigid] {
        match &self.copies {
            None => &[Rigid::IDENTITY],
            Some(copies) => copies.poses(),
        }
    }

    /// Returns the corners of a triangle in the frame of the part.
    pub fn corners(&self, face: TriangleId) -> [DVec3; 3] {
        let corners = self.mesh().triangle(face.triangle as usize);
        match &self.copies {
            None => corners,
            Some(copies) => corners.map(|corner| copies.poses()[face.copy as usize].point(corner)),
        }
    }

    /// Returns a box around the part. For a single mesh it is the smallest box; otherwise it
    /// encloses the transformed boxes of the instances.
    pub fn bounds(&self) -> Aabb {
        match &self.copies {
            None => self.hierarchy.part().bounds,
            Some(copies) => copies.bounds(),
        }
    }

    /// Returns the largest absolute coordinate of the part, of the mesh in its own frame, and of
    /// the poses, mm.
    #[doc(hidden)]
    pub fn largest_coordinate(&self) -> f64 {
        let (mesh, part) = (self.hierarchy.part().bounds, self.bounds());
        let moved = self
            .copies
            .as_ref()
            .map_or(0.0, InstanceBvh::largest_translation);
        let places = [mesh.min, mesh.max, part.min, part.max];
        places
            .map(|p| p.abs().max_element())
            .into_iter()
            .fold(moved, f64::max)
    }

    /// Returns a length (mm) that f32 cannot resolve on this mesh: 2⁻²⁰ of the largest coordinate
    /// from its center, eight rounding errors of a vertex.
    ///
    /// Shadow rays start at this distance from their surface. No hit point is farther from its
    /// triangle.
    pub fn resolution(&self) -> f64 {
        self.hierarchy.part().resolution()
    }

    /// Returns the largest accepted difference between the distance from the backend and the
    /// refined distance, mm.
    #[doc(hidden)]
    pub fn refinement(&self) -> f64 {
        self.hierarchy.part().refinement()
    }

    /// Returns the nearest hit of each of up to 16 coherent rays, refined in f64.
    ///
    /// A hit is returned only if `wanted(ray, t)` holds, where t is within [`Self::refinement`] of
    /// the final distance. Otherwise the result is `None`. If instances touch, the first one is
    /// returned. A triangle that the ray misses in f64 is not hit.
    ///
    /// A hit may be lost within the f32 resolution of an outline, and at a vertex of an open mesh
    /// (LIMITS.md).
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

    /// Returns the hits as [`Self::closest`] does for the rays selected by the bits of `some`, and
    /// `None` for all others. The hit of a ray does not depend on which other rays are selected.
    #[doc(hidden)]
    pub fn closest_some(
        &self,
        rays: &[Ray],
        some: u16,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        self.trace(rays, some, false, wanted)
    }

    /// Returns the hits as [`Self::closest_some`] does. The rays must start outside the part unless
    /// `anywhere` is true.
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

    /// Builds what [`Hierarchy::along`] needs, at the first use.
    pub(super) fn prepare_crossings(&self) -> Result<()> {
        self.hierarchy.prepare_along()
    }

    /// Calls `each` with the hits of each packet, in order, as [`Self::closest`] returns them.
    ///
    /// The rays must start outside the part unless `anywhere` is true. The triangles of one packet
    /// are prefetched while the next packets are traced.
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
        // One packet is traced, one waits for its triangles, and one for their corners.
        let mut found: [PacketCandidates; 3] = Default::default();
        let mut count = 0;
        for rays in packets {
            let [this, last, before] = [0, 2, 1].map(|back| (count + back) % 3);
            (self.hierarchy).find(rays.as_ref(), u16::MAX, anywhere, all, &mut found[this]);
            if count > 0 {
                self.hierarchy.prefetch(&mut found[last]);
            }
            if count > 1 {
                each(&self.hierarchy.refine_hits(&found[before], all));
            }
            count += 1;
        }
        if let Some(last) = count.checked_sub(1) {
            self.hierarchy.prefetch(&mut found[last % 3]);
        }
        for packet in count.saturating_sub(2)..count {
            each(&self.hierarchy.refine_hits(&found[packet % 3], all));
        }
    }

    fn closest_of(
        &self,
        copies: &InstanceBvh,
        rays: &[Ray],
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let nothing = PacketHit {
            t: f64::INFINITY,
            copy: u32::MAX,
            hit: None,
        };
        let mut met = [nothing; WIDTH];
        copies.along(rays, |copy, some, packet| {
            let pose = &copies.poses()[copy as usize];
            // The margin exceeds the f32 rounding error, so a hit that is nearer by less is kept.
            let slack = 4.0 * self.resolution();
            let mut local = InstanceRays::new(rays, some, pose);
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
                // An unwanted hit still occludes others.
                let hit = hits[k].filter(|hit| hit.t <= unwanted[k].get());
                let t = hit.map_or(unwanted[k].get(), |hit| hit.t);
                if (t, copy) < (met[i].t, met[i].copy) {
                    let hit = hit.map(|hit| moved(hit, copy, pose));
                    met[i] = PacketHit { t, copy, hit };
                    packet.shorten(i, t);
                }
            }
        });
        met.map(|met| met.hit)
    }

    /// Returns, as bits, whether each of up to 16 coherent rays hits anything.
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
            let local = InstanceRays::new(rays, some, &copies.poses()[copy as usize]);
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

    /// Returns the point of the part nearest to `p`, in f64. On equal distances it is on the first
    /// triangle. A known triangle close to `p` shortens the search.
    #[doc(hidden)]
    pub fn nearest(&self, p: DVec3, close: Option<TriangleId>) -> Nearest {
        let nothing = |point| Nearest {
            face: TriangleId {
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
            face: TriangleId { copy, ..found.face },
            point: pose(copy).point(found.point),
            ..found
        };
        let known = close.map(|TriangleId { copy, triangle }| {
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

    /// Returns the outward direction of the part at a point of a face, of any length.
    ///
    /// A query point outside, whose nearest surface point this is, lies on the side of this
    /// direction (see [`Pseudonormals::outward`]). Returns `None` if the mesh is open or inconsistently
    /// wound, since it then has no inside.
    #[doc(hidden)]
    pub fn outward(&self, face: TriangleId, point: DVec3) -> Option<DVec3> {
        let shell = self
            .shell
            .get_or_init(|| Pseudonormals::of(self.mesh()))
            .as_ref()?;
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

    /// Reports every triangle that may touch the intersection of the half-spaces `volume` (at most
    /// 32), as [`TriangleClusters::touching_until`] does. `clusters` are the clusters of the mesh. The cost is
    /// the sum over the instances that are touched.
    #[doc(hidden)]
    pub fn touching(
        &self,
        clusters: &TriangleClusters,
        volume: &[HalfSpace],
        detail: f64,
        mut found: impl FnMut(ClusterHit),
    ) {
        let _ = self.touching_until(clusters, volume, detail, &mut |hit| {
            found(hit);
            ControlFlow::Continue(())
        });
    }

    /// Returns true if `test` accepts a triangle that may touch the intersection of the half-spaces.
    /// The search ends at the first such triangle.
    pub(crate) fn touches(
        &self,
        clusters: &TriangleClusters,
        volume: &[HalfSpace],
        mut test: impl FnMut(TriangleId) -> bool,
    ) -> bool {
        // A group of triangles whose box has no extent has no area.
        let search = self.touching_until(clusters, volume, 0.0, &mut |hit| match hit {
            ClusterHit::Triangle { face, .. } if test(face) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        });
        search.is_break()
    }

    fn touching_until(
        &self,
        clusters: &TriangleClusters,
        volume: &[HalfSpace],
        detail: f64,
        found: &mut impl FnMut(ClusterHit) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let Some(copies) = &self.copies else {
            return clusters.touching_until(volume, detail, found);
        };
        copies.touching_until(volume, |copy| {
            let pose = &copies.poses()[copy as usize];
            let volume: SmallVec<[HalfSpace; 32]> =
                volume.iter().map(|half| half.seen_from(pose)).collect();
            clusters.touching_until(&volume, detail, |what| {
                found(match what {
                    ClusterHit::Triangle { face, crossed } => ClusterHit::Triangle {
                        face: TriangleId { copy, ..face },
                        crossed,
                    },
                    ClusterHit::Ball { center, radius } => ClusterHit::Ball {
                        center: pose.point(center),
                        radius,
                    },
                })
            })
        })
    }
}

/// True if the part is the mesh in its own frame.
fn is_mesh_alone(poses: &[Rigid]) -> bool {
    matches!(poses, [pose] if *pose == Rigid::IDENTITY)
}

fn check_pose(i: usize, pose: &Rigid) -> Result<()> {
    let by = pose.translation;
    if by.is_nan() || by.abs().max_element() > MAX_COORDINATE_MM {
        return Err(Error::Usage(format!(
            "instance {i} is moved by {by}, expected finite lengths within 1e12 mm"
        )));
    }
    Ok(())
}

/// Selected rays of a packet, in the frame of an instance.
struct InstanceRays {
    rays: [Ray; WIDTH],
    /// Indices of the rays in the packet.
    of: [usize; WIDTH],
    count: usize,
}

impl InstanceRays {
    /// Selects the rays of the set bits.
    #[inline(always)]
    fn new(rays: &[Ray], some: u16, pose: &Rigid) -> InstanceRays {
        let copy_from_part = pose.inverse();
        let mut local = InstanceRays {
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

/// Transforms the hit of an instance into the frame of the part.
fn moved(hit: Hit, copy: u32, pose: &Rigid) -> Hit {
    Hit {
        face: TriangleId { copy, ..hit.face },
        point: pose.point(hit.point),
        normal: pose.vector(hit.normal),
        ..hit
    }
}

#[cfg(test)]
#[path = "assembly_tests.rs"]
mod tests;
