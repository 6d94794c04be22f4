//! Point cloud.

use crate::math::DVec3;
use crate::profile::Flags;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Measured point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CloudPoint {
    /// Position in the part frame, mm.
    pub position: DVec3,
    /// Signed distance to the CAD surface, mm. It is positive outside the material. For meshes that
    /// are open or have inconsistent winding, it is positive on the side of the camera.
    pub deviation: f64,
    /// Standard uncertainty of the position, mm, along the motion of the viewing ray through the
    /// laser plane that a row error causes.
    pub u_position: f64,
    /// Repeatability standard deviation of the position, mm (VIM 2.21): the component of
    /// `u_position` without speckle and calibration.
    pub repeatability: f64,
    /// Correlation length of the errors along the profile, mm.
    ///
    /// The length is the column distance times n_c = Σ_k ρ_k, where ρ_k is the correlation of
    /// errors at a lag of k columns. The mean over a length L of the profile has a standard
    /// uncertainty of `u_position`·√(correlation_length/L), for L well above the correlation
    /// length.
    pub correlation_length: f64,
    /// Correlation length of the errors along the scan, mm.
    ///
    /// The length is the frame distance times Σ_k ρ_k, where ρ_k is the correlation of errors at a
    /// lag of k frames. The mean over a profile length L and a scan length S has a standard
    /// uncertainty of `u_position`·√(correlation_length/L · scan_correlation_length/S). L and S
    /// must be well above the correlation lengths. Errors of consecutive frames may be
    /// anticorrelated, which makes the length much smaller than the frame distance.
    pub scan_correlation_length: f64,
    /// Standard uncertainty of the deviation, mm: the component of `u_position` along the surface
    /// normal, and the chordal deviation stated in the scene.
    pub u_deviation: f64,
    /// Sum of the counts of the peak above background.
    pub intensity: f64,
    /// Frame number.
    pub frame: u32,
    /// Column of the image.
    pub column: u32,
    /// Row of the line in this column, px.
    pub row: f64,
    /// Standard deviation of the line, px.
    pub line_sigma_px: f64,
    /// Possible defects of the peak.
    pub flags: Flags,
    /// Unit normal of the CAD surface at the nearest position, on the side of the camera, part
    /// frame.
    pub normal: Vec3,
    /// Ground truth: fraction of direct light at the peak, 0 to 1. It is 1 where indirect light is
    /// not simulated. A line caused by indirect light has a low fraction.
    pub direct_fraction: f32,
}

impl CloudPoint {
    /// Returns whether the peak has no defect. A missing uncertainty (UNCERTAINTY_NOT_VALID) is not
    /// a defect.
    pub fn is_valid(&self) -> bool {
        self.flags.is_valid()
    }
}

/// Returns the index range of the points of a frame. `points` must be in the order of frames.
pub(crate) fn of_frame(points: &[CloudPoint], frame: u32) -> Range<usize> {
    let before = |frame: u32| points.partition_point(|point| point.frame < frame);
    before(frame)..before(frame + 1)
}
