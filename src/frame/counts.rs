//! What the sensor makes of light.

use super::irradiance::Irradiance;
use crate::camera::{Counts, DarkCounts, Sensor};
use crate::math::rng::Key;

/// Tells the key of the groups of dark pixels from those of pixels: no sensor has
/// as many.
const DARK: u64 = u64::MAX;

/// A sensor under light of one wavelength.
pub struct Readout {
    sensor: Sensor,
    /// `None`: dark counts are all the same.
    dark: Option<DarkCounts>,
    electrons_per_irradiance: f64,
}

impl Readout {
    /// `wavelength` in mm.
    pub fn new(sensor: Sensor, wavelength: f64) -> Readout {
        Readout {
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
            None => Counts::filled(columns, rows, sensor.count(0.0, key)),
            Some(dark) => Counts::of_columns(dark.draw(columns * rows, key.with(DARK)), rows),
        };
        let counts = image.by_column_mut();
        for row in 0..rows {
            for (column, e) in irradiance.row(row).filter(|&(_, e)| e != 0.0) {
                let pixel = key.with((row * columns + column) as u64);
                let electrons = e as f64 * self.electrons_per_irradiance;
                counts[column * rows + row] = sensor.count(electrons, pixel);
            }
        }
        image
    }
}
