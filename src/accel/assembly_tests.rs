//! Tests of an assembly against one flattened mesh, with the vertices of all instances transformed
//! in f64, and brute force over all its triangles.

use super::super::brute;
use super::super::hierarchy::tests::{rays_at, soup};
use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::shapes;
use std::sync::Arc;

fn uniform(key: RngKey, i: u64, low: f64, high: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        low + (high - low) * key.with(i).uniform(j as u64)
    }))
}

/// Returns random rotations, with the centers of the mesh in a cube of side `width` mm.
fn poses(mesh: &Mesh, count: u64, width: f64) -> Vec<Rigid> {
    let key = RngKey::new(21, Purpose::SensorNoise);
    let pose = |i| {
        let turn = Rigid::from_euler_xyz(uniform(key, 2 * i, -3.0, 3.0), DVec3::ZERO);
        let middle = uniform(key, 2 * i + 1, -width / 2.0, width / 2.0);
        Rigid {
            translation: middle - turn.point(mesh.bounds().center()),
            ..turn
        }
    };
    (0..count).map(pose).collect()
}

/// Flattens the assembly into one mesh: triangle t of instance c has index c·n + t for n triangles
/// per instance.
fn flattened(mesh: &Mesh, poses: &[Rigid]) -> Mesh {
    let vertices = mesh.positions.len() as u32;
    let moved = poses.iter().enumerate().map(|(copy, pose)| {
        let triangles = mesh.triangles.iter();
        (
            mesh.positions.iter().map(|&p| pose.point(p)).collect(),
            triangles
                .map(|t| t.map(|v| v + copy as u32 * vertices))
                .collect(),
        )
    });
    let (positions, triangles): (Vec<Vec<_>>, Vec<Vec<_>>) = moved.unzip();
    Mesh {
        positions: positions.concat(),
        triangles: triangles.concat(),
    }
}

/// Returns the assembly for every available backend.
fn accels(mesh: &Mesh, poses: &[Rigid]) -> impl Iterator<Item = Accel> {
    let mesh = Arc::new(mesh.clone());
    Backend::ALL.iter().map(move |&backend| {
        let accel = Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap();
        accel.with_copies(poses).unwrap()
    })
}

/// Returns 12 instances of a mesh of loose 1 mm triangles within 10 mm, whose origin is 4 m away.
/// The instances lie in cubes of 8 mm (all overlap), 40 mm (some overlap) and 3 m (separate).
fn assemblies() -> Vec<(Mesh, Vec<Rigid>, Mesh)> {
    let widths = [8.0, 40.0, 3000.0].into_iter();
    let made = widths.map(|width| {
        let mesh = soup();
        let poses = poses(&mesh, 12, width);
        let flat = flattened(&mesh, &poses);
        (mesh, poses, flat)
    });
    made.collect()
}

fn number(face: TriangleId, mesh: &Mesh) -> u32 {
    face.copy * mesh.triangles.len() as u32 + face.triangle
}

/// Returns rays from at least 200 mm to points in the instances; the rays of a packet are adjacent.
fn rays(mesh: &Mesh, poses: &[Rigid], count: usize) -> Vec<Ray> {
    let at_mesh = rays_at(mesh, count as u64);
    let key = RngKey::new(22, Purpose::SensorNoise);
    let packets = at_mesh.chunks(WIDTH).enumerate().flat_map(|(i, packet)| {
        let pose = &poses[i % poses.len()];
        let first = packet[0];
        packet.iter().enumerate().map(move |(k, ray)| {
            let aside = uniform(key.with(i as u64), k as u64, -0.02, 0.02);
            // Every fourth packet has random directions.
            let direction = match i % 4 {
                0 => ray.direction,
                _ => (first.direction + aside).normalize(),
            };
            Ray {
                origin: pose.point(if i % 4 == 0 { ray.origin } else { first.origin }),
                direction: pose.vector(direction),
                t_max: f64::INFINITY,
            }
        })
    });
    packets.collect()
}

