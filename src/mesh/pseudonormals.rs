//! Outward direction of a closed surface, at faces, edges and vertices alike.

use super::Mesh;
use super::check::{Orientation, facing, signed_volume};
use super::vertex_edges::{self, HalfEdge, VertexEdges};
use crate::math::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Fraction of the longest side of a triangle within which a point counts as on a side or a corner.
/// It exceeds f64 rounding errors unless the mesh is a million times its size from the origin.
const ON: f64 = 1e-9;

/// Closed and consistently wound mesh with linked triangle sides. Side k of a triangle runs from
/// its corner k to the next; its index is 3·triangle + k.
#[derive(Debug, Clone)]
pub struct Pseudonormals {
    /// Opposite side of each side. A side of a triangle with a repeated vertex refers to itself,
    /// since such a triangle has no neighbours.
    opposite: Vec<u32>,
    inward: bool,
}

impl Pseudonormals {
    /// Links the sides of a mesh. Uses 12 bytes per triangle, and temporarily twice this amount.
    ///
    /// Returns `None` if its [`Orientation`] is open or mixed: such a mesh has no inside.
    pub fn of(mesh: &Mesh) -> Option<Pseudonormals> {
        let sides = u32::try_from(3 * mesh.triangles.len()).ok()?;
        // Each element is written at most once. Atomics are needed because elements of different
        // vertices interleave.
        let opposite: Vec<AtomicU32> = (0..sides).into_par_iter().map(AtomicU32::new).collect();
        let joined = vertex_edges::of_all(mesh, |VertexEdges { ups, downs }| {
            let number = |side: &HalfEdge| 3 * side.triangle + side.corner;
            for (up, down) in ups.iter().zip(downs) {
                opposite[number(up) as usize].store(number(down), Relaxed);
                opposite[number(down) as usize].store(number(up), Relaxed);
            }
            let higher = |side: &HalfEdge| side.higher;
            ups.iter().map(higher).eq(downs.iter().map(higher))
        });
        if !joined.all(|joined| joined) {
            return None;
        }
        let inward = match facing(mesh, signed_volume(mesh)) {
            Orientation::Outward => false,
            Orientation::Inward => true,
            Orientation::Mixed | Orientation::Open => return None,
        };
        let opposite = opposite.into_iter().map(AtomicU32::into_inner).collect();
        Some(Pseudonormals { opposite, inward })
    }

    /// Returns the outward pseudonormal of the surface at a point of a triangle, of any length.
    ///
    /// A query point whose nearest surface point this is lies outside if it is on the side of the
    /// pseudonormal (Bærentzen and Aanæs 2005). On a side, the pseudonormal is the sum of the unit
    /// normals of both triangles. At a corner, it is the angle-weighted sum over all adjacent
    /// triangles. Returns zero for a triangle with a repeated vertex.
    pub fn outward(&self, mesh: &Mesh, triangle: u32, point: DVec3) -> DVec3 {
        let corners = mesh.triangle(triangle as usize);
        let side = |k: usize| corners[(k + 1) % 3] - corners[k];
        let within = ON * (0..3).map(|k| side(k).length()).fold(0.0, f64::max);
        let first = 3 * triangle;
        let normal = match (0..3).find(|&k| point.distance(corners[k]) <= within) {
            Some(k) => self.around_corner(mesh, first + k as u32),
            None => {
                let off = |k: usize| {
                    let along = side(k).normalize_or_zero();
                    (point - corners[k]).reject_from_normalized(along).length()
                };
                let on = (0..3).filter(|&k| off(k) <= within);
                let beyond = on.map(|k| self.normal_across_edge(mesh, first + k as u32));
                unit_normal(mesh, first) + beyond.sum::<DVec3>()
            }
        };
        if self.inward { -normal } else { normal }
    }

    /// Returns the unit normal of the triangle across a side. If its area is zero, returns the sum
    /// of the normals of the triangles across its other sides.
    fn normal_across_edge(&self, mesh: &Mesh, side: u32) -> DVec3 {
        let other = self.opposite[side as usize];
        let normal = unit_normal(mesh, other);
        if normal != DVec3::ZERO {
            return normal;
        }
        let next = next(other);
        let beyond = [next, self::next(next)].map(|side| self.opposite[side as usize]);
        beyond.map(|side| unit_normal(mesh, side)).iter().sum()
    }

    /// Returns the angle-weighted sum of the unit normals around the corner at which a side starts.
    fn around_corner(&self, mesh: &Mesh, side: u32) -> DVec3 {
        let mut sum = DVec3::ZERO;
        let mut at = side;
        loop {
            let corners = mesh.triangle(at as usize / 3);
            let k = at as usize % 3;
            let (to, from) = (
                corners[(k + 1) % 3] - corners[k],
                corners[(k + 2) % 3] - corners[k],
            );
            let angle = to.cross(from).length().atan2(to.dot(from));
            sum += unit_normal(mesh, at) * angle;
            // The side that ends at the corner is opposite to a side that starts there.
            at = self.opposite[next(next(at)) as usize];
            // `opposite` and `next` are one-to-one, so the traversal returns to its start.
            if at == side {
                return sum;
            }
        }
    }
}

/// Returns the next side of the triangle.
fn next(side: u32) -> u32 {
    side - side % 3 + (side + 1) % 3
}

/// Returns the unit normal of the triangle of a side, following its winding; zero without area.
fn unit_normal(mesh: &Mesh, side: u32) -> DVec3 {
    let [a, b, c] = mesh.triangle(side as usize / 3);
    (b - a).cross(c - a).normalize_or_zero()
}
