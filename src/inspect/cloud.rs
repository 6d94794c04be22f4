//! The point cloud.

use crate::math::DVec3;
use crate::profile::Flags;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// One measured point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CloudPoint {
    /// Part frame, mm.
    pub position: DVec3,
    /// Signed distance to the CAD surface, mm; positive outside the material, and on the
    /// camera's side of a mesh that is open or wound both ways.
    pub deviation: f64,
    /// Standard uncertainty of the position, mm: along the camera's ray's way
    /// through the laser plane, where an error of the row moves it.
    pub sigma: f64,
    /// Standard deviation of the position, mm, if the same place is measured again and nothing moves
    /// ("repeatability" in data sheets): the part of `sigma` without speckle and calibration.
    pub repeatability: f64,
    /// Length along the profile within which errors are alike, mm: the columns' distance times n_c = Σ_k ρ_k, ρ_k
    /// the correlation of errors k columns apart. The mean over a length L of the profile has a standard uncertainty
    /// of `sigma`·√(correlation_length/L), for L well above it.
    pub correlation_length: f64,
    /// Length along the scan within which errors are alike, mm: the distance of frames times Σ_k ρ_k, with ρ_k the correlation
    /// of errors at a lag of k frames. The mean over a length L of profiles and a way S of the scan has a standard
    /// uncertainty of `sigma`·√(correlation_length/L · scan_correlation_length/S), for L and S well above them. Errors of
    /// neighbouring frames may differ in sign, which makes the length far smaller than the distance of frames.
    pub scan_correlation_length: f64,
    /// Standard uncertainty of the deviation, mm: the part of `sigma` that lies
    /// along the surface's normal, and what the scene says of its triangles' chord.
    pub deviation_sigma: f64,
    /// Counts above background in the peak.
    pub intensity: f64,
    /// Number of the frame it was measured in.
    pub frame: u32,
    /// Column of the image it was found in.
    pub column: u32,
    /// Row of the line in that column, px.
    pub row: f64,
    /// Standard deviation of the line's width there, px.
    pub width: f64,
    /// What is doubtful about its peak.
    pub flags: Flags,
    /// Unit normal of the CAD at the place nearest to the point, on the camera's side, part frame.
    pub normal: Vec3,
    /// Truth, which no measurement has: the share of the light about its peak that was reflected once, 0 to 1; 1 where
    /// light reflected more than once is not modelled. A reflection has little of it.
    pub direct: f32,
}

impl CloudPoint {
    /// Whether nothing is doubtful about its peak. That its uncertainty is not
    /// stated (OUTSIDE) does not make it so.
    pub fn is_valid(&self) -> bool {
        self.flags.is_valid()
    }
}

/// Where the points of a frame are among those of a scan, which are in the order of frames.
pub(super) fn of_frame(points: &[CloudPoint], frame: u32) -> Range<usize> {
    let before = |frame: u32| points.partition_point(|point| point.frame < frame);
    before(frame)..before(frame + 1)
}
