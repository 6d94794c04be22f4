//! What the sensor makes of light.

use super::irradiance::Irradiance;
use crate::camera::{Counts, DarkCounts, Noise, PixelPattern, Sensor};
use crate::math::rng::{Key, Purpose};

/// Tells the key of the groups of dark pixels from those of pixels: no sensor has
/// as many.
const DARK: u64 = u64::MAX;

/// A sensor under light of one wavelength.
pub struct Readout {
    sensor: Sensor,
    /// Of how its pixels differ.
    patterns: Key,
    /// `None`: dark counts are all the same, or each is drawn as those of lit pixels are.
    dark: Option<DarkCounts>,
    electrons_per_irradiance: f64,
}

impl Readout {
    /// `wavelength` in mm; `seed` is that of the patterns of its pixels.
    pub fn new(sensor: Sensor, wavelength: f64, seed: u64) -> Readout {
        Readout {
            patterns: Key::new(seed, Purpose::FixedPattern),
            dark: DarkCounts::new(&sensor),
            electrons_per_irradiance: sensor.electrons_per_irradiance(wavelength),
            sensor,
        }
    }

    /// Counts of every pixel: electrons drawn from the light, noise, gain, black level,
    /// saturation and rounding. Each pixel's noise is its own, by `key` and its number.
    pub fn counts(&self, irradiance: &Irradiance, key: Key) -> Counts {
        let sensor = &self.sensor;
        let (columns, rows) = (irradiance.columns(), irradiance.rows());
        let mut image = match &self.dark {
            None => self.without_light(columns, rows, key),
            Some(dark) => Counts::of_columns(dark.draw(columns * rows, key.with(DARK)), rows),
        };
        let counts = image.by_column_mut();
        for row in 0..rows {
            for (column, e) in irradiance.row(row).filter(|&(_, e)| e != 0.0) {
                let pixel = (row * columns + column) as u64;
                let electrons = e as f64 * self.electrons_per_irradiance;
                let pattern = self.pattern(pixel);
                counts[column * rows + row] = sensor.count_of(&pattern, electrons, key.with(pixel));
            }
        }
        image
    }

    fn pattern(&self, pixel: u64) -> PixelPattern {
        let pattern = |noise: &Noise| noise.pattern(self.patterns.with(pixel));
        let noise = self.sensor.noise.as_ref();
        noise.map_or(PixelPattern::MEAN, pattern)
    }

    /// Counts of all pixels where no table has those without light.
    fn without_light(&self, columns: usize, rows: usize, key: Key) -> Counts {
        let sensor = &self.sensor;
        if !sensor.noise.is_some_and(|noise| noise.adds_to_dark()) {
            return Counts::filled(columns, rows, sensor.count(0.0, key));
        }
        let count = |i: usize| {
            let pixel = (i % rows * columns + i / rows) as u64;
            sensor.count_of(&self.pattern(pixel), 0.0, key.with(pixel))
        };
        Counts::of_columns((0..columns * rows).map(count).collect(), rows)
    }
}
