//! Indirect light by bidirectional path tracing: light paths connected to the pupil, camera paths
//! connected to the laser, and connections of both.
//!
//! The laser illuminates each point from one direction. Its light is therefore either evaluated at
//! a surface point or sampled from the aperture. Paths are stratified by a scrambled Sobol
//! sequence, so the reflection of the line in a mirror is a smooth line. Mirrors are sampled by
//! specular reflection only, never by connection.

use super::PoseView;
use super::defocus::{Blur, DefocusSettings};
use super::direct_light::DirectIrradiance;
use super::footprint::TracedRegion;
use super::irradiance::Irradiance;
use super::laser_emitter::{FanImportance, LaserEmitter};
use super::line_image::{LineImager, LinePixels};
use super::line_source::LineSource;
use super::mis::{FullPath, towards};
use super::pixel_integration::expose;
use super::pixel_mask::{PixelMask, PixelNumbering};
use super::random_walk::{PathSampler, PathVertex, random_walk};
use super::thin_lens::{PupilPoint, ThinLens};
use crate::accel::{Ray, WIDTH};
use crate::math::rng::RngKey;
use crate::math::{DVec2, Sequence};
use glam::UVec2;
use rayon::prelude::*;
use smallvec::SmallVec;
use std::f32::consts::{LN_2, PI};
use std::ops::Range;

/// Parameters of indirect light.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Reflections {
    /// Maximum number of bounces of a path, at least 2.
    pub most: u32,
    /// Number of light paths.
    pub from_laser: u32,
    /// Camera paths per pixel, 0 for none.
    pub per_pixel: f64,
    /// Whether light is integrated over the lit curve where this is accurate. Paths then contribute
    /// the rest.
    pub line: bool,
}

impl Reflections {
    /// Returns the parameters with the number of paths multiplied by `times`.
    pub fn scaled(self, times: f64) -> Reflections {
        Reflections {
            from_laser: (times * self.from_laser as f64) as u32,
            per_pixel: times * self.per_pixel,
            ..self
        }
    }
}

/// Indirect light of a frame.
#[derive(Debug, Clone, Copy)]
pub struct IndirectSettings {
    /// Number of bounces and paths.
    pub reflections: Reflections,
    /// Random key of the frame.
    pub key: RngKey,
    /// Coherence length λ²/Δλ of the laser, mm; infinite if path differences are always smaller.
    pub coherence_length: f64,
}

impl IndirectSettings {
    /// Returns true if direct and indirect light have a common speckle pattern, because their
    /// fields add coherently.
    pub(super) fn is_one_field(&self, view: &PoseView) -> bool {
        view.speckle.as_ref().is_none_or(|speckle| {
            let anywhere = view.lens.blur != Blur::Coherent && !speckle.patterns.read_surface();
            anywhere && self.coherence_length == f64::INFINITY
        })
    }
}

/// Indirect light on the sensor.
pub struct IndirectLight {
    /// Mean of each pixel without speckle.
    pub mean: Irradiance,
    /// Speckle contrast of each pixel; empty if it is 1.
    contrast: Vec<f32>,
    /// Number of pairs of a node of the lit curve and a receiver.
    pub line_pairs: u64,
}

impl IndirectLight {
    /// Returns the irradiance with an independent speckle pattern.
    pub(super) fn pixel_irradiance(&self, view: &PoseView) -> Irradiance {
        let view = PoseView {
            lens: DefocusSettings::NONE,
            speckle: view
                .speckle
                .as_ref()
                .map(|speckle| speckle.independent_copy(view)),
            ..view.clone()
        };
        let mut exposed = expose(DirectIrradiance::even(&self.mean, view.grid), &view);
        if view.speckle.is_some() && !self.contrast.is_empty() {
            let pairs = exposed.values_mut().iter_mut().zip(self.mean.values());
            for ((value, mean), contrast) in pairs.zip(&self.contrast) {
                *value = mean + contrast * (*value - mean);
            }
        }
        exposed
    }
}

/// Statistics over consecutive pairs of paths that reach a pixel.
#[derive(Clone, Copy, Default)]
struct CoherenceEstimator {
    last: f32,
    length: f32,
    /// Sum of the products of their irradiances.
    sum: f32,
    /// Sum of the products times |γ|² of their path difference.
    coherent: f32,
}

