//! Tests of each backend against brute force, and of the backends against each other.

use super::super::Accel;
use super::super::brute;
use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::shapes;
use std::sync::Arc;

/// Returns the mesh in every available backend.
fn accels(mesh: &Mesh) -> impl Iterator<Item = Accel> {
    let mesh = Arc::new(mesh.clone());
    let backends = Backend::ALL.iter();
    backends.map(move |&backend| Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap())
}

fn uniform(key: RngKey, i: u64, low: f64, high: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        low + (high - low) * key.with(i).uniform(j as u64)
    }))
}

/// Returns 300 loose triangles about 1 mm wide in a 10 mm cube, far from the origin so that
/// centering matters.
pub fn soup() -> Mesh {
    let key = RngKey::new(11, Purpose::SensorNoise);
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

pub fn rays_at(mesh: &Mesh, count: u64) -> Vec<Ray> {
    let key = RngKey::new(12, Purpose::SensorNoise);
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

/// Tests hits against brute force. If both hit the same triangle, the points agree to f64 rounding.
///
/// Otherwise the ray passes an edge within the f32 resolution. For 300 triangles of edge about 1
/// mm, a ray hits a band of 2e-6 mm around edges with probability below 1e-4. Of 20 000 rays, 0.1
/// are expected to differ, and more than 2 would be a defect.
#[test]
fn closest_hits_agree_with_brute_force() {
    let mesh = soup();
    for accel in accels(&mesh) {
        let rays = rays_at(&mesh, 20_000);
        let (mut hits, mut disagreements) = (0, 0);
        for packet in rays.chunks(WIDTH) {
            let found = accel.closest(packet, |_, _| true);
            for (ray, found) in packet.iter().zip(found) {
                let truth = brute::closest(&mesh, ray);
                match (truth, found) {
                    (None, None) => {}
                    (Some(a), Some(b)) if a.face == b.face => {
                        hits += 1;
                        // Distances of about 200 mm and coordinates of about 4000 mm have rounding
                        // errors of 1e-12, which oblique incidence multiplies by 1/cos.
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
}

#[test]
fn occlusion_agrees_with_brute_force_and_ends_at_t_max() {
    let mesh = soup();
    for accel in accels(&mesh) {
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
}

#[test]
fn nearest_points_agree_with_brute_force() {
    let mesh = soup();
    for accel in accels(&mesh) {
        let key = RngKey::new(13, Purpose::SensorNoise);
        for i in 0..2_000 {
            let p = mesh.bounds().center() + uniform(key, i, -12.0, 12.0);
            let truth = brute::nearest(&mesh, p).unwrap();
            let found = accel.nearest(p, None);
            assert_eq!(found.distance, truth.distance, "{p}");
            // The result does not depend on the starting triangle.
            let last = mesh.triangles.len() as u32 - 1;
            for close in [0, last / 2, last, found.face.triangle] {
                assert_eq!(
                    accel.nearest(p, Some(TriangleId::of_mesh(close))),
                    found,
                    "{p}"
                );
            }
        }
    }
}

#[test]
fn a_ray_that_misses_the_box_or_runs_along_its_face_is_no_trouble() {
    let mesh = soup();
    for accel in accels(&mesh) {
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
}

/// Tests 90 000 rays from outside at the vertices and edges of a sphere of 4 mm, far from the
/// origin, and along its axes.
///
/// A ray passes within 1e-12 mm of its target at more than 6° to the surface (the sine of the angle
/// is above 0.1). There is a triangle in its path, and none may be missed. With Embree, the
/// correction of f32 misses is tested on quads, which large meshes use; `limits_rays` tests
/// triangles.
#[test]
fn no_ray_slips_between_triangles() {
    let mut mesh = shapes::sphere(4.0, 0.004).unwrap();
    for p in &mut mesh.positions {
        *p += DVec3::new(900.0, -70.0, 3.0);
    }
    let part = PartBounds::new(mesh.bounds());
    let mesh = Arc::new(mesh);
    let trees = [
        Tree::Rust(rust_bvh::RustBvh::build(&mesh, &part)),
        #[cfg(feature = "embree")]
        Tree::Embree(embree::tests::of_quads(&mesh, &part)),
    ];
    for tree in trees {
        slips_between_none(&Hierarchy {
            mesh: mesh.clone(),
            built: mesh.clone(),
            part,
            tree,
            #[cfg(feature = "embree")]
            exhaustive: OnceLock::new(),
        });
    }
}

fn slips_between_none(hierarchy: &Hierarchy) {
    let mesh = &hierarchy.mesh;
    let (center, key) = (
        mesh.bounds().center(),
        RngKey::new(14, Purpose::SensorNoise),
    );
    let mut aimed = 0;
    for i in 0..45_000u64 {
        let corners = mesh.triangle(i as usize % mesh.triangles.len());
        let along = key.with(i).uniform(7);
        for target in [corners[0], corners[0].lerp(corners[1], along)] {
            let eye = match i % 4 {
                // Parallel rays, as in an orthographic view.
                0 => target + DVec3::AXES[i as usize / 4 % 3] * 30.0,
                _ => center + uniform(key, i, -60.0, 60.0),
            };
            let ray = Ray {
                t_max: f64::INFINITY,
                ..Ray::between(eye, target).unwrap()
            };
            if ray.direction.dot(target - center) > -0.4 {
                continue;
            }
            aimed += 1;
            let hit = hierarchy.closest(&[ray], 1, false, |_, _| true)[0];
            let hit = hit.unwrap_or_else(|| panic!("{ray:?} misses {target}"));
            assert!(hit.point.distance(target) < 1e-9, "{hit:?} {target}");
            assert_eq!(hierarchy.occluded(&[ray]), 1, "{ray:?}");
        }
    }
    assert!(aimed > 25_000, "{aimed}");
}

/// Tests a mesh of one triangle, a mesh that includes triangles without area, and a flat mesh. No
/// hit may be lost or invented.
#[test]
fn meshes_of_strange_shapes_are_no_trouble() {
    let flat = |triangles: Vec<[u32; 3]>| Mesh {
        positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::X * 2.0],
        triangles,
    };
    let down = |x: f64, y: f64| Ray {
        origin: DVec3::new(x, y, 5.0),
        direction: -DVec3::Z,
        t_max: 10.0,
    };
    for triangles in [
        vec![[0, 1, 2]],
        vec![[0, 1, 3], [0, 0, 0], [0, 1, 2], [1, 1, 2]],
        vec![[0, 1, 3]; 40].into_iter().chain([[0, 1, 2]]).collect(),
    ] {
        let mesh = flat(triangles);
        for accel in accels(&mesh) {
            let hits = accel.closest(&[down(0.2, 0.2), down(0.8, 0.8)], |_, _| true);
            assert_eq!(hits[0].unwrap().point, DVec3::new(0.2, 0.2, 0.0));
            assert!(hits[1].is_none());
            let near = accel.nearest(DVec3::new(0.25, -1.0, 0.0), None);
            assert_eq!(near.distance, 1.0);
        }
    }
}

/// Tests that a file with many equal triangles neither hangs nor overflows the stack.
#[test]
fn a_hundred_thousand_equal_triangles_are_one() {
    let mesh = Mesh {
        positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y],
        triangles: vec![[0, 1, 2]; 100_000],
    };
    for accel in accels(&mesh) {
        let ray = Ray {
            origin: DVec3::new(0.2, 0.2, 5.0),
            direction: -DVec3::Z,
            t_max: 10.0,
        };
        assert_eq!(accel.closest(&[ray], |_, _| true)[0].unwrap().t, 5.0);
        assert_eq!(accel.nearest(DVec3::Z, None).face.triangle, 0);
    }
}

#[test]
fn the_version_that_is_written_down_is_that_of_the_crate() {
    let lock = include_str!("../../Cargo.lock");
    let package = format!("name = \"obvhs\"\nversion = \"{}\"", rust_bvh::OBVHS);
    assert!(lock.contains(&package), "{package}");
}

/// Returns a mesh large enough for Embree to report progress during the build.
fn large() -> Mesh {
    shapes::sphere(10.0, 2e-4).unwrap()
}

#[test]
fn a_build_tells_how_far_it_is_and_ends() {
    let mesh = Arc::new(large());
    let heard = std::sync::Mutex::new(Vec::new());
    for &backend in Backend::ALL {
        let watch = |share| {
            heard.lock().unwrap().push(share);
            Ok(())
        };
        Accel::build_with(backend, &mesh, 2, &watch).unwrap();
        let mut heard = std::mem::take(&mut *heard.lock().unwrap());
        assert_eq!(heard.pop(), Some(1.0));
        assert!(heard.iter().all(|share| (0.0..=1.0).contains(share)));
        let between = heard.iter().filter(|&&share| 0.0 < share && share < 1.0);
        // The Rust backend reports progress only at its end.
        assert!(between.count() > 1 || backend == Backend::Rust, "{heard:?}");
    }
}

#[test]
fn a_build_can_be_stopped() {
    let mesh = Arc::new(large());
    for &backend in Backend::ALL {
        let watch = |share| match share > 0.3 {
            true => Err(Error::Interrupted),
            false => Ok(()),
        };
        let stopped = Accel::build_with(backend, &mesh, 2, &watch);
        assert!(matches!(stopped, Err(Error::Interrupted)));
    }
}
