//! Geometric elements and their least-squares and minimum-zone fits to points.

use crate::math::{DMat3, DVec3, Rigid};
use glam::DQuat;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix4, Matrix6, SymmetricEigen, Vector4, Vector6};
use serde::Serialize;

/// Shape of an element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// Plane z = 0 of the frame.
    Plane,
    /// Line along x in a section of a surface whose normal is z.
    Line,
    /// Circle about z: points of a bore or shaft projected along its nominal axis.
    Circle,
    /// Cylinder about z.
    Cylinder,
    /// Sphere about the origin.
    Sphere,
    /// Cone about z, whose radius grows along z.
    Cone,
}

/// Element in the part frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element {
    /// Shape.
    pub shape: Shape,
    /// Pose of the element's frame.
    pub frame: Rigid,
    /// Radius, mm; for a cone at the origin of the frame.
    pub radius: f64,
    /// Half of the cone's apex angle, rad.
    pub half_angle: f64,
}

/// Signed distance of a point from an element, and its derivatives.
#[derive(Debug, Clone)]
pub struct Residual {
    /// Signed distance, mm.
    pub distance: f64,
    /// Derivative of the distance with respect to the point, part frame: the surface normal.
    pub normal: DVec3,
    /// Derivatives of the distance with respect to the parameters, with opposite sign; zero beyond
    /// the number of parameters.
    pub row: Vector6<f64>,
}

/// Maximum number of Gauss–Newton steps.
const MOST_STEPS: usize = 100;
/// Step, relative to the extent of the points, below which rounding dominates.
const LEAST_STEP: f64 = 1e-13;
/// Step, relative to the extent of the points, below which a step that is not halved is rounding.
const STALLED: f64 = 1e-9;
/// Smallest eigenvalue of the normalised normal matrix, relative to the largest, of points that
/// determine all parameters. Rounding gives about 1e-16.
const DETERMINED: f64 = 1e-11;

impl Shape {
    /// Returns the number of parameters.
    pub fn parameters(self) -> usize {
        match self {
            Shape::Line => 2,
            Shape::Plane | Shape::Circle => 3,
            Shape::Sphere => 4,
            Shape::Cylinder => 5,
            Shape::Cone => 6,
        }
    }

    /// Returns the name in scene files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Shape::Plane => "plane",
            Shape::Line => "line",
            Shape::Circle => "circle",
            Shape::Cylinder => "cylinder",
            Shape::Sphere => "sphere",
            Shape::Cone => "cone",
        }
    }

    /// Returns the default angle between neighbouring triangles at which a face of this shape ends,
    /// degrees.
    pub(crate) fn crease_deg(self) -> f64 {
        match self {
            Shape::Plane | Shape::Line => 1.0,
            _ => 30.0,
        }
    }

    /// True if the shape is a surface of revolution about the z axis of its frame.
    pub fn is_round(self) -> bool {
        matches!(self, Shape::Circle | Shape::Cylinder | Shape::Cone)
    }
}

impl Element {
    /// Fits a sphere to points by least squares. Returns `None` for fewer than four points or
    /// coplanar points.
    pub fn sphere(points: &[DVec3]) -> Option<Element> {
        let middle = points.iter().sum::<DVec3>() / points.len() as f64;
        let size = extent(points);
        if points.len() < 4 || size.is_nan() || size <= 0.0 {
            return None;
        }
        // |p|² = 2·c·p + (R² − |c|²) is linear in the unknowns and gives the initial value.
        let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for &point in points {
            let p = (point - middle) / size;
            let row = Vector4::new(2.0 * p.x, 2.0 * p.y, 2.0 * p.z, 1.0);
            matrix.syger(1.0, &row, &row, 1.0);
            right += row * p.length_squared();
        }
        matrix.fill_upper_triangle_with_lower_triangle();
        let least = SymmetricEigen::new(matrix).eigenvalues.min();
        // For coplanar points, rounding gives a relative eigenvalue of about 1e-16.
        if least.is_nan() || least <= 1e-13 * points.len() as f64 {
            return None;
        }
        let start = matrix.cholesky()?.solve(&right);
        let center = DVec3::new(start.x, start.y, start.z);
        let radius = (start.w + center.length_squared()).max(0.0).sqrt();
        let start = Element {
            shape: Shape::Sphere,
            frame: Rigid::translation(middle + center * size),
            radius: radius * size,
            half_angle: 0.0,
        };
        start.fitted(points, None)
    }

