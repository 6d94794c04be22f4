//! Tests of inside, signed distance and thickness.

use super::super::hierarchy::tests::soup;
use super::super::{Backend, brute};
use super::*;
use crate::math::Rigid;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::{Mesh, shapes};
use std::sync::Arc;

fn uniform(key: RngKey, i: u64, half: f64) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|j| {
        (key.with(i).uniform(j as u64) * 2.0 - 1.0) * half
    }))
}

fn built(mesh: &Mesh) -> Accel {
    Accel::build(&Arc::new(mesh.clone()), 1).unwrap()
}

/// Returns two balls that overlap, one wound inward or not.
fn balls(inward: bool) -> Mesh {
    let mut mesh = shapes::sphere(10.0, 0.1).unwrap();
    let count = mesh.positions.len() as u32;
    let second: Vec<DVec3> = mesh.positions.iter().map(|&p| p + 8.0 * DVec3::X).collect();
    let triangles = mesh.triangles.iter().map(|t| t.map(|v| v + count));
    let triangles: Vec<[u32; 3]> = triangles
        .map(|[a, b, c]| if inward { [a, c, b] } else { [a, b, c] })
        .collect();
    mesh.positions.extend(second);
    mesh.triangles.extend(triangles);
    mesh
}

/// Returns a mesh in which every triangle has separate vertices.
fn unwelded(mesh: &Mesh) -> Mesh {
    let triangles = 0..mesh.triangles.len();
    Mesh {
        positions: triangles.clone().flat_map(|i| mesh.triangle(i)).collect(),
        triangles: triangles
            .map(|i| [0, 1, 2].map(|k| 3 * i as u32 + k))
            .collect(),
    }
}

/// Tests points near the vertices of closed meshes, on the lines through them, and anywhere: parity
/// and solid angle agree, and the distance has their sign.
///
/// The solid angles of some thousand triangles round to less than 10⁻⁹ in sum. Near the surface,
/// the smallest distance is 10⁻⁵ mm.
#[test]
fn parity_and_solid_angle_agree_on_closed_meshes() {
    let block = shapes::step_block(DVec3::new(12.0, 9.0, 7.0), 2.0).unwrap();
    let mut far = balls(false);
    far.positions
        .iter_mut()
        .for_each(|p| *p += DVec3::new(1e6, 1e6, -1e6));
    let closed = [
        block.clone(),
        unwelded(&block),
        balls(false),
        balls(true),
        far,
    ];
    for (seed, mesh) in (91..).zip(&closed) {
        let key = RngKey::new(seed, Purpose::RaceRays);
        let accel = built(mesh);
        let (center, half) = (accel.bounds().center(), accel.bounds().size() / 2.0);
        let anywhere = (0..300).map(|i| center + 1.2 * half * uniform(key, i, 1.0));
        let near = mesh.positions.iter().take(200).zip(0..).map(|(&p, i)| {
            let aside = [1e-5, 1e-3, 0.1][i as usize % 3];
            p + aside * uniform(key, 1000 + i, 1.0).normalize()
        });
        // A test ray through a vertex.
        let through = (mesh.positions.iter().take(200)).map(|&p| p - 3.0 * TEST_DIRECTION);
        let points: Vec<DVec3> = anywhere.chain(near).chain(through).collect();
        let mut inside = vec![false; points.len()];
        let [mut numbers, mut distances] = [0; 2].map(|_| vec![7.0; points.len()]);
        accel.contains_points(|i| points[i], &mut inside).unwrap();
        accel.winding_numbers(|i| points[i], &mut numbers).unwrap();
        accel
            .signed_distances(|i| points[i], &mut distances)
            .unwrap();
        for i in 0..points.len() {
            let whole = numbers[i].round();
            assert!(
                (numbers[i] - whole).abs() < 1e-3,
                "{} {}",
                points[i],
                numbers[i]
            );
            assert_eq!(
                inside[i],
                whole.abs() % 2.0 == 1.0,
                "{} {}",
                points[i],
                numbers[i]
            );
            assert_eq!(inside[i], distances[i] < 0.0, "{}", points[i]);
        }
        for (p, distance) in points.iter().zip(&distances).step_by(17) {
            assert_eq!(distance.abs(), brute::nearest(mesh, *p).unwrap().distance);
        }
        assert!(inside.iter().filter(|&&inside| inside).count() > 50);
    }
}

/// Tests instances of a block in two poses against the block.
#[test]
fn instances_have_an_inside() {
    let block = shapes::step_block(DVec3::new(12.0, 9.0, 7.0), 2.0).unwrap();
    let alone = built(&block);
    let key = RngKey::new(95, Purpose::RaceRays);
    let poses = [3.0, -30.0].map(|x| Rigid::from_euler_xyz(DVec3::splat(0.7), x * DVec3::X));
    let placed = built(&block).with_copies(poses).unwrap();
    let points: Vec<DVec3> = (0..500)
        .map(|i| alone.bounds().center() + uniform(key, i, 9.0))
        .collect();
    let [mut expected, mut found] = [0; 2].map(|_| vec![false; points.len()]);
    alone.contains_points(|i| points[i], &mut expected).unwrap();
    for pose in poses {
        placed
            .contains_points(|i| pose.point(points[i]), &mut found)
            .unwrap();
        assert_eq!(found, expected);
        let mut numbers = vec![0.0; points.len()];
        placed
            .winding_numbers(|i| pose.point(points[i]), &mut numbers)
            .unwrap();
        assert!(
            numbers
                .iter()
                .zip(&found)
                .all(|(n, &f)| (n - f64::from(u8::from(f))).abs() < 1e-9)
        );
    }
}