impl CoherenceEstimator {
    /// Returns |γ|² of light with a Gaussian spectrum of full width Δλ at half maximum. `d` is the
    /// path difference in coherence lengths (Goodman 1985, Statistical Optics, 5.1).
    fn coherence(d: f32) -> f32 {
        (-(PI * d).powi(2) / (2.0 * LN_2)).exp()
    }

    fn add(&mut self, irradiance: f32, length: f32, coherence_length: f32) {
        let product = self.last * irradiance;
        self.sum += product;
        self.coherent +=
            product * CoherenceEstimator::coherence((length - self.length) / coherence_length);
        (self.last, self.length) = (irradiance, length);
    }

    /// Returns the contrast C, with C² = Σ I_a·I_b·|γ_ab|²/(ΣI)². It is 1 for a single path.
    fn contrast(&self) -> f32 {
        match self.sum > 0.0 {
            true => (self.coherent / self.sum).sqrt(),
            false => 1.0,
        }
    }
}

/// Paths per task, independent of the number of threads.
const TASK: u32 = 4096;
/// Number of tasks whose light is buffered before it is added.
const TASKS: u32 = 64;

/// Contribution of a path to a pixel.
struct Splat {
    /// Pixel number, row by row.
    pixel: u32,
    /// Irradiance, mW/mm².
    irradiance: f32,
    /// Path length from the laser to the pupil, mm.
    length: f32,
    /// Start position of a light path along the fan, as a uniform random number; 0 for camera
    /// paths.
    start: f64,
}

/// Computes the light with at least two bounces, including the lens blur. The result is
/// byte-identical for any number of threads.
pub fn indirect_irradiance(
    view: &PoseView,
    region: &TracedRegion,
    indirect: &IndirectSettings,
) -> IndirectLight {
    let &IndirectSettings {
        ref reflections,
        key,
        coherence_length,
    } = indirect;
    let resolution = view.camera.sensor.resolution;
    let line = match reflections.line {
        true => LineSource::new(view, key.with(3)),
        false => None,
    };
    let mut tracer = BidirectionalTracer {
        view,
        eye: ThinLens::new(view),
        emitter: LaserEmitter::new(view),
        line: line.as_ref(),
        reflections,
        blocks: CameraPathAllocation::none(resolution),
    };
    tracer.allocate_from_pilot(key.with(2));
    let mut image = vec![0.0; resolution.element_product() as usize];
    let mixed = view.speckle.is_some() && coherence_length < f64::INFINITY;
    let mut pairs = vec![CoherenceEstimator::default(); if mixed { image.len() } else { 0 }];
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
    let mut line_pairs = 0;
    if let Some(line) = &line {
        let imager = LineImager::new((view, &tracer.eye), line, reflections.most, key.with(4));
        let pixels = imager.image(region, mixed);
        line_pairs = pixels.pairs;
        add_line(&pixels, add);
    }
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
    IndirectLight {
        mean: Irradiance::new(PixelNumbering::new(pixels), values),
        contrast,
        line_pairs,
    }
}

/// Traces paths in packets on all cores, and passes on their light in the order of tasks.
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

/// Passes on the light of each pixel, divided among its path lengths if these are known.
fn add_line(line: &LinePixels, add: &mut dyn FnMut(Splat)) {
    for (pixel, &irradiance) in line.irradiance.iter().enumerate() {
        if irradiance <= 0.0 {
            continue;
        }
        let splat = |irradiance: f32, length: f32| Splat {
            pixel: pixel as u32,
            irradiance,
            length,
            start: 0.0,
        };
        let lengths = line.lengths.get(pixel).into_iter().flatten();
        let visible = lengths.filter(|length| length.is_finite());
        match visible.clone().count() {
            0 => add(splat(irradiance, 0.0)),
            count => visible.for_each(|&length| add(splat(irradiance / count as f32, length))),
        }
    }
}

/// Returns the pixels of a region that have light in an image.
fn lit_pixels(image: &[f64], resolution: glam::UVec2, region: &TracedRegion) -> PixelMask {
    let mut pixels = PixelMask::none(resolution);
    let columns = resolution.x as usize;
    for (row, values) in image.chunks(columns).enumerate() {
        for column in (0..columns).filter(|&column| values[column] > 0.0) {
            pixels.insert(row, column, column);
        }
    }
    if let TracedRegion::Columns(_, columns) = region {
        pixels.keep_columns(columns);
    }
    pixels
}

