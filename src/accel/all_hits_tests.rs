//! Tests of all hits along rays against brute force, at vertices and edges, and of instances.

use super::super::hierarchy::tests::{rays_at, soup};
use super::super::{Backend, brute};
use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::{Mesh, shapes};
use std::path::Path;
use std::sync::Arc;

fn accels(mesh: &Mesh) -> Vec<Accel> {
    let mesh = Arc::new(mesh.clone());
    let backends = Backend::ALL.iter();
    let built = backends.map(|&backend| Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap());
    built.collect()
}

fn uniform(key: RngKey, i: u64, half: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        (key.with(i).uniform(j as u64) * 2.0 - 1.0) * half
    }))
}

fn all(accel: &Accel, rays: &[Ray]) -> AllHits {
    accel.all_hits(|i| rays[i], rays.len(), usize::MAX).unwrap()
}

/// Returns the example part, which has slivers and long triangles.
fn bracket() -> Mesh {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/bracket.stl");
    crate::mesh::load(&file, 1.0).unwrap()
}

/// Returns the meshes of the tests: loose triangles, closed parts, a part with triangles without
/// area, and a part at 10⁶ mm from the origin.
fn meshes() -> Vec<Mesh> {
    let mut far = shapes::sphere(10.0, 0.2).unwrap();
    far.positions
        .iter_mut()
        .for_each(|p| *p += DVec3::new(1e6, -1e6, 1e6));
    let mut flat = shapes::step_block(DVec3::new(12.0, 9.0, 7.0), 2.0).unwrap();
    let count = flat.positions.len() as u32;
    (flat.triangles).extend((0..count - 2).flat_map(|i| [[i, i, i + 1], [i + 2; 3]]));
    vec![
        soup(),
        shapes::sphere(10.0, 0.2).unwrap(),
        bracket(),
        flat,
        far,
    ]
}

/// Tests random rays, which pass no edge within rounding: the hits are those of brute force.
///
/// A distance has an error of about ten rounding errors of the largest coordinate, divided by the
/// cosine of incidence, and by the ratio of height to longest side that limits the normal.
fn equal_to_brute_force(seed: u64, rays_per_mesh: u64) {
    let key = RngKey::new(seed, Purpose::RaceRays);
    let mut total = 0;
    for mesh in meshes() {
        let (center, half) = (mesh.bounds().center(), mesh.bounds().size() / 2.0);
        let rays: Vec<Ray> = (0..rays_per_mesh)
            .map(|i| {
                let origin = center + uniform(key, 2 * i, 1.0) * half * 2.0;
                let target = center + uniform(key, 2 * i + 1, 1.0) * half;
                let end = [f64::INFINITY, 0.7][(i % 4 == 3) as usize];
                Ray {
                    origin,
                    direction: target - origin,
                    t_max: end,
                }
            })
            .collect();
        let results: Vec<AllHits> = accels(&mesh)
            .iter()
            .map(|accel| all(accel, &rays))
            .collect();
        assert!(
            results.iter().all(|hits| hits == &results[0]),
            "the backends differ"
        );
        let hits = &results[0];
        let largest = (center.abs() + 3.0 * half).max_element();
        for (i, ray) in rays.iter().enumerate() {
            let expected = brute::all(&mesh, ray);
            let entering = &hits.entering[hits.starts[i]..hits.starts[i + 1]];
            let found = hits.of(i);
            assert_eq!(
                found.len(),
                expected.len(),
                "{ray:?} {found:?} {expected:?}"
            );
            assert!(found.is_sorted_by(|a, b| a.distance <= b.distance));
            for ((hit, &entering), expected) in found.iter().zip(entering).zip(expected) {
                let length = ray.direction.length();
                let corners = mesh.triangle(hit.triangle as usize);
                let across = crate::accel::refine::across(corners);
                let [a, b, c] = corners;
                let sides = [a.distance(b), b.distance(c), c.distance(a)];
                let longest = sides.into_iter().fold(0.0, f64::max);
                let (across, height) = (across.normalize(), across.length() / longest);
                let cosine = across.dot(ray.direction / length).abs();
                let off = (hit.distance - expected.0).abs() * length;
                assert!(
                    off <= 20.0 * f64::EPSILON * largest / cosine * (longest / height).max(1.0),
                    "{hit:?} {expected:?}"
                );
                // Hits at one distance within rounding may be exchanged.
                assert!((hit.triangle, entering) == (expected.1, expected.2) || off > 0.0);
            }
            total += found.len();
        }
    }
    assert!(total as u64 > rays_per_mesh, "{total}");
}

