//! Image of the light from the lit curve: receivers on a quadtree over the sensor.
//!
//! Receivers are corners, edge midpoints and centres of blocks. A block is interpolated if the
//! bilinear interpolation of its corners predicts the other receivers to a fraction of the sensor
//! noise, and if its pixels see one smooth surface. Otherwise it is divided into four blocks. A
//! pixel that remains has the mean of its corners, or at edges of the surface the mean of random
//! samples over its area and the pupil.
//!
//! Each receiver has random numbers of its position. The image is therefore independent of the
//! number of threads, and equal for the complete sensor and for some of its columns.

use super::PoseView;
use super::defocus::Blur;
use super::footprint::TracedRegion;
use super::line_source::{LineReceiver, LineSource, SHADOW_RAYS};
use super::mis::towards;
use super::random_walk::{PathSampler, PathVertex, random_walk};
use super::thin_lens::{PupilPoint, ThinLens};
use crate::accel::{Hit, Ray, WIDTH};
use crate::math::rng::RngKey;
use crate::math::{DVec2, Sequence};
use glam::UVec2;
use rayon::prelude::*;
use smallvec::{SmallVec, smallvec};
use std::ops::Range;

/// Side of the largest blocks, pixels.
const LARGEST_BLOCK: u32 = 16;
/// Largest deviation of a receiver from the bilinear interpolation of the corners, relative to the
/// sensor noise of a pixel. The remaining error is at most about a quarter of the deviation, since
/// the receivers at midpoints and centre are interpolated, too.
const TOLERANCE: f64 = 0.5;
/// Standard deviation of a sampled pixel, relative to the sensor noise, that determines the number
/// of samples.
const SAMPLING_NOISE: f64 = 0.5;
/// Smallest and largest number of samples of a pixel at an edge.
const EDGE_SAMPLES: f64 = 4.0;
const MOST_SAMPLES: f64 = 16.0;
/// Standard deviation of one path for later bounces, relative to the light with two bounces, and
/// largest number of these paths per receiver. The value is typical of third bounces in metal
/// grooves.
const LATER_NOISE: f64 = 0.1;
const MOST_LATER_PATHS: f64 = 8.0;
/// Shadow rays per later vertex.
const LATER_SHADOW_RAYS: usize = 2;
/// Half angle of the pupil relative to the roughness below which light is constant over the pupil.
/// The second-order change of a lobe is about the square of this ratio.
const NARROW_PUPIL: f64 = 0.05;
/// Light of a pixel that is omitted, relative to the noise of a dark pixel.
const INVISIBLE: f64 = 1e-3;
/// Angle between the normals of neighbouring pixels of one smooth surface: cosine of 8°.
const SMOOTH_COSINE: f64 = 0.99;
/// Sine of the angle between the surface and the line to the point of a neighbouring pixel, above
/// which the surface is discontinuous.
const STEP_SINE: f64 = 0.3;

/// Line light as seen by a camera.
pub(super) struct LineImager<'a> {
    view: &'a PoseView<'a>,
    eye: &'a ThinLens<'a>,
    line: &'a LineSource<'a>,
    /// Maximum number of bounces.
    most: u32,
    key: RngKey,
    /// Points of the pupil over which receivers average.
    pupil_nodes: Vec<PupilPoint>,
    /// Electrons per irradiance, mm²/mW.
    electrons: f64,
    /// Variance of a dark pixel, electrons².
    dark: f64,
}

/// Light from the curve in some pixels.
pub(super) struct LinePixels {
    /// Irradiance (mW/mm²) of each pixel of the sensor, row by row.
    pub irradiance: Vec<f32>,
    /// Lengths of some paths from the laser to the pupil in each pixel, mm, infinite for paths that
    /// are occluded; empty if not required.
    pub lengths: Vec<[f32; SHADOW_RAYS]>,
}

/// Position on the sensor at which light is evaluated.
struct ImageSample {
    place: DVec2,
    /// Point of the pupil; `None` for the mean over the pupil, seen from its centre.
    pupil: Option<PupilPoint>,
    key: RngKey,
}

/// Light at a sample.
#[derive(Clone, Copy, Default)]
struct SampledLight {
    /// Irradiance of light with two bounces, mW/mm².
    second: f32,
    /// Irradiance of light with more bounces, mW/mm².
    later: f32,
    /// See [`LinePixels::lengths`].
    lengths: [f32; SHADOW_RAYS],
}