/// Estimates the power incident on the part, and the power of the second hit, mW, from `paths`
/// light paths.
pub fn second_hit_power(view: &PoseView, paths: u32, key: RngKey) -> [f64; 2] {
    let tracer = BidirectionalTracer {
        view,
        eye: ThinLens::new(view),
        emitter: LaserEmitter::new(view),
        reflections: &Reflections {
            most: 2,
            from_laser: paths,
            per_pixel: 0.0,
            line: false,
        },
        line: None,
        blocks: CameraPathAllocation::none(view.camera.sensor.resolution),
    };
    let sequence = Sequence::new(key);
    let mut power = [0.0; 2];
    for first in (0..paths).step_by(WIDTH) {
        for path in tracer
            .trace_light_paths(first..(first + WIDTH as u32).min(paths), &sequence)
            .0
        {
            for (power, vertex) in power.iter_mut().zip(&path) {
                *power += vertex.beta / paths as f64;
            }
        }
    }
    power
}

/// Side of the pixel blocks for which camera paths are distributed, pixels.
const SIDE: u32 = 8;
/// Fraction of the camera paths in the pilot run, and fraction that is distributed uniformly
/// afterwards.
const UNIFORM_FRACTION_CAMERA: f64 = 0.125;

/// Number of camera paths in each block of pixels.
struct CameraPathAllocation {
    resolution: UVec2,
    /// Number of paths before each block, followed by the total number.
    first: Vec<u32>,
}

impl CameraPathAllocation {
    fn none(resolution: UVec2) -> CameraPathAllocation {
        CameraPathAllocation::new(resolution, |_| 0.0)
    }

    fn new(resolution: UVec2, paths: impl Fn(usize) -> f64) -> CameraPathAllocation {
        let count = resolution.x.div_ceil(SIDE) * resolution.y.div_ceil(SIDE);
        let mut first = vec![0];
        for block in 0..count as usize {
            first.push(first[block] + paths(block).ceil() as u32);
        }
        CameraPathAllocation { resolution, first }
    }

    fn count(&self) -> usize {
        self.first.len() - 1
    }

    fn across(&self) -> usize {
        self.resolution.x.div_ceil(SIDE) as usize
    }

    /// Returns the number of paths in all blocks.
    fn paths(&self) -> u32 {
        self.first[self.count()]
    }

    /// Returns the block of a path, and the index of the path in the block.
    fn of_path(&self, path: u32) -> (usize, u32) {
        let block = self.first.partition_point(|&first| first <= path) - 1;
        (block, path - self.first[block])
    }

    fn of_pixel(&self, pixel: u32) -> usize {
        let [column, row] = [pixel % self.resolution.x, pixel / self.resolution.x];
        (row / SIDE) as usize * self.across() + (column / SIDE) as usize
    }

    /// Returns the first pixel of a block, and its size.
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

    /// Returns the sum over a block and its neighbours.
    fn around(&self, values: &[DVec2], block: usize) -> DVec2 {
        let (across, down) = (self.across(), self.count() / self.across());
        let near = |i: usize, end: usize| i.saturating_sub(1)..(i + 2).min(end);
        let rows = near(block / across, down);
        rows.flat_map(|row| &values[row * across..][near(block % across, across)])
            .sum()
    }
}

/// Number of bins along the fan.
const FAN_BINS: usize = 64;

/// Path tracer of a view.
struct BidirectionalTracer<'a> {
    view: &'a PoseView<'a>,
    eye: ThinLens<'a>,
    emitter: LaserEmitter<'a>,
    /// Lit curve, whose light paths do not contribute.
    line: Option<&'a LineSource<'a>>,
    reflections: &'a Reflections,
    blocks: CameraPathAllocation,
}

/// Connection between two points, subject to a visibility test.
struct Connection {
    ray: Ray,
    pixel: u32,
    irradiance: f64,
    /// Length of the complete path, mm.
    length: f64,
    start: f64,
}

