//! Surfaces whose BRDF depends on direction: a mixture of lobes with a common lay.

use super::Lambert;
use super::coat::CoatedDiffuse;
use super::fresnel;
use super::ggx::Ggx;
use super::lay::Lay;
use super::metal::Conductor;
use super::mirror::Mirror;
use crate::math::{DMat3, DVec3};
use std::f64::consts::FRAC_1_PI;

/// Maximum relative change of a BRDF that is treated as constant.
const SAME: f64 = 0.01;

/// BRDF component.
#[derive(Clone, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Lobe {
    /// Diffuse reflection from within the material.
    Diffuse(Lambert),
    /// Rough bare metal.
    Metal(Conductor),
    /// Clear coat over a diffuse base.
    CoatedDiffuse(CoatedDiffuse),
    /// Perfect mirror.
    Mirror(Mirror),
}

impl Lobe {
    /// Returns two components of the BRDF (1/sr). The first is reflected at the surface and
    /// preserves polarisation. The second comes from within the material and is depolarised. Both
    /// directions are local and above the surface.
    pub(super) fn polarised_and_depolarised(&self, i: DVec3, o: DVec3) -> [f64; 2] {
        match self {
            Lobe::Diffuse(matt) => [0.0, matt.reflectance * FRAC_1_PI],
            Lobe::Metal(metal) => [metal.bsdf(i, o), 0.0],
            Lobe::CoatedDiffuse(coat) => [coat.gloss(i, o), coat.body(i, o)],
            Lobe::Mirror(_) => [0.0; 2],
        }
    }

    /// Returns the fraction of uniform light from all directions that is reflected.
    pub(super) fn mean_reflectance(&self) -> f64 {
        match self {
            Lobe::Diffuse(matt) => matt.reflectance,
            Lobe::Metal(metal) => {
                fresnel::mean(|cosine| fresnel::conductor(metal.n, metal.k, cosine))
            }
            Lobe::CoatedDiffuse(coat) => coat.mean_reflectance(),
            Lobe::Mirror(mirror) => mirror.reflectance,
        }
    }

    fn facets(&self) -> Option<&Ggx> {
        match self {
            Lobe::Diffuse(_) | Lobe::Mirror(_) => None,
            Lobe::Metal(metal) => Some(&metal.facets),
            Lobe::CoatedDiffuse(coat) => Some(&coat.facets),
        }
    }
}

/// Lobes with weights (sum at most 1), and the lay of their roughness.
#[derive(Clone, serde::Serialize)]
pub struct LayeredBrdf {
    /// Weights and lobes.
    pub lobes: Vec<(f64, Lobe)>,
    /// `None` for surfaces without a preferred direction.
    pub lay: Option<Lay>,
}

/// Surface at one point, lit from one direction.
pub struct LitPoint<'a> {
    surface: &'a LayeredBrdf,
    local_from_part: DMat3,
    towards_light: DVec3,
}

impl LitPoint<'_> {
    fn polarised_and_depolarised(&self, towards_eye: DVec3) -> [f64; 2] {
        let o = self.local_from_part * towards_eye;
        if !(self.towards_light.z > 0.0 && o.z > 0.0) {
            return [0.0; 2];
        }
        let lobes = self.surface.lobes.iter();
        lobes.fold([0.0; 2], |[kept, lost], (share, lobe)| {
            let parts = lobe.polarised_and_depolarised(self.towards_light, o);
            [kept + share * parts[0], lost + share * parts[1]]
        })
    }

    /// Returns the BRDF towards the camera, 1/sr; 0 from behind.
    pub fn bsdf(&self, towards_eye: DVec3) -> f64 {
        let [kept, lost] = self.polarised_and_depolarised(towards_eye);
        kept + lost
    }

    /// Returns the polarisation-preserving fraction of the light towards the camera, 0 to 1.
    /// Returns 1 if there is no light.
    pub fn degree_of_polarisation(&self, towards_eye: DVec3) -> f64 {
        let [kept, lost] = self.polarised_and_depolarised(towards_eye);
        match kept + lost > 0.0 {
            true => kept / (kept + lost),
            false => 1.0,
        }
    }
}

impl LayeredBrdf {
    /// Evaluates the surface at `point` (part frame, mm) with the given normal, lit from
    /// `towards_light`. Unit vectors point away from the surface.
    pub fn lit(&self, point: DVec3, normal: DVec3, towards_light: DVec3) -> LitPoint<'_> {
        let [x, y, z] = Lay::frame(self.lay.as_ref(), point, normal);
        let local_from_part = DMat3::from_cols(x, y, z).transpose();
        LitPoint {
            surface: self,
            local_from_part,
            towards_light: local_from_part * towards_light,
        }
    }

    /// Returns the roughness α of the narrowest lobe; infinite if all lobes are diffuse.
    pub fn min_roughness(&self) -> f64 {
        let facets = self.lobes.iter().filter_map(|(_, lobe)| lobe.facets());
        facets.map(Ggx::least).fold(f64::INFINITY, f64::min)
    }

    /// Returns the largest rotation (rad) of the half vector relative to the normal for which the
    /// BRDF is constant to [`SAME`]: |d ln D/dθ| ≤ 2/α.
    pub fn max_normal_change_rad(&self) -> f64 {
        SAME / 2.0 * self.min_roughness()
    }
}
