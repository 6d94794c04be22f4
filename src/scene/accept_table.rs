//! The acceptance test of a sensor, as its file or a scene has it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Artefacts, counts and limits of the acceptance test that `lasertrace accept` predicts. What is left out follows
/// from the measuring volume.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AcceptTable {
    /// Way of the scans: the third side of the measuring volume. Default: as long as the volume is wide.
    pub travel_mm: Option<f64>,
    /// Diameter of the spheres. Default: 0.15 of the volume's diagonal, or less where the range is short.
    pub sphere_mm: Option<f64>,
    /// Between the centres of the two spheres of a ball bar. Default: 0.9 of the most that fits.
    pub spacing_mm: Option<f64>,
    /// Side of the square plate. Default: 0.8 of the volume's width or length.
    pub plate_mm: Option<f64>,
    /// Tilt of the plate in two of its five places. Default: 20, or less where the range is short.
    pub plate_tilt_deg: Option<f64>,
    /// Half angle of the cap that is measured of a sphere, about its top. Default: 45.
    pub cap_deg: Option<f64>,
    /// Profiles across a sphere's cap and across a plate. Default: 25.
    pub profiles: Option<u32>,
    /// Heights over the measuring range for linearity and repeatability. Default: 11.
    pub heights: Option<u32>,
    /// Times that each height is measured for repeatability. Default: 10.
    pub repeats: Option<u32>,
    /// Share of the points that flatness leaves out. Default: 0.3.
    pub left_out_percent: Option<f64>,
    /// Expanded uncertainty (k = 2) of the artefacts' calibrated values: the guard band. Default: 1.
    pub artefact_um: Option<f64>,
    /// Largest permissible values. Default of each: a thousandth of the measuring range, of
    /// repeatability a tenth of that.
    pub limits_um: LimitsTable,
}

/// Largest permissible values of an acceptance test.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsTable {
    /// P_F of 25 representative points.
    pub probing_form: Option<f64>,
    /// P_F as the smallest shell that holds 95 % of all points.
    pub probing_form_d95: Option<f64>,
    /// P_S, of either sign.
    pub probing_size: Option<f64>,
    /// SD, of either sign.
    pub sphere_spacing: Option<f64>,
    /// F.
    pub flatness: Option<f64>,
    /// Indicated minus true height, of either sign.
    pub linearity: Option<f64>,
    /// Standard deviation of a height that is measured again.
    pub z_repeatability: Option<f64>,
}
