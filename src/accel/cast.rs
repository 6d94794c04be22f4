//! Ray casting as a service: any number of rays or points in one call, on all threads of
//! rayon's current pool (`ThreadPool::install` chooses another), each answer settled in f64 as the simulator's own rays are.

use super::{Accel, Face, Hit, Ray, WIDTH, refine};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::LARGEST_MM;
use rayon::prelude::*;
use smallvec::SmallVec;

/// A place on the part, as [`Accel::closest_hits`] and [`Accel::nearest_points`] write it:
/// 56 bytes, laid out as in C.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Of a ray: t ≥ 0, with `point` = origin + t·direction, in mm if the direction is of
    /// length 1. Of a point: its distance, mm. Infinite if there is nothing.
    pub distance: f64,
    /// mm, in the part's frame; 0 if there is nothing.
    pub point: [f64; 3],
    /// u and v, both ≥ 0 and u + v ≤ 1: the place (1 − u − v)·a + u·b + v·c of a triangle
    /// with corners a, b, c. 0 if there is nothing.
    pub barycentric: [f64; 2],
    /// Number of the triangle in the mesh; 2³² − 1 if there is nothing.
    pub triangle: u32,
    /// Number of the instance: 0 for a mesh that stands alone; 2³² − 1 if there is nothing.
    pub instance: u32,
}

impl SurfacePoint {
    /// What a ray gets that meets nothing.
    pub const NOTHING: SurfacePoint = SurfacePoint {
        distance: f64::INFINITY,
        point: [0.0; 3],
        barycentric: [0.0; 2],
        triangle: u32::MAX,
        instance: u32::MAX,
    };

    /// Whether there is a place at all.
    pub fn is_some(&self) -> bool {
        self.triangle != u32::MAX
    }
}

/// Lengths of directions that are taken.
const LENGTHS: std::ops::RangeInclusive<f64> = 1e-100..=1e100;

/// Up to so many rays or points are done by one thread: to wake another takes longer.
pub const CAST_ALONE: usize = 16 * WIDTH;

/// Times a ray that met something behind its origin is asked again.
const ASKED_AGAIN: usize = 4;

impl Accel {
    /// What each of `hits.len()` rays meets first. `rays` gives ray i, in the part's frame:
    /// its direction may have any length from 1e-100 to 1e100, and `t_max` and
    /// [`SurfacePoint::distance`] are in units of that length. A miss is
    /// [`SurfacePoint::NOTHING`]: nothing of what stood in `hits` stays.
    ///
    /// Both sides of a triangle are met; one without area is not. Of two triangles at the
    /// same distance either may be met; which depends on the rays beside this one in its
    /// packet of 16 (rays 0 to 15, 16 to 31, …), never on the number of threads. With Embree,
    /// surface closer to the origin than [`Self::resolution`] may be missed, and so may what a
    /// ray meets within f32's steps of a vertex or outline of an open mesh (LIMITS.md).
    ///
    /// # Errors
    /// `Error::Usage` that names the first ray which is not one; all of `hits` is then
    /// [`SurfacePoint::NOTHING`].
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
    /// let mut hits = [SurfacePoint::NOTHING; 2];
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
        let nothing = SurfacePoint::NOTHING;
        self.cast(rays, hits, nothing, |hit, length| match hit {
            Some(hit) => SurfacePoint {
                distance: hit.t / length,
                ..self.surface_point(hit.face, hit.point)
            },
            None => nothing,
        })
    }

    /// Whether each of `hit.len()` rays meets anything up to its `t_max`: exactly where
    /// [`Self::closest_hits`] finds something, with the same errors (`hit` is then false).
    pub fn any_hits(&self, rays: impl Fn(usize) -> Ray + Sync, hit: &mut [bool]) -> Result<()> {
        self.cast(rays, hit, false, |hit, _| hit.is_some())
    }

    /// The place of the part nearest to each of `nearest.len()` points (mm, in the part's
    /// frame); of several, that of the first triangle of the first instance. Triangles
    /// without area count, as the segments or points they are.
    ///
    /// # Errors
    /// `Error::Usage` that names the first point which is not one; all of `nearest` is then
    /// [`SurfacePoint::NOTHING`].
    pub fn nearest_points(
        &self,
        points: impl Fn(usize) -> DVec3 + Sync,
        nearest: &mut [SurfacePoint],
    ) -> Result<()> {
        in_shares(nearest, SurfacePoint::NOTHING, |first, share| {
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

    /// As far as the backend may be off by what f32 rounds.
    fn further(&self, ray: &Ray) -> Ray {
        Ray {
            t_max: ray.t_max + self.refinement(),
            ..*ray
        }
    }

    /// The closest hit from 0 to `t_max` in f64, of what the ray meets [`Self::further`]. A hit
    /// behind the origin by no more than f64 rounds is one at it.
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

    /// What a ray meets that first met something behind its origin, which f32 took to lie
    /// before it.
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

    /// A place on a triangle, without its distance.
    fn surface_point(&self, face: Face, point: DVec3) -> SurfacePoint {
        SurfacePoint {
            distance: 0.0,
            point: point.to_array(),
            barycentric: refine::barycentric(self.corners(face), point),
            triangle: face.triangle,
            instance: face.copy,
        }
    }
}

/// Fills `out` a share at a time, on all threads. Of several errors that with the lowest
/// number is given, whatever thread met it, and `out` is `nothing` then.
fn in_shares<T: Copy + Send + Sync>(
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

/// The ray with a direction of length 1, and what the length was; else what is wrong.
fn normalized(ray: Ray) -> std::result::Result<(Ray, f64), String> {
    check_place(ray.origin).map_err(|what| format!("origin {what}"))?;
    // Not from the squares, which overflow.
    let largest = ray.direction.abs().max_element();
    let length = (ray.direction / largest).length() * largest;
    // False for NaN too, which 0/0 and ∞/∞ give.
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

fn check_place(p: DVec3) -> std::result::Result<(), String> {
    match !p.is_nan() && p.abs().max_element() <= LARGEST_MM {
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
