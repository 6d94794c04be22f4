//! Best-fit alignment of a measured cloud to the CAD surface by the iterative closest point method
//! with point-to-plane distances (Chen & Medioni 1992).

use crate::accel::Accel;
use crate::math::{DMat3, DVec3, Rigid};
use glam::DQuat;
use nalgebra::{Matrix6, SymmetricEigen, Vector6};
use rayon::prelude::*;
use serde::Serialize;

/// Rigid motion that aligns a cloud with the CAD surface.
#[derive(Debug, Clone, Serialize)]
pub struct Alignment {
    /// Transformation from measured to aligned points.
    pub part_from_measured: Rigid,
    /// Root mean square distance of the fitted points from the CAD surface before the fit, µm.
    pub rms_before_um: f64,
    /// Root mean square distance after the fit, µm.
    pub rms_after_um: f64,
    /// Number of fitted points.
    pub points_fitted: usize,
    /// Number of iterations.
    pub iterations: u32,
    /// Number of the six degrees of freedom that the cloud does not determine; for a plane, three.
    /// They are not changed.
    pub undetermined: u32,
}

/// Maximum number of fitted points. More points do not reduce the error of the fit.
const MOST_POINTS: usize = 50_000;
const MOST_ITERATIONS: u32 = 60;

/// Relative eigenvalue limit for undetermined directions. Rounding of nearest points is well below
/// the limit, and the facets of a tessellated sphere are well above it.
const UNDETERMINED: f64 = 1e-10;

/// Returns the alignment of `points` (part frame, mm) to the mesh by least squares of the
/// distances. Returns `None` for fewer than six points.
pub fn best_fit(accel: &Accel, points: &[DVec3]) -> Option<Alignment> {
    let stride = points.len().div_ceil(MOST_POINTS).max(1);
    let points: Vec<DVec3> = points.iter().copied().step_by(stride).collect();
    if points.len() < 6 {
        return None;
    }
    let mut fit = Alignment {
        part_from_measured: Rigid::IDENTITY,
        rms_before_um: 0.0,
        rms_after_um: 0.0,
        points_fitted: points.len(),
        iterations: 0,
        undetermined: 0,
    };
    let mut system = System::of(accel, &points, &fit.part_from_measured);
    fit.rms_before_um = system.rms * 1e3;
    while fit.iterations < MOST_ITERATIONS {
        let (step, undetermined) = system.step();
        let moved = step * fit.part_from_measured;
        let next = System::of(accel, &points, &moved);
        fit.iterations += 1;
        fit.undetermined = undetermined;
        let gain = system.rms - next.rms;
        if gain <= 0.0 {
            break;
        }
        fit.part_from_measured = moved;
        let done = gain < 1e-9 * system.rms;
        system = next;
        if done {
            break;
        }
    }
    fit.rms_after_um = system.rms * 1e3;
    Some(fit)
}

/// Normal equations of a small motion: rotation ω about `center` in units of 1/`size`, then
/// translation.
struct System {
    matrix: Matrix6<f64>,
    right: Vector6<f64>,
    center: DVec3,
    size: f64,
    rms: f64,
}

impl System {
    fn of(accel: &Accel, points: &[DVec3], moved: &Rigid) -> System {
        let n = points.len() as f64;
        let center = points.iter().map(|&p| moved.point(p)).sum::<DVec3>() / n;
        let spread: f64 = points
            .iter()
            .map(|&p| (moved.point(p) - center).length_squared())
            .sum();
        let size = (spread / n).sqrt().max(f64::MIN_POSITIVE);
        // Chunks are summed in order, so the result is independent of the number of threads.
        let parts: Vec<_> = points
            .par_chunks(1024)
            .map(|chunk| {
                let mut sum = (Matrix6::zeros(), Vector6::zeros(), 0.0);
                for &p in chunk {
                    let p = moved.point(p);
                    let nearest = accel.nearest(p, None);
                    let [a, b, c] = accel.corners(nearest.face);
                    let Some(normal) = (b - a).cross(c - a).try_normalize() else {
                        continue;
                    };
                    let off = normal.dot(p - nearest.point);
                    let turn = (p - center).cross(normal) / size;
                    let row = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
                    sum.0 += row * row.transpose();
                    sum.1 -= row * off;
                    sum.2 += nearest.distance * nearest.distance;
                }
                sum
            })
            .collect();
        let mut system = System {
            matrix: Matrix6::zeros(),
            right: Vector6::zeros(),
            center,
            size,
            rms: 0.0,
        };
        for (matrix, right, squares) in parts {
            system.matrix += matrix;
            system.right += right;
            system.rms += squares;
        }
        system.rms = (system.rms / n).sqrt();
        system
    }

