//! Defocus blur and diffraction of the lens.
//!
//! The pupil ([`PupilOtf`]) spreads the light of each sample with the defocus of the sample's
//! surface. Both sides of a step in depth therefore have separate blurs.
//!
//! The light is processed in tiles along the line, each by Fourier transforms on a separate grid.
//! Each tile uses the pupil at the centre of fixed rows and columns. The images of the tiles are
//! added, so tile borders are invisible. Light beyond the margin of a point along rows is omitted.

use super::PoseView;
use super::defocus::{self, Blur, COLUMNS, TAIL_GRAINS};
use super::direct_light::DirectIrradiance;
use super::footprint::TracedRegion;
use super::pixel_mask::{PixelMask, PixelNumbering};
use super::pixel_quadrature::{PixelQuadrature, QuadratureNodes};
use super::pupil::PupilOtf;
use super::speckle::{Speckle, SpeckleSampler, power};
use super::speckle_strips::TangentPlane;
use super::transform::{OutputSampling, PassBand, Transform, fast_length, fast_margin};
use crate::math::{Aperture, DVec2, sinc};
use crate::speckle::theory::AIRY_SIGMA;
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use std::ops::{AddAssign, Range};

/// Step of β between layers; light at intermediate β is interpolated. Halfway between two layers,
/// this increases the squared width of the blur by 1/64 grain². The phase of fields at the pupil
/// rim changes by π/8 per step. Fields therefore use half the step, and lose 0.2 % halfway between
/// two layers.
const BLUR_LAYER_STEP: f64 = 0.5;

/// Returns the light behind the lens, in the columns of `region`. The sensor of `light` may be
/// larger than the view's by the same amount on each side. Defocused light from beyond the border
/// then reaches the view's sensor. Without blur, the input is returned unchanged.
pub fn blur(light: DirectIrradiance, view: &PoseView, region: &TracedRegion) -> DirectIrradiance {
    if view.lens.blur == Blur::None {
        return light;
    }
    let resolution = view.camera.sensor.resolution;
    let beyond = ((light.rows.pixels.columns - resolution.x as usize) / 2) as isize;
    let tiles = tiles(&light, view, beyond);
    let mut pixels = PixelMask::none(resolution);
    for tile in &tiles {
        let around = tile.around().within(&pixels);
        for row in around.rows {
            if !around.columns.is_empty() {
                let columns = &around.columns;
                pixels.insert(
                    row as usize,
                    columns.start as usize,
                    columns.end as usize - 1,
                );
            }
        }
    }
    if let TracedRegion::Columns(_, columns) = region {
        pixels.keep_columns(columns);
    }
    let rows = PixelNumbering::new(pixels);
    match &view.speckle {
        Some(speckle) if view.lens.blur == Blur::Coherent => {
            field_behind(&light, view, speckle, &tiles, rows)
        }
        _ => mean_behind(light, view, &tiles, rows, beyond as usize),
    }
}

/// Computes the mean light behind the lens over each pixel.
fn mean_behind(
    mut light: DirectIrradiance,
    view: &PoseView,
    tiles: &[Tile],
    rows: PixelNumbering,
    beyond: usize,
) -> DirectIrradiance {
    let means = |light: &DirectIrradiance| {
        let spread = |tile: &Tile| {
            view.unwind_if_stopped();
            [tile.apply_otf(light)]
        };
        let parts: Vec<_> = tiles.par_iter().map(spread).collect();
        let mut means = vec![0.0; rows.total()];
        sum_of(tiles, &parts, &rows, &mut means, |sums, mean| {
            mean[0] = sums[0].max(0.0);
        });
        means
    };
    let all = means(&light);
    let nodes = QuadratureNodes::new(PixelQuadrature::Even { per_side: 1 });
    if view.speckle.is_none() {
        return DirectIrradiance::from_blurred(rows, nodes, all, Vec::new());
    }
    let seen = seen_nearest(&light, &rows, beyond);
    let mut polarised = Vec::new();
    if !light.degree_of_polarisation.is_empty() {
        // The lens spreads polarised and unpolarised light equally.
        let each = light
            .irradiance
            .iter_mut()
            .zip(&light.degree_of_polarisation);
        each.for_each(|(irradiance, polarised)| *irradiance *= polarised);
        let degrees = means(&light).into_iter().zip(&all);
        polarised.extend(degrees.map(|(kept, &all)| {
            let degree = (kept / all).clamp(0.0, 1.0);
            if degree.is_nan() { 0.0 } else { degree }
        }));
    }
    DirectIrradiance {
        degree_of_polarisation: polarised,
        ..DirectIrradiance::from_blurred(rows, nodes, all, seen)
    }
}

