//! An assembly against its flattened twin: the vertices of every copy moved in f64 into
//! one mesh, and all of its triangles tried.

use super::super::brute;
use super::super::hierarchy::tests::{rays_at, soup};
use super::*;
use crate::math::rng::{Key, Purpose};
use crate::mesh::shapes;
use std::sync::Arc;

fn uniform(key: Key, i: u64, low: f64, high: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        low + (high - low) * key.with(i).uniform(j as u64)
    }))
}

/// Turned at random, with the middles of the mesh in a cube of so many mm.
fn poses(mesh: &Mesh, count: u64, width: f64) -> Vec<Rigid> {
    let key = Key::new(21, Purpose::SensorNoise);
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

/// The same as one mesh: triangle t of copy c is number c·n + t of n a copy.
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

/// The assembly under every backend that is built in.
fn accels(mesh: &Mesh, poses: &[Rigid]) -> impl Iterator<Item = Accel> {
    let mesh = Arc::new(mesh.clone());
    Backend::ALL.iter().map(move |&backend| {
        let accel = Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap();
        accel.with_copies(poses).unwrap()
    })
}

/// 12 copies of a soup of triangles of 1 mm in 10 mm, whose own origin is 4 m away, in
/// cubes of 8 mm (all overlap), 40 mm (some do) and 3 m (far apart).
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

fn number(face: Face, mesh: &Mesh) -> u32 {
    face.copy * mesh.triangles.len() as u32 + face.triangle
}

/// Rays from 200 mm and more at places in the copies, a packet beside each other.
fn rays(mesh: &Mesh, poses: &[Rigid], count: usize) -> Vec<Ray> {
    let at_mesh = rays_at(mesh, count as u64);
    let key = Key::new(22, Purpose::SensorNoise);
    let packets = at_mesh.chunks(WIDTH).enumerate().flat_map(|(i, packet)| {
        let pose = &poses[i % poses.len()];
        let first = packet[0];
        packet.iter().enumerate().map(move |(k, ray)| {
            let aside = uniform(key.with(i as u64), k as u64, -0.02, 0.02);
            // Every fourth packet runs all ways.
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

/// Where both hit the same triangle they agree to rounding: 4000 mm and 3 m round at
/// 1e-12 a step, some 20 steps there and back, over the cosine. Elsewhere the ray
/// passes an edge closer than f32 resolves, as in `hierarchy_tests`: more than 3 of
/// 24 000 (of an expected 0.3) would be a defect.
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

/// With a limit below which hits are not wanted, a ray that meets something before it
/// meets nothing, and one that does not meets what it did.
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

/// To some 20 roundings of 4 m; and from whatever triangle the search starts, to the
/// same triangle and the same bits.
#[test]
fn nearest_points_are_those_of_the_flattened_mesh() {
    for (mesh, poses, flat) in assemblies() {
        let last = mesh.triangles.len() as u32 - 1;
        for accel in accels(&mesh, &poses) {
            let key = Key::new(23, Purpose::SensorNoise);
            for i in 0..600 {
                let middle = poses[i as usize % poses.len()].point(mesh.bounds().center());
                let p = middle + uniform(key, i, -12.0, 12.0);
                let truth = brute::nearest(&flat, p).unwrap();
                let found = accel.nearest(p, None);
                assert!((found.distance - truth.distance).abs() < 1e-11, "{p}");
                assert!((found.point.distance(p) - found.distance).abs() < 1e-11);
                for copy in [0, 5, found.face.copy] {
                    for triangle in [0, last, found.face.triangle] {
                        let close = Some(Face { copy, triangle });
                        assert_eq!(accel.nearest(p, close), found, "{p}");
                    }
                }
            }
        }
    }
}

/// Rays at vertices and edges of nine balls, some of which stand in each other: each
/// meets what it is aimed at, or something before.
#[test]
fn no_ray_is_lost_at_a_vertex_of_a_copy() {
    let mesh = shapes::sphere(4.0, 0.004).unwrap();
    let poses = poses(&mesh, 9, 20.0);
    for accel in accels(&mesh, &poses) {
        let key = Key::new(24, Purpose::SensorNoise);
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

/// Every triangle that has a point in a slab is found, alone or in a ball, with the
/// planes that it crosses; and copies far from it are not looked at.
#[test]
fn what_touches_a_volume_is_found_in_every_copy() {
    for (mesh, poses, _) in assemblies() {
        let accel = Accel::build(&mesh.clone().into(), 1)
            .unwrap()
            .with_copies(poses.clone())
            .unwrap();
        let clusters = Clusters::new(&mesh);
        let key = Key::new(25, Purpose::SensorNoise);
        let (mut touching, mut copies) = (0, 0);
        for i in 0..60 {
            let at = poses[i as usize % 12].point(mesh.bounds().center());
            let n = uniform(key, i, -1.0, 1.0);
            let volume = [n, -n].map(|n| HalfSpace::new(at, n).widened(0.3));
            for detail in [0.0, 2.0] {
                let (mut faces, mut balls) = (std::collections::BTreeMap::new(), Vec::new());
                accel.touching(&clusters, &volume, detail, |what| match what {
                    Found::Triangle { face, crossed } => {
                        assert_eq!(faces.insert(face, crossed), None);
                    }
                    Found::Ball { center, radius } => balls.push((center, radius)),
                });
                for face in (0..12).flat_map(|copy| {
                    (0..mesh.triangles.len() as u32).map(move |triangle| Face { copy, triangle })
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
        // Far apart a slab cuts the copy it is laid through, and each of the 11 others,
        // some 15 mm in 3 m, with chance 1/100.
        let middles = poses.iter().map(|pose| pose.point(mesh.bounds().center()));
        let far = Aabb::of(middles).size().max_element() > 1000.0;
        assert!(touching > 1_000, "{touching}");
        assert!(!far || copies < 2 * 120, "{copies}");
    }
}

/// One copy unmoved is the mesh: the same bits, by the same way.
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
            copies: Some(Copies::new(unmoved.into(), &mesh.bounds())),
            ..copy
        };
        // And by the other way to rounding.
        assert_eq!(placed.bounds(), alone.bounds());
        assert_eq!(placed.largest_coordinate(), alone.largest_coordinate());
        for packet in rays_at(&mesh, 4_000).chunks(WIDTH) {
            let [a, b] = [&alone, &placed].map(|accel| accel.closest(packet, |_, _| true));
            assert_eq!(a, b);
            assert_eq!(alone.occluded(packet), placed.occluded(packet));
        }
    }
}

/// A hundred thousand copies at one place neither hang nor overflow a stack.
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