/// Receivers at the corners of all pixels.
struct ReceiverGrid {
    columns: usize,
    /// See [`SampledLight`]; NaN if not known.
    second: Vec<f32>,
    later: Vec<f32>,
    lengths: Vec<[f32; SHADOW_RAYS]>,
}

/// Block of pixels: first column and row.
type Block = [u32; 2];

impl<'a> LineImager<'a> {
    /// Creates the imager for light with at most `most` bounces.
    pub fn new(
        (view, eye): (&'a PoseView<'a>, &'a ThinLens<'a>),
        line: &'a LineSource<'a>,
        most: u32,
        key: RngKey,
    ) -> LineImager<'a> {
        let (sensor, lens) = (&view.camera.sensor, &view.camera.lens);
        let glossy = view.surface.glossy();
        let roughness = glossy.map(|glossy| glossy.min_roughness());
        let roughness = roughness.fold(1.0, f64::min);
        let half_angle = lens.pupil_diameter() / 2.0 / lens.focus_distance;
        let pupil_nodes = match half_angle > NARROW_PUPIL * roughness {
            true => eye.pupil_nodes().to_vec(),
            false => vec![eye.pupil_center()],
        };
        LineImager {
            view,
            eye,
            line,
            most,
            key,
            pupil_nodes,
            electrons: sensor.electrons_per_irradiance(view.laser.beam.wavelength),
            dark: sensor.dark_variance_e(),
        }
    }

    /// Returns the light in the pixels of a region. `lengths` selects whether path lengths are
    /// returned.
    pub fn image(&self, region: &TracedRegion, lengths: bool) -> LinePixels {
        let resolution = self.view.camera.sensor.resolution;
        let columns = match region {
            TracedRegion::Columns(_, columns) => columns.start as u32..columns.end as u32,
            _ => 0..resolution.x,
        };
        let mut blocks = self.blocks_of(&columns);
        // The blur of an edge may extend over several blocks.
        let edges = self.edges(&self.blocks_of(&(0..resolution.x)));
        let mut grid = ReceiverGrid::new(resolution, lengths);
        let mut pixels = LinePixels {
            irradiance: vec![0.0; resolution.element_product() as usize],
            lengths: Vec::new(),
        };
        if lengths {
            pixels.lengths = vec![Default::default(); pixels.irradiance.len()];
        }
        let mut size = LARGEST_BLOCK;
        while size > 1 {
            self.evaluate(&mut grid, &blocks, size);
            let smooth = |block: &&Block| self.is_smooth(&grid, &edges, **block, size);
            let (done, divided): (Vec<&Block>, Vec<&Block>) = blocks.par_iter().partition(smooth);
            for block in done {
                self.interpolate(&grid, *block, size, &mut pixels);
            }
            size /= 2;
            let children = divided
                .into_iter()
                .flat_map(|&[x, y]| [[x, y], [x + size, y], [x, y + size], [x + size, y + size]]);
            let inside = |&[x, y]: &Block| x < resolution.x && y < resolution.y;
            blocks = children.filter(inside).collect();
        }
        let sampled: Vec<SampledLight> = (blocks.par_iter())
            .map(|&pixel| self.sample_pixel(&grid, &edges, pixel))
            .collect();
        for ([x, y], light) in blocks.iter().zip(sampled) {
            let pixel = (y * resolution.x + x) as usize;
            pixels.irradiance[pixel] = light.second + light.later;
            if lengths {
                pixels.lengths[pixel] = light.lengths;
            }
        }
        let least = (INVISIBLE * self.noise(0.0)) as f32;
        let faint = pixels.irradiance.iter_mut().filter(|e| **e < least);
        faint.for_each(|irradiance| *irradiance = 0.0);
        pixels
    }

    /// Returns the largest blocks that contain some of the columns.
    fn blocks_of(&self, columns: &Range<u32>) -> Vec<Block> {
        let rows = self.view.camera.sensor.resolution.y.div_ceil(LARGEST_BLOCK);
        let columns = columns.start / LARGEST_BLOCK..columns.end.div_ceil(LARGEST_BLOCK);
        (0..rows)
            .flat_map(|row| columns.clone().map(move |column| [column, row]))
            .map(|block| block.map(|i| i * LARGEST_BLOCK))
            .collect()
    }

    /// Evaluates the receivers of these blocks that are not known yet.
    fn evaluate(&self, grid: &mut ReceiverGrid, blocks: &[Block], size: u32) {
        let mut points: Vec<u32> = (blocks.iter())
            .flat_map(|&block| receivers(block, size))
            .map(|point| grid.index(point) as u32)
            .filter(|&index| grid.second[index as usize].is_nan())
            .collect();
        points.sort_unstable();
        points.dedup();
        let sample = |&index: &u32| ImageSample {
            place: grid.place(index as usize),
            pupil: None,
            key: self.key.with(u64::from(index)),
        };
        let found: Vec<Vec<SampledLight>> = (points.par_chunks(WIDTH))
            .map(|points| {
                let samples: Vec<ImageSample> = points.iter().map(sample).collect();
                self.light(&samples, |second| self.later_paths(second))
            })
            .collect();
        for (&index, light) in points.iter().zip(found.into_iter().flatten()) {
            let index = index as usize;
            (grid.second[index], grid.later[index]) = (light.second, light.later);
            if let Some(lengths) = grid.lengths.get_mut(index) {
                *lengths = light.lengths;
            }
        }
    }

    /// Returns the number of paths for later bounces at a receiver, from the irradiance of light
    /// with two bounces. The noise of the paths is then about half of the sensor noise.
    fn later_paths(&self, second: f64) -> u32 {
        let needed = (LATER_NOISE * second / (SAMPLING_NOISE * self.noise(second))).powi(2);
        needed.clamp(1.0, MOST_LATER_PATHS).ceil() as u32
    }

    /// Returns the light at up to a packet of samples. `later_paths` returns the number of paths for
    /// later bounces from the irradiance of light with two bounces.
    fn light(
        &self,
        samples: &[ImageSample],
        later_paths: impl Fn(f64) -> u32,
    ) -> Vec<SampledLight> {
        self.view.unwind_if_stopped();
        let center = self.eye.pupil_center();
        let pupils = samples.iter().map(|s| s.pupil.unwrap_or(center));
        let pupils: SmallVec<[PupilPoint; WIDTH]> = pupils.collect();
        let rays: SmallVec<[Ray; WIDTH]> = (samples.iter().zip(&pupils))
            .map(|(sample, pupil)| self.viewing_ray(sample.place, pupil))
            .collect();
        let hits = self.view.accel.closest(&rays, |_, _| true);
        let mut found = vec![SampledLight::default(); samples.len()];
        let mut seen = vec![None; samples.len()];
        let mut paths = vec![0; samples.len()];
        for (i, (sample, pupil)) in samples.iter().zip(&pupils).enumerate() {
            let Some(hit) = &hits[i] else {
                continue;
            };
            let receiver = LineReceiver {
                vertex: seen_vertex(hit, pupil),
                towards: match sample.pupil {
                    None => (self.pupil_nodes.iter())
                        .map(|node| towards(hit.point, node.point))
                        .collect(),
                    Some(pupil) => smallvec![towards(hit.point, pupil.point)],
                },
            };
            let light = (self.line).light(&receiver, sample.key.uniform(0), SHADOW_RAYS);
            let gain = self.eye.sensor_sample(sample.place, pupil).gain;
            let camera = self.view.part_from_camera.translation.distance(hit.point) as f32;
            let second = light.radiance * gain;
            paths[i] = later_paths(second);
            found[i].second = second as f32;
            found[i].lengths = light.lengths.map(|length| length + camera);
            seen[i] = Some(PathVertex {
                beta: gain,
                ..receiver.vertex
            });
        }
        if self.most > 2 {
            self.add_later_bounces(samples, &seen, &paths, &mut found);
        }
        found
    }

    /// Adds light with more than two bounces. Random walks from the receivers integrate over the
    /// curve at each of their later vertices.
    fn add_later_bounces(
        &self,
        samples: &[ImageSample],
        seen: &[Option<PathVertex>],
        paths: &[u32],
        found: &mut [SampledLight],
    ) {
        let sequences: Vec<Sequence> = (samples.iter())
            .map(|sample| Sequence::new(sample.key.with(1)))
            .collect();
        for index in 0..paths.iter().copied().max().unwrap_or(0) {
            let numbers: Vec<PathSampler> = (sequences.iter())
                .map(|sequence| PathSampler {
                    sequence,
                    index,
                    first: 0,
                })
                .collect();
            let mut walks: Vec<Vec<PathVertex>> = (seen.iter().zip(paths))
                .map(|(vertex, &paths)| vertex.iter().filter(|_| index < paths).copied().collect())
                .collect();
            random_walk(self.view, &mut walks, &numbers, 1..self.most as usize - 1);
            for (i, walk) in walks.iter().enumerate() {
                for (depth, vertex) in walk.iter().enumerate().skip(1) {
                    let receiver = LineReceiver {
                        vertex: *vertex,
                        towards: smallvec![vertex.from],
                    };
                    let random = numbers[i].pupil(depth).x;
                    let light = self.line.light(&receiver, random, LATER_SHADOW_RAYS);
                    let irradiance = vertex.beta * light.radiance / f64::from(paths[i]);
                    found[i].later += irradiance as f32;
                }
            }
        }
    }

    fn viewing_ray(&self, place: DVec2, pupil: &PupilPoint) -> Ray {
        Ray {
            origin: pupil.origin,
            direction: self.eye.direction(place, pupil),
            t_max: f64::INFINITY,
        }
    }

    /// Returns the standard deviation of the sensor noise of a pixel, as irradiance.
    fn noise(&self, irradiance: f64) -> f64 {
        (irradiance * self.electrons + self.dark).sqrt() / self.electrons
    }

    fn is_smooth(&self, grid: &ReceiverGrid, edges: &EdgeMap, block: Block, size: u32) -> bool {
        let values = receivers(block, size).map(|point| f64::from(grid.second(point)));
        let largest = values.iter().fold(0.0f64, |most, &value| most.max(value));
        if largest == 0.0 && !edges.any(block, size) {
            return true;
        }
        let [a, b, c, d, top, left, center, right, bottom] = values;
        let pairs = [
            (top, a + b),
            (left, a + c),
            (right, b + d),
            (bottom, c + d),
            (center, (a + b + c + d) / 2.0),
        ];
        let tolerance = TOLERANCE * self.noise(center);
        let predicted = |&(value, twice): &(f64, f64)| (value - twice / 2.0).abs() <= tolerance;
        // Light that no pixel shows does not have to be resolved.
        let faint = largest < TOLERANCE / 4.0 * self.noise(0.0);
        pairs.iter().all(predicted) && (faint || !edges.any(block, size))
    }

    /// Interpolates a block quadratically between its nine receivers.
    fn interpolate(&self, grid: &ReceiverGrid, block: Block, size: u32, pixels: &mut LinePixels) {
        let resolution = self.view.camera.sensor.resolution;
        let known = receivers(block, size).map(|point| grid.total(point));
        let [a, b, c, d, top, left, center, right, bottom] = known;
        let rows = [[a, top, b], [left, center, right], [c, bottom, d]];
        let along = |values: [f64; 3], u: f64| {
            let weights = [
                (1.0 - u) * (1.0 - 2.0 * u),
                4.0 * u * (1.0 - u),
                u * (2.0 * u - 1.0),
            ];
            values
                .iter()
                .zip(weights)
                .map(|(value, weight)| value * weight)
                .sum::<f64>()
        };
        let position = |pixel: u32, first: u32| (f64::from(pixel - first) + 0.5) / f64::from(size);
        for y in block[1]..(block[1] + size).min(resolution.y) {
            for x in block[0]..(block[0] + size).min(resolution.x) {
                let of_row = rows.map(|values| along(values, position(x, block[0])));
                let value = along(of_row, position(y, block[1])).max(0.0);
                let pixel = (y * resolution.x + x) as usize;
                pixels.irradiance[pixel] = value as f32;
                if let Some(lengths) = pixels.lengths.get_mut(pixel) {
                    *lengths = grid.lengths[grid.index(block)];
                }
            }
        }
    }

    /// Returns the light of a pixel: the mean of its corners, or at edges of the surface the mean of
    /// random samples. The number of samples follows from the receivers at the corners only, so the
    /// mean is unbiased.
    fn sample_pixel(&self, grid: &ReceiverGrid, edges: &EdgeMap, pixel: Block) -> SampledLight {
        let [x, y] = pixel;
        let corners =
            [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]].map(|point| grid.index(point));
        let of_corners = |values: &[f32]| corners.map(|corner| values[corner]);
        let second = of_corners(&grid.second);
        if !edges.any(pixel, 1) {
            return SampledLight {
                second: second.iter().sum::<f32>() / 4.0,
                later: of_corners(&grid.later).iter().sum::<f32>() / 4.0,
                lengths: grid.lengths.get(corners[0]).copied().unwrap_or_default(),
            };
        }
        let high = f64::from(second.into_iter().fold(0.0, f32::max));
        // The blur of an edge may be wider than the pixel.
        let low = match self.view.lens.blur {
            Blur::None => f64::from(second.into_iter().fold(f32::INFINITY, f32::min)),
            _ => 0.0,
        };
        // A step within a pixel of n stratified samples has the standard deviation 0.4·n^−¾.
        let noise = self.noise((low + high) / 2.0);
        let needed = (0.4 * (high - low) / (SAMPLING_NOISE * noise)).powf(4.0 / 3.0);
        let count = needed.clamp(EDGE_SAMPLES, MOST_SAMPLES).ceil() as u32;
        let resolution = self.view.camera.sensor.resolution;
        // Receivers at corners have smaller numbers.
        let key = self.key.with(u64::MAX - u64::from(y * resolution.x + x));
        let sequence = Sequence::new(key);
        let sample = |i: u32| ImageSample {
            place: DVec2::new(x.into(), y.into()) + sequence.pair(i, 0),
            pupil: Some(self.eye.pupil_point(sequence.pair(i, 1))),
            key: key.with(u64::from(i)),
        };
        let samples: Vec<ImageSample> = (0..count).map(sample).collect();
        let light = self.light(&samples, |_| 1);
        let mean = |of: fn(&SampledLight) -> f32| light.iter().map(of).sum::<f32>() / count as f32;
        SampledLight {
            second: mean(|light| light.second),
            later: mean(|light| light.later),
            lengths: light[0].lengths,
        }
    }

    /// Finds the pixels that do not see one smooth surface together with their neighbours.
    fn edges(&self, blocks: &[Block]) -> EdgeMap {
        let resolution = self.view.camera.sensor.resolution;
        let found: Vec<Vec<(UVec2, u32)>> = blocks
            .par_iter()
            .map(|&block| self.edges_of(block))
            .collect();
        let mut edges = EdgeMap::none(resolution);
        for (pixel, radius) in found.into_iter().flatten() {
            edges.insert(pixel, radius);
        }
        edges
    }

    /// Returns the pixels of a largest block at edges, and the radius of the defocus blur there,
    /// pixels.
    fn edges_of(&self, [left, top]: Block) -> Vec<(UVec2, u32)> {
        const SIDE: usize = LARGEST_BLOCK as usize + 1;
        let resolution = self.view.camera.sensor.resolution;
        let center = self.eye.pupil_center();
        let mut seen: Vec<Option<Hit>> = Vec::with_capacity(SIDE * SIDE);
        for row in 0..SIDE as u32 {
            for columns in [0..16, 16..17u32] {
                let ray = |column: u32| {
                    let place = DVec2::new((left + column).into(), (top + row).into()) + 0.5;
                    self.viewing_ray(place, &center)
                };
                let rays: SmallVec<[Ray; WIDTH]> = columns.map(ray).collect();
                seen.extend_from_slice(&self.view.accel.closest(&rays, |_, _| true)[..rays.len()]);
            }
        }
        let mut edges = Vec::new();
        for i in 0..SIDE * SIDE {
            let (row, column) = (i / SIDE, i % SIDE);
            let pixel = UVec2::new(left + column as u32, top + row as u32);
            let next = [
                (column + 1 < SIDE, 1, UVec2::X),
                (row + 1 < SIDE, SIDE, UVec2::Y),
            ];
            for (exists, step, to) in next {
                if !exists || self.is_continuous(&seen[i], &seen[i + step]) {
                    continue;
                }
                let radii = [&seen[i], &seen[i + step]].map(|hit| self.blur_radius(hit));
                let radius = radii[0].max(radii[1]);
                for pixel in [pixel, pixel + to] {
                    if pixel.cmplt(resolution).all() {
                        edges.push((pixel, radius));
                    }
                }
            }
        }
        edges
    }

    /// Returns whether two neighbouring pixels see one smooth surface.
    fn is_continuous(&self, a: &Option<Hit>, b: &Option<Hit>) -> bool {
        let (a, b) = match (a, b) {
            (None, None) => return true,
            (Some(a), Some(b)) => (a, b),
            _ => return false,
        };
        let materials = &self.view.surface;
        let way = b.point - a.point;
        materials.number(a.face.triangle) == materials.number(b.face.triangle)
            && a.normal.dot(b.normal) > SMOOTH_COSINE
            && way.dot(a.normal).abs() <= STEP_SINE * way.length()
    }

    /// Returns the radius of the image of a point, pixels, rounded up.
    fn blur_radius(&self, hit: &Option<Hit>) -> u32 {
        let Some(hit) = hit else { return 0 };
        let image = |u: DVec2| self.eye.image(hit.point, &self.eye.pupil_point(u));
        // Opposite points of the pupil's rim.
        match [0.0, 0.5].map(|angle| image(DVec2::new(1.0, angle))) {
            [Some(a), Some(b)] => ((a.place - b.place).length() / 2.0).round() as u32,
            _ => 0,
        }
    }
}