/// Computes the intensity of the field behind the lens.
fn field_behind(
    light: &DirectIrradiance,
    view: &PoseView,
    speckle: &Speckle,
    tiles: &[Tile],
    rows: PixelNumbering,
) -> DirectIrradiance {
    let side = light.nodes.transformed();
    let nodes = QuadratureNodes::new(defocus::grid_behind(view));
    let images: Vec<OutputSampling> = nodes
        .places()
        .iter()
        .map(|&node| OutputSampling::at(node, side))
        .collect();
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    let reader = SpeckleSampler::new(speckle, view.camera, camera_from_laser);
    let wider = speckle.pupil_scale.unwrap_or(1.0) as f32;
    let mut irradiance = vec![0.0; nodes.places().len() * rows.total()];
    for (pattern, weight) in reader.weights().into_iter().enumerate() {
        let field = |sample: &LitSample| {
            let pixel = sample.pixel;
            let centre = DVec2::new(pixel.column as f64, pixel.row as f64) + 0.5;
            let place = centre + light.nodes.places()[sample.number];
            let seen = light.tangent_planes(pixel.number).get(sample.number);
            let amplitude = reader.amplitude(pattern, place, seen.copied().unwrap_or_default());
            let polarised = light
                .degree_of_polarisation(pixel.number)
                .get(sample.number);
            let power = power(pattern, polarised.copied().unwrap_or(0.0));
            amplitude * wider * power.sqrt()
        };
        let spread = |tile: &Tile| {
            view.unwind_if_stopped();
            tile.spread_field(light, &images, field)
        };
        let parts: Vec<_> = tiles.par_iter().map(spread).collect();
        sum_of(tiles, &parts, &rows, &mut irradiance, |sums, values| {
            for (value, sum) in values.iter_mut().zip(sums) {
                *value += weight * sum.norm_sqr();
            }
        });
    }
    DirectIrradiance::from_blurred(rows, nodes, irradiance, Vec::new())
}

/// Adds the images of all tiles. `take` receives the sums of all images in each pixel of `rows`,
/// and the slice for its values.
fn sum_of<T: Copy + Default + AddAssign + Send + Sync>(
    tiles: &[Tile],
    parts: &[impl AsRef<[Vec<T>]> + Sync],
    rows: &PixelNumbering,
    values: &mut [f32],
    take: impl Fn(&[T], &mut [f32]) + Sync,
) {
    let Some(images) = parts.first().map(|images| images.as_ref().len()) else {
        return;
    };
    let count = values.len() / rows.total().max(1);
    let mut left = values;
    let mut tasks = Vec::new();
    for row in 0..rows.pixels.rows {
        let mine;
        (mine, left) = left.split_at_mut(count * rows.range(row).len());
        if !mine.is_empty() {
            tasks.push((row, mine));
        }
    }
    let new = || vec![T::default(); images * rows.pixels.columns];
    tasks
        .into_par_iter()
        .for_each_init(new, |sums, (row, values)| {
            sums.fill(T::default());
            for (tile, part) in tiles.iter().zip(parts) {
                let all = tile.around();
                let around = all.within(&rows.pixels);
                // A tile beyond the sensor border has no columns on the sensor.
                if !around.rows.contains(&(row as isize)) || around.columns.is_empty() {
                    continue;
                }
                let first = (row as isize - all.rows.start) as usize * all.columns.len();
                let skipped = (around.columns.start - all.columns.start) as usize;
                let onto = &mut sums[images * around.columns.start as usize..];
                for (i, image) in part.as_ref().iter().enumerate() {
                    let values = &image[first + skipped..][..around.columns.len()];
                    let sums = onto[i..].iter_mut().step_by(images);
                    sums.zip(values).for_each(|(sum, &value)| *sum += value);
                }
            }
            let of_pixels = values.chunks_exact_mut(count);
            for (column, values) in rows.pixels.of(row).zip(of_pixels) {
                take(&sums[column * images..][..images], values);
            }
        });
}

