//! Coated diffuse surfaces, such as paint, varnish and coloured anodised metal: a clear interface
//! over a diffuse base.

use super::albedo::Albedo;
use super::fresnel;
use super::ggx::Ggx;
use crate::math::DVec3;

/// Rough dielectric interface over a diffuse base.
///
/// E(ω) is the albedo of the interface, and ρ is the albedo of the base. Light enters with
/// 1 − E(ω_i) and leaves with (1 − E(ω_o))/n² per solid angle. The fraction r = 1 − (1 − E_avg)/n²
/// is reflected internally and hits the base again (Saunderson 1942). The BRDF is
/// f = f_interface + ρ·(1 − E(ω_i))·(1 − E(ω_o))/(π·n²·(1 − ρ·r)). It is reciprocal. For ρ = 1, all
/// light leaves, and the second term is the coupling of Kelemen & Szirmay-Kalos (2001).
#[derive(Clone, serde::Serialize)]
pub struct CoatedDiffuse {
    /// Refractive index of the coat, above 1.
    pub index: f64,
    /// Albedo ρ of the base, 0 to 1.
    pub reflectance: f64,
    /// Roughness of the interface.
    pub facets: Ggx,
    #[serde(skip)]
    albedo: Albedo,
    /// ρ·(1 − E_avg)/(n²·(1 − ρ·r)).
    #[serde(skip)]
    scattered: f64,
}

impl CoatedDiffuse {
    /// Creates a coat; see the fields.
    pub fn new(index: f64, reflectance: f64, facets: Ggx) -> CoatedDiffuse {
        let albedo = Albedo::new(&facets, |cosine| fresnel::dielectric(index, cosine));
        let out = (1.0 - albedo.mean) / (index * index);
        let scattered = reflectance * out / (1.0 - reflectance * (1.0 - out));
        CoatedDiffuse {
            index,
            reflectance,
            facets,
            albedo,
            scattered,
        }
    }

    /// Returns the interface term of the BRDF, 1/sr, for local directions above the surface.
    pub fn gloss(&self, i: DVec3, o: DVec3) -> f64 {
        let once = |cosine| fresnel::dielectric(self.index, cosine);
        self.facets.bsdf(i, o, once)
    }

    /// Returns the albedo of the interface.
    pub(super) fn albedo(&self) -> &Albedo {
        &self.albedo
    }

    /// Returns the factor of the base term, ρ·(1 − E_avg)/(n²·(1 − ρ·r)).
    pub(super) fn scattered(&self) -> f64 {
        self.scattered
    }

    /// Returns the fractions of the light from `o` that are reflected by the interface and by the
    /// base.
    pub(super) fn albedo_split(&self, o: DVec3) -> [f64; 2] {
        let gloss = self.albedo.of(o);
        [gloss, self.scattered * (1.0 - gloss).max(0.0)]
    }

    /// Returns the fraction of uniform light from all directions that is reflected.
    pub(super) fn mean_reflectance(&self) -> f64 {
        let gloss = self.albedo.mean;
        gloss + self.scattered * (1.0 - gloss)
    }

    /// Returns the base term of the BRDF, 1/sr, for local directions above the surface.
    pub fn body(&self, i: DVec3, o: DVec3) -> f64 {
        self.scattered * self.albedo.multiple_scattering_term(i, o)
    }
}
