//! Tests of many rays per call: at vertices and edges, against brute force, with both backends and
//! any number of threads. Also tests invalid rays.

use super::super::hierarchy::tests::{rays_at, soup};
use super::super::{Backend, brute};
use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{Aabb, Rigid};
use crate::mesh::{Mesh, shapes};
use std::sync::Arc;

/// Previous content of a buffer, to detect elements that are not overwritten.
const STALE: SurfacePoint = SurfacePoint {
    distance: -7.0,
    point: [-7.0; 3],
    barycentric: [-7.0; 2],
    triangle: 7,
    instance: 7,
};

fn accels(mesh: &Mesh) -> Vec<Accel> {
    let mesh = Arc::new(mesh.clone());
    let backends = Backend::ALL.iter();
    let built = backends.map(|&backend| Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap());
    built.collect()
}

fn closest(accel: &Accel, rays: &[Ray]) -> Result<Vec<SurfacePoint>> {
    let mut hits = vec![STALE; rays.len()];
    accel.closest_hits(|i| rays[i], &mut hits).map(|()| hits)
}

fn any(accel: &Accel, rays: &[Ray]) -> Vec<bool> {
    let mut hit = vec![true; rays.len()];
    accel.occluded_batch(|i| rays[i], &mut hit).unwrap();
    hit
}

fn uniform(key: RngKey, i: u64, half: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        (key.with(i).uniform(j as u64) * 2.0 - 1.0) * half
    }))
}

/// Returns rays from outside at every vertex and at points on every edge of a sphere about
/// `middle`, with the distance to their target.
fn at_vertices_and_edges(mesh: &Mesh, middle: DVec3) -> Vec<(Ray, f64)> {
    let key = RngKey::new(31, Purpose::SensorNoise);
    let edges = (0..mesh.triangles.len()).flat_map(|i| {
        let [a, b, c] = mesh.triangle(i);
        let share = key.with(i as u64).uniform(9);
        [a, a.lerp(b, share), b.lerp(c, 0.5), c.lerp(a, share)]
    });
    let aimed = edges.enumerate().map(|(i, target)| {
        // Within 40° of the normal of the sphere, so no facet is visible from its back.
        let outward = (target - middle).normalize();
        let origin = target + 30.0 * outward + uniform(key, i as u64, 14.0);
        let ray = Ray {
            origin,
            direction: target - origin,
            t_max: f64::INFINITY,
        };
        (ray, origin.distance(target))
    });
    aimed.collect()
}

/// Tests that no ray is lost and that each hits the sphere at its target.
///
/// The tolerance is the rounding of coordinates up to 9000 mm (2⁻⁵³ of them is 1e-12 mm), for about
/// ten operations over a cosine above 0.6. Next to an edge, `resolution` times the angle between
/// its facets, 0.1, is added.
#[test]
fn rays_at_vertices_and_edges_of_a_closed_mesh_all_meet_it() {
    let mut mesh = shapes::sphere(10.0, 0.05).unwrap();
    let middle = DVec3::new(4000.0, -9000.0, 120.0);
    for position in &mut mesh.positions {
        *position += middle;
    }
    let (rays, lengths): (Vec<Ray>, Vec<f64>) =
        at_vertices_and_edges(&mesh, middle).into_iter().unzip();
    assert!(rays.len() > 1_000, "{}", rays.len());
    for accel in accels(&mesh) {
        let hits = closest(&accel, &rays).unwrap();
        for ((hit, ray), length) in hits.iter().zip(&rays).zip(&lengths) {
            assert!(hit.is_some(), "lost: {ray:?}");
            // The direction extends to the target, where t is 1.
            let off = (hit.distance - 1.0) * length;
            assert!(off.abs() < 1e-10 + 0.1 * accel.resolution(), "{off}");
            check(&accel, hit);
        }
        assert!(any(&accel, &rays).into_iter().all(|hit| hit));
    }
}

