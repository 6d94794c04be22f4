//! Mean normal of the surface that the laser of a scan lights. Its speckle patterns move with this
//! surface.
//!
//! The mean normal determines how the patterns move, so different processors must compute one
//! value. Rays are unsuitable: at the common edge of two facets, the facet that a ray hits depends
//! on the vector instructions. The mean is therefore an integral over areas, computed in f64
//! without rays. A small displacement of a vertex changes the areas by a small amount, wherever the
//! edges lie.

use super::surface_view::surface_view;
use crate::accel::{Accel, ClusterHit, HalfSpace, TriangleClusters, TriangleId, facing_normal};
use crate::frame::{
    DistortedFrustum, FanAngleRange, PinholeGeometry, Polygon, Projection, frustum,
};
use crate::math::{DVec3, Rigid};
use crate::scene::Scene;
use rayon::prelude::*;

/// Number of poses along the path at which the surface is evaluated.
const PLACES: u32 = 5;

/// Number of strips into which the fan is divided. In a strip with the outline of a surface, hidden
/// surface behind the outline may count as lit. One strip of 256 changes the mean of slopes that
/// differ by 45° by less than 0.2°.
const STRIPS: usize = 256;

/// Near limit, as a fraction of the distance from the laser to the centre of the field. Closer
/// surface is ignored.
const NEAREST: f64 = 1e-3;

/// Returns the mean normal of the lit surface in the camera's view, over the path. It is in the
/// head's frame and points towards the laser; `None` if no lit surface is in view.
///
/// The weight of surface is its solid angle as viewed from the laser, within the beam radius of the
/// laser plane. It is multiplied by the cosine of the angle between the normal and the direction to
/// the camera.
pub(crate) fn lit_normal(scene: &Scene, accel: &Accel) -> Option<DVec3> {
    let wedge = Wedge::of(scene)?;
    let clusters = TriangleClusters::new(accel.mesh());
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

/// Volume of the light that the camera may see, in the laser's frame. It is a wedge with its apex
/// at the laser, thin across the laser plane and divided into strips along it.
struct Wedge {
    /// Smallest and largest x/z of the light.
    ends: [f64; 2],
    /// Largest |y/z| of the light.
    half: f64,
    /// Smallest z of surface that counts, mm.
    near: f64,
    /// Position of the camera; `view` is its view frustum.
    eye: DVec3,
    view: [HalfSpace; 4],
}

/// The lit part of a triangle in a strip.
struct LitPiece {
    /// z of its centre, mm.
    depth: f64,
    face: TriangleId,
    /// Solid angle as viewed from the laser; `seen` is the part inside the camera's view.
    filled: f64,
    seen: f64,
    /// Normal times the cosine of the angle to the camera.
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
            Some(fan) => FanAngleRange::new(fan, camera, &laser_from_camera.inverse())
                .visible_angles()
                .map(f64::tan),
        };
        let sight = PinholeGeometry::new(camera, &laser_from_camera);
        let resolution = camera.sensor.resolution.as_dvec2();
        let projection = Projection::new(&sight, resolution);
        let bend = DistortedFrustum::new(camera, &sight, laser_from_camera.rotation);
        (half.is_finite() && ends[0] < ends[1]).then(|| Wedge {
            ends,
            half,
            near: NEAREST * distance,
            eye: sight.camera_center,
            view: frustum(sight.camera_center, &projection, resolution, bend.as_ref()),
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

    /// Returns the sum of the normals of lit and visible surface in a strip, weighted by solid
    /// angle.
    fn normals(
        &self,
        accel: &Accel,
        clusters: &TriangleClusters,
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
            if let ClusterHit::Triangle { face, .. } = found {
                let corners = accel.corners(face).map(|p| laser_from_part.point(p));
                pieces.extend(self.piece(&bounds, face, corners));
            }
        });
        pieces.sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.face.cmp(&b.face)));
        // Earlier pieces reduce the solid angle that lights the later ones. Pieces of one surface
        // do not overlap, so their sum never exceeds the available solid angle and their order is
        // irrelevant.
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
    fn piece(
        &self,
        bounds: &[HalfSpace],
        face: TriangleId,
        corners: [DVec3; 3],
    ) -> Option<LitPiece> {
        let mut polygon = Polygon::new(corners);
        for half in bounds {
            polygon.clip(half);
        }
        let filled = solid_angle(&polygon);
        if filled <= 0.0 {
            return None;
        }
        let middle = middle(&polygon);
        let normal = facing_normal(corners, middle)?;
        for half in &self.view {
            polygon.clip(half);
        }
        let cosine = normal.dot((self.eye - middle).normalize_or_zero());
        Some(LitPiece {
            depth: middle.z,
            face,
            filled,
            seen: solid_angle(&polygon),
            normal: normal * cosine.max(0.0),
        })
    }
}

/// Returns the area of a polygon projected from the origin onto the plane z = 1.
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

/// Returns the mean of a polygon's corners.
fn middle(polygon: &Polygon) -> DVec3 {
    polygon.corners().iter().sum::<DVec3>() / polygon.count as f64
}

#[cfg(test)]
#[path = "lit_normal_tests.rs"]
mod tests;
