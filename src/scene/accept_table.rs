//! `[accept]`: acceptance test of a sensor, in a sensor file or a scene.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Artefacts, counts and limits of the acceptance test that `lasertrace accept` predicts. Defaults
/// are derived from the measuring volume.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AcceptTable {
    /// Travel of the scans, the third side of the measuring volume. Default: width of the volume.
    pub travel_mm: Option<f64>,
    /// Diameter of the spheres. Default: 0.15 of the volume's diagonal, or less for a short range.
    pub sphere_diameter_mm: Option<f64>,
    /// Distance between the centres of the two spheres of a ball bar. Default: 0.9 of the largest
    /// distance that fits.
    pub ball_bar_length_mm: Option<f64>,
    /// Side length of the square plate. Default: 0.8 of the volume's width or length.
    pub plate_side_mm: Option<f64>,
    /// Tilt of the plate in two of its five positions. Default: 20, or less for a short range.
    pub plate_tilt_deg: Option<f64>,
    /// Half angle of the measured spherical cap about the top of the sphere. Default: 45.
    pub cap_half_angle_deg: Option<f64>,
    /// Number of profiles across a spherical cap and across a plate. Default: 25.
    pub profiles: Option<u32>,
    /// Number of heights over the measuring range for linearity and repeatability. Default: 11.
    pub height_steps: Option<u32>,
    /// Number of measurements per height for repeatability. Default: 10.
    pub repeats: Option<u32>,
    /// Percentage of the points that flatness excludes. Default: 0.3.
    pub excluded_percent: Option<f64>,
    /// Expanded uncertainty (k = 2) of the calibrated values of the artefacts; it is the guard
    /// band. Default: 1.
    pub artefact_expanded_uncertainty_um: Option<f64>,
    /// Maximum permissible errors (MPE). A characteristic without one has no verdict.
    pub mpe_um: LimitsTable,
}

/// Maximum permissible errors (MPE) of an acceptance test.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsTable {
    /// Probing form error P_F of 25 representative points.
    pub probing_form: Option<f64>,
    /// Probing form error P_F, as the thickness of the thinnest shell that contains 95 % of all
    /// points.
    pub probing_form_d95: Option<f64>,
    /// Magnitude of the probing size error P_S.
    pub probing_size: Option<f64>,
    /// Magnitude of the sphere-spacing error SD.
    pub sphere_spacing: Option<f64>,
    /// Flatness form error F.
    pub flatness: Option<f64>,
    /// Magnitude of indicated minus true height.
    pub linearity: Option<f64>,
    /// Standard deviation of repeated measurements of a height.
    pub z_repeatability: Option<f64>,
}
