//! Rough bare metal.

use super::albedo::Albedo;
use super::fresnel;
use super::ggx::Ggx;
use crate::math::DVec3;

/// Metallic microfacet surface with compensation of multiple scattering (Kulla & Conty 2017).
#[derive(Clone, serde::Serialize)]
pub struct Conductor {
    /// Real part of the refractive index.
    pub n: f64,
    /// Imaginary part of the refractive index.
    pub k: f64,
    /// Roughness of the surface.
    pub facets: Ggx,
    /// Albedo of facets with reflectance 1.
    #[serde(skip)]
    albedo: Albedo,
    /// Fraction of the multiply scattered light that is not absorbed.
    #[serde(skip)]
    multiple_scattering_albedo: f64,
}

impl Conductor {
    /// Creates a metal of refractive index n + ik.
    pub fn new(n: f64, k: f64, facets: Ggx) -> Conductor {
        let albedo = Albedo::new(&facets, |_| 1.0);
        let mean = fresnel::mean(|cosine| fresnel::conductor(n, k, cosine));
        // Geometric series: at least two facets, and each further facet with the probability that
        // the light does not leave.
        let several = mean * mean * albedo.mean / (1.0 - mean * (1.0 - albedo.mean));
        Conductor {
            n,
            k,
            facets,
            albedo,
            multiple_scattering_albedo: several,
        }
    }

    /// Returns the BRDF, 1/sr, for local directions above the surface.
    pub fn bsdf(&self, i: DVec3, o: DVec3) -> f64 {
        let once = |cosine| fresnel::conductor(self.n, self.k, cosine);
        self.facets.bsdf(i, o, once)
            + self.multiple_scattering_albedo * self.albedo.multiple_scattering_term(i, o)
    }

    /// Returns the albedo of facets with reflectance 1.
    pub(super) fn albedo(&self) -> &Albedo {
        &self.albedo
    }

    /// Returns the fraction of the multiply scattered light that is not absorbed.
    pub(super) fn multiple_scattering_albedo(&self) -> f64 {
        self.multiple_scattering_albedo
    }

    /// Returns the approximate fraction of light from `o` reflected by one facet, and the exact
    /// fraction reflected by several facets.
    pub(super) fn albedo_split(&self, o: DVec3) -> [f64; 2] {
        let white = self.albedo.of(o);
        let once = fresnel::conductor(self.n, self.k, o.z.min(1.0));
        [
            once * white,
            self.multiple_scattering_albedo * (1.0 - white).max(0.0),
        ]
    }

    /// Removes multiple scattering, for comparisons with programs that omit it.
    #[doc(hidden)]
    pub fn single_scattering_only(self) -> Conductor {
        Conductor {
            multiple_scattering_albedo: 0.0,
            ..self
        }
    }

    /// Creates a metal of reflectance 1, for furnace tests.
    #[cfg(test)]
    pub fn white(facets: Ggx) -> Conductor {
        // For k → ∞, F = 1.
        let metal = Conductor::new(1.0, 1e9, facets);
        assert!((metal.multiple_scattering_albedo - 1.0).abs() < 1e-6);
        metal
    }
}
