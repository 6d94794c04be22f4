//! What a measurement knows of its sensor, how well it knows it, and what that
//! makes of a pixel.

use super::Peak;
use crate::camera::{CameraModel, Distortion};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use glam::DQuat;
use nalgebra::{DMatrix, DVector};

/// The parameters of a calibration, with their units. Those of directions and of
/// the plane are small changes of the calibration at hand: rotations of the camera
/// about the head's x, y and z axes; of the laser plane a shift along its normal n
/// and turns of n towards u, the camera's x axis within the plane, and v = n × u.
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
/// Row by row, in products of the parameters' units.
pub type Covariance = [Parameters; PARAMETERS.len()];

/// What turns a peak into a point: camera, its place in the head, and the laser plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Camera without its sensor.
    pub camera: CameraModel,
    /// Where the camera stands in the head.
    pub head_from_camera: Rigid,
    /// A point of the laser plane, camera frame, mm.
    pub plane_point: DVec3,
    /// Unit normal of the laser plane, camera frame; not along the x axis.
    pub plane_normal: DVec3,
    /// Of the estimates of the parameters. A zero on its diagonal is a parameter
    /// taken as known; all are in a perfect calibration.
    pub covariance: Box<Covariance>,
}

/// A measured point and its derivatives, in the head's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct PointJacobian {
    /// mm.
    pub point: DVec3,
    /// By column and row, mm per pixel.
    pub by_pixel: [DVec3; 2],
    /// By [`PARAMETERS`], mm per their units.
    pub by_parameters: [DVec3; PARAMETERS.len()],
}

impl Calibration {
    /// Of known values.
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

    /// The point of the laser plane that `peak`'s pixel sees, camera frame, mm.
    /// `None` if its ray does not meet the plane in front of the camera.
    ///
    /// ```
    /// use lasertrace::Scene;
    /// use lasertrace::math::{DVec2, DVec3, Rigid};
    /// use lasertrace::profile::Calibration;
    ///
    /// // The plane that the camera sees sharp, 150 mm in front of it.
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

    /// [`Self::point`] of a place (column, row) on the sensor.
    pub fn point_at(&self, pixel: DVec2) -> Option<DVec3> {
        let direction = self.camera.direction(pixel);
        let t = self.plane_normal.dot(self.plane_point) / self.plane_normal.dot(direction);
        (t.is_finite() && t > 0.0).then(|| direction * t)
    }

    /// Axes of the laser plane in which its normal is turned.
    fn plane_axes(&self) -> [DVec3; 2] {
        let n = self.plane_normal;
        let u = (DVec3::X - n * n.x).normalize();
        [u, n.cross(u)]
    }

    /// The calibration whose parameters differ by `by` from this one's; with its
    /// covariance.
    pub fn perturbed(&self, by: &Parameters) -> Calibration {
        let mut changed = self.clone();
        let camera = &mut changed.camera;
        camera.principal_distance += by[0];
        camera.principal_point += DVec2::new(by[1], by[2]);
        if by[3..8].iter().any(|&k| k != 0.0) {
            let k = coefficients(camera);
            let k: [f64; 5] = std::array::from_fn(|i| k[i] + by[3 + i]);
            camera.distortion = Some(Distortion::unchecked([k[0], k[1], k[2]], [k[3], k[4]]));
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

    /// By how much the parameters of `other` differ from this calibration's:
    /// [`Self::perturbed`] turned round.
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

    /// The point that `pixel` measures, head's frame, with its derivatives: with
    /// them row noise and [`Self::covariance`] give its uncertainty. `None` as
    /// [`Self::point`].
    ///
    /// With x the normalised direction and D the distortion, D(x) = m is where the
    /// pixel lies behind the lens, so dx = D′⁻¹(dm - dD). X = s·(x, 1) with
    /// s = n·p/n·(x, 1) lies in the plane.
    pub fn point_jacobian(&self, pixel: DVec2) -> Option<PointJacobian> {
        let in_camera = self.point_at(pixel)?;
        let camera = &self.camera;
        let behind = camera.sensor_point(pixel);
        let axes = camera.sensor_axes();
        let seen = behind.truncate() / behind.z;
        let (s, n) = (in_camera.z, self.plane_normal);
        let v = in_camera / s;
        let slant = n.dot(v);
        // The inverse of D′, and dD by its coefficients.
        let (inverse, coefficients) = match &camera.distortion {
            None => (Default::default(), lensless(v.truncate())),
            Some(d) => (
                d.jacobian(v.truncate()).inverse(),
                d.by_coefficients(v.truncate()),
            ),
        };
        let turn = &self.head_from_camera;
        // Derivatives of the point: by x, and by where the pixel lies.
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

    /// Covariance of the point that `jacobian` is of, mm², as far as it comes from
    /// the calibration: J·C·Jᵀ.
    pub fn point_covariance(&self, jacobian: &PointJacobian) -> DMat3 {
        let by = &jacobian.by_parameters;
        let mut sum = DMat3::ZERO;
        for (row, &a) in self.covariance.iter().zip(by) {
            let b: DVec3 = row.iter().zip(by).map(|(&c, &b)| b * c).sum();
            sum += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        }
        sum
    }

    /// Whether all parameters are taken as known.
    pub fn is_exact(&self) -> bool {
        (0..PARAMETERS.len()).all(|i| self.covariance[i][i] == 0.0)
    }

    /// Squared distance of `other` in units of this calibration's uncertainty,
    /// dᵀ·C⁻¹·d over the parameters not taken as known, and their number n. If
    /// `other` is the truth and the covariance right it is distributed as χ² with n
    /// degrees of freedom.
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

    /// Standard uncertainties of the parameters.
    pub fn standard_uncertainties(&self) -> Parameters {
        std::array::from_fn(|i| self.covariance[i][i].sqrt())
    }
}

/// Axis times angle, the angle in [0, π].
pub(super) fn rotation_vector(rotation: &DMat3) -> DVec3 {
    let q = DQuat::from_mat3(rotation);
    (if q.w < 0.0 { -q } else { q }).to_scaled_axis()
}

/// How a lens without distortion would respond to some.
fn lensless(x: DVec2) -> [DVec2; 5] {
    Distortion::unchecked([0.0; 3], [0.0; 2]).by_coefficients(x)
}

/// k₁, k₂, k₃, p₁, p₂.
pub(super) fn coefficients(camera: &CameraModel) -> [f64; 5] {
    camera.distortion.map_or([0.0; 5], |d| {
        let ([k1, k2, k3], [p1, p2]) = (d.radial, d.tangential);
        [k1, k2, k3, p1, p2]
    })
}

#[cfg(test)]
#[path = "calibration_tests.rs"]
mod tests;