/// Returns the vertex of a camera path at a hit.
fn seen_vertex(hit: &Hit, pupil: &PupilPoint) -> PathVertex {
    PathVertex {
        point: hit.point,
        normal: hit.normal,
        triangle: hit.face.triangle,
        from: towards(hit.point, pupil.point),
        beta: 1.0,
        pdf_fwd: 0.0,
        pdf_rev: 0.0,
        is_delta: false,
    }
}

/// Returns the receivers of a block: corners, then edge midpoints and centre, row by row.
fn receivers([x, y]: Block, size: u32) -> [[u32; 2]; 9] {
    let half = size / 2;
    let steps = [
        (0, 0),
        (2, 0),
        (0, 2),
        (2, 2),
        (1, 0),
        (0, 1),
        (1, 1),
        (2, 1),
        (1, 2),
    ];
    steps.map(|(i, j)| [x + i * half, y + j * half])
}

impl ReceiverGrid {
    /// Creates a grid without known receivers. It extends over the largest blocks.
    fn new(resolution: UVec2, lengths: bool) -> ReceiverGrid {
        let points = |pixels: u32| (pixels.next_multiple_of(LARGEST_BLOCK) + 1) as usize;
        let (columns, rows) = (points(resolution.x), points(resolution.y));
        let with_lengths = if lengths { columns * rows } else { 0 };
        ReceiverGrid {
            columns,
            second: vec![f32::NAN; columns * rows],
            later: vec![0.0; columns * rows],
            lengths: vec![Default::default(); with_lengths],
        }
    }

