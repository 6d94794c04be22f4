//! Image of the light from the lit curve: receivers on a quadtree over the sensor.
//!
//! Receivers are corners, edge midpoints and centres of blocks. If the bilinear interpolation of
//! the corners predicts the other receivers to a fraction of the sensor noise, and if the pixels see
//! one smooth surface, the block is interpolated quadratically between all nine. Otherwise it is
//! divided into four blocks. A pixel that remains has the mean of its corners and centre by
//! Simpson's rule. If these disagree, and at edges of the surface, it has the mean of random samples
//! over its area and the pupil.
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
    /// Number of pairs of node and receiver that were evaluated.
    pub pairs: u64,
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
    /// Number of receivers, with the later vertices.
    receivers: u32,
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
type ReceiverBlock = [u32; 2];

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
            pairs: 0,
        };
        if lengths {
            pixels.lengths = vec![Default::default(); pixels.irradiance.len()];
        }
        let mut receivers = 0;
        let mut size = LARGEST_BLOCK;
        while size > 1 {
            receivers += self.evaluate(&mut grid, &blocks, size);
            let smooth = |block: &&ReceiverBlock| self.is_smooth(&grid, &edges, **block, size);
            let (done, divided): (Vec<&ReceiverBlock>, Vec<&ReceiverBlock>) =
                blocks.par_iter().partition(smooth);
            for block in done {
                self.interpolate(&grid, *block, size, &mut pixels);
            }
            size /= 2;
            let children = divided.into_iter().flat_map(|&block| corners(block, size));
            let inside = |&[x, y]: &ReceiverBlock| x < resolution.x && y < resolution.y;
            blocks = children.filter(inside).collect();
        }
        receivers += self.add_single_pixels(&grid, &edges, &blocks, &mut pixels);
        pixels.pairs = receivers * self.line.nodes() as u64;
        let least = (INVISIBLE * self.noise(0.0)) as f32;
        let faint = pixels.irradiance.iter_mut().filter(|e| **e < least);
        faint.for_each(|irradiance| *irradiance = 0.0);
        pixels
    }

    /// Returns the largest blocks that contain some of the columns.
    fn blocks_of(&self, columns: &Range<u32>) -> Vec<ReceiverBlock> {
        let rows = self.view.camera.sensor.resolution.y.div_ceil(LARGEST_BLOCK);
        let columns = columns.start / LARGEST_BLOCK..columns.end.div_ceil(LARGEST_BLOCK);
        (0..rows)
            .flat_map(|row| columns.clone().map(move |column| [column, row]))
            .map(|block| block.map(|i| i * LARGEST_BLOCK))
            .collect()
    }

    /// Evaluates the receivers of these blocks that are not known yet, and returns the number of
    /// receivers, with the later vertices.
    fn evaluate(&self, grid: &mut ReceiverGrid, blocks: &[ReceiverBlock], size: u32) -> u64 {
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
        let mut receivers = 0;
        for (&index, light) in points.iter().zip(found.into_iter().flatten()) {
            let index = index as usize;
            receivers += u64::from(light.receivers);
            (grid.second[index], grid.later[index]) = (light.second, light.later);
            if let Some(lengths) = grid.lengths.get_mut(index) {
                *lengths = light.lengths;
            }
        }
        receivers
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
            let light = (self.line).light(&receiver, 2, sample.key.uniform(0), SHADOW_RAYS);
            let gain = self.eye.sensor_sample(sample.place, pupil).gain;
            let camera = self.view.part_from_camera.translation.distance(hit.point) as f32;
            let second = light.radiance * gain;
            paths[i] = later_paths(second);
            found[i].receivers = 1;
            found[i].second = second as f32;
            found[i].lengths = light.lengths.map(|length| length + camera);
            seen[i] = Some(PathVertex {
                beta: gain,
                ..receiver.vertex
            });
        }
        if self.most > 2 && self.line.has_later_bounces() {
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
                    let light = self
                        .line
                        .light(&receiver, depth + 2, random, LATER_SHADOW_RAYS);
                    let irradiance = vertex.beta * light.radiance / f64::from(paths[i]);
                    found[i].later += irradiance as f32;
                    found[i].receivers += 1;
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

    fn is_smooth(
        &self,
        grid: &ReceiverGrid,
        edges: &EdgeMap,
        block: ReceiverBlock,
        size: u32,
    ) -> bool {
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
    fn interpolate(
        &self,
        grid: &ReceiverGrid,
        block: ReceiverBlock,
        size: u32,
        pixels: &mut LinePixels,
    ) {
        let resolution = self.view.camera.sensor.resolution;
        let known = receivers(block, size).map(|point| grid.total(point));
        for y in block[1]..(block[1] + size).min(resolution.y) {
            for x in block[0]..(block[0] + size).min(resolution.x) {
                let value = pixel_mean(&known, [x - block[0], y - block[1]], size);
                let pixel = (y * resolution.x + x) as usize;
                pixels.irradiance[pixel] = value.max(0.0) as f32;
                if let Some(lengths) = pixels.lengths.get_mut(pixel) {
                    *lengths = grid.lengths[grid.index(block)];
                }
            }
        }
    }

    /// Adds the light of pixels that belong to no interpolated block, and returns the number of
    /// receivers.
    fn add_single_pixels(
        &self,
        grid: &ReceiverGrid,
        edges: &EdgeMap,
        blocks: &[ReceiverBlock],
        pixels: &mut LinePixels,
    ) -> u64 {
        let (uneven, even): (Vec<ReceiverBlock>, Vec<ReceiverBlock>) =
            blocks.par_iter().partition(|&&pixel| edges.any(pixel, 1));
        let centers: Vec<Vec<SampledLight>> = (even.par_chunks(WIDTH))
            .map(|some| self.light_at_centers(some))
            .collect();
        let mut receivers = 0;
        let mut sampled: Vec<(ReceiverBlock, f64)> = uneven.into_iter().map(|p| (p, 0.0)).collect();
        for (pixel, center) in even.into_iter().zip(centers.into_iter().flatten()) {
            receivers += u64::from(center.receivers);
            match self.mean_of_corners_and_center(grid, pixel, &center) {
                Some(light) => pixels.set(self.index(pixel), light),
                None => sampled.push((pixel, f64::from(center.second))),
            }
        }
        let found: Vec<SampledLight> = (sampled.par_iter())
            .map(|&(pixel, center)| self.sample_pixel(grid, pixel, center))
            .collect();
        for ((pixel, _), light) in sampled.into_iter().zip(found) {
            receivers += u64::from(light.receivers);
            pixels.set(self.index(pixel), light);
        }
        receivers
    }

    fn index(&self, [x, y]: ReceiverBlock) -> usize {
        (y * self.view.camera.sensor.resolution.x + x) as usize
    }

    /// Returns the random key of a pixel. Receivers at corners have smaller numbers.
    fn key_of(&self, pixel: ReceiverBlock) -> RngKey {
        self.key.with(u64::MAX - self.index(pixel) as u64)
    }

    /// Returns the light at the centres of up to a packet of pixels.
    fn light_at_centers(&self, pixels: &[ReceiverBlock]) -> Vec<SampledLight> {
        let sample = |&pixel: &ReceiverBlock| ImageSample {
            place: DVec2::from(pixel.map(f64::from)) + 0.5,
            pupil: None,
            key: self.key_of(pixel).with(u64::MAX),
        };
        let samples: Vec<ImageSample> = pixels.iter().map(sample).collect();
        self.light(&samples, |second| self.later_paths(second))
    }

    /// Returns the mean over a pixel by Simpson's rule; `None` if the mean of the corners deviates
    /// from the centre by a large fraction of the sensor noise.
    fn mean_of_corners_and_center(
        &self,
        grid: &ReceiverGrid,
        pixel: ReceiverBlock,
        center: &SampledLight,
    ) -> Option<SampledLight> {
        let corners = corners(pixel, 1).map(|point| grid.index(point));
        let mean = |values: &[f32]| corners.iter().map(|&i| values[i]).sum::<f32>() / 4.0;
        let second = mean(&grid.second);
        let tolerance = TOLERANCE * self.noise(center.second.into());
        let agree = f64::from((second - center.second).abs()) <= tolerance;
        agree.then(|| SampledLight {
            second: (second + 2.0 * center.second) / 3.0,
            later: (mean(&grid.later) + 2.0 * center.later) / 3.0,
            ..*center
        })
    }

    /// Returns the mean of random samples over a pixel. Their number follows from other receivers
    /// only, at the corners and with the light `center`, so the mean is unbiased.
    fn sample_pixel(&self, grid: &ReceiverGrid, pixel: ReceiverBlock, center: f64) -> SampledLight {
        let known = corners(pixel, 1).map(|point| f64::from(grid.second(point)));
        let high = known.into_iter().fold(center, f64::max);
        // The blur of an edge may be wider than the pixel.
        let low = match self.view.lens.blur {
            Blur::None => known.into_iter().fold(f64::INFINITY, f64::min),
            _ => 0.0,
        };
        // A step within a pixel of n stratified samples has the standard deviation 0.4·n^−¾.
        let noise = self.noise((low + high) / 2.0);
        let needed = (0.4 * (high - low) / (SAMPLING_NOISE * noise)).powf(4.0 / 3.0);
        let count = needed.clamp(EDGE_SAMPLES, MOST_SAMPLES).ceil() as u32;
        let light = self.light_in_pixel(pixel, self.key_of(pixel), count);
        let mean = |of: fn(&SampledLight) -> f32| light.iter().map(of).sum::<f32>() / count as f32;
        SampledLight {
            second: mean(|light| light.second),
            later: mean(|light| light.later),
            lengths: light[0].lengths,
            receivers: light.iter().map(|light| light.receivers).sum(),
        }
    }

    /// Returns the light at stratified samples over the area of a pixel and the pupil.
    fn light_in_pixel(&self, pixel: ReceiverBlock, key: RngKey, count: u32) -> Vec<SampledLight> {
        let sequence = Sequence::new(key);
        let sample = |i: u32| ImageSample {
            place: DVec2::from(pixel.map(f64::from)) + sequence.pair(i, 0),
            pupil: Some(self.eye.pupil_point(sequence.pair(i, 1))),
            key: key.with(u64::from(i)),
        };
        let samples: Vec<ImageSample> = (0..count).map(sample).collect();
        (samples.chunks(WIDTH))
            .flat_map(|some| self.light(some, |_| 1))
            .collect()
    }

    /// Returns the image from `count` random samples in each pixel, without interpolation.
    #[cfg(test)]
    pub fn sampled(&self, count: u32) -> Vec<f32> {
        let resolution = self.view.camera.sensor.resolution;
        let mean = |pixel: u32| {
            let block = [pixel % resolution.x, pixel / resolution.x];
            let light = self.light_in_pixel(block, self.key.with(u64::from(pixel)).with(2), count);
            let of_all = light.iter().map(|light| light.second + light.later);
            of_all.sum::<f32>() / count as f32
        };
        let pixels = (0..resolution.element_product()).into_par_iter();
        pixels.map(mean).collect()
    }

    /// Finds the pixels that do not see one smooth surface together with their neighbours.
    fn edges(&self, blocks: &[ReceiverBlock]) -> EdgeMap {
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
    fn edges_of(&self, [left, top]: ReceiverBlock) -> Vec<(UVec2, u32)> {
        const SIDE: usize = LARGEST_BLOCK as usize + 1;
        let resolution = self.view.camera.sensor.resolution;
        let center = self.eye.pupil_center();
        let mut seen: Vec<Option<Hit>> = Vec::with_capacity(SIDE * SIDE);
        for row in 0..SIDE as u32 {
            for first in (0..SIDE).step_by(WIDTH) {
                let ray = |column: u32| {
                    let place = DVec2::new((left + column).into(), (top + row).into()) + 0.5;
                    self.viewing_ray(place, &center)
                };
                let columns = first as u32..SIDE.min(first + WIDTH) as u32;
                let rays: SmallVec<[Ray; WIDTH]> = columns.map(ray).collect();
                seen.extend_from_slice(&self.view.accel.closest(&rays, |_, _| true)[..rays.len()]);
            }
        }
        // Neighbours of a pixel with the offsets of both: also along the diagonals, since an edge
        // may cross a corner of a pixel only.
        let pairs = [
            [UVec2::ZERO, UVec2::X],
            [UVec2::ZERO, UVec2::Y],
            [UVec2::ZERO, UVec2::ONE],
            [UVec2::X, UVec2::Y],
        ];
        let mut edges = Vec::new();
        for i in 0..SIDE * SIDE {
            let pixel = UVec2::new((i % SIDE) as u32, (i / SIDE) as u32);
            for pair in pairs.map(|pair| pair.map(|offset| pixel + offset)) {
                if pair.iter().any(|pixel| pixel.max_element() >= SIDE as u32) {
                    continue;
                }
                let [a, b] = pair.map(|pixel| &seen[pixel.y as usize * SIDE + pixel.x as usize]);
                if self.is_continuous(a, b) {
                    continue;
                }
                let radius = self.blur_radius(a).max(self.blur_radius(b));
                let pixels = pair.map(|pixel| pixel + UVec2::new(left, top));
                let inside = pixels.iter().filter(|pixel| pixel.cmplt(resolution).all());
                edges.extend(inside.map(|&pixel| (pixel, radius)));
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

    /// Returns the radius of the image of a point, in whole pixels; 0 without a point.
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

impl LinePixels {
    fn set(&mut self, pixel: usize, light: SampledLight) {
        self.irradiance[pixel] = light.second + light.later;
        if let Some(lengths) = self.lengths.get_mut(pixel) {
            *lengths = light.lengths;
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

/// Returns the mean of the quadratic interpolation over a pixel of a block, from the values at the
/// nine receivers.
fn pixel_mean(values: &[f64; 9], pixel: [u32; 2], size: u32) -> f64 {
    let [a, b, c, d, top, left, center, right, bottom] = *values;
    let rows = [[a, top, b], [left, center, right], [c, bottom, d]];
    let [column, row] = pixel.map(|i| {
        let half = 0.5 / f64::from(size);
        let u = f64::from(2 * i + 1) * half;
        // Mean of u² over the pixel.
        let square = u * u + half * half / 3.0;
        [
            1.0 - 3.0 * u + 2.0 * square,
            4.0 * (u - square),
            2.0 * square - u,
        ]
    });
    let along = |values: [f64; 3], weights: [f64; 3]| -> f64 {
        values
            .iter()
            .zip(weights)
            .map(|(value, weight)| value * weight)
            .sum()
    };
    along(rows.map(|values| along(values, column)), row)
}

/// Returns the corners of a block, row by row.
fn corners([x, y]: ReceiverBlock, size: u32) -> [[u32; 2]; 4] {
    [[x, y], [x + size, y], [x, y + size], [x + size, y + size]]
}

/// Returns the receivers of a block: corners, then edge midpoints and centre, row by row.
fn receivers([x, y]: ReceiverBlock, size: u32) -> [[u32; 2]; 9] {
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
    fn any(&self, [x, y]: ReceiverBlock, size: u32) -> bool {
        let columns = x as usize..(x + size).min(self.resolution.x) as usize;
        let mut rows = y..(y + size).min(self.resolution.y);
        rows.any(|y| {
            let row = (y * self.resolution.x) as usize;
            self.pixels[row + columns.start..row + columns.end].contains(&true)
        })
    }
}
