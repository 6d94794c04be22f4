//! Illuminated and visible surface of the part along the path of a scan. The configuration is
//! chosen for these positions, because the part may be much larger than the field of view.

use crate::accel::{Accel, HalfSpace, Ray, WIDTH};
use crate::camera::{Camera, Projector};
use crate::frame::{DistortedFrustum, FanAngleRange, PinholeGeometry, Projection, frustum, sides};
use crate::laser::Laser;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3, Rigid};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Laser and camera with a fixed relative pose.
#[derive(Debug, Clone, Copy)]
pub struct SensorOptics<'a> {
    /// Source of the light plane.
    pub laser: &'a Laser,
    /// Lens and sensor.
    pub camera: &'a Camera,
    /// Pose of the laser in the camera's frame.
    pub camera_from_laser: &'a Rigid,
    /// True if the surface may be brighter than a white diffuser and illuminate the pupil
    /// non-uniformly.
    pub glossy: bool,
}

/// Visible laser light on the part along a path. For a line, it includes the line centre; for a
/// beam, the area within the beam radius.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VisibleLine {
    /// Illuminated and visible positions on the part, laser frame, mm, in the order of the frames.
    /// Empty if the sensor receives no light in any traced frame.
    pub places: Vec<DVec3>,
    /// Unit normals of the part at these positions, laser frame.
    pub normals: Vec<DVec3>,
    /// Traced frames with at least one such position.
    pub frames: Vec<u32>,
    /// Number of traced laser rays. It is zero if the light never enters the field of view, or if
    /// the bounding box of the part never enters both.
    pub rays: usize,
    /// Number of laser rays that hit the part.
    pub met: usize,
    /// Number of laser rays whose hit is in the field of view, including occluded hits.
    pub on_sensor: usize,
}

/// Total number of laser rays, as jittered samples over frames and angles of the fan (Cook 1986). A
/// feature with a fraction s of all line points, distributed over the frames, is missed with a
/// probability of at most e^(-s·RAYS). For s = 1/1000, this is 6e-15.
const RAYS: usize = 1 << 15;
/// Minimum number of rays per frame of a line laser, hence 1024 traced frames. A feature in one of
/// a hundred frames is missed with a probability of 3e-5.
const RAYS_PER_FRAME: usize = 32;
/// Maximum number of frames in which the bounding box of the part is tested.
const MOST_FRAMES: usize = 1 << 20;
/// Nodes along each side of the sensor.
const NODES: usize = 9;

impl VisibleLine {
    /// Traces the frames 0 to `frames` - 1 of a path with the laser poses `part_from_laser`. All
    /// frames are traced if there are at most 1024 (32 768 for a point laser). Otherwise, this
    /// number is sampled from the frames in which the bounding box of the part may be visible. The
    /// result does not depend on the number of threads.
    pub fn along(
        optics: &SensorOptics,
        accel: &Accel,
        frames: u32,
        part_from_laser: impl Fn(u32) -> Rigid + Sync,
    ) -> VisibleLine {
        let key = RngKey::new(0, Purpose::PlanRays);
        let angles = match &optics.laser.fan {
            None => [0.0, 0.0],
            Some(fan) => {
                FanAngleRange::new(fan, optics.camera, optics.camera_from_laser).visible_angles()
            }
        };
        let least = match optics.laser.fan {
            None => 1,
            Some(_) if angles[1] <= angles[0] => return VisibleLine::default(),
            Some(_) => RAYS_PER_FRAME,
        };
        let all: Vec<usize> = strata(MOST_FRAMES, frames as usize, key).collect();
        let region = region(optics, accel.resolution());
        let corners = accel.bounds().corners();
        let near: Vec<u32> = all
            .into_par_iter()
            .map(|frame| frame as u32)
            .filter(|&frame| {
                let laser_from_part = part_from_laser(frame).inverse();
                let corners = corners.map(|corner| laser_from_part.point(corner));
                let reaches = |half: &HalfSpace| corners.iter().any(|&p| half.height(p) >= 0.0);
                region.iter().all(reaches)
            })
            .collect();
        let chosen: Vec<u32> = strata(RAYS / least, near.len(), key.with(u64::MAX))
            .map(|i| near[i])
            .collect();
        let tracer = LineTracer {
            optics,
            accel,
            laser_from_camera: optics.camera_from_laser.inverse(),
            projector: optics.camera.model().projector(),
            angles,
            rays: (RAYS / chosen.len().max(1)).min(match optics.laser.fan {
                None => RAYS_PER_FRAME,
                Some(_) => RAYS / RAYS_PER_FRAME,
            }),
            distance: optics.overlap().first().map_or(1.0, |place| place.z),
        };
        let found: Vec<(u32, VisibleLine)> = chosen
            .into_par_iter()
            .map(|frame| {
                let key = key.with(frame as u64);
                (frame, tracer.frame(&part_from_laser(frame), key))
            })
            .collect();
        let mut all = VisibleLine::default();
        for (frame, seen) in found {
            if !seen.places.is_empty() {
                all.frames.push(frame);
            }
            all.places.extend(seen.places);
            all.normals.extend(seen.normals);
            all.rays += seen.rays;
            all.met += seen.met;
            all.on_sensor += seen.on_sensor;
        }
        all
    }
}

