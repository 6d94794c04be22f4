//! Lens distortion after Brown (1966) and Conrady (1919).

use crate::math::DVec2;
use glam::DMat2;

/// Maps directions in front of the lens to directions behind it, in normalised coordinates (x, y) =
/// (X/Z, Y/Z) of the camera frame:
///
/// ```text
/// x′ = x·(1 + k₁r² + k₂r⁴ + k₃r⁶) + 2p₁xy + p₂(r² + 2x²),   r² = x² + y²
/// y′ = y·(1 + k₁r² + k₂r⁴ + k₃r⁶) + p₁(r² + 2y²) + 2p₂xy
/// ```
///
/// (x′, y′, 1) is the chief ray behind the lens. Distortion is a property of the lens and its axis.
/// It is applied before the sensor tilt and does not depend on it.
///
/// The Jacobian of the map is symmetric. If its eigenvalues are positive on a disc about the axis,
/// the map is one-to-one on the disc.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Distortion {
    /// Radial coefficients k₁, k₂, k₃.
    pub radial: [f64; 3],
    /// Tangential coefficients p₁, p₂.
    pub tangential: [f64; 2],
    /// Radius r of the disc on which the map is used and is one-to-one.
    #[serde(skip)]
    radius: f64,
    /// Lower bound of the eigenvalues of the Jacobian on the disc.
    #[serde(skip)]
    min_jacobian_eigenvalue: f64,
}

/// Smallest accepted eigenvalue of the Jacobian; a smaller one counts as a fold. At this value the
/// local scale is a tenth of the scale on the axis.
const FOLD_EIGENVALUE: f64 = 0.1;
/// Number of radial steps from the axis to the farthest corner in which the Jacobian is bounded.
const STEPS: f64 = 256.0;
/// Margin beyond the sensor, as a fraction of the radius, on which the map is kept if it has no
/// fold there. Points just outside the sensor then have an image too.
const BEYOND: f64 = 0.2;

impl Distortion {
    /// Creates the distortion for a sensor that extends to the distorted radius `reach`.
    ///
    /// Returns an error that describes the expected distortion if the map folds within this radius.
    pub fn new(radial: [f64; 3], tangential: [f64; 2], reach: f64) -> Result<Distortion, String> {
        let mut lens = Distortion::new_unchecked(radial, tangential);
        let folds = |r: f64| {
            Err(format!(
                "a distortion that does not fold within the sensor, whose corner is at radius \
                 {reach:.4} of the normalised image; this folds, or nearly, at {r:.4}"
            ))
        };
        let step = reach / STEPS;
        lens.radius = 0.0;
        // The image of the circle of radius r encloses the disc of this radius.
        let map = lens;
        let encloses = |r: f64| r * map.scale(r * r) - 3.0 * map.decentring().length() * r * r;
        let mut sensor = f64::INFINITY;
        while lens.radius < (1.0 + BEYOND) * sensor {
            let next = lens.radius + step;
            let stretch = lens.stretch_from(lens.radius, next);
            if stretch.is_nan() || stretch < FOLD_EIGENVALUE {
                if sensor.is_finite() {
                    break;
                }
                return folds(lens.radius);
            }
            lens.min_jacobian_eigenvalue = lens.min_jacobian_eigenvalue.min(stretch);
            lens.radius = next;
            if sensor == f64::INFINITY && encloses(next) >= reach {
                sensor = next;
            }
        }
        let inverts = |i: usize| {
            let (ring, turn) = ((i / 64 + 1) as f64 / 8.0, (i % 64) as f64 / 64.0);
            let seen = DVec2::from_angle(turn * std::f64::consts::TAU) * (reach * ring);
            let x = lens.undistort(seen, seen);
            x.length() <= lens.radius && (lens.distort(x) - seen).length() < 1e-12
        };
        match (0..8 * 64).all(inverts) {
            true => Ok(lens),
            false => folds(lens.radius),
        }
    }

