//! Light that goes laser → surface → camera, pixel by pixel: camera ray, closest
//! hit, laser light there, shadow ray to the aperture point it came from, Lambert
//! reflection, pupil solid angle; and over the samples of a pixel the laser's
//! profile and the speckle.

use super::footprint::footprint;
use super::irradiance::Irradiance;
use super::lit::{Center, Light, LitRays, Plane, Rays};
use super::pixels::{Pixels, SIDE, middle};
use super::reference::Seen;
use super::samples::Grid;
use super::sight::Sight;
use super::speckle::{Reader, Speckle};
use super::window::Window;
use crate::accel::{Accel, Clusters, WIDTH};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::{DVec2, Rigid};
use crate::surface::Lambert;
use rayon::prelude::*;
use std::ops::Range;

/// Everything one frame depends on, in the part's frame.
pub struct View<'a> {
    pub accel: &'a Accel,
    pub surface: Lambert,
    pub laser: &'a Laser,
    pub part_from_laser: Rigid,
    pub camera: &'a Camera,
    pub part_from_camera: Rigid,
    /// `None`: the light is taken as incoherent.
    pub speckle: Option<Speckle<'a>>,
    /// Samples along each side of a pixel.
    pub samples_per_side: u32,
    pub sampling: Sampling,
    /// Beam radii at which light is taken to end, at most
    /// [`CUTOFF_RADII`](crate::laser::CUTOFF_RADII).
    pub cutoff_radii: f64,
}

/// How the samples of a pixel come by the surface they see.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// A ray for each: the oracle of the other.
    Rays,
    /// Where the rays through the centres of a pixel and its eight neighbours meet
    /// one plane under the same light, the samples lie on that plane, and the light
    /// is the centre's but for the laser's profile across the line; elsewhere a ray
    /// for each. So the middle of a flat piece costs one ray a pixel. What is
    /// thinner than a pixel and missed by nine centres is not seen.
    Planes,
}

/// The light on the sensor. The same bytes for any number of threads: pixels are
/// summed one by one, each in a fixed order. Takes every pixel; of those that
/// [`footprint_image`] takes it gives the same, and of the others zero.
pub fn irradiance_image(view: &View) -> Irradiance {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, Pixels::all(view.camera.sensor.resolution))
}

/// [`irradiance_image`] of those pixels alone that may see lit surface; `clusters`
/// are those of the view's mesh.
pub fn footprint_image(view: &View, clusters: &Clusters) -> Irradiance {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, footprint(view, &sight, clusters))
}

/// [`footprint_image`] of these columns alone: the same values there.
pub fn strip_image(view: &View, clusters: &Clusters, columns: &Range<usize>) -> Irradiance {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    let mut pixels = footprint(view, &sight, clusters);
    pixels.keep_columns(columns);
    trace(view, &sight, pixels)
}

/// From the first column that may see lit surface to the last.
pub fn lit_columns(view: &View, clusters: &Clusters) -> Option<Range<usize>> {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    footprint(view, &sight, clusters).span()
}

/// Bands of a task: enough that two more at its ends cost little, and few enough
/// that there are some to share out.
const BANDS_PER_TASK: usize = 32;

/// The light that these pixels see.
fn trace(view: &View, sight: &Sight, pixels: Pixels) -> Irradiance {
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    let frame = Frame {
        lit: LitRays::new(view, sight),
        pixels: &pixels,
        grid: Grid::new(view.samples_per_side as usize),
        speckle: view
            .speckle
            .as_ref()
            .map(|speckle| Reader::new(speckle, view.camera, camera_from_laser)),
    };
    let tasks = (0..pixels.bands()).into_par_iter().step_by(BANDS_PER_TASK);
    let values: Vec<Vec<f32>> = tasks
        .map_init(Window::default, |window, first| frame.render(first, window))
        .collect();
    Irradiance::new(pixels, values.concat())
}

/// A view with what its pixels share computed once.
struct Frame<'a> {
    lit: LitRays<'a>,
    pixels: &'a Pixels,
    grid: Grid,
    speckle: Option<Reader<'a>>,
}

/// Columns and rows of pixels whose samples are traced together where they are few.
const BLOCK: usize = 2;

