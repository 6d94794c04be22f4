//! Direct calls of Embree for the benchmark, including modes that lasertrace does not use: f32
//! rays, one or 16 per call, robust or fast, with memory accounting.

#![allow(unsafe_code)]

use super::WIDTH;
use super::embree::{EmbreeScene, Valid};
use super::embree_device::{Device, ffi};
use super::part_bounds::PartBounds;
use crate::error::Result;
use crate::mesh::Mesh;
use std::ffi::c_void;
use std::sync::Arc;
use std::sync::atomic::{AtomicIsize, Ordering};

/// Ray in the form that all backends of the benchmark accept.
#[derive(Debug, Clone, Copy)]
pub struct FlatRay {
    /// Origin, mm.
    pub origin: [f32; 3],
    /// Direction of unit length.
    pub direction: [f32; 3],
    /// End of the ray in units of the direction length, positive.
    pub t_max: f32,
}

/// First hit of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlatHit {
    /// Distance; infinite for a miss.
    pub t: f32,
    /// Index of the triangle; `u32::MAX` for a miss.
    pub triangle: u32,
}

impl FlatHit {
    /// Result of a ray without a hit.
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
    // SAFETY: `memory` is the `Memory` of the BareEmbree whose device makes the call. It outlives
    // the device. Any number of threads may access it, because its fields are atomic.
    let memory = unsafe { &*(memory as *const Memory) };
    let now = memory.now.fetch_add(bytes, Ordering::Relaxed) + bytes;
    memory.peak.fetch_max(now, Ordering::Relaxed);
    true
}

/// Embree scene of one mesh whose coordinates are exact in f32.
pub struct BareEmbree {
    // Dropped before the memory counters it uses.
    tree: EmbreeScene,
    // An `Arc`, because Embree has a pointer to the counters and moving a `Box` asserts unique
    // access.
    memory: Arc<Memory>,
}

impl BareEmbree {
    /// Builds the scene. Returns the errors of Embree.
    pub fn build(mesh: &Arc<Mesh>, robust: bool, threads: usize) -> Result<BareEmbree> {
        let memory = Arc::new(Memory::default());
        // A separate device, as Embree counts memory per device.
        let device = Arc::new(Device::configured(&format!("threads={threads}"))?);
        let user = Arc::as_ptr(&memory) as *mut c_void;
        // SAFETY: the device is live. The counters are not moved or freed until its release,
        // because the tree that owns the device is dropped first.
        unsafe { ffi::lt_device_on_memory(device.handle, Some(count_memory), user) };
        let mut part = PartBounds::new(mesh.bounds());
        part.center = crate::math::DVec3::ZERO;
        let tree = EmbreeScene::filled(device, mesh, None, &part, robust)?;
        tree.commit(&|_| Ok(()))?;
        Ok(BareEmbree { tree, memory })
    }

    /// Returns the bytes that Embree has allocated, and their maximum.
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

    /// Returns the first hit of a ray, or [`FlatHit::NONE`].
    pub fn closest(&self, ray: &FlatRay) -> FlatHit {
        let mut packet = ffi::RTCRayHit {
            ray: BareEmbree::ray(ray),
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        };
        packet.hit.geomID = ffi::LT_NO_GEOMETRY;
        // SAFETY: the scene is live and committed. The struct has the layout and alignment of the
        // library.
        unsafe { ffi::lt_intersect1(self.tree.scene, &mut packet) };
        match packet.hit.geomID {
            ffi::LT_NO_GEOMETRY => FlatHit::NONE,
            _ => FlatHit {
                t: packet.ray.tfar,
                triangle: packet.hit.primID,
            },
        }
    }

    /// True if the ray hits anything.
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

    /// Computes the first hits of up to 16 rays in one call.
    pub fn closest16(&self, rays: &[FlatRay], coherent: bool, hits: &mut [FlatHit]) {
        let (valid, ray) = BareEmbree::pack(rays);
        let mut packet = ffi::RTCRayHit16 {
            ray,
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        };
        packet.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
        // SAFETY: the scene is live and committed. Both structs are 64-byte aligned and have the
        // layout of the library.
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

    /// Determines whether each of up to 16 rays hits anything, in one call.
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
