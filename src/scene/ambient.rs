//! Ambient light of a scene as electrons of its camera.

use super::ambient_table::daylight;
use super::file::SceneFile;
use super::resolver::Resolver;
use crate::camera::{Camera, irradiance_per_lux};
use crate::error::Result;
use crate::surface::Materials;
use serde::Serialize;
use std::f64::consts::PI;

/// Ambient light on the part.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Ambient {
    /// Illuminance, lx.
    pub illuminance_lx: f64,
    /// Photoelectrons of a pixel per second and lux; `None` for a camera whose filter is not known.
    pub e_per_s_per_lx: Option<f64>,
}

impl Ambient {
    /// Returns whether the scene states neither ambient light nor a filter.
    pub fn is_unknown(&self) -> bool {
        self.e_per_s_per_lx.is_none()
    }
}

impl Resolver<'_> {
    /// Returns the ambient light, and adds it to the camera's background. Each pixel has the light
    /// of the pixel at the centre.
    ///
    /// A diffuse surface of reflectance ρ under the irradiance E has the radiance ρ·E/π.
    pub(super) fn ambient(
        &self,
        file: &SceneFile,
        surface: &Materials,
        triangles: usize,
        camera: &mut Camera,
    ) -> Result<Ambient> {
        let width = match file.camera.filter_nm {
            Some(width) => Some(self.within(width, "camera.filter_nm", [0.01, 1e4])?),
            None => None,
        };
        let table = file.ambient;
        if let Some(table) = &table {
            let key = "ambient.illuminance_lx";
            self.within(table.illuminance_lx, key, [0.0, 1e9])?;
            let key = "ambient.colour_temperature_k";
            self.within(table.colour_temperature_k, key, [500.0, 1e5])?;
            self.check(
                width.is_some(),
                "camera.filter_nm",
                "the width of the filter's passband with [ambient]",
            )?;
            let expected = "read_noise_e with [ambient], 0 if there is none: without that key \
                            counts have no noise";
            self.check(file.camera.read_noise_e.is_some(), "ambient", expected)?;
        }
        let Some(width) = width else {
            return Ok(Ambient::default());
        };
        let temperature = table.map_or(daylight(), |table| table.colour_temperature_k);
        let counts = surface.counts(triangles);
        let kinds = surface.kinds().iter().zip(counts);
        let reflectance = kinds
            .map(|(kind, count)| kind.surface.mean_reflectance() * count as f64)
            .sum::<f64>()
            / triangles as f64;
        let center = camera.sensor.resolution.as_dvec2() / 2.0;
        let per_lux = irradiance_per_lux(temperature, file.laser.wavelength_nm, width);
        let on_pixel = reflectance * per_lux / PI * camera.pupil_solid_angle(center);
        let wavelength = file.laser.wavelength_nm * 1e-6;
        let exposure_s = camera.sensor.exposure_ms * 1e-3;
        let e_per_s_per_lx =
            on_pixel * camera.sensor.electrons_per_irradiance(wavelength) / exposure_s;
        let illuminance_lx = table.map_or(0.0, |table| table.illuminance_lx);
        if let Some(noise) = &mut camera.sensor.noise {
            noise.ambient_e_per_s = illuminance_lx * e_per_s_per_lx;
        }
        Ok(Ambient {
            illuminance_lx,
            e_per_s_per_lx: Some(e_per_s_per_lx),
        })
    }
}
