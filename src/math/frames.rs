//! Rigid transforms between right-handed frames, named `to_from_from`: `world_from_head.point(p)`
//! transforms `p` from head to world coordinates.

use glam::{DMat3, DQuat, DVec3, EulerRot};

/// Returns the rotation vector (axis times angle), with the angle in [0, π].
pub fn rotation_vector(rotation: &DMat3) -> DVec3 {
    let q = DQuat::from_mat3(rotation);
    (if q.w < 0.0 { -q } else { q }).to_scaled_axis()
}

/// Rotation followed by translation (mm).
///
/// ```
/// use lasertrace::math::{DVec3, Rigid};
/// use std::f64::consts::FRAC_PI_2;
///
/// let world_from_head = Rigid::from_euler_xyz(DVec3::Z * FRAC_PI_2, DVec3::new(0.0, 0.0, 7.0));
/// let p = world_from_head.point(DVec3::X);
/// assert!((p - DVec3::new(0.0, 1.0, 7.0)).length() < 1e-15);
/// // The inverse: adjacent frame names of a product agree.
/// let head_from_world = world_from_head.inverse();
/// assert!(((head_from_world * world_from_head).point(DVec3::X) - DVec3::X).length() < 1e-14);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Rigid {
    /// Orthonormal matrix of determinant +1.
    pub rotation: DMat3,
    /// Translation vector, mm.
    pub translation: DVec3,
}

impl Rigid {
    /// Identity transform.
    pub const IDENTITY: Rigid = Rigid {
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };

    /// Builds a transform from the first three rows of a 4 × 4 matrix that acts on column vectors.
    ///
    /// Each row holds the rotation and, last, the translation (mm). The rotation is
    /// orthonormalized. Returns an error message if the rows deviate from an orthonormal basis by
    /// more than 1e-6, if the matrix mirrors, or if the translation is not finite.
    pub fn from_rows(rows: [[f64; 4]; 3]) -> Result<Rigid, String> {
        let [x, y, z] = rows.map(|[x, y, z, _]| DVec3::new(x, y, z));
        let translation = DVec3::from_array(rows.map(|row| row[3]));
        let given = DMat3::from_cols(x, y, z).transpose();
        let off = given * given.transpose() - DMat3::IDENTITY;
        // Also false for NaN.
        let is_rotation = off.to_cols_array().iter().all(|v| v.abs() <= 1e-6);
        if !is_rotation || given.determinant() < 0.0 || !translation.is_finite() {
            return Err(format!(
                "found {rows:?}, expected a rotation and a translation, without scale or mirror"
            ));
        }
        // Gram–Schmidt: each step changes rows that are already orthonormal by rounding errors
        // only.
        let x = x.normalize();
        let y = (y - x * x.dot(y)).normalize();
        Ok(Rigid {
            rotation: DMat3::from_cols(x, y, x.cross(y)).transpose(),
            translation,
        })
    }

    /// Returns a pure translation, mm.
    pub fn translation(translation: DVec3) -> Rigid {
        Rigid {
            rotation: DMat3::IDENTITY,
            translation,
        }
    }

    /// Returns rotations about the fixed x, then y, then z axis (radians), followed by the
    /// translation.
    pub fn from_euler_xyz(angles: DVec3, translation: DVec3) -> Rigid {
        Rigid {
            rotation: DMat3::from_quat(DQuat::from_euler(
                EulerRot::XYZEx,
                angles.x,
                angles.y,
                angles.z,
            )),
            translation,
        }
    }

    /// Returns the frame at `origin` with z axis `z`. Its x axis is the component of `x_hint`
    /// perpendicular to `z`.
    ///
    /// Returns `None` if either vector is zero or not finite, or if the two are parallel to within
    /// 1e-6 rad.
    pub fn from_z_and_x(origin: DVec3, z: DVec3, x_hint: DVec3) -> Option<Rigid> {
        let z = z.try_normalize()?;
        let hint = x_hint.try_normalize()?;
        let across = hint - z * hint.dot(z);
        if across.length() < 1e-6 {
            return None;
        }
        let x = across.normalize();
        // If the hint is almost parallel to z, the rounding error of the small difference lies
        // along z.
        let x = (x - z * x.dot(z)).normalize();
        Some(Rigid {
            rotation: DMat3::from_cols(x, z.cross(x), z),
            translation: origin,
        })
    }

