//! Fresnel reflectance of smooth interfaces for unpolarised light (Born & Wolf 1999, 1.5 and 14.2).

use crate::math::quadrature::gauss_legendre;

/// Returns the reflectance, 0 to 1, of a metal of complex refractive index n + ik in air. `cosine`
/// is the cosine of the incidence angle.
pub fn conductor(n: f64, k: f64, cosine: f64) -> f64 {
    let sin2 = 1.0 - cosine * cosine;
    // a + ib = √((n + ik)² − sin²θ)
    let real = n * n - k * k - sin2;
    let size = real.hypot(2.0 * n * k);
    let a = ((size + real) / 2.0).max(0.0).sqrt();
    let ratio = |along: f64, twice: f64| (along - twice) / (along + twice);
    let across = ratio(size + cosine * cosine, 2.0 * a * cosine);
    let (c2, s4) = (cosine * cosine, sin2 * sin2);
    let along = across * ratio(size * c2 + s4, 2.0 * a * cosine * sin2);
    (across + along) / 2.0
}

/// Returns the reflectance, 0 to 1, of a dielectric of refractive index `n` ≥ 1 for light from air.
pub fn dielectric(n: f64, cosine: f64) -> f64 {
    let inside = (1.0 - (1.0 - cosine * cosine) / (n * n)).sqrt();
    let across = (cosine - n * inside) / (cosine + n * inside);
    let along = (n * cosine - inside) / (n * cosine + inside);
    (across * across + along * along) / 2.0
}

/// Returns the cosine-weighted mean of a reflectance over the hemisphere, 2∫F(μ)μ dμ.
pub fn mean(reflectance: impl Fn(f64) -> f64) -> f64 {
    let rule = gauss_legendre(32);
    rule.iter()
        .map(|&(x, w)| 2.0 * w * x * reflectance(x))
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The reflectance agrees with ((n − 1)² + k²)/((n + 1)² + k²) at normal incidence, with 1 at
    /// grazing incidence, and with complex arithmetic at other angles.
    #[test]
    fn metals_reflect_what_complex_arithmetic_says() {
        use rustfft::num_complex::Complex64;
        for (n, k) in [(1.6575, 9.2238), (0.22, 3.747), (2.92, 3.10)] {
            let normal = ((n - 1.0f64).powi(2) + k * k) / ((n + 1.0f64).powi(2) + k * k);
            assert!((conductor(n, k, 1.0) - normal).abs() < 1e-14);
            assert!((conductor(n, k, 0.0) - 1.0).abs() < 1e-14);
            for cosine in [0.9, 0.5, 0.1] {
                let index = Complex64::new(n, k);
                let inside = (index * index - (1.0 - cosine * cosine)).sqrt();
                let across = (cosine - inside) / (cosine + inside);
                let along = (index * index * cosine - inside) / (index * index * cosine + inside);
                let expected = (across.norm_sqr() + along.norm_sqr()) / 2.0;
                let found = conductor(n, k, cosine);
                assert!((found - expected).abs() < 1e-13, "{found} {expected}");
            }
        }
        // Aluminium of the reference scene for indirect light: 85.5108/92.1408.
        assert!((conductor(1.6575, 9.2238, 1.0) - 0.92804).abs() < 5e-6);
    }

    /// The reflectance agrees with known values at normal incidence and at Brewster's angle
    /// tan θ = n, where only s-polarised light is reflected. The mean for n = 1.5 is 0.0918 (closed
    /// form by Duntley, in Kortüm 1969).
    #[test]
    fn clear_materials_reflect_what_is_known() {
        assert!((dielectric(1.5, 1.0) - 0.04).abs() < 1e-15);
        assert!((dielectric(1.5, 0.0) - 1.0).abs() < 1e-15);
        let brewster = 1.5f64.atan().cos();
        let across = ((1.0 - 2.25f64) / (1.0 + 2.25)).powi(2);
        assert!((dielectric(1.5, brewster) - across / 2.0).abs() < 1e-14);
        let mean = mean(|cosine| dielectric(1.5, cosine));
        assert!((mean - 0.0918).abs() < 1e-4, "{mean}");
        // An interface without a change of index does not reflect.
        assert!(dielectric(1.0, 0.3) < 1e-15);
    }
}
