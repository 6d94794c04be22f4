//! Sensor calibration with its uncertainty, and triangulation of pixels.

use super::Peak;
use crate::camera::{CameraModel, Distortion};
use crate::math::{DMat3, DVec2, DVec3, Rigid, rotation_vector};
use glam::DQuat;
use nalgebra::{DMatrix, DVector};

/// Names of the calibration parameters, with units.
///
/// Direction and plane parameters are small changes of the current calibration. The camera is
/// rotated about the x, y and z axes of the head frame. The laser plane is shifted along its normal
/// n, and n is rotated towards u and v. Here u is the camera x axis projected onto the plane, and
/// v = n × u.
pub const PARAMETERS: [&str; 17] = [
    "principal_distance_mm",
    "principal_column_px",
    "principal_row_px",
    "k1",
    "k2",
    "k3",
    "p1",
    "p2",
    "rotation_x_rad",
    "rotation_y_rad",
    "rotation_z_rad",
    "position_x_mm",
    "position_y_mm",
    "position_z_mm",
    "plane_offset_mm",
    "plane_tilt_u_rad",
    "plane_tilt_v_rad",
];

/// One value for each of [`PARAMETERS`].
pub type Parameters = [f64; PARAMETERS.len()];
/// Covariance matrix by rows, in products of the parameters' units.
pub type Covariance = [Parameters; PARAMETERS.len()];

/// Camera model, camera pose and laser plane, which map a peak to a point.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Geometric camera model, without the noise properties of the sensor.
    pub camera: CameraModel,
    /// Pose of the camera in the head frame.
    pub head_from_camera: Rigid,
    /// Point of the laser plane, camera frame, mm.
    pub plane_point: DVec3,
    /// Unit normal of the laser plane, camera frame; not along the x axis.
    pub plane_normal: DVec3,
    /// Covariance of the parameter estimates. A zero on the diagonal marks a parameter as exact. In
    /// a perfect calibration, all parameters are exact.
    pub covariance: Box<Covariance>,
}

/// Measured point and its derivatives, in the head frame.
#[derive(Debug, Clone, PartialEq)]
pub struct PointJacobian {
    /// Measured point, mm.
    pub point: DVec3,
    /// Derivatives with respect to column and row, mm per pixel.
    pub by_pixel: [DVec3; 2],
    /// Derivatives with respect to [`PARAMETERS`], mm per unit of the parameter.
    pub by_parameters: [DVec3; PARAMETERS.len()],
}

impl Calibration {
    /// Creates a calibration whose values are exact.
    pub fn perfect(
        camera: CameraModel,
        head_from_camera: Rigid,
        plane_point: DVec3,
        plane_normal: DVec3,
    ) -> Calibration {
        Calibration {
            camera,
            head_from_camera,
            plane_point,
            plane_normal,
            covariance: Box::new([[0.0; PARAMETERS.len()]; PARAMETERS.len()]),
        }
    }

    /// Returns the intersection of the viewing ray of `peak` with the laser plane, camera frame,
    /// mm. Returns `None` if the ray does not intersect the plane in front of the camera.
    ///
    /// ```
    /// use lasertrace::Scene;
    /// use lasertrace::math::{DVec2, DVec3, Rigid};
    /// use lasertrace::profile::Calibration;
    ///
    /// // The plane in focus is 150 mm in front of the camera.
    /// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
    /// let ahead = DVec3::new(0.0, 0.0, 150.0);
    /// let camera = scene.camera.model();
    /// let calibration = Calibration::perfect(camera, Rigid::IDENTITY, ahead, DVec3::Z);
    ///
    /// let middle = DVec2::new(320.0, 150.0);
    /// let point = calibration.point_at(middle).expect("the ray meets the plane");
    /// assert!((point - ahead).length() < 1e-9);
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn point(&self, peak: &Peak) -> Option<DVec3> {
        self.point_at(peak.place())
    }

