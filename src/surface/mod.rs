//! Reflection of light by the surface of the part.

mod albedo;
mod coat;
mod fresnel;
mod ggx;
mod glossy;
pub(crate) mod lanes;
mod lay;
mod materials;
mod metal;
mod mirror;
mod refractive_index;
mod scatter;
mod topography;

pub use coat::CoatedDiffuse;
pub use ggx::Ggx;
pub use glossy::{LayeredBrdf, LitPoint, Lobe};
pub use lay::Lay;
pub use materials::{Material, Materials};
pub use metal::Conductor;
pub use mirror::Mirror;
pub use refractive_index::{WAVELENGTHS_NM, index as metal_index, names as metal_names};
pub use scatter::{BsdfSample, Scatter};
pub use topography::{LineFootprint, Topography};

use crate::math::DVec3;
use std::f64::consts::FRAC_1_PI;
use std::sync::Arc;

/// Diffuse (Lambertian) reflection with equal radiance in all directions.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lambert {
    /// Fraction of the incident flux that is reflected, 0 to 1.
    pub reflectance: f64,
}

impl Lambert {
    /// Returns the BRDF, 1/sr, equal for all directions: ρ/π (Lambert 1760).
    #[inline(always)]
    pub fn bsdf(&self) -> f64 {
        self.reflectance * FRAC_1_PI
    }
}

/// Surface of a part.
#[derive(Clone, serde::Serialize)]
#[serde(untagged)]
pub enum Surface {
    /// Diffuse surface.
    Lambert(Lambert),
    /// Mixture of lobes.
    Layered(#[serde(serialize_with = "inner")] Arc<LayeredBrdf>),
}

fn inner<S: serde::Serializer>(glossy: &LayeredBrdf, serializer: S) -> Result<S::Ok, S::Error> {
    serde::Serialize::serialize(glossy, serializer)
}

impl From<Lambert> for Surface {
    fn from(lambert: Lambert) -> Surface {
        Surface::Lambert(lambert)
    }
}

impl Surface {
    /// Returns the BRDF, 1/sr, at `point` (part frame, mm) with the given normal. The directions
    /// are unit vectors of the part frame and point away from the surface.
    pub fn bsdf(
        &self,
        point: DVec3,
        normal: DVec3,
        towards_light: DVec3,
        towards_eye: DVec3,
    ) -> f64 {
        match self {
            Surface::Lambert(lambert) => lambert.bsdf(),
            Surface::Layered(glossy) => glossy.lit(point, normal, towards_light).bsdf(towards_eye),
        }
    }

    /// Returns the fraction of uniform light from all directions that is reflected.
    pub fn mean_reflectance(&self) -> f64 {
        match self {
            Surface::Lambert(lambert) => lambert.reflectance,
            Surface::Layered(glossy) => {
                let lobes = glossy.lobes.iter();
                lobes
                    .map(|(weight, lobe)| weight * lobe.mean_reflectance())
                    .sum()
            }
        }
    }

    /// Returns the lobes, or `None` for a Lambertian surface, whose BRDF is constant.
    #[inline(always)]
    pub fn glossy(&self) -> Option<&LayeredBrdf> {
        match self {
            Surface::Lambert(_) => None,
            Surface::Layered(glossy) => Some(glossy),
        }
    }
}

#[cfg(test)]
mod tests;