/// Tests that no ray from inside a ball is lost. At the vertices, Embree without correction loses
/// one ray in some hundreds: 165 of the rays from one origin.
///
/// A lost ray would hit nothing, or the front of a second ball behind. The tolerance is the
/// rounding of coordinates up to 120 mm, as above, with cosines above 0.8.
#[test]
fn rays_from_inside_at_vertices_and_edges_all_meet_the_surface_around_them() {
    let mut mesh = shapes::sphere(10.0, 1e-3).unwrap();
    let (count, far) = (mesh.triangles.len(), shapes::sphere(40.0, 0.1).unwrap());
    mesh.append(&far, &Rigid::translation(80.0 * DVec3::X));
    let key = RngKey::new(33, Purpose::SensorNoise);
    let rays = |starts: f64| -> Vec<Ray> {
        let ray = |i: usize| {
            let [a, b, c] = mesh.triangle(i);
            let origin = DVec3::new(1.0, -2.0, 1.5) + uniform(key, i as u64, starts);
            [a, a.midpoint(b), b, c.midpoint(a)].map(|target| Ray {
                origin,
                direction: target - origin,
                t_max: f64::INFINITY,
            })
        };
        (0..count).flat_map(ray).collect()
    };
    for accel in accels(&mesh) {
        // All rays from one origin, and from many origins.
        for rays in [rays(0.0), rays(2.0)] {
            assert!(rays.len() > 40_000, "{}", rays.len());
            for (hit, ray) in closest(&accel, &rays).unwrap().iter().zip(&rays) {
                let off = (hit.distance - 1.0) * ray.direction.length();
                assert!(
                    off.abs() < 1e-12 + 0.1 * accel.resolution(),
                    "{off}: {ray:?}"
                );
            }
            assert!(any(&accel, &rays).into_iter().all(|hit| hit));
        }
    }
}

/// Checks that the barycentric coordinates are valid and reproduce the point. The tolerance is
/// `resolution`, the largest distance of a hit from its triangle, plus rounding.
fn check(accel: &Accel, hit: &SurfacePoint) {
    let [u, v] = hit.barycentric;
    assert!(u >= 0.0 && v >= 0.0 && u + v <= 1.0, "{u} {v}");
    let [a, b, c] = accel.corners(TriangleId {
        copy: hit.instance,
        triangle: hit.triangle,
    });
    let place = a * (1.0 - u - v) + b * u + c * v;
    let off = place.distance(DVec3::from_array(hit.point));
    assert!(off <= 2.0 * accel.resolution(), "{off}");
}

/// Tests hits against brute force. As in `hierarchy_tests`, at most one of 8 000 rays at loose
/// triangles passes an edge within the f32 resolution. Half of the directions are not of unit
/// length.
#[test]
fn hits_are_those_of_brute_force_in_units_of_the_direction() {
    let mesh = soup();
    let unit = rays_at(&mesh, 8_000);
    let length = |i: usize| [1.0, 0.37][i & 1];
    let given = |(i, ray): (usize, &Ray)| Ray {
        direction: ray.direction * length(i),
        ..*ray
    };
    let rays: Vec<Ray> = unit.iter().enumerate().map(given).collect();
    for accel in accels(&mesh) {
        let hits = closest(&accel, &rays).unwrap();
        let (mut met, mut disagreements) = (0, 0);
        for (i, (hit, ray)) in hits.iter().zip(&unit).enumerate() {
            match brute::closest(&mesh, ray) {
                None if *hit == SurfacePoint::MISS => {}
                Some(truth) if truth.face.triangle == hit.triangle => {
                    let slant = truth.normal.dot(ray.direction).abs();
                    let off = hit.distance * length(i) - truth.t;
                    assert!(off.abs() < 1e-10 / slant, "{off}");
                    check(&accel, hit);
                    met += 1;
                }
                _ => disagreements += 1,
            }
        }
        assert!(met > 500 && disagreements <= 1, "{met} {disagreements}");
        let some: Vec<bool> = hits.iter().map(SurfacePoint::is_some).collect();
        assert_eq!(any(&accel, &rays), some);
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let mesh = soup();
    let rays = rays_at(&mesh, 5_003);
    let poses = [Rigid::IDENTITY, Rigid::translation(DVec3::X * 4.0)];
    for accel in accels(&mesh) {
        let accel = accel.with_copies(poses).unwrap();
        let mut runs = [1, 2, 3].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            pool.build().unwrap().install(|| {
                let mut nearest = vec![STALE; rays.len()];
                accel
                    .nearest_points(|i| rays[i].origin, &mut nearest)
                    .unwrap();
                (closest(&accel, &rays).unwrap(), nearest)
            })
        });
        let last = runs[2].clone();
        assert!(runs.iter_mut().all(|run| *run == last));
        let instances: Vec<u32> = last.0.iter().map(|hit| hit.instance).collect();
        assert!([0, 1, u32::MAX].iter().all(|i| instances.contains(i)));
        last.0
            .iter()
            .filter(|hit| hit.is_some())
            .for_each(|hit| check(&accel, hit));
        last.1.iter().for_each(|place| check(&accel, place));
    }
}