    /// Returns the least-squares motion, and the number of undetermined directions.
    fn step(&self) -> (Rigid, u32) {
        let eigen = SymmetricEigen::new(self.matrix);
        let floor = UNDETERMINED * eigen.eigenvalues.max();
        let mut solution = Vector6::zeros();
        let mut undetermined = 0;
        for (value, vector) in eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter())
        {
            if *value > floor {
                solution += vector * (vector.dot(&self.right) / value);
            } else {
                undetermined += 1;
            }
        }
        let [x, y, z, shift @ ..] = <[f64; 6]>::from(solution);
        let turn = DQuat::from_scaled_axis(DVec3::new(x, y, z) / self.size);
        let rotation = DMat3::from_quat(turn);
        let translation = self.center - rotation * self.center + DVec3::from(shift);
        let step = Rigid {
            rotation,
            translation,
        };
        (step, undetermined)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use crate::mesh::{Mesh, shapes};

    /// Returns random points on the triangles of a mesh.
    fn spread(mesh: &Mesh, n: u64) -> Vec<DVec3> {
        let key = RngKey::new(7, Purpose::SensorNoise);
        (0..n)
            .map(|i| {
                let random = |j| key.with(i).uniform(j);
                let t = (random(0) * mesh.triangles.len() as f64) as usize;
                let [a, b, c] = mesh.triangle(t);
                let (u, v) = (random(1), random(2));
                let (u, v) = if u + v > 1.0 {
                    (1.0 - u, 1.0 - v)
                } else {
                    (u, v)
                };
                a + (b - a) * u + (c - a) * v
            })
            .collect()
    }

    /// The fit restores a displaced block up to the f64 rounding of nearest points.
    #[test]
    fn a_displaced_block_is_found() {
        let mesh = shapes::step_block(DVec3::new(30.0, 20.0, 8.0), 2.0).unwrap();
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        let away =
            Rigid::from_euler_xyz(DVec3::new(0.01, -0.02, 0.015), DVec3::new(0.1, -0.2, 0.15));
        let points: Vec<DVec3> = spread(&mesh, 3000).iter().map(|&p| away.point(p)).collect();
        let fit = best_fit(&accel, &points).unwrap();
        assert_eq!(fit.undetermined, 0);
        assert!(
            fit.rms_before_um > 100.0 && fit.rms_after_um < 1e-6,
            "{fit:?}"
        );
        let back = fit.part_from_measured * away;
        for corner in mesh.bounds().corners() {
            assert!((back.point(corner) - corner).length() < 1e-9, "{fit:?}");
        }
    }

    /// A plane determines one translation and two rotations. The other directions are unchanged.
    #[test]
    fn what_a_plane_cannot_tell_is_left_alone() {
        let mesh = shapes::plane([40.0, 40.0].into()).unwrap();
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        let away = Rigid::from_euler_xyz(DVec3::new(0.01, 0.0, 0.0), DVec3::new(0.5, 0.0, 0.2));
        let points: Vec<DVec3> = spread(&mesh, 500)
            .iter()
            .map(|&p| away.point(p * 0.5))
            .collect();
        let fit = best_fit(&accel, &points).unwrap();
        assert_eq!(fit.undetermined, 3);
        assert!(fit.rms_after_um < 1e-6, "{fit:?}");
        let moved = fit.part_from_measured.point(away.point(DVec3::ZERO));
        // The rotation about the centre of the cloud shifts the origin in proportion to the height.
        assert!(
            (moved.x - 0.5).abs() < 1e-9 && moved.y.abs() < 0.01,
            "{moved}"
        );
    }

    #[test]
    fn too_few_points_have_no_fit() {
        let mesh = shapes::plane([1.0, 1.0].into()).unwrap();
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        assert!(best_fit(&accel, &[DVec3::ZERO; 5]).is_none());
        let same = best_fit(&accel, &[DVec3::new(0.1, 0.1, 0.01); 6]).unwrap();
        assert!(same.part_from_measured.point(DVec3::X).is_finite());
    }
}
