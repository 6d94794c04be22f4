//! Embree behind the shim of `ffi/`. Vertices are centered on the mesh before conversion to f32, so
//! that a distant part loses no precision.

#![allow(unsafe_code)]

use super::embree_device::{Device, ffi, reported};
use super::packet_soa::{ClippedPacket, RayPacketSoA};
use super::part_bounds::{Facing, PartBounds};
use super::quads::Quads;
use super::refine::nearest_on_triangle;
use super::{Nearest, Ray, TriangleId, WIDTH};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::{Mesh, ProgressFn};
use rayon::prelude::*;
use smallvec::SmallVec;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex};

/// Embree scene of one mesh.
pub struct EmbreeScene {
    pub(super) scene: ffi::RTCScene,
    // Dropped after `scene` is released in `drop`.
    pub(super) device: Arc<Device>,
    mesh: Arc<Mesh>,
    /// Mesh for which the scene was made. It owns the triangles that the scene refers to unless
    /// there are quads.
    made_of: Arc<Mesh>,
    quads: Option<Quads>,
}

/// Progress callback of a build, and the error with which it stopped the build.
struct BuildMonitor<'a> {
    watch: &'a ProgressFn<'a>,
    error: Mutex<Option<Error>>,
}

unsafe extern "C" fn tell(watched: *mut c_void, share: f64) -> bool {
    // SAFETY: `watched` is the `Watched` passed to lt_scene_on_progress. It outlives the commit and
    // is only read.
    let watched = unsafe { &*(watched as *const BuildMonitor) };
    match (watched.watch)(share) {
        Ok(()) => true,
        Err(error) => {
            let mut first = watched.error.lock().unwrap_or_else(|p| p.into_inner());
            first.get_or_insert(error);
            false
        }
    }
}

// SAFETY: Embree scenes may be queried from many threads once committed, and this module does not
// modify a scene after that.
unsafe impl Send for EmbreeScene {}
// SAFETY: as above.
unsafe impl Sync for EmbreeScene {}

impl Drop for EmbreeScene {
    fn drop(&mut self) {
        // SAFETY: the handle is live and released only here.
        unsafe { ffi::lt_scene_release(self.scene) }
    }
}

#[repr(align(64))]
pub(super) struct Valid(pub(super) [i32; WIDTH]);

/// Bytes per triangle while the hierarchy is built: 67 for nodes and leaves, 6 for vertices, 32 for
/// sorting.
pub(super) const BUILD: u64 = 105;

impl EmbreeScene {
    /// Builds the hierarchy with `threads` threads. Returns the errors of Embree, such as
    /// insufficient memory, and the errors of `watch`.
    pub(super) fn build(
        mesh: &Arc<Mesh>,
        part: &PartBounds,
        threads: usize,
        watch: &ProgressFn,
    ) -> Result<EmbreeScene> {
        let tree =
            EmbreeScene::filled(Device::common(threads)?, mesh, Quads::of(mesh), part, true)?;
        tree.commit(watch)?;
        Ok(tree)
    }

    /// Creates a scene of the mesh, or of its quads, which is not yet committed.
    pub(super) fn filled(
        device: Arc<Device>,
        mesh: &Arc<Mesh>,
        quads: Option<Quads>,
        part: &PartBounds,
        robust: bool,
    ) -> Result<EmbreeScene> {
        let vertices = mesh.positions.len();
        let mut vertex_buffer = std::ptr::null_mut();
        let (faces, indices) = match &quads {
            None => (mesh.triangles.len(), mesh.triangles.as_ptr().cast()),
            Some(quads) => (quads.len(), quads.as_ptr()),
        };
        // SAFETY: the device is live, and the out-pointer is valid for the call. The tree that
        // releases the scene owns the mesh and the quads, so the memory that Embree reads is not
        // moved or freed.
        let scene = reported(|| unsafe {
            ffi::lt_mesh_scene_new(
                device.handle,
                robust,
                vertices,
                &mut vertex_buffer,
                quads.is_some(),
                faces,
                indices,
            )
        })?;
        if scene.is_null() {
            return Err(Error::Embree("cannot make a scene".into()));
        }
        let tree = EmbreeScene {
            scene,
            device,
            mesh: mesh.clone(),
            made_of: mesh.clone(),
            quads,
        };
        // SAFETY: the buffer was just created for these vertices.
        unsafe { tree.fill(vertex_buffer, part) };
        Ok(tree)
    }

