//! Ray casting interface: any number of rays or points per call, on all threads of the current
//! rayon pool (`ThreadPool::install` selects a different one).
//!
//! Each result is refined in f64 in the way the rays of the simulator are.

use super::{Accel, Hit, Ray, TriangleId, WIDTH, refine};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::MAX_COORDINATE_MM;
use rayon::prelude::*;
use smallvec::SmallVec;

/// Point on the part, as written by [`Accel::closest_hits`] and [`Accel::nearest_points`]: 56 bytes
/// in C layout.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Distance of the point; infinite for a miss.
    ///
    /// For a ray it is t ≥ 0, with `point` = origin + t·direction, in mm if the direction has
    /// length 1. For a query point it is the distance, mm.
    pub distance: f64,
    /// Position in the frame of the part, mm; 0 for a miss.
    pub point: [f64; 3],
    /// Coordinates u and v, both ≥ 0 with u + v ≤ 1. The position is (1 − u − v)·a + u·b + v·c for
    /// a triangle with corners a, b, c. They are 0 for a miss.
    pub barycentric: [f64; 2],
    /// Index of the triangle in the mesh; 2³² − 1 for a miss.
    pub triangle: u32,
    /// Index of the instance: 0 for a single mesh; 2³² − 1 for a miss.
    pub instance: u32,
}

impl SurfacePoint {
    /// Result of a ray without a hit.
    pub const MISS: SurfacePoint = SurfacePoint {
        distance: f64::INFINITY,
        point: [0.0; 3],
        barycentric: [0.0; 2],
        triangle: u32::MAX,
        instance: u32::MAX,
    };

    /// True unless the result is a miss.
    pub fn is_some(&self) -> bool {
        self.triangle != u32::MAX
    }
}

/// Accepted lengths of directions.
const LENGTHS: std::ops::RangeInclusive<f64> = 1e-100..=1e100;

/// Number of rays or points up to which one thread is used: waking another one takes longer.
pub const CAST_ALONE: usize = 16 * WIDTH;

/// Number of retries for a ray whose hit is behind its origin.
const ASKED_AGAIN: usize = 4;

impl Accel {
    /// Finds the first hit of each of `hits.len()` rays. `rays` returns ray i in the frame of the
    /// part.
    ///
    /// Directions may have any length from 1e-100 to 1e100; `t_max` and [`SurfacePoint::distance`]
    /// are in units of that length. A miss is [`SurfacePoint::MISS`]. All elements of `hits` are
    /// overwritten.
    ///
    /// Rays hit both sides of a triangle, but no triangle without area. If two triangles are at
    /// equal distance, either may be returned. The choice depends on the other rays in the packet
    /// of 16 (rays 0 to 15, 16 to 31, …), never on the number of threads.
    ///
    /// With Embree, surfaces closer to the origin than [`Self::resolution`] may be missed. Hits
    /// within the f32 resolution of a vertex or outline of an open mesh may be missed as well
    /// (LIMITS.md).
    ///
    /// # Errors
    /// Returns `Error::Usage` with the index of the first invalid ray; all of `hits` is then
    /// [`SurfacePoint::MISS`].
    ///
    /// ```
    /// use lasertrace::accel::{Accel, Ray, SurfacePoint};
    /// use lasertrace::math::DVec3;
    /// use lasertrace::mesh::Mesh;
    /// use std::sync::Arc;
    ///
    /// let corners = [DVec3::ZERO, DVec3::X, DVec3::Y];
    /// let mesh = Mesh::from_triangles(corners, [[0, 1, 2]])?;
    /// let accel = Accel::build(&Arc::new(mesh), 1)?;
    /// let rays = [0.25, 0.75].map(|x| Ray {
    ///     origin: DVec3::new(x, 0.5, 6.0),
    ///     direction: DVec3::new(0.0, 0.0, -2.0),
    ///     t_max: f64::INFINITY,
    /// });
    /// let mut hits = [SurfacePoint::MISS; 2];
    /// accel.closest_hits(|i| rays[i], &mut hits)?;
    /// assert_eq!((hits[0].distance, hits[0].barycentric), (3.0, [0.25, 0.5]));
    /// assert!(!hits[1].is_some());
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn closest_hits(
        &self,
        rays: impl Fn(usize) -> Ray + Sync,
        hits: &mut [SurfacePoint],
    ) -> Result<()> {
        let nothing = SurfacePoint::MISS;
        self.cast(rays, hits, nothing, |hit, length| match hit {
            Some(hit) => SurfacePoint {
                distance: hit.t / length,
                ..self.surface_point(hit.face, hit.point)
            },
            None => nothing,
        })
    }

    /// Determines whether each of `hit.len()` rays hits anything up to its `t_max`.
    ///
    /// The result is true exactly for the rays for which [`Self::closest_hits`] finds a hit. The
    /// errors are equal too (`hit` is then false).
    pub fn occluded_batch(
        &self,
        rays: impl Fn(usize) -> Ray + Sync,
        hit: &mut [bool],
    ) -> Result<()> {
        self.cast(rays, hit, false, |hit, _| hit.is_some())
    }

    /// Finds the point of the part nearest to each of `nearest.len()` points (mm, in the frame of
    /// the part).
    ///
    /// On equal distances, the first triangle of the first instance is returned. Triangles without
    /// area count as segments or points.
    ///
    /// # Errors
    /// Returns `Error::Usage` with the index of the first invalid point; all of `nearest` is then
    /// [`SurfacePoint::MISS`].
    pub fn nearest_points(
        &self,
        points: impl Fn(usize) -> DVec3 + Sync,
        nearest: &mut [SurfacePoint],
    ) -> Result<()> {
        in_shares(nearest, SurfacePoint::MISS, |first, share| {
            let mut close = None;
            for (i, out) in (first..).zip(share) {
                let p = points(i);
                check_place(p).map_err(|what| (i, format!("point {i}: {what}")))?;
                let found = self.nearest(p, close);
                close = Some(found.face);
                *out = SurfacePoint {
                    distance: found.distance,
                    ..self.surface_point(found.face, found.point)
                };
            }
            Ok(())
        })
    }

