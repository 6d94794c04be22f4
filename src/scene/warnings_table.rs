//! `[warnings]`: the limits of the assessment that `check`, `scan`, `sweep`, `view` and the service share.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Limits of the warnings that `check`, `scan`, `sweep`, `view` and the service give.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WarningsTable {
    /// Fraction of the light on surface that the camera could see that may be lost to one cause: too near, too far,
    /// occluded, too dark, saturated, out of focus. Default: 0.05.
    pub lost_fraction: f64,
    /// Fraction of the surface that may be without valid points: of the surface in the field along the path by all
    /// causes together, and of the measurable surface where the field passes outside the part. Default: 0.05.
    pub unmeasured_fraction: f64,
    /// Fraction of the light that may fall on surface that the camera cannot see in any orientation of the path,
    /// because it faces away or the part hides it. Default: 0.5.
    pub hidden_fraction: f64,
    /// Fraction of the frames that may see nothing of the part. Default: 0.5.
    pub empty_frames_fraction: f64,
    /// Duration of the path at its frame rate, and of its simulation, in hours. Default: 8.
    pub duration_h: f64,
    /// Distance between neighbouring passes, in widths of the field at the part. Default: 0.95.
    pub pass_spacing: f64,
    /// Width of the line in the image, in widths of the line at the best focus. Light beyond is out of focus.
    /// Default: 1.5.
    pub blur: f64,
    /// Least step from frame to frame, in distances between columns. Default: 0.03.
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
            // A path in metres read as millimetres has steps a thousandth as long. On a scale of ratios this is half
            // way between that and a step of one column, 1/√1000.
            least_step: 0.03,
        }
    }
}
