//! Microfacets with the GGX distribution of slopes (Walter et al. 2007). Directions are local to
//! the surface: x along the lay, y across it, z along the normal.

use crate::math::quadrature::gauss_legendre;
use crate::math::{DVec2, DVec3};
use std::f64::consts::{FRAC_1_PI, PI};

/// Roughness α along the lay and across it, 0 to 1. If both are equal, half of the facets by
/// projected area have a slope below α.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Ggx {
    /// Roughness along the lay, α_u.
    pub alpha_u: f64,
    /// Roughness across the lay, α_v.
    pub alpha_v: f64,
}

impl Ggx {
    fn alpha(&self) -> DVec2 {
        DVec2::new(self.alpha_u, self.alpha_v)
    }

    /// Returns the lower roughness.
    pub fn least(&self) -> f64 {
        self.alpha_u.min(self.alpha_v)
    }

    /// Returns whether the roughness is independent of direction.
    pub fn is_isotropic(&self) -> bool {
        self.alpha_u == self.alpha_v
    }

    /// Returns the distribution of normals D(m): facet area per solid angle and surface area, 1/sr.
    /// `m` must be in the upper hemisphere.
    pub fn normal_distribution(&self, m: DVec3) -> f64 {
        let slope = m.truncate() / self.alpha();
        let e = slope.length_squared() + m.z * m.z;
        FRAC_1_PI / (self.alpha_u * self.alpha_v * e * e)
    }

    /// Returns Smith's Λ(w).
    pub(super) fn lambda(&self, w: DVec3) -> f64 {
        let tan2 = (w.truncate() * self.alpha()).length_squared() / (w.z * w.z);
        ((1.0 + tan2).sqrt() - 1.0) / 2.0
    }

    /// Returns G₂/(4·μ_i·μ_o) with height correlation (Heitz 2014), for two directions above the
    /// surface.
    fn masking(&self, i: DVec3, o: DVec3) -> f64 {
        1.0 / (4.0 * i.z * o.z * (1.0 + self.lambda(i) + self.lambda(o)))
    }

    /// Returns the BRDF, 1/sr. `fresnel` is the reflectance of a facet, a function of the cosine of
    /// the incidence angle. The result is 0 unless both directions are above the surface.
    pub fn bsdf(&self, i: DVec3, o: DVec3, fresnel: impl Fn(f64) -> f64) -> f64 {
        if !(i.z > 0.0 && o.z > 0.0) {
            return 0.0;
        }
        let m = (i + o).normalize();
        self.normal_distribution(m) * self.masking(i, o) * fresnel(o.dot(m).min(1.0))
    }

    /// Samples a visible normal for the direction `o` from (u₁, u₂) of the unit square (Heitz
    /// 2018). Uniform samples are distributed as the visible normals.
    pub(super) fn sample_visible_normal(&self, o: DVec3, u: DVec2) -> DVec3 {
        let alpha = self.alpha().extend(1.0);
        let stretched = (o * alpha).normalize();
        let flat = DVec2::new(-stretched.y, stretched.x);
        let first = flat.try_normalize().unwrap_or(DVec2::X).extend(0.0);
        let second = stretched.cross(first);
        let (sin, cos) = (2.0 * PI * u.y).sin_cos();
        let (x, y) = (u.x.sqrt() * cos, u.x.sqrt() * sin);
        let s = 0.5 * (1.0 + stretched.z);
        let y = (1.0 - s) * (1.0 - x * x).max(0.0).sqrt() + s * y;
        let z = (1.0 - x * x - y * y).max(0.0).sqrt();
        let m = first * x + second * y + stretched * z;
        DVec3::new(m.x * self.alpha_u, m.y * self.alpha_v, m.z.max(1e-12)).normalize()
    }

    /// Returns the density of directions `i` that result from mirroring `o` at sampled visible
    /// normals, 1/sr.
    pub(super) fn vndf_pdf(&self, o: DVec3, i: DVec3) -> f64 {
        let m = (i + o).normalize();
        self.normal_distribution(m) / (4.0 * o.z * (1.0 + self.lambda(o)))
    }

    /// Returns the directional albedo, 0 to 1: the fraction of light from `o` that leaves after one
    /// facet.
    ///
    /// The loss is integrated over the visible normals, at radius √u and azimuth φ of the disc of
    /// Heitz (2018). With v = −ln(1 − u), it is ∫(1 − F·G)·e⁻ᵛ dv. At small α, the loss comes from
    /// the tail of the slopes and is of order α², which nodes in u miss. Each azimuth is integrated
    /// up to the v at which a facet mirrors `o` to the horizon. There, the loss rises to 1 within a
    /// range of order α. Steeper facets lose all light, e⁻ᵛ. The 16 nodes are denser towards the
    /// horizon. With 32 azimuths, the relative error of the loss is 1e-4 for α from 0.01 to 0.4.
    pub fn albedo(&self, o: DVec3, fresnel: impl Fn(f64) -> f64) -> f64 {
        const AZIMUTHS: usize = 32;
        let nodes = gauss_legendre(16);
        let seen = self.lambda(o);
        // Returns the cosine of the incidence angle on the facet, and the mirrored direction.
        let mirrored = |v: f64, azimuth: f64| {
            let m = self.sample_visible_normal(o, DVec2::new(-(-v).exp_m1(), azimuth));
            let cosine = o.dot(m).clamp(0.0, 1.0);
            (cosine, m * (2.0 * cosine) - o)
        };
        let lost = |v: f64, azimuth: f64| {
            let (cosine, i) = mirrored(v, azimuth);
            if i.z <= 0.0 {
                return 1.0;
            }
            1.0 - fresnel(cosine) * (1.0 + seen) / (1.0 + seen + self.lambda(i))
        };
        let loss_at = |azimuth: f64| {
            // e⁻³⁶ is below the resolution of f64.
            let (mut low, mut high) = (0.0, 36.0);
            for _ in 0..24 {
                let middle = (low + high) / 2.0;
                match mirrored(middle, azimuth).1.z > 0.0 {
                    true => low = middle,
                    false => high = middle,
                }
            }
            let horizon = low;
            let node = |&(x, weight): &(f64, f64)| {
                // Substitution t = 1 − (1 − x)², relative to the range.
                let v = horizon * x * (2.0 - x);
                weight * 2.0 * (1.0 - x) * horizon * (-v).exp() * lost(v, azimuth)
            };
            nodes.iter().map(node).sum::<f64>() + (-horizon).exp()
        };
        let azimuth = |k: usize| (k as f64 + 0.5) / AZIMUTHS as f64;
        1.0 - (0..AZIMUTHS).map(|k| loss_at(azimuth(k))).sum::<f64>() / AZIMUTHS as f64
    }
}
