//! Embree against brute force, and the guards around its structs.

use super::super::brute;
use super::*;
use crate::math::rng::{Key, Purpose};

fn uniform(key: Key, i: u64, low: f64, high: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        low + (high - low) * key.with(i).uniform(j as u64)
    }))
}

/// A few hundred loose triangles about 1 mm wide in a 10 mm cube, some way off
/// the origin so that centring matters.
fn soup() -> Mesh {
    let key = Key::new(11, Purpose::SensorNoise);
    let offset = DVec3::new(4000.0, -700.0, 120.0);
    let positions: Vec<DVec3> = (0..900)
        .map(|i| uniform(key, i / 3, 0.0, 10.0) + uniform(key.with(9), i, -1.0, 1.0) + offset)
        .collect();
    let triangles = (0..300).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    Mesh {
        positions,
        triangles,
    }
}

fn rays_at(mesh: &Mesh, count: u64) -> Vec<Ray> {
    let key = Key::new(12, Purpose::SensorNoise);
    let center = mesh.bounds().center();
    (0..count)
        .map(|i| {
            let from = center + uniform(key, 2 * i, -200.0, 200.0);
            let to = center + uniform(key, 2 * i + 1, -6.0, 6.0);
            Ray {
                t_max: f64::INFINITY,
                ..Ray::between(from, to).unwrap()
            }
        })
        .collect()
}

/// Where both hit the same triangle the points agree to f64 rounding. Elsewhere
/// the ray passes an edge closer than f32 resolves: of 20 000 rays at 300
/// triangles of edge ~1 mm, a band of 2e-6 mm around edges is met with chance
/// below 1e-4 a ray, so more than 2 (of an expected 0.1) would be a defect.
#[test]
fn closest_hits_agree_with_brute_force() {
    let mesh = soup();
    let accel = Accel::build(&mesh, 1).unwrap();
    let rays = rays_at(&mesh, 20_000);
    let (mut hits, mut disagreements) = (0, 0);
    for packet in rays.chunks(WIDTH) {
        let found = accel.closest(packet, |_, _| true);
        for (ray, found) in packet.iter().zip(found) {
            let truth = brute::closest(&mesh, ray);
            match (truth, found) {
                (None, None) => {}
                (Some(a), Some(b)) if a.triangle == b.triangle => {
                    hits += 1;
                    // Distances of ~200 mm and coordinates of ~4000 mm round at
                    // 1e-12; seen at an angle that is multiplied by 1/cos.
                    let slant = a.normal.dot(ray.direction).abs();
                    assert!((a.t - b.t).abs() < 1e-10 / slant, "{a:?} {b:?}");
                    assert!(b.normal.dot(ray.direction) <= 0.0);
                }
                _ => disagreements += 1,
            }
        }
    }
    assert!(hits > 5_000, "{hits}");
    assert!(disagreements <= 2, "{disagreements}");
}

#[test]
fn occlusion_agrees_with_brute_force_and_ends_at_t_max() {
    let mesh = soup();
    let accel = Accel::build(&mesh, 1).unwrap();
    let mut disagreements = 0;
    for packet in rays_at(&mesh, 4_000).chunks(WIDTH) {
        let truth: Vec<Option<f64>> = packet
            .iter()
            .map(|r| brute::closest(&mesh, r).map(|h| h.t))
            .collect();
        // Ends 1 % before and 1 % behind the first hit.
        for (stretch, expected) in [(0.99, false), (1.01, true)] {
            let rays: Vec<Ray> = packet
                .iter()
                .zip(&truth)
                .map(|(ray, t)| Ray {
                    t_max: t.unwrap_or(1000.0) * stretch,
                    ..*ray
                })
                .collect();
            let bits = accel.occluded(&rays);
            for (i, t) in truth.iter().enumerate() {
                let blocked = bits >> i & 1 == 1;
                disagreements += usize::from(blocked != (expected && t.is_some()));
            }
        }
    }
    assert!(disagreements <= 2, "{disagreements}");
}

#[test]
fn nearest_points_agree_with_brute_force() {
    let mesh = soup();
    let accel = Accel::build(&mesh, 1).unwrap();
    let key = Key::new(13, Purpose::SensorNoise);
    for i in 0..2_000 {
        let p = mesh.bounds().center() + uniform(key, i, -12.0, 12.0);
        let truth = brute::nearest(&mesh, p).unwrap();
        assert_eq!(accel.nearest(p).distance, truth.distance, "{p}");
    }
}

#[test]
fn a_ray_that_misses_the_box_or_runs_along_its_face_is_no_trouble() {
    let mesh = soup();
    let accel = Accel::build(&mesh, 1).unwrap();
    let bounds = mesh.bounds();
    let along_face = Ray {
        origin: bounds.min,
        direction: DVec3::X,
        t_max: f64::INFINITY,
    };
    let away = Ray {
        origin: bounds.max + DVec3::ONE,
        ..along_face
    };
    assert!(accel.closest(&[along_face, away], |_, _| true)[1].is_none());
    assert_eq!(accel.occluded(&[away, away]), 0);
    assert_eq!(accel.occluded(&[]), 0);
}

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
    let accel = Accel::build(&mesh, 1).unwrap();
    let rays = rays_at(&mesh, WIDTH as u64);
    let (valid, ray, _) = accel.pack(&rays);
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
        ffi::lt_intersect16(accel.scene, valid.0.as_ptr(), &mut closest.value);
        ffi::lt_occluded16(accel.scene, valid.0.as_ptr(), &mut occluded.value);
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
    let (mut v, mut t) = (std::ptr::null_mut(), std::ptr::null_mut());
    // SAFETY: the device is live, the out-pointers valid.
    let scene = unsafe { ffi::lt_mesh_scene_new(device.handle, 1 << 50, 1 << 50, &mut v, &mut t) };
    assert!(scene.is_null());
    assert!(device.check().is_err());
}
