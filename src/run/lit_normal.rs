//! Mean direction of the surface that the laser of a scan lights, to which its speckle is tied.
//!
//! The mean decides how the patterns move, so a scan that runs on two kinds of processor needs
//! the same one. Rays cannot give it: which of two facets a ray meets at their common edge
//! depends on the vector instructions by which it is traced. The mean is therefore taken over
//! areas, in f64 and without a ray. Moving a vertex by a small amount changes areas by a small
//! amount, wherever edges lie.

use super::surface_view::surface_view;
use crate::accel::{Accel, Clusters, Face, Found, HalfSpace, facing_normal};
use crate::frame::{Bend, Polygon, Projection, SheetAngles, Sight, frustum};
use crate::math::{DVec3, Rigid};
use crate::scene::Scene;
use rayon::prelude::*;

/// Poses along the path at which the surface is looked at.
const PLACES: u32 = 5;

/// Strips into which the fan is cut. In a strip that contains the outline of a surface, the
/// surface hidden behind it may count as lit. One strip of 256 changes the mean of slopes that
/// differ by 45° by less than 0.2°.
const STRIPS: usize = 256;

/// Fraction of the distance from the laser to the centre of the field within which nothing
/// counts.
const NEAREST: f64 = 1e-3;

/// Returns the mean normal (head's frame, towards the laser) of what the laser lights within
/// the camera's view, over the path; `None` if that is nothing.
///
/// Surface counts by the solid angle that it fills as seen from the laser, within the beam's
/// radius of the sheet, times the cosine of the angle at which the camera sees it.
pub(crate) fn lit_normal(scene: &Scene, accel: &Accel) -> Option<DVec3> {
    let wedge = Wedge::of(scene)?;
    let clusters = Clusters::new(accel.mesh());
    let last = scene.scan.frames.saturating_sub(1) as u64;
    let frames = (0..PLACES as u64).map(|i| (last * i / (PLACES as u64 - 1)) as u32);
    let sum: DVec3 = frames
        .map(|frame| {
            let part_from_laser = scene.part_from_head(frame) * scene.head_from_laser;
            let strips: Vec<DVec3> = (0..STRIPS)
                .into_par_iter()
                .map(|strip| wedge.normals(accel, &clusters, &part_from_laser, strip))
                .collect();
            strips.into_iter().sum::<DVec3>()
        })
        .sum();
    let normal = scene.head_from_laser.vector(sum);
    normal.try_normalize()
}

/// The light that the camera may see, in the laser's frame: a wedge from the laser, thin
/// across the sheet, cut into strips along it.
struct Wedge {
    /// x/z from and to which the light goes.
    ends: [f64; 2],
    /// |y/z| up to which it goes.
    half: f64,
    /// z from which surface counts, mm.
    near: f64,
    /// The camera, and the pyramid that it sees.
    eye: DVec3,
    view: [HalfSpace; 4],
}

/// The lit part of a triangle in a strip.
struct Piece {
    /// z of its middle, mm.
    depth: f64,
    face: Face,
    /// Solid angle from the laser, and what of it the camera's view holds.
    filled: f64,
    seen: f64,
    /// Normal times the cosine to the camera.
    normal: DVec3,
}

impl Wedge {
    fn of(scene: &Scene) -> Option<Wedge> {
        let (camera, laser) = (&scene.camera, &scene.laser);
        let laser_from_camera = scene.head_from_laser.inverse() * scene.head_from_camera;
        let middle = surface_view(scene, None).point;
        let middle = scene.head_from_laser.inverse().point(middle);
        let distance = middle.length();
        let half = laser.beam.radius(distance) / distance;
        let ends = match &laser.fan {
            None => [-half, half],
            Some(fan) => SheetAngles::new(fan, camera, &laser_from_camera.inverse())
                .seen()
                .map(f64::tan),
        };
        let sight = Sight::new(camera, &laser_from_camera);
        let resolution = camera.sensor.resolution.as_dvec2();
        let projection = Projection::new(&sight, resolution);
        let bend = Bend::new(camera, &sight, laser_from_camera.rotation);
        (half.is_finite() && ends[0] < ends[1]).then(|| Wedge {
            ends,
            half,
            near: NEAREST * distance,
            eye: sight.eye,
            view: frustum(sight.eye, &projection, resolution, bend.as_ref()),
        })
    }

