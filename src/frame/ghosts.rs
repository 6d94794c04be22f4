//! Light that is reflected more than once: paths from the laser, joined to the pupil; paths from the camera that
//! reflect before they ask for laser light; and both joined to each other.
//!
//! The laser lights each point from one direction, so that its light is either asked for at a point, or followed
//! from the aperture. Paths are stratified (Sobol's sequence, scrambled), so that what a mirror shows of the line
//! is a line; mirrors reflect, and are not met by chance.

use super::View;
use super::defocus::{Blur, LensBlur};
use super::expose::expose;
use super::eye::{Eye, PupilPoint};
use super::footprint::Region;
use super::irradiance::Irradiance;
use super::join::{Path, towards};
use super::light::Light;
use super::pixels::{Pixels, Rows};
use super::walk::{Numbers, Vertex, walk};
use crate::accel::{Ray, WIDTH};
use crate::laser::gaussian;
use crate::math::rng::Key;
use crate::math::{DVec2, DVec3, Rigid, Sequence};
use rayon::prelude::*;
use std::f32::consts::{LN_2, PI};
use std::ops::Range;

/// How light that is reflected more than once is followed.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Reflections {
    /// Most reflections of a path, at least 2.
    pub most: u32,
    /// Paths from the laser.
    pub from_laser: u32,
    /// Paths from the camera for each pixel, 0 for none.
    pub per_pixel: f64,
}

impl Reflections {
    /// The same with so many times the paths.
    pub(crate) fn times(self, times: f64) -> Reflections {
        Reflections {
            from_laser: (times * self.from_laser as f64) as u32,
            per_pixel: times * self.per_pixel,
            ..self
        }
    }
}

/// What a frame has to know of light that is reflected more than once.
#[derive(Debug, Clone, Copy)]
pub struct Indirect {
    /// How it is followed.
    pub reflections: Reflections,
    /// The frame's.
    pub key: Key,
    /// λ²/Δλ of the laser, mm; infinite if no path differs by as much.
    pub coherence_length: f64,
}

impl Indirect {
    /// Whether all light that meets in a pixel has one speckle pattern: that of fields that add.
    pub(super) fn is_one_field(&self, view: &View) -> bool {
        view.speckle.as_ref().is_none_or(|speckle| {
            let anywhere = view.lens.blur != Blur::Coherent && !speckle.patterns.read_surface();
            anywhere && self.coherence_length == f64::INFINITY
        })
    }
}

/// Light that is reflected more than once, as it falls on the sensor.
pub struct Ghosts {
    /// Over each pixel, without speckle.
    pub mean: Irradiance,
    /// Of the speckle of each of its pixels; empty where that is 1.
    contrast: Vec<f32>,
}

impl Ghosts {
    /// With speckle of its own.
    pub(super) fn exposed(&self, view: &View) -> Irradiance {
        let view = View {
            lens: LensBlur::NONE,
            speckle: view.speckle.as_ref().map(|speckle| speckle.elsewhere(view)),
            ..view.clone()
        };
        let mut exposed = expose(Light::even(&self.mean, view.grid), &view);
        if view.speckle.is_some() && !self.contrast.is_empty() {
            let pairs = exposed.values_mut().iter_mut().zip(self.mean.values());
            for ((value, mean), contrast) in pairs.zip(&self.contrast) {
                *value = mean + contrast * (*value - mean);
            }
        }
        exposed
    }
}

/// What is known of a pixel's light by pairs of paths that reach it one after the other.
#[derive(Clone, Copy, Default)]
struct Pairs {
    last: f32,
    length: f32,
    /// Of products of their irradiances.
    sum: f32,
    /// The same times |γ|² of their lengths.
    coherent: f32,
}

impl Pairs {
    /// |γ|² of light of a Gaussian spectrum of full width Δλ at half maximum, of paths that differ by `d` coherence
    /// lengths (Goodman 1985, Statistical Optics, 5.1).
    fn coherence(d: f32) -> f32 {
        (-(PI * d).powi(2) / (2.0 * LN_2)).exp()
    }

    fn add(&mut self, irradiance: f32, length: f32, coherence_length: f32) {
        let product = self.last * irradiance;
        self.sum += product;
        self.coherent += product * Pairs::coherence((length - self.length) / coherence_length);
        (self.last, self.length) = (irradiance, length);
    }

    /// C² = Σ I_a·I_b·|γ_ab|²/(ΣI)²; 1 of light of one path.
    fn contrast(&self) -> f32 {
        match self.sum > 0.0 {
            true => (self.coherent / self.sum).sqrt(),
            false => 1.0,
        }
    }
}

