//! How the part's surface turns light that arrives into light that leaves.

mod albedo;
mod coat;
mod fresnel;
mod ggx;
mod glossy;
mod lay;
mod metal;
mod metals;
mod mirror;
mod scatter;
mod surfaces;

pub use coat::Coat;
pub use ggx::Ggx;
pub use glossy::{Glossy, LitPoint, Lobe};
pub use lay::Lay;
pub use metal::Metal;
pub use metals::{WAVELENGTHS_NM, index as metal_index, names as metal_names};
pub use mirror::Mirror;
pub use scatter::{Drawn, Scatter};
pub use surfaces::{Kind, Surfaces};

use crate::math::DVec3;
use std::f64::consts::FRAC_1_PI;
use std::sync::Arc;

/// Lambert's law: the same radiance in all directions.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lambert {
    /// Share of the received flux that is reflected, 0 to 1.
    pub reflectance: f64,
}

impl Lambert {
    /// Radiance towards the eye per irradiance received from the light (1/sr), in all
    /// directions. Here it is ρ/π (Lambert 1760).
    #[inline(always)]
    pub fn bsdf(&self) -> f64 {
        self.reflectance * FRAC_1_PI
    }
}

/// A part's surface.
#[derive(Clone, serde::Serialize)]
#[serde(untagged)]
pub enum Surface {
    /// The same in all directions.
    Lambert(Lambert),
    /// Lobes.
    Glossy(#[serde(serialize_with = "inner")] Arc<Glossy>),
}

fn inner<S: serde::Serializer>(glossy: &Glossy, serializer: S) -> Result<S::Ok, S::Error> {
    serde::Serialize::serialize(glossy, serializer)
}

impl From<Lambert> for Surface {
    fn from(lambert: Lambert) -> Surface {
        Surface::Lambert(lambert)
    }
}

impl Surface {
    /// Radiance towards the eye per irradiance received from the light (1/sr), of a surface
    /// with this normal at `point` (part's frame, mm); unit vectors of the part's frame, away from
    /// the surface.
    pub fn bsdf(
        &self,
        point: DVec3,
        normal: DVec3,
        towards_light: DVec3,
        towards_eye: DVec3,
    ) -> f64 {
        match self {
            Surface::Lambert(lambert) => lambert.bsdf(),
            Surface::Glossy(glossy) => glossy.lit(point, normal, towards_light).bsdf(towards_eye),
        }
    }

    /// `None`: Lambert's, which is the same everywhere.
    #[inline(always)]
    pub fn glossy(&self) -> Option<&Glossy> {
        match self {
            Surface::Lambert(_) => None,
            Surface::Glossy(glossy) => Some(glossy),
        }
    }
}

#[cfg(test)]
mod tests;
