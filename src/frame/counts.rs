//! What the sensor makes of light.

use super::irradiance::Irradiance;
use crate::camera::{Counts, DarkCounts, NearLight, Noise, PixelPattern, Sensor};
use crate::math::rng::{Key, Purpose};
use std::ops::Range;
use std::sync::Arc;

/// A sensor under light of one wavelength.
pub struct Readout {
    sensor: Sensor,
    /// Of how its pixels differ.
    patterns: Key,
    /// `None`: each dark count is drawn as those of lit pixels are.
    dark: Option<Arc<DarkCounts>>,
    electrons_per_irradiance: f64,
}

impl Readout {
    /// `wavelength` in mm; `seed` is that of the patterns of its pixels.
    pub fn new(sensor: Sensor, wavelength: f64, seed: u64) -> Readout {
        Readout {
            patterns: Key::new(seed, Purpose::FixedPattern),
            dark: DarkCounts::new(&sensor).map(Arc::new),
            electrons_per_irradiance: sensor.electrons_per_irradiance(wavelength),
            sensor,
        }
    }

    /// Counts of every pixel: electrons drawn from the light, noise, gain, black level,
    /// saturation and rounding.
    pub fn counts(&self, irradiance: &Irradiance, key: Key) -> Counts {
        self.near_light(irradiance, key).into_counts()
    }

    /// The same image, drawn near its light alone: dark pixels elsewhere have places where someone asks for
    /// them. Noise of lit pixels and of dark ones near them is each pixel's own, by `key` and its number.
    pub fn near_light(&self, irradiance: &Irradiance, key: Key) -> NearLight {
        let (columns, rows) = (irradiance.columns(), irradiance.rows());
        let mut image = match &self.dark {
            Some(dark) => NearLight::new(rows, &lit_rows(irradiance), dark.clone(), key),
            None => NearLight::of_all(self.without_light(columns, rows, key), key),
        };
        for (row, column, e) in lit(irradiance) {
            let pixel = (row * columns + column) as u64;
            let electrons = e as f64 * self.electrons_per_irradiance;
            let count = (self.sensor).count_of(&self.pattern(pixel), electrons, key.with(pixel));
            image.set(column, row, count);
        }
        image
    }

    fn pattern(&self, pixel: u64) -> PixelPattern {
        let pattern = |noise: &Noise| noise.pattern(self.patterns.with(pixel));
        let noise = self.sensor.noise.as_ref();
        noise.map_or(PixelPattern::MEAN, pattern)
    }

    /// Counts of all pixels without light, each drawn by itself.
    fn without_light(&self, columns: usize, rows: usize, key: Key) -> Counts {
        let count = |i: usize| {
            let pixel = (i % rows * columns + i / rows) as u64;
            (self.sensor).count_of(&self.pattern(pixel), 0.0, key.with(pixel))
        };
        Counts::of_columns((0..columns * rows).map(count).collect(), rows)
    }
}

/// Row, column and irradiance of the pixels with light.
fn lit(irradiance: &Irradiance) -> impl Iterator<Item = (usize, usize, f32)> + '_ {
    let rows = (0..irradiance.rows()).flat_map(|row| {
        let columns = irradiance.row(row);
        columns.map(move |(column, e)| (row, column, e))
    });
    rows.filter(|&(.., e)| e != 0.0)
}

/// From the first row with light to the last, of each column.
fn lit_rows(irradiance: &Irradiance) -> Vec<Range<usize>> {
    let mut spans: Vec<Range<usize>> = vec![0..0; irradiance.columns()];
    for (row, column, _) in lit(irradiance) {
        let span = &mut spans[column];
        if span.end == 0 {
            span.start = row;
        }
        span.end = row + 1;
    }
    spans
}
