//! From a pixel to a point: the camera's ray meets the laser plane.

use super::Peak;
use crate::camera::Camera;
use crate::math::{DVec2, DVec3};

/// What a measurement knows of its sensor.
#[derive(Debug, Clone)]
pub struct Calibration {
    pub camera: Camera,
    /// A point of the laser plane, camera frame, mm.
    pub plane_point: DVec3,
    /// Unit normal of the laser plane, camera frame.
    pub plane_normal: DVec3,
}

impl Calibration {
    /// The point of the laser plane that `peak`'s pixel sees, camera frame, mm.
    /// `None` if its ray does not meet the plane in front of the camera.
    pub fn point(&self, peak: &Peak) -> Option<DVec3> {
        let pixel = DVec2::new(peak.column as f64 + 0.5, peak.row);
        let direction = self.camera.direction(pixel);
        let t = self.plane_normal.dot(self.plane_point) / self.plane_normal.dot(direction);
        (t.is_finite() && t > 0.0).then(|| direction * t)
    }

    /// Movement of that point for a row more, mm/px: the difference over a pixel
    /// about the row, which misses a 24th of the third derivative.
    pub fn row_derivative(&self, peak: &Peak) -> Option<DVec3> {
        let at = |by| {
            self.point(&Peak {
                row: peak.row + by,
                ..*peak
            })
        };
        Some(at(0.5)? - at(-0.5)?)
    }
}
