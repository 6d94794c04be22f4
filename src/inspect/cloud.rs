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
    /// Signed distance to the CAD surface, mm; positive on the camera's side.
    pub deviation: f64,
    /// Counts above background in the peak.
    pub intensity: f64,
    pub frame: u32,
    pub column: u32,
    /// What is doubtful about its peak.
    pub flags: Flags,
}

/// Writes a binary PLY: x, y, z (double, mm, part frame), deviation (float, mm),
/// intensity (float, counts), frame and column (uint), flags (ushort; the bits of
/// [`Flags`]).
pub fn write_ply(mut out: impl Write, points: &[CloudPoint]) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment lasertrace: millimetres, frame of the part\n\
         element vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         property float deviation\nproperty float intensity\n\
         property uint frame\nproperty uint column\nproperty ushort flags\nend_header\n",
        points.len()
    )?;
    for point in points {
        for coordinate in point.position.to_array() {
            out.write_all(&coordinate.to_le_bytes())?;
        }
        out.write_all(&(point.deviation as f32).to_le_bytes())?;
        out.write_all(&(point.intensity as f32).to_le_bytes())?;
        out.write_all(&point.frame.to_le_bytes())?;
        out.write_all(&point.column.to_le_bytes())?;
        out.write_all(&point.flags.bits().to_le_bytes())?;
    }
    Ok(())
}
