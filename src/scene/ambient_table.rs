//! `[ambient]`: light on the part that is not from the laser.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Ambient light on the part, from all directions. It adds a background with shot noise to all
/// pixels. Its spectrum is that of a black body, limited to the passband of `camera.filter_nm`. All
/// surfaces reflect it diffusely, with the mean reflectance of the part.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AmbientTable {
    /// Illuminance of the part, lx.
    pub illuminance_lx: f64,
    /// Colour temperature of the light. Default: 6504, daylight (CIE D65).
    #[serde(default = "daylight")]
    pub colour_temperature_k: f64,
}

/// Correlated colour temperature of CIE D65, K.
pub fn daylight() -> f64 {
    6504.0
}
