//! Embree behind the shim of `ffi/`. Vertices are centred on the mesh before they
//! are narrowed to f32, so that a far-off part costs no digits.

#![allow(unsafe_code)]

use super::embree_device::{Device, ffi, reported};
use super::lanes::{Inside, Lanes};
use super::part_box::{PartBox, Side};
use super::quads::Quads;
use super::refine::nearest_on_triangle;
use super::{Face, Nearest, Ray, WIDTH};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::{Mesh, Watch};
use rayon::prelude::*;
use smallvec::SmallVec;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex};

/// Embree's scene of one mesh.
pub struct Tree {
    pub(super) scene: ffi::RTCScene,
    // Dropped after `scene` is released in `drop`.
    pub(super) device: Arc<Device>,
    /// The scene refers to its triangles, or to the quads if there are any.
    mesh: Arc<Mesh>,
    quads: Option<Quads>,
}

/// Who watches a build, and the error with which they ended it.
struct Watched<'a> {
    watch: &'a Watch<'a>,
    error: Mutex<Option<Error>>,
}

unsafe extern "C" fn tell(watched: *mut c_void, share: f64) -> bool {
    // SAFETY: `watched` is the Watched given to lt_scene_on_progress, which outlives
    // the commit and is only read.
    let watched = unsafe { &*(watched as *const Watched) };
    match (watched.watch)(share) {
        Ok(()) => true,
        Err(error) => {
            let mut first = watched.error.lock().unwrap_or_else(|p| p.into_inner());
            first.get_or_insert(error);
            false
        }
    }
}

// SAFETY: Embree's scenes may be queried from many threads once committed, and
// nothing here changes one after that.
unsafe impl Send for Tree {}
// SAFETY: as above.
unsafe impl Sync for Tree {}

impl Drop for Tree {
    fn drop(&mut self) {
        // SAFETY: the handle is live and released only here.
        unsafe { ffi::lt_scene_release(self.scene) }
    }
}

#[repr(align(64))]
pub(super) struct Valid(pub(super) [i32; WIDTH]);

/// Bytes a triangle takes while the hierarchy is built: 67 of nodes and leaves, 6 of
/// vertices, 32 of what is sorted.
pub(super) const BUILD: u64 = 105;

impl Tree {
    /// Builds the hierarchy with `threads` threads. Errors: what Embree reports,
    /// such as too little memory; `watch`'s.
    pub(super) fn build(
        mesh: &Arc<Mesh>,
        part: &PartBox,
        threads: usize,
        watch: &Watch,
    ) -> Result<Tree> {
        let tree = Tree::filled(Device::common(threads)?, mesh, Quads::of(mesh), part, true)?;
        tree.commit(watch)?;
        Ok(tree)
    }

    /// A scene of the mesh, or of its triangles in pairs, that is still to be committed.
    pub(super) fn filled(
        device: Arc<Device>,
        mesh: &Arc<Mesh>,
        quads: Option<Quads>,
        part: &PartBox,
        robust: bool,
    ) -> Result<Tree> {
        let vertices = mesh.positions.len();
        let mut vertex_buffer = std::ptr::null_mut();
        let (faces, indices) = match &quads {
            None => (mesh.triangles.len(), mesh.triangles.as_ptr().cast()),
            Some(quads) => (quads.len(), quads.as_ptr()),
        };
        // SAFETY: the device is live, the out-pointer valid for the call. The tree
        // that releases the scene keeps the mesh and the quads, so that what
        // Embree only reads of them stays where it is.
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
        let tree = Tree {
            scene,
            device,
            mesh: mesh.clone(),
            quads,
        };
        // SAFETY: the scene was made, so the buffer is there: `vertices` times three
        // floats, aligned to 4 bytes, that live as long as the scene and that no one else
        // reads or writes before the commit. Embree need not have set them, and
        // `MaybeUninit` says so.
        let vertex_buffer: &mut [MaybeUninit<[f32; 3]>] =
            unsafe { std::slice::from_raw_parts_mut(vertex_buffer.cast(), vertices) };
        (vertex_buffer.par_iter_mut().zip(&mesh.positions)).for_each(|(out, p)| {
            out.write((*p - part.center).as_vec3().to_array());
        });
        Ok(tree)
    }

