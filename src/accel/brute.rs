//! Reference for tests: every triangle against every ray, in f64.

use super::{Hit, Nearest, Ray, TriangleId, refine};
use crate::math::DVec3;
use crate::mesh::Mesh;

/// Returns the nearest hit by testing all triangles (Möller & Trumbore 1997).
pub fn closest(mesh: &Mesh, ray: &Ray) -> Option<Hit> {
    (0..mesh.triangles.len())
        .filter_map(|i| Some((intersect(mesh.triangle(i), ray)?, i)))
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(t, i)| Hit {
            t,
            face: TriangleId::of_mesh(i as u32),
            point: ray.origin + ray.direction * t,
            normal: refine::facing_normal(mesh.triangle(i), ray.direction)
                .expect("a triangle that is hit has an area"),
        })
}

/// Returns all hits in order of distance, each with whether the ray hits the front of the triangle.
/// A hit on a shared edge is returned for both triangles.
pub fn all(mesh: &Mesh, ray: &Ray) -> Vec<(f64, u32, bool)> {
    let triangles = 0..mesh.triangles.len();
    let mut hits: Vec<(f64, u32, bool)> = triangles
        .filter_map(|i| {
            let corners = mesh.triangle(i);
            let front = refine::across(corners).dot(ray.direction) < 0.0;
            Some((intersect(corners, ray)?, i as u32, front))
        })
        .collect();
    hits.sort_by(|a, b| a.0.total_cmp(&b.0));
    hits
}

fn intersect([a, b, c]: [DVec3; 3], ray: &Ray) -> Option<f64> {
    let (e1, e2) = (b - a, c - a);
    let p = ray.direction.cross(e2);
    let det = e1.dot(p);
    if det == 0.0 {
        return None;
    }
    let s = ray.origin - a;
    let u = s.dot(p) / det;
    let q = s.cross(e1);
    let v = ray.direction.dot(q) / det;
    let t = e2.dot(q) / det;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t >= 0.0 && t <= ray.t_max).then_some(t)
}

/// Returns the nearest point of the mesh by testing all triangles.
pub fn nearest(mesh: &Mesh, p: DVec3) -> Option<Nearest> {
    (0..mesh.triangles.len())
        .map(|i| {
            let point = refine::nearest_on_triangle(mesh.triangle(i), p);
            Nearest {
                face: TriangleId::of_mesh(i as u32),
                point,
                distance: point.distance(p),
            }
        })
        .min_by(|a, b| a.distance.total_cmp(&b.distance))
}
