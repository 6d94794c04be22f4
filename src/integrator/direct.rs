//! Light that goes laser → surface → camera, pixel by pixel: camera ray, closest
//! hit, laser light there, shadow ray to the aperture point it came from, Lambert
//! reflection, pupil solid angle; and over the samples of a pixel the laser's
//! profile and the speckle.

use super::footprint::footprint;
use super::irradiance::Irradiance;
use super::lit::{Center, LitRays};
use super::pixels::Pixels;
use super::samples::Grid;
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

/// Rows of a task: enough that two more at its ends cost little, and few enough
/// that there are some to share out.
const ROWS_PER_TASK: usize = 32;

/// The light that these pixels see.
fn trace(view: &View, sight: &Sight, pixels: Pixels) -> Irradiance {
    let frame = Frame {
        lit: LitRays::new(view, sight),
        pixels: &pixels,
        grid: Grid::new(view.samples_per_side as usize),
        speckle: view
            .speckle
            .map(|speckle| Reader::new(&speckle, view.camera)),
    };
    let tasks = (0..pixels.rows).into_par_iter().step_by(ROWS_PER_TASK);
    let window = || std::array::from_fn(|_| vec![Center::Nothing; pixels.columns]);
    let values: Vec<Vec<f32>> = tasks
        .map_init(window, |window, first| frame.render(first, window))
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

/// Rows of centres at hand: those of a pixel and of its neighbours.
const WINDOW: usize = 3;

/// What the centres of some rows see; of row r at r modulo [`WINDOW`].
type Window = [Vec<Center>; WINDOW];

impl Frame<'_> {
    /// Irradiance (mW/mm²) of the pixels of the rows from `first` on.
    fn render(&self, first: usize, window: &mut Window) -> Vec<f32> {
        let rows = first..(first + ROWS_PER_TASK).min(self.pixels.rows);
        let mut values = Vec::with_capacity(rows.clone().map(|row| self.pixels.count(row)).sum());
        if values.capacity() == 0 {
            return values;
        }
        // How far around a pixel centres matter to it.
        let around = match (self.lit.view.sampling, self.grid.count()) {
            (_, 1) => 0,
            (Sampling::Planes, _) => 1,
            (Sampling::Rays, _) => {
                let pixels = rows.flat_map(|row| self.pixels.of(row).map(move |c| (c, row)));
                values.extend(pixels.map(|(column, row)| self.sampled(column, row) as f32));
                return values;
            }
        };
        let trace = |row: usize, window: &mut Window| {
            for first in self.pixels.blocks(row, around) {
                self.lit
                    .centers(row, first, &mut window[row % WINDOW][first..]);
            }
        };
        let mut next = first.saturating_sub(around);
        for row in rows {
            while next <= row + around && next < self.pixels.rows {
                trace(next, window);
                next += 1;
            }
            let columns = self.pixels.of(row);
            values.extend(columns.map(|column| self.pixel(column, row, around, window) as f32));
        }
        values
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
                let centre = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                let speckle = self.speckle.as_ref();
                light.irradiance * self.grid.mean(centre, light, plane, &self.lit, speckle)
            }
            _ => 0.0,
        }
    }

    /// Mean irradiance of a pixel by a ray for each sample.
    fn sampled(&self, column: usize, row: usize) -> f64 {
        let sight = self.lit.sight;
        let mut bend = DVec2::ZERO;
        let mut sum = 0.0;
        let mut samples = self.grid.places(column, row);
        loop {
            let mut places = [DVec2::ZERO; WIDTH];
            let mut directions = [DVec3::Z; WIDTH];
            let mut count = 0;
            for place in samples.by_ref().take(WIDTH) {
                places[count] = place;
                let towards = sight.towards(sight.to_sensor(place), &mut bend);
                directions[count] = towards.normalize();
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
                    let reader = self.speckle.as_ref();
                    let speckle = reader.map_or(1.0, |reader| reader.intensity(place, light.depth));
                    sum += light.irradiance * light.share * speckle;
                }
            }
        }
        sum / self.grid.count() as f64
    }
}
