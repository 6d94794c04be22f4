//! Artefacts of acceptance tests: spherical caps and plates.

use super::features::Element;
use crate::math::{DMat3, DVec3};
use std::f64::consts::TAU;

/// Sphere, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub center: DVec3,
    /// Radius.
    pub radius: f64,
}

/// Points of a spherical cap, and the fitted sphere.
#[derive(Debug, Clone, PartialEq)]
pub struct Cap {
    /// Sphere fitted to `points` by least squares.
    pub sphere: Sphere,
    /// Points within the half angle of the cap, as viewed from the sphere centre.
    pub points: Vec<DVec3>,
}

/// Maximum number of times that the cap is selected again about the fitted sphere.
const MOST_CAPS: usize = 5;

impl Sphere {
    /// Fits a sphere by least squares of the radial distances. Returns `None` for fewer than four
    /// points or coplanar points.
    pub fn fit(points: &[DVec3]) -> Option<Sphere> {
        let Element { frame, radius, .. } = Element::sphere(points)?;
        Some(Sphere {
            center: frame.translation,
            radius,
        })
    }

    /// Fits a sphere to the points of the cap of the given half angle (rad) about `up`.
    ///
    /// `points` may extend beyond the cap. The iteration starts from the cap about `center` and
    /// selects the cap about the fitted sphere.
    pub fn fit_cap(points: &[DVec3], center: DVec3, up: DVec3, half_angle: f64) -> Option<Cap> {
        let least = half_angle.cos();
        let of_cap = |center: DVec3| -> Vec<DVec3> {
            let inside = |p: &&DVec3| (**p - center).dot(up) >= least * p.distance(center);
            points.iter().filter(inside).copied().collect()
        };
        let mut points = of_cap(center);
        let mut sphere = Sphere::fit(&points)?;
        // The centre converges, because only points at the rim change between iterations.
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

    /// Returns the signed distance of a point from the sphere, positive outside, mm.
    pub fn residual(&self, point: DVec3) -> f64 {
        point.distance(self.center) - self.radius
    }

    /// Returns the 25 representative points of a cap of the given half angle (rad) about `up`.
    ///
    /// The directions cover the area of the cap uniformly: the pole, and rings of 4, 8 and 12
    /// directions at 0.3, 0.6 and 0.9 of the half angle. Each representative point has the mean
    /// direction and mean radius of the points within 0.15 of the half angle. It is `None` if no
    /// point is within this angle.
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

/// Returns the distances (mm) of points from their least-squares plane. Returns `None` for fewer
/// than three points.
pub fn plane_residuals(points: &[DVec3]) -> Option<Vec<f64>> {
    Some(Element::plane(points)?.distances(points))
}

/// Returns the width of the narrowest interval that contains the fraction `share` of the values, at
/// least one value. Returns `None` without values.
pub fn shortest_interval(mut values: Vec<f64>, share: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    // Rounding must not add another value.
    let held = (share * values.len() as f64 - 1e-9).ceil().max(1.0) as usize;
    let widths = values
        .windows(held)
        .map(|held| held[held.len() - 1] - held[0]);
    widths.min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

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

    /// The fit recovers the sphere of exact points. The error is the rounding of coordinates,
    /// 1e-16, divided by 1 − cos θ ≈ 0.06, which separates centre and radius on the smallest cap.
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

    /// The selected cap is centred on the sphere, independent of the position and the initial
    /// centre.
    ///
    /// The 400 points cover a cap of 60° with constant angular spacing. A cap of 45° contains the
    /// first 45/60 of them.
    #[test]
    fn the_cap_is_about_the_sphere_that_is_found() {
        let truth = Sphere {
            center: DVec3::new(0.3, -0.2, 0.1),
            radius: 5.0,
        };
        let points = cap(truth, 60f64.to_radians());
        let found = Sphere::fit_cap(&points, DVec3::ZERO, DVec3::Z, 45f64.to_radians()).unwrap();
        assert!((found.sphere.radius - 5.0).abs() < 1e-10, "{found:?}");
        // 399 · 45/60 = 299.25: the first 300 points.
        assert_eq!(found.points, points[..300]);
        let flat = [DVec3::X, DVec3::Y, DVec3::ZERO, -DVec3::X].map(|p| p + DVec3::Z);
        assert_eq!(Sphere::fit_cap(&flat, DVec3::ZERO, DVec3::Z, 1.0), None);
    }

    /// Residuals at the six ends of the axes have a closed form. A bump e at +x shifts the centre
    /// by e/2 along x and increases the radius by e/6, to first order in e. The second order is
    /// e²/R.
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
        let key = RngKey::new(1, Purpose::Bootstrap);
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
        assert_eq!(shortest_interval(values.clone(), 1.0), Some(1e6));
        assert_eq!(shortest_interval(values.clone(), 100.0 / 101.0), Some(99.0));
        // 0.95 · 101 = 95.95: 96 values.
        assert_eq!(shortest_interval(values, 0.95), Some(95.0));
        assert_eq!(shortest_interval(vec![], 0.95), None);
        assert_eq!(shortest_interval(vec![3.0], 0.95), Some(0.0));
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
