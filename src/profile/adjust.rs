//! A calibration from images of a target: least squares over all views at once.
//!
//! Known is where the target stood in the head's frame in each view (a stage with
//! scales carries it, and the target itself is measured), the sensor's pitch and
//! the tilt of the sensor, which is a choice of axes (see `CameraModel`). Estimated
//! are the camera's principal distance and point, its distortion, its pose in the
//! head, which is the one that turns its points into the head's frame and so into
//! the part's, and the laser plane.

use super::calibration::{Calibration, PARAMETERS, Parameters, coefficients};
use crate::camera::Distortion;
use crate::math::{DVec2, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// A dot of the target in one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dot {
    /// Where it is, head's frame, mm.
    pub position: DVec3,
    /// Where its image is, (column, row).
    pub pixel: DVec2,
    /// Standard uncertainty of each coordinate of `pixel`.
    pub sigma_px: f64,
}

/// The laser line on the target, in one column of one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePoint {
    /// A point of the target's plane and its normal, head's frame.
    pub target_point: DVec3,
    /// Unit vector.
    pub target_normal: DVec3,
    /// Middle of the column, and row of the peak. All have the same uncertainty in
    /// row, which is found from how far they stray, and are independent.
    pub pixel: DVec2,
}

/// What all views of the target gave.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Observations {
    /// Of all views.
    pub dots: Vec<Dot>,
    /// Peaks of all views.
    pub line: Vec<LinePoint>,
}

/// What [`adjust`] finds.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjustment {
    /// The estimates with their covariance.
    pub calibration: Calibration,
    /// Found minus predicted, pixels.
    pub dot_residuals: Vec<DVec2>,
    /// The same along the rows.
    pub line_residuals: Vec<f64>,
    /// Standard deviation of a peak's row, from the residuals.
    pub line_sigma_px: f64,
    /// Steps that the adjustment took.
    pub iterations: usize,
}

/// Row noise of peaks at first, pixels; what it is changes only how the first of
/// three adjustments weighs line against dots.
const FIRST_LINE_SIGMA: f64 = 0.1;
/// Share of its information that a parameter may keep to itself: with less, all its
/// effects but a millionth part are those of the others, and rounding decides.
const LEAST_INDEPENDENCE: f64 = 1e-12;

/// Whether the parameter is one of the distortion.
fn of_lens(parameter: usize) -> bool {
    (3..8).contains(&parameter)
}

/// One weighing of the observations.
struct Problem<'a> {
    observations: &'a Observations,
    line_sigma: f64,
    /// Those of [`PARAMETERS`] that are estimated, and the steps by which their
    /// derivatives are taken.
    free: Vec<(usize, f64)>,
}

/// A calibration with its weighted residuals and their sum of squares.
struct State {
    calibration: Calibration,
    residuals: DVector<f64>,
    cost: f64,
}

/// Normal equations, each parameter scaled to unit information.
struct Normal {
    factors: Cholesky<f64, Dyn>,
    gradient: DVector<f64>,
    scale: DVector<f64>,
}

