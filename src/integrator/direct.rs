//! Light that goes laser → surface → camera. For each sample on a pixel: camera
//! ray, closest hit, laser light there, shadow ray to the aperture point it came
//! from, Lambert reflection, pupil solid angle, speckle.

use super::blocks::Blocks;
use super::footprint::Footprint;
use super::sight::Sight;
use super::speckle::{Reader, Speckle};
use crate::accel::{Accel, Clusters, Hit, Ray, WIDTH};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3, Rigid};
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

/// Irradiance on the sensor averaged over each pixel, mW/mm², row by row.
/// The same bytes for any number of threads: pixels are summed one by one, each
/// in a fixed order. Traces every sample; [`footprint_image`] gives the same.
pub fn irradiance_image(view: &View) -> Vec<f32> {
    let everything = Footprint {
        blocks: Blocks::all(view.camera.sensor.resolution, view.samples_per_side),
        reach: f64::INFINITY,
    };
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, &everything)
}

/// The bytes of [`irradiance_image`], of which only those samples are traced that
/// may see lit surface; `clusters` are those of the view's mesh.
pub fn footprint_image(view: &View, clusters: &Clusters) -> Vec<f32> {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, &Footprint::new(view, &sight, clusters))
}

/// The image of the light that the samples of a footprint see.
fn trace(view: &View, sight: &Sight, footprint: &Footprint) -> Vec<f32> {
    let resolution = view.camera.sensor.resolution;
    let columns = resolution.x as usize;
    let laser_from_part = view.part_from_laser.inverse();
    let frame = Frame {
        view,
        sight,
        blocks: &footprint.blocks,
        laser_from_part,
        eye_to_sheet: laser_from_part.point(sight.eye).y,
        across: view.part_from_laser.rotation.y_axis,
        reach: footprint.reach + view.accel.refinement(),
        side: view.samples_per_side as usize,
        speckle: view
            .speckle
            .map(|speckle| Reader::new(&speckle, view.camera, &footprint.blocks)),
    };
    let mut image = vec![0.0f32; columns * resolution.y as usize];
    // Eight rows amortise a task and leave a hundred tasks to share out.
    let rows_per_task = 8;
    image
        .par_chunks_mut(columns * rows_per_task)
        .enumerate()
        .for_each(|(task, rows)| {
            let mut sums = vec![0.0f64; columns];
            for (i, row) in rows.chunks_exact_mut(columns).enumerate() {
                if frame.render_row(task * rows_per_task + i, &mut sums) {
                    for (pixel, sum) in row.iter_mut().zip(&mut sums) {
                        *pixel = std::mem::take(sum) as f32;
                    }
                }
            }
        });
    image
}

/// A view with what its samples share computed once.
struct Frame<'a> {
    view: &'a View<'a>,
    sight: &'a Sight,
    blocks: &'a Blocks,
    laser_from_part: Rigid,
    /// Height of the eye over the laser's sheet, and the sheet's normal.
    eye_to_sheet: f64,
    across: DVec3,
    /// Hits higher than this over the sheet are dark, before refinement too.
    reach: f64,
    /// Samples along each side of a pixel.
    side: usize,
    speckle: Option<Reader<'a>>,
}

impl Frame<'_> {
    /// Adds the mean irradiance of the pixels of one row; `false` if none of its
    /// blocks is traced.
    fn render_row(&self, row: usize, sums: &mut [f64]) -> bool {
        let mut traced = false;
        for sub_row in row * self.side..(row + 1) * self.side {
            for first in self.blocks.of(sub_row) {
                self.render_block(sub_row, first, sums);
                traced = true;
            }
        }
        traced
    }

    /// Up to 16 samples of one sub-row, from sample `first` to the right.
    fn render_block(&self, sub_row: usize, first: usize, sums: &mut [f64]) {
        let count = WIDTH.min(self.blocks.samples - first);
        let per_sample = 1.0 / self.side as f64;
        let pixel =
            |i: usize| DVec2::new((first + i) as f64 + 0.5, sub_row as f64 + 0.5) * per_sample;
        let to_sensor = |i: usize| self.sight.to_sensor(pixel(i));
        let mut rays = [Ray {
            origin: self.sight.eye,
            direction: DVec3::Z,
            t_max: f64::INFINITY,
        }; WIDTH];
        let mut bend = DVec2::ZERO;
        for (i, ray) in rays[..count].iter_mut().enumerate() {
            ray.direction = self.sight.towards(to_sensor(i), &mut bend).normalize();
        }
        let near_sheet = |i: usize, t: f64| {
            let climb = self.across.dot(rays[i].direction);
            (self.eye_to_sheet + t * climb).abs() <= self.reach
        };
        let hits = self.view.accel.closest(&rays[..count], near_sheet);
        let mut shadow_rays = rays;
        let mut lit = [(0, 0.0, 0.0); WIDTH];
        let mut seen = 0;
        for (i, hit) in hits[..count].iter().enumerate() {
            let Some(hit) = hit else { continue };
            let Some((received, shadow_ray)) = self.light_at(hit) else {
                continue;
            };
            let radiance = self.view.surface.radiance(received);
            let irradiance = radiance * self.solid_angle(to_sensor(i));
            shadow_rays[seen] = shadow_ray;
            let depth = self.sight.axis.dot(hit.point - self.sight.eye);
            lit[seen] = (i, irradiance * per_sample * per_sample, depth);
            seen += 1;
        }
        if seen == 0 {
            return;
        }
        let blocked = self.view.accel.occluded(&shadow_rays[..seen]);
        for (bit, &(i, irradiance, depth)) in lit[..seen].iter().enumerate() {
            if blocked >> bit & 1 == 0 {
                let reader = self.speckle.as_ref();
                let speckle = reader.map_or(1.0, |reader| reader.intensity(pixel(i), depth));
                sums[(first + i) / self.side] += irradiance * speckle;
            }
        }
    }

    /// Irradiance on the sensor per radiance of what it sees there, sr.
    fn solid_angle(&self, to_sensor: DVec3) -> f64 {
        let r2 = to_sensor.length_squared();
        self.sight.pupil * self.sight.axis.dot(to_sensor) / (r2 * r2)
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
