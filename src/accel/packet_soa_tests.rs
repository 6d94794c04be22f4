//! Tests of the selected instruction set against scalar code.

use super::*;
use crate::accel::hierarchy::tests::{rays_at, soup};

/// Tests that vectorized code for 16 rays gives the bits of the scalar code for one ray.
#[test]
fn a_packet_is_its_rays_one_by_one() {
    let mesh = soup();
    let part = PartBounds::new(mesh.bounds());
    let bounds = part.widened();
    let bits = |v: DVec3| v.to_array().map(f64::to_bits);
    let mut triangles = mesh.triangles.iter().cycle();
    let (mut entered, mut met) = (0, 0);
    for rays in rays_at(&mesh, 16_000).chunks(WIDTH) {
        let lanes = RayPacketSoA::new(rays);
        let inside = lanes.inside(&part, None);
        let [low, high] = extent(&lanes.direction);
        let directions = || rays.iter().map(|ray| ray.direction);
        assert_eq!(directions().reduce(DVec3::min), Some(low));
        assert_eq!(directions().reduce(DVec3::max), Some(high));
        let mut corners = [Lanes3::ZERO; 3];
        let mut t_found = [0.0; WIDTH];
        for (i, ray) in rays.iter().enumerate() {
            // Some rays hit the triangle, some miss it, and some have a wrong distance.
            let triangle = triangles
                .next()
                .unwrap()
                .map(|v| mesh.positions[v as usize]);
            let across = (triangle[1] - triangle[0]).cross(triangle[2] - triangle[0]);
            t_found[i] = across.dot(triangle[0] - ray.origin) / across.dot(ray.direction);
            t_found[i] += if i == 5 { 1.0 } else { 1e-6 };
            for (corners, corner) in corners.iter_mut().zip(triangle) {
                corners.set(i, corner);
            }
        }
        let meetings = lanes.intersect_plane(&corners, &t_found, 1e-3);
        for (i, ray) in rays.iter().enumerate() {
            let (enter, leave) = interval(&bounds, ray.origin, ray.direction, ray.t_max);
            assert_eq!(inside.length[i] >= 0.0, enter <= leave);
            if enter > leave {
                continue;
            }
            assert_eq!(inside.advanced[i].to_bits(), enter.to_bits());
            assert_eq!(inside.length[i].to_bits(), (leave - enter).to_bits());
            let start = ray.origin + ray.direction * enter - part.center;
            let narrowed = |axis: usize| inside.origin[axis][i].to_bits();
            let expected = start.as_vec3().to_array().map(f32::to_bits);
            assert_eq!([0, 1, 2].map(narrowed), expected);
            entered += 1;
            let corners = corners.map(|corners| corners.get(i));
            let one = intersect_plane(ray.origin, ray.direction, corners, t_found[i], 1e-3);
            let of_all = meetings.get(i);
            assert_eq!(of_all.is_some(), one.on);
            if let Some(of_all) = of_all {
                assert_eq!(of_all.t.to_bits(), one.t.to_bits());
                assert_eq!(bits(of_all.point), bits(one.point));
                assert_eq!(bits(of_all.normal), bits(one.normal));
                met += 1;
            }
        }
    }
    assert!(entered > 1000 && met > 10, "{entered} {met}");
}
