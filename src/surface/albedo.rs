//! Directional albedo of microfacets for single scattering, as a table.

use super::ggx::Ggx;
use crate::math::DVec3;
use crate::math::quadrature::gauss_legendre;
use std::f64::consts::{FRAC_PI_2, PI};

/// Number of steps in √μ. At grazing incidence, the albedo changes over μ ≈ α.
const RISE: usize = 64;
/// Number of azimuth steps over the quarter circle from along the lay to across it.
const AZIMUTH_STEPS: usize = 16;

/// Directional albedo E(ω): the fraction of the light from ω that leaves after one facet. The table
/// is interpolated linearly in √μ and azimuth.
#[derive(Clone)]
pub struct Albedo {
    /// [`RISE`] + 1 values for each azimuth.
    values: Vec<f64>,
    /// Number of azimuth steps.
    turn: usize,
    /// Cosine-weighted mean E_avg over the hemisphere.
    pub mean: f64,
}

impl Albedo {
    /// Computes the table for facets with the reflectance `fresnel`, a function of the cosine of
    /// the incidence angle.
    pub fn new(facets: &Ggx, fresnel: impl Fn(f64) -> f64) -> Albedo {
        let turn = if facets.is_isotropic() {
            0
        } else {
            AZIMUTH_STEPS
        };
        let value = |i: usize| {
            let root = (i % (RISE + 1)) as f64 / RISE as f64;
            // At μ = 0, no facet is visible.
            let z = (root * root).max(1e-6);
            let azimuth = FRAC_PI_2 * (i / (RISE + 1)) as f64 / turn.max(1) as f64;
            let (sin, cos) = azimuth.sin_cos();
            let flat = (1.0 - z * z).sqrt();
            facets.albedo(DVec3::new(cos * flat, sin * flat, z), &fresnel)
        };
        let values = (0..(turn + 1) * (RISE + 1)).map(value).collect();
        let mut albedo = Albedo {
            values,
            turn,
            mean: 0.0,
        };
        // The integral 2∫Eμ dμ is computed per step: E is linear in √μ there, so a rule of three
        // nodes is exact.
        let rule = gauss_legendre(3);
        for i in 0..RISE {
            for &(x, weight) in &rule {
                let root = (i as f64 + x) / RISE as f64;
                let all_round = albedo.azimuthal_mean(root);
                albedo.mean += weight / RISE as f64 * 4.0 * root.powi(3) * all_round;
            }
        }
        albedo
    }

    /// Returns the mean over azimuths. The trapezoid rule is exact for linear interpolation.
    fn azimuthal_mean(&self, root: f64) -> f64 {
        let share = |k: usize| match (self.turn, k) {
            (0, _) => 1.0,
            (turn, k) if k == 0 || k == turn => 0.5 / turn as f64,
            (turn, _) => 1.0 / turn as f64,
        };
        let values = (0..=self.turn).map(|k| share(k) * self.along_rise(k, root));
        values.sum()
    }

    fn along_rise(&self, azimuth: usize, root: f64) -> f64 {
        let at = root * RISE as f64;
        let first = (at as usize).min(RISE - 1);
        let values = &self.values[azimuth * (RISE + 1) + first..];
        values[0] + (values[1] - values[0]) * (at - first as f64)
    }

    /// Returns E for a direction above the surface.
    pub fn of(&self, w: DVec3) -> f64 {
        let root = w.z.clamp(0.0, 1.0).sqrt();
        if self.turn == 0 {
            return self.along_rise(0, root);
        }
        let azimuth = w.y.abs().atan2(w.x.abs());
        let at = azimuth / FRAC_PI_2 * self.turn as f64;
        let first = (at as usize).min(self.turn - 1);
        let (low, high) = (
            self.along_rise(first, root),
            self.along_rise(first + 1, root),
        );
        low + (high - low) * (at - first as f64)
    }

    /// Returns 1 − E in f32, for a local direction.
    #[inline(always)]
    pub fn lost(&self, [x, y, z]: [f32; 3]) -> f32 {
        let albedo = match self.turn {
            0 => self.along_rise(0, f64::from(z.clamp(0.0, 1.0).sqrt())),
            _ => self.of(DVec3::new(x.into(), y.into(), z.into())),
        };
        (1.0 - albedo).max(0.0) as f32
    }

    /// Returns (1 − E(i))·(1 − E(o))/(π·(1 − E_avg)), 1/sr, which compensates the energy lost by
    /// single scattering of facets with reflectance 1 (Kulla & Conty 2017). The function is
    /// reciprocal, and its flux for light from `o` is 1 − E(o).
    pub fn multiple_scattering_term(&self, i: DVec3, o: DVec3) -> f64 {
        let left = 1.0 - self.mean;
        if left < 1e-9 {
            return 0.0;
        }
        (1.0 - self.of(i)).max(0.0) * (1.0 - self.of(o)).max(0.0) / (PI * left)
    }
}
