//! The geometry of a camera: which pixel sees which direction. What a calibration
//! knows of it.

use super::Distortion;
use crate::math::{DMat3, DVec2, DVec3};
use glam::UVec2;

/// A pinhole with a distorting lens in it and a sensor, perhaps tilted, behind.
///
/// Without distortion, a tilt is a choice of axes: the sensor's plane and the
/// pinhole are all there is, and the foot of the perpendicular serves as principal
/// point. So a calibration takes the tilt from the design; if that is wrong,
/// principal point, distance and the camera's rotation make up for it.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct CameraModel {
    /// Columns, rows.
    pub resolution: UVec2,
    /// mm.
    pub pixel_pitch: f64,
    /// From the pupil along the optical axis to the sensor, mm.
    pub principal_distance: f64,
    /// Where the optical axis meets the sensor, (column, row).
    pub principal_point: DVec2,
    /// As in [`Camera`](super::Camera), rad.
    pub tilt: DVec2,
    /// `None`: the lens is a pinhole's projection.
    pub distortion: Option<Distortion>,
}

impl CameraModel {
    /// Sensor axes (columns, rows, normal) in the camera frame.
    pub fn sensor_axes(&self) -> DMat3 {
        DMat3::from_rotation_y(self.tilt.y) * DMat3::from_rotation_x(self.tilt.x)
    }

    /// Where `pixel` (column, row) lies on the sensor, mm from the principal point.
    pub fn screen(&self, pixel: DVec2) -> DVec2 {
        (pixel - self.principal_point) * self.pixel_pitch
    }

    /// Where `pixel` lies, on the sensor drawn in front of the lens: along the
    /// chief ray behind it.
    pub fn sensor_point(&self, pixel: DVec2) -> DVec3 {
        self.projector().sensor_point(pixel)
    }

    /// Unit direction in which `pixel`, one of the sensor's, looks from the pupil.
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

    /// See [`Projector::project`].
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        self.projector().project(point)
    }

    /// For projecting many points.
    pub fn projector(&self) -> Projector {
        Projector {
            model: *self,
            axes: self.sensor_axes(),
        }
    }

    /// Greatest angle from the axis, as its tangent, at which a chief ray behind
    /// the lens meets the sensor. `None` if a corner of it is not behind the lens.
    pub fn reach(&self) -> Option<f64> {
        let size = self.resolution.as_dvec2();
        let corners = [DVec2::ZERO, size.with_y(0.0), size.with_x(0.0), size];
        // The normalised image of the sensor is a convex quadrilateral.
        corners.into_iter().try_fold(0.0f64, |reach, corner| {
            let p = self.sensor_point(corner);
            (p.z > 0.0).then(|| reach.max(p.truncate().length() / p.z))
        })
    }
}

/// A camera's model with what all points share computed once.
#[derive(Debug, Clone, Copy)]
pub struct Projector {
    model: CameraModel,
    axes: DMat3,
}

impl Projector {
    /// See [`CameraModel::sensor_point`].
    pub(super) fn sensor_point(&self, pixel: DVec2) -> DVec3 {
        let on_sensor = self.axes * self.model.screen(pixel).extend(0.0);
        on_sensor + DVec3::Z * self.model.principal_distance
    }

    pub(super) fn sensor_normal(&self) -> DVec3 {
        self.axes.z_axis
    }

    /// The pixel (column, row, not bounded to the sensor) that sees `point` (camera
    /// frame); `None` if it lies at or behind the lens, or so far off axis that its
    /// image misses the sensor's plane or the distortion is not known there.
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
