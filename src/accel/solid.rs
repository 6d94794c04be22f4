//! Queries about the material that a closed mesh encloses: inside or outside, signed distance and
//! thickness.

use super::cast::{check_place, in_shares, normalized};
use super::{Accel, Ray, SurfacePoint};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::check;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Direction of the rays that decide whether a point is inside. No common part has a face or an
/// edge along it; the result is correct for every direction.
const TEST_DIRECTION: DVec3 = DVec3::new(0.324_717_957, 0.430_159_709, 0.842_330_621);

impl Accel {
    /// Determines by parity whether each of `inside.len()` points (mm, in the frame of the part) is
    /// inside the part: a ray from it has an odd number of hits.
    ///
    /// The winding of the triangles has no effect. A point in two overlapping solids or instances
    /// counts as outside. A point on the surface may count as either.
    ///
    /// # Errors
    /// Returns `Error::Usage` for an open mesh and, with the index, for the first invalid point;
    /// `inside` is then false. A mesh is open if an edge has an odd number of triangles; vertices
    /// at equal positions count as one. [`Self::winding_numbers`] accepts open meshes.
    ///
    /// ```
    /// use lasertrace::accel::Accel;
    /// use lasertrace::math::DVec3;
    /// use lasertrace::mesh::shapes;
    /// use std::sync::Arc;
    ///
    /// let ball = shapes::sphere(10.0, 0.01).expect("a valid size");
    /// let accel = Accel::build(&Arc::new(ball), 1)?;
    /// let center = accel.bounds().center();
    /// let points = [center, center + 11.0 * DVec3::X];
    /// let (mut inside, mut distances) = ([false; 2], [0.0; 2]);
    /// accel.contains_points(|i| points[i], &mut inside)?;
    /// accel.signed_distances(|i| points[i], &mut distances)?;
    /// assert_eq!((inside, distances.map(f64::round)), ([true, false], [-10.0, 1.0]));
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn contains_points(
        &self,
        points: impl Fn(usize) -> DVec3 + Sync,
        inside: &mut [bool],
    ) -> Result<()> {
        self.prepare_solid().inspect_err(|_| inside.fill(false))?;
        in_shares(inside, false, |first, inside| {
            for (i, inside) in (first..).zip(inside) {
                *inside = self.is_inside(checked(&points, i)?);
            }
            Ok(())
        })
    }

    /// Computes the generalised winding number around each of `numbers.len()` points: the sum of the
    /// signed solid angles of all triangles, divided by 4π (Jacobson, Kavan &
    /// Sorkine-Hornung 2013).
    ///
    /// For a closed mesh wound outward it is the number of solids around the point: 1 inside, 0
    /// outside. It is odd exactly if [`Self::contains_points`] returns true. For an open mesh it is
    /// a fraction, and 0.5 is the usual threshold. The time per point is proportional to the number
    /// of triangles and instances.
    ///
    /// # Errors
    /// Returns `Error::Usage` with the index of the first invalid point; `numbers` is then 0.
    pub fn winding_numbers(
        &self,
        points: impl Fn(usize) -> DVec3 + Sync,
        numbers: &mut [f64],
    ) -> Result<()> {
        in_shares(numbers, 0.0, |first, numbers| {
            let points = (0..numbers.len()).map(|i| checked(&points, first + i));
            let points = points.collect::<std::result::Result<Vec<DVec3>, _>>()?;
            // One point is work for a thread on a large mesh.
            let numbers = numbers.par_iter_mut().zip(points);
            numbers.for_each(|(number, p)| *number = self.winding_number(p));
            Ok(())
        })
    }

    /// Computes the distance from each of `distances.len()` points to the surface, mm: negative
    /// inside the part, as [`Self::contains_points`] decides, and otherwise positive.
    ///
    /// # Errors
    /// As for [`Self::contains_points`]; `distances` is then infinite.
    pub fn signed_distances(
        &self,
        points: impl Fn(usize) -> DVec3 + Sync,
        distances: &mut [f64],
    ) -> Result<()> {
        let nothing = SurfacePoint::MISS.distance;
        (self.prepare_solid()).inspect_err(|_| distances.fill(nothing))?;
        in_shares(distances, nothing, |first, distances| {
            let mut close = None;
            for (i, distance) in (first..).zip(distances) {
                let p = checked(&points, i)?;
                let nearest = self.nearest(p, close);
                close = Some(nearest.face);
                *distance = match self.is_inside(p) {
                    true => -nearest.distance,
                    false => nearest.distance,
                };
            }
            Ok(())
        })
    }

