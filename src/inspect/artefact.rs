//! Artefacts of acceptance tests in measured points: least-squares spheres and planes, and how far
//! points lie off them.

use crate::math::{DMat3, DVec3};
use nalgebra::{Matrix3, Matrix4, SymmetricEigen, Vector4};
use std::f64::consts::TAU;

/// A sphere, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Its middle.
    pub center: DVec3,
    /// Its radius.
    pub radius: f64,
}

/// The points of a cap of a sphere, and the sphere through them.
#[derive(Debug, Clone, PartialEq)]
pub struct Cap {
    /// By least squares.
    pub sphere: Sphere,
    /// As far from the cap's axis as it asks for, seen from the sphere's own centre.
    pub points: Vec<DVec3>,
}

/// Times that the cap is taken anew about the sphere it gave.
const MOST_CAPS: usize = 5;
/// Steps of Gauss and Newton: caps of 20° take some twenty.
const MOST_STEPS: usize = 100;
/// Step, in radii, that is rounding of the sums over many points.
const LEAST_STEP: f64 = 1e-12;

impl Sphere {
    /// The sphere from which squares of radial distances of `points` are least. `None` for points that say
    /// no sphere: fewer than four, or all in a plane.
    pub fn fit(points: &[DVec3]) -> Option<Sphere> {
        let n = points.len() as f64;
        let middle = points.iter().sum::<DVec3>() / n;
        let size = points
            .iter()
            .map(|p| p.distance_squared(middle))
            .sum::<f64>();
        let size = (size / n).sqrt();
        if points.len() < 4 || size.is_nan() || size <= 0.0 {
            return None;
        }
        let local: Vec<DVec3> = points.iter().map(|&p| (p - middle) / size).collect();
        // |p|² = 2·c·p + (R² − |c|²) is linear in what is sought, and a good start.
        let rows = local.iter().map(|p| {
            let row = Vector4::new(2.0 * p.x, 2.0 * p.y, 2.0 * p.z, 1.0);
            (row, p.length_squared())
        });
        let start = least_squares(rows)?;
        let mut center = DVec3::new(start.x, start.y, start.z);
        let mut radius = (start.w + center.length_squared()).max(0.0).sqrt();
        for _ in 0..MOST_STEPS {
            let rows = local.iter().map(|&p| {
                let away = (p - center).normalize_or_zero();
                let row = Vector4::new(away.x, away.y, away.z, 1.0);
                (row, p.distance(center) - radius)
            });
            let step = least_squares(rows)?;
            center += DVec3::new(step.x, step.y, step.z);
            radius += step.w;
            if step.norm() < LEAST_STEP * radius {
                break;
            }
        }
        let sphere = Sphere {
            center: middle + center * size,
            radius: radius * size,
        };
        (sphere.center.is_finite() && sphere.radius > 0.0).then_some(sphere)
    }

    /// The same of the points of the cap of this half angle (rad) about `up` that it has itself, from `points` of more of it. Starts
    /// from the cap about `center`.
    pub fn fit_cap(points: &[DVec3], center: DVec3, up: DVec3, half_angle: f64) -> Option<Cap> {
        let least = half_angle.cos();
        let of_cap = |center: DVec3| -> Vec<DVec3> {
            let inside = |p: &&DVec3| (**p - center).dot(up) >= least * p.distance(center);
            points.iter().filter(inside).copied().collect()
        };
        let mut points = of_cap(center);
        let mut sphere = Sphere::fit(&points)?;
        // Each time the centre changes by that share of its change that moves points over the rim.
        for _ in 0..MOST_CAPS {
            let before = points.len();
            points = of_cap(sphere.center);
            let next = Sphere::fit(&points)?;
            let settled = next == sphere && points.len() == before;
            sphere = next;
            if settled {
                break;
            }
        }
        Some(Cap { sphere, points })
    }

    /// How far a point is outside, mm.
    pub fn residual(&self, point: DVec3) -> f64 {
        point.distance(self.center) - self.radius
    }