/// Columns and rows of pixels, relative to the first pixel of the sensor. They may be negative.
struct Rectangle {
    columns: Range<isize>,
    rows: Range<isize>,
}

impl Rectangle {
    /// Returns the intersection with the sensor.
    fn within(&self, sensor: &PixelMask) -> Rectangle {
        let cut = |range: &Range<isize>, size: usize| {
            let size = size as isize;
            range.start.clamp(0, size)..range.end.clamp(0, size)
        };
        Rectangle {
            columns: cut(&self.columns, sensor.columns),
            rows: cut(&self.rows, sensor.rows),
        }
    }
}

/// Lit pixel.
#[derive(Clone, Copy)]
struct BlurPixel {
    column: isize,
    row: isize,
    number: usize,
}

/// Lit pixels whose light is blurred together.
struct Tile {
    own: Rectangle,
    /// Margin around the lit pixels for their blurred light, pixels.
    margin: [usize; 2],
    /// Transformed samples per side of a pixel.
    side: usize,
    pupil: PupilOtf,
    lit: Vec<BlurPixel>,
    /// β of the layers, uniformly spaced from the minimum to the maximum.
    layers: Vec<f64>,
}

/// Lit sample.
struct LitSample<'a> {
    pixel: &'a BlurPixel,
    /// Index of the sample in its pixel.
    number: usize,
}

/// Returns the minimum and maximum β of a pixel's lit samples.
fn blurs(light: &DirectIrradiance, pixel: usize) -> Option<[f64; 2]> {
    let samples = light.samples(pixel).iter().zip(light.blur(pixel));
    let lit = samples.filter(|&(&irradiance, _)| irradiance > 0.0);
    lit.map(|(_, &blur)| [blur as f64; 2])
        .reduce(|[low, high], [b, _]| [low.min(b), high.max(b)])
}

/// Maximum relative error of the peak of a line due to tiles, and due to layers.
const PEAK_TOLERANCE: f64 = 0.002;
/// Minimum number of rows of a tile.
const FEWEST_ROWS: f64 = 16.0;

/// Returns the maximum number of rows of a block at a column. The pupil at the centre of the block
/// represents all of its rows.
///
/// Between the centre and either end, the image of a point changes in size by at most
/// [`PEAK_TOLERANCE`]. The error of the peak of a blurred line is no larger.
fn rows_of_one_pupil(view: &PoseView, column: f64) -> isize {
    let rows = view.camera.sensor.resolution.y as f64;
    let wavelength = view.laser.beam.wavelength;
    let size = [0.0, 0.5, 1.0].map(|share| {
        let place = DVec2::new(column, share * rows);
        let pupil = PupilOtf::new(view.camera, place, wavelength);
        [pupil.reach(1.0, 0.0), pupil.reach(0.0, 1.0)]
    });
    let change = |a: DVec2, b: DVec2| (a / b).map(f64::ln).abs().max_element();
    let change = |i: usize| (0..2).map(move |k| change(size[i][k], size[i + 1][k]));
    let most = (0..2).flat_map(change).fold(0.0, f64::max);
    // The sensor is divided into parts with equal numbers of rows. `max` turns NaN into one part.
    let parts = (most / PEAK_TOLERANCE).ceil().max(1.0);
    (rows / parts).max(FEWEST_ROWS).ceil() as isize
}

/// Returns the relative peak error of a line if its blurs from `low` to `high` are replaced by
/// their mean. The line has the standard deviation `line`. All arguments are in grains.
///
/// The error is half the relative change of the squared width of the line. The blur adds the
/// variance of the pupil times b² to the squared width, and the core of the Airy pattern adds
/// 0.42².
fn off_in_one_layer(low: f64, high: f64, line: f64, aperture: Aperture) -> f64 {
    let blur = low.abs().max(high.abs());
    let variance = aperture.variance_along_height();
    let square = line * line + variance * blur * blur + AIRY_SIGMA * AIRY_SIGMA;
    variance * blur * (high - low) / 2.0 / square
}

