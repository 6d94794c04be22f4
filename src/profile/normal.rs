//! Normal equations of a few unknowns.

/// Cholesky's lower triangle of a symmetric matrix of `n` rows, given by its
/// elements. Errors: the row whose pivot is not positive.
pub(super) fn cholesky(
    n: usize,
    matrix: impl Fn(usize, usize) -> f64,
) -> Result<Vec<Vec<f64>>, usize> {
    let mut lower = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..=i {
            let dot: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let rest = matrix(i, j) - dot;
            lower[i][j] = match i == j {
                // Written so that NaN is not positive.
                true if rest > 0.0 => rest.sqrt(),
                true => return Err(i),
                false => rest / lower[j][j],
            };
        }
    }
    Ok(lower)
}

/// Solves L·Lᵀ·x = b.
pub(super) fn solve(lower: &[Vec<f64>], b: &[f64]) -> Vec<f64> {
    let n = b.len();
    let mut x = b.to_vec();
    for i in 0..n {
        let dot: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (x[i] - dot) / lower[i][i];
    }
    for i in (0..n).rev() {
        let dot: f64 = (i + 1..n).map(|k| lower[k][i] * x[k]).sum();
        x[i] = (x[i] - dot) / lower[i][i];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The Hilbert matrix of 5 rows, condition 5e5: its inverse is of whole numbers,
    /// so the solution for the unit vector is known; rounding of 1e-16 grows to
    /// 1e-10 of it.
    #[test]
    fn an_ill_conditioned_system_is_solved() {
        let lower = cholesky(5, |i, j| 1.0 / (i + j + 1) as f64).unwrap();
        let x = solve(&lower, &[1.0, 0.0, 0.0, 0.0, 0.0]);
        for (x, expected) in x.iter().zip([25.0, -300.0, 1050.0, -1400.0, 630.0]) {
            assert!((x - expected).abs() < 1e-7, "{x} {expected}");
        }
        assert_eq!(cholesky(2, |_, _| 1.0), Err(1));
        assert_eq!(cholesky(1, |_, _| f64::NAN), Err(0));
    }
}