/// Returns one random index in each of up to `most` equal intervals of 0 to `count` - 1, in
/// ascending order. If `count` is at most `most`, all indices are returned. The random positions
/// avoid aliasing with periodic features of the part.
fn strata(most: usize, count: usize, key: RngKey) -> impl Iterator<Item = usize> {
    let parts = most.min(count);
    (0..parts).map(move |i| match parts == count {
        true => i,
        false => {
            let at = (i as f64 + key.uniform(i as u64)) / parts as f64;
            ((at * count as f64) as usize).min(count - 1)
        }
    })
}

/// Returns half-spaces in the laser frame that enclose the visible part of the light's centre, with
/// a margin of `margin`.
fn region(optics: &SensorOptics, margin: f64) -> Vec<HalfSpace> {
    let camera = optics.camera;
    let pose = optics.camera_from_laser.inverse();
    let sight = PinholeGeometry::new(camera, &pose);
    let resolution = camera.sensor.resolution.as_dvec2();
    let projection = Projection::new(&sight, resolution);
    let bend = DistortedFrustum::new(camera, &sight, pose.rotation);
    let mut region: Vec<HalfSpace> = [DVec3::Y, -DVec3::Y, DVec3::Z]
        .map(|inward| HalfSpace::new(DVec3::ZERO, inward))
        .into();
    region.extend(
        sides(optics.laser, &Rigid::IDENTITY, 0.0)
            .into_iter()
            .flatten(),
    );
    region.extend(frustum(
        sight.camera_center,
        &projection,
        resolution,
        bend.as_ref(),
    ));
    region
        .into_iter()
        .map(|half| half.widened(margin))
        .collect()
}

struct LineTracer<'a> {
    optics: &'a SensorOptics<'a>,
    accel: &'a Accel,
    laser_from_camera: Rigid,
    projector: Projector,
    /// Angles of the fan in the field of view, rad.
    angles: [f64; 2],
    /// Number of rays per frame.
    rays: usize,
    /// Distance along the beam at which straight rays match the beam radius, mm.
    distance: f64,
}