    /// Computes the thickness of the part along each of `thicknesses.len()` rays: the length of the
    /// first section inside the part, in units of the direction length.
    ///
    /// The section starts at the origin of a ray that starts inside, and ends at `t_max` at the
    /// latest. The thickness is 0 if the ray has no such section.
    ///
    /// # Errors
    /// Returns `Error::Usage` for an open mesh and, with the index, for the first invalid ray;
    /// `thicknesses` is then 0.
    pub fn thicknesses(
        &self,
        rays: impl Fn(usize) -> Ray + Sync,
        thicknesses: &mut [f64],
    ) -> Result<()> {
        (self.prepare_solid()).inspect_err(|_| thicknesses.fill(0.0))?;
        in_shares(thicknesses, 0.0, |first, thicknesses| {
            for (i, thickness) in (first..).zip(thicknesses) {
                let ray = normalized(rays(i));
                let (ray, length) = ray.map_err(|what| (i, format!("ray {i}: {what}")))?;
                *thickness = self.thickness(&ray) / length;
            }
            Ok(())
        })
    }

    /// Prepares the crossings, or returns an error for an open mesh.
    fn prepare_solid(&self) -> Result<()> {
        let odd = match self.odd_edges.get() {
            Some(&odd) => odd,
            None => {
                let odd = check::odd_edges(self.mesh());
                // As for the hierarchy, no lock is held while it is counted.
                let _ = self.odd_edges.set(odd);
                odd
            }
        };
        if odd > 0 {
            return Err(Error::Usage(format!(
                "the mesh is open: found {odd} edges with an odd number of triangles, expected a \
                 closed mesh, which has an inside; close it, or use winding numbers"
            )));
        }
        self.prepare_crossings()
    }

    fn is_inside(&self, p: DVec3) -> bool {
        let bounds = self.bounds();
        if p.cmplt(bounds.min).any() || p.cmpgt(bounds.max).any() {
            return false;
        }
        let ray = Ray {
            origin: p,
            direction: TEST_DIRECTION,
            t_max: f64::INFINITY,
        };
        self.number_of_crossings(&ray) % 2 == 1
    }

    /// Returns the length of the first section of a ray, with a direction of length 1, inside the
    /// part.
    fn thickness(&self, ray: &Ray) -> f64 {
        let endless = Ray {
            t_max: f64::INFINITY,
            ..*ray
        };
        let crossings = self.crossings(&endless, |_| true).unwrap_or_default();
        let starts_inside = crossings.len() % 2 == 1;
        let start = starts_inside.then_some(0.0);
        let distances = crossings.iter().map(|found| found.crossing.t);
        let ends: Vec<f64> = start.into_iter().chain(distances).collect();
        let sections = ends
            .chunks_exact(2)
            .map(|ends| ends[1].min(ray.t_max) - ends[0]);
        // The outline of the part, and its surface at the origin, have sections without length.
        sections
            .into_iter()
            .find(|&length| length > 0.0)
            .unwrap_or(0.0)
    }

    fn winding_number(&self, p: DVec3) -> f64 {
        let mesh = self.mesh();
        let around = |p: DVec3| -> f64 {
            let triangles = 0..mesh.triangles.len();
            triangles
                .map(|i| half_solid_angle(mesh.triangle(i), p))
                .sum()
        };
        let halves: f64 = match &self.copies {
            None => around(p),
            Some(copies) => (copies.poses().iter())
                .map(|pose| around(pose.inverse().point(p)))
                .sum(),
        };
        halves / (2.0 * PI)
    }
}

fn checked(
    points: &(impl Fn(usize) -> DVec3 + Sync),
    i: usize,
) -> std::result::Result<DVec3, (usize, String)> {
    let p = points(i);
    check_place(p).map_err(|what| (i, format!("point {i}: {what}")))?;
    Ok(p)
}

/// Returns half the solid angle of a triangle as seen from a point, positive from the back (van
/// Oosterom & Strackee 1983).
fn half_solid_angle(corners: [DVec3; 3], p: DVec3) -> f64 {
    let [a, b, c] = corners.map(|corner| corner - p);
    let [la, lb, lc] = [a, b, c].map(DVec3::length);
    let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
    a.dot(b.cross(c)).atan2(below)
}

#[cfg(test)]
#[path = "solid_tests.rs"]
mod tests;