    /// Writes the vertices of the mesh to the buffer of the scene.
    ///
    /// # Safety
    /// The buffer must be the vertex buffer of the scene, and no other thread may use the scene.
    unsafe fn fill(&self, vertex_buffer: *mut f32, part: &PartBounds) {
        let vertices = self.mesh.positions.len();
        // SAFETY: the buffer has `vertices` times three floats, is aligned to 4 bytes, and lives as
        // long as the scene. No other code reads or writes it before the commit. Embree may leave
        // it uninitialized, hence `MaybeUninit`.
        let vertex_buffer: &mut [MaybeUninit<[f32; 3]>] =
            unsafe { std::slice::from_raw_parts_mut(vertex_buffer.cast(), vertices) };
        (vertex_buffer.par_iter_mut().zip(&self.mesh.positions)).for_each(|(out, p)| {
            out.write((*p - part.center).as_vec3().to_array());
        });
    }

    /// Adapts the hierarchy to moved vertices of the mesh. The first call builds it in the form
    /// that Embree can refit.
    pub(super) fn refit(&mut self, mesh: &Arc<Mesh>, part: &PartBounds) -> Result<()> {
        assert_eq!(mesh.positions.len(), self.made_of.positions.len());
        self.mesh = mesh.clone();
        // SAFETY: the scene is live, and the exclusive reference excludes other threads. The buffer
        // has the length of the vertices at the creation of the scene.
        unsafe {
            let vertex_buffer = reported(|| ffi::lt_mesh_scene_vertices(self.scene))?;
            if vertex_buffer.is_null() {
                return Err(Error::Embree("cannot read the vertices of a scene".into()));
            }
            self.fill(vertex_buffer, part);
            reported(|| ffi::lt_mesh_scene_moved(self.scene))?;
        }
        self.commit(&|_| Ok(()))
    }

    pub(super) fn commit(&self, watch: &ProgressFn) -> Result<()> {
        let watched = BuildMonitor {
            watch,
            error: Mutex::default(),
        };
        // SAFETY: the scene is live and its buffers are filled. `watched` outlives the calls, after
        // which nothing refers to it.
        let committed = reported(|| unsafe {
            let user = &watched as *const BuildMonitor as *mut c_void;
            ffi::lt_scene_on_progress(self.scene, Some(tell), user);
            ffi::lt_scene_commit(self.scene);
            ffi::lt_scene_on_progress(self.scene, None, std::ptr::null_mut());
        });
        let stopped = watched
            .error
            .into_inner()
            .unwrap_or_else(|p| p.into_inner());
        stopped.map_or(committed, Err)
    }

    /// Returns the number of rays that are traced together. The other rays of such a group can
    /// determine which of two triangles at equal distance is hit.
    pub(super) fn together(&self) -> usize {
        self.device.packet as usize
    }

    /// Returns the bits of all rays that are traced in a group with a ray of `some`.
    fn beside(&self, some: u16) -> u16 {
        let packets = (0..WIDTH).step_by(self.together());
        let packets = packets.map(|first| u16::MAX >> (WIDTH - self.together()) << first);
        packets.filter(|bits| bits & some != 0).sum()
    }