/// Returns the lit pixels with the range of their blurs, in blocks of [`COLUMNS`] columns.
fn lit_blocks(light: &DirectIrradiance, beyond: isize) -> Vec<Vec<(BlurPixel, [f64; 2])>> {
    let rows = &light.rows;
    let mut blocks = vec![Vec::new(); rows.pixels.columns.div_ceil(COLUMNS)];
    for row in 0..rows.pixels.rows {
        for (column, number) in rows.pixels.of(row).zip(rows.start(row)..) {
            if let Some(blurs) = blurs(light, number) {
                let pixel = BlurPixel {
                    column: column as isize - beyond,
                    row: row as isize - beyond,
                    number,
                };
                blocks[column / COLUMNS].push((pixel, blurs));
            }
        }
    }
    blocks
}

/// Divides the lit pixels into tiles. The result depends on lit samples only, not on the selection
/// of traced dark pixels.
fn tiles(light: &DirectIrradiance, view: &PoseView, beyond: isize) -> Vec<Tile> {
    let blocks = lit_blocks(light, beyond);
    let wavelength = view.laser.beam.wavelength;
    let side = light.nodes.transformed();
    let is_field = view.lens.blur == Blur::Coherent;
    let step = BLUR_LAYER_STEP / if is_field { 2.0 } else { 1.0 };
    let margin_of = |pupil: &PupilOtf, blur: f64| {
        let reach = pupil.reach(blur, TAIL_GRAINS).to_array();
        reach.map(|x| fast_margin((x.ceil() as usize).min(view.lens.reach)))
    };
    let mut tiles = Vec::new();
    for (i, block) in blocks.iter().enumerate() {
        let start = (i * COLUMNS) as isize - beyond;
        let middle = (start + COLUMNS as isize / 2) as f64;
        let height = rows_of_one_pupil(view, middle);
        let mut rest = &block[..];
        while let Some((first, _)) = rest.first() {
            let first = first.row;
            // End row of the tile, independent of its contents. Fields are not divided along rows,
            // because the pupils of different tiles differ in phase.
            let (last, middle_row) = match is_field {
                true => (isize::MAX, first as f64),
                false => {
                    let last = (first.div_euclid(height) + 1) * height;
                    (last, last as f64 - 0.5 * height as f64)
                }
            };
            let pupil_at = |row| PupilOtf::new(view.camera, DVec2::new(middle, row), wavelength);
            let mut pupil = pupil_at(middle_row);
            // Upper limit of |β|: twice the blur of the largest tile margin, at which light is too
            // diluted to be visible.
            let widest = 2.0 * view.lens.reach as f64 / pupil.reach(1.0, 0.0).max_element();
            // A tile ends at the next gap that blurred light cannot cross.
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            let mut margin = [0; 2];
            let mut end = first;
            let mut count = 0;
            for (pixel, blurs) in rest {
                if pixel.row >= last || pixel.row > end + 2 * margin[1] as isize {
                    break;
                }
                let [least, most] = blurs.map(|blur| blur.clamp(-widest, widest));
                (low, high) = (low.min(least), high.max(most));
                margin = margin_of(&pupil, low.abs().max(high.abs()));
                (end, count) = (pixel.row, count + 1);
            }
            if is_field {
                pupil = pupil_at(0.5 * (first + end + 1) as f64);
                margin = margin_of(&pupil, low.abs().max(high.abs()));
            }
            let (own, others) = rest.split_at(count);
            let steps = ((high - low) / step).ceil().max(1.0);
            let line = view.lens.line_sigma * pupil.grains.determinant().sqrt();
            let is_one = high - low <= step
                && (is_field || off_in_one_layer(low, high, line, pupil.aperture) < PEAK_TOLERANCE);
            tiles.push(Tile {
                own: Rectangle {
                    columns: start..start + COLUMNS as isize,
                    rows: first..end + 1,
                },
                margin,
                side,
                pupil,
                lit: own.iter().map(|(pixel, _)| *pixel).collect(),
                layers: match is_one {
                    true => vec![0.5 * (low + high)],
                    false => (0..=steps as usize)
                        .map(|i| low + (high - low) * i as f64 / steps)
                        .collect(),
                },
            });
            rest = others;
        }
    }
    tiles
}

impl Tile {
    /// Returns the columns and rows of the grid, pixels.
    fn extent(&self) -> [usize; 2] {
        [
            fast_length(self.own.columns.len() + 2 * self.margin[0]),
            fast_length(self.own.rows.len() + 2 * self.margin[1]),
        ]
    }

