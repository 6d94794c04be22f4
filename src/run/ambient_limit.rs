//! Illuminance at which ambient light doubles the repeatability.

use super::simulation::Simulation;
use crate::camera::Sensor;
use crate::math::DVec2;
use crate::profile::{Flags, Peak};
use serde::Serialize;
use std::f64::consts::TAU;

/// Effect of ambient light on the sensor.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct AmbientLimit {
    /// Illuminance of the scene, lx.
    pub illuminance_lx: f64,
    /// Background of a pixel by this light, electrons.
    pub background_e: f64,
    /// Illuminance at which the noise of a row is twice the noise without ambient light, lx. The
    /// line has the median brightness on the part, at the centre of the image. `null` if the line
    /// saturates before, and under the conditions of `saturating_lx`.
    pub doubling_lx: Option<f64>,
    /// Illuminance at which line and background saturate the sensor, lx; 0 if the line alone does.
    /// `null` if the filter of the camera is not known, without sensor noise, and without light on
    /// the part.
    pub saturating_lx: Option<f64>,
}

impl AmbientLimit {
    /// Returns the limit for the median height of the line above black, counts.
    pub(crate) fn of(simulation: &Simulation, height: Option<f64>) -> AmbientLimit {
        let scene = &simulation.scene;
        let sensor = &scene.camera.sensor;
        let known = || {
            let per_lux = scene.ambient.e_per_s_per_lx.filter(|&e| e > 0.0)?;
            let height = height.filter(|&height| height > 0.0)?;
            sensor.noise?;
            let free = sensor.full_scale() - sensor.black_level_dn - height;
            let free_e_per_s = free.max(0.0) / sensor.gain_dn_per_e / (sensor.exposure_ms * 1e-3);
            Some((per_lux, height, free_e_per_s / per_lux))
        };
        let doubling = |(per_lux, height, saturating): (f64, f64, f64)| {
            let noise = |lx: f64| row_noise(simulation, height, lx * per_lux);
            let goal = 2.0 * noise(0.0)?;
            let (mut low, mut high) = (0.0, saturating);
            if noise(high)? < goal {
                return None;
            }
            for _ in 0..60 {
                let middle = (low + high) / 2.0;
                match noise(middle)? < goal {
                    true => low = middle,
                    false => high = middle,
                }
            }
            Some(high)
        };
        let known = known();
        AmbientLimit {
            illuminance_lx: scene.ambient.illuminance_lx,
            background_e: sensor.noise.map_or(0.0, |noise| sensor.ambient_e(&noise)),
            doubling_lx: known.and_then(doubling),
            saturating_lx: known.map(|(_, _, lx)| lx),
        }
    }
}

/// Returns the noise of a row of an ideal line under a background of `ambient_e_per_s`, px.
fn row_noise(simulation: &Simulation, height: f64, ambient_e_per_s: f64) -> Option<f64> {
    let camera = &simulation.scene.camera;
    let mut sensor: Sensor = camera.sensor.clone();
    sensor.noise.as_mut()?.ambient_e_per_s = ambient_e_per_s;
    let center = sensor.resolution.as_dvec2() / 2.0;
    let column = center.x.floor();
    let pixel = DVec2::new(column + 0.5, center.y);
    let sigma = (simulation.errors).measured(pixel, simulation.plan.line_half_width_px / 2.0);
    let peak = Peak {
        column: column as u32,
        row: pixel.y,
        intensity: height * sigma * TAU.sqrt(),
        height,
        sigma,
        noise: sensor.dark_variance_e().sqrt() * sensor.gain_dn_per_e,
        flags: Flags::empty(),
    };
    let columns = sensor.resolution.x as usize;
    let errors = simulation.errors.row_errors(&[peak], columns);
    errors.first().map(|error| error.noise)
}
