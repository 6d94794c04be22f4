//! Nonlinear least squares of a few parameters of order 1.

use nalgebra::{DMatrix, DVector};

/// Largest magnitude of a parameter.
const BOUND: f64 = 25.0;

/// Returns the parameters with the least sum of squared residuals, and this sum (Levenberg 1944,
/// Marquardt 1963). `jacobian` returns the derivatives of the model, which are those of the
/// residuals with the opposite sign.
pub fn minimum(
    start: DVector<f64>,
    residual: impl Fn(&DVector<f64>) -> DVector<f64>,
    jacobian: impl Fn(&DVector<f64>) -> DMatrix<f64>,
) -> (DVector<f64>, f64) {
    let (mut at, mut damping) = (start, 1e-3);
    let mut rest = residual(&at);
    for _ in 0..80 {
        let derivatives = jacobian(&at);
        let mut normal = derivatives.transpose() * &derivatives;
        for i in 0..normal.nrows() {
            normal[(i, i)] *= 1.0 + damping;
            normal[(i, i)] += 1e-300;
        }
        let step = normal
            .cholesky()
            .map(|n| n.solve(&(derivatives.transpose() * &rest)));
        let Some(step) = step else {
            damping *= 10.0;
            continue;
        };
        let next = (&at + step).map(|value| value.clamp(-BOUND, BOUND));
        let next_rest = residual(&next);
        if next_rest.norm_squared() < rest.norm_squared() {
            let gain = 1.0 - next_rest.norm_squared() / rest.norm_squared();
            (at, rest, damping) = (next, next_rest, damping / 5.0);
            if gain < 1e-12 {
                break;
            }
        } else {
            damping *= 5.0;
            if damping > 1e12 {
                break;
            }
        }
    }
    let loss = rest.norm_squared();
    (at, loss)
}

/// Returns the derivatives of a model by central differences.
pub fn derivatives(
    at: &DVector<f64>,
    model: impl Fn(&DVector<f64>) -> DVector<f64>,
) -> DMatrix<f64> {
    const STEP: f64 = 1e-5;
    let columns = (0..at.len()).map(|parameter| {
        let [low, high] = [-STEP, STEP].map(|step| {
            let mut moved = at.clone();
            moved[parameter] += step;
            model(&moved)
        });
        (high - low) / (2.0 * STEP)
    });
    DMatrix::from_columns(&columns.collect::<Vec<_>>())
}