/// Fits a calibration by Levenberg's and Marquardt's method (Marquardt 1963), from
/// `start`: nominal values, some per cent off at most. The lens distorts if that of
/// `start` does. The covariance is the inverse of the normal matrix.
///
/// Errors, as a sentence: observations that do not determine a parameter, or from
/// which `start` is too far off.
pub fn adjust(start: &Calibration, observations: &Observations) -> Result<Adjustment, String> {
    let distorts = start.camera.distortion.is_some();
    let reach = start
        .camera
        .reach()
        .ok_or("the sensor is not behind the lens")?;
    let free = (0..PARAMETERS.len()).filter(|&i| distorts || !of_lens(i));
    let mut problem = Problem {
        observations,
        line_sigma: FIRST_LINE_SIGMA,
        free: free.map(|i| (i, step(i, reach))).collect(),
    };
    let known = 2 * observations.dots.len() + observations.line.len();
    if known <= problem.free.len() || observations.line.len() <= 3 {
        return Err(format!(
            "the views give {} dots and {} points of the laser line, too few for {} parameters",
            observations.dots.len(),
            observations.line.len(),
            problem.free.len()
        ));
    }
    let mut iterations = 0;
    let mut calibration = with_plane_point_amid(start, observations);
    // The third finds the weights of the second.
    for _ in 0..3 {
        let state = problem.minimise(calibration, &mut iterations)?;
        let dots = 2 * observations.dots.len();
        let line = state.residuals.rows_range(dots..);
        let freedom = observations.line.len() as f64 - 3.0;
        // Of peaks that fit perfectly rounding is left.
        problem.line_sigma = (problem.line_sigma * line.norm() / freedom.sqrt()).max(1e-9);
        calibration = state.calibration;
    }
    let state = problem
        .state(calibration)
        .ok_or("the fit left what the camera sees")?;
    let mut calibration = problem.with_covariance(&state)?;
    if distorts {
        let [k1, k2, k3, p1, p2] = coefficients(&calibration.camera);
        let reach = calibration
            .camera
            .reach()
            .ok_or("the sensor is not behind the lens")?;
        let lens = Distortion::new([k1, k2, k3], [p1, p2], reach);
        calibration.camera.distortion =
            Some(lens.map_err(|e| format!("the views give a lens that folds; expected {e}"))?);
    }
    let (dots, line) = state
        .residuals
        .as_slice()
        .split_at(2 * observations.dots.len());
    Ok(Adjustment {
        calibration,
        dot_residuals: dots
            .chunks(2)
            .zip(&observations.dots)
            .map(|(r, dot)| DVec2::new(r[0], r[1]) * dot.sigma_px)
            .collect(),
        line_residuals: line.iter().map(|r| r * problem.line_sigma).collect(),
        line_sigma_px: problem.line_sigma,
        iterations,
    })
}

/// Cholesky's factors of a symmetric matrix. Errors: the first row that, with those before
/// it, leaves the matrix not positive definite.
fn factorise(matrix: &DMatrix<f64>) -> Result<Cholesky<f64, Dyn>, usize> {
    let leading = |rows: usize| matrix.view((0, 0), (rows, rows)).clone_owned().cholesky();
    let rows = matrix.nrows();
    leading(rows).ok_or_else(|| {
        (0..rows)
            .find(|&row| leading(row + 1).is_none())
            .unwrap_or(0)
    })
}

/// Half the interval over which a derivative is taken: small against the lengths
/// over which images bend, and large against rounding.
fn step(parameter: usize, reach: f64) -> f64 {
    match parameter {
        1 | 2 => 0.1,
        // So that the sensor's corner moves by a ten-thousandth of the image.
        3..=5 => 1e-4 / reach.powi(2 * (parameter as i32 - 2)),
        6 | 7 => 1e-4 / reach,
        8..=10 | 15 | 16 => 1e-5,
        _ => 1e-2,
    }
}

/// Far from the points that determine it, a plane's offset depends on its tilt.
fn with_plane_point_amid(start: &Calibration, observations: &Observations) -> Calibration {
    let points = observations.line.iter();
    let points: Vec<DVec3> = points.filter_map(|p| start.point_at(p.pixel)).collect();
    let mut calibration = start.clone();
    if !points.is_empty() {
        calibration.plane_point = points.iter().sum::<DVec3>() / points.len() as f64;
    }
    calibration
}