/// Tests that `t_max` is exact to the next representable f64.
#[test]
fn t_max_is_kept_to_the_last_digit() {
    let mesh = Mesh::from_triangles([DVec3::ZERO, DVec3::X, DVec3::Y], [[0, 1, 2]]).unwrap();
    let ray = |t_max: f64| Ray {
        origin: DVec3::new(0.3, 0.3, 7.0),
        direction: -DVec3::Z,
        t_max,
    };
    for accel in accels(&mesh) {
        let hits = closest(&accel, &[7f64.next_down(), 7.0, 7f64.next_up()].map(ray)).unwrap();
        assert_eq!(
            [0, 1, 2].map(|i| hits[i].distance),
            [f64::INFINITY, 7.0, 7.0]
        );
        assert_eq!(hits[0], SurfacePoint::MISS);
    }
}

/// Tests rays from slightly above, on and below a plane, in both normal directions, with a second
/// plane below. No distance is negative. Planes that differ by more than `resolution` in f64 are
/// distinguished.
#[test]
fn nothing_behind_the_origin_is_met() {
    let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    let square = |z: f64| {
        [
            corner(0.0, 0.0, z),
            corner(90.0, 0.0, z),
            corner(0.0, 90.0, z),
        ]
    };
    let mesh =
        Mesh::from_triangles([square(0.0), square(-5.0)].concat(), [[0, 1, 2], [3, 4, 5]]).unwrap();
    for accel in accels(&mesh) {
        let resolution = accel.resolution();
        for i in -400..=400 {
            // Up to 4 times the resolution on each side, in steps of a hundredth.
            let above = resolution * 0.01 * i as f64;
            let down = Ray {
                origin: corner(20.0 + 0.01 * i as f64, 30.0, above),
                direction: -DVec3::Z,
                t_max: f64::INFINITY,
            };
            let up = Ray {
                direction: DVec3::Z,
                ..down
            };
            let hits = closest(&accel, &[down, up]).unwrap();
            assert!(hits.iter().all(|hit| hit.distance >= 0.0), "{hits:?}");
            let expected = match above {
                a if a >= resolution => Some([a, f64::INFINITY]),
                a if a <= -resolution => Some([5.0 + a, -a]),
                _ => None,
            };
            if let Some(expected) = expected {
                for (hit, expected) in hits.iter().zip(expected) {
                    let same = hit.distance == expected;
                    assert!(
                        same || (hit.distance - expected).abs() < 1e-13,
                        "{i} {hit:?}"
                    );
                }
            } else {
                assert!(
                    hits[0].distance <= resolution
                        || (hits[0].distance - 5.0).abs() < 2.0 * resolution
                );
            }
        }
    }
}

/// Tests nearest points to 20 rounding errors of 4 m, and that each lies on the reported triangle.
#[test]
fn nearest_points_are_those_of_brute_force() {
    let mesh = soup();
    let key = RngKey::new(32, Purpose::SensorNoise);
    let center = mesh.bounds().center();
    let points: Vec<DVec3> = (0..1_000).map(|i| center + uniform(key, i, 20.0)).collect();
    for accel in accels(&mesh) {
        let mut nearest = vec![STALE; points.len()];
        accel.nearest_points(|i| points[i], &mut nearest).unwrap();
        for (place, &p) in nearest.iter().zip(&points) {
            let truth = brute::nearest(&mesh, p).unwrap();
            assert!((place.distance - truth.distance).abs() < 1e-11, "{p}");
            check(&accel, place);
        }
    }
}

fn message<T>(result: Result<T>) -> String {
    result.err().expect("it is refused").to_string()
}

