//! Gauss–Legendre quadrature.

use std::f64::consts::PI;

/// Returns the nodes in (0, 1), ascending, and the weights, of sum 1, of the rule of `n` nodes.
///
/// The rule is exact for polynomials of degree 2n − 1 (Abramowitz & Stegun 1964, 25.4.29). The
/// nodes are found by Newton iteration on the Legendre polynomial P_n from cos(π(i + ¾)/(n + ½)),
/// to 1e-14.
pub fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    let order = n as f64;
    let node = |i: usize| {
        let mut x = -(PI * (i as f64 + 0.75) / (order + 0.5)).cos();
        let mut slope = 1.0;
        for _ in 0..10 {
            let (mut last, mut value) = (0.0, 1.0);
            for k in 1..=n {
                let k = k as f64;
                (last, value) = (value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * last) / k);
            }
            slope = order * (x * value - last) / (x * x - 1.0);
            x -= value / slope;
        }
        ((x + 1.0) / 2.0, 1.0 / ((1.0 - x * x) * slope * slope))
    };
    (0..n).map(node).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tests ∫₀¹ xᵏ dx = 1/(k + 1) up to k = 2n − 1, and that the rule is inexact for the next
    /// power.
    #[test]
    fn powers_are_integrated_up_to_the_rules_degree() {
        for n in 1..=16 {
            let rule = gauss_legendre(n);
            let error = |k: usize| {
                let sum: f64 = rule.iter().map(|(x, w)| w * x.powi(k as i32)).sum();
                (sum * (k + 1) as f64 - 1.0).abs()
            };
            assert!((0..2 * n).all(|k| error(k) < 1e-13 * (k + 1) as f64), "{n}");
            assert!(n > 10 || error(2 * n) > 1e-12, "{n}");
            assert!(rule.is_sorted_by(|a, b| a.0 < b.0));
        }
    }
}