    /// Returns the result of [`Self::point`] for sensor coordinates (column, row).
    pub fn point_at(&self, pixel: DVec2) -> Option<DVec3> {
        let direction = self.camera.direction(pixel);
        let t = self.plane_normal.dot(self.plane_point) / self.plane_normal.dot(direction);
        (t.is_finite() && t > 0.0).then(|| direction * t)
    }

    /// Returns the axes u and v of the laser plane towards which its normal is rotated.
    fn plane_axes(&self) -> [DVec3; 2] {
        let n = self.plane_normal;
        let u = (DVec3::X - n * n.x).normalize();
        [u, n.cross(u)]
    }

    /// Returns the calibration with its parameters changed by `by`. The covariance is unchanged.
    pub fn perturbed(&self, by: &Parameters) -> Calibration {
        let mut changed = self.clone();
        let camera = &mut changed.camera;
        camera.principal_distance += by[0];
        camera.principal_point += DVec2::new(by[1], by[2]);
        if by[3..8].iter().any(|&k| k != 0.0) {
            let k = coefficients(camera);
            let k: [f64; 5] = std::array::from_fn(|i| k[i] + by[3 + i]);
            camera.distortion = Some(Distortion::new_unchecked([k[0], k[1], k[2]], [k[3], k[4]]));
        }
        let turn = DQuat::from_scaled_axis(DVec3::from_slice(&by[8..11]));
        changed.head_from_camera = Rigid {
            rotation: DMat3::from_quat(turn) * self.head_from_camera.rotation,
            translation: self.head_from_camera.translation + DVec3::from_slice(&by[11..14]),
        };
        let [u, v] = self.plane_axes();
        changed.plane_point += self.plane_normal * by[14];
        changed.plane_normal = (self.plane_normal + u * by[15] + v * by[16]).normalize();
        changed
    }

    /// Returns the parameter changes from this calibration to `other`; the inverse of
    /// [`Self::perturbed`].
    pub fn difference(&self, other: &Calibration) -> Parameters {
        let camera = &self.camera;
        let point = other.camera.principal_point - camera.principal_point;
        let (from, to) = (coefficients(camera), coefficients(&other.camera));
        let turn = other.head_from_camera.rotation * self.head_from_camera.rotation.transpose();
        let turn = rotation_vector(&turn);
        let moved = other.head_from_camera.translation - self.head_from_camera.translation;
        let [u, v] = self.plane_axes();
        let n = other.plane_normal / other.plane_normal.dot(self.plane_normal);
        [
            other.camera.principal_distance - camera.principal_distance,
            point.x,
            point.y,
            to[0] - from[0],
            to[1] - from[1],
            to[2] - from[2],
            to[3] - from[3],
            to[4] - from[4],
            turn.x,
            turn.y,
            turn.z,
            moved.x,
            moved.y,
            moved.z,
            n.dot(other.plane_point - self.plane_point),
            n.dot(u),
            n.dot(v),
        ]
    }