#[test]
fn what_is_not_a_ray_is_named_and_leaves_nothing() {
    let mesh = soup();
    let good = rays_at(&mesh, 700);
    let with = |change: &dyn Fn(&mut Ray)| {
        let mut rays = good.clone();
        change(&mut rays[613]);
        change(&mut rays[650]);
        rays
    };
    let wrong: [(&str, Vec<Ray>); 9] = [
        ("origin", with(&|ray| ray.origin.y = f64::NAN)),
        ("origin", with(&|ray| ray.origin.x = f64::NEG_INFINITY)),
        ("origin", with(&|ray| ray.origin.z = 1e13)),
        ("direction", with(&|ray| ray.direction.z = f64::NAN)),
        ("direction", with(&|ray| ray.direction.z = f64::INFINITY)),
        ("direction", with(&|ray| ray.direction = DVec3::ZERO)),
        ("direction", with(&|ray| ray.direction *= 1e-300)),
        ("t_max", with(&|ray| ray.t_max = f64::NAN)),
        ("t_max", with(&|ray| ray.t_max = -1.0)),
    ];
    for accel in accels(&mesh) {
        for (what, rays) in &wrong {
            let mut hits = vec![STALE; rays.len()];
            let text = message(accel.closest_hits(|i| rays[i], &mut hits));
            assert!(text.starts_with(&format!("ray 613: {what}")), "{text}");
            assert!(hits.iter().all(|hit| *hit == SurfacePoint::MISS));
            let mut hit = vec![true; rays.len()];
            assert_eq!(text, message(accel.occluded_batch(|i| rays[i], &mut hit)));
            assert!(hit.iter().all(|hit| !hit));
        }
        let mut nearest = vec![STALE; 40];
        let point = |i: usize| DVec3::X / (31.0 - i as f64);
        let text = message(accel.nearest_points(point, &mut nearest));
        assert!(text.starts_with("point 31: "), "{text}");
        assert!(nearest.iter().all(|hit| *hit == SurfacePoint::MISS));
        assert!(
            accel
                .closest_hits(|_| panic!("there is no ray"), &mut [])
                .is_ok()
        );
    }
}

#[test]
fn what_is_not_a_mesh_is_named() {
    let corners = [DVec3::ZERO, DVec3::X, DVec3::Y];
    let with = |vertex: DVec3| [corners[0], corners[1], vertex];
    let wrong = [
        (with(DVec3::NAN), vec![[0, 1, 2]], "vertex 2 is "),
        (with(DVec3::INFINITY), vec![[0, 1, 2]], "vertex 2 is "),
        (with(DVec3::X * 1e13), vec![[0, 1, 2]], "vertex 2 is "),
        (
            corners,
            vec![[0, 1, 2], [0, 1, 3]],
            "triangle 1 uses vertex 3",
        ),
        (corners, vec![], "0 triangles"),
    ];
    for (vertices, triangles, expected) in wrong {
        let text = message(Mesh::from_triangles(vertices, triangles));
        assert!(text.starts_with(expected), "{text}");
    }
    // An unused vertex is not in the box.
    let vertices = [DVec3::X * 1e9, DVec3::ZERO, DVec3::X, DVec3::Y];
    let mesh = Mesh::from_triangles(vertices, [[1, 2, 3]]).unwrap();
    assert_eq!(
        mesh.bounds(),
        Aabb::new(DVec3::ZERO, DVec3::new(1.0, 1.0, 0.0))
    );
    for accel in accels(&mesh) {
        assert!(message(accel.with_copies([])).starts_with("0 instances"));
    }
    for accel in accels(&mesh) {
        let poses = [Rigid::IDENTITY, Rigid::translation(DVec3::NAN)];
        assert!(message(accel.with_copies(poses)).starts_with("instance 1 "));
    }
}

/// Tests points, segments and slivers: rays hit no triangle without area. Each of them can be the
/// nearest triangle, with valid barycentric coordinates.
#[test]
fn triangles_without_area_are_nearest_but_not_met() {
    let meshes: [[DVec3; 3]; 3] = [
        [DVec3::ONE; 3],
        [DVec3::ZERO, DVec3::X, DVec3::X * 2.0],
        [DVec3::X * 2.0, DVec3::X * 2.0, DVec3::ZERO],
    ];
    for corners in meshes {
        let mesh = Mesh::from_triangles(corners, [[0, 1, 2]]).unwrap();
        for accel in accels(&mesh) {
            let rays = [DVec3::Z, DVec3::X, DVec3::new(0.5, 0.2, 1.0)].map(|from| Ray {
                origin: corners[0] + from,
                direction: -from,
                t_max: f64::INFINITY,
            });
            let hits = closest(&accel, &rays).unwrap();
            assert!(
                hits.iter().all(|hit| *hit == SurfacePoint::MISS),
                "{hits:?}"
            );
            let mut nearest = [STALE];
            let p = DVec3::new(1.25, 3.0, 4.0);
            accel.nearest_points(|_| p, &mut nearest).unwrap();
            let truth = brute::nearest(&mesh, p).unwrap();
            assert_eq!(nearest[0].distance, truth.distance);
            check(&accel, &nearest[0]);
        }
    }
}

