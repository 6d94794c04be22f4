//! Rough bare metal.

use super::albedo::Albedo;
use super::fresnel;
use super::ggx::Ggx;
use crate::math::DVec3;

/// Microfacets of a metal; light that meets several is given back as Kulla & Conty (2017) have
/// it.
#[derive(Clone, serde::Serialize)]
pub struct Metal {
    /// Real part of the refractive index.
    pub n: f64,
    /// Imaginary part of the refractive index.
    pub k: f64,
    /// Slopes of the surface.
    pub facets: Ggx,
    /// Of white facets.
    #[serde(skip)]
    albedo: Albedo,
    /// Share of the light that met several facets which is left.
    #[serde(skip)]
    several: f64,
}

impl Metal {
    /// Of refractive index n + ik.
    pub fn new(n: f64, k: f64, facets: Ggx) -> Metal {
        let albedo = Albedo::new(&facets, |_| 1.0);
        let mean = fresnel::mean(|cosine| fresnel::conductor(n, k, cosine));
        // Two facets at least, and each further one with the chance that light does not leave.
        let several = mean * mean * albedo.mean / (1.0 - mean * (1.0 - albedo.mean));
        Metal {
            n,
            k,
            facets,
            albedo,
            several,
        }
    }

    /// BRDF, 1/sr, in directions local to the surface, both above it.
    pub fn bsdf(&self, i: DVec3, o: DVec3) -> f64 {
        let once = |cosine| fresnel::conductor(self.n, self.k, cosine);
        self.facets.bsdf(i, o, once) + self.several * self.albedo.rest(i, o)
    }

    /// About what of light from `o` is reflected by one facet, and exactly by several.
    pub(super) fn shares(&self, o: DVec3) -> [f64; 2] {
        let white = self.albedo.of(o);
        let once = fresnel::conductor(self.n, self.k, o.z.min(1.0));
        [once * white, self.several * (1.0 - white).max(0.0)]
    }

    /// Without what several facets reflect: for comparing with programs that leave it out.
    #[doc(hidden)]
    pub fn once(self) -> Metal {
        Metal {
            several: 0.0,
            ..self
        }
    }

    /// The same of a metal that reflects all: what a furnace checks.
    #[cfg(test)]
    pub fn white(facets: Ggx) -> Metal {
        // k → ∞: F = 1.
        let metal = Metal::new(1.0, 1e9, facets);
        assert!((metal.several - 1.0).abs() < 1e-6);
        metal
    }
}