    /// Creates a distortion that is used at all radii without a check for folds. It serves as an
    /// intermediate value during a fit.
    pub fn new_unchecked(radial: [f64; 3], tangential: [f64; 2]) -> Distortion {
        Distortion {
            radial,
            tangential,
            radius: f64::INFINITY,
            min_jacobian_eigenvalue: 1.0,
        }
    }

    /// True if `x` is on the disc on which the map is used.
    pub fn covers(&self, x: DVec2) -> bool {
        x.length_squared() <= self.radius * self.radius
    }

    /// Returns (p₂, p₁) = q; the tangential part is r²·q + 2·(q·x)·x.
    fn decentring(&self) -> DVec2 {
        DVec2::new(self.tangential[1], self.tangential[0])
    }

    /// Returns the radial scale 1 + k₁s + k₂s² + k₃s³ at s = r².
    fn scale(&self, s: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        1.0 + s * (k1 + s * (k2 + s * k3))
    }

    /// Returns the derivative of the radial scale with respect to s = r².
    fn slope(&self, s: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        k1 + s * (2.0 * k2 + s * 3.0 * k3)
    }

    /// Returns (x′, y′).
    pub fn distort(&self, x: DVec2) -> DVec2 {
        let (s, q) = (x.length_squared(), self.decentring());
        x * (self.scale(s) + 2.0 * q.dot(x)) + q * s
    }

    /// Returns (x′, y′). Outside the disc on which the map is used, it is continued linearly from
    /// the boundary.
    pub fn continued(&self, x: DVec2) -> DVec2 {
        let rim = x.clamp_length_max(self.radius);
        self.distort(rim) + self.jacobian(rim) * (x - rim)
    }

    /// Returns the Jacobian ∂(x′, y′)/∂(x, y).
    pub fn jacobian(&self, x: DVec2) -> DMat2 {
        let (s, q) = (x.length_squared(), self.decentring());
        let outer = x * (2.0 * self.slope(s)) + q * 2.0;
        let even = self.scale(s) + 2.0 * q.dot(x);
        DMat2::from_cols(
            outer * x.x + x * (2.0 * q.x) + DVec2::X * even,
            outer * x.y + x * (2.0 * q.y) + DVec2::Y * even,
        )
    }

    /// Returns the ratio of the irradiance behind the lens to the irradiance without distortion at
    /// the same sensor position. For light of the direction x it is (cosθ/cosθ′)⁴/|∂x′/∂x| with
    /// cos²θ = 1/(1 + r²).
    ///
    /// Derivation: a flat entrance pupil of area A receives L·A·cos⁴θ·d²x of the radiance L. This
    /// light falls on |∂x′/∂x|·d²x, where an undistorted lens would image L·A·cos⁴θ′·d²x′.
    pub fn irradiance_jacobian(&self, x: DVec2) -> f64 {
        let secant2 = |x: DVec2| 1.0 + x.length_squared();
        (secant2(self.distort(x)) / secant2(x)).powi(2) / self.jacobian(x).determinant()
    }

    /// Returns an upper bound of [`Self::irradiance_jacobian`] for a sensor that extends to the distorted
    /// radius `reach`.
    pub fn greatest_concentration(&self, reach: f64) -> f64 {
        ((1.0 + reach * reach) / self.min_jacobian_eigenvalue).powi(2)
    }

    /// Returns the derivatives ∂(x′, y′)/∂(k₁, k₂, k₃, p₁, p₂).
    pub fn coefficient_jacobian(&self, x: DVec2) -> [DVec2; 5] {
        let s = x.length_squared();
        let cross = 2.0 * x.x * x.y;
        [
            x * s,
            x * (s * s),
            x * (s * s * s),
            DVec2::new(cross, s + 2.0 * x.y * x.y),
            DVec2::new(s + 2.0 * x.x * x.x, cross),
        ]
    }

