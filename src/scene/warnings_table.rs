//! `[warnings]`: thresholds of the assessment in `check`, `scan`, `sweep`, `view` and the service.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Thresholds of the warnings that `check`, `scan`, `sweep`, `view` and the service issue.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WarningsTable {
    /// Fraction of light that may be lost to a single cause: too near, too far, occluded, too dark,
    /// saturated or out of focus. It refers to the light on surface that the camera could see.
    /// Default: 0.05.
    pub lost_fraction: f64,
    /// Fraction of the surface that may lack valid points. It applies to the surface in the field
    /// of view along the path, for all causes together. It also applies to the measurable surface
    /// where the field of view passes outside the part. Default: 0.05.
    pub unmeasured_fraction: f64,
    /// Fraction of the light that may fall on surface that the camera cannot see in any orientation
    /// of the path. The surface either faces away or is occluded by the part. Default: 0.5.
    pub hidden_fraction: f64,
    /// Fraction of the frames that may contain no image of the part. Default: 0.5.
    pub empty_frames_fraction: f64,
    /// Duration of the path at its frame rate, and duration of its simulation, in hours. Default:
    /// 8.
    pub duration_h: f64,
    /// Distance between neighbouring passes, in widths of the field of view at the part. Default:
    /// 0.95.
    pub pass_spacing: f64,
    /// Width of the line in the image relative to the line width at best focus. Light above it
    /// counts as out of focus. Default: 1.5.
    pub blur: f64,
    /// Minimum displacement between frames, in column spacings. Default: 0.03.
    pub least_step: f64,
}

impl Default for WarningsTable {
    fn default() -> WarningsTable {
        WarningsTable {
            lost_fraction: 0.05,
            unmeasured_fraction: 0.05,
            hidden_fraction: 0.5,
            empty_frames_fraction: 0.5,
            duration_h: 8.0,
            pass_spacing: 0.95,
            blur: 1.5,
            // A path in metres that is read as millimetres has steps that are 1000 times too short.
            // The threshold is the geometric mean of such a step and one column, 1/√1000.
            least_step: 0.03,
        }
    }
}
