//! Camera geometry: the mapping between pixels and directions. A calibration determines these
//! parameters.

use super::Distortion;
use crate::math::{DMat3, DVec2, DVec3};
use glam::UVec2;

/// Pinhole camera with lens distortion and an optionally tilted sensor.
///
/// A tilt is equivalent to a choice of axes if the lens has no distortion: the foot of the
/// perpendicular from the pinhole serves as the principal point. A calibration therefore takes the
/// tilt from the design. An error of this tilt is compensated by the principal point, the principal
/// distance and the rotation of the camera.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct CameraModel {
    /// Number of columns and rows.
    pub resolution: UVec2,
    /// Pixel pitch, mm.
    pub pixel_pitch: f64,
    /// Distance from the pupil to the sensor along the optical axis, mm.
    pub principal_distance: f64,
    /// Intersection of the optical axis with the sensor, (column, row).
    pub principal_point: DVec2,
    /// Tilt of the sensor as in [`Camera`](super::Camera), rad.
    pub tilt: DVec2,
    /// Lens distortion; `None` for an ideal pinhole projection.
    pub distortion: Option<Distortion>,
}

impl CameraModel {
    /// Returns the sensor axes (columns, rows, normal) in the camera frame.
    pub fn sensor_axes(&self) -> DMat3 {
        DMat3::from_rotation_y(self.tilt.y) * DMat3::from_rotation_x(self.tilt.x)
    }

    /// Returns the position of `pixel` (column, row) on the sensor relative to the principal point,
    /// mm.
    pub fn screen(&self, pixel: DVec2) -> DVec2 {
        (pixel - self.principal_point) * self.pixel_pitch
    }

    /// Returns the position of `pixel` on the sensor in the camera frame, mm. The sensor is
    /// represented in front of the lens, so the vector points along the chief ray behind the lens.
    pub fn sensor_point(&self, pixel: DVec2) -> DVec3 {
        self.projector().sensor_point(pixel)
    }

    /// Returns the unit viewing direction of `pixel` from the pupil. The pixel must be within the
    /// sensor.
    pub fn direction(&self, pixel: DVec2) -> DVec3 {
        let behind = self.sensor_point(pixel);
        match &self.distortion {
            None => behind.normalize(),
            Some(distortion) => {
                let seen = behind.truncate() / behind.z;
                distortion.undistort(seen, seen).extend(1.0).normalize()
            }
        }
    }

    /// Projects a point to pixel coordinates; see [`Projector::project`].
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        self.projector().project(point)
    }

    /// Returns a projector for many points.
    pub fn projector(&self) -> Projector {
        Projector {
            model: *self,
            axes: self.sensor_axes(),
        }
    }

    /// Returns the largest tangent of the angle between the axis and a chief ray behind the lens
    /// that hits the sensor. Returns `None` if a corner of the sensor is not behind the lens.
    pub fn reach(&self) -> Option<f64> {
        let size = self.resolution.as_dvec2();
        let corners = [DVec2::ZERO, size.with_y(0.0), size.with_x(0.0), size];
        // The normalised image of the sensor is a convex quadrilateral, so its corners suffice.
        corners.into_iter().try_fold(0.0f64, |reach, corner| {
            let p = self.sensor_point(corner);
            (p.z > 0.0).then(|| reach.max(p.truncate().length() / p.z))
        })
    }
}

/// Camera model with precomputed sensor axes.
#[derive(Debug, Clone, Copy)]
pub struct Projector {
    model: CameraModel,
    axes: DMat3,
}

impl Projector {
    /// Returns a point of the sensor in the camera frame; see [`CameraModel::sensor_point`].
    pub(super) fn sensor_point(&self, pixel: DVec2) -> DVec3 {
        let on_sensor = self.axes * self.model.screen(pixel).extend(0.0);
        on_sensor + DVec3::Z * self.model.principal_distance
    }

    pub(super) fn sensor_normal(&self) -> DVec3 {
        self.axes.z_axis
    }

    /// Returns the pixel coordinates (column, row) of the image of `point` (camera frame). The
    /// result may be outside the sensor.
    ///
    /// Returns `None` if the point is at or behind the lens. It also returns `None` if the chief
    /// ray misses the sensor plane or is outside the domain of the distortion.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        if point.z <= 0.0 {
            return None;
        }
        let CameraModel {
            principal_distance, ..
        } = self.model;
        let point = match &self.model.distortion {
            None => point,
            Some(distortion) => {
                let x = point.truncate() / point.z;
                let covered = distortion.covers(x);
                covered.then(|| distortion.distort(x).extend(1.0))?
            }
        };
        let axes = &self.axes;
        let towards = axes.z_axis.dot(point);
        let scale = principal_distance * axes.z_axis.z / towards;
        if scale <= 0.0 || !scale.is_finite() {
            return None;
        }
        let on_sensor = point * scale - DVec3::Z * principal_distance;
        let on_sensor = DVec2::new(axes.x_axis.dot(on_sensor), axes.y_axis.dot(on_sensor));
        Some(on_sensor / self.model.pixel_pitch + self.model.principal_point)
    }
}
