//! Second-order correction of the centroid's speckle variance for lines of few grains.
//!
//! The centroid is the ratio N/S with N = Σy·I and the light S = ΣI. To first order, its variance
//! is V = Var N/(ES)². With ES = 1 and s = S − 1, the next terms are E[N²·(3s² − 2s)] = 3·V·L −
//! 4·T. L is the relative variance of the light. T is tr(ΓyΓyΓ), where Γ is the field covariance:
//! joint cumulants of the intensities of a circular Gaussian field are such traces (Goodman 2007,
//! 2.1).
//!
//! For a Gaussian line, T/V = 4/(3√3)·κ·L. Here κ = C₃/C₂², and C_n is the n-fold trace of the
//! field correlation over one column. The variance is V·(1 − c·L) with c = 16/(3√3)·κ − 3.

use crate::math::Aperture;
use crate::math::quadrature::gauss_legendre;
use nalgebra::DMatrix;
use std::f64::consts::PI;

/// Returns the coefficient c of the variance V/(1 + c·L) of a centroid. `grains` is the number of
/// grains across a column. The coefficient is at most 0.53, for columns of about one grain.
///
/// The correction is written as a quotient, which remains positive. Omitted terms are of the order
/// L².
pub(super) fn few_grains_coefficient(aperture: Aperture, grains: f64) -> f64 {
    let count = 6 + (6.0 * grains).ceil().min(42.0) as usize;
    let nodes = gauss_legendre(count);
    let mut traces = [0.0; 2];
    for (x, weight) in gauss_legendre(32) {
        // Half of the chord of the pupil at a row frequency of x/2 cycles per grain.
        let (half, area) = match aperture {
            Aperture::Square => (0.5, 1.0),
            Aperture::Circle | Aperture::Ellipse(_) => (0.5 * (1.0 - x * x).sqrt(), PI / 4.0),
        };
        let correlation = DMatrix::from_fn(count, count, |i, j| {
            let ((a, of_a), (b, of_b)) = (nodes[i], nodes[j]);
            let width = 2.0 * half;
            let value = crate::math::sinc(width * (a - b) * grains) * width / area;
            value * (of_a * of_b).sqrt()
        });
        let square = &correlation * &correlation;
        traces[0] += weight * square.trace();
        traces[1] += weight * square.component_mul(&correlation).sum();
    }
    let kappa = traces[1] / traces[0].powi(2);
    16.0 / (3.0 * 3f64.sqrt()) * kappa - 3.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec2;
    use nalgebra::DVector;

    /// Returns the exact variance of the centroid relative to its first-order value, and the
    /// relative variance of the light. The line has a standard deviation of `sigma` px. Speckle is
    /// fully developed, with grains of `grain` px.
    ///
    /// The centroid is a ratio of quadratic forms of the field. With the eigenvalues λ of the field
    /// covariance and the rows P in its eigenvectors, its mean square is
    /// ∫ t·Σ λᵢλⱼPᵢⱼ²/((1+tλᵢ)(1+tλⱼ))·Π 1/(1+tλ) dt over t from 0 to ∞ (Magnus 1986).
    /// Fields at four heights of each of three columns of a pixel represent the light.
    fn exact_over_first_order(sigma: f64, grain: f64) -> [f64; 2] {
        const PARTS: i64 = 4;
        let last = (4.0 * sigma * PARTS as f64).ceil() as i64;
        let of_row = |row: i64| {
            let y = (row as f64 + 0.5) / PARTS as f64;
            let pixel = row.div_euclid(PARTS) as f64 + 0.5;
            let light = (-0.5 * (y / sigma).powi(2)).exp();
            gauss_legendre(3)
                .into_iter()
                .map(move |(x, w)| (DVec2::new(x, y), pixel, w * light))
        };
        let nodes: Vec<(DVec2, f64, f64)> = (-last..last).flat_map(of_row).collect();
        let light: f64 = nodes.iter().map(|node| node.2).sum();
        let n = nodes.len();
        let covariance = DMatrix::from_fn(n, n, |i, j| {
            let ((a, _, light_a), (b, _, light_b)) = (nodes[i], nodes[j]);
            (light_a * light_b).sqrt() / light * Aperture::Circle.field_correlation((a - b) / grain)
        });
        let modes = covariance.symmetric_eigen();
        let rows = DVector::from_iterator(n, nodes.iter().map(|node| node.1));
        let rows =
            modes.eigenvectors.transpose() * DMatrix::from_diagonal(&rows) * &modes.eigenvectors;
        let lights = modes.eigenvalues.map(|mode| mode.max(0.0));
        let square = |weights: &DVector<f64>| {
            let pair = |i: usize, j: usize| weights[i] * weights[j] * rows[(i, j)].powi(2);
            (0..n)
                .flat_map(|i| (0..n).map(move |j| (i, j)))
                .map(|(i, j)| pair(i, j))
                .sum::<f64>()
        };
        let at = |t: f64| {
            let all: f64 = lights.iter().map(|mode| (t * mode).ln_1p()).sum();
            t * square(&lights.map(|mode| mode / (1.0 + t * mode))) * (-all).exp()
        };
        let exact = gauss_legendre(32).into_iter().map(|(u, weight)| {
            let t = 4.0 * u / (1.0 - u);
            weight * 4.0 / (1.0 - u).powi(2) * at(t)
        });
        [exact.sum::<f64>() / square(&lights), lights.norm_squared()]
    }

    /// The next omitted terms are of the order L². For coefficients below 1 they are at most L²,
    /// and half as much in the standard deviation.
    #[test]
    fn centroids_in_few_grains_scatter_as_the_exact_ratio() {
        for (sigma, grain) in [(0.9, 1.0), (1.8, 2.0), (2.0, 1.0), (4.0, 4.0), (3.0, 1.5)] {
            let [exact, light] = exact_over_first_order(sigma, grain);
            let coefficient = few_grains_coefficient(Aperture::Circle, 1.0 / grain);
            let found = 1.0 / (1.0 + coefficient * light);
            let text = format!(
                "σ = {sigma} px, h = {grain} px, L = {light:.3}: {found:.4} for {exact:.4}"
            );
            println!("{text}");
            assert!((found - exact).abs() < light * light, "{text}");
        }
    }

    /// One grain per column or less: C_n are integrals of the chords (4/π)·√(1 − 4f²) of the pupil,
    /// C₂ = 32/(3π²) and C₃ = 12/π².
    #[test]
    fn large_grains_have_the_coefficient_of_a_line_without_width() {
        let kappa = 12.0 / PI.powi(2) / (32.0 / (3.0 * PI.powi(2))).powi(2);
        let expected = 16.0 / (3.0 * 3f64.sqrt()) * kappa - 3.0;
        let found = few_grains_coefficient(Aperture::Circle, 1e-3);
        assert!((found - expected).abs() < 1e-4, "{found} for {expected}");
        // A square pupil has equal chords.
        let found = few_grains_coefficient(Aperture::Square, 1e-3);
        assert!((found - (16.0 / (3.0 * 3f64.sqrt()) - 3.0)).abs() < 1e-4);
    }
}
