//! Zero vectors, zero areas and denormals among the triangles and rays of a part.

use crate::random::Random;
use lasertrace::accel::{Accel, Backend, Hit, Ray, WIDTH};
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::shapes;

fn closest(accel: &Accel, rays: &[Ray]) -> Vec<Option<Hit>> {
    (rays.chunks(WIDTH))
        .flat_map(|packet| accel.closest(packet, |_, _| true)[..packet.len()].to_vec())
        .collect()
}

fn endless(from: DVec3, to: DVec3) -> Ray {
    Ray {
        t_max: f64::INFINITY,
        ..Ray::between(from, to).unwrap()
    }
}

/// Triangles without area, corners a denormal apart, rays without length: a valid part
/// is met through them where it is, nothing else is, and every number is one.
#[test]
fn zero_vectors_and_areas_give_no_hits_and_no_other_numbers() {
    let p = DVec3::new(1.0, 2.0, 3.0);
    assert!(Ray::between(p, p).is_none());
    for (z, x) in [(DVec3::ZERO, DVec3::X), (DVec3::Z, DVec3::ZERO), (p, p)] {
        assert!(Rigid::from_z_and_x(DVec3::ZERO, z, x).is_none());
    }
    let tiny = DVec3::splat(5e-324);
    assert!(Rigid::from_z_and_x(p, tiny, DVec3::X).is_none_or(|pose| pose.rotation.is_finite()));
    let valid = shapes::sphere(5.0, 0.01).unwrap();
    let mut mesh = valid.clone();
    let mut random = Random::new(9);
    for _ in 0..200 {
        let (a, way) = (random.direction() * 8.0, random.direction());
        for corners in [[a; 3], [a, a + way, a + way], [tiny, tiny * 2.0, -tiny]] {
            let first = mesh.positions.len() as u32;
            mesh.positions.extend(corners);
            mesh.triangles.push([first, first + 1, first + 2]);
        }
    }
    // Half of them at corners without area, half at the valid part, off its vertices.
    let corners = &mesh.positions[valid.positions.len()..];
    let rays: Vec<Ray> = (0..4000)
        .map(|i| {
            let target = [corners[i % corners.len()], random.vector(2.0)][i % 2];
            endless(random.direction() * 30.0, target)
        })
        .collect();
    for &backend in Backend::ALL {
        let [with, without] = [&mesh, &valid]
            .map(|mesh| Accel::build_with(backend, &mesh.clone().into(), 1, &|_| Ok(())).unwrap());
        // Other corners make another box, and its f32 another side of the horizon.
        let mut off = 0;
        for (found, truth) in closest(&with, &rays).iter().zip(closest(&without, &rays)) {
            if let Some(hit) = found {
                assert!(hit.point.is_finite() && hit.normal.is_finite() && hit.t.is_finite());
                assert!(
                    (hit.face.triangle as usize) < valid.triangles.len(),
                    "{hit:?}"
                );
            }
            off += match (found, truth) {
                (Some(found), Some(truth)) => usize::from((found.t - truth.t).abs() > 1e-5),
                (None, None) => 0,
                _ => 1,
            };
        }
        println!("{backend:?}: {off} of 4000 off by more than 1e-5 mm");
        assert!(off <= 4, "{backend:?}: {off}");
        for &p in mesh.positions.iter().step_by(7) {
            let nearest = with.nearest(p + random.vector(1.0), None);
            assert!(nearest.distance.is_finite());
        }
    }
}