    /// Fills a packet with the rays of the set bits, in place because copying it takes time.
    ///
    /// Other lanes have a negative length: without AVX, Embree 3 ignores the valid mask and skips
    /// only rays of negative length.
    fn pack(inside: &ClippedPacket, some: u16, packet: &mut ffi::RTCRay16) -> Valid {
        let mut valid = Valid([0; WIDTH]);
        let traced = |i: usize| some >> i & 1 == 1 && inside.length[i] >= 0.0;
        for (i, valid) in valid.0.iter_mut().enumerate() {
            *valid = -i32::from(traced(i));
        }
        let [x, y, z] = inside.origin;
        (packet.org_x, packet.org_y, packet.org_z) = (x, y, z);
        let [x, y, z] = inside.direction;
        (packet.dir_x, packet.dir_y, packet.dir_z) = (x, y, z);
        packet.tfar = std::array::from_fn(|i| match valid.0[i] {
            0 => -1.0,
            _ => inside.length[i] as f32,
        });
        packet.mask = [u32::MAX; WIDTH];
        valid
    }

    pub(super) fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Calls `found` for each ray that hits the mesh and is traced in a group with a ray of `some`
    /// (bits).
    ///
    /// The arguments are the index of the ray, the triangle, the distance (mm), and the side of the
    /// triangle that is hit.
    pub(super) fn closest(
        &self,
        rays: &RayPacketSoA,
        some: u16,
        part: &PartBounds,
        mut found: impl FnMut(usize, u32, f64, Facing),
    ) {
        let together = rays.together(part);
        // SAFETY: RTCRayHit16 consists of floats and integers, for which all-zero bytes are valid.
        let mut packet: ffi::RTCRayHit16 = unsafe { std::mem::zeroed() };
        let inside = rays.inside(part, together.approach);
        let asked = self.beside(some) & rays.there();
        let valid = EmbreeScene::pack(&inside, asked, &mut packet.ray);
        packet.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
        // SAFETY: the scene is live and committed. Both structs are 64-byte aligned and have the
        // layout of the linked library.
        unsafe {
            ffi::lt_intersect16(
                self.scene,
                together.coherent,
                self.device.packet,
                valid.0.as_ptr(),
                &mut packet,
            )
        };
        let (ray, hit) = (&packet.ray, &packet.hit);
        for i in 0..WIDTH {
            if hit.geomID[i] != ffi::LT_NO_GEOMETRY {
                let t = inside.advanced[i] + ray.tfar[i] as f64;
                let along = hit.Ng_x[i] * ray.dir_x[i]
                    + hit.Ng_y[i] * ray.dir_y[i]
                    + hit.Ng_z[i] * ray.dir_z[i];
                let side = if along > 0.0 {
                    Facing::Back
                } else {
                    Facing::Front
                };
                let triangle = match &self.quads {
                    None => hit.primID[i],
                    Some(quads) => quads.triangle(hit.primID[i], hit.u[i], hit.v[i]),
                };
                found(i, triangle, t, side);
            }
        }
    }

    /// Returns the bits of the rays that start inside the mesh, from whose origin a probe ray first
    /// hits a back.
    ///
    /// The result may be wrong for an origin on the surface, to the last digits of f32. It has no
    /// meaning for open meshes.
    pub(super) fn starting_inside(&self, rays: &[Ray], part: &PartBounds) -> u16 {
        // Arbitrary direction that is unlikely to align with a part or a ray.
        const SOMEWHERE: DVec3 = DVec3::new(0.324_717_957, 0.430_159_709, 0.842_330_621);
        let mut probes: SmallVec<[Ray; WIDTH]> = SmallVec::new();
        let mut asked: SmallVec<[(usize, usize); WIDTH]> = SmallVec::new();
        for (i, ray) in rays.iter().enumerate() {
            let bounds = part.bounds;
            if ray.origin.cmplt(bounds.min).any() || ray.origin.cmpgt(bounds.max).any() {
                continue;
            }
            if probes.last().is_none_or(|probe| probe.origin != ray.origin) {
                probes.push(Ray {
                    direction: SOMEWHERE,
                    t_max: f64::INFINITY,
                    ..*ray
                });
            }
            asked.push((i, probes.len() - 1));
        }
        if probes.is_empty() {
            return 0;
        }
        let mut backs = 0;
        self.closest(
            &RayPacketSoA::new(&probes),
            u16::MAX,
            part,
            |i, _, _, side| {
                backs |= u16::from(side == Facing::Back) << i;
            },
        );
        let bits = asked.iter().map(|&(i, probe)| (backs >> probe & 1) << i);
        bits.sum()
    }

