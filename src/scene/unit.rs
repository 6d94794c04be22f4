//! Units of length that mesh files are written in.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Unit {
    #[serde(rename = "um")]
    #[cfg_attr(feature = "cli", value(name = "um"))]
    Micrometre,
    #[serde(rename = "mm")]
    #[cfg_attr(feature = "cli", value(name = "mm"))]
    Millimetre,
    #[serde(rename = "cm")]
    #[cfg_attr(feature = "cli", value(name = "cm"))]
    Centimetre,
    #[serde(rename = "m")]
    #[cfg_attr(feature = "cli", value(name = "m"))]
    Metre,
    #[serde(rename = "inch")]
    Inch,
}

impl Unit {
    pub const ALL: [Unit; 5] = [
        Unit::Micrometre,
        Unit::Millimetre,
        Unit::Centimetre,
        Unit::Metre,
        Unit::Inch,
    ];

    /// Its length, mm.
    pub fn mm(self) -> f64 {
        match self {
            Unit::Micrometre => 1e-3,
            Unit::Millimetre => 1.0,
            Unit::Centimetre => 10.0,
            Unit::Metre => 1000.0,
            Unit::Inch => 25.4,
        }
    }
}

/// As scene files and command lines have it.
impl std::fmt::Display for Unit {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(match self {
            Unit::Micrometre => "um",
            Unit::Millimetre => "mm",
            Unit::Centimetre => "cm",
            Unit::Metre => "m",
            Unit::Inch => "inch",
        })
    }
}