    /// Fits a plane to points by least squares of the normal distances. Returns `None` for fewer
    /// than three points.
    pub fn plane(points: &[DVec3]) -> Option<Element> {
        if points.len() < 3 {
            return None;
        }
        let middle = points.iter().sum::<DVec3>() / points.len() as f64;
        let mut moments = Matrix3::zeros();
        for point in points {
            let p = *point - middle;
            let p = nalgebra::Vector3::new(p.x, p.y, p.z);
            moments.syger(1.0, &p, &p, 1.0);
        }
        moments.fill_upper_triangle_with_lower_triangle();
        let eigen = SymmetricEigen::new(moments);
        let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin());
        let normal = DVec3::new(normal[0], normal[1], normal[2]);
        let hint = normal.any_orthonormal_vector();
        Some(Element {
            shape: Shape::Plane,
            frame: Rigid::from_z_and_x(middle, normal, hint)?,
            radius: 0.0,
            half_angle: 0.0,
        })
    }

    /// Returns the distance of a point from the element.
    pub fn residual(&self, point: DVec3) -> Residual {
        let p = self.frame.inverse().point(point);
        let across = p.x.hypot(p.y).max(f64::MIN_POSITIVE);
        let (x, y) = (p.x / across, p.y / across);
        let (sin, cos) = self.half_angle.sin_cos();
        let (distance, normal, row) = match self.shape {
            Shape::Plane => (p.z, DVec3::Z, [1.0, p.x, p.y, 0.0, 0.0, 0.0]),
            Shape::Line => (p.z, DVec3::Z, [1.0, p.x, 0.0, 0.0, 0.0, 0.0]),
            Shape::Circle => {
                let normal = DVec3::new(x, y, 0.0);
                (across - self.radius, normal, [x, y, 1.0, 0.0, 0.0, 0.0])
            }
            Shape::Cylinder => {
                let normal = DVec3::new(x, y, 0.0);
                let row = [x, y, x * p.z, y * p.z, 1.0, 0.0];
                (across - self.radius, normal, row)
            }
            Shape::Sphere => {
                let length = p.length().max(f64::MIN_POSITIVE);
                let n = p / length;
                (length - self.radius, n, [n.x, n.y, n.z, 1.0, 0.0, 0.0])
            }
            Shape::Cone => {
                let out = across - self.radius;
                let row = [
                    cos * x,
                    cos * y,
                    cos * x * p.z + sin * p.x,
                    cos * y * p.z + sin * p.y,
                    cos,
                    out * sin + p.z * cos,
                ];
                let normal = DVec3::new(cos * x, cos * y, -sin);
                (out * cos - p.z * sin, normal, row)
            }
        };
        Residual {
            distance,
            normal: self.frame.vector(normal),
            row: Vector6::from(row),
        }
    }

    /// Returns the element after a change of its parameters: displacements in mm, rotations in rad,
    /// radius and half angle.
    pub fn changed(&self, by: &DVector<f64>) -> Element {
        let mut next = *self;
        let (shift, turn) = match self.shape {
            Shape::Plane => (DVec3::Z * by[0], DVec3::new(by[2], -by[1], 0.0)),
            Shape::Line => (DVec3::Z * by[0], DVec3::new(0.0, -by[1], 0.0)),
            Shape::Circle | Shape::Sphere => (DVec3::new(by[0], by[1], 0.0), DVec3::ZERO),
            Shape::Cylinder | Shape::Cone => (
                DVec3::new(by[0], by[1], 0.0),
                DVec3::new(-by[3], by[2], 0.0),
            ),
        };
        let shift = match self.shape {
            Shape::Sphere => shift + DVec3::Z * by[2],
            _ => shift,
        };
        match self.shape {
            Shape::Circle => next.radius += by[2],
            Shape::Sphere => next.radius += by[3],
            Shape::Cylinder | Shape::Cone => next.radius += by[4],
            Shape::Plane | Shape::Line => {}
        }
        if self.shape == Shape::Cone {
            next.half_angle += by[5];
        }
        next.frame = self.frame
            * Rigid {
                rotation: DMat3::from_quat(DQuat::from_scaled_axis(turn)),
                translation: shift,
            };
        next
    }

    /// Returns the element whose origin is where the element meets the normal or the normal plane
    /// at the origin of `nominal`. The surface is unchanged.
    pub fn anchored(mut self, nominal: &Element) -> Element {
        let [z, along] = [self.frame.rotation.z_axis, nominal.frame.rotation.z_axis];
        let away = nominal.frame.translation - self.frame.translation;
        match self.shape {
            Shape::Plane | Shape::Line => {
                let height = z.dot(-away) / z.dot(along);
                self.frame.translation = nominal.frame.translation + along * height;
            }
            Shape::Circle | Shape::Cylinder | Shape::Cone => {
                let step = along.dot(away) / along.dot(z);
                self.frame.translation += z * step;
                self.radius += step * self.half_angle.tan();
            }
            Shape::Sphere => {}
        }
        self
    }

    /// Fits the element to points by weighted least squares, from this element as initial value.
    /// Returns `None` if the points do not determine all parameters.
    pub fn fitted(&self, points: &[DVec3], weights: Option<&[f64]>) -> Option<Element> {
        if points.len() < self.shape.parameters() {
            return None;
        }
        let mut element = *self;
        let size = extent(points).max(f64::MIN_POSITIVE);
        let mut before = f64::INFINITY;
        for _ in 0..MOST_STEPS {
            let normal = NormalEquations::of(&element, points, weights);
            let step = normal.solve()?;
            element = element.changed(&step);
            // A rotation by 1/size displaces the points by about 1.
            let moved = step.iter().fold(0.0, |most: f64, s| most.max(s.abs()));
            if moved.is_nan() {
                return None;
            }
            // Far from the origin, rounding stops the steps from becoming smaller.
            let stalled = moved < STALLED * size && moved > before / 2.0;
            if stalled || moved <= LEAST_STEP * size.max(1.0 / size) {
                break;
            }
            before = moved;
        }
        let sound = element.frame.translation.is_finite()
            && element.radius.is_finite()
            && element.half_angle.abs() < std::f64::consts::FRAC_PI_2;
        (sound && (element.radius > 0.0 || !self.has_radius())).then_some(element)
    }

    fn has_radius(&self) -> bool {
        matches!(self.shape, Shape::Circle | Shape::Cylinder | Shape::Sphere)
    }

    /// Returns the signed distances of points from the element.
    pub fn distances(&self, points: &[DVec3]) -> Vec<f64> {
        points.iter().map(|&p| self.residual(p).distance).collect()
    }

    /// Returns the element of the minimum zone: the largest distance of a point is as small as
    /// possible (Chebyshev fit), which makes the zone that contains all points as narrow as
    /// possible. The zone is at most 0.1 % wider than the minimum.
    ///
    /// An exchange method adds the farthest points to a small set until no point is farther than
    /// the set. Lawson's weights give the fit to the set.
    pub fn minimum_zone(&self, points: &[DVec3]) -> Option<Element> {
        const MOST_EXCHANGES: usize = 60;
        const EXCESS: f64 = 1e-3;
        let mut best = *self;
        let mut least = width(&best.distances(points));
        let mut set: Vec<usize> = Vec::new();
        let mut element = *self;
        for _ in 0..MOST_EXCHANGES {
            let distances = element.distances(points);
            let ends = extremes(&distances)?;
            let before = set.len();
            for i in ends {
                if !set.contains(&i) {
                    set.push(i);
                }
            }
            // Points between the extremes keep the small set determined.
            if before == 0 {
                let stride = points.len().div_ceil(4 * self.shape.parameters()).max(1);
                set.extend(
                    (0..points.len())
                        .step_by(stride)
                        .filter(|i| !ends.contains(i)),
                );
            }
            let of_set: Vec<DVec3> = set.iter().map(|&i| points[i]).collect();
            let (next, of_set_width) = element.lawson(&of_set);
            element = next;
            let all = width(&element.distances(points));
            if all < least {
                (best, least) = (element, all);
            }
            if all <= of_set_width * (1.0 + EXCESS) || set.len() == before {
                break;
            }
        }
        Some(best)
    }

    /// Returns the Chebyshev fit to a few points by iterated weights (Lawson 1961), and the width
    /// of its zone.
    fn lawson(&self, points: &[DVec3]) -> (Element, f64) {
        const MOST_ITERATIONS: usize = 2000;
        const SETTLED: f64 = 2e-4;
        let n = points.len();
        let mut weights = vec![1.0 / n as f64; n];
        let mut element = *self;
        let mut best = (element, f64::INFINITY);
        for _ in 0..MOST_ITERATIONS {
            // Weights of few points may no longer determine the element.
            let Some(step) = NormalEquations::of(&element, points, Some(&weights)).solve() else {
                break;
            };
            element = element.changed(&step);
            let distances = element.distances(points);
            let largest = distances.iter().fold(0.0, |most: f64, d| most.max(d.abs()));
            if 2.0 * largest < best.1 {
                best = (element, 2.0 * largest);
            }
            // The weighted mean of the squares is a lower limit of the minimum.
            let squares: f64 = distances.iter().zip(&weights).map(|(d, w)| w * d * d).sum();
            if largest == 0.0 || squares.sqrt() >= largest * (1.0 - SETTLED) {
                break;
            }
            let scaled: Vec<f64> = distances
                .iter()
                .zip(&weights)
                .map(|(d, w)| w * d.abs() / largest)
                .collect();
            let sum: f64 = scaled.iter().sum();
            weights = scaled.iter().map(|w| w / sum).collect();
        }
        best
    }
}