    /// Returns, as bits, whether each of up to 16 coherent rays hits anything.
    pub(super) fn occluded(&self, rays: &RayPacketSoA, part: &PartBounds) -> u16 {
        let together = rays.together(part);
        // SAFETY: as in `closest`.
        let mut packet: ffi::RTCRay16 = unsafe { std::mem::zeroed() };
        let inside = rays.inside(part, together.approach);
        let valid = EmbreeScene::pack(&inside, rays.there(), &mut packet);
        // SAFETY: as in `closest`.
        unsafe {
            ffi::lt_occluded16(
                self.scene,
                true,
                self.device.packet,
                valid.0.as_ptr(),
                &mut packet,
            )
        };
        // Embree sets tfar to −∞ on a hit. Before that, no traced ray has this value.
        (0..WIDTH)
            .filter(|&i| packet.tfar[i] == f32::NEG_INFINITY)
            .fold(0, |bits, i| bits | 1 << i)
    }

    /// Returns the point of the mesh nearest to `p`, in f64, or `best` if no point is nearer.
    pub(super) fn nearest(&self, p: DVec3, part: &PartBounds, mut best: Nearest) -> Nearest {
        self.around(p, part, best.distance, |triangle| {
            let point = nearest_on_triangle(self.mesh.triangle(triangle as usize), p);
            let distance = point.distance(p);
            if (distance, triangle) >= (best.distance, best.face.triangle) {
                return None;
            }
            best = Nearest {
                face: TriangleId::of_mesh(triangle),
                point,
                distance,
            };
            Some(distance)
        });
        best
    }

    /// Calls `visit` with every triangle within `radius` mm of `p`, and with some beyond. The value
    /// returned by `visit` becomes the new radius.
    pub(super) fn around<F: FnMut(u32) -> Option<f64>>(
        &self,
        p: DVec3,
        part: &PartBounds,
        radius: f64,
        visit: F,
    ) {
        struct Search<'t, F> {
            quads: Option<&'t Quads>,
            visit: F,
            slack: f64,
        }
        impl<F: FnMut(u32) -> Option<f64>> Search<'_, F> {
            /// Widens the radius by the rounding errors of the f32 vertices and the f32 query
            /// point, so that no nearer triangle is missed.
            fn widened(&self, radius: f64) -> f32 {
                ((radius + self.slack) * (1.0 + 1e-6)) as f32
            }

            unsafe extern "C" fn visit(args: *mut ffi::RTCPointQueryFunctionArguments) -> bool {
                // SAFETY: Embree passes valid arguments. Their userPtr is the `Search` passed
                // below, and their query is the query passed below.
                let (args, search, query) = unsafe {
                    let args = &*args;
                    (args, &mut *(args.userPtr as *mut Self), &mut *args.query)
                };
                let [one, other] = match search.quads {
                    None => [args.primID; 2],
                    Some(quads) => quads.triangles(args.primID),
                };
                let mut nearer = (search.visit)(one);
                if other != one {
                    nearer = (search.visit)(other).or(nearer);
                }
                let Some(radius) = nearer else {
                    return false;
                };
                query.radius = search.widened(radius);
                true
            }
        }
        let mut search = Search {
            quads: self.quads.as_ref(),
            visit,
            slack: part.resolution() + (p - part.center).length() * 2f64.powi(-20),
        };
        let [x, y, z] = (p - part.center).as_vec3().to_array();
        let mut query = ffi::RTCPointQuery {
            x,
            y,
            z,
            time: 0.0,
            radius: search.widened(radius),
        };
        // SAFETY: the scene is live and committed. The query and the search outlive the call, and
        // only `visit` accesses them during it.
        unsafe {
            let user = &mut search as *mut Search<F> as *mut c_void;
            ffi::lt_point_query(self.scene, &mut query, Some(Search::<F>::visit), user)
        };
    }
}

#[cfg(test)]
#[path = "embree_tests.rs"]
pub(super) mod tests;