/// Tests the hits against the flattened mesh. Hits of one triangle agree to rounding: 1e-12 per
/// operation at 4000 mm and 3 m, about 20 operations in both directions, divided by the cosine.
///
/// Other differences occur if a ray passes an edge within the f32 resolution, as in
/// `hierarchy_tests`. About 0.3 of 24 000 rays are expected to differ; more than 3 would be a
/// defect.
#[test]
fn closest_hits_are_those_of_the_flattened_mesh() {
    for (mesh, poses, flat) in assemblies() {
        let rays = rays(&mesh, &poses, 8_000);
        let truths: Vec<Option<Hit>> = rays.iter().map(|r| brute::closest(&flat, r)).collect();
        for accel in accels(&mesh, &poses) {
            let (mut hits, mut disagreements) = (0, 0);
            let mut copies = vec![false; poses.len()];
            for (rays, truths) in rays.chunks(WIDTH).zip(truths.chunks(WIDTH)) {
                let found = accel.closest(rays, |_, _| true);
                for ((ray, truth), found) in rays.iter().zip(truths).zip(found) {
                    match (truth, found) {
                        (None, None) => {}
                        (Some(a), Some(b)) if a.face.triangle == number(b.face, &mesh) => {
                            let slant = a.normal.dot(ray.direction).abs();
                            let off = (a.t - b.t).abs() + a.point.distance(b.point);
                            assert!(off < 1e-10 / slant, "{a:?} {b:?}");
                            assert!(a.normal.distance(b.normal) < 1e-9, "{a:?} {b:?}");
                            copies[b.face.copy as usize] = true;
                            hits += 1;
                        }
                        _ => disagreements += 1,
                    }
                }
            }
            assert!(hits > 1_500, "{hits}");
            assert!(copies.iter().all(|seen| *seen), "{copies:?}");
            assert!(disagreements <= 1, "{disagreements}");
        }
    }
}

/// Tests a limit below which hits are unwanted. A ray with a hit before the limit returns nothing,
/// and any other ray returns its hit.
#[test]
fn what_is_not_wanted_hides_what_is_behind_it() {
    let (mesh, poses, _) = assemblies().swap_remove(0);
    let rays = rays(&mesh, &poses, 4_000);
    for accel in accels(&mesh, &poses) {
        let (mut kept, mut hidden) = (0, 0);
        for packet in rays.chunks(WIDTH) {
            let all = accel.closest(packet, |_, _| true);
            let Some(limit) = all.iter().flatten().map(|hit| hit.t - 0.1).reduce(f64::max) else {
                continue;
            };
            let some = accel.closest(packet, |_, t| t > limit);
            for (all, some) in all.into_iter().zip(some) {
                assert_eq!(some, all.filter(|hit| hit.t > limit));
                kept += usize::from(some.is_some());
                hidden += usize::from(some != all);
            }
        }
        assert!(kept > 100 && hidden > 500, "{kept} {hidden}");
    }
}

#[test]
fn occlusion_is_that_of_the_flattened_mesh() {
    for (mesh, poses, flat) in assemblies() {
        let rays = rays(&mesh, &poses, 2_000);
        let truths: Vec<_> = rays.iter().map(|r| brute::closest(&flat, r)).collect();
        for accel in accels(&mesh, &poses) {
            let mut disagreements = 0;
            for (packet, truths) in rays.chunks(WIDTH).zip(truths.chunks(WIDTH)) {
                // Ends 1 % before and 1 % behind the first hit.
                for (stretch, expected) in [(0.99, false), (1.01, true)] {
                    let ended = packet.iter().zip(truths).map(|(ray, truth)| Ray {
                        t_max: truth.map_or(1000.0, |hit| hit.t) * stretch,
                        ..*ray
                    });
                    let bits = accel.occluded(&ended.collect::<Vec<_>>());
                    for (i, truth) in truths.iter().enumerate() {
                        let blocked = bits >> i & 1 == 1;
                        disagreements += usize::from(blocked != (expected && truth.is_some()));
                    }
                }
            }
            assert!(disagreements <= 1, "{disagreements}");
        }
    }
}