#[test]
fn all_hits_equal_brute_force() {
    for seed in [41, 42, 43] {
        equal_to_brute_force(seed, 400);
    }
}

#[test]
#[ignore = "long form of all_hits_equal_brute_force: 10⁶ rays, some minutes"]
fn all_hits_of_a_million_rays_equal_brute_force() {
    equal_to_brute_force(44, 200_000);
}

/// Tests rays at every vertex and edge of closed meshes, from all directions, at small and large
/// coordinates. Each infinite line enters and leaves equally often, and never leaves more often.
/// A hit is at the target, unless the target is on the outline.
fn balanced_at_vertices_and_edges(seed: u64, per_target: u64) {
    let key = RngKey::new(seed, Purpose::RaceRays);
    for mesh in &meshes()[1..] {
        let (center, size) = (mesh.bounds().center(), mesh.bounds().size().length());
        let targets = (0..mesh.triangles.len()).flat_map(|i| {
            let [a, b, c] = mesh.triangle(i);
            [a, a.midpoint(b), b.lerp(c, 0.3)]
        });
        let step = mesh.triangles.len().div_ceil(100);
        let targets: Vec<DVec3> = targets.step_by(step).collect();
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let rays: Vec<Ray> = (0..targets.len() as u64 * per_target)
            .map(|i| {
                let target = targets[(i / per_target) as usize];
                let direction = match i % per_target {
                    k @ 0..3 => axes[k as usize],
                    3 => targets[(i * 7919) as usize % targets.len()] - target,
                    _ => uniform(key, i, 1.0),
                };
                let direction = direction.try_normalize().unwrap_or(DVec3::Z);
                let origin = target - 2.0 * size * direction;
                Ray {
                    origin,
                    direction,
                    t_max: f64::INFINITY,
                }
            })
            .collect();
        let accel = &accels(mesh)[0];
        let hits = all(accel, &rays);
        let mut counts = vec![7; rays.len()];
        accel.count_hits(|i| rays[i], &mut counts).unwrap();
        let mut at_target = 0;
        for (i, ray) in rays.iter().enumerate() {
            let range = hits.starts[i]..hits.starts[i + 1];
            assert_eq!(counts[i], range.len() as u64);
            let signs = hits.entering[range]
                .iter()
                .map(|&enters| if enters { 1 } else { -1 });
            assert_eq!(signs.sum::<i32>(), 0, "{ray:?} {:?}", hits.of(i));
            let near = |hit: &SurfacePoint| (hit.distance - 2.0 * size).abs() < 1e-3 * size;
            let number = hits.of(i).iter().filter(|hit| near(hit)).count();
            at_target += usize::from(number > 0);
        }
        assert!(
            at_target * 3 > rays.len(),
            "{at_target} of {} at {center}",
            rays.len()
        );
    }
}

#[test]
fn rays_at_vertices_and_edges_of_closed_meshes_enter_and_leave_equally_often() {
    for seed in [51, 52, 53] {
        balanced_at_vertices_and_edges(seed, 6);
    }
}

/// Tests that the first of all hits is the hit of `closest_hits` with the Rust backend, for rays
/// that pass no outline.
#[test]
fn the_first_hit_is_the_closest_hit() {
    let mesh = soup();
    let accel = Accel::build_with(Backend::Rust, &Arc::new(mesh.clone()), 1, &|_| Ok(())).unwrap();
    let rays = rays_at(&mesh, 2_000);
    let mut closest = vec![SurfacePoint::MISS; rays.len()];
    accel.closest_hits(|i| rays[i], &mut closest).unwrap();
    let first = accel.all_hits(|i| rays[i], rays.len(), 1).unwrap();
    let without = accel.all_hits(|i| rays[i], rays.len(), 0).unwrap();
    assert!(without.points.is_empty() && without.starts == vec![0; rays.len() + 1]);
    for (i, closest) in closest.iter().enumerate() {
        let expected: Vec<SurfacePoint> =
            closest.is_some().then_some(*closest).into_iter().collect();
        assert_eq!(first.of(i), expected, "{i}");
    }
}

