//! Faces of a part: connected triangles without a sharp edge between them.

use super::Mesh;
use crate::math::DVec3;
use std::collections::{HashMap, HashSet};

/// Returns the unit normal of a triangle by its winding; `None` without area.
pub fn normal(mesh: &Mesh, triangle: u32) -> Option<DVec3> {
    let [a, b, c] = mesh.triangle(triangle as usize);
    (b - a).cross(c - a).try_normalize()
}

/// Returns the triangles of the smooth face that contains `seed`, in ascending order.
///
/// The face grows over edges whose two triangles have normals within `crease` (rad) of each other.
/// Triangles without area are part of the face.
pub fn smooth_face(mesh: &Mesh, seed: u32, crease: f64) -> Vec<u32> {
    EdgeTriangles::of(mesh).smooth_face(seed, crease)
}

/// Triangles at each edge of a mesh.
pub struct EdgeTriangles<'a> {
    mesh: &'a Mesh,
    by_edge: HashMap<[u32; 2], Vec<u32>>,
}

impl EdgeTriangles<'_> {
    /// Collects the triangles of all edges.
    pub fn of(mesh: &Mesh) -> EdgeTriangles<'_> {
        let mut by_edge: HashMap<[u32; 2], Vec<u32>> = HashMap::new();
        for (i, triangle) in mesh.triangles.iter().enumerate() {
            for edge in edges(triangle) {
                by_edge.entry(edge).or_default().push(i as u32);
            }
        }
        EdgeTriangles { mesh, by_edge }
    }

    /// Returns the result of [`smooth_face`].
    pub fn smooth_face(&self, seed: u32, crease: f64) -> Vec<u32> {
        let mesh = self.mesh;
        let least = crease.cos();
        let is_smooth = |a: u32, b: u32| match (normal(mesh, a), normal(mesh, b)) {
            (Some(a), Some(b)) => a.dot(b) >= least,
            _ => true,
        };
        let mut face = HashSet::from([seed]);
        let mut open = vec![seed];
        while let Some(triangle) = open.pop() {
            for edge in edges(&mesh.triangles[triangle as usize]) {
                for &next in &self.by_edge[&edge] {
                    if !face.contains(&next) && is_smooth(triangle, next) {
                        face.insert(next);
                        open.push(next);
                    }
                }
            }
        }
        let mut face: Vec<u32> = face.into_iter().collect();
        face.sort_unstable();
        face
    }
}

/// Returns the ends of the edges that belong to exactly one of the triangles.
pub fn boundary(mesh: &Mesh, triangles: &[u32]) -> Vec<[DVec3; 2]> {
    let mut count: HashMap<[u32; 2], u32> = HashMap::new();
    for &triangle in triangles {
        for edge in edges(&mesh.triangles[triangle as usize]) {
            *count.entry(edge).or_default() += 1;
        }
    }
    let mut outer: Vec<[u32; 2]> = count
        .into_iter()
        .filter_map(|(edge, count)| (count == 1).then_some(edge))
        .collect();
    outer.sort_unstable();
    let ends = outer.into_iter();
    ends.map(|edge| edge.map(|vertex| mesh.positions[vertex as usize]))
        .collect()
}

/// Returns the triangle of the mesh nearest to a point, by exhaustive search.
pub fn nearest(mesh: &Mesh, point: DVec3) -> Option<(u32, f64)> {
    let distances = (0..mesh.triangles.len()).map(|i| {
        let distance = to_triangle(point, mesh.triangle(i)).distance(point);
        (i as u32, distance)
    });
    distances.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Returns the point of a segment nearest to `point`.
pub fn to_segment(point: DVec3, [a, b]: [DVec3; 2]) -> DVec3 {
    let along = b - a;
    let t = (point - a).dot(along) / along.length_squared();
    if t.is_finite() {
        a + along * t.clamp(0.0, 1.0)
    } else {
        a
    }
}

/// Returns the point of a triangle nearest to `point`.
pub(super) fn to_triangle(point: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let normal = (b - a).cross(c - a);
    let inside = |p: DVec3, q: DVec3| normal.cross(q - p).dot(point - p) >= 0.0;
    if normal != DVec3::ZERO && inside(a, b) && inside(b, c) && inside(c, a) {
        return point - normal * (normal.dot(point - a) / normal.length_squared());
    }
    let sides = [[a, b], [b, c], [c, a]].map(|side| to_segment(point, side));
    let [first, rest @ ..] = sides;
    rest.into_iter().fold(first, |best, other| {
        match other.distance(point) < best.distance(point) {
            true => other,
            false => best,
        }
    })
}

/// Returns the edges of a triangle, each with the smaller vertex first.
pub(super) fn edges(&[a, b, c]: &[u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]].map(|[p, q]| [p.min(q), p.max(q)])
}