    pub(super) fn commit(&self, watch: &Watch) -> Result<()> {
        let watched = Watched {
            watch,
            error: Mutex::default(),
        };
        // SAFETY: the scene is live and its buffers are filled; `watched` outlives
        // the calls, after which nothing refers to it.
        let committed = reported(|| unsafe {
            let user = &watched as *const Watched as *mut c_void;
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

    /// Rays that are traced together: which others there are has a say in which of two
    /// triangles at the same distance is met.
    pub(super) fn together(&self) -> usize {
        self.device.packet as usize
    }

    /// Of 16 rays, as bits, those that are traced with some.
    fn beside(&self, some: u16) -> u16 {
        let packets = (0..WIDTH).step_by(self.together());
        let packets = packets.map(|first| u16::MAX >> (WIDTH - self.together()) << first);
        packets.filter(|bits| bits & some != 0).sum()
    }

    /// Fills a packet with the rays of the set bits, in place since a copy of it takes time.
    fn pack(inside: &Inside, some: u16, packet: &mut ffi::RTCRay16) -> Valid {
        let mut valid = Valid([0; WIDTH]);
        let traced = |i: usize| some >> i & 1 == 1 && inside.length[i] >= 0.0;
        for (i, valid) in valid.0.iter_mut().enumerate() {
            *valid = -i32::from(traced(i));
        }
        let [x, y, z] = inside.origin;
        (packet.org_x, packet.org_y, packet.org_z) = (x, y, z);
        let [x, y, z] = inside.direction;
        (packet.dir_x, packet.dir_y, packet.dir_z) = (x, y, z);
        packet.tfar = inside.length.map(|length| length as f32);
        packet.mask = [u32::MAX; WIDTH];
        valid
    }

    pub(super) fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Calls `found` for each ray that meets the mesh, with its number, the triangle,
    /// the distance (mm), and whether it comes to the triangle's front or back: those
    /// that are traced together with some (as bits).
    pub(super) fn closest(
        &self,
        rays: &Lanes,
        some: u16,
        part: &PartBox,
        mut found: impl FnMut(usize, u32, f64, Side),
    ) {
        let together = rays.together(part);
        // SAFETY: RTCRayHit16 is floats and integers, for which all-zero bytes are values.
        let mut packet: ffi::RTCRayHit16 = unsafe { std::mem::zeroed() };
        let inside = rays.inside(part, together.approach);
        let asked = self.beside(some) & rays.there();
        let valid = Tree::pack(&inside, asked, &mut packet.ray);
        packet.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
        // SAFETY: the scene is live and committed; both structs are 64-byte
        // aligned and of the linked library's own layout.
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
                let side = if along > 0.0 { Side::Back } else { Side::Front };
                let triangle = match &self.quads {
                    None => hit.primID[i],
                    Some(quads) => quads.triangle(hit.primID[i], hit.u[i], hit.v[i]),
                };
                found(i, triangle, t, side);
            }
        }
    }

    /// Which rays start inside the mesh, as bits: those from whose origin the first thing in
    /// some direction is a back. Wrong of an origin that is on the surface to f32's last
    /// digits, and without a meaning for open meshes.
    pub(super) fn starting_inside(&self, rays: &[Ray], part: &PartBox) -> u16 {
        // Any that parts and rays do not have for a reason of their own.
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
        self.closest(&Lanes::new(&probes), u16::MAX, part, |i, _, _, side| {
            backs |= u16::from(side == Side::Back) << i;
        });
        let bits = asked.iter().map(|&(i, probe)| (backs >> probe & 1) << i);
        bits.sum()
    }

    /// Whether each of up to 16 coherent rays meets anything, as bits.
    pub(super) fn occluded(&self, rays: &Lanes, part: &PartBox) -> u16 {
        let together = rays.together(part);
        // SAFETY: as in `closest`.
        let mut packet: ffi::RTCRay16 = unsafe { std::mem::zeroed() };
        let inside = rays.inside(part, together.approach);
        let valid = Tree::pack(&inside, rays.there(), &mut packet);
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
        // Embree sets tfar to -∞ on a hit. No ray that is traced has that before.
        (0..WIDTH)
            .filter(|&i| packet.tfar[i] == f32::NEG_INFINITY)
            .fold(0, |bits, i| bits | 1 << i)
    }

    /// The point of the mesh nearest to `p`, in f64, which `best` is at most as near.
    pub(super) fn nearest(&self, p: DVec3, part: &PartBox, mut best: Nearest) -> Nearest {
        self.around(p, part, best.distance, |triangle| {
            let point = nearest_on_triangle(self.mesh.triangle(triangle as usize), p);
            let distance = point.distance(p);
            if (distance, triangle) >= (best.distance, best.face.triangle) {
                return None;
            }
            best = Nearest {
                face: Face::of_mesh(triangle),
                point,
                distance,
            };
            Some(distance)
        });
        best
    }

    /// Calls `visit` with every triangle within `radius` mm of `p`, and some beyond;
    /// what it returns is the radius from then on.
    pub(super) fn around<F: FnMut(u32) -> Option<f64>>(
        &self,
        p: DVec3,
        part: &PartBox,
        radius: f64,
        visit: F,
    ) {
        struct Search<'t, F> {
            quads: Option<&'t Quads>,
            visit: F,
            slack: f64,
        }
        impl<F: FnMut(u32) -> Option<f64>> Search<'_, F> {
            /// Embree compares with f32 vertices and an f32 query point: widened by
            /// their rounding, no nearer triangle is missed.
            fn widened(&self, radius: f64) -> f32 {
                ((radius + self.slack) * (1.0 + 1e-6)) as f32
            }

            unsafe extern "C" fn visit(args: *mut ffi::RTCPointQueryFunctionArguments) -> bool {
                // SAFETY: Embree passes valid arguments whose userPtr is the Search
                // given below and whose query is the one given below.
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
        // SAFETY: the scene is live and committed; query and search outlive the
        // call, and `visit` is the only one to touch them during it.
        unsafe {
            let user = &mut search as *mut Search<F> as *mut c_void;
            ffi::lt_point_query(self.scene, &mut query, Some(Search::<F>::visit), user)
        };
    }
}

#[cfg(test)]
#[path = "embree_tests.rs"]
pub(super) mod tests;