impl Frame<'_> {
    /// Irradiance (mW/mm²) of the pixels of the bands from `first` on, row by row.
    fn render(&self, first: usize, window: &mut Window) -> Vec<f32> {
        let bands = first..(first + BANDS_PER_TASK).min(self.pixels.bands());
        let rows = SIDE * bands.start..(SIDE * bands.end).min(self.pixels.rows);
        let mut values = Vec::with_capacity(rows.clone().map(|row| self.pixels.count(row)).sum());
        if values.capacity() == 0 {
            return values;
        }
        // How far around a pixel centres matter to it.
        let around = match (self.lit.view.sampling, self.grid.samples().len()) {
            (_, 1) => 0,
            (Sampling::Planes, _) => 1,
            (Sampling::Rays, _) => {
                let pixels = rows.flat_map(|row| self.pixels.of(row).map(move |c| (c, row)));
                values
                    .extend(pixels.map(|(column, row)| self.sampled(&[middle(column, row)], 1)[0]));
                return values;
            }
        };
        let mut next = first.saturating_sub(around);
        let mut light = vec![0.0; SIDE * self.pixels.columns];
        for band in bands {
            while next <= band + around && next < self.pixels.bands() {
                let tiles = self.pixels.tiles(next, around);
                window.fill(next, tiles, |first, tile| {
                    let wanted = self.pixels.near_in_tile(next, first, around);
                    self.lit.centers(next, first, wanted, tile)
                });
                next += 1;
            }
            for column in self.pixels.tiles(band, 0) {
                self.tile(band, column, around, window, &mut light);
            }
            let rows = SIDE * band..(SIDE * (band + 1)).min(self.pixels.rows);
            for (row, light) in rows.zip(light.chunks_exact(self.pixels.columns)) {
                values.extend(self.pixels.of(row).map(|column| light[column]));
            }
        }
        values
    }

    /// Mean irradiance of a tile's pixels, into rows of the sensor's width.
    fn tile(&self, band: usize, first: usize, around: usize, window: &Window, light: &mut [f32]) {
        let columns = self.pixels.columns;
        let wanted = self.pixels.near_in_tile(band, first, 0);
        let size = [columns, self.pixels.rows];
        let alike = match around {
            0 => wanted,
            _ => window.alike(band, first, size, wanted),
        };
        let centers = window.tile(band, first);
        for pixel in (0..WIDTH).filter(|pixel| alike >> pixel & 1 == 1) {
            let (column, row) = (first + pixel % SIDE, pixel / SIDE);
            let value = match &centers[pixel] {
                Center::Lit(light, plane) => {
                    let place = middle(column, SIDE * band + row);
                    let speckle = self.speckle.as_ref();
                    light.irradiance * self.grid.mean(place, light, plane, &self.lit, speckle)
                }
                _ => 0.0,
            };
            light[row * columns + column] = value as f32;
        }
        for (pixel, value) in self.apart(band, first, wanted & !alike) {
            light[pixel / SIDE * columns + first + pixel % SIDE] = value;
        }
    }

    /// Mean irradiance of those pixels of a tile that are `wanted`, by a ray for each
    /// sample, beside their numbers. Packets are the same whichever pixels are wanted, as
    /// tiles are.
    fn apart(&self, band: usize, first: usize, wanted: u16) -> impl Iterator<Item = (usize, f32)> {
        let side = match self.grid.samples().len() * BLOCK * BLOCK <= WIDTH {
            true => BLOCK,
            false => 1,
        };
        let corners = (0..SIDE).step_by(side).flat_map(move |row| {
            let columns = (0..SIDE).step_by(side);
            columns.map(move |column| SIDE * row + column)
        });
        corners.flat_map(move |corner| {
            let pixels = (0..side * side).map(|i| corner + i / side * SIDE + i % side);
            let place = |pixel: usize| (first + pixel % SIDE, SIDE * band + pixel / SIDE);
            let is_wanted = move |pixel: usize| wanted >> pixel & 1 == 1;
            let mut values = [None; BLOCK * BLOCK];
            if pixels.clone().any(is_wanted) {
                let (mut centres, mut of) = ([DVec2::ZERO; BLOCK * BLOCK], [0; BLOCK * BLOCK]);
                let (mut count, mut bits) = (0, 0);
                for pixel in pixels {
                    let (column, row) = place(pixel);
                    if column < self.pixels.columns && row < self.pixels.rows {
                        (centres[count], of[count]) = (middle(column, row), pixel);
                        bits |= u16::from(is_wanted(pixel)) << count;
                        count += 1;
                    }
                }
                let sampled = self.sampled(&centres[..count], bits);
                for i in (0..count).filter(|i| bits >> i & 1 == 1) {
                    values[i] = Some((of[i], sampled[i]));
                }
            }
            values.into_iter().flatten()
        })
    }

    /// Mean irradiance of the pixels around these centres (up to [`BLOCK`]²) that are
    /// `wanted` (as bits) by a ray for each sample.
    fn sampled(&self, centres: &[DVec2], wanted: u16) -> [f32; BLOCK * BLOCK] {
        let sight = self.lit.sight;
        let samples = self.grid.samples();
        let mut sums = [0.0; BLOCK * BLOCK];
        let mut bend = DVec2::ZERO;
        // Of all samples of all pixels, one after the other.
        for first in (0..samples.len() * centres.len()).step_by(WIDTH) {
            let chunk = first..(first + WIDTH).min(samples.len() * centres.len());
            let mut places = [DVec2::ZERO; WIDTH];
            let mut rays = Rays::new();
            let mut rays_wanted = 0;
            for (i, ray) in chunk.clone().enumerate() {
                let (pixel, sample) = (ray / samples.len(), ray % samples.len());
                if sample == 0 {
                    bend = DVec2::ZERO;
                }
                places[i] = centres[pixel] + samples[sample].0;
                let towards = sight.towards(sight.to_sensor(places[i]), &mut bend);
                rays.push(self.lit.ray(towards));
                rays_wanted |= (wanted >> pixel & 1) << i;
            }
            let count = chunk.len();
            let mut centers = [const { Center::Nothing }; WIDTH];
            (self.lit).look(&places[..count], &rays, rays_wanted, &mut centers);
            for (pixel, (&centre, sum)) in centres.iter().zip(&mut sums).enumerate() {
                let own = samples.len() * pixel..samples.len() * (pixel + 1);
                let own = own.start.max(chunk.start)..own.end.min(chunk.end);
                let lit = own.map(|ray| (&samples[ray % samples.len()], &centers[ray - first]));
                *sum += self.with_speckle(
                    centre,
                    lit.filter_map(|((off, weight), center)| match center {
                        Center::Lit(light, plane) => Some((*off, *weight, light, plane)),
                        _ => None,
                    }),
                );
            }
        }
        sums.map(|sum| sum as f32)
    }

    /// Weighted sum of the irradiance from points seen so many columns and rows from a
    /// pixel's centre.
    fn with_speckle<'l>(
        &self,
        centre: DVec2,
        mut lit: impl Iterator<Item = (DVec2, f64, &'l Light, &'l Plane)>,
    ) -> f64 {
        let value = |weight: f64, light: &Light| weight * light.irradiance * light.share();
        let Some(reader) = &self.speckle else {
            return lit.map(|(_, weight, light, _)| value(weight, light)).sum();
        };
        let reader = reader.pixel(centre);
        let mut sum = 0.0;
        loop {
            let (mut columns, mut rows) = ([0.0; 4], [0.0; 4]);
            let (mut seen, mut values) = ([Seen::default(); 4], [0.0; 4]);
            let mut count = 0;
            for (off, weight, light, plane) in lit.by_ref().take(4) {
                (columns[count], rows[count]) = (off.x as f32, off.y as f32);
                (seen[count], values[count]) = (Seen::new(light, plane), value(weight, light));
                count += 1;
            }
            if count == 0 {
                return sum;
            }
            let speckle = reader.four(columns.into(), rows.into(), seen, count);
            let read = speckle.to_array().map(f64::from);
            let shares = values.iter().zip(read).take(count);
            sum += shares.map(|(value, speckle)| value * speckle).sum::<f64>();
        }
    }
}