    fn cast<T: Copy + Send + Sync>(
        &self,
        rays: impl Fn(usize) -> Ray + Sync,
        out: &mut [T],
        nothing: T,
        answer: impl Fn(Option<Hit>, f64) -> T + Sync,
    ) -> Result<()> {
        let rounding = self.largest_coordinate() * 2f64.powi(-48);
        in_shares(out, nothing, |first, out| {
            let mut unit = Vec::with_capacity(out.len());
            for i in first..first + out.len() {
                let ray = normalized(rays(i)).map_err(|what| (i, format!("ray {i}: {what}")))?;
                unit.push(ray);
            }
            let packets = unit.chunks(WIDTH).map(|rays| {
                let further = rays.iter().map(|(ray, _)| self.further(ray));
                further.collect::<SmallVec<[Ray; WIDTH]>>()
            });
            let mut asked = unit.iter().zip(out);
            self.trace_in_turn(packets, true, |hits| {
                for (hit, ((ray, length), out)) in hits.iter().zip(asked.by_ref().take(WIDTH)) {
                    *out = answer(self.settled(*hit, ray, rounding), *length);
                }
            });
            Ok(())
        })
    }

    /// Extends a ray by the largest f32 error of the backend.
    fn further(&self, ray: &Ray) -> Ray {
        Ray {
            t_max: ray.t_max + self.refinement(),
            ..*ray
        }
    }

    /// Returns the closest f64 hit from 0 to `t_max`, given the hit of the ray extended by
    /// [`Self::further`]. A hit behind the origin within the f64 rounding error is moved to the
    /// origin.
    fn settled(&self, hit: Option<Hit>, ray: &Ray, rounding: f64) -> Option<Hit> {
        let hit = match hit? {
            behind if behind.t < -rounding => self.ahead(&self.further(ray))?,
            hit => Hit {
                t: hit.t.max(0.0),
                ..hit
            },
        };
        (hit.t <= ray.t_max).then_some(hit)
    }

    /// Retraces a ray whose first hit is behind its origin due to f32 rounding.
    #[cold]
    fn ahead(&self, ray: &Ray) -> Option<Hit> {
        for step in 1..=ASKED_AGAIN {
            let passed = self.resolution() * step as f64;
            let onward = Ray {
                origin: ray.origin + ray.direction * passed,
                t_max: ray.t_max - passed,
                ..*ray
            };
            let hit = self.trace(&[onward], u16::MAX, true, |_, _| true)[0]?;
            let t = hit.t + passed;
            if t >= 0.0 {
                return Some(Hit { t, ..hit });
            }
        }
        None
    }

    /// Returns a point on a triangle, without its distance.
    pub(super) fn surface_point(&self, face: TriangleId, point: DVec3) -> SurfacePoint {
        SurfacePoint {
            distance: 0.0,
            point: point.to_array(),
            barycentric: refine::barycentric(self.corners(face), point),
            triangle: face.triangle,
            instance: face.copy,
        }
    }
}

/// Fills `out` in chunks, on all threads. If there are several errors, returns the one with the
/// lowest index, independent of the threads, and sets `out` to `nothing`.
pub(super) fn in_shares<T: Copy + Send + Sync>(
    out: &mut [T],
    nothing: T,
    fill: impl Fn(usize, &mut [T]) -> std::result::Result<(), (usize, String)> + Sync,
) -> Result<()> {
    let wrong = if out.len() <= CAST_ALONE {
        fill(0, out).err()
    } else {
        let shares = out.par_chunks_mut(CAST_ALONE).enumerate();
        let wrong = shares.filter_map(|(share, out)| fill(share * CAST_ALONE, out).err());
        wrong.min_by_key(|&(number, _)| number)
    };
    match wrong {
        None => Ok(()),
        Some((_, message)) => {
            out.fill(nothing);
            Err(Error::Usage(message))
        }
    }
}

/// Returns the ray with unit direction and the original length, or an error message.
pub(super) fn normalized(ray: Ray) -> std::result::Result<(Ray, f64), String> {
    check_place(ray.origin).map_err(|what| format!("origin {what}"))?;
    // Scaled first, because the squares may overflow.
    let largest = ray.direction.abs().max_element();
    let length = (ray.direction / largest).length() * largest;
    // Also false for NaN, the result of 0/0 and ∞/∞.
    if !LENGTHS.contains(&length) {
        return Err(format!(
            "direction {:?}, expected a vector of length 1e-100 to 1e100",
            ray.direction.to_array()
        ));
    }
    if ray.t_max.is_nan() || ray.t_max < 0.0 {
        return Err(format!(
            "t_max {}, expected a number from 0, or infinity",
            ray.t_max
        ));
    }
    let unit = Ray {
        direction: ray.direction / length,
        t_max: ray.t_max * length,
        ..ray
    };
    Ok((unit, length))
}

pub(super) fn check_place(p: DVec3) -> std::result::Result<(), String> {
    match !p.is_nan() && p.abs().max_element() <= MAX_COORDINATE_MM {
        true => Ok(()),
        false => Err(format!(
            "{:?}, expected finite coordinates within 1e12 mm",
            p.to_array()
        )),
    }
}

#[cfg(test)]
#[path = "cast_tests.rs"]
mod tests;
