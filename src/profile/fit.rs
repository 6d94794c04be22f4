//! Least squares with few parameters.

use super::line::{Line, Located};
use std::f64::consts::{PI, SQRT_2};

/// Solves the symmetric positive definite a·x = b by Cholesky's factorisation;
/// `None` if it is not positive definite.
pub(super) fn solve<const N: usize>(a: &[[f64; N]; N], b: &[f64; N]) -> Option<[f64; N]> {
    let mut l = [[0.0; N]; N];
    for i in 0..N {
        for j in 0..=i {
            let rest: f64 = a[i][j] - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
            if i > j {
                l[i][j] = rest / l[j][j];
            } else if rest > 1e-14 * a[i][i] {
                l[i][i] = rest.sqrt();
            } else {
                return None;
            }
        }
    }
    let mut x = *b;
    for i in 0..N {
        x[i] = (x[i] - (0..i).map(|k| l[i][k] * x[k]).sum::<f64>()) / l[i][i];
    }
    for i in (0..N).rev() {
        x[i] = (x[i] - (i + 1..N).map(|k| l[k][i] * x[k]).sum::<f64>()) / l[i][i];
    }
    Some(x)
}

/// Background, area, row and standard deviation of a Gaussian line.
type Parameters = [f64; 4];

/// Normal equations of a fit at some parameters.
struct Normal {
    squares: f64,
    matrix: [[f64; 4]; 4],
    gradient: [f64; 4],
}

/// Sum of squared residuals of the pixels against
/// b + A·(Φ((i+1-μ)/σ) - Φ((i-μ)/σ)), and its derivatives.
fn normal(counts: &[(usize, f64)], [b, area, mean, sigma]: Parameters) -> Normal {
    let mut n = Normal {
        squares: 0.0,
        matrix: [[0.0; 4]; 4],
        gradient: [0.0; 4],
    };
    // Φ, φ and u·φ at a pixel's edge; each is the next pixel's lower edge.
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
        let slopes = [
            1.0,
            share,
            -area / sigma * (high.1 - low.1),
            -area / sigma * (high.2 - low.2),
        ];
        let residual = count - b - area * share;
        n.squares += residual * residual;
        for i in 0..4 {
            n.gradient[i] += slopes[i] * residual;
            for j in 0..4 {
                n.matrix[i][j] += slopes[i] * slopes[j];
            }
        }
    }
    n
}

/// Least-squares fit of a pixel-integrated Gaussian on a constant background over
/// 5σ to either side, saturated pixels left out, by the damped steps of Marquardt
/// (1963). With noise alike in all pixels its error is the Cramér–Rao bound. `None`
/// with fewer than six pixels, or if the fit leaves its window or its width.
pub(super) fn gaussian_fit(line: &Line, start: Located) -> Option<Located> {
    let sigma = start.sigma.max(0.3);
    let reach = (5.0 * sigma).max(3.0);
    let low = (start.row - reach).max(0.0) as usize;
    let high = ((start.row + reach).ceil() as usize).min(line.column.len());
    let counts: Vec<(usize, f64)> = (low..high)
        .filter(|&row| line.column[row] < line.max_count)
        .map(|row| (row, line.column[row] as f64))
        .collect();
    if counts.len() < 6 {
        return None;
    }
    let area = line.height * sigma * (2.0 * PI).sqrt();
    let mut at = [line.background.mean, area, start.row, sigma];
    let mut now = normal(&counts, at);
    let mut damping = 1e-3;
    for _ in 0..50 {
        let mut matrix = now.matrix;
        for (i, row) in matrix.iter_mut().enumerate() {
            row[i] *= 1.0 + damping;
        }
        let step = solve(&matrix, &now.gradient)?;
        let tried: Parameters = std::array::from_fn(|i| at[i] + step[i]);
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
        // No step improves: rounding is all that is left.
        if damping > 1e8 {
            break;
        }
    }
    let [_, area, row, fitted] = at;
    let inside = (low as f64..=high as f64).contains(&row) && fitted < reach && area > 0.0;
    inside.then_some(Located { row, sigma: fitted })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cholesky_solves_and_refuses() {
        let a = [[4.0, 2.0, 0.6], [2.0, 5.0, 1.0], [0.6, 1.0, 3.0]];
        let x = [1.0, -2.0, 0.5];
        let b = std::array::from_fn(|i| (0..3).map(|j| a[i][j] * x[j]).sum());
        let found = solve(&a, &b).unwrap();
        assert!((0..3).all(|i| (found[i] - x[i]).abs() < 1e-12), "{found:?}");
        assert_eq!(solve(&[[1.0, 1.0], [1.0, 1.0]], &[1.0, 1.0]), None);
    }
}
