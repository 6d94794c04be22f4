//! The guards around Embree's structs, and its errors.

use super::*;
use crate::accel::hierarchy::tests::{rays_at, soup};
use crate::math::DVec2;
use std::path::Path;

/// The bytes behind the structs stay as they were: had the header another
/// RTCHit than the library, Embree would write past the end.
#[test]
fn embree_writes_nothing_past_its_structs() {
    #[repr(C, align(64))]
    struct Guarded<T> {
        value: T,
        guard: [u8; 1024],
    }
    let mesh = soup();
    let part = PartBox::new(mesh.bounds());
    let tree = Tree::build(&mesh, &part, 1, &|_| Ok(())).unwrap();
    let rays = rays_at(&mesh, WIDTH as u64);
    let (valid, ray, _) = Tree::pack(&rays, &part);
    let mut closest = Guarded {
        value: ffi::RTCRayHit16 {
            ray,
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        },
        guard: [0xA5; 1024],
    };
    closest.value.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
    let mut occluded = Guarded {
        value: ray,
        guard: [0xA5; 1024],
    };
    // SAFETY: scene live and committed, structs aligned to 64 bytes.
    unsafe {
        ffi::lt_intersect16(tree.scene, true, valid.0.as_ptr(), &mut closest.value);
        ffi::lt_occluded16(tree.scene, true, valid.0.as_ptr(), &mut occluded.value);
    }
    assert!(closest.value.hit.geomID.contains(&0), "no ray hit");
    assert_eq!(closest.guard, [0xA5; 1024]);
    assert_eq!(occluded.guard, [0xA5; 1024]);
}

#[test]
fn another_minor_version_of_the_library_is_refused() {
    assert!(check_versions(31305, 31306).is_ok());
    let message = check_versions(40200, 40303).unwrap_err().to_string();
    assert!(
        message.contains("4.2.0") && message.contains("4.3.3"),
        "{message}"
    );
}

#[test]
fn an_error_of_embree_becomes_an_error() {
    let device = Device::new(1).unwrap();
    assert!(device.check().is_ok());
    let slot = &*device.error as *const ErrorSlot as *mut c_void;
    // SAFETY: the slot is alive and the text a C string.
    unsafe { record_error(slot, 4, c"out of memory".as_ptr()) };
    let message = device.check().unwrap_err().to_string();
    assert!(message.contains("out of memory"), "{message}");
    // A mesh no machine has memory for: Embree's own report.
    let (mut v, t) = (std::ptr::null_mut(), [0; 3]);
    // SAFETY: the device is live, the out-pointer valid, and so is the triangle.
    let scene =
        unsafe { ffi::lt_mesh_scene_new(device.handle, true, 1 << 50, &mut v, 1, t.as_ptr()) };
    assert!(scene.is_null());
    assert!(device.check().is_err());
}

/// Embree takes the widest instructions the processor has. With narrower ones rays at
/// a triangle's inside meet the same triangle, at a distance that differs in f32 and,
/// refined in f64, not at all. Of 20 000 rays at 300 triangles of edge 1 mm 0.1 are
/// expected within f32's 2e-6 mm of an edge, as against brute force.
#[test]
fn other_instructions_meet_the_same_triangles() {
    let mesh = soup();
    let part = PartBox::new(mesh.bounds());
    let rays = rays_at(&mesh, 20_000);
    let met = |settings: &str| {
        let device = Device::configured(settings).unwrap();
        let tree = Tree::filled(device, &mesh, &part, true).unwrap();
        tree.commit(&|_| Ok(())).unwrap();
        let mut met = vec![(None, 0.0); rays.len()];
        for (packet, rays) in rays.chunks(WIDTH).enumerate() {
            tree.closest(rays, &part, |i, triangle, t, side| {
                met[packet * WIDTH + i] = (Some((triangle, side)), t);
            });
        }
        met
    };
    let own = met("threads=1");
    assert!(own.iter().filter(|(met, _)| met.is_some()).count() > 5_000);
    for isa in ["sse2", "avx", "avx2"] {
        let other = met(&format!("threads=1,isa={isa}"));
        let both = || own.iter().zip(&other);
        let others = both().filter(|(a, b)| a.0 != b.0).count();
        let moved = both().filter(|(a, b)| a.1 != b.1).count();
        println!("{isa}: {others} other triangles, {moved} other distances");
        assert!(others <= 2, "{isa}: {others}");
    }
}

/// A frame is a function of the hits, shadows and nearest points of its rays, and these are
/// the same to the bit with AVX2 as with the widest instructions of the processor: 40 960
/// coherent rays at the demo's part, as many shadows and 2 000 nearest points.
#[test]
fn a_frames_rays_are_the_same_with_avx2() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/bracket.stl");
    let mesh = crate::mesh::load(&file, 1.0).unwrap();
    let part = PartBox::new(mesh.bounds());
    let eye = DVec3::new(0.0, -126.0, 233.2);
    let at = |i: usize| {
        let share = DVec2::new((i % 320) as f64 / 320.0, (i / 320) as f64 / 128.0) - 0.5;
        DVec3::new(64.0 * share.x, 44.0 * share.y, 15.0)
    };
    let rays: Vec<Ray> = (0..320 * 128)
        .map(|i| Ray::between(eye, eye + (at(i) - eye) * 1.2).unwrap())
        .collect();
    let answers = |settings: &str| {
        let device = Device::configured(settings).unwrap();
        let tree = Tree::filled(device, &mesh, &part, true).unwrap();
        tree.commit(&|_| Ok(())).unwrap();
        let mut hits = vec![(u32::MAX, 0); rays.len()];
        for (packet, rays) in rays.chunks(WIDTH).enumerate() {
            tree.closest(rays, &part, |i, triangle, t, _| {
                hits[packet * WIDTH + i] = (triangle, t.to_bits());
            });
        }
        let shadows: Vec<u16> = rays
            .chunks(WIDTH)
            .map(|r| tree.occluded(r, &part))
            .collect();
        let nearest: Vec<_> = (0..2000)
            .map(|i| {
                let far = Nearest {
                    distance: f64::INFINITY,
                    point: DVec3::ZERO,
                    face: Face::of_mesh(0),
                };
                let nearest = tree.nearest(at(i * 20), &part, far);
                (nearest.face.triangle, nearest.distance.to_bits())
            })
            .collect();
        (hits, shadows, nearest)
    };
    let (own, narrow) = (answers("threads=1"), answers("threads=1,isa=avx2"));
    assert!(own.0.iter().filter(|hit| hit.0 != u32::MAX).count() > 30_000);
    assert!(own == narrow);
}
