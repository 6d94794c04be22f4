//! Units of length of mesh files.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Unit of length of a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Unit {
    /// 0.001 mm.
    #[serde(rename = "um")]
    #[cfg_attr(feature = "cli", value(name = "um"))]
    Micrometre,
    /// 1 mm.
    #[serde(rename = "mm")]
    #[cfg_attr(feature = "cli", value(name = "mm"))]
    Millimetre,
    /// 10 mm.
    #[serde(rename = "cm")]
    #[cfg_attr(feature = "cli", value(name = "cm"))]
    Centimetre,
    /// 1000 mm.
    #[serde(rename = "m")]
    #[cfg_attr(feature = "cli", value(name = "m"))]
    Metre,
    /// 25.4 mm.
    #[serde(rename = "inch")]
    Inch,
}

impl Unit {
    /// All units: the metric ones by ascending length, then the inch.
    pub const ALL: [Unit; 5] = [
        Unit::Micrometre,
        Unit::Millimetre,
        Unit::Centimetre,
        Unit::Metre,
        Unit::Inch,
    ];

    /// Returns the length of the unit, mm.
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

/// Spelling in scene files and on the command line.
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
