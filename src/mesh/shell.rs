//! Which way is out of a closed surface, at faces, edges and vertices alike.

use super::Mesh;
use super::check::{Orientation, facing, signed_volume};
use super::stars::{self, Side, Star};
use crate::math::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Share of a triangle's longest side within which a point counts as on a side or a corner:
/// far more than f64 rounds on a mesh that is not a million sizes from its origin.
const ON: f64 = 1e-9;

/// A closed and consistently wound mesh, its triangles joined at their sides. Side k of a
/// triangle runs from its corner k to the next; its number is 3·triangle + k.
#[derive(Debug, Clone)]
pub struct Shell {
    /// The side that runs along each the other way; itself of triangles with a vertex twice,
    /// which have no sides.
    opposite: Vec<u32>,
    inward: bool,
}

impl Shell {
    /// `None` where [`Orientation`] is open or mixed: such a mesh has no inside. Takes 12
    /// bytes a triangle, and as many more while it is made.
    pub fn of(mesh: &Mesh) -> Option<Shell> {
        let sides = u32::try_from(3 * mesh.triangles.len()).ok()?;
        // Each is written once at most. Atomic only because a vertex's lie between others'.
        let opposite: Vec<AtomicU32> = (0..sides).into_par_iter().map(AtomicU32::new).collect();
        let joined = stars::of_all(mesh, |Star { ups, downs }| {
            let number = |side: &Side| 3 * side.triangle + side.corner;
            for (up, down) in ups.iter().zip(downs) {
                opposite[number(up) as usize].store(number(down), Relaxed);
                opposite[number(down) as usize].store(number(up), Relaxed);
            }
            let higher = |side: &Side| side.higher;
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
        Some(Shell { opposite, inward })
    }

    /// The pseudonormal of the surface at a point of a triangle, out of the material and of
    /// any length: a point off the mesh whose nearest point this is lies outside where it is
    /// on the pseudonormal's side (Bærentzen and Aanæs 2005). On a side it is the sum of the
    /// two triangles' unit normals, at a corner that of all around, weighted by their angles
    /// there. Zero for a triangle with a vertex twice.
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
                let beyond = on.map(|k| self.beyond(mesh, first + k as u32));
                unit_normal(mesh, first) + beyond.sum::<DVec3>()
            }
        };
        if self.inward { -normal } else { normal }
    }

    /// Unit normal of the triangle beyond a side; if that is without area, of those beyond it.
    fn beyond(&self, mesh: &Mesh, side: u32) -> DVec3 {
        let other = self.opposite[side as usize];
        let normal = unit_normal(mesh, other);
        if normal != DVec3::ZERO {
            return normal;
        }
        let next = next(other);
        let beyond = [next, self::next(next)].map(|side| self.opposite[side as usize]);
        beyond.map(|side| unit_normal(mesh, side)).iter().sum()
    }

    /// Sum of the unit normals around the corner a side starts from, weighted by angles.
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
            // The side that ends at the corner runs the other way from it.
            at = self.opposite[next(next(at)) as usize];
            // `opposite` and `next` are one to one, so the way round comes back.
            if at == side {
                return sum;
            }
        }
    }
}

/// The next side of the same triangle.
fn next(side: u32) -> u32 {
    side - side % 3 + (side + 1) % 3
}

/// Of the triangle of a side, as it is wound; zero without area.
fn unit_normal(mesh: &Mesh, side: u32) -> DVec3 {
    let [a, b, c] = mesh.triangle(side as usize / 3);
    (b - a).cross(c - a).normalize_or_zero()
}
