//! Conversion of irradiance to sensor counts.

use super::irradiance::Irradiance;
use crate::camera::{Counts, DarkNoiseTable, Noise, PixelPattern, Sensor, SparseImage};
use crate::math::rng::{Purpose, RngKey};
use std::ops::Range;
use std::sync::Arc;

/// Sensor model for light of one wavelength.
pub struct Readout {
    sensor: Sensor,
    /// Random key of the fixed pattern.
    patterns: RngKey,
    /// Table of dark counts; `None` if dark counts are sampled individually, like counts of lit
    /// pixels.
    dark: Option<Arc<DarkNoiseTable>>,
    electrons_per_irradiance: f64,
}

impl Readout {
    /// Prepares the sensor model. `wavelength` is in mm; `seed` is the random seed of the fixed
    /// pattern.
    pub fn new(sensor: Sensor, wavelength: f64, seed: u64) -> Readout {
        Readout {
            patterns: RngKey::new(seed, Purpose::FixedPattern),
            dark: DarkNoiseTable::new(&sensor).map(Arc::new),
            electrons_per_irradiance: sensor.electrons_per_irradiance(wavelength),
            sensor,
        }
    }

    /// Simulates the counts of every pixel: photoelectrons, noise, gain, black level, saturation
    /// and rounding.
    pub fn counts(&self, irradiance: &Irradiance, key: RngKey) -> Counts {
        self.near_light(irradiance, key).into_counts()
    }

    /// Simulates the counts near the light only. Other dark pixels get their positions on request.
    /// The noise of each lit pixel, and of dark pixels near them, depends on `key` and the pixel
    /// number.
    pub fn near_light(&self, irradiance: &Irradiance, key: RngKey) -> SparseImage {
        let (columns, rows) = (irradiance.columns(), irradiance.rows());
        let mut image = match &self.dark {
            Some(dark) => SparseImage::new(rows, &lit_rows(irradiance), dark.clone(), key),
            None => SparseImage::of_all(self.without_light(columns, rows, key), key),
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

    /// Simulates the counts of all pixels without light, each individually.
    fn without_light(&self, columns: usize, rows: usize, key: RngKey) -> Counts {
        let count = |i: usize| {
            let pixel = (i % rows * columns + i / rows) as u64;
            (self.sensor).count_of(&self.pattern(pixel), 0.0, key.with(pixel))
        };
        Counts::of_columns((0..columns * rows).map(count).collect(), rows)
    }
}

/// Returns row, column and irradiance of the lit pixels.
fn lit(irradiance: &Irradiance) -> impl Iterator<Item = (usize, usize, f32)> + '_ {
    let rows = (0..irradiance.rows()).flat_map(|row| {
        let columns = irradiance.row(row);
        columns.map(move |(column, e)| (row, column, e))
    });
    rows.filter(|&(.., e)| e != 0.0)
}

/// Returns the range from the first to the last lit row, for each column.
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