/// Returns a number of any magnitude in the range of f64, of either sign, or a known special case.
fn of_any_size(key: RngKey, j: u64) -> f64 {
    let special = [0.0, f64::from_bits(1), f64::MIN_POSITIVE, 6.1e-17, 1.0];
    let pick = (key.uniform(4 * j) * 10.0) as usize;
    let size = match special.get(pick) {
        Some(&size) => size,
        None => 10f64.powf(-323.0 + 623.0 * key.uniform(4 * j + 1)),
    };
    size.copysign(key.uniform(4 * j + 2) - 0.5)
}

/// Returns sixteen rays, half of the time from one origin, like the packets of a frame. Some
/// directions are nearly parallel to an axis. Origins are within ten sizes of the part, or
/// anywhere.
fn rays_of_any_size(bounds: &Aabb, seed: u64, packet: u64) -> Vec<Ray> {
    let key = RngKey::new(seed, Purpose::SensorNoise).with(packet);
    let size = bounds.size().max_element();
    let (together, aimed) = (key.uniform(0) < 0.5, key.uniform(1) < 0.5);
    let axis = (key.uniform(2) * 3.0) as usize;
    let ray = |i: u64| {
        let own = key.with(100 + i);
        let from = if together { key.with(1) } else { own };
        let mut origin = bounds.center() + uniform(from, 1, 10.0 * size);
        if from.uniform(3) < 0.2 {
            let any = |j| of_any_size(from.with(2), j).clamp(-1e12, 1e12);
            origin = DVec3::from_array([0, 1, 2].map(any));
        }
        let mut direction = DVec3::from_array([0, 1, 2].map(|j| of_any_size(own.with(3), j)));
        if aimed {
            direction = bounds.center() + uniform(own, 4, 0.6 * size) - origin;
        } else if own.uniform(5) < 0.5 {
            // Nearly parallel to an axis.
            direction[axis] = 10f64.copysign(own.uniform(6) - 0.5);
            let shrink = own.uniform(7);
            direction[(axis + 1) % 3] *= if shrink < 0.5 { 0.0 } else { 1e-17 };
        }
        Ray {
            origin,
            direction,
            t_max: match own.uniform(8) < 0.5 {
                true => f64::INFINITY,
                false => of_any_size(own.with(9), 0).abs(),
            },
        }
    };
    (0..WIDTH as u64).map(ray).collect()
}

/// Returns parts of several sizes and offsets.
fn parts() -> Vec<(f64, Mesh)> {
    let sizes = [1.0, 1.0, 1e-3, 1e6, 1e11, 1e-12];
    let offsets = [0.0, 4000.0, 0.0, 1e6, 1e11, 0.0];
    let mut parts: Vec<(f64, Mesh)> = (sizes.into_iter().zip(offsets))
        .map(|(size, offset)| {
            let mut mesh = shapes::sphere(10.0, 0.5).unwrap();
            for position in &mut mesh.positions {
                *position = *position * size + DVec3::new(offset, -offset, offset / 3.0);
            }
            (size, mesh)
        })
        .collect();
    parts.push((
        1.0,
        shapes::plane(crate::math::DVec2::new(90.0, 60.0)).unwrap(),
    ));
    parts
}

