//! `[systematic]` and `[scan.systematic]`: errors of sensor and stage that an average does not
//! remove.

use super::arrays::array;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Systematic errors of the sensor. Each error has a normal distribution and one value per run,
/// which follows from the seed. The simulated sensor has the errors, and the measurement does not
/// know them. They enter all stated uncertainties. Default of every key: no error.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SystematicTable {
    /// Standard deviation of the temperature relative to the calibration, in kelvin. It multiplies
    /// `per_kelvin` of the errors.
    pub temperature_k: f64,
    /// Rotation of the laser about the direction of the line, which shifts the laser plane.
    pub laser_pointing_urad: Option<DriftTable>,
    /// Rotation of the laser about its beam axis, which tilts the laser plane.
    pub laser_rotation_urad: Option<DriftTable>,
    /// Rotation of the camera about each axis of the camera frame.
    pub camera_rotation_urad: Option<DriftTable>,
    /// Displacement of the camera along each axis of the camera frame.
    pub camera_position_um: Option<DriftTable>,
    /// Displacement of the head along its z axis, towards the laser.
    pub height_um: Option<DriftTable>,
    /// Relative change of the focal length of the lens, with a constant focus distance.
    pub focal_length_percent: Option<ConstantErrorTable>,
    /// Relative change of the laser power. It changes noise and saturation, but shifts no point.
    pub laser_power_percent: Option<ConstantErrorTable>,
    /// Straightness of the laser line: angle between the rays of the fan and the laser plane.
    pub line_straightness_urad: Option<StraightnessTable>,
    /// Standard deviation of the bow of the laser line: angle between the rays at both ends of the
    /// fan and the laser plane. The angle increases with the square of the fan angle.
    pub line_bow_urad: f64,
    /// Residual calibration error: displacement of the points along the motion that an error of the
    /// row causes.
    pub residual_um: Option<ResidualTable>,
    /// Vibration of the head along its z axis.
    pub vibration_um: Option<VibrationTable>,
}

/// Error that is constant or changes slowly.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DriftTable {
    /// Standard deviation at the temperature of the calibration. Default: 0.
    pub standard_deviation: f64,
    /// Standard deviation per kelvin. Default: 0.
    pub per_kelvin: f64,
    /// Correlation time L in seconds: errors at an interval t have the correlation exp(−(t/L)²).
    /// Without `scan.frame_rate_hz`, frames follow at the highest rate of the sensor. Default: the
    /// error is constant.
    pub correlation_time_s: Option<f64>,
}

/// Error that is constant.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ConstantErrorTable {
    /// Standard deviation at the temperature of the calibration. Default: 0.
    pub standard_deviation: f64,
    /// Standard deviation per kelvin. Default: 0.
    pub per_kelvin: f64,
}

/// Error that changes smoothly along the laser line.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StraightnessTable {
    pub standard_deviation: f64,
    /// Correlation length L of the fan angle: rays at an angle a have the correlation exp(−(a/L)²).
    pub correlation_deg: f64,
}

/// Smooth field over the laser plane.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResidualTable {
    pub standard_deviation: f64,
    /// Correlation length L along the line: points at a distance d have the correlation
    /// exp(−(d/L)²).
    pub correlation_x_mm: f64,
    /// Correlation length along the beam.
    pub correlation_z_mm: f64,
}

/// Sinusoidal motion with random phase.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct VibrationTable {
    /// Standard deviation (root mean square) of the displacement, 0.71 of the amplitude.
    pub standard_deviation: f64,
    pub frequency_hz: f64,
}

/// Systematic errors of the stage, with the distribution of the errors of the sensor. The axes are
/// the direction of travel (roll), the horizontal axis (pitch) and the vertical axis (yaw). The
/// vertical axis is the head's z axis without its component along the travel. Default of every key:
/// no error.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StageErrorsTable {
    /// Point of the carriage about which it rotates, in the frame of the moving body (head or part)
    /// at rest. Default: the origin of the frame.
    #[serde(deserialize_with = "array")]
    pub pivot_mm: [f64; 3],
    /// Standard deviation of the relative error of all steps, in parts per million of the travel.
    pub step_ppm: f64,
    /// Position error of the encoder along the travel.
    pub encoder_um: Option<StageErrorTable>,
    /// Displacement along each of the two axes perpendicular to the travel.
    pub straightness_um: Option<StageErrorTable>,
    /// Rotation about the horizontal axis.
    pub pitch_urad: Option<StageErrorTable>,
    /// Rotation about the vertical axis.
    pub yaw_urad: Option<StageErrorTable>,
    /// Rotation about the direction of travel.
    pub roll_urad: Option<StageErrorTable>,
}

/// Error along the travel.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StageErrorTable {
    pub standard_deviation: f64,
    /// Correlation length L: errors at a distance d along the travel have the correlation
    /// exp(−(d/L)²). Default: the error is constant.
    pub correlation_length_mm: Option<f64>,
}
