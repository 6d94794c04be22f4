//! Estimates a calibration from images of a target by least squares over all views.
//!
//! The following quantities are known:
//!
//! - the pose of the target in the head frame for every view, from a stage with encoders;
//! - the dot positions on the target;
//! - the pixel pitch;
//! - the sensor tilt, which is a choice of axes (see `CameraModel`).
//!
//! The estimated quantities are the principal distance, the principal point, the distortion, the
//! camera pose in the head frame, and the laser plane. The estimated pose transforms camera
//! coordinates to the head frame and thus to the part frame.

use super::calibration::{Calibration, PARAMETERS, Parameters, coefficients};
use crate::camera::Distortion;
use crate::math::{DVec2, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Dot of the target in one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dot {
    /// Position of the dot in the head frame, mm.
    pub position: DVec3,
    /// Position of the dot image (column, row), px.
    pub pixel: DVec2,
    /// Standard uncertainty of each coordinate of `pixel`, px.
    pub sigma_px: f64,
}

/// Point of the laser line on the target, in one column of one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaserLineObservation {
    /// Point of the target plane in the head frame, mm.
    pub target_point: DVec3,
    /// Unit normal of the target plane in the head frame.
    pub target_normal: DVec3,
    /// Column centre and row of the peak, px. Row errors are assumed independent with equal
    /// variance, which is estimated from the residuals.
    pub pixel: DVec2,
}

/// Observations of all views of the target.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Observations {
    /// Dots of all views.
    pub dots: Vec<Dot>,
    /// Peaks of all views.
    pub line: Vec<LaserLineObservation>,
}

/// Result of [`adjust`].
#[derive(Debug, Clone, PartialEq)]
pub struct Adjustment {
    /// Estimated calibration with its covariance.
    pub calibration: Calibration,
    /// Residuals of the dots (measured minus predicted), px.
    pub dot_residuals: Vec<DVec2>,
    /// Residuals of the peak rows (measured minus predicted), px.
    pub line_residuals: Vec<f64>,
    /// Standard deviation of a peak row, estimated from the residuals, px.
    pub line_sigma_px: f64,
    /// Number of Levenberg–Marquardt steps.
    pub iterations: usize,
}

/// Initial standard deviation of peak rows, px. It only sets the relative weight of line and dots
/// in the first of three adjustments.
const FIRST_LINE_SIGMA: f64 = 0.1;
/// Minimum fraction of a parameter's information that is independent of the other parameters. Below
/// it, the other parameters reproduce all but a millionth of its effect, and rounding dominates.
const MIN_CONDITION: f64 = 1e-12;

/// True if the parameter is a distortion coefficient.
fn of_lens(parameter: usize) -> bool {
    (3..8).contains(&parameter)
}

/// Fit problem with fixed weights.
struct Problem<'a> {
    observations: &'a Observations,
    line_sigma: f64,
    /// Indices into [`PARAMETERS`] of the estimated parameters, with the step of the numerical
    /// derivative.
    free: Vec<(usize, f64)>,
}

/// Calibration with its weighted residuals and their sum of squares.
struct AdjustmentState {
    calibration: Calibration,
    residuals: DVector<f64>,
    cost: f64,
}

/// Normal equations, each parameter scaled to unit information.
struct ScaledNormalEquations {
    factors: Cholesky<f64, Dyn>,
    gradient: DVector<f64>,
    scale: DVector<f64>,
}

/// Fits a calibration by the Levenberg–Marquardt method (Marquardt 1963).
///
/// The fit starts from the nominal values `start`, which may deviate from the truth by a few per
/// cent. Distortion is estimated if `start` has a distortion. The covariance is the inverse of the
/// normal matrix.
///
/// # Errors
///
/// Returns a message if the observations do not determine a parameter, or if the fit does not
/// converge from `start`.
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
    // The third adjustment uses weights from the residuals of the second.
    for _ in 0..3 {
        let state = problem.minimise(calibration, &mut iterations)?;
        let dots = 2 * observations.dots.len();
        let line = state.residuals.rows_range(dots..);
        let freedom = observations.line.len() as f64 - 3.0;
        // Lower bound for perfect data, whose residuals are rounding errors.
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

/// Returns the Cholesky factorisation of a symmetric matrix. The error is the index of the first
/// row whose leading submatrix is not positive definite.
fn factorise(matrix: &DMatrix<f64>) -> Result<Cholesky<f64, Dyn>, usize> {
    let leading = |rows: usize| matrix.view((0, 0), (rows, rows)).clone_owned().cholesky();
    let rows = matrix.nrows();
    leading(rows).ok_or_else(|| {
        (0..rows)
            .find(|&row| leading(row + 1).is_none())
            .unwrap_or(0)
    })
}

/// Returns half the interval of the numerical derivative. It is small compared with the scale of
/// the model's nonlinearity and large compared with rounding.
fn step(parameter: usize, reach: f64) -> f64 {
    match parameter {
        1 | 2 => 0.1,
        // The step moves the corner of the sensor by 1e-4 of the image size.
        3..=5 => 1e-4 / reach.powi(2 * (parameter as i32 - 2)),
        6 | 7 => 1e-4 / reach,
        8..=10 | 15 | 16 => 1e-5,
        _ => 1e-2,
    }
}

/// Moves the reference point of the laser plane to the mean of the observed points. With a distant
/// reference point, the offset and the tilt of the plane would be strongly correlated.
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
    /// Returns `None` if a dot has no image.
    fn state(&self, calibration: Calibration) -> Option<AdjustmentState> {
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
        cost.is_finite().then_some(AdjustmentState {
            calibration,
            residuals,
            cost,
        })
    }

    fn normal(
        &self,
        state: &AdjustmentState,
        damping: f64,
    ) -> Result<ScaledNormalEquations, String> {
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
        matrix.fill_diagonal(1.0 + damping - MIN_CONDITION);
        let factors = factorise(&matrix).map_err(|row| {
            format!(
                "the views do not determine {}: what it changes in the images, the parameters \
                 before it change as well. Views of the target at several heights and tilts do",
                PARAMETERS[self.free[row].0]
            )
        })?;
        Ok(ScaledNormalEquations {
            factors,
            gradient: -columns.tr_mul(&state.residuals).component_mul(&scale),
            scale,
        })
    }

    /// Returns the state of least squares, starting from `start`.
    fn minimise(
        &self,
        start: Calibration,
        iterations: &mut usize,
    ) -> Result<AdjustmentState, String> {
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
            // Step length in units of the parameters' standard uncertainties.
            let length = scaled.norm();
            match self.state(state.calibration.perturbed(&by)) {
                Some(next) if next.cost <= state.cost => {
                    let done = length < 1e-6 && damping < 1e-6;
                    (state, damping) = (next, damping / 10.0);
                    if done {
                        return Ok(state);
                    }
                }
                // At the minimum, the costs differ by rounding only.
                _ if length < 1e-6 => return Ok(state),
                _ => damping = (damping * 10.0).min(1e9),
            }
        }
        Err(format!("{far}: the fit did not end in 200 steps"))
    }

    fn with_covariance(&self, state: &AdjustmentState) -> Result<Calibration, String> {
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

/// Returns the row distance of the peak from the intersection of laser plane and target, px.
///
/// The distance of the target point at this pixel from the laser plane is divided by its change per
/// row.
fn row_residual(calibration: &Calibration, point: &LaserLineObservation) -> f64 {
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