impl LineTracer<'_> {
    fn frame(&self, part_from_laser: &Rigid, key: RngKey) -> VisibleLine {
        let [low, high] = self.angles;
        let laser = self.optics.laser;
        let [near, far] = [0.0, self.distance].map(|z| laser.beam.radius(z));
        let ray = |i: usize| {
            let share = (i as f64 + key.uniform(i as u64)) / self.rays as f64;
            if laser.fan.is_some() {
                let (x, z) = (low + (high - low) * share).sin_cos();
                return (DVec3::ZERO, DVec3::new(x, 0.0, z));
            }
            // The first ray is on the axis; the others are uniformly distributed over the beam's
            // cross section.
            let radius = if i == 0 { 0.0 } else { share.sqrt() };
            let turn = TAU * key.uniform((self.rays + i) as u64);
            let off = DVec2::from_angle(turn) * radius;
            let start = (off * near).extend(0.0);
            (start, (off * far).extend(self.distance) - start)
        };
        let ray = |i| {
            let (start, towards) = ray(i);
            Ray {
                origin: part_from_laser.point(start),
                direction: part_from_laser.vector(towards).normalize(),
                t_max: f64::INFINITY,
            }
        };
        let rays: Vec<Ray> = (0..self.rays).map(ray).collect();
        let mut seen = VisibleLine {
            rays: rays.len(),
            ..VisibleLine::default()
        };
        for rays in rays.chunks(WIDTH) {
            self.trace(part_from_laser, rays, &mut seen);
        }
        seen
    }

    fn trace(&self, part_from_laser: &Rigid, rays: &[Ray], seen: &mut VisibleLine) {
        let resolution = self.optics.camera.sensor.resolution.as_dvec2();
        let laser_from_part = part_from_laser.inverse();
        let eye = part_from_laser.point(self.laser_from_camera.translation);
        let (mut places, mut normals, mut sights) = (Vec::new(), Vec::new(), Vec::new());
        for hit in self.accel.closest(rays, |_, _| true).into_iter().flatten() {
            seen.met += 1;
            let place = laser_from_part.point(hit.point);
            let pixel = self
                .projector
                .project(self.optics.camera_from_laser.point(place));
            if !pixel.is_some_and(|p| p.cmpge(DVec2::ZERO).all() && p.cmple(resolution).all()) {
                continue;
            }
            seen.on_sensor += 1;
            let start = hit.point + hit.normal * self.accel.resolution();
            let sight = Ray::between(start, eye);
            if let Some(sight) = sight.filter(|sight| sight.direction.dot(hit.normal) > 0.0) {
                places.push(place);
                normals.push(laser_from_part.vector(hit.normal));
                sights.push(sight);
            }
        }
        if sights.is_empty() {
            return;
        }
        let hidden = self.accel.occluded(&sights);
        let shown = places.into_iter().zip(normals).enumerate();
        let shown = shown.filter(|(i, _)| hidden >> i & 1 == 0);
        for (_, (place, normal)) in shown {
            seen.places.push(place);
            seen.normals.push(normal);
        }
    }
}

impl SensorOptics<'_> {
    /// Returns visible positions at the centre of the laser light, laser frame, mm, with or without
    /// a part. For a line, these are the intersections of 9 × 9 pixel rays with the laser plane.
    /// For a beam, they are the points of its axis nearest to these rays. Empty if light and field
    /// of view do not overlap.
    pub fn overlap(&self) -> Vec<DVec3> {
        let resolution = self.camera.sensor.resolution.as_dvec2();
        let laser_from_camera = self.camera_from_laser.inverse();
        let eye = laser_from_camera.translation;
        let nodes = (0..NODES * NODES).map(|i| {
            let share = DVec2::new((i % NODES) as f64, (i / NODES) as f64);
            resolution * share / (NODES - 1) as f64
        });
        nodes
            .filter_map(|pixel| {
                let direction = laser_from_camera.vector(self.camera.direction(pixel));
                let place = match self.laser.fan {
                    Some(_) => {
                        let t = -eye.y / direction.y;
                        (t > 0.0).then(|| (eye + direction * t).with_y(0.0))?
                    }
                    None => {
                        let along = direction.z;
                        let t = (along * eye.z - direction.dot(eye)) / (1.0 - along * along);
                        DVec3::Z * (eye.z + t * along)
                    }
                };
                let pixel = self.camera.project(self.camera_from_laser.point(place))?;
                // Rounding may image points of the sensor border to either side of it.
                let inside =
                    pixel.cmpge(DVec2::splat(-1e-6)).all() && pixel.cmple(resolution + 1e-6).all();
                (place.is_finite() && inside && self.laser.section(place).is_some())
                    .then_some(place)
            })
            .collect()
    }
}

#[cfg(test)]
#[path = "visible_line_tests.rs"]
mod tests;