/// Tests that instances have the hits of a mesh with the triangles of all instances.
///
/// The poses round by 2⁻⁵³ of 100 mm in some ten operations; the tolerance is 100 of these errors.
#[test]
fn instances_have_the_hits_of_the_flattened_mesh() {
    let key = RngKey::new(61, Purpose::RaceRays);
    let mesh = shapes::step_block(DVec3::new(12.0, 9.0, 7.0), 2.0).unwrap();
    let poses: Vec<Rigid> = (0..8)
        .map(|i| Rigid::from_euler_xyz(uniform(key, 2 * i, 3.0), uniform(key, 2 * i + 1, 20.0)))
        .collect();
    let count = mesh.positions.len() as u32;
    let flat = Mesh {
        positions: poses
            .iter()
            .flat_map(|pose| mesh.positions.iter().map(|&p| pose.point(p)))
            .collect(),
        triangles: (0..8)
            .flat_map(|i| mesh.triangles.iter().map(move |t| t.map(|v| v + i * count)))
            .collect(),
    };
    let rays: Vec<Ray> = (0..2_000)
        .map(|i| {
            let origin = uniform(key, 100 + 2 * i, 60.0);
            Ray {
                origin,
                direction: uniform(key, 101 + 2 * i, 25.0) - origin,
                t_max: f64::INFINITY,
            }
        })
        .collect();
    let expected = all(&accels(&flat)[0], &rays);
    let results = accels(&mesh)
        .into_iter()
        .map(|accel| all(&accel.with_copies(poses.clone()).unwrap(), &rays));
    for hits in results {
        assert_eq!(
            (&hits.starts, &hits.entering),
            (&expected.starts, &expected.entering)
        );
        for (a, b) in hits.points.iter().zip(&expected.points) {
            let triangle = a.instance * mesh.triangles.len() as u32 + a.triangle;
            assert_eq!(triangle, b.triangle);
            let off = DVec3::from_array(a.point).distance(DVec3::from_array(b.point));
            assert!(off < 100.0 * 100.0 * f64::EPSILON, "{off}");
        }
    }
}

#[test]
fn invalid_rays_and_too_many_rays_are_errors() {
    let good = Ray {
        origin: DVec3::ZERO,
        direction: DVec3::X,
        t_max: f64::INFINITY,
    };
    for accel in accels(&soup()) {
        let invalid = [
            (
                Ray {
                    origin: DVec3::NAN,
                    ..good
                },
                "origin",
            ),
            (
                Ray {
                    origin: DVec3::INFINITY,
                    ..good
                },
                "origin",
            ),
            (
                Ray {
                    direction: DVec3::ZERO,
                    ..good
                },
                "direction",
            ),
            (
                Ray {
                    direction: DVec3::splat(f64::INFINITY),
                    ..good
                },
                "direction",
            ),
            (
                Ray {
                    t_max: f64::NAN,
                    ..good
                },
                "t_max",
            ),
            (
                Ray {
                    t_max: -1.0,
                    ..good
                },
                "t_max",
            ),
        ];
        for (ray, word) in invalid {
            let rays = |i| if i == 700 { ray } else { good };
            let mut counts = vec![9; 1000];
            for error in [
                accel.all_hits(rays, 1000, usize::MAX).unwrap_err(),
                accel.count_hits(rays, &mut counts).unwrap_err(),
            ] {
                let message = error.to_string();
                assert!(message.contains(&format!("ray 700: {word}")), "{message}");
            }
            assert!(counts.iter().all(|&count| count == 0));
        }
        let many = accel.all_hits(|_| good, usize::MAX, 1).unwrap_err();
        assert!(matches!(many, Error::Memory { .. }), "{many}");
        assert_eq!(all(&accel, &[]).starts, [0]);
    }
}

