//! Reflectance of the part's surface.

use std::f64::consts::FRAC_1_PI;

/// Lambert's law: the same radiance in all directions.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lambert {
    /// Share of the received flux that is reflected, 0 to 1.
    pub reflectance: f64,
}

impl Lambert {
    /// Radiance (mW/mm²/sr) of a surface that receives `irradiance` (mW/mm²).
    pub fn radiance(&self, irradiance: f64) -> f64 {
        self.reflectance * FRAC_1_PI * irradiance
    }
}