/// Tests nearest points to about 20 rounding errors of 4 m. Any starting triangle of the search
/// must give the same triangle and identical bits.
#[test]
fn nearest_points_are_those_of_the_flattened_mesh() {
    for (mesh, poses, flat) in assemblies() {
        let last = mesh.triangles.len() as u32 - 1;
        for accel in accels(&mesh, &poses) {
            let key = RngKey::new(23, Purpose::SensorNoise);
            for i in 0..600 {
                let middle = poses[i as usize % poses.len()].point(mesh.bounds().center());
                let p = middle + uniform(key, i, -12.0, 12.0);
                let truth = brute::nearest(&flat, p).unwrap();
                let found = accel.nearest(p, None);
                assert!((found.distance - truth.distance).abs() < 1e-11, "{p}");
                assert!((found.point.distance(p) - found.distance).abs() < 1e-11);
                for copy in [0, 5, found.face.copy] {
                    for triangle in [0, last, found.face.triangle] {
                        let close = Some(TriangleId { copy, triangle });
                        assert_eq!(accel.nearest(p, close), found, "{p}");
                    }
                }
            }
        }
    }
}

/// Tests rays at vertices and edges of nine balls, some of which overlap. Each ray must hit its
/// target or something before it.
#[test]
fn no_ray_is_lost_at_a_vertex_of_a_copy() {
    let mesh = shapes::sphere(4.0, 0.004).unwrap();
    let poses = poses(&mesh, 9, 20.0);
    for accel in accels(&mesh, &poses) {
        let key = RngKey::new(24, Purpose::SensorNoise);
        let (mut aimed, mut met) = (0, 0);
        for i in 0..40_000u64 {
            let pose = &poses[i as usize % poses.len()];
            let corners = mesh.triangle(i as usize % mesh.triangles.len());
            let along = key.with(i).uniform(7);
            let target = match i % 2 {
                0 => corners[0],
                _ => corners[0].lerp(corners[1], along),
            };
            let eye = pose.point(uniform(key, i, -60.0, 60.0));
            let ray = Ray {
                t_max: f64::INFINITY,
                ..Ray::between(eye, pose.point(target)).unwrap()
            };
            if ray.direction.dot(pose.vector(target)) > -0.4 {
                continue;
            }
            aimed += 1;
            let hit = accel.closest(&[ray], |_, _| true)[0];
            let hit = hit.unwrap_or_else(|| panic!("{ray:?} misses {target}"));
            let beyond = hit.t - eye.distance(pose.point(target));
            assert!(beyond < 1e-9, "{hit:?} is {beyond} beyond {target}");
            met += usize::from(beyond > -1e-9);
        }
        assert!(aimed > 10_000 && met > aimed / 3, "{met} of {aimed}");
    }
}

