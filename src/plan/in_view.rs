//! What of the part the laser lights and the camera sees along the path of a scan. The
//! plan is made for these places: a part may be many times as large as what the sensor
//! sees of it.

use crate::accel::{Accel, HalfSpace, Ray, WIDTH};
use crate::camera::{Camera, Projector};
use crate::frame::{Bend, Projection, SheetAngles, Sight, frustum, sides};
use crate::laser::Laser;
use crate::math::rng::{Key, Purpose};
use crate::math::{DVec2, DVec3, Rigid};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// A laser and a camera that stand still to each other.
#[derive(Debug, Clone, Copy)]
pub struct Optics<'a> {
    /// Source of the light plane.
    pub laser: &'a Laser,
    /// Lens and sensor.
    pub camera: &'a Camera,
    /// Where the laser stands before the camera.
    pub camera_from_laser: &'a Rigid,
    /// Whether what they look at may be brighter than white paint and send light unevenly through the pupil.
    pub glossy: bool,
}

/// Where the laser's light meets the part along a path, in the camera's view: the middle of a
/// line, and of a beam what is within its radius.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InView {
    /// Places on the part that are lit and seen, laser frame, mm; in the order of the
    /// frames. None: the sensor sees no light in any frame that was looked at.
    pub places: Vec<DVec3>,
    /// Unit normals of the part there, laser frame.
    pub normals: Vec<DVec3>,
    /// Frames looked at that have such a place.
    pub frames: Vec<u32>,
    /// Laser rays traced: none if the light never enters the camera's view, or the
    /// part's box never enters both.
    pub rays: usize,
    /// Those of them that meet the part.
    pub met: usize,
    /// Those that meet it where the sensor would see it, were nothing in between.
    pub on_sensor: usize,
}

/// Laser rays traced in all, as jittered samples over frames and angles of the fan
/// (Cook 1986): what holds a share s of the line's points on a path has none of them
/// with a probability of at most e^(-s·RAYS) if it is spread over the frames, 6e-15
/// for s = 1/1000.
const RAYS: usize = 1 << 15;
/// Rays of a frame of a line laser, at least. So 1024 frames are looked at: of what is
/// in one of a hundred frames, none is among them with a probability of 3e-5.
const RAYS_PER_FRAME: usize = 32;
/// Frames in which the part's box is looked for.
const MOST_FRAMES: usize = 1 << 20;
/// Nodes along each side of the sensor.
const NODES: usize = 9;

impl InView {
    /// Looks at the frames 0 to `frames` - 1 of a path, in which the laser stands at
    /// `part_from_laser`. All of them if they are no more than 1024 (32 768 of a point
    /// laser), else so many of those in which the part's box may be in view. Does not
    /// depend on the number of threads.
    pub fn along(
        optics: &Optics,
        accel: &Accel,
        frames: u32,
        part_from_laser: impl Fn(u32) -> Rigid + Sync,
    ) -> InView {
        let key = Key::new(0, Purpose::PlanRays);
        let angles = match &optics.laser.fan {
            None => [0.0, 0.0],
            Some(fan) => SheetAngles::new(fan, optics.camera, optics.camera_from_laser).seen(),
        };
        let least = match optics.laser.fan {
            None => 1,
            Some(_) if angles[1] <= angles[0] => return InView::default(),
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
        let tracer = Tracer {
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
        let found: Vec<(u32, InView)> = chosen
            .into_par_iter()
            .map(|frame| {
                let key = key.with(frame as u64);
                (frame, tracer.frame(&part_from_laser(frame), key))
            })
            .collect();
        let mut all = InView::default();
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

/// One place in each of up to `most` equal parts of 0 to `count` - 1, rising; all of
/// them if there are no more. Not evenly spaced, so that nothing the part repeats falls
/// between them.
fn strata(most: usize, count: usize, key: Key) -> impl Iterator<Item = usize> {
    let parts = most.min(count);
    (0..parts).map(move |i| match parts == count {
        true => i,
        false => {
            let at = (i as f64 + key.uniform(i as u64)) / parts as f64;
            ((at * count as f64) as usize).min(count - 1)
        }
    })
}

/// Half-spaces of the laser frame that hold the middle of the light where the sensor
/// sees it, and `margin` around it.
fn region(optics: &Optics, margin: f64) -> Vec<HalfSpace> {
    let camera = optics.camera;
    let pose = optics.camera_from_laser.inverse();
    let sight = Sight::new(camera, &pose);
    let resolution = camera.sensor.resolution.as_dvec2();
    let projection = Projection::new(&sight, resolution);
    let bend = Bend::new(camera, &sight, pose.rotation);
    let mut region: Vec<HalfSpace> = [DVec3::Y, -DVec3::Y, DVec3::Z]
        .map(|inward| HalfSpace::new(DVec3::ZERO, inward))
        .into();
    region.extend(
        sides(optics.laser, &Rigid::IDENTITY, 0.0)
            .into_iter()
            .flatten(),
    );
    region.extend(frustum(sight.eye, &projection, resolution, bend.as_ref()));
    region
        .into_iter()
        .map(|half| half.widened(margin))
        .collect()
}

struct Tracer<'a> {
    optics: &'a Optics<'a>,
    accel: &'a Accel,
    laser_from_camera: Rigid,
    projector: Projector,
    /// Of the fan where the sensor may see it, rad.
    angles: [f64; 2],
    /// In each frame.
    rays: usize,
    /// From the laser to where a beam's rays are as far off its axis as its width there has it;
    /// they are taken as straight, mm.
    distance: f64,
}

impl Tracer<'_> {
    fn frame(&self, part_from_laser: &Rigid, key: Key) -> InView {
        let [low, high] = self.angles;
        let laser = self.optics.laser;
        let [near, far] = [0.0, self.distance].map(|z| laser.beam.radius(z));
        let ray = |i: usize| {
            let share = (i as f64 + key.uniform(i as u64)) / self.rays as f64;
            if laser.fan.is_some() {
                let (x, z) = (low + (high - low) * share).sin_cos();
                return (DVec3::ZERO, DVec3::new(x, 0.0, z));
            }
            // The first on the axis; the others evenly over the beam's disc.
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
        let mut seen = InView {
            rays: rays.len(),
            ..InView::default()
        };
        for rays in rays.chunks(WIDTH) {
            self.trace(part_from_laser, rays, &mut seen);
        }
        seen
    }

    fn trace(&self, part_from_laser: &Rigid, rays: &[Ray], seen: &mut InView) {
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

impl Optics<'_> {
    /// Places in the middle of the laser's light that the sensor sees, laser frame, mm,
    /// whether or not a part is there: for a line where 9 × 9 pixels look at the sheet,
    /// for a beam the places of its axis nearest to what they look at. None where light
    /// and view do not meet.
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
                // What lies on the sensor's border is imaged to either side of it.
                let inside =
                    pixel.cmpge(DVec2::splat(-1e-6)).all() && pixel.cmple(resolution + 1e-6).all();
                (place.is_finite() && inside && self.laser.section(place).is_some())
                    .then_some(place)
            })
            .collect()
    }
}

#[cfg(test)]
#[path = "in_view_tests.rs"]
mod tests;
