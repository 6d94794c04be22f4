//! Paint, varnish, anodised metal with a coloured layer: a clear interface over a diffuse base.

use super::albedo::Albedo;
use super::fresnel;
use super::ggx::Ggx;
use crate::math::DVec3;

/// A rough clear interface over a base that scatters evenly.
///
/// With E(ω) the share that the interface reflects, light enters by 1 − E(ω_i), is scattered by the base (albedo ρ),
/// leaves by (1 − E(ω_o))/n² a solid angle, and what is held back inside, r = 1 − (1 − E_avg)/n², comes to the base
/// again (Saunderson 1942): f = f_interface + ρ·(1 − E(ω_i))·(1 − E(ω_o))/(π·n²·(1 − ρ·r)). Reciprocal; with ρ = 1 all light
/// leaves, and the second term is the coupling of Kelemen & Szirmay-Kalos (2001).
#[derive(Clone, serde::Serialize)]
pub struct Coat {
    /// Refractive index of the coat, above 1.
    pub index: f64,
    /// ρ of the base, 0 to 1.
    pub reflectance: f64,
    /// Slopes of the interface.
    pub facets: Ggx,
    #[serde(skip)]
    albedo: Albedo,
    /// ρ·(1 − E_avg)/(n²·(1 − ρ·r)).
    #[serde(skip)]
    scattered: f64,
}

impl Coat {
    /// See the fields.
    pub fn new(index: f64, reflectance: f64, facets: Ggx) -> Coat {
        let albedo = Albedo::new(&facets, |cosine| fresnel::dielectric(index, cosine));
        let out = (1.0 - albedo.mean) / (index * index);
        let scattered = reflectance * out / (1.0 - reflectance * (1.0 - out));
        Coat {
            index,
            reflectance,
            facets,
            albedo,
            scattered,
        }
    }

    /// What the interface reflects of the BRDF, 1/sr, in directions local to the surface, both above it.
    pub fn gloss(&self, i: DVec3, o: DVec3) -> f64 {
        let once = |cosine| fresnel::dielectric(self.index, cosine);
        self.facets.bsdf(i, o, once)
    }

    /// Shares of light from `o` that the interface and the base reflect.
    pub(super) fn shares(&self, o: DVec3) -> [f64; 2] {
        let gloss = self.albedo.of(o);
        [gloss, self.scattered * (1.0 - gloss).max(0.0)]
    }

    /// What comes from the base of it.
    pub fn body(&self, i: DVec3, o: DVec3) -> f64 {
        self.scattered * self.albedo.rest(i, o)
    }
}