    /// The 25 representative points of a cap of this half angle (rad) about `up`: in directions from the centre evenly
    /// over the cap's area (the pole and rings of 4, 8 and 12 at 0.3, 0.6 and 0.9 of the half angle), each the mean
    /// direction and mean radius of the points within 0.15 of it. `None` where there is none.
    pub fn representative(
        &self,
        points: &[DVec3],
        up: DVec3,
        half_angle: f64,
    ) -> [Option<DVec3>; 25] {
        let turn = DMat3::from_quat(glam::DQuat::from_rotation_arc(DVec3::Z, up));
        let mut directions = vec![up];
        for (ring, count) in [(0.3, 4), (0.6, 8), (0.9, 12)] {
            let (sin, cos) = f64::sin_cos(ring * half_angle);
            directions.extend((0..count).map(|k| {
                let (y, x) = (TAU * f64::from(k) / f64::from(count)).sin_cos();
                turn * DVec3::new(sin * x, sin * y, cos)
            }));
        }
        let least_cosine = (0.15 * half_angle).cos();
        std::array::from_fn(|i| {
            let (mut direction, mut radius, mut count) = (DVec3::ZERO, 0.0, 0.0);
            for &point in points {
                let away = point - self.center;
                let length = away.length();
                if away.dot(directions[i]) >= least_cosine * length {
                    direction += away / length;
                    radius += length;
                    count += 1.0;
                }
            }
            (count > 0.0).then(|| self.center + direction.normalize() * (radius / count))
        })
    }
}

/// What minimises the squares of row·x − value. `None` if rows leave it open.
fn least_squares(rows: impl Iterator<Item = (Vector4<f64>, f64)>) -> Option<Vector4<f64>> {
    let (mut matrix, mut right, mut count) = (Matrix4::zeros(), Vector4::zeros(), 0.0);
    for (row, value) in rows {
        // A product of matrices costs ten times as much.
        matrix.syger(1.0, &row, &row, 1.0);
        right += row * value;
        count += 1.0;
    }
    matrix.fill_upper_triangle_with_lower_triangle();
    let eigen = SymmetricEigen::new(matrix);
    let least = eigen.eigenvalues.min();
    // Rounding leaves some 1e-16 of points in a plane.
    if least.is_nan() || least <= 1e-13 * count {
        return None;
    }
    matrix.cholesky().map(|factor| factor.solve(&right))
}

/// Distances (mm) of points from the plane from which their squares are least. `None` for
/// fewer than three.
pub fn plane_residuals(points: &[DVec3]) -> Option<Vec<f64>> {
    if points.len() < 3 {
        return None;
    }
    let middle = points.iter().sum::<DVec3>() / points.len() as f64;
    let mut moments = Matrix3::zeros();
    for point in points {
        let off = nalgebra::Vector3::from((*point - middle).to_array());
        moments += off * off.transpose();
    }
    let eigen = SymmetricEigen::new(moments);
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let normal = DVec3::new(normal[0], normal[1], normal[2]);
    let residuals = points.iter().map(|&p| normal.dot(p - middle));
    Some(residuals.collect())
}