    /// Returns the pixels of the grid.
    fn around(&self) -> Rectangle {
        let [columns, rows] = self.extent();
        let from = |own: &Range<isize>, margin: usize, extent: usize| {
            let start = own.start - margin as isize;
            start..start + extent as isize
        };
        Rectangle {
            columns: from(&self.own.columns, self.margin[0], columns),
            rows: from(&self.own.rows, self.margin[1], rows),
        }
    }

    /// Returns the two layers between which light of this β is interpolated, and their weights.
    fn layer_weights(&self, blur: f64) -> [(usize, f32); 2] {
        let last = self.layers.len() - 1;
        if last == 0 {
            return [(0, 1.0), (0, 0.0)];
        }
        let step = (self.layers[last] - self.layers[0]) / last as f64;
        let at = ((blur - self.layers[0]) / step).clamp(0.0, last as f64);
        let first = (at as usize).min(last - 1);
        let second = at - first as f64;
        [(first, (1.0 - second) as f32), (first + 1, second as f32)]
    }

    /// Returns, for each sample of a pixel, the index of its transformed sample relative to the
    /// first one of the pixel. The second value is the weight of the sample in the mean over that
    /// transformed sample.
    fn nodes(&self, light: &DirectIrradiance) -> Vec<(usize, f32)> {
        let in_sample = light.nodes.side() / self.side;
        let columns = self.grid()[0];
        let node = |(i, weight): (usize, &f32)| {
            let (x, y) = (i % light.nodes.side(), i / light.nodes.side());
            let offset = y / in_sample * columns + x / in_sample;
            (offset, weight * (self.side * self.side) as f32)
        };
        light.nodes.weights().iter().enumerate().map(node).collect()
    }

    /// Returns the index of the first sample of a pixel in the tile's rows.
    fn first(&self, pixel: &BlurPixel) -> usize {
        let column = (pixel.column - self.own.columns.start) as usize + self.margin[0];
        let row = (pixel.row - self.own.rows.start) as usize;
        self.side * (row * self.grid()[0] + column)
    }

    /// Returns the field values of all lit samples and their indices, for each layer.
    fn by_layer(
        &self,
        light: &DirectIrradiance,
        field: impl Fn(&LitSample) -> Complex32,
    ) -> Vec<Vec<(usize, Complex32)>> {
        let mut layers: Vec<Vec<(usize, Complex32)>> = vec![Vec::new(); self.layers.len()];
        let nodes = self.nodes(light);
        for pixel in &self.lit {
            let first = self.first(pixel);
            let samples = light.samples(pixel.number).iter();
            let samples = samples.zip(light.blur(pixel.number)).zip(&nodes);
            for (number, ((&irradiance, &blur), &(offset, weight))) in samples.enumerate() {
                if irradiance == 0.0 {
                    continue;
                }
                let value = field(&LitSample { pixel, number }) * (irradiance * weight).sqrt();
                for (layer, share) in self.layer_weights(blur as f64) {
                    if share > 0.0 {
                        layers[layer].push((first + offset, value * share));
                    }
                }
            }
        }
        layers
    }

    /// Returns the samples along the columns and rows of the grid.
    fn grid(&self) -> [usize; 2] {
        self.extent().map(|n| n * self.side)
    }

    /// Converts frequencies from cycles per sample to cycles per pixel.
    fn cycles_per_pixel(&self) -> f64 {
        self.side as f64
    }

    /// Returns the columns and rows in which the image of a point is computed, pixels. Light beyond
    /// this rectangle is folded into it.
    fn kernel_size(&self) -> [usize; 2] {
        [2 * self.margin[0], 3 * self.margin[1]]
    }

