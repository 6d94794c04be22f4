//! What the lens spreads of the light.
//!
//! The light at each place is spread by the pupil ([`Pupil`]) with the defocus of its own
//! surface, so each side of a step in depth has its own blur. That is done in tiles along the
//! line, each by Fourier transforms on its own grid and by the pupil at the centre of fixed rows and columns: the tiles' results are added, so that where one ends
//! and the next begins does not show, and light is neither lost nor made (what the tails would carry
//! past a tile's margin comes in again on its other side).

use super::View;
use super::defocus::{self, Blur, COLUMNS, GRAINS};
use super::footprint::Region;
use super::grid::{Grid, Nodes};
use super::light::Light;
use super::pixels::{Pixels, Rows};
use super::pupil::Pupil;
use super::reference::Seen;
use super::speckle::{Reader, Speckle, power};
use super::transform::{Band, Drawn, Transform, fast_length};
use crate::math::{DVec2, sinc};
use crate::speckle::theory::AIRY_SIGMA;
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use std::ops::{AddAssign, Range};

/// Steps of β at which light is spread: so far between two, the mean of both is as much wider as 1/64
/// of a grain's square; and fields, whose phase at the pupil's rim differs by π/8, lose 0.2 % in
/// the middle between two steps of half of that.
const STEP: f64 = 0.5;

/// The light behind the lens, in the columns of `region`. `light` may be on a sensor that is larger
/// than the view's by as much on each side, as light that is out of focus beyond its edge reaches it too. A
/// sharp image is the same light, and costs nothing.
pub fn blur(light: Light, view: &View, region: &Region) -> Light {
    if view.lens.blur == Blur::None {
        return light;
    }
    let resolution = view.camera.sensor.resolution;
    let beyond = ((light.rows.pixels.columns - resolution.x as usize) / 2) as isize;
    let tiles = tiles(&light, view, beyond);
    let mut pixels = Pixels::none(resolution);
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
    if let Region::Columns(_, columns) = region {
        pixels.keep_columns(columns);
    }
    let rows = Rows::new(pixels);
    match &view.speckle {
        Some(speckle) if view.lens.blur == Blur::Coherent => {
            field_behind(&light, view, speckle, &tiles, rows)
        }
        _ => mean_behind(light, view, &tiles, rows, beyond as usize),
    }
}

/// The mean of the light behind the lens over each pixel.
fn mean_behind(mut light: Light, view: &View, tiles: &[Tile], rows: Rows, beyond: usize) -> Light {
    let means = |light: &Light| {
        let spread = |tile: &Tile| {
            view.unwind_if_stopped();
            [tile.spread(light)]
        };
        let parts: Vec<_> = tiles.par_iter().map(spread).collect();
        let mut means = vec![0.0; rows.total()];
        sum_of(tiles, &parts, &rows, &mut means, |sums, mean| {
            mean[0] = sums[0].max(0.0);
        });
        means
    };
    let all = means(&light);
    let nodes = Nodes::new(Grid::Even { per_side: 1 });
    if view.speckle.is_none() {
        return Light::spread(rows, nodes, all, Vec::new());
    }
    let seen = seen_nearest(&light, &rows, beyond);
    let mut polarised = Vec::new();
    if !light.polarised.is_empty() {
        // The lens spreads what is polarised with the rest.
        let each = light.irradiance.iter_mut().zip(&light.polarised);
        each.for_each(|(irradiance, polarised)| *irradiance *= polarised);
        let degrees = means(&light).into_iter().zip(&all);
        polarised.extend(degrees.map(|(kept, &all)| {
            let degree = (kept / all).clamp(0.0, 1.0);
            if degree.is_nan() { 0.0 } else { degree }
        }));
    }
    Light {
        polarised,
        ..Light::spread(rows, nodes, all, seen)
    }
}