    /// Transforms the coordinates (mm) of a point into the frame to the left of "from".
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }

    /// Transforms a vector: rotates it without translation.
    pub fn vector(&self, v: DVec3) -> DVec3 {
        self.rotation * v
    }

    /// Returns the inverse transform: `b_from_a` for `a_from_b`.
    pub fn inverse(&self) -> Rigid {
        let rotation = self.rotation.transpose();
        Rigid {
            rotation,
            translation: -(rotation * self.translation),
        }
    }
}

impl std::ops::Mul for Rigid {
    type Output = Rigid;
    /// Composes two transforms: `a_from_b * b_from_c = a_from_c`.
    fn mul(self, other: Rigid) -> Rigid {
        Rigid {
            rotation: self.rotation * other.rotation,
            translation: self.point(other.translation),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn euler_angles_turn_about_fixed_x_then_y_then_z() {
        let quarter = std::f64::consts::FRAC_PI_2;
        let t = Rigid::from_euler_xyz(DVec3::new(quarter, 0.0, quarter), DVec3::X);
        // y → z about x, and z is unchanged about z; x → y about z.
        assert!((t.point(DVec3::Y) - DVec3::new(1.0, 0.0, 1.0)).length() < 1e-15);
        assert!((t.point(DVec3::X) - DVec3::new(1.0, 1.0, 0.0)).length() < 1e-15);
    }

    #[test]
    fn inverse_and_product_agree() {
        let a = Rigid::from_euler_xyz(DVec3::new(0.3, -1.0, 2.0), DVec3::new(1.0, 2.0, 3.0));
        let b = Rigid::from_z_and_x(DVec3::Y, DVec3::new(1.0, 1.0, 0.2), DVec3::X).unwrap();
        let p = DVec3::new(-4.0, 0.5, 7.0);
        assert!(((a * b).point(p) - a.point(b.point(p))).length() < 1e-14);
        assert!((a.inverse().point(a.point(p)) - p).length() < 1e-14);
        assert!((b.rotation.determinant() - 1.0).abs() < 1e-14);
    }

    /// Tests a hint at 2e-6 rad from z, where rounding is 1e-10 of the perpendicular component.
    #[test]
    fn a_hint_almost_along_z_gives_a_rotation_all_the_same() {
        let z = DVec3::new(0.3, -0.7, 0.64).normalize();
        for aside in [DVec3::X, DVec3::Y, DVec3::new(-0.2, 0.5, 0.9)] {
            let pose = Rigid::from_z_and_x(DVec3::ZERO, z, z + 2e-6 * z.cross(aside)).unwrap();
            let turn = pose.rotation * pose.rotation.transpose();
            assert!(turn.abs_diff_eq(DMat3::IDENTITY, 1e-15), "{turn}");
        }
    }

    #[test]
    fn a_matrix_that_is_no_rigid_motion_is_refused() {
        let turned = Rigid::from_euler_xyz(DVec3::new(0.3, -1.0, 2.0), DVec3::new(1.0, 2.0, 3.0));
        let rows = |rigid: &Rigid| {
            let rotation = rigid.rotation.transpose();
            let rows =
                [rotation.x_axis, rotation.y_axis, rotation.z_axis].map(|row| row.to_array());
            let moved = rigid.translation.to_array();
            std::array::from_fn(|i| [rows[i][0], rows[i][1], rows[i][2], moved[i]])
        };
        let given: [[f64; 4]; 3] = rows(&turned);
        let read = Rigid::from_rows(given).unwrap();
        assert!(read.rotation.abs_diff_eq(turned.rotation, 1e-15));
        assert_eq!(read.translation, turned.translation);
        assert_eq!(
            Rigid::from_rows(rows(&Rigid::IDENTITY)),
            Ok(Rigid::IDENTITY)
        );
        for (row, column, value) in [(0, 0, 2.0), (1, 2, f64::NAN), (2, 3, f64::INFINITY)] {
            let mut wrong = given;
            wrong[row][column] = value;
            assert!(Rigid::from_rows(wrong).is_err(), "{row} {column}");
        }
        let mirrored = [given[1], given[0], given[2]];
        assert!(Rigid::from_rows(mirrored).is_err());
    }
}