    /// Computes the mean light behind the lens in the pixels of the grid, row by row.
    ///
    /// The image of a point ends at the margin. Images of points are therefore symmetric and
    /// independent of the tile, so centroids do not depend on tile borders. Along columns, light
    /// beyond the margin is folded into the image, because a line receives as much from its other
    /// columns. Along rows, it is omitted; less than a quarter is added to the tail at the margin.
    fn apply_otf(&self, light: &DirectIrradiance) -> Vec<f32> {
        let cutoff = 2.0 * self.pupil.cutoff_frequency() / self.cycles_per_pixel();
        let spread = self.kernel_size().map(|n| n * self.side);
        let kernel_band = PassBand::of_real(spread, cutoff);
        // A kernel of finite size has frequencies slightly beyond the cutoff.
        let cell = DVec2::from(spread.map(|n| 1.0 / n as f64));
        let band = PassBand::of_real(self.grid(), cutoff + cell);
        let frequencies: Vec<DVec2> = kernel_band
            .frequencies()
            .map(|f| f * self.cycles_per_pixel())
            .collect();
        let mut sum = vec![Complex32::ZERO; band.len()];
        let passes = self.pupil.passes(&frequencies);
        for (pairs, &blur) in self.pairs(light).iter_mut().zip(&self.layers) {
            let kernel = passes.at(blur);
            Transform::with(|own| {
                let spectrum = own.rfft2(pairs, &band);
                let margin = self.margin[1] * self.side;
                let mut kernel = own.centred_kernel(&kernel, &kernel_band, margin, self.grid()[0]);
                let kernel = own.rfft2(&mut kernel, &band);
                for ((sum, value), pass) in sum.iter_mut().zip(spectrum).zip(kernel) {
                    *sum += value * pass;
                }
            });
        }
        // Samples of a non-uniform grid are already integrated over the pixel.
        if light.nodes.side() == self.side {
            let [of_columns, of_rows] = band.along().map(|frequencies| {
                let factor = |frequency: f64| sinc(frequency * self.cycles_per_pixel()) as f32;
                frequencies.into_iter().map(factor).collect::<Vec<f32>>()
            });
            for (sum, of_column) in sum.chunks_mut(of_rows.len()).zip(of_columns) {
                let factors = of_rows.iter().map(|of_row| of_row * of_column);
                sum.iter_mut()
                    .zip(factors)
                    .for_each(|(sum, factor)| *sum *= factor);
            }
        }
        let drawn = OutputSampling::at(DVec2::ZERO, self.side);
        let pairs = Transform::with(|own| own.backward_real(&sum, &band, &drawn));
        let mut image = Vec::with_capacity(2 * pairs.len());
        let [columns, rows] = self.extent();
        for pair in pairs.chunks(columns) {
            image.extend(pair.iter().map(|z| z.re));
            image.extend(pair.iter().map(|z| z.im));
        }
        image.truncate(columns * rows);
        image
    }

    /// Returns the rows of each layer in pairs. Rows 2i and 2i + 1 are the real and imaginary parts
    /// of row i.
    fn pairs(&self, light: &DirectIrradiance) -> Vec<Vec<Complex32>> {
        let [columns, _] = self.grid();
        let length = columns * (self.own.rows.len() * self.side).div_ceil(2);
        let mut layers = vec![vec![Complex32::ZERO; length]; self.layers.len()];
        let mut add = |at: usize, value: f32, shares: &[(usize, f32); 2]| {
            let (row, column) = (at / columns, at % columns);
            for &(layer, share) in shares.iter().filter(|(_, share)| *share > 0.0) {
                let pair = &mut layers[layer][row / 2 * columns + column];
                match row % 2 {
                    0 => pair.re += value * share,
                    _ => pair.im += value * share,
                }
            }
        };
        let nodes = self.nodes(light);
        for pixel in &self.lit {
            let first = self.first(pixel);
            let (samples, blurs) = (light.samples(pixel.number), light.blur(pixel.number));
            let is_one = self.layers.len() == 1 || blurs.iter().all(|&blur| blur == blurs[0]);
            if is_one && self.side == 1 {
                let weighted = samples
                    .iter()
                    .zip(&nodes)
                    .map(|(e, (_, weight))| e * weight);
                add(first, weighted.sum(), &self.layer_weights(blurs[0] as f64));
                continue;
            }
            for ((&irradiance, &blur), &(offset, weight)) in samples.iter().zip(blurs).zip(&nodes) {
                if irradiance > 0.0 {
                    add(
                        first + offset,
                        irradiance * weight,
                        &self.layer_weights(blur as f64),
                    );
                }
            }
        }
        layers
    }