    fn index(&self, [x, y]: [u32; 2]) -> usize {
        y as usize * self.columns + x as usize
    }

    /// Returns the irradiance of light with at least two bounces.
    fn total(&self, point: [u32; 2]) -> f64 {
        let index = self.index(point);
        f64::from(self.second[index]) + f64::from(self.later[index])
    }

    fn place(&self, index: usize) -> DVec2 {
        DVec2::new((index % self.columns) as f64, (index / self.columns) as f64)
    }

    /// Returns the irradiance of light with two bounces.
    fn second(&self, point: [u32; 2]) -> f32 {
        self.second[self.index(point)]
    }
}

/// Pixels at edges of the visible surface.
struct EdgeMap {
    resolution: UVec2,
    pixels: Vec<bool>,
}

impl EdgeMap {
    fn none(resolution: UVec2) -> EdgeMap {
        EdgeMap {
            resolution,
            pixels: vec![false; resolution.element_product() as usize],
        }
    }

    /// Marks the pixels within `radius` of a pixel.
    fn insert(&mut self, pixel: UVec2, radius: u32) {
        let last = (pixel + radius).min(self.resolution - 1);
        let first = pixel.saturating_sub(UVec2::splat(radius));
        for y in first.y..=last.y {
            let row = (y * self.resolution.x) as usize;
            self.pixels[row + first.x as usize..=row + last.x as usize].fill(true);
        }
    }

    /// Returns whether any pixel of a block is marked.
    fn any(&self, [x, y]: Block, size: u32) -> bool {
        let columns = x as usize..(x + size).min(self.resolution.x) as usize;
        let mut rows = y..(y + size).min(self.resolution.y);
        rows.any(|y| {
            let row = (y * self.resolution.x) as usize;
            self.pixels[row + columns.start..row + columns.end].contains(&true)
        })
    }
}