impl Problem<'_> {
    /// `None` if a dot has no image.
    fn state(&self, calibration: Calibration) -> Option<State> {
        let Observations { dots, line } = self.observations;
        let mut residuals = Vec::with_capacity(2 * dots.len() + line.len());
        let camera_from_head = calibration.head_from_camera.inverse();
        for dot in dots {
            let image = calibration
                .camera
                .project(camera_from_head.point(dot.position))?;
            let residual = (dot.pixel - image) / dot.sigma_px;
            residuals.extend([residual.x, residual.y]);
        }
        for point in line {
            residuals.push(row_residual(&calibration, point) / self.line_sigma);
        }
        let residuals = DVector::from_vec(residuals);
        let cost = residuals.norm_squared();
        cost.is_finite().then_some(State {
            calibration,
            residuals,
            cost,
        })
    }

    fn normal(&self, state: &State, damping: f64) -> Result<Normal, String> {
        let beyond = || "the fit left what the camera sees".to_owned();
        let mut columns = Vec::new();
        for &(i, step) in &self.free {
            let moved = |by: f64| {
                let mut change: Parameters = [0.0; PARAMETERS.len()];
                change[i] = by;
                self.state(state.calibration.perturbed(&change))
                    .ok_or_else(beyond)
            };
            let (more, less) = (moved(step)?, moved(-step)?);
            columns.push((more.residuals - less.residuals) / (2.0 * step));
        }
        let columns = DMatrix::from_columns(&columns);
        let scale = DVector::from_iterator(
            columns.ncols(),
            columns.column_iter().map(|column| 1.0 / column.norm()),
        );
        let mut matrix = columns
            .tr_mul(&columns)
            .component_mul(&(&scale * scale.transpose()));
        matrix.fill_diagonal(1.0 + damping - LEAST_INDEPENDENCE);
        let factors = factorise(&matrix).map_err(|row| {
            format!(
                "the views do not determine {}: what it changes in the images, the parameters \
                 before it change as well. Views of the target at several heights and tilts do",
                PARAMETERS[self.free[row].0]
            )
        })?;
        Ok(Normal {
            factors,
            gradient: -columns.tr_mul(&state.residuals).component_mul(&scale),
            scale,
        })
    }

    /// `start` moved to the least sum of squares.
    fn minimise(&self, start: Calibration, iterations: &mut usize) -> Result<State, String> {
        let far = "the views are too far from what the nominal values predict";
        let mut state = self.state(start).ok_or(far)?;
        let mut damping = 1e-3;
        for _ in 0..200 {
            *iterations += 1;
            let normal = self.normal(&state, damping)?;
            let scaled = normal.factors.solve(&normal.gradient);
            let mut by: Parameters = [0.0; PARAMETERS.len()];
            for (k, &(i, _)) in self.free.iter().enumerate() {
                by[i] = scaled[k] * normal.scale[k];
            }
            // In units of what the observations can tell.
            let length = scaled.norm();
            match self.state(state.calibration.perturbed(&by)) {
                Some(next) if next.cost <= state.cost => {
                    let done = length < 1e-6 && damping < 1e-6;
                    (state, damping) = (next, damping / 10.0);
                    if done {
                        return Ok(state);
                    }
                }
                // At the minimum rounding decides which is less.
                _ if length < 1e-6 => return Ok(state),
                _ => damping = (damping * 10.0).min(1e9),
            }
        }
        Err(format!("{far}: the fit did not end in 200 steps"))
    }

    fn with_covariance(&self, state: &State) -> Result<Calibration, String> {
        let normal = self.normal(state, 0.0)?;
        let mut calibration = state.calibration.clone();
        let inverse = normal.factors.inverse();
        for (k, &(j, _)) in self.free.iter().enumerate() {
            for (l, &(i, _)) in self.free.iter().enumerate().skip(k) {
                let value = inverse[(l, k)] * normal.scale[l] * normal.scale[k];
                calibration.covariance[i][j] = value;
                calibration.covariance[j][i] = value;
            }
        }
        Ok(calibration)
    }
}

/// How far the peak lies beside where the laser plane cuts the target, rows: the
/// distance from the plane of the point of the target that the pixel sees, over
/// what that changes by from row to row.
fn row_residual(calibration: &Calibration, point: &LinePoint) -> f64 {
    let distance = |pixel: DVec2| {
        let direction = calibration.camera.direction(pixel);
        let pose = &calibration.head_from_camera;
        let to_target = point
            .target_normal
            .dot(point.target_point - pose.translation);
        let t = to_target / point.target_normal.dot(pose.vector(direction));
        calibration
            .plane_normal
            .dot(direction * t - calibration.plane_point)
    };
    let half = DVec2::Y * 0.5;
    let slope = distance(point.pixel + half) - distance(point.pixel - half);
    distance(point.pixel) / slope
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_row_that_is_not_independent_is_named() {
        let refused = |rows: usize, values: &[f64]| {
            factorise(&DMatrix::from_row_slice(rows, rows, values)).err()
        };
        assert_eq!(refused(2, &[1.0, 1.0, 1.0, 1.0]), Some(1));
        assert_eq!(
            refused(3, &[2.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0]),
            Some(1)
        );
        assert_eq!(refused(1, &[f64::NAN]), Some(0));
        assert_eq!(refused(2, &[2.0, 1.0, 1.0, 2.0]), None);
    }
}