    /// Computes the field behind the lens for a surface that has `field` at its samples. The mean
    /// square of `field` in the passband of the pupil is 1.
    fn spread_field(
        &self,
        light: &DirectIrradiance,
        images: &[OutputSampling],
        field: impl Fn(&LitSample) -> Complex32,
    ) -> Vec<Vec<Complex32>> {
        let cell = DVec2::from(self.extent().map(|n| 1.0 / n as f64));
        let band = PassBand::new(
            self.grid(),
            (self.pupil.cutoff_frequency() + cell) / self.cycles_per_pixel(),
        );
        let openings: Vec<(f32, f32)> = band
            .frequencies()
            .map(|frequency| {
                self.pupil
                    .amplitude_and_phase(frequency * self.cycles_per_pixel(), cell)
            })
            .collect();
        // Cells at the pupil rim have a transmitted amplitude fraction; the square of this fraction
        // is the transmitted power.
        let open: f64 = openings
            .iter()
            .map(|&(share, _)| (share * share) as f64)
            .sum();
        let scale = (self.pupil.cells(cell) / open).sqrt() as f32;
        let columns = self.grid()[0];
        let mut sum = vec![Complex32::ZERO; band.len()];
        let mut rows = vec![Complex32::ZERO; columns * self.own.rows.len() * self.side];
        let layers = self.by_layer(light, |sample| field(sample) * scale);
        for (values, &blur) in layers.iter().zip(&self.layers) {
            if values.is_empty() {
                continue;
            }
            rows.fill(Complex32::ZERO);
            for &(at, value) in values {
                rows[at] += value;
            }
            let first = self.margin[1] * self.side;
            let spectrum = Transform::with(|own| own.forward(&mut rows, first, &band));
            let turn = std::f32::consts::PI * blur as f32;
            for ((sum, value), &(share, phase)) in sum.iter_mut().zip(spectrum).zip(&openings) {
                *sum += value * Complex32::from_polar(share, turn * phase);
            }
        }
        let image = |drawn| Transform::with(|own| own.backward(&sum, &band, drawn));
        images.iter().map(image).collect()
    }
}

/// Returns the plane at which speckle is read for each pixel. It is the plane of the nearest lit
/// pixel in the column, or in the nearest column with a lit pixel. The light of that pixel spreads
/// to this one.
fn seen_nearest(
    light: &DirectIrradiance,
    rows: &PixelNumbering,
    beyond: usize,
) -> Vec<TangentPlane> {
    if light.surface.is_empty() {
        return Vec::new();
    }
    let mut lit = vec![Vec::new(); light.rows.pixels.columns];
    for row in 0..light.rows.pixels.rows {
        let pixels = light.rows.pixels.of(row).zip(light.rows.start(row)..);
        for (column, pixel) in pixels {
            let seen = light.tangent_planes(pixel).iter().zip(light.samples(pixel));
            let brightest = seen.max_by(|a, b| a.1.total_cmp(b.1));
            if let Some((&seen, _)) = brightest.filter(|&(_, &irradiance)| irradiance > 0.0) {
                lit[column].push((row, seen));
            }
        }
    }
    // Nearest lit column for each column, and the index of its nearest lit pixel so far.
    let with_light: Vec<usize> = (0..lit.len()).filter(|&c| !lit[c].is_empty()).collect();
    if with_light.is_empty() {
        return Vec::new();
    }
    let nearest = |column: usize| {
        let after = with_light.partition_point(|&c| c < column);
        let beside = with_light[after.saturating_sub(1)..].iter().take(2);
        let nearest = beside.min_by_key(|c| c.abs_diff(column));
        (*nearest.expect("one is lit"), 0)
    };
    let mut nearest: Vec<(usize, usize)> = (0..lit.len()).map(nearest).collect();
    let mut seen = Vec::with_capacity(rows.total());
    for row in 0..rows.pixels.rows {
        for column in rows.pixels.of(row) {
            let (of, at) = &mut nearest[column + beyond];
            let lit = &lit[*of];
            let off = |at: usize| lit[at].0.abs_diff(row + beyond);
            while *at + 1 < lit.len() && off(*at + 1) < off(*at) {
                *at += 1;
            }
            seen.push(lit[*at].1);
        }
    }
    seen
}

#[cfg(test)]
#[path = "blur_tests.rs"]
mod tests;
