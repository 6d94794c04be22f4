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
use glam::UVec2;
use rayon::prelude::*;
use smallvec::SmallVec;
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
    pub fn times(self, times: f64) -> Reflections {
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
    /// Number by which its path from the laser started; 0 of those from the camera.
    start: f64,
}

/// The light that is reflected at least twice, as the lens spreads it. The same bytes for any number of
/// threads.
pub fn ghosts(view: &View, region: &Region, indirect: &Indirect) -> Ghosts {
    let &Indirect {
        ref reflections,
        key,
        coherence_length,
    } = indirect;
    let resolution = view.camera.sensor.resolution;
    let mut tracer = Tracer {
        view,
        eye: Eye::new(view),
        laser_from_part: view.part_from_laser.inverse(),
        reflections,
        blocks: Blocks::none(resolution),
        starts: Starts::new([0.0; STARTS]),
    };
    tracer.learn(key.with(2));
    let mut image = vec![0.0; resolution.element_product() as usize];
    let mixed = view.speckle.is_some() && coherence_length < f64::INFINITY;
    let mut pairs = vec![Pairs::default(); if mixed { image.len() } else { 0 }];
    let add = &mut |splat: Splat| {
        let pixel = splat.pixel as usize;
        image[pixel] += splat.irradiance as f64;
        if mixed {
            pairs[pixel].add(splat.irradiance, splat.length, coherence_length as f32);
        }
    };
    let sequence = Sequence::new(key.with(0));
    in_tasks(reflections.from_laser, add, |paths, splats| {
        tracer.laser_paths(paths, &sequence, splats)
    });
    tracer.follow_from_camera(key.with(1), add);
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

/// Follows paths a packet at a time on all cores; hands on their light in the order of tasks.
fn in_tasks(
    paths: u32,
    add: &mut dyn FnMut(Splat),
    follow: impl Fn(Range<u32>, &mut Vec<Splat>) + Sync,
) {
    let of_task = |task: u32| {
        let mut splats = Vec::new();
        let end = (TASK * (task + 1)).min(paths);
        for first in (TASK * task..end).step_by(WIDTH) {
            follow(first..(first + WIDTH as u32).min(end), &mut splats);
        }
        splats
    };
    let tasks = paths.div_ceil(TASK);
    for first in (0..tasks).step_by(TASKS as usize) {
        let some = (first..(first + TASKS).min(tasks)).into_par_iter();
        let splats: Vec<Vec<Splat>> = some.map(of_task).collect();
        splats.into_iter().flatten().for_each(&mut *add);
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
        blocks: Blocks::none(view.camera.sensor.resolution),
        starts: Starts::new([0.0; STARTS]),
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

/// Side of the squares of pixels that share paths from the camera.
const SIDE: u32 = 8;
/// Share of the paths from the camera by which it is learnt where they are needed, and of those that lie evenly
/// afterwards.
const EVEN: f64 = 0.125;

/// Paths from the camera, so many in each square of pixels.
struct Blocks {
    resolution: UVec2,
    /// Number of those before each square, and of all.
    first: Vec<u32>,
}

impl Blocks {
    fn none(resolution: UVec2) -> Blocks {
        Blocks::new(resolution, |_| 0.0)
    }

    fn new(resolution: UVec2, paths: impl Fn(usize) -> f64) -> Blocks {
        let count = resolution.x.div_ceil(SIDE) * resolution.y.div_ceil(SIDE);
        let mut first = vec![0];
        for block in 0..count as usize {
            first.push(first[block] + paths(block).ceil() as u32);
        }
        Blocks { resolution, first }
    }

    fn count(&self) -> usize {
        self.first.len() - 1
    }

    fn across(&self) -> usize {
        self.resolution.x.div_ceil(SIDE) as usize
    }

    /// In all squares.
    fn paths(&self) -> u32 {
        self.first[self.count()]
    }

    /// The square of a path, and the path's number in it.
    fn of_path(&self, path: u32) -> (usize, u32) {
        let block = self.first.partition_point(|&first| first <= path) - 1;
        (block, path - self.first[block])
    }

    fn of_pixel(&self, pixel: u32) -> usize {
        let [column, row] = [pixel % self.resolution.x, pixel / self.resolution.x];
        (row / SIDE) as usize * self.across() + (column / SIDE) as usize
    }

    /// First pixel of a square, and its size.
    fn place(&self, block: usize) -> [DVec2; 2] {
        let first = SIDE
            * UVec2::new(
                (block % self.across()) as u32,
                (block / self.across()) as u32,
            );
        let size = (self.resolution - first).min(UVec2::splat(SIDE));
        [first, size].map(|pixels| pixels.as_dvec2())
    }

    fn per_pixel(&self, block: usize) -> f64 {
        let paths = self.first[block + 1] - self.first[block];
        paths as f64 / self.place(block)[1].element_product()
    }

    /// Sums over a square and its neighbours.
    fn around(&self, values: &[DVec2], block: usize) -> DVec2 {
        let (across, down) = (self.across(), self.count() / self.across());
        let near = |i: usize, end: usize| i.saturating_sub(1)..(i + 2).min(end);
        let rows = near(block / across, down);
        rows.flat_map(|row| &values[row * across..][near(block % across, across)])
            .sum()
    }
}

/// Parts of the fan that are told apart.
const STARTS: usize = 64;
/// Share of the paths from the laser that starts evenly.
const EVEN_STARTS: f64 = 0.25;

/// Where along the fan paths from the laser start.
struct Starts {
    /// Share of the paths before each part, and of all.
    first: [f64; STARTS + 1],
}

impl Starts {
    /// In proportion to `needs`, but for those that start evenly.
    fn new(needs: [f64; STARTS]) -> Starts {
        let all: f64 = needs.iter().sum();
        let mut first = [0.0; STARTS + 1];
        for (part, need) in needs.iter().enumerate() {
            let even = 1.0 / STARTS as f64;
            let share = if all > 0.0 { need / all } else { even };
            first[part + 1] = first[part] + EVEN_STARTS * even + (1.0 - EVEN_STARTS) * share;
        }
        Starts { first }
    }

    /// A number of 0 to 1, drawn evenly, as one drawn so; and its density.
    fn drawn(&self, u: f64) -> (f64, f64) {
        let part = self.first[1..STARTS].partition_point(|&first| first <= u);
        let share = self.first[part + 1] - self.first[part];
        let within = ((u - self.first[part]) / share).clamp(0.0, 1.0 - f64::EPSILON);
        (
            (part as f64 + within) / STARTS as f64,
            share * STARTS as f64,
        )
    }
}

/// A view, as paths meet it.
struct Tracer<'a> {
    view: &'a View<'a>,
    eye: Eye<'a>,
    laser_from_part: Rigid,
    reflections: &'a Reflections,
    blocks: Blocks,
    starts: Starts,
}

/// Two points that light may go between.
struct Between {
    ray: Ray,
    pixel: u32,
    irradiance: f64,
    /// Of the whole path, mm.
    length: f64,
    start: f64,
}

impl Tracer<'_> {
    /// Learns from a share of the paths where others are needed, so that their noise over the sensor's own becomes about the
    /// same everywhere: how many from the camera in each square of pixels, and where along the fan those from the laser
    /// start. These give no light to the image, which would depend on what they met.
    fn learn(&mut self, key: Key) {
        let sensor = &self.view.camera.sensor;
        let count = self.reflections.per_pixel * sensor.resolution.as_dvec2().element_product();
        let even = EVEN * count / self.blocks.count() as f64;
        self.blocks = Blocks::new(sensor.resolution, |_| even);
        let (mut from_laser, mut from_camera) = (Vec::new(), Vec::new());
        let sequence = Sequence::new(key.with(0));
        let few = (EVEN * self.reflections.from_laser as f64) as u32;
        in_tasks(few, &mut |splat| from_laser.push(splat), |paths, splats| {
            self.laser_paths(paths, &sequence, splats)
        });
        self.follow_from_camera(key.with(1), &mut |splat| from_camera.push(splat));
        // Light, and the squares of what paths from the camera carry.
        let mut found = vec![DVec2::ZERO; self.blocks.count()];
        for (splats, times, of_camera) in
            [(&from_laser, EVEN.recip(), 0.0), (&from_camera, 1.0, 1.0)]
        {
            for splat in splats {
                let irradiance = splat.irradiance as f64;
                found[self.blocks.of_pixel(splat.pixel)] +=
                    DVec2::new(times * irradiance, of_camera * irradiance.powi(2));
            }
        }
        let electrons = sensor.electrons_per_irradiance(self.view.laser.beam.wavelength);
        let dark = sensor.dark_variance_e() / electrons * f64::from(9 * SIDE * SIDE);
        let around = |block| self.blocks.around(&found, block) + DVec2::X * dark;
        let around: Vec<DVec2> = (0..found.len()).map(around).collect();
        let mut needs = [0.0; STARTS];
        for splat in &from_laser {
            let noise = around[self.blocks.of_pixel(splat.pixel)].x;
            needs[(splat.start * STARTS as f64) as usize] +=
                f64::from(splat.irradiance).powi(2) / noise;
        }
        self.starts = Starts::new(needs.map(f64::sqrt));
        let need = |sums: &DVec2| if sums.y > 0.0 { sums.y / sums.x } else { 0.0 };
        let all = around.iter().map(need).sum::<f64>().max(f64::MIN_POSITIVE);
        let each = (1.0 - 2.0 * EVEN) * count / all;
        self.blocks = Blocks::new(sensor.resolution, |block| {
            even + each * need(&around[block])
        });
    }

    fn follow_from_camera(&self, key: Key, add: &mut dyn FnMut(Splat)) {
        in_tasks(self.blocks.paths(), add, |paths, splats| {
            self.camera_paths(paths, key, splats)
        });
    }

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
                        start: between.start,
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
        let drawn = |numbers: &Numbers| {
            let u = numbers.start();
            let (along, density) = self.starts.drawn(u.x);
            (view.laser.stream(DVec2::new(along, u.y)), density)
        };
        let streams: SmallVec<[_; WIDTH]> = numbers.iter().map(drawn).collect();
        // Streams bend by little: aimed at where the first chord met the part, a second one is where light goes.
        for _ in 0..2 {
            let mut rays = [Ray::between(DVec3::ZERO, DVec3::Z).expect("a length"); WIDTH];
            for (i, (stream, _)) in streams.iter().enumerate() {
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
        for ((path, hit), (_, density)) in paths.iter_mut().zip(&hits).zip(&streams) {
            path.clear();
            let lit = hit
                .as_ref()
                .and_then(|hit| self.lit(hit.point, hit.normal, hit.face.triangle));
            // What ways of finding a path count goes by even starts.
            path.extend(lit.map(|(_, vertex)| Vertex {
                carried: vertex.carried / density,
                ..vertex
            }));
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
        self.view.unwind_if_stopped();
        let (paths, numbers) = self.walked(indices, sequence);
        let mut between = Vec::new();
        for (path, numbers) in paths.iter().zip(&numbers) {
            for count in 2..=path.len() {
                let pupil = self.eye.pupil_point(numbers.pupil(count - 1));
                let joined = self.to_pupil(&path[..count], &pupil);
                between.extend(joined.map(|between| Between {
                    start: numbers.start().x,
                    ..between
                }));
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
            let block = self.blocks.of_pixel(self.pixel(looked.place));
            let camera = self.blocks.per_pixel(block);
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
            start: 0.0,
        })
    }

    /// Up to a packet of paths from the camera, by their numbers.
    fn camera_paths(&self, paths: Range<u32>, key: Key, splats: &mut Vec<Splat>) {
        self.view.unwind_if_stopped();
        let blocks: Vec<(usize, u32)> = paths.map(|path| self.blocks.of_path(path)).collect();
        // The paths of a square lie evenly in it.
        let sequence = |&(block, _): &(usize, u32)| Sequence::new(key.with(block as u64));
        let sequences: Vec<Sequence> = blocks.iter().map(sequence).collect();
        let of = |first: u32| -> Vec<Numbers> {
            let pairs = sequences.iter().zip(&blocks);
            let numbers = pairs.map(|(sequence, &(_, index))| Numbers {
                sequence,
                index,
                first,
            });
            numbers.collect()
        };
        let numbers = of(0);
        let mut rays = Vec::with_capacity(WIDTH);
        let mut looks = Vec::with_capacity(WIDTH);
        for (&(block, _), numbers) in blocks.iter().zip(&numbers) {
            let [first, size] = self.blocks.place(block);
            let place = first + numbers.start() * size;
            let pupil = self
                .eye
                .pupil_point(numbers.sequence.pair(numbers.index, 255));
            looks.push(self.eye.looked(place, &pupil));
            rays.push(Ray {
                origin: pupil.origin,
                direction: self.eye.direction(place, &pupil),
                t_max: f64::INFINITY,
            });
        }
        let hits = self.view.accel.closest(&rays, |_, _| true);
        let mut paths = vec![Vec::new(); rays.len()];
        for (i, path) in paths.iter_mut().enumerate() {
            let (Some(hit), looked) = (&hits[i], &looks[i]) else {
                continue;
            };
            let per_pixel = self.blocks.per_pixel(blocks[i].0);
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
        let light_numbers = of(256);
        let mut light = vec![Vec::new(); rays.len()];
        self.start(&mut light, &light_numbers);
        walk(self.view, &mut light, &light_numbers, most - 1);
        let mut between = Vec::new();
        for ((camera, light), looked) in paths.iter().zip(&light).zip(&looks) {
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
            start: 0.0,
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
            start: 0.0,
        })
    }
}

#[cfg(test)]
#[path = "ghosts_tests.rs"]
mod tests;