/// Tests that every triangle with a point in a slab is reported, individually or in a ball, with
/// the planes that it crosses. Distant instances must not be visited.
#[test]
fn what_touches_a_volume_is_found_in_every_copy() {
    for (mesh, poses, _) in assemblies() {
        let accel = Accel::build(&mesh.clone().into(), 1)
            .unwrap()
            .with_copies(poses.clone())
            .unwrap();
        let clusters = TriangleClusters::new(&mesh);
        let key = RngKey::new(25, Purpose::SensorNoise);
        let (mut touching, mut copies) = (0, 0);
        for i in 0..60 {
            let at = poses[i as usize % 12].point(mesh.bounds().center());
            let n = uniform(key, i, -1.0, 1.0);
            let volume = [n, -n].map(|n| HalfSpace::new(at, n).widened(0.3));
            for detail in [0.0, 2.0] {
                let (mut faces, mut balls) = (std::collections::BTreeMap::new(), Vec::new());
                accel.touching(&clusters, &volume, detail, |what| match what {
                    ClusterHit::Triangle { face, crossed } => {
                        assert_eq!(faces.insert(face, crossed), None);
                    }
                    ClusterHit::Ball { center, radius } => balls.push((center, radius)),
                });
                for face in (0..12).flat_map(|copy| {
                    (0..mesh.triangles.len() as u32)
                        .map(move |triangle| TriangleId { copy, triangle })
                }) {
                    let corners = accel.corners(face);
                    let inside = |half: &HalfSpace| corners.map(|p| half.height(p) >= 0.0);
                    let [a, b] = [0, 1].map(|j| inside(&volume[j]));
                    let touches = (0..3).any(|k| a[k] && b[k]);
                    touching += usize::from(touches);
                    let in_ball = |&(center, radius): &(DVec3, f64)| {
                        corners.iter().all(|p| p.distance(center) <= radius)
                    };
                    match faces.get(&face) {
                        Some(crossed) => {
                            assert!(crossed & 1 == 1 || a == [true; 3]);
                            assert!(crossed & 2 == 2 || b == [true; 3]);
                        }
                        None => assert!(!touches || balls.iter().any(in_ball), "{face:?}"),
                    }
                }
                let seen: std::collections::BTreeSet<u32> = faces.keys().map(|f| f.copy).collect();
                copies += seen.len();
            }
        }
        // If the instances are far apart, a slab cuts its target instance. It cuts each of the 11
        // others, about 15 mm in size within 3 m, with probability 1/100.
        let middles = poses.iter().map(|pose| pose.point(mesh.bounds().center()));
        let far = Aabb::of(middles).size().max_element() > 1000.0;
        assert!(touching > 1_000, "{touching}");
        assert!(!far || copies < 2 * 120, "{copies}");
    }
}

/// Tests that one instance with the identity pose gives the bits of the mesh itself, by the same
/// code.
#[test]
fn a_copy_unmoved_is_the_mesh_itself() {
    let mesh = soup();
    let unmoved = [Rigid::IDENTITY];
    for (alone, copy) in accels(&mesh, &unmoved).zip(accels(&mesh, &unmoved)) {
        assert!(copy.copies.is_none());
        let alone = Accel {
            copies: None,
            ..alone
        };
        let placed = Accel {
            copies: Some(InstanceBvh::new(unmoved.into(), &mesh.bounds())),
            ..copy
        };
        // The code for instances agrees to rounding.
        assert_eq!(placed.bounds(), alone.bounds());
        assert_eq!(placed.largest_coordinate(), alone.largest_coordinate());
        for packet in rays_at(&mesh, 4_000).chunks(WIDTH) {
            let [a, b] = [&alone, &placed].map(|accel| accel.closest(packet, |_, _| true));
            assert_eq!(a, b);
            assert_eq!(alone.occluded(packet), placed.occluded(packet));
        }
    }
}

/// Tests that 100 000 coincident instances neither hang nor overflow the stack.
#[test]
fn equal_poses_are_no_trouble() {
    let mesh = shapes::plane([2.0, 2.0].into()).unwrap();
    let poses = vec![Rigid::translation(DVec3::Z); 100_000];
    let accel = Accel::build(&mesh.clone().into(), 1)
        .unwrap()
        .with_copies(poses.clone())
        .unwrap();
    let ray = Ray {
        origin: DVec3::new(0.3, 0.2, 5.0),
        direction: -DVec3::Z,
        t_max: 10.0,
    };
    let hit = accel.closest(&[ray], |_, _| true)[0].unwrap();
    assert_eq!((hit.t, hit.face.copy), (4.0, 0));
    assert_eq!(accel.nearest(DVec3::ZERO, None).face.copy, 0);
    assert_eq!(accel.occluded(&[ray]), 1);
}
