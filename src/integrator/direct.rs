//! Light that goes laser → surface → camera. For each sample on a pixel: camera
//! ray, closest hit, laser light there, shadow ray to the aperture point it came
//! from, Lambert reflection, pupil solid angle, speckle.

use crate::accel::{Accel, Hit, Ray, WIDTH};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3, Rigid};
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::lookup::Lookup;
use crate::surface::Lambert;
use rayon::prelude::*;

/// Everything one frame depends on, in the part's frame.
pub struct View<'a> {
    pub accel: &'a Accel<'a>,
    pub surface: Lambert,
    pub laser: &'a Laser,
    pub part_from_laser: Rigid,
    pub camera: &'a Camera,
    pub part_from_camera: Rigid,
    /// `None`: the light is taken as incoherent.
    pub speckle: Option<Speckle<'a>>,
    /// Samples along each side of a pixel.
    pub samples_per_side: u32,
}

/// Speckle patterns, and how they lie over the sensor in one frame.
#[derive(Clone, Copy)]
pub struct Speckle<'a> {
    pub lookup: &'a Lookup,
    pub map: GrainMap,
    /// a_I of the seed: displacement on the sensor at which the pattern is read,
    /// (columns, rows), mm.
    pub displacement: DVec2,
    /// u, in slices.
    pub slice: f64,
}

impl Speckle<'_> {
    /// Speckle intensity (mean 1) at a point of the sensor, mm from its centre.
    fn intensity(&self, screen: DVec2) -> f64 {
        let (s, t) = self.map.position(screen, self.displacement).into();
        let u = self.slice;
        self.lookup.intensity(Coordinate { s, t, u }) as f64
    }
}

/// Irradiance on the sensor averaged over each pixel, mW/mm², row by row.
/// The same bytes for any number of threads: pixels are summed one by one, each
/// in a fixed order.
pub fn irradiance_image(view: &View) -> Vec<f32> {
    let resolution = view.camera.sensor.resolution;
    let columns = resolution.x as usize;
    let frame = Frame::new(view);
    let mut image = vec![0.0f32; columns * resolution.y as usize];
    // Eight rows amortise a task and leave a hundred tasks to share out.
    let rows_per_task = 8;
    image
        .par_chunks_mut(columns * rows_per_task)
        .enumerate()
        .for_each(|(task, rows)| {
            let mut sums = vec![0.0f64; columns];
            for (i, row) in rows.chunks_exact_mut(columns).enumerate() {
                frame.render_row(task * rows_per_task + i, &mut sums);
                for (pixel, sum) in row.iter_mut().zip(&sums) {
                    *pixel = *sum as f32;
                }
            }
        });
    image
}

/// A view with what its samples share computed once.
struct Frame<'a> {
    view: &'a View<'a>,
    laser_from_part: Rigid,
    eye: DVec3,
    /// The sensor point of pixel (0, 0) in the camera frame, and the steps from
    /// column to column and row to row: the sensor is a plane.
    sensor_origin: DVec3,
    sensor_column: DVec3,
    sensor_row: DVec3,
    /// Eye and half extents of the lit box in the laser frame: a camera ray meets
    /// light only inside it.
    eye_in_laser: DVec3,
    reach: DVec2,
    /// Numerator of the pupil's solid angle: area × cos·cos/r² is
    /// this × z/r⁴ with r the distance to the sensor point.
    pupil: f64,
}

/// A place on the sensor whose ray may meet light.
#[derive(Clone, Copy)]
struct Sample {
    pixel: DVec2,
    ray: Ray,
    /// Distances between which a hit may be lit.
    lit: (f64, f64),
    /// Irradiance on the sensor per radiance, sr.
    solid_angle: f64,
}

/// Up to 16 samples of one sub-row, from left to right.
struct Packet {
    samples: [Sample; WIDTH],
    rays: [Ray; WIDTH],
    count: usize,
}

impl Packet {
    fn new(eye: DVec3) -> Packet {
        let ray = Ray {
            origin: eye,
            direction: DVec3::Z,
            t_max: 0.0,
        };
        let sample = Sample {
            pixel: DVec2::ZERO,
            ray,
            lit: (0.0, 0.0),
            solid_angle: 0.0,
        };
        Packet {
            samples: [sample; WIDTH],
            rays: [ray; WIDTH],
            count: 0,
        }
    }

    fn push(&mut self, sample: Sample) {
        self.rays[self.count] = sample.ray;
        self.samples[self.count] = sample;
        self.count += 1;
    }
}

