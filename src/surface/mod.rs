//! How the part's surface turns light that arrives into light that leaves.

use crate::math::DVec3;
use std::f64::consts::FRAC_1_PI;

/// Lambert's law: the same radiance in all directions.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lambert {
    /// Share of the received flux that is reflected, 0 to 1.
    pub reflectance: f64,
}

impl Lambert {
    /// Radiance towards the eye per irradiance received from the light (1/sr), of a surface
    /// with this normal; unit vectors, away from the surface. Here it is ρ/π (Lambert 1760).
    #[inline(always)]
    pub fn bsdf(&self, _normal: DVec3, _towards_light: DVec3, _towards_eye: DVec3) -> f64 {
        self.reflectance * FRAC_1_PI
    }

    /// Greatest angle (rad) between two directions for which [`Self::bsdf`] may be taken as the
    /// same.
    #[inline(always)]
    pub fn constant_cone(&self) -> f64 {
        f64::INFINITY
    }
}
