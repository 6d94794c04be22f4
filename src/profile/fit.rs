//! Fits with few parameters by least squares.

use super::line::{DetectedLine, PeakEstimate};
use nalgebra::{Matrix4, SMatrix, SVector, Vector4};
use std::f64::consts::{PI, SQRT_2};

/// Solves the symmetric positive definite system a·x = b. Returns `None` if `a` is not positive
/// definite, or is positive definite only by rounding.
pub(super) fn solve<const N: usize>(
    a: SMatrix<f64, N, N>,
    b: &SVector<f64, N>,
) -> Option<SVector<f64, N>> {
    let factor = a.cholesky()?;
    let pivot = |i: usize| factor.l_dirty()[(i, i)].powi(2);
    let definite = (0..N).all(|i| pivot(i) > 1e-14 * a[(i, i)]);
    definite.then(|| factor.solve(b))
}

/// Background, area, row and standard deviation of a Gaussian line.
type GaussianParameters = Vector4<f64>;

/// Normal equations of a fit, linearised at the current parameters.
struct GaussianNormalEquations {
    squares: f64,
    matrix: Matrix4<f64>,
    gradient: Vector4<f64>,
}

/// Returns the sum of squared residuals of the pixels against b + A·(Φ((i+1-μ)/σ) - Φ((i-μ)/σ)),
/// and its derivatives.
fn normal(counts: &[(usize, f64)], parameters: GaussianParameters) -> GaussianNormalEquations {
    let [b, area, mean, sigma] = parameters.into();
    let mut n = GaussianNormalEquations {
        squares: 0.0,
        matrix: Matrix4::zeros(),
        gradient: Vector4::zeros(),
    };
    // Φ, φ and u·φ at a pixel border; each value is reused for the adjacent pixel.
    let at = |row: usize| {
        let u = (row as f64 - mean) / sigma;
        let density = (-0.5 * u * u).exp() / (2.0 * PI).sqrt();
        (0.5 * libm::erf(u / SQRT_2), density, u * density)
    };
    let mut edge: Option<(usize, (f64, f64, f64))> = None;
    for &(row, count) in counts {
        let low = match edge {
            Some((last, values)) if last == row => values,
            _ => at(row),
        };
        let high = at(row + 1);
        edge = Some((row + 1, high));
        let share = high.0 - low.0;
        let slopes = Vector4::new(
            1.0,
            share,
            -area / sigma * (high.1 - low.1),
            -area / sigma * (high.2 - low.2),
        );
        let residual = count - b - area * share;
        n.squares += residual * residual;
        n.gradient += slopes * residual;
        n.matrix += slopes * slopes.transpose();
    }
    n
}

/// Fits a pixel-integrated Gaussian on a constant background by least squares over ±5σ.
///
/// Saturated pixels are excluded. The steps are damped (Marquardt 1963). For equal noise in all
/// pixels, the error of the fit attains the Cramér–Rao bound. Returns `None` if there are fewer
/// than six pixels, or if the row or the width leaves the window.
pub(super) fn gaussian_fit(line: &DetectedLine, start: PeakEstimate) -> Option<PeakEstimate> {
    let sigma = start.sigma.max(0.3);
    let reach = (5.0 * sigma).max(3.0);
    let low = (start.row - reach).max(0.0) as usize;
    let high = ((start.row + reach).ceil() as usize).min(line.column.rows());
    let counts: Vec<(usize, f64)> = (low..high)
        .map(|row| (row, line.column.at(row)))
        .filter(|&(_, count)| count < line.max_count)
        .map(|(row, count)| (row, count as f64))
        .collect();
    if counts.len() < 6 {
        return None;
    }
    let area = line.height * sigma * (2.0 * PI).sqrt();
    let mut at = GaussianParameters::new(line.background.mean, area, start.row, sigma);
    let mut now = normal(&counts, at);
    let mut damping = 1e-3;
    for _ in 0..50 {
        let mut matrix = now.matrix;
        matrix.set_diagonal(&(matrix.diagonal() * (1.0 + damping)));
        let step = solve(matrix, &now.gradient)?;
        let tried = at + step;
        let next = (tried[3] > 0.05).then(|| normal(&counts, tried));
        match next.filter(|next| next.squares <= now.squares) {
            Some(next) => {
                (at, now) = (tried, next);
                damping *= 0.1;
                if step[2].abs() < 1e-7 * sigma && step[3].abs() < 1e-6 * sigma {
                    break;
                }
            }
            None => damping *= 10.0,
        }
        // No step improves the fit beyond rounding.
        if damping > 1e8 {
            break;
        }
    }
    let [_, area, row, fitted] = at.into();
    let inside = (low as f64..=high as f64).contains(&row) && fitted < reach && area > 0.0;
    inside.then_some(PeakEstimate { row, sigma: fitted })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_system_that_only_rounding_makes_definite_is_refused() {
        let ones = SMatrix::<f64, 2, 2>::from_element(1.0);
        let one = SVector::<f64, 2>::new(1.0, 0.0);
        assert_eq!(solve(ones, &one), None);
        // A pivot of 2e-16 is a rounding error; a pivot of 1e-8 is not.
        let lifted = |by: f64| ones + SMatrix::from_diagonal(&SVector::<f64, 2>::new(0.0, by));
        assert_eq!(solve(lifted(2.3e-16), &one), None);
        assert!(solve(lifted(1e-8), &one).is_some());
    }
}