impl<'a> Frame<'a> {
    fn new(view: &'a View<'a>) -> Frame<'a> {
        let at = |x: f64, y: f64| view.camera.sensor_point(DVec2::new(x, y));
        let origin = at(0.0, 0.0);
        let (column, row) = (at(1.0, 0.0) - origin, at(0.0, 1.0) - origin);
        let normal = column.cross(row).normalize();
        let laser_from_part = view.part_from_laser.inverse();
        let eye = view.part_from_camera.translation;
        let corners = view.accel.bounds().corners();
        let furthest = corners
            .map(|c| laser_from_part.point(c).length())
            .into_iter()
            .fold(0.0, f64::max);
        Frame {
            view,
            eye,
            eye_in_laser: laser_from_part.point(eye),
            reach: view.laser.reach(furthest),
            laser_from_part,
            sensor_origin: origin,
            sensor_column: column,
            sensor_row: row,
            pupil: view.camera.lens.pupil_area() * normal.dot(origin),
        }
    }

    /// Mean irradiance of the pixels of one row.
    fn render_row(&self, row: usize, sums: &mut [f64]) {
        sums.fill(0.0);
        let side = self.view.samples_per_side as usize;
        for sub_row in 0..side {
            let y = row as f64 + (sub_row as f64 + 0.5) / side as f64;
            let mut packet = Packet::new(self.eye);
            for i in 0..sums.len() * side {
                let pixel = DVec2::new((i as f64 + 0.5) / side as f64, y);
                if let Some(sample) = self.sample(pixel) {
                    packet.push(sample);
                    if packet.count == WIDTH {
                        self.render_packet(&packet, sums);
                        packet.count = 0;
                    }
                }
            }
            self.render_packet(&packet, sums);
        }
    }

    /// The camera ray of a place on the sensor; `None` if it meets no light.
    fn sample(&self, pixel: DVec2) -> Option<Sample> {
        let to_sensor =
            self.sensor_origin + self.sensor_column * pixel.x + self.sensor_row * pixel.y;
        let r2 = to_sensor.length_squared();
        let direction = self.view.part_from_camera.vector(to_sensor / r2.sqrt());
        let (from, to) = self.lit_interval(self.laser_from_part.vector(direction))?;
        let ray = Ray {
            origin: self.eye,
            direction,
            t_max: f64::INFINITY,
        };
        let (enter, leave) = self.view.accel.interval(&ray)?;
        (from.max(enter) <= to.min(leave)).then_some(Sample {
            pixel,
            ray,
            lit: (from, to),
            solid_angle: self.pupil * to_sensor.z / (r2 * r2),
        })
    }

    /// Distances between which a camera ray along `direction` (laser frame) is in
    /// the lit box, widened by what refinement may move a hit.
    fn lit_interval(&self, direction: DVec3) -> Option<(f64, f64)> {
        let (mut from, mut to) = (0.0f64, f64::INFINITY);
        for axis in 0..2 {
            let (start, speed) = (self.eye_in_laser[axis], direction[axis]);
            if speed == 0.0 {
                if start.abs() > self.reach[axis] {
                    return None;
                }
                continue;
            }
            let middle = -start / speed;
            let half = self.reach[axis] / speed.abs();
            from = from.max(middle - half);
            to = to.min(middle + half);
        }
        let margin = self.view.accel.refinement();
        (from <= to).then_some((from - margin, to + margin))
    }

    fn render_packet(&self, packet: &Packet, sums: &mut [f64]) {
        let (samples, rays) = (
            &packet.samples[..packet.count],
            &packet.rays[..packet.count],
        );
        let in_light = |i: usize, t: f64| {
            let (from, to) = samples[i].lit;
            from <= t && t <= to
        };
        let hits = self.view.accel.closest(rays, in_light);
        let per_sample = 1.0 / (self.view.samples_per_side as f64).powi(2);
        let mut shadow_rays = [packet.rays[0]; WIDTH];
        let mut lit = [(0, 0.0); WIDTH];
        let mut count = 0;
        for (sample, hit) in samples.iter().zip(hits) {
            let Some((received, shadow_ray)) = hit.and_then(|hit| self.light_at(&hit)) else {
                continue;
            };
            let radiance = self.view.surface.radiance(received);
            let speckle = self.view.speckle.map_or(1.0, |speckle| {
                speckle.intensity(self.view.camera.screen(sample.pixel))
            });
            shadow_rays[count] = shadow_ray;
            let irradiance = radiance * sample.solid_angle * speckle * per_sample;
            lit[count] = (sample.pixel.x as usize, irradiance);
            count += 1;
        }
        if count == 0 {
            return;
        }
        let blocked = self.view.accel.occluded(&shadow_rays[..count]);
        for (i, &(column, irradiance)) in lit[..count].iter().enumerate() {
            if blocked >> i & 1 == 0 {
                sums[column] += irradiance;
            }
        }
    }

    /// Irradiance (mW/mm²) the surface receives at `hit` on the side that is
    /// seen, and the ray on which it may be blocked.
    fn light_at(&self, hit: &Hit) -> Option<(f64, Ray)> {
        let light = self.view.laser.at(self.laser_from_part.point(hit.point))?;
        let received = -light.flux.dot(self.laser_from_part.vector(hit.normal));
        if received <= 0.0 {
            return None;
        }
        let start = hit.point + hit.normal * self.view.accel.resolution();
        let aperture = self.view.part_from_laser.point(light.aperture_point);
        let shadow_ray = Ray::between(start, aperture)?;
        // At grazing light the local direction may come from the front and the
        // chord from behind: then the surface itself is in the way.
        (shadow_ray.direction.dot(hit.normal) > 0.0).then_some((received, shadow_ray))
    }
}