/// Width of the smallest shell that holds this share of values, at least one of them. `None` without any.
pub fn shell(mut values: Vec<f64>, share: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    // Rounding must not ask for one more.
    let held = (share * values.len() as f64 - 1e-9).ceil().max(1.0) as usize;
    let widths = values
        .windows(held)
        .map(|held| held[held.len() - 1] - held[0]);
    widths.min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    fn cap(sphere: Sphere, half_angle: f64) -> Vec<DVec3> {
        let points = (0..400).map(|i| {
            let (angle, turn) = (half_angle * f64::from(i) / 399.0, 2.4 * f64::from(i));
            let direction = DVec3::new(
                angle.sin() * turn.cos(),
                angle.sin() * turn.sin(),
                angle.cos(),
            );
            sphere.center + sphere.radius * direction
        });
        points.collect()
    }

    /// Of exact points rounding is left: 1e-16 of coordinates, over the cosine's fall 1 − cos θ ≈ 0.06 that
    /// tells centre from radius on the smallest cap.
    #[test]
    fn the_sphere_of_exact_points_is_found() {
        for (center, radius) in [(DVec3::ZERO, 1.0), (DVec3::new(30.0, -70.0, 200.0), 12.5)] {
            for half_angle in [20f64, 45.0, 180.0] {
                let truth = Sphere { center, radius };
                let found = Sphere::fit(&cap(truth, half_angle.to_radians())).unwrap();
                assert!(found.center.distance(center) < 1e-10, "{found:?}");
                assert!((found.radius - radius).abs() < 1e-10, "{found:?}");
            }
        }
    }

    /// Where the sphere stands does not matter, nor where it is looked for: the cap is that about its own centre. Points in
    /// a cap of 60° are 400, evenly over the angle, so that one of 45° has those up to 45/60 of them.
    #[test]
    fn the_cap_is_about_the_sphere_that_is_found() {
        let truth = Sphere {
            center: DVec3::new(0.3, -0.2, 0.1),
            radius: 5.0,
        };
        let points = cap(truth, 60f64.to_radians());
        let found = Sphere::fit_cap(&points, DVec3::ZERO, DVec3::Z, 45f64.to_radians()).unwrap();
        assert!((found.sphere.radius - 5.0).abs() < 1e-10, "{found:?}");
        // 399 · 45/60 = 299.25: from the first to the 300th.
        assert_eq!(found.points, points[..300]);
        let flat = [DVec3::X, DVec3::Y, DVec3::ZERO, -DVec3::X].map(|p| p + DVec3::Z);
        assert_eq!(Sphere::fit_cap(&flat, DVec3::ZERO, DVec3::Z, 1.0), None);
    }

    /// Residuals at the six ends of the axes have a closed form: a bump e at +x is shared as e·(a + ⅙) by a shift
    /// a = e/2 along x and e/6 of the radius, to first order in e (the second is e²/R).
    #[test]
    fn a_bump_moves_the_fit_as_the_closed_form_says() {
        let e = 1e-4;
        let mut points = [DVec3::X, DVec3::Y, DVec3::Z]
            .map(|axis| [axis, -axis])
            .concat();
        points[0] *= 1.0 + e;
        let found = Sphere::fit(&points).unwrap();
        assert!(
            (found.center - DVec3::X * e / 2.0).length() < 2.0 * e * e,
            "{found:?}"
        );
        assert!(
            (found.radius - 1.0 - e / 6.0).abs() < 2.0 * e * e,
            "{found:?}"
        );
    }

    #[test]
    fn what_is_no_sphere_is_refused() {
        let flat: Vec<DVec3> = (0..20)
            .map(|i| DVec3::new(f64::from(i % 5), f64::from(i / 5), 3.0))
            .collect();
        assert_eq!(Sphere::fit(&flat), None);
        assert_eq!(Sphere::fit(&flat[..3]), None);
        assert_eq!(Sphere::fit(&[]), None);
        assert_eq!(Sphere::fit(&[DVec3::ONE; 9]), None);
    }

    #[test]
    fn representative_points_are_on_the_sphere_and_cover_the_cap() {
        let truth = Sphere {
            center: DVec3::new(1.0, 2.0, 3.0),
            radius: 5.0,
        };
        let half_angle = 45f64.to_radians();
        let key = Key::new(1, Purpose::Bootstrap);
        let points: Vec<DVec3> = (0..20_000)
            .map(|i| {
                let z = 1.0 - key.uniform(2 * i) * (1.0 - half_angle.cos());
                let (sin, cos) = (TAU * key.uniform(2 * i + 1)).sin_cos();
                let across = (1.0 - z * z).sqrt();
                truth.center + truth.radius * DVec3::new(across * cos, across * sin, z)
            })
            .collect();
        let found = truth.representative(&points, DVec3::Z, half_angle);
        assert!(
            found
                .iter()
                .all(|p| truth.residual(p.unwrap()).abs() < 1e-12)
        );
        let one_side: Vec<DVec3> = points.into_iter().filter(|p| p.x > 1.0).collect();
        let found = truth.representative(&one_side, DVec3::Z, half_angle);
        assert!(found.iter().any(Option::is_none) && found[0].is_some());
    }

    #[test]
    fn shells_hold_their_share() {
        let values: Vec<f64> = (0..100).map(f64::from).chain([1e6]).collect();
        assert_eq!(shell(values.clone(), 1.0), Some(1e6));
        assert_eq!(shell(values.clone(), 100.0 / 101.0), Some(99.0));
        // 0.95 · 101 = 95.95: 96 values.
        assert_eq!(shell(values, 0.95), Some(95.0));
        assert_eq!(shell(vec![], 0.95), None);
        assert_eq!(shell(vec![3.0], 0.95), Some(0.0));
    }

    #[test]
    fn plane_residuals_are_distances() {
        let tilt = DMat3::from_rotation_x(0.7);
        let place = |x, y, z| tilt * DVec3::new(x, y, z) + DVec3::splat(40.0);
        let corners = [
            place(0.0, 0.0, 0.1),
            place(5.0, 0.0, -0.1),
            place(5.0, 5.0, 0.1),
        ];
        let points = [corners.as_slice(), &[place(0.0, 5.0, -0.1)]].concat();
        let found = plane_residuals(&points).unwrap();
        assert!(
            found.iter().all(|r| (r.abs() - 0.1).abs() < 1e-12),
            "{found:?}"
        );
        assert_eq!(plane_residuals(&points[..2]), None);
    }
}
