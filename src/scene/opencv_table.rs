//! Table of camera parameters in the conventions of OpenCV.

use super::arrays::array;
use schemars::JsonSchema;
use serde::Deserialize;

/// Camera parameters that OpenCV's `calibrateCamera` and `solvePnP` return, for the sensor without
/// region of interest and binning. They replace `focal_length_mm`, `principal_point_px`,
/// `distortion`, `position_mm`, `look_at_mm` and `column_axis`. The focal length follows from the
/// camera matrix, `pixel_pitch_um` and `focus_distance_mm`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OpenCvTable {
    /// Camera matrix `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]` in pixels. The centre of the first
    /// pixel has the coordinates (0, 0). Pixels are square: `fx` and `fy` differ by at most 0.1 px
    /// at the corners of the sensor.
    #[serde(deserialize_with = "matrix")]
    pub camera_matrix: [[f64; 3]; 3],
    /// Distortion coefficients `[k1, k2, p1, p2]` or `[k1, k2, p1, p2, k3]`. Default: no
    /// distortion.
    #[serde(default)]
    pub distortion_coefficients: Vec<f64>,
    /// Rotation vector of the transformation from the frame of the scan head to the frame of the
    /// camera, rad.
    #[serde(deserialize_with = "array")]
    pub rvec: [f64; 3],
    /// Translation of the transformation from the frame of the scan head to the frame of the
    /// camera.
    #[serde(deserialize_with = "array")]
    pub tvec_mm: [f64; 3],
}

fn matrix<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<[[f64; 3]; 3], D::Error> {
    let rows: [Vec<f64>; 3] = array(deserializer)?;
    let mut matrix = [[0.0; 3]; 3];
    for (row, values) in matrix.iter_mut().zip(rows) {
        let length = values.len();
        *row = values.try_into().map_err(|_| {
            serde::de::Error::invalid_length(length, &"three rows of three numbers")
        })?;
    }
    Ok(matrix)
}
