//! The point cloud.

use crate::math::DVec3;
use crate::profile::Flags;
use serde::{Deserialize, Serialize};
use std::io::{self, Write};

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
    /// Standard uncertainty of the deviation, mm: the part of `sigma` that lies
    /// along the surface's normal.
    pub deviation_sigma: f64,
    /// Counts above background in the peak.
    pub intensity: f64,
    pub frame: u32,
    pub column: u32,
    /// What is doubtful about its peak.
    pub flags: Flags,
}

impl CloudPoint {
    /// Whether nothing is doubtful about its peak. That its uncertainty is not
    /// stated (OUTSIDE) does not make it so.
    pub fn is_sound(&self) -> bool {
        self.flags.is_sound()
    }
}

/// Writes a binary PLY: x, y, z (double, mm, part frame), deviation, sigma
/// and deviation_sigma (float, mm), intensity (float, counts), frame and column (uint), flags (ushort; the bits of
/// [`Flags`]).
pub fn write_ply(mut out: impl Write, points: &[CloudPoint]) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment lasertrace: millimetres, frame of the part\n\
         element vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         property float deviation\nproperty float sigma\n\
         property float deviation_sigma\nproperty float intensity\n\
         property uint frame\nproperty uint column\nproperty ushort flags\nend_header\n",
        points.len()
    )?;
    for point in points {
        for coordinate in point.position.to_array() {
            out.write_all(&coordinate.to_le_bytes())?;
        }
        let CloudPoint {
            deviation,
            sigma,
            deviation_sigma,
            intensity,
            ..
        } = *point;
        for value in [deviation, sigma, deviation_sigma, intensity] {
            out.write_all(&(value as f32).to_le_bytes())?;
        }
        out.write_all(&point.frame.to_le_bytes())?;
        out.write_all(&point.column.to_le_bytes())?;
        out.write_all(&point.flags.bits().to_le_bytes())?;
    }
    Ok(())
}
