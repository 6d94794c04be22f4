//! Embree called bare, and in ways lasertrace does not use, for the race: rays in
//! f32 as they are, one or 16 at a time, robust or fast, its memory counted.

#![allow(unsafe_code)]

use super::WIDTH;
use super::embree::{Tree, Valid};
use super::embree_device::{Device, ffi};
use super::part_box::PartBox;
use crate::error::Result;
use crate::mesh::Mesh;
use std::ffi::c_void;
use std::sync::Arc;
use std::sync::atomic::{AtomicIsize, Ordering};

/// A ray as all who race take it.
#[derive(Debug, Clone, Copy)]
pub struct FlatRay {
    /// mm.
    pub origin: [f32; 3],
    /// Of length 1.
    pub direction: [f32; 3],
    /// End of the ray in lengths of its direction, positive.
    pub t_max: f32,
}

/// What a ray met first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlatHit {
    /// Infinite if it met nothing.
    pub t: f32,
    /// Number of the triangle; `u32::MAX` for a miss.
    pub triangle: u32,
}

impl FlatHit {
    /// A ray that meets nothing.
    pub const NONE: FlatHit = FlatHit {
        t: f32::INFINITY,
        triangle: u32::MAX,
    };
}

#[derive(Default)]
struct Memory {
    now: AtomicIsize,
    peak: AtomicIsize,
}

unsafe extern "C" fn count_memory(memory: *mut c_void, bytes: isize, _done: bool) -> bool {
    // SAFETY: `memory` is the Memory of the BareEmbree whose device calls; it outlives
    // the device, and many threads may read it, as it is of atomics.
    let memory = unsafe { &*(memory as *const Memory) };
    let now = memory.now.fetch_add(bytes, Ordering::Relaxed) + bytes;
    memory.peak.fetch_max(now, Ordering::Relaxed);
    true
}

/// Embree's scene of one mesh whose coordinates f32 holds.
pub struct BareEmbree {
    // Dropped before the memory it counts into.
    tree: Tree,
    // Not a box: Embree holds a pointer to it, and to move a box claims that no one does.
    memory: Arc<Memory>,
}

impl BareEmbree {
    /// Errors: what Embree reports.
    pub fn build(mesh: &Arc<Mesh>, robust: bool, threads: usize) -> Result<BareEmbree> {
        let memory = Arc::new(Memory::default());
        // A separate device, as Embree counts memory per device.
        let device = Arc::new(Device::configured(&format!("threads={threads}"))?);
        let user = Arc::as_ptr(&memory) as *mut c_void;
        // SAFETY: the device is live, and the counts stay where they are until it is
        // released: the tree that holds it is dropped first.
        unsafe { ffi::lt_device_on_memory(device.handle, Some(count_memory), user) };
        let mut part = PartBox::new(mesh.bounds());
        part.center = crate::math::DVec3::ZERO;
        let tree = Tree::filled(device, mesh, None, &part, robust)?;
        tree.commit(&|_| Ok(()))?;
        Ok(BareEmbree { tree, memory })
    }

    /// Bytes Embree holds, and the most it held.
    pub fn bytes(&self) -> [usize; 2] {
        [&self.memory.now, &self.memory.peak].map(|b| b.load(Ordering::Relaxed).max(0) as usize)
    }

    fn ray(ray: &FlatRay) -> ffi::RTCRay {
        let ([org_x, org_y, org_z], [dir_x, dir_y, dir_z]) = (ray.origin, ray.direction);
        ffi::RTCRay {
            org_x,
            org_y,
            org_z,
            tnear: 0.0,
            dir_x,
            dir_y,
            dir_z,
            time: 0.0,
            tfar: ray.t_max,
            mask: u32::MAX,
            id: 0,
            flags: 0,
        }
    }

    /// First hit of a ray; [`FlatHit::NONE`] if there is none.
    pub fn closest(&self, ray: &FlatRay) -> FlatHit {
        let mut packet = ffi::RTCRayHit {
            ray: BareEmbree::ray(ray),
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        };
        packet.hit.geomID = ffi::LT_NO_GEOMETRY;
        // SAFETY: the scene is live and committed; the struct is of the library's
        // own layout and alignment.
        unsafe { ffi::lt_intersect1(self.tree.scene, &mut packet) };
        match packet.hit.geomID {
            ffi::LT_NO_GEOMETRY => FlatHit::NONE,
            _ => FlatHit {
                t: packet.ray.tfar,
                triangle: packet.hit.primID,
            },
        }
    }

    /// Whether anything lies on the ray.
    pub fn occluded(&self, ray: &FlatRay) -> bool {
        let mut ray = BareEmbree::ray(ray);
        // SAFETY: as in `closest`.
        unsafe { ffi::lt_occluded1(self.tree.scene, &mut ray) };
        ray.tfar == f32::NEG_INFINITY
    }

    fn pack(rays: &[FlatRay]) -> (Valid, ffi::RTCRay16) {
        let mut valid = Valid([0; WIDTH]);
        // SAFETY: all-zero bytes are valid floats and integers.
        let mut packet: ffi::RTCRay16 = unsafe { std::mem::zeroed() };
        packet.mask = [u32::MAX; WIDTH];
        for (i, ray) in rays.iter().enumerate() {
            valid.0[i] = -1;
            [packet.org_x[i], packet.org_y[i], packet.org_z[i]] = ray.origin;
            [packet.dir_x[i], packet.dir_y[i], packet.dir_z[i]] = ray.direction;
            packet.tfar[i] = ray.t_max;
        }
        (valid, packet)
    }

    /// Up to 16 rays at once.
    pub fn closest16(&self, rays: &[FlatRay], coherent: bool, hits: &mut [FlatHit]) {
        let (valid, ray) = BareEmbree::pack(rays);
        let mut packet = ffi::RTCRayHit16 {
            ray,
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        };
        packet.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
        // SAFETY: the scene is live and committed; both structs are 64-byte aligned
        // and of the library's own layout.
        unsafe {
            ffi::lt_intersect16(
                self.tree.scene,
                coherent,
                self.tree.device.packet,
                valid.0.as_ptr(),
                &mut packet,
            );
        }
        for (i, hit) in hits.iter_mut().enumerate() {
            *hit = match packet.hit.geomID[i] {
                ffi::LT_NO_GEOMETRY => FlatHit::NONE,
                _ => FlatHit {
                    t: packet.ray.tfar[i],
                    triangle: packet.hit.primID[i],
                },
            };
        }
    }

    /// Up to 16 rays at once.
    pub fn occluded16(&self, rays: &[FlatRay], coherent: bool, blocked: &mut [bool]) {
        let (valid, mut packet) = BareEmbree::pack(rays);
        // SAFETY: as in `closest16`.
        unsafe {
            ffi::lt_occluded16(
                self.tree.scene,
                coherent,
                self.tree.device.packet,
                valid.0.as_ptr(),
                &mut packet,
            );
        }
        for (blocked, t) in blocked.iter_mut().zip(packet.tfar) {
            *blocked = t == f32::NEG_INFINITY;
        }
    }
}