    /// Returns the direction (x, y) that is imaged at `seen`.
    ///
    /// Uses Newton's method from `guess` and halves steps that do not reduce the residual. The
    /// result is exact to rounding for directions within the sensor. For other directions it is the
    /// last iterate.
    pub fn undistort(&self, seen: DVec2, guess: DVec2) -> DVec2 {
        let mut x = guess;
        let mut miss = seen - self.distort(x);
        for _ in 0..50 {
            let step = self.jacobian(x).inverse() * miss;
            // The next step would be of the order of the square of this one.
            if step.length_squared() < 1e-18 {
                return x + step;
            }
            let mut share = 1.0;
            loop {
                let next = x + step * share;
                let left = seen - self.distort(next);
                if left.length_squared() < miss.length_squared() || share < 1e-3 {
                    (x, miss) = (next, left);
                    break;
                }
                share /= 2.0;
            }
        }
        x
    }

    /// Returns a lower bound of the eigenvalues of the Jacobian for radii from `a` to `b`. The
    /// eigenvalues of the radial part are the scale and d(r·scale)/dr. The eigenvalues of the
    /// tangential part are at least −6·|p|·r.
    fn stretch_from(&self, a: f64, b: f64) -> f64 {
        let (a2, b2) = (a * a, b * b);
        let least = |factors: [f64; 3]| {
            let (mut low, mut high, mut sum) = (1.0, 1.0, 1.0);
            for (k, factor) in self.radial.iter().zip(factors) {
                (low, high) = (low * a2, high * b2);
                sum += f64::min(k * factor * low, k * factor * high);
            }
            sum
        };
        let radial = f64::min(least([1.0; 3]), least([3.0, 5.0, 7.0]));
        radial - 6.0 * self.decentring().length() * b
    }

    /// Returns a lower bound of the eigenvalues of the Jacobian over the sensor.
    pub fn min_jacobian_eigenvalue(&self) -> f64 {
        self.min_jacobian_eigenvalue
    }