/// Paths of a task; the same for any number of threads.
const TASK: u32 = 4096;
/// Tasks whose light is kept before it is added up.
const TASKS: u32 = 64;

/// Light that falls on a pixel.
struct Splat {
    /// Row by row.
    pixel: u32,
    /// mW/mm².
    irradiance: f32,
    /// From the laser to the pupil, mm.
    length: f32,
}

/// The light that is reflected at least twice, as the lens spreads it. The same bytes for any number of
/// threads.
pub fn ghosts(view: &View, region: &Region, indirect: &Indirect) -> Ghosts {
    let &Indirect {
        ref reflections,
        key,
        coherence_length,
    } = indirect;
    let tracer = Tracer {
        view,
        eye: Eye::new(view),
        laser_from_part: view.part_from_laser.inverse(),
        reflections,
    };
    let resolution = view.camera.sensor.resolution;
    let mut image = vec![0.0; resolution.element_product() as usize];
    let mixed = view.speckle.is_some() && coherence_length < f64::INFINITY;
    let mut pairs = vec![Pairs::default(); if mixed { image.len() } else { 0 }];
    let sequence = Sequence::new(key.with(0));
    let mut add = |tasks: u32, splats: &(dyn Fn(u32) -> Vec<Splat> + Sync)| {
        for first in (0..tasks).step_by(TASKS as usize) {
            let some = (first..(first + TASKS).min(tasks)).into_par_iter();
            // In the order of tasks.
            for splats in some.map(splats).collect::<Vec<_>>() {
                for splat in splats {
                    let pixel = splat.pixel as usize;
                    image[pixel] += splat.irradiance as f64;
                    if mixed {
                        pairs[pixel].add(splat.irradiance, splat.length, coherence_length as f32);
                    }
                }
            }
        }
    };
    add(reflections.from_laser.div_ceil(TASK), &|task| {
        let paths = TASK * task..(TASK * (task + 1)).min(reflections.from_laser);
        let mut splats = Vec::new();
        for first in paths.clone().step_by(WIDTH) {
            let last = (first + WIDTH as u32).min(paths.end);
            tracer.laser_paths(first..last, &sequence, &mut splats);
        }
        splats
    });
    let blocks = Blocks::new(view, reflections.per_pixel);
    add(blocks.rows() * blocks.per_block, &|task| {
        let mut splats = Vec::new();
        let sequence = Sequence::new(key.with(1).with((task / blocks.per_block) as u64));
        for first in (0..blocks.columns()).step_by(WIDTH) {
            let columns = first..(first + WIDTH as u32).min(blocks.columns());
            tracer.camera_paths(&blocks, task, columns, &sequence, &mut splats);
        }
        splats
    });
    let pixels = lit_pixels(&image, resolution, region);
    let columns = resolution.x as usize;
    let lit = || {
        let rows = 0..resolution.y as usize;
        rows.flat_map(|row| pixels.of(row).map(move |column| row * columns + column))
    };
    let values = lit().map(|pixel| image[pixel] as f32).collect();
    let contrast = match mixed {
        true => lit().map(|pixel| pairs[pixel].contrast()).collect(),
        false => Vec::new(),
    };
    Ghosts {
        mean: Irradiance::new(Rows::new(pixels), values),
        contrast,
    }
}

/// The pixels of a region that have light in an image.
fn lit_pixels(image: &[f64], resolution: glam::UVec2, region: &Region) -> Pixels {
    let mut pixels = Pixels::none(resolution);
    let columns = resolution.x as usize;
    for (row, values) in image.chunks(columns).enumerate() {
        for column in (0..columns).filter(|&column| values[column] > 0.0) {
            pixels.insert(row, column, column);
        }
    }
    if let Region::Columns(_, columns) = region {
        pixels.keep_columns(columns);
    }
    pixels
}

/// The laser's power that falls on the part, and of it what meets the part again after one reflection, mW, by
/// `paths` paths.
pub fn met_again(view: &View, paths: u32, key: Key) -> [f64; 2] {
    let tracer = Tracer {
        view,
        eye: Eye::new(view),
        laser_from_part: view.part_from_laser.inverse(),
        reflections: &Reflections {
            most: 2,
            from_laser: paths,
            per_pixel: 0.0,
        },
    };
    let sequence = Sequence::new(key);
    let mut power = [0.0; 2];
    for first in (0..paths).step_by(WIDTH) {
        for path in tracer
            .walked(first..(first + WIDTH as u32).min(paths), &sequence)
            .0
        {
            for (power, vertex) in power.iter_mut().zip(&path) {
                *power += vertex.carried / paths as f64;
            }
        }
    }
    power
}