/// Tests that an open mesh has no inside, but winding numbers: half a ball has 0.5 at its center.
#[test]
fn open_meshes_have_winding_numbers_only() {
    let mut half = shapes::sphere(10.0, 0.05).unwrap();
    let middle = half.bounds().center();
    let above = |t: &[u32; 3]| {
        t.iter()
            .map(|&v| half.positions[v as usize].z - middle.z)
            .sum::<f64>()
            > 0.0
    };
    half.triangles = half.triangles.iter().copied().filter(above).collect();
    for accel in [built(&half), built(&soup())] {
        let ray = Ray {
            origin: middle,
            direction: DVec3::Z,
            t_max: 1.0,
        };
        let (mut inside, mut distances) = ([true; 3], [7.0; 3]);
        let errors = [
            accel.contains_points(|_| middle, &mut inside).unwrap_err(),
            accel
                .signed_distances(|_| middle, &mut distances)
                .unwrap_err(),
            accel.thicknesses(|_| ray, &mut [7.0; 3]).unwrap_err(),
        ];
        for error in errors {
            let message = error.to_string();
            assert!(message.contains("the mesh is open: found"), "{message}");
        }
        assert_eq!((inside, distances), ([false; 3], [f64::INFINITY; 3]));
    }
    let mut number = [7.0];
    built(&half)
        .winding_numbers(|_| middle, &mut number)
        .unwrap();
    // The border of the half is within one facet of 2 mm of the equator: 2/10 of a radian.
    assert!((number[0].abs() - 0.5).abs() < 0.1, "{number:?}");
}

/// Tests thicknesses of a block: through it, from inside, along a face, from the surface, ending in
/// it, and past it.
#[test]
fn thickness_is_the_first_section_in_the_part() {
    let accel = built(&shapes::step_block(DVec3::new(12.0, 8.0, 7.0), 2.0).unwrap());
    let (low, size) = (accel.bounds().min, accel.bounds().size());
    let inside = low + DVec3::new(0.3 * size.x, 0.5 * size.y, 0.25 * size.z);
    let ray = |origin: DVec3, direction: DVec3, t_max: f64| Ray {
        origin,
        direction,
        t_max,
    };
    let cases = [
        (
            ray(inside - 50.0 * DVec3::Y, DVec3::Y, f64::INFINITY),
            size.y,
        ),
        (
            ray(inside - 50.0 * DVec3::Y, 2.0 * DVec3::Y, f64::INFINITY),
            size.y / 2.0,
        ),
        (ray(inside, DVec3::Y, f64::INFINITY), size.y / 2.0),
        (
            ray(inside - 0.5 * size.y * DVec3::Y, DVec3::Y, f64::INFINITY),
            size.y,
        ),
        (
            ray(inside - 0.5 * size.y * DVec3::Y, -DVec3::Y, f64::INFINITY),
            0.0,
        ),
        (ray(inside - 50.0 * DVec3::Y, DVec3::Y, 50.0), size.y / 2.0),
        (ray(inside - 50.0 * DVec3::Y, DVec3::Y, 10.0), 0.0),
        (ray(inside - 50.0 * DVec3::Y, -DVec3::Y, f64::INFINITY), 0.0),
    ];
    let mut found = [7.0; 8];
    accel.thicknesses(|i| cases[i].0, &mut found).unwrap();
    for ((ray, expected), found) in cases.iter().zip(found) {
        // Twenty rounding errors of 60 mm.
        assert!(
            (found - expected).abs() < 20.0 * 60.0 * f64::EPSILON,
            "{ray:?} {found} {expected}"
        );
    }
}

#[test]
fn invalid_points_are_errors() {
    for &backend in Backend::ALL {
        let mesh = Arc::new(shapes::sphere(10.0, 0.5).unwrap());
        let accel = Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap();
        for wrong in [DVec3::NAN, DVec3::INFINITY, DVec3::splat(1e300)] {
            let points = |i| if i == 300 { wrong } else { DVec3::ZERO };
            let (mut inside, mut numbers, mut distances) = ([true; 400], [7.0; 400], [7.0; 400]);
            let errors = [
                accel.contains_points(points, &mut inside).unwrap_err(),
                accel.winding_numbers(points, &mut numbers).unwrap_err(),
                accel.signed_distances(points, &mut distances).unwrap_err(),
            ];
            assert!(
                errors
                    .iter()
                    .all(|error| error.to_string().contains("point 300"))
            );
            assert_eq!((inside, numbers), ([false; 400], [0.0; 400]));
            assert_eq!(distances, [f64::INFINITY; 400]);
        }
    }
}