/// Tests moved instances, among them moves far outside the earlier box: results are equal to the
/// results of a new tree over the poses.
#[test]
fn moved_instances_have_the_hits_of_a_new_tree() {
    let mesh = shapes::step_block(DVec3::new(12.0, 9.0, 7.0), 2.0).unwrap();
    for seed in [71, 72, 73] {
        let key = RngKey::new(seed, Purpose::RaceRays);
        let pose = |i: u64, far: f64| {
            Rigid::from_euler_xyz(uniform(key, 2 * i, 3.0), uniform(key, 2 * i + 1, far))
        };
        let initial: Vec<Rigid> = (0..60).map(|i| pose(i, 100.0)).collect();
        for &backend in Backend::ALL {
            let placed = |poses: &[Rigid]| {
                let mesh = Arc::new(mesh.clone());
                let accel = Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap();
                accel.with_copies(poses).unwrap()
            };
            let mut poses = initial.clone();
            let mut moved = placed(&poses);
            for step in 0..4u64 {
                let far = [100.0, 100.0, 3000.0, 100.0][step as usize];
                let moves: Vec<(usize, Rigid)> = (0..10)
                    .map(|i| {
                        (
                            (key.uniform(90 + i) * 60.0) as usize,
                            pose(1000 + 10 * step + i, far),
                        )
                    })
                    .collect();
                moves.iter().for_each(|&(i, pose)| poses[i] = pose);
                moved.move_instances(moves).unwrap();
                let new = placed(&poses);
                assert_eq!(moved.poses(), new.poses());
                assert_eq!(moved.bounds(), new.bounds());
                same_results(&moved, &new, key.with(step), 150);
            }
        }
        let mut alone = Accel::build(&Arc::new(mesh.clone()), 1).unwrap();
        alone.move_instances([(0, pose(5, 10.0))]).unwrap();
        let placed = Accel::build(&Arc::new(mesh.clone()), 1)
            .unwrap()
            .with_copies([pose(5, 10.0)])
            .unwrap();
        same_results(&alone, &placed, key, 500);
        let wrong = alone
            .move_instances([(1, Rigid::IDENTITY)])
            .unwrap_err()
            .to_string();
        assert!(wrong.contains("instance 1"), "{wrong}");
        let wrong = Rigid::translation(DVec3::NAN);
        assert!(alone.move_instances([(0, wrong)]).is_err());
        same_results(&alone, &placed, key, 100);
    }
}

/// Tests three successive refits of each backend: results are equal to the results of a new build.
#[test]
fn refitted_meshes_have_the_hits_of_a_new_build() {
    for mesh in [soup(), bracket(), shapes::sphere(10.0, 0.05).unwrap()] {
        let key = RngKey::new(81, Purpose::RaceRays);
        // Below 5 % of the largest side, also along the diagonal.
        let step = 0.028 * mesh.bounds().size().max_element();
        for &backend in Backend::ALL {
            let build = |mesh: &Mesh| {
                Accel::build_with(backend, &Arc::new(mesh.clone()), 1, &|_| Ok(())).unwrap()
            };
            let mut accel = build(&mesh);
            // Builds the hierarchy for all hits before the refit, too.
            all(&accel, &rays_at(&mesh, 1));
            for round in 0..3u64 {
                let key = key.with(round);
                let positions = mesh.positions.iter().zip(0..);
                let positions: Vec<DVec3> =
                    positions.map(|(&p, i)| p + uniform(key, i, step)).collect();
                accel = accel.refit(positions.iter().copied()).unwrap();
                let moved = Mesh {
                    positions,
                    triangles: mesh.triangles.clone(),
                };
                assert_eq!(**accel.mesh(), moved);
                same_results(&accel, &build(&moved), key, 2_000);
            }
            let too_far = mesh.positions.iter().map(|&p| p + 4.0 * step);
            let error = build(&mesh).refit(too_far).err().unwrap().to_string();
            assert!(error.contains("vertex 0 moved by"), "{error}");
            assert!(build(&mesh).refit([DVec3::ZERO]).is_err());
            assert!(
                build(&mesh)
                    .refit(mesh.positions.iter().map(|_| DVec3::NAN))
                    .is_err()
            );
        }
    }
}

fn same_results(one: &Accel, other: &Accel, key: RngKey, count: u64) {
    let half = one.bounds().size().max_element();
    let below = |i: u64, count: usize| (key.uniform(i) * count as f64) as u32;
    let rays: Vec<Ray> = (0..count)
        .map(|i| {
            let copy = below(2 * i, one.poses().len());
            let triangle = below(2 * i + 1, one.mesh().triangles.len());
            let [a, b, c] = one.corners(TriangleId { copy, triangle });
            let target = (a + b + c) / 3.0;
            let direction = uniform(key, i, half);
            Ray {
                origin: target - direction,
                direction,
                t_max: f64::INFINITY,
            }
        })
        .collect();
    let results = [one, other].map(|accel| {
        let [mut hits, mut nearest] = [0; 2].map(|_| vec![SurfacePoint::MISS; rays.len()]);
        accel.closest_hits(|i| rays[i], &mut hits).unwrap();
        accel
            .nearest_points(|i| rays[i].origin, &mut nearest)
            .unwrap();
        let mut any = vec![false; rays.len()];
        accel.occluded_batch(|i| rays[i], &mut any).unwrap();
        (hits, nearest, any, all(accel, &rays))
    });
    assert!(results[0].2.iter().filter(|&&hit| hit).count() > rays.len() / 2);
    let [one, other] = results;
    assert_eq!(one.0, other.0);
    assert_eq!(one.1, other.1);
    assert_eq!(one.2, other.2);
    assert_eq!(one.3, other.3);
}