/// Tests that no public ray function aborts, hangs or returns NaN, for any magnitude of directions,
/// origins and lengths.
///
/// If the origin is near the part, a ray that clearly hits a triangle by brute force must hit it
/// here, within a tenth of `refinement`. A ray that misses the box by its full size must hit
/// nothing.
#[test]
fn rays_of_any_size_are_traced_or_refused() {
    for seed in [43, 44, 45] {
        let (mut met, mut refused) = (0, 0);
        for (size, mesh) in parts() {
            let bounds = mesh.bounds();
            for accel in accels(&mesh) {
                for packet in 0..120 {
                    let rays = rays_of_any_size(&bounds, seed, packet);
                    let good = |ray: &Ray| normalized(*ray).is_ok();
                    let (good, bad): (Vec<Ray>, Vec<Ray>) = rays.into_iter().partition(good);
                    refused += bad.len();
                    for ray in bad {
                        assert!(closest(&accel, &[ray]).is_err(), "{ray:?}");
                    }
                    if good.is_empty() {
                        continue;
                    }
                    let hits = closest(&accel, &good).unwrap();
                    let some: Vec<bool> = hits.iter().map(SurfacePoint::is_some).collect();
                    assert_eq!(any(&accel, &good), some);
                    let unit: Vec<Ray> = good.iter().map(|r| normalized(*r).unwrap().0).collect();
                    let traced = accel.closest(&unit, |_, _| true);
                    accel.occluded(&unit);
                    for ((hit, traced), (ray, unit)) in
                        hits.iter().zip(traced).zip(good.iter().zip(&unit))
                    {
                        if let Some(hit) = traced {
                            assert!(hit.t.is_finite() && hit.point.is_finite(), "{ray:?}");
                        }
                        sound(&accel, &mesh, hit, ray, unit, size);
                        met += usize::from(hit.is_some());
                    }
                    let mut nearest = vec![STALE; good.len()];
                    accel
                        .nearest_points(|i| good[i].origin, &mut nearest)
                        .unwrap();
                    assert!(
                        nearest
                            .iter()
                            .all(|n| n.distance.is_finite() && n.is_some())
                    );
                }
            }
        }
        assert!(met > 500 && refused > 500, "{met} {refused}");
    }
}

fn sound(accel: &Accel, mesh: &Mesh, hit: &SurfacePoint, ray: &Ray, unit: &Ray, size: f64) {
    if hit.is_some() {
        let [u, v] = hit.barycentric;
        assert!(hit.distance >= 0.0 && hit.distance <= ray.t_max, "{ray:?}");
        assert!(DVec3::from_array(hit.point).is_finite(), "{ray:?}");
        assert!(u >= 0.0 && v >= 0.0 && u + v <= 1.0, "{ray:?}");
    }
    let bounds = mesh.bounds();
    let away = ray.origin.distance(bounds.center());
    if away > 100.0 * bounds.size().max_element() || !(1e-3..=1e6).contains(&size) {
        return;
    }
    let Some(truth) = brute::closest(mesh, unit) else {
        return;
    };
    let corners = accel.corners(truth.face);
    let [u, v] = refine::barycentric(corners, truth.point);
    let inside = u.min(v).min(1.0 - u - v) > 0.01;
    let far = truth.t > 10.0 * accel.resolution() && truth.t < unit.t_max * (1.0 - 1e-6);
    if inside && far && truth.normal.dot(unit.direction).abs() > 0.01 {
        assert!(hit.is_some(), "lost: {ray:?}");
        let off = DVec3::from_array(hit.point).distance(truth.point);
        assert!(off < 0.1 * accel.refinement(), "{off} {ray:?}");
    }
}

/// Tests the ray of direction (0, cos 90°, −1) that starts lateral to a part, in packets of one
/// origin. The cosine of 90° is not zero in f64, so the ray reaches the side of the box only after
/// 4·10¹⁸ mm.
#[test]
fn rays_almost_along_an_axis_beside_the_part_meet_nothing() {
    let (mesh, sizes) = (shapes::sphere(10.0, 0.1).unwrap(), [1e-3, 1.0, 280.0, 1e9]);
    for accel in accels(&mesh) {
        for beside in sizes {
            for (axis, sign) in (0..3).flat_map(|axis| [(axis, 1.0), (axis, -1.0)]) {
                let mut origin = DVec3::splat(1.0);
                origin[axis] = sign * (10.0 + beside);
                let ray = |along: f64| {
                    let mut direction = DVec3::ZERO;
                    direction[(axis + 1) % 3] = -1.0;
                    direction[axis] = -sign * along;
                    Ray {
                        origin,
                        direction,
                        t_max: f64::INFINITY,
                    }
                };
                let almost = std::f64::consts::FRAC_PI_2.cos();
                for along in [almost, f64::MIN_POSITIVE, f64::from_bits(1), 1e-100] {
                    let rays = [ray(along); WIDTH];
                    let hits = closest(&accel, &rays).unwrap();
                    assert!(hits.iter().all(|hit| !hit.is_some()), "{beside} {along}");
                    assert!(any(&accel, &rays).iter().all(|hit| !hit));
                }
            }
        }
    }
}