/// Sums of the normal equations M·δ = b of a small change δ of the parameters.
pub struct NormalEquations {
    parameters: usize,
    matrix: Matrix6<f64>,
    right: Vector6<f64>,
}

impl NormalEquations {
    /// Sums the rows of all points.
    pub fn of(element: &Element, points: &[DVec3], weights: Option<&[f64]>) -> NormalEquations {
        let mut sums = NormalEquations {
            parameters: element.shape.parameters(),
            matrix: Matrix6::zeros(),
            right: Vector6::zeros(),
        };
        for (i, &point) in points.iter().enumerate() {
            let Residual { distance, row, .. } = element.residual(point);
            let weight = weights.map_or(1.0, |weights| weights[i]);
            sums.matrix.syger(weight, &row, &row, 1.0);
            sums.right.axpy(weight * distance, &row, 1.0);
        }
        sums.matrix.fill_upper_triangle_with_lower_triangle();
        sums
    }

    /// Returns the inverse of M; `None` if the points do not determine all parameters.
    pub fn inverse(&self) -> Option<DMatrix<f64>> {
        let n = self.parameters;
        // Parameters in mm and in rad are made comparable.
        let scale = DVector::from_fn(n, |i, _| 1.0 / self.matrix[(i, i)].sqrt());
        if !scale.iter().all(|s| s.is_finite()) {
            return None;
        }
        let scaled = DMatrix::from_fn(n, n, |i, j| self.matrix[(i, j)] * scale[i] * scale[j]);
        let eigen = SymmetricEigen::new(scaled);
        let [least, most] = [eigen.eigenvalues.min(), eigen.eigenvalues.max()];
        if least.is_nan() || least <= DETERMINED * most {
            return None;
        }
        let values = eigen.eigenvalues.map(|value| 1.0 / value);
        let inverse =
            &eigen.eigenvectors * DMatrix::from_diagonal(&values) * eigen.eigenvectors.transpose();
        Some(DMatrix::from_fn(n, n, |i, j| {
            inverse[(i, j)] * scale[i] * scale[j]
        }))
    }

    fn solve(&self) -> Option<DVector<f64>> {
        Some(self.inverse()? * self.right.rows(0, self.parameters))
    }
}

/// Returns the difference of the largest and the smallest value; 0 without values.
pub fn width(values: &[f64]) -> f64 {
    let [low, high] = values
        .iter()
        .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], &v| {
            [low.min(v), high.max(v)]
        });
    (high - low).max(0.0)
}

fn extremes(values: &[f64]) -> Option<[usize; 2]> {
    let order = |a: &usize, b: &usize| values[*a].total_cmp(&values[*b]);
    Some([
        (0..values.len()).min_by(order)?,
        (0..values.len()).max_by(order)?,
    ])
}

/// Returns the root mean square distance of points from their centroid.
pub fn extent(points: &[DVec3]) -> f64 {
    let n = points.len() as f64;
    let center = points.iter().sum::<DVec3>() / n;
    let squares: f64 = points.iter().map(|p| p.distance_squared(center)).sum();
    (squares / n).sqrt()
}