    /// Returns an upper bound of the eigenvalues of the Jacobian within `radius`.
    pub fn max_jacobian_eigenvalue(&self, radius: f64) -> f64 {
        let s = radius * radius;
        let [k1, k2, k3] = self.radial.map(f64::abs);
        1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * 7.0 * k3))
            + 6.0 * self.decentring().length() * radius
    }

    /// Returns a Lipschitz constant of the Jacobian within `radius`. With the scale f, the
    /// derivative of the Jacobian along a unit vector h is 4f″(x·h)²x + 2f′(2(x·h)h + x). The
    /// tangential part adds 2(q + 2(q·h)h).
    pub fn curvature(&self, radius: f64) -> f64 {
        let s = radius * radius;
        let [k1, k2, k3] = self.radial.map(f64::abs);
        let slope = k1 + s * (2.0 * k2 + s * 3.0 * k3);
        let second = 2.0 * k2 + s * 6.0 * k3;
        radius * (6.0 * slope + 4.0 * s * second) + 6.0 * self.decentring().length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Lenses with weak to strong barrel, pincushion and tangential distortion.
    const LENSES: [([f64; 3], [f64; 2]); 5] = [
        ([-0.12, 0.05, 0.0], [0.0, 0.0]),
        ([0.3, -0.2, 0.1], [2e-3, -1e-3]),
        ([-0.25, 0.1, -0.02], [5e-3, 4e-3]),
        ([0.0; 3], [0.02, -0.01]),
        ([1.5, 2.0, 3.0], [0.0, 0.01]),
    ];
    const REACH: f64 = 0.5;

    fn points(n: u64, radius: f64) -> impl Iterator<Item = DVec2> {
        let key = RngKey::new(9, Purpose::SensorNoise);
        (0..n).map(move |i| {
            let turn = key.with(i).uniform(0) * std::f64::consts::TAU;
            DVec2::from_angle(turn) * radius * key.with(i).uniform(1).sqrt()
        })
    }

    #[test]
    fn the_formula_is_that_of_brown() {
        let lens = Distortion::new_unchecked([0.1, 0.2, 0.3], [0.01, 0.02]);
        let (x, y) = (0.3, -0.2);
        let r2: f64 = 0.13;
        let scale = 1.0 + 0.1 * r2 + 0.2 * r2 * r2 + 0.3 * r2.powi(3);
        let expected = DVec2::new(
            x * scale + 0.02 * x * y + 0.02 * (r2 + 2.0 * x * x),
            y * scale + 0.01 * (r2 + 2.0 * y * y) + 0.04 * x * y,
        );
        assert!((lens.distort(DVec2::new(x, y)) - expected).length() < 1e-15);
    }

    /// `undistort` inverts `distort` and vice versa over the sensor, to a few roundings of
    /// coordinates below 1.
    #[test]
    fn undistorting_inverts_distorting() {
        for (radial, tangential) in LENSES {
            let lens = Distortion::new(radial, tangential, REACH).unwrap();
            for seen in points(2000, REACH) {
                let x = lens.undistort(seen, seen);
                assert!(lens.covers(x));
                let back = lens.distort(x);
                assert!((back - seen).length() < 2e-15, "{radial:?} {seen} {back}");
            }
        }
    }

    /// Compares derivatives with differences over 2h = 2e-5. Their error is h²/6 times the third
    /// derivative, which is below 400 here, plus 1e-16/h of rounding.
    #[test]
    fn derivatives_are_those_of_the_map() {
        let h = 1e-5;
        for (radial, tangential) in LENSES {
            let lens = Distortion::new_unchecked(radial, tangential);
            for x in points(50, REACH) {
                for (axis, column) in [
                    (DVec2::X, lens.jacobian(x).x_axis),
                    (DVec2::Y, lens.jacobian(x).y_axis),
                ] {
                    let found =
                        (lens.distort(x + axis * h) - lens.distort(x - axis * h)) / (2.0 * h);
                    assert!((found - column).length() < 2e-8, "{found} {column}");
                }
                for (i, expected) in lens.coefficient_jacobian(x).into_iter().enumerate() {
                    let mut more = lens;
                    match i < 3 {
                        true => more.radial[i] += 1.0,
                        false => more.tangential[i - 3] += 1.0,
                    }
                    let found = more.distort(x) - lens.distort(x);
                    assert!((found - expected).length() < 1e-14);
                }
            }
        }
    }

    /// Distances between image points respect the bounds of the eigenvalues, and chords respect the
    /// bound of the curvature. For radial distortion the bounds are tight.
    #[test]
    fn bounds_hold() {
        for (radial, tangential) in LENSES {
            let lens = Distortion::new(radial, tangential, REACH).unwrap();
            let radius = lens.radius;
            let (least, most) = (
                lens.min_jacobian_eigenvalue(),
                lens.max_jacobian_eigenvalue(radius),
            );
            let curvature = lens.curvature(radius);
            let mut sharpest: f64 = 0.0;
            let all: Vec<DVec2> = points(4000, radius).collect();
            for pair in all.chunks(2) {
                let way = pair[1] - pair[0];
                let moved = lens.distort(pair[1]) - lens.distort(pair[0]);
                let stretch = moved.length() / way.length();
                assert!(
                    (least..=most).contains(&stretch),
                    "{least} {stretch} {most}"
                );
                let straight = lens.jacobian(pair[0]) * way;
                let bend = 2.0 * (moved - straight).length() / way.length_squared();
                sharpest = sharpest.max(bend / curvature);
            }
            assert!((0.1..=1.0).contains(&sharpest), "{radial:?} {sharpest}");
        }
    }

    /// Barrel distortion folds where 1 + 3k₁r² = 0, that is at r = 1/√(−3k₁) and r′ = 2r/3. With k₁
    /// = −1 the fold is at r′ = 0.385.
    #[test]
    fn a_fold_within_the_sensor_is_refused() {
        assert!(Distortion::new([-1.0, 0.0, 0.0], [0.0; 2], 0.37).is_ok());
        for reach in [0.39, 1.0, 100.0] {
            let refused = Distortion::new([-1.0, 0.0, 0.0], [0.0; 2], reach);
            assert!(refused.unwrap_err().contains("folds"), "{reach}");
        }
        for wild in [f64::NAN, f64::INFINITY, -1e300] {
            assert!(Distortion::new([wild, 0.0, 0.0], [0.0; 2], 0.3).is_err());
            assert!(Distortion::new([0.0; 3], [wild, 0.0], 0.3).is_err());
        }
    }
}
