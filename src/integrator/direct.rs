//! Light that goes laser → surface → camera, pixel by pixel: camera ray, closest
//! hit, laser light there, shadow ray to the aperture point it came from, Lambert
//! reflection, pupil solid angle; and over the samples of a pixel the laser's
//! profile and the speckle.

use super::footprint::footprint;
use super::lit::{Center, LitRays};
use super::pixels::Pixels;
use super::sight::Sight;
use super::speckle::{Reader, Speckle};
use crate::accel::{Accel, Clusters, WIDTH};
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

/// Irradiance on the sensor averaged over each pixel, mW/mm², row by row.
/// The same bytes for any number of threads: pixels are summed one by one, each
/// in a fixed order. Takes every pixel; [`footprint_image`] gives the same.
pub fn irradiance_image(view: &View) -> Vec<f32> {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, &Pixels::all(view.camera.sensor.resolution))
}

/// The bytes of [`irradiance_image`], for which only those pixels are taken that
/// may see lit surface; `clusters` are those of the view's mesh.
pub fn footprint_image(view: &View, clusters: &Clusters) -> Vec<f32> {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    trace(view, &sight, &footprint(view, &sight, clusters))
}

/// Rows of a task: enough that two more at its ends cost little, and few enough
/// that there are some to share out.
const ROWS_PER_TASK: usize = 32;

/// The image of the light that these pixels see.
fn trace(view: &View, sight: &Sight, pixels: &Pixels) -> Vec<f32> {
    let columns = pixels.columns;
    let frame = Frame {
        lit: LitRays::new(view, sight),
        pixels,
        side: view.samples_per_side as usize,
        speckle: view
            .speckle
            .map(|speckle| Reader::new(&speckle, view.camera, pixels)),
    };
    let mut image = vec![0.0f32; columns * pixels.rows];
    image
        .par_chunks_mut(columns * ROWS_PER_TASK)
        .enumerate()
        .for_each(|(task, image)| frame.render(task * ROWS_PER_TASK, image));
    image
}

/// A view with what its pixels share computed once.
struct Frame<'a> {
    lit: LitRays<'a>,
    pixels: &'a Pixels,
    /// Samples along each side of a pixel.
    side: usize,
    speckle: Option<Reader<'a>>,
}

/// Rows of centres at hand: those of a pixel and of its neighbours.
const WINDOW: usize = 3;

/// What the centres of some rows see; of row r at r modulo [`WINDOW`].
type Window = [Vec<Center>; WINDOW];

impl Frame<'_> {
    /// Sets the pixels of the rows from `first` on.
    fn render(&self, first: usize, image: &mut [f32]) {
        let rows = first..first + image.len() / self.pixels.columns;
        if !self.pixels.any(rows.clone()) {
            return;
        }
        // How far around a pixel centres matter to it.
        let around = match (self.lit.view.sampling, self.side) {
            (_, 1) => 0,
            (Sampling::Planes, _) => 1,
            (Sampling::Rays, _) => {
                self.each(rows, image, |column, row| self.sampled(column, row));
                return;
            }
        };
        let mut window: Window =
            std::array::from_fn(|_| vec![Center::Nothing; self.pixels.columns]);
        let trace = |row: usize, window: &mut Window| {
            for first in self.pixels.blocks(row, around) {
                self.lit
                    .centers(row, first, &mut window[row % WINDOW][first..]);
            }
        };
        let mut next = first.saturating_sub(around);
        for row in rows {
            while next <= row + around && next < self.pixels.rows {
                trace(next, &mut window);
                next += 1;
            }
            let image = &mut image[(row - first) * self.pixels.columns..];
            self.each(row..row + 1, image, |column, row| {
                self.pixel(column, row, around, &window)
            });
        }
    }

    /// Sets the pixels of `rows`.
    fn each(
        &self,
        rows: std::ops::Range<usize>,
        image: &mut [f32],
        light: impl Fn(usize, usize) -> f64,
    ) {
        for (i, row) in rows.enumerate() {
            for column in self.pixels.of(row) {
                image[i * self.pixels.columns + column] = light(column, row) as f32;
            }
        }
    }

    /// Mean irradiance of a pixel.
    fn pixel(&self, column: usize, row: usize, around: usize, window: &Window) -> f64 {
        let here = &window[row % WINDOW][column];
        if around > 0 {
            let columns = column.saturating_sub(1)..=(column + 1).min(self.pixels.columns - 1);
            let mut rows = row.saturating_sub(1)..=(row + 1).min(self.pixels.rows - 1);
            let like = |row: usize| {
                let row = &window[row % WINDOW][columns.clone()];
                row.iter().all(|center| here.is_like(center))
            };
            if !rows.all(like) {
                return self.sampled(column, row);
            }
        }
        match here {
            Center::Lit(light, plane) => {
                let samples =
                    self.samples(column, row, &self.lit.from_laser)
                        .map(|(place, to_sensor)| {
                            light.share_at(plane, to_sensor, &self.lit)
                                * self.speckle(place, light.depth)
                        });
                light.irradiance * samples.sum::<f64>() / (self.side * self.side) as f64
            }
            _ => 0.0,
        }
    }

    /// Places of a pixel's samples on the sensor, and from the eye towards what they
    /// see, any length.
    fn samples<'a>(
        &self,
        column: usize,
        row: usize,
        sight: &'a Sight,
    ) -> impl Iterator<Item = (DVec2, DVec3)> + use<'a> {
        let side = self.side;
        let corner = DVec2::new(column as f64, row as f64);
        let mut bend = DVec2::ZERO;
        (0..side * side).map(move |i| {
            let place = DVec2::new((i % side) as f64 + 0.5, (i / side) as f64 + 0.5);
            let place = corner + place / side as f64;
            (place, sight.towards(sight.to_sensor(place), &mut bend))
        })
    }

    /// Mean irradiance of a pixel by a ray for each sample.
    fn sampled(&self, column: usize, row: usize) -> f64 {
        let mut sum = 0.0;
        let mut samples = self.samples(column, row, self.lit.sight);
        loop {
            let mut places = [DVec2::ZERO; WIDTH];
            let mut directions = [DVec3::Z; WIDTH];
            let mut count = 0;
            for (place, to_sensor) in samples.by_ref().take(WIDTH) {
                places[count] = place;
                directions[count] = to_sensor.normalize();
                count += 1;
            }
            if count == 0 {
                break;
            }
            let mut centers = [const { Center::Nothing }; WIDTH];
            let places = &places[..count];
            self.lit.look(places, &directions[..count], &mut centers);
            for (&place, center) in places.iter().zip(&centers) {
                if let Center::Lit(light, _) = center {
                    let share = light.share * self.speckle(place, light.depth);
                    sum += light.irradiance * share;
                }
            }
        }
        sum / (self.side * self.side) as f64
    }

    #[inline(always)]
    fn speckle(&self, place: DVec2, depth: f64) -> f64 {
        let reader = self.speckle.as_ref();
        reader.map_or(1.0, |reader| reader.intensity(place, depth))
    }
}