impl BidirectionalTracer<'_> {
    /// Distributes the paths by a pilot run, to equalise path noise relative to sensor noise. The
    /// run determines the number of camera paths in each block of pixels, and the density of light
    /// paths along the fan. Pilot paths do not contribute to the image, because the image would
    /// then depend on their hits.
    fn allocate_from_pilot(&mut self, key: RngKey) {
        let sensor = &self.view.camera.sensor;
        let count = self.reflections.per_pixel * sensor.resolution.as_dvec2().element_product();
        let even = UNIFORM_FRACTION_CAMERA * count / self.blocks.count() as f64;
        self.blocks = CameraPathAllocation::new(sensor.resolution, |_| even);
        let (mut from_laser, mut from_camera) = (Vec::new(), Vec::new());
        let sequence = Sequence::new(key.with(0));
        let few = (UNIFORM_FRACTION_CAMERA * self.reflections.from_laser as f64) as u32;
        in_tasks(few, &mut |splat| from_laser.push(splat), |paths, splats| {
            self.laser_paths(paths, &sequence, splats)
        });
        self.follow_from_camera(key.with(1), &mut |splat| from_camera.push(splat));
        // Irradiance in each block, and squared contributions of camera paths.
        let mut found = vec![DVec2::ZERO; self.blocks.count()];
        for (splats, times, of_camera) in [
            (&from_laser, UNIFORM_FRACTION_CAMERA.recip(), 0.0),
            (&from_camera, 1.0, 1.0),
        ] {
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
        let mut needs = [0.0; FAN_BINS];
        for splat in &from_laser {
            let noise = around[self.blocks.of_pixel(splat.pixel)].x;
            needs[(splat.start * FAN_BINS as f64) as usize] +=
                f64::from(splat.irradiance).powi(2) / noise;
        }
        self.emitter.starts = FanImportance::new(&needs.map(f64::sqrt));
        let need = |sums: &DVec2| if sums.y > 0.0 { sums.y / sums.x } else { 0.0 };
        let all = around.iter().map(need).sum::<f64>().max(f64::MIN_POSITIVE);
        let each = (1.0 - 2.0 * UNIFORM_FRACTION_CAMERA) * count / all;
        self.blocks = CameraPathAllocation::new(sensor.resolution, |block| {
            even + each * need(&around[block])
        });
    }

    fn follow_from_camera(&self, key: RngKey, add: &mut dyn FnMut(Splat)) {
        in_tasks(self.blocks.paths(), add, |paths, splats| {
            self.camera_paths(paths, key, splats)
        });
    }

    /// Returns the weight of paths with these first two points and number of bounces, see
    /// [`LineSource::weight`]. The lit curve has the rest.
    fn path_weight(&self, first: &PathVertex, second: &PathVertex, bounces: usize) -> f64 {
        1.0 - (self.line).map_or(0.0, |line| line.weight(first, second, bounces))
    }

    fn pixel(&self, place: DVec2) -> u32 {
        place.y as u32 * self.view.camera.sensor.resolution.x + place.x as u32
    }

    /// Returns the length from the laser over these vertices to the pupil, mm.
    fn length(&self, light: &[PathVertex], camera: &[PathVertex]) -> f64 {
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

    /// Adds the contributions of all unoccluded connections.
    fn add_visible_connections(&self, between: &mut Vec<Connection>, splats: &mut Vec<Splat>) {
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

    /// Traces light paths to their first vertices.
    fn start(&self, paths: &mut [Vec<PathVertex>], numbers: &[PathSampler]) {
        let starts: SmallVec<[DVec2; WIDTH]> = numbers.iter().map(PathSampler::start).collect();
        for (path, vertex) in paths.iter_mut().zip(self.emitter.first_vertices(&starts)) {
            path.clear();
            path.extend(vertex);
        }
    }

    /// Returns light paths and their random numbers.
    fn trace_light_paths<'b>(
        &self,
        indices: Range<u32>,
        sequence: &'b Sequence,
    ) -> (Vec<Vec<PathVertex>>, Vec<PathSampler<'b>>) {
        let numbers: Vec<PathSampler> = indices
            .map(|index| PathSampler {
                sequence,
                index,
                first: 0,
            })
            .collect();
        let mut paths = vec![Vec::new(); numbers.len()];
        self.start(&mut paths, &numbers);
        let most = self.reflections.most as usize;
        random_walk(self.view, &mut paths, &numbers, 1..most.min(2));
        for path in &mut paths {
            // The lit curve has all light of such a path. Paths with two bounces have the least
            // weight.
            if path.len() == 2 && self.path_weight(&path[0], &path[1], 3) <= 0.0 {
                path.truncate(1);
            }
        }
        random_walk(self.view, &mut paths, &numbers, 2..most);
        (paths, numbers)
    }

    fn laser_paths(&self, indices: Range<u32>, sequence: &Sequence, splats: &mut Vec<Splat>) {
        self.view.unwind_if_stopped();
        let (paths, numbers) = self.trace_light_paths(indices, sequence);
        let mut between = Vec::new();
        for (path, numbers) in paths.iter().zip(&numbers) {
            for count in 2..=path.len() {
                let pupil = self.eye.pupil_point(numbers.pupil(count - 1));
                let joined = self.connect_to_pupil(&path[..count], &pupil);
                between.extend(joined.map(|between| Connection {
                    start: numbers.start().x,
                    ..between
                }));
            }
        }
        self.add_visible_connections(&mut between, splats);
    }

    /// Connects the last vertex of a light path to the pupil.
    fn connect_to_pupil(&self, path: &[PathVertex], pupil: &PupilPoint) -> Option<Connection> {
        let (last, before) = (path.last()?, &path[path.len() - 2]);
        let ray = Ray::between(last.start(self.view), pupil.origin)?;
        let eye = towards(last.point, pupil.point);
        if ray.direction.dot(last.normal) <= 0.0 {
            return None;
        }
        let rest = self.path_weight(&path[0], &path[1], path.len());
        if rest <= 0.0 {
            return None;
        }
        let looked = self.eye.image(last.point, pupil)?;
        let scatter = last.scatter(self.view);
        let bsdf = scatter.bsdf(eye);
        let angle = last.solid_angle_to_area(pupil.origin);
        let paths = self.reflections.from_laser as f64;
        let mut irradiance =
            rest * last.beta / paths * bsdf * angle * looked.gain / looked.solid_angle;
        if self.reflections.per_pixel > 0.0 && irradiance > 0.0 {
            let block = self.blocks.of_pixel(self.pixel(looked.place));
            let camera = self.blocks.per_pixel(block);
            let ends = [
                camera * angle / looked.solid_angle,
                scatter.pdf_reverse(eye) * before.solid_angle_to_area(last.point),
            ];
            irradiance *= FullPath::new(path, &[], paths, [ends, [0.0; 2]]).mis_weight(path.len());
        }
        (irradiance > 0.0 && irradiance.is_finite()).then(|| Connection {
            ray,
            pixel: self.pixel(looked.place),
            irradiance,
            length: self.length(path, &[]),
            start: 0.0,
        })
    }

    /// Traces up to a packet of camera paths with these indices.
    fn camera_paths(&self, paths: Range<u32>, key: RngKey, splats: &mut Vec<Splat>) {
        self.view.unwind_if_stopped();
        let blocks: Vec<(usize, u32)> = paths.map(|path| self.blocks.of_path(path)).collect();
        // The paths of a block are stratified within it.
        let sequence = |&(block, _): &(usize, u32)| Sequence::new(key.with(block as u64));
        let sequences: Vec<Sequence> = blocks.iter().map(sequence).collect();
        let of = |first: u32| -> Vec<PathSampler> {
            let pairs = sequences.iter().zip(&blocks);
            let numbers = pairs.map(|(sequence, &(_, index))| PathSampler {
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
            let point = numbers.sequence.pair(numbers.index, 255);
            let pupil = self.eye.pupil_point(point);
            looks.push(self.eye.sensor_sample(place, &pupil));
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
            let point = numbers[i].sequence.pair(numbers[i].index, 255);
            let pupil = self.eye.pupil_point(point);
            let mut vertex = PathVertex {
                point: hit.point,
                normal: hit.normal,
                triangle: hit.face.triangle,
                from: towards(hit.point, pupil.point),
                beta: looked.gain / per_pixel,
                pdf_fwd: 0.0,
                pdf_rev: 0.0,
                is_delta: false,
            };
            vertex.pdf_fwd =
                per_pixel * vertex.solid_angle_to_area(pupil.origin) / looked.solid_angle;
            path.push(vertex);
        }
        let most = self.reflections.most as usize;
        random_walk(self.view, &mut paths, &numbers, 1..most);
        let light_numbers = of(256);
        let mut light = vec![Vec::new(); rays.len()];
        self.start(&mut light, &light_numbers);
        random_walk(self.view, &mut light, &light_numbers, 1..most - 1);
        let mut between = Vec::new();
        for ((camera, light), looked) in paths.iter().zip(&light).zip(&looks) {
            let pixel = self.pixel(looked.place);
            for count in 1..=camera.len() {
                let camera = &camera[..count];
                between.extend(self.connect_to_laser(camera, pixel));
                for count in 1..=light.len().min(most - count) {
                    between.extend(self.connect(&light[..count], camera, pixel));
                }
            }
        }
        self.add_visible_connections(&mut between, splats);
    }

    /// Connects the last vertex of a camera path to the laser.
    fn connect_to_laser(&self, camera: &[PathVertex], pixel: u32) -> Option<Connection> {
        let (last, before) = (camera.last()?, camera.get(camera.len().wrapping_sub(2))?);
        let view = self.view;
        let (received, lit) = self.emitter.lit(last.point, last.normal, last.triangle)?;
        let seen = self.emitter.laser_from_part.point(last.point);
        let aperture = view.laser.section(seen)?.aperture_point;
        let ray = Ray::between(last.start(view), view.part_from_laser.point(aperture))?;
        if ray.direction.dot(last.normal) <= 0.0 {
            return None;
        }
        let rest = self.path_weight(&lit, before, camera.len());
        let scatter = lit.scatter(view);
        let irradiance = rest * last.beta * scatter.bsdf(last.from) * received;
        if irradiance <= 0.0 || !irradiance.is_finite() {
            return None;
        }
        let ends = [
            lit.pdf_fwd,
            scatter.pdf(last.from) * before.solid_angle_to_area(last.point),
        ];
        let path = FullPath::new(
            &[],
            camera,
            self.reflections.from_laser as f64,
            [[0.0; 2], ends],
        );
        Some(Connection {
            ray,
            pixel,
            irradiance: irradiance * path.mis_weight(0),
            length: self.length(&[], camera),
            start: 0.0,
        })
    }

    /// Connects a light path to a camera path.
    fn connect(
        &self,
        light: &[PathVertex],
        camera: &[PathVertex],
        pixel: u32,
    ) -> Option<Connection> {
        let view = self.view;
        let (l, c) = (light.last()?, camera.last()?);
        let ray = Ray::between(l.start(view), c.start(view))?;
        let way = towards(l.point, c.point);
        if way.dot(l.normal) <= 0.0 || way.dot(c.normal) >= 0.0 {
            return None;
        }
        let bounces = light.len() + camera.len();
        let rest = self.path_weight(&light[0], light.get(1).unwrap_or(c), bounces);
        let [of_light, of_camera] = [l, c].map(|vertex| vertex.scatter(view));
        let bsdf = of_light.bsdf(way) * of_camera.bsdf(-way);
        let irradiance =
            rest * l.beta * c.beta * bsdf * way.dot(l.normal) * c.solid_angle_to_area(l.point);
        if irradiance <= 0.0 || !irradiance.is_finite() {
            return None;
        }
        let before = |path: &[PathVertex], back: f64| {
            let index = path.len().checked_sub(2);
            index.map_or(0.0, |i| {
                back * path[i].solid_angle_to_area(path[i + 1].point)
            })
        };
        let ends = [
            [
                of_camera.pdf(-way) * l.solid_angle_to_area(c.point),
                before(light, of_light.pdf_reverse(way)),
            ],
            [
                of_light.pdf(way) * c.solid_angle_to_area(l.point),
                before(camera, of_camera.pdf_reverse(-way)),
            ],
        ];
        let path = FullPath::new(light, camera, self.reflections.from_laser as f64, ends);
        Some(Connection {
            ray,
            pixel,
            irradiance: irradiance * path.mis_weight(light.len()),
            length: self.length(light, camera),
            start: 0.0,
        })
    }
}

#[cfg(test)]
#[path = "indirect_tests.rs"]
mod tests;