/// The intensity of the field behind the lens.
fn field_behind(
    light: &Light,
    view: &View,
    speckle: &Speckle,
    tiles: &[Tile],
    rows: Rows,
) -> Light {
    let side = light.nodes.transformed();
    let nodes = Nodes::new(defocus::grid_behind(view));
    let images: Vec<Drawn> = nodes
        .places()
        .iter()
        .map(|&node| Drawn::at(node, side))
        .collect();
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    let reader = Reader::new(speckle, view.camera, camera_from_laser);
    let wider = speckle.wider.unwrap_or(1.0) as f32;
    let mut irradiance = vec![0.0; nodes.places().len() * rows.total()];
    for (pattern, weight) in reader.weights().into_iter().enumerate() {
        let field = |sample: &Sample| {
            let pixel = sample.pixel;
            let centre = DVec2::new(pixel.column as f64, pixel.row as f64) + 0.5;
            let place = centre + light.nodes.places()[sample.number];
            let seen = light.seen(pixel.number).get(sample.number);
            let amplitude = reader.amplitude(pattern, place, seen.copied().unwrap_or_default());
            let polarised = light.polarised(pixel.number).get(sample.number);
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
    Light::spread(rows, nodes, irradiance, Vec::new())
}

/// Adds up the images in the tiles' `parts`; `take` gets the sums of all images in each pixel of `rows`,
/// and where its values go.
fn sum_of<T: Copy + Default + AddAssign + Send + Sync>(
    tiles: &[Tile],
    parts: &[impl AsRef<[Vec<T>]> + Sync],
    rows: &Rows,
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
                // A tile beyond the sensor's edge has no columns on it.
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

/// Columns and rows of pixels, from the sensor's first pixel on; there may be some before it.
struct Rectangle {
    columns: Range<isize>,
    rows: Range<isize>,
}

impl Rectangle {
    /// What of it is on the sensor.
    fn within(&self, sensor: &Pixels) -> Rectangle {
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

/// A lit pixel.
#[derive(Clone, Copy)]
struct Pixel {
    column: isize,
    row: isize,
    number: usize,
}

/// Lit pixels whose light is spread together.
struct Tile {
    own: Rectangle,
    /// How far their light goes, pixels.
    margin: [usize; 2],
    /// Samples along the side of a pixel that are transformed.
    side: usize,
    pupil: Pupil,
    lit: Vec<Pixel>,
    /// β at which light is spread, evenly from the least to the greatest.
    layers: Vec<f64>,
}

/// A lit sample.
struct Sample<'a> {
    pixel: &'a Pixel,
    /// Which of the pixel's it is.
    number: usize,
}

/// Least and greatest β of a pixel's lit samples.
fn blurs(light: &Light, pixel: usize) -> Option<[f64; 2]> {
    let samples = light.samples(pixel).iter().zip(light.blur(pixel));
    let lit = samples.filter(|&(&irradiance, _)| irradiance > 0.0);
    lit.map(|(_, &blur)| [blur as f64; 2])
        .reduce(|[low, high], [b, _]| [low.min(b), high.max(b)])
}

/// Relative error of the peak of a line that tiles and layers may cause, each.
const PEAK_TOLERANCE: f64 = 0.002;
/// Fewest rows of a tile.
const FEWEST_ROWS: f64 = 16.0;

/// Returns the number of rows of a block, at a column, in whose centre the pupil represents all of them.
///
/// From there to either end, the image of a point changes in size by at most [`PEAK_TOLERANCE`]. The peak of a
/// blurred line errs by no more.
fn rows_of_one_pupil(view: &View, column: f64) -> isize {
    let rows = view.camera.sensor.resolution.y as f64;
    let wavelength = view.laser.beam.wavelength;
    let size = [0.0, 0.5, 1.0].map(|share| {
        let place = DVec2::new(column, share * rows);
        let pupil = Pupil::new(view.camera, place, wavelength);
        [pupil.reach(1.0, 0.0), pupil.reach(0.0, 1.0)]
    });
    let change = |a: DVec2, b: DVec2| (a / b).map(f64::ln).abs().max_element();
    let change = |i: usize| (0..2).map(move |k| change(size[i][k], size[i + 1][k]));
    let most = (0..2).flat_map(change).fold(0.0, f64::max);
    // Equal parts of the sensor's rows; `max` also turns NaN into one part.
    let parts = (most / PEAK_TOLERANCE).ceil().max(1.0);
    (rows / parts).max(FEWEST_ROWS).ceil() as isize
}

/// Returns the relative error of the peak of a line of standard deviation `line` whose blurs from `low` to `high` are
/// replaced by their mean. All are in grains.
///
/// The error is half of the relative change of the square of the line's width. The blur adds b²/16 to that
/// square, and the core of Airy's pattern 0.42².
fn off_in_one_layer(low: f64, high: f64, line: f64) -> f64 {
    let blur = low.abs().max(high.abs());
    let square = line * line + blur * blur / 16.0 + AIRY_SIGMA * AIRY_SIGMA;
    blur * (high - low) / 2.0 / (16.0 * square)
}

/// Depends on lit samples only, so that it is the same whichever others were looked at.
fn tiles(light: &Light, view: &View, beyond: isize) -> Vec<Tile> {
    let rows = &light.rows;
    let mut blocks = vec![Vec::new(); rows.pixels.columns.div_ceil(COLUMNS)];
    for row in 0..rows.pixels.rows {
        for (column, number) in rows.pixels.of(row).zip(rows.start(row)..) {
            if let Some(blurs) = blurs(light, number) {
                let pixel = Pixel {
                    column: column as isize - beyond,
                    row: row as isize - beyond,
                    number,
                };
                blocks[column / COLUMNS].push((pixel, blurs));
            }
        }
    }
    let wavelength = view.laser.beam.wavelength;
    let side = light.nodes.transformed();
    let is_field = view.lens.blur == Blur::Coherent;
    let step = if is_field { STEP / 2.0 } else { STEP };
    let mut tiles = Vec::new();
    for (i, block) in blocks.iter().enumerate() {
        let start = (i * COLUMNS) as isize - beyond;
        let middle = (start + COLUMNS as isize / 2) as f64;
        let height = rows_of_one_pupil(view, middle);
        let mut rest = &block[..];
        while let Some((first, _)) = rest.first() {
            let first = first.row;
            // Where its rows end is the same whatever they hold. Fields are not parted: their tiles' pupils differ in phase.
            let last = match is_field {
                true => isize::MAX,
                false => (first.div_euclid(height) + 1) * height,
            };
            let middle_row = match is_field {
                true => first as f64,
                false => last as f64 - 0.5 * height as f64,
            };
            let pupil_at = |row| Pupil::new(view.camera, DVec2::new(middle, row), wavelength);
            let mut pupil = pupil_at(middle_row);
            // Twice as wide as a tile's margin may be light is spread out of sight.
            let widest = 2.0 * view.lens.reach as f64 / pupil.reach(1.0, 0.0).max_element();
            // Until the next gap that light does not cross.
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
                let reach = pupil.reach(low.abs().max(high.abs()), GRAINS);
                margin = (reach.to_array()).map(|x| (x.ceil() as usize).min(view.lens.reach));
                (end, count) = (pixel.row, count + 1);
            }
            if is_field {
                pupil = pupil_at(0.5 * (first + end + 1) as f64);
                let reach = pupil.reach(low.abs().max(high.abs()), GRAINS);
                margin = (reach.to_array()).map(|x| (x.ceil() as usize).min(view.lens.reach));
            }
            let (own, others) = rest.split_at(count);
            let steps = ((high - low) / step).ceil().max(1.0);
            let line = view.lens.line_sigma * pupil.grains.determinant().sqrt();
            let is_one = high - low <= step
                && (is_field || off_in_one_layer(low, high, line) < PEAK_TOLERANCE);
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
    /// Columns and rows of its grid, pixels.
    fn extent(&self) -> [usize; 2] {
        [
            fast_length(self.own.columns.len() + 2 * self.margin[0]),
            fast_length(self.own.rows.len() + 2 * self.margin[1]),
        ]
    }

    /// The pixels of its grid.
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

    /// Layers that light of this β is shared by, and their shares.
    fn shares(&self, blur: f64) -> [(usize, f32); 2] {
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

    /// Of each sample of a pixel how much further on than the pixel's first it is transformed, and its weight in the
    /// mean over what is transformed as one.
    fn nodes(&self, light: &Light) -> Vec<(usize, f32)> {
        let in_sample = light.nodes.side() / self.side;
        let columns = self.grid()[0];
        let node = |(i, weight): (usize, &f32)| {
            let (x, y) = (i % light.nodes.side(), i / light.nodes.side());
            let offset = y / in_sample * columns + x / in_sample;
            (offset, weight * (self.side * self.side) as f32)
        };
        light.nodes.weights().iter().enumerate().map(node).collect()
    }

    /// Where a pixel's first sample is in the tile's own rows.
    fn first(&self, pixel: &Pixel) -> usize {
        let column = (pixel.column - self.own.columns.start) as usize + self.margin[0];
        let row = (pixel.row - self.own.rows.start) as usize;
        self.side * (row * self.grid()[0] + column)
    }

    /// What lit samples put into each layer as a field: theirs, and where.
    fn by_layer(
        &self,
        light: &Light,
        field: impl Fn(&Sample) -> Complex32,
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
                let value = field(&Sample { pixel, number }) * (irradiance * weight).sqrt();
                for (layer, share) in self.shares(blur as f64) {
                    if share > 0.0 {
                        layers[layer].push((first + offset, value * share));
                    }
                }
            }
        }
        layers
    }

    /// Samples along the columns and rows of its grid.
    fn grid(&self) -> [usize; 2] {
        self.extent().map(|n| n * self.side)
    }

    /// Cycles a pixel of frequencies in cycles a sample.
    fn per_pixel(&self) -> f64 {
        self.side as f64
    }

    /// Its mean light behind the lens, in the pixels around it, row by row.
    fn spread(&self, light: &Light) -> Vec<f32> {
        let band = Band::of_real(self.grid(), 2.0 * self.pupil.most() / self.per_pixel());
        let frequencies: Vec<DVec2> = band.frequencies().map(|f| f * self.per_pixel()).collect();
        let mut sum = vec![Complex32::ZERO; band.len()];
        let first = self.margin[1] * self.side;
        let passes = self.pupil.passes(&frequencies);
        for (pairs, &blur) in self.pairs(light).iter_mut().zip(&self.layers) {
            let spectrum = Transform::with(|own| own.forward_real(pairs, first, &band));
            let passes = passes.at(blur);
            for ((sum, value), pass) in sum.iter_mut().zip(spectrum).zip(passes) {
                *sum += value * pass;
            }
        }
        // Samples of a grid that is not even are integrated over the pixel already.
        if light.nodes.side() == self.side {
            let [of_columns, of_rows] = band.along().map(|frequencies| {
                let factor = |frequency: f64| sinc(frequency * self.per_pixel()) as f32;
                frequencies.into_iter().map(factor).collect::<Vec<f32>>()
            });
            for (sum, of_column) in sum.chunks_mut(of_rows.len()).zip(of_columns) {
                let factors = of_rows.iter().map(|of_row| of_row * of_column);
                sum.iter_mut()
                    .zip(factors)
                    .for_each(|(sum, factor)| *sum *= factor);
            }
        }
        let drawn = Drawn::at(DVec2::ZERO, self.side);
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

    /// Its own rows of each layer, row 2i and row 2i + 1 as real and imaginary part of row i.
    fn pairs(&self, light: &Light) -> Vec<Vec<Complex32>> {
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
                add(first, weighted.sum(), &self.shares(blurs[0] as f64));
                continue;
            }
            for ((&irradiance, &blur), &(offset, weight)) in samples.iter().zip(blurs).zip(&nodes) {
                if irradiance > 0.0 {
                    add(
                        first + offset,
                        irradiance * weight,
                        &self.shares(blur as f64),
                    );
                }
            }
        }
        layers
    }

    /// The field behind the lens of a surface that has `field` at its samples, of mean square 1 in the
    /// pupil's band.
    fn spread_field(
        &self,
        light: &Light,
        images: &[Drawn],
        field: impl Fn(&Sample) -> Complex32,
    ) -> Vec<Vec<Complex32>> {
        let cell = DVec2::from(self.extent().map(|n| 1.0 / n as f64));
        let band = Band::new(self.grid(), (self.pupil.most() + cell) / self.per_pixel());
        let openings: Vec<(f32, f32)> = band
            .frequencies()
            .map(|frequency| self.pupil.opening(frequency * self.per_pixel(), cell))
            .collect();
        // Cells at the rim are open by a share, of whose light that share's square comes through.
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

/// What each pixel sees where speckle asks for it: what the nearest lit pixel of the
/// column sees, or of the nearest column that has one; its light is spread there.
fn seen_nearest(light: &Light, rows: &Rows, beyond: usize) -> Vec<Seen> {
    if light.surface.is_empty() {
        return Vec::new();
    }
    let mut lit = vec![Vec::new(); light.rows.pixels.columns];
    for row in 0..light.rows.pixels.rows {
        let pixels = light.rows.pixels.of(row).zip(light.rows.start(row)..);
        for (column, pixel) in pixels {
            let seen = light.seen(pixel).iter().zip(light.samples(pixel));
            let brightest = seen.max_by(|a, b| a.1.total_cmp(b.1));
            if let Some((&seen, _)) = brightest.filter(|&(_, &irradiance)| irradiance > 0.0) {
                lit[column].push((row, seen));
            }
        }
    }
    // Of each column the nearest that has light, and which of its pixels is the nearest so far.
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
