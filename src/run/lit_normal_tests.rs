//! Tests the mean normal on surfaces with known mean and under small changes of the part.

use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::Mesh;
use std::sync::Arc;

/// The scene `plane` without rotation: the laser plane is at y = −0.4, −0.2, 0, 0.2 and 0.4 mm.
fn scene() -> Scene {
    let text = include_str!("../../scenes/plane/scene.toml");
    let text = text.replace("rotation_deg = [8, 5, 0]", "rotation_deg = [0, 0, 0]");
    Scene::parse(&text, "".as_ref()).unwrap()
}

fn normal(scene: &Scene, corners: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Option<DVec3> {
    let mesh = Mesh::from_triangles(corners, triangles).unwrap();
    lit_normal(scene, &Accel::build(&Arc::new(mesh), 1).unwrap())
}

/// Returns two facets that form a ridge along x at y = `at` and descend with the given slopes.
fn roof(at: f64, slopes: [f64; 2]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let corners = [-40.0, 40.0].into_iter().flat_map(|x| {
        [
            DVec3::new(x, at, 0.0),
            DVec3::new(x, -20.0, -20.0 * slopes[0]),
            DVec3::new(x, 20.0, -20.0 * slopes[1]),
        ]
    });
    let triangles = vec![[0, 4, 1], [0, 3, 4], [0, 2, 5], [0, 5, 3]];
    (corners.collect(), triangles)
}

#[test]
fn a_plane_has_its_own_normal() {
    let scene = scene();
    let key = RngKey::new(44, Purpose::SensorNoise);
    for i in 0..20 {
        let slope = |j| key.with(i).uniform(j) - 0.5;
        let (dx, dy) = (slope(0), slope(1));
        let z = |x: f64, y: f64| DVec3::new(x, y, dx * x + dy * y);
        let corners = vec![
            z(-40.0, -40.0),
            z(40.0, -40.0),
            z(40.0, 40.0),
            z(-40.0, 40.0),
        ];
        let found = normal(&scene, corners, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
        let expected = DVec3::new(-dx, -dy, 1.0).normalize();
        // The head has the orientation of the part. The tolerance allows some thousand rounding
        // errors.
        assert!(found.distance(expected) < 1e-12, "{found} {expected}");
    }
}

/// A ridge in the laser plane is moved by a millionth of a micrometre. The fraction of the beam
/// width on a facet changes by `moved`/2w in one of five poses. The mean changes by this fraction
/// times the difference of the normals (below 2), divided by a mean above 0.7.
#[test]
fn an_edge_in_the_sheet_decides_nothing_by_a_rounding() {
    let scene = scene();
    let (radius, moved) = (scene.laser.beam.radius(150.0), 1e-9);
    let key = RngKey::new(45, Purpose::SensorNoise);
    for i in 0..12 {
        let slopes = [0, 1].map(|j| 1.2 * key.with(i).uniform(j));
        let at = [-0.4, -0.2, 0.0, 0.2, 0.4][i as usize % 5];
        let [low, middle, high] = [-moved, 0.0, moved].map(|by| {
            let (corners, triangles) = roof(at + by, slopes);
            normal(&scene, corners, triangles).unwrap()
        });
        assert!(low.distance(high) < moved / radius, "{slopes:?} at {at}");
        assert!(low.distance(middle) < moved / radius, "{slopes:?} at {at}");
        // The mean is between the normals of the facets.
        assert!(middle.y < slopes[1] && middle.y > -slopes[0], "{middle}");
    }
}

/// A horizontal plate lies 0.8 mm above a slope and hides all of it in the field.
#[test]
fn what_is_hidden_does_not_count() {
    let scene = scene();
    let square = |half: f64, z: f64, slope: f64| {
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
            .map(|(x, y): (f64, f64)| DVec3::new(x, y, 0.0) * half)
            .map(|p| p + DVec3::Z * (z + slope * p.x))
    };
    let of = |covers: bool| {
        let mut corners = square(40.0, -0.5, 0.05).to_vec();
        let mut triangles = vec![[0, 1, 2], [0, 2, 3]];
        if covers {
            corners.extend(square(20.0, 0.3, 0.0));
            triangles.extend([[4, 5, 6], [4, 6, 7]]);
        }
        normal(&scene, corners, triangles).unwrap()
    };
    assert!(of(true).distance(DVec3::Z) < 1e-12, "{}", of(true));
    let slope = DVec3::new(-0.05, 0.0, 1.0).normalize();
    assert!(of(false).distance(slope) < 1e-12, "{}", of(false));
}

/// The underside of a closed part does not contribute to the mean, for both winding orders.
#[test]
fn the_far_side_of_a_closed_part_does_not_count() {
    let scene = scene();
    let mut mesh = crate::mesh::shapes::sphere(200.0, 5.0).unwrap();
    let up = |mesh: &Mesh| {
        let down = mesh.positions.iter().map(|&p| p - 200.0 * DVec3::Z);
        normal(&scene, down.collect(), mesh.triangles.clone()).unwrap()
    };
    let outward = up(&mesh);
    mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    assert!(up(&mesh).distance(outward) < 1e-12);
    // The field covers about 3 mm of a sphere of 200 mm with facets up to 90 mm.
    assert!(outward.z > 0.9, "{outward}");
}

#[test]
fn where_nothing_is_lit_there_is_no_mean() {
    let far = roof(0.0, [0.1, 0.1]);
    let corners = far.0.iter().map(|&p| p + DVec3::X * 500.0).collect();
    assert_eq!(normal(&scene(), corners, far.1), None);
}