    /// Returns the measured point of `pixel`, head frame, with its derivatives. The uncertainty of
    /// the point follows from the derivatives, the row noise and [`Self::covariance`]. Returns
    /// `None` under the conditions of [`Self::point`].
    ///
    /// x is the normalised direction and D the distortion. D(x) = m is the position of the pixel
    /// behind the lens, so dx = D′⁻¹(dm - dD). The point X = s·(x, 1) with s = n·p/n·(x, 1) is in
    /// the plane.
    pub fn point_jacobian(&self, pixel: DVec2) -> Option<PointJacobian> {
        let in_camera = self.point_at(pixel)?;
        let camera = &self.camera;
        let behind = camera.sensor_point(pixel);
        let axes = camera.sensor_axes();
        let seen = behind.truncate() / behind.z;
        let (s, n) = (in_camera.z, self.plane_normal);
        let v = in_camera / s;
        let slant = n.dot(v);
        // The inverse of D′, and the derivatives of D with respect to its coefficients.
        let (inverse, coefficients) = match &camera.distortion {
            None => (Default::default(), lensless(v.truncate())),
            Some(d) => (
                d.jacobian(v.truncate()).inverse(),
                d.coefficient_jacobian(v.truncate()),
            ),
        };
        let turn = &self.head_from_camera;
        // Derivatives of the point with respect to x and to the position on the sensor.
        let by_direction = |dx: DVec2| {
            let dv = dx.extend(0.0);
            turn.vector(dv * s - v * (s * n.dot(dv) / slant))
        };
        let by_sensor = |d: DVec3| by_direction(inverse * ((d.truncate() - seen * d.z) / behind.z));
        let by_plane = |change: f64| turn.vector(v * (change / slant));
        let by_pixel = [axes.x_axis, axes.y_axis].map(|axis| by_sensor(axis * camera.pixel_pitch));
        let mut by = [DVec3::ZERO; PARAMETERS.len()];
        by[0] = by_sensor(DVec3::Z);
        by[1] = -by_pixel[0];
        by[2] = -by_pixel[1];
        for (by, dd) in by[3..8].iter_mut().zip(coefficients) {
            *by = -by_direction(inverse * dd);
        }
        for (by, axis) in by[8..11].iter_mut().zip(DVec3::AXES) {
            *by = axis.cross(turn.vector(in_camera));
        }
        by[11..14].copy_from_slice(&DVec3::AXES);
        by[14] = by_plane(1.0);
        for (by, axis) in by[15..].iter_mut().zip(self.plane_axes()) {
            *by = by_plane(axis.dot(self.plane_point - in_camera));
        }
        Some(PointJacobian {
            point: turn.point(in_camera),
            by_pixel,
            by_parameters: by,
        })
    }

    /// Returns the contribution of the calibration to the covariance of a point, J·C·Jᵀ, mm².
    pub fn point_covariance(&self, jacobian: &PointJacobian) -> DMat3 {
        let by = &jacobian.by_parameters;
        let mut sum = DMat3::ZERO;
        for (row, &a) in self.covariance.iter().zip(by) {
            let b: DVec3 = row.iter().zip(by).map(|(&c, &b)| b * c).sum();
            sum += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        }
        sum
    }

    /// Returns whether all parameters are exact.
    pub fn is_exact(&self) -> bool {
        (0..PARAMETERS.len()).all(|i| self.covariance[i][i] == 0.0)
    }

    /// Returns the squared Mahalanobis distance dᵀ·C⁻¹·d of `other` from this calibration, and the
    /// number n of parameters that are not exact. If `other` is the truth and the covariance is
    /// correct, the distance has a χ² distribution with n degrees of freedom.
    pub fn chi_squared(&self, other: &Calibration) -> Option<(f64, usize)> {
        let sigma = self.standard_uncertainties();
        let free: Vec<usize> = (0..PARAMETERS.len()).filter(|&i| sigma[i] > 0.0).collect();
        let difference = self.difference(other);
        let scaled =
            DVector::from_iterator(free.len(), free.iter().map(|&i| difference[i] / sigma[i]));
        let correlation = |i: usize, j: usize| {
            let (i, j) = (free[i], free[j]);
            self.covariance[i][j] / (sigma[i] * sigma[j])
        };
        let factors = DMatrix::from_fn(free.len(), free.len(), correlation).cholesky()?;
        Some((scaled.dot(&factors.solve(&scaled)), free.len()))
    }

    /// Returns the standard uncertainties of the parameters.
    pub fn standard_uncertainties(&self) -> Parameters {
        std::array::from_fn(|i| self.covariance[i][i].sqrt())
    }
}

/// Returns the derivatives with respect to the distortion coefficients for a lens without
/// distortion.
fn lensless(x: DVec2) -> [DVec2; 5] {
    Distortion::new_unchecked([0.0; 3], [0.0; 2]).coefficient_jacobian(x)
}

/// Returns k₁, k₂, k₃, p₁, p₂.
pub(super) fn coefficients(camera: &CameraModel) -> [f64; 5] {
    camera.distortion.map_or([0.0; 5], |d| {
        let ([k1, k2, k3], [p1, p2]) = (d.radial, d.tangential);
        [k1, k2, k3, p1, p2]
    })
}

#[cfg(test)]
#[path = "calibration_tests.rs"]
mod tests;