/// Squares of pixels that share paths from the camera, or pixels that have several.
struct Blocks {
    columns: u32,
    rows: u32,
    /// Pixels.
    side: u32,
    per_block: u32,
}

impl Blocks {
    fn new(view: &View, per_pixel: f64) -> Blocks {
        let resolution = view.camera.sensor.resolution;
        let (side, per_block) = match per_pixel {
            none if none <= 0.0 => (1, 0),
            few if few < 1.0 => ((1.0 / few.sqrt()).round().max(1.0) as u32, 1),
            more => (1, more.round() as u32),
        };
        Blocks {
            columns: resolution.x,
            rows: resolution.y,
            side,
            per_block,
        }
    }

    fn columns(&self) -> u32 {
        self.columns.div_ceil(self.side)
    }

    fn rows(&self) -> u32 {
        self.rows.div_ceil(self.side)
    }

    fn per_pixel(&self) -> f64 {
        self.per_block as f64 / (self.side * self.side) as f64
    }
}

/// A view, as paths meet it.
struct Tracer<'a> {
    view: &'a View<'a>,
    eye: Eye<'a>,
    laser_from_part: Rigid,
    reflections: &'a Reflections,
}

/// Two points that light may go between.
struct Between {
    ray: Ray,
    pixel: u32,
    irradiance: f64,
    /// Of the whole path, mm.
    length: f64,
}