    /// Returns the half-spaces that bound a strip.
    fn strip(&self, strip: usize) -> [HalfSpace; 5] {
        let [from, to] = [strip, strip + 1].map(|i| {
            let share = i as f64 / STRIPS as f64;
            self.ends[0] + (self.ends[1] - self.ends[0]) * share
        });
        let from_laser = |x, y, z| HalfSpace::new(DVec3::ZERO, DVec3::new(x, y, z));
        [
            from_laser(1.0, 0.0, -from),
            from_laser(-1.0, 0.0, to),
            from_laser(0.0, 1.0, self.half),
            from_laser(0.0, -1.0, self.half),
            HalfSpace::new(DVec3::Z * self.near, DVec3::Z),
        ]
    }

    /// Returns the sum of the normals of the lit and seen surface in a strip, each times its
    /// solid angle.
    fn normals(
        &self,
        accel: &Accel,
        clusters: &Clusters,
        part_from_laser: &Rigid,
        strip: usize,
    ) -> DVec3 {
        let bounds = self.strip(strip);
        let margin = accel.resolution();
        let volume = bounds.map(|half| {
            let on_it = part_from_laser.point(half.normal * -half.offset);
            HalfSpace::new(on_it, part_from_laser.vector(half.normal)).widened(margin)
        });
        let laser_from_part = part_from_laser.inverse();
        let mut pieces = Vec::new();
        accel.touching(clusters, &volume, 0.0, |found| {
            if let Found::Triangle { face, .. } = found {
                let corners = accel.corners(face).map(|p| laser_from_part.point(p));
                pieces.extend(self.piece(&bounds, face, corners));
            }
        });
        pieces.sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.face.cmp(&b.face)));
        // Each piece is lit as far as those before it leave the strip free. (Pieces of one
        // surface do not overlap, so together they never fill more than there is, and their
        // order does not matter.)
        let mut free = (self.ends[1] - self.ends[0]) / STRIPS as f64 * 2.0 * self.half;
        let mut sum = DVec3::ZERO;
        for piece in pieces {
            let lit = piece.filled.min(free);
            free -= lit;
            sum += piece.normal * (piece.seen * (lit / piece.filled));
        }
        sum
    }

    /// Returns the part of a triangle (laser's frame) that lies in a strip.
    fn piece(&self, bounds: &[HalfSpace], face: Face, corners: [DVec3; 3]) -> Option<Piece> {
        let mut polygon = Polygon::new(corners);
        for half in bounds {
            polygon.cut(half);
        }
        let filled = solid_angle(&polygon);
        if filled <= 0.0 {
            return None;
        }
        let middle = middle(&polygon);
        let normal = facing_normal(corners, middle)?;
        for half in &self.view {
            polygon.cut(half);
        }
        let cosine = normal.dot((self.eye - middle).normalize_or_zero());
        Some(Piece {
            depth: middle.z,
            face,
            filled,
            seen: solid_angle(&polygon),
            normal: normal * cosine.max(0.0),
        })
    }
}

/// Area of a polygon as seen from the origin on a screen at z = 1.
fn solid_angle(polygon: &Polygon) -> f64 {
    let corners = polygon.corners();
    let Some((&first, others)) = corners.split_first() else {
        return 0.0;
    };
    let screen = |p: DVec3| p.truncate() / p.z;
    let from = screen(first);
    let twice: f64 = others
        .windows(2)
        .map(|pair| (screen(pair[0]) - from).perp_dot(screen(pair[1]) - from))
        .sum();
    twice.abs() / 2.0
}

/// Mean of a polygon's corners.
fn middle(polygon: &Polygon) -> DVec3 {
    polygon.corners().iter().sum::<DVec3>() / polygon.count as f64
}

#[cfg(test)]
#[path = "lit_normal_tests.rs"]
mod tests;