impl Tracer<'_> {
    fn pixel(&self, place: DVec2) -> u32 {
        place.y as u32 * self.view.camera.sensor.resolution.x + place.x as u32
    }

    /// From the laser over these points to the pupil, mm.
    fn length(&self, light: &[Vertex], camera: &[Vertex]) -> f64 {
        let ends = [
            self.view.part_from_laser.translation,
            self.view.part_from_camera.translation,
        ];
        let points = light
            .iter()
            .chain(camera.iter().rev())
            .map(|vertex| vertex.point);
        let (way, last) = points.fold((0.0, ends[0]), |(way, last), point| {
            (way + last.distance(point), point)
        });
        way + last.distance(ends[1])
    }

    /// Adds those between whose ends nothing is.
    fn splat(&self, between: &mut Vec<Between>, splats: &mut Vec<Splat>) {
        for some in between.chunks(WIDTH) {
            let mut rays = [some[0].ray; WIDTH];
            for (ray, between) in rays.iter_mut().zip(some) {
                *ray = between.ray;
            }
            let blocked = self.view.accel.occluded(&rays[..some.len()]);
            for (i, between) in some.iter().enumerate() {
                if blocked >> i & 1 == 0 {
                    splats.push(Splat {
                        pixel: between.pixel,
                        irradiance: between.irradiance as f32,
                        length: between.length as f32,
                    });
                }
            }
        }
        between.clear();
    }

    /// Followed from the laser to its first points.
    fn start(&self, paths: &mut [Vec<Vertex>], numbers: &[Numbers]) {
        let view = self.view;
        let to_part = &view.part_from_laser;
        let center = self.laser_from_part.point(view.accel.bounds().center());
        // Of a part behind the laser there is none.
        let middle = view.laser.distance(center).max(1.0);
        let mut far = [middle; WIDTH];
        let mut hits = [None; WIDTH];
        // Streams bend by little: aimed at where the first chord met the part, a second one is where light goes.
        for _ in 0..2 {
            let mut rays = [Ray::between(DVec3::ZERO, DVec3::Z).expect("a length"); WIDTH];
            for (i, numbers) in numbers.iter().enumerate() {
                let stream = view.laser.stream(numbers.start());
                let [aperture, aim] = [0.0, far[i]].map(|far| to_part.point(stream.at(far)));
                if let Some(ray) = Ray::between(aperture, aim) {
                    rays[i] = Ray {
                        t_max: f64::INFINITY,
                        ..ray
                    };
                }
            }
            hits = view.accel.closest(&rays[..numbers.len()], |_, _| true);
            for (far, hit) in far.iter_mut().zip(&hits) {
                if let Some(hit) = hit {
                    *far = view.laser.distance(self.laser_from_part.point(hit.point));
                }
            }
        }
        for (path, hit) in paths.iter_mut().zip(&hits) {
            path.clear();
            if let Some(hit) = hit {
                path.extend(
                    self.lit(hit.point, hit.normal, hit.face.triangle)
                        .map(|(_, vertex)| vertex),
                );
            }
        }
    }

    /// A point as the laser lights it: what it receives there (mW/mm²), and the path from the laser to it.
    fn lit(&self, point: DVec3, normal: DVec3, triangle: u32) -> Option<(f64, Vertex)> {
        let laser = self.view.laser;
        let seen = self.laser_from_part.point(point);
        let section = laser.section(seen)?;
        let flux = self.view.part_from_laser.vector(section.flux);
        let share = gaussian(laser.off_middle(seen).length_squared(), section.radius);
        let received = -flux.dot(normal) * share;
        let vertex = Vertex {
            point,
            normal,
            triangle,
            from: -flux.normalize_or_zero(),
            carried: laser.beam.power_mw,
            forward: received / laser.beam.power_mw,
            backward: 0.0,
            mirrored: false,
        };
        (received > 0.0).then_some((received, vertex))
    }

    /// Paths from the laser, and their numbers.
    fn walked<'b>(
        &self,
        indices: Range<u32>,
        sequence: &'b Sequence,
    ) -> (Vec<Vec<Vertex>>, Vec<Numbers<'b>>) {
        let numbers: Vec<Numbers> = indices
            .map(|index| Numbers {
                sequence,
                index,
                first: 0,
            })
            .collect();
        let mut paths = vec![Vec::new(); numbers.len()];
        self.start(&mut paths, &numbers);
        walk(
            self.view,
            &mut paths,
            &numbers,
            self.reflections.most as usize,
        );
        (paths, numbers)
    }

    fn laser_paths(&self, indices: Range<u32>, sequence: &Sequence, splats: &mut Vec<Splat>) {
        let (paths, numbers) = self.walked(indices, sequence);
        let mut between = Vec::new();
        for (path, numbers) in paths.iter().zip(&numbers) {
            for count in 2..=path.len() {
                let pupil = self.eye.pupil_point(numbers.pupil(count - 1));
                between.extend(self.to_pupil(&path[..count], &pupil));
            }
        }
        self.splat(&mut between, splats);
    }

    /// The last of a path's points, joined to the pupil.
    fn to_pupil(&self, path: &[Vertex], pupil: &PupilPoint) -> Option<Between> {
        let (last, before) = (path.last()?, &path[path.len() - 2]);
        let ray = Ray::between(last.start(self.view), pupil.origin)?;
        let eye = towards(last.point, pupil.point);
        if ray.direction.dot(last.normal) <= 0.0 {
            return None;
        }
        let looked = self.eye.image(last.point, pupil)?;
        let scatter = last.scatter(self.view);
        let bsdf = scatter.bsdf(eye);
        let angle = last.angle_per_area(pupil.origin);
        let paths = self.reflections.from_laser as f64;
        let mut irradiance = last.carried / paths * bsdf * angle * looked.gain / looked.solid_angle;
        if self.reflections.per_pixel > 0.0 && irradiance > 0.0 {
            let camera = Blocks::new(self.view, self.reflections.per_pixel).per_pixel();
            let ends = [
                camera * angle / looked.solid_angle,
                scatter.density_back(eye) * before.angle_per_area(last.point),
            ];
            irradiance *= Path::new(path, &[], paths, [ends, [0.0; 2]]).weight(path.len());
        }
        (irradiance > 0.0 && irradiance.is_finite()).then(|| Between {
            ray,
            pixel: self.pixel(looked.place),
            irradiance,
            length: self.length(path, &[]),
        })
    }

    /// One path in each of a row of blocks.
    fn camera_paths(
        &self,
        blocks: &Blocks,
        task: u32,
        columns: Range<u32>,
        sequence: &Sequence,
        splats: &mut Vec<Splat>,
    ) {
        let (row, sample) = (task / blocks.per_block, task % blocks.per_block);
        let resolution = self.view.camera.sensor.resolution.as_dvec2();
        // Each block has samples of its own that lie evenly in it.
        let index = |column: u32| column * blocks.per_block + sample;
        let light_first = 256;
        let of = |first: u32| -> Vec<Numbers> {
            let numbers = columns.clone().map(|column| Numbers {
                sequence,
                index: index(column),
                first,
            });
            numbers.collect()
        };
        let numbers = of(0);
        let per_pixel = blocks.per_pixel();
        let mut rays = Vec::with_capacity(WIDTH);
        let mut looks = Vec::with_capacity(WIDTH);
        for (column, numbers) in columns.clone().zip(&numbers) {
            let corner = DVec2::new(column as f64, row as f64);
            let place = (corner + numbers.start()) * blocks.side as f64;
            let pupil = self
                .eye
                .pupil_point(numbers.sequence.pair(numbers.index, 255));
            looks.push((place.cmplt(resolution).all()).then(|| self.eye.looked(place, &pupil)));
            rays.push(Ray {
                origin: pupil.origin,
                direction: self.eye.direction(place, &pupil),
                t_max: f64::INFINITY,
            });
        }
        let hits = self.view.accel.closest(&rays, |_, _| true);
        let mut paths = vec![Vec::new(); rays.len()];
        for (i, path) in paths.iter_mut().enumerate() {
            let (Some(hit), Some(looked)) = (&hits[i], &looks[i]) else {
                continue;
            };
            let pupil = self
                .eye
                .pupil_point(numbers[i].sequence.pair(numbers[i].index, 255));
            let mut vertex = Vertex {
                point: hit.point,
                normal: hit.normal,
                triangle: hit.face.triangle,
                from: towards(hit.point, pupil.point),
                carried: looked.gain / per_pixel,
                forward: 0.0,
                backward: 0.0,
                mirrored: false,
            };
            vertex.forward = per_pixel * vertex.angle_per_area(pupil.origin) / looked.solid_angle;
            path.push(vertex);
        }
        let most = self.reflections.most as usize;
        walk(self.view, &mut paths, &numbers, most);
        let light_numbers = of(light_first);
        let mut light = vec![Vec::new(); rays.len()];
        self.start(&mut light, &light_numbers);
        walk(self.view, &mut light, &light_numbers, most - 1);
        let mut between = Vec::new();
        for ((camera, light), looked) in paths.iter().zip(&light).zip(&looks) {
            let Some(looked) = looked else { continue };
            let pixel = self.pixel(looked.place);
            for count in 1..=camera.len() {
                let camera = &camera[..count];
                between.extend(self.to_laser(camera, pixel));
                for count in 1..=light.len().min(most - count) {
                    between.extend(self.joined(&light[..count], camera, pixel));
                }
            }
        }
        self.splat(&mut between, splats);
    }

    /// The last of a camera path's points, where the laser lights it.
    fn to_laser(&self, camera: &[Vertex], pixel: u32) -> Option<Between> {
        let (last, before) = (camera.last()?, camera.get(camera.len().wrapping_sub(2))?);
        let view = self.view;
        let (received, lit) = self.lit(last.point, last.normal, last.triangle)?;
        let seen = self.laser_from_part.point(last.point);
        let aperture = view.laser.section(seen)?.aperture_point;
        let ray = Ray::between(last.start(view), view.part_from_laser.point(aperture))?;
        if ray.direction.dot(last.normal) <= 0.0 {
            return None;
        }
        let scatter = lit.scatter(view);
        let irradiance = last.carried * scatter.bsdf(last.from) * received;
        if irradiance <= 0.0 || !irradiance.is_finite() {
            return None;
        }
        let ends = [
            lit.forward,
            scatter.density(last.from) * before.angle_per_area(last.point),
        ];
        let path = Path::new(
            &[],
            camera,
            self.reflections.from_laser as f64,
            [[0.0; 2], ends],
        );
        Some(Between {
            ray,
            pixel,
            irradiance: irradiance * path.weight(0),
            length: self.length(&[], camera),
        })
    }

    /// A path from the laser joined to one from the camera.
    fn joined(&self, light: &[Vertex], camera: &[Vertex], pixel: u32) -> Option<Between> {
        let view = self.view;
        let (l, c) = (light.last()?, camera.last()?);
        let ray = Ray::between(l.start(view), c.start(view))?;
        let way = towards(l.point, c.point);
        if way.dot(l.normal) <= 0.0 || way.dot(c.normal) >= 0.0 {
            return None;
        }
        let [of_light, of_camera] = [l, c].map(|vertex| vertex.scatter(view));
        let bsdf = of_light.bsdf(way) * of_camera.bsdf(-way);
        let irradiance =
            l.carried * c.carried * bsdf * way.dot(l.normal) * c.angle_per_area(l.point);
        if irradiance <= 0.0 || !irradiance.is_finite() {
            return None;
        }
        let before = |path: &[Vertex], back: f64| {
            let index = path.len().checked_sub(2);
            index.map_or(0.0, |i| back * path[i].angle_per_area(path[i + 1].point))
        };
        let ends = [
            [
                of_camera.density(-way) * l.angle_per_area(c.point),
                before(light, of_light.density_back(way)),
            ],
            [
                of_light.density(way) * c.angle_per_area(l.point),
                before(camera, of_camera.density_back(-way)),
            ],
        ];
        let path = Path::new(light, camera, self.reflections.from_laser as f64, ends);
        Some(Between {
            ray,
            pixel,
            irradiance: irradiance * path.weight(light.len()),
            length: self.length(light, camera),
        })
    }
}

#[cfg(test)]
#[path = "ghosts_tests.rs"]
mod tests;
