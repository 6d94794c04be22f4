//! Surfaces whose radiance depends on direction: a mix of lobes on one lay.

use super::Lambert;
use super::coat::Coat;
use super::ggx::Ggx;
use super::lay::Lay;
use super::metal::Metal;
use super::mirror::Mirror;
use crate::math::{DMat3, DVec3};
use std::f64::consts::FRAC_1_PI;

/// By how much a BRDF may vary for it to be taken as the same.
const SAME: f64 = 0.01;

/// One way to scatter light.
#[derive(Clone, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Lobe {
    /// Evenly, from within.
    Matt(Lambert),
    /// By rough bare metal.
    Metal(Metal),
    /// By a clear coat over a diffuse base.
    Coat(Coat),
    /// By a perfect mirror.
    Mirror(Mirror),
}

impl Lobe {
    /// What of the BRDF (1/sr) keeps the light's polarisation, as it is reflected at the surface, and
    /// what comes from within and has lost it; in local directions, both above the surface.
    pub(super) fn parts(&self, i: DVec3, o: DVec3) -> [f64; 2] {
        match self {
            Lobe::Matt(matt) => [0.0, matt.reflectance * FRAC_1_PI],
            Lobe::Metal(metal) => [metal.bsdf(i, o), 0.0],
            Lobe::Coat(coat) => [coat.gloss(i, o), coat.body(i, o)],
            Lobe::Mirror(_) => [0.0; 2],
        }
    }

    fn facets(&self) -> Option<&Ggx> {
        match self {
            Lobe::Matt(_) | Lobe::Mirror(_) => None,
            Lobe::Metal(metal) => Some(&metal.facets),
            Lobe::Coat(coat) => Some(&coat.facets),
        }
    }
}

/// Lobes, each with the share of the surface that has it (sum at most 1), and the lay of their roughness.
#[derive(Clone, serde::Serialize)]
pub struct Glossy {
    /// Shares and lobes.
    pub lobes: Vec<(f64, Lobe)>,
    /// `None`: no direction is distinguished.
    pub lay: Option<Lay>,
}

/// A surface at one point, lit from one direction.
pub struct LitPoint<'a> {
    surface: &'a Glossy,
    local_from_part: DMat3,
    towards_light: DVec3,
}

impl LitPoint<'_> {
    fn parts(&self, towards_eye: DVec3) -> [f64; 2] {
        let o = self.local_from_part * towards_eye;
        if !(self.towards_light.z > 0.0 && o.z > 0.0) {
            return [0.0; 2];
        }
        let lobes = self.surface.lobes.iter();
        lobes.fold([0.0; 2], |[kept, lost], (share, lobe)| {
            let parts = lobe.parts(self.towards_light, o);
            [kept + share * parts[0], lost + share * parts[1]]
        })
    }

    /// Radiance towards the eye per irradiance received (1/sr); 0 from behind.
    pub fn bsdf(&self, towards_eye: DVec3) -> f64 {
        let [kept, lost] = self.parts(towards_eye);
        kept + lost
    }

    /// Share of that light which has kept its polarisation, 0 to 1; 1 where there is none.
    pub fn polarised(&self, towards_eye: DVec3) -> f64 {
        let [kept, lost] = self.parts(towards_eye);
        match kept + lost > 0.0 {
            true => kept / (kept + lost),
            false => 1.0,
        }
    }
}

impl Glossy {
    /// At `point` (part's frame, mm) with this normal, lit from there; unit vectors away from
    /// the surface.
    pub fn lit(&self, point: DVec3, normal: DVec3, towards_light: DVec3) -> LitPoint<'_> {
        let [x, y, z] = Lay::frame(self.lay.as_ref(), point, normal);
        let local_from_part = DMat3::from_cols(x, y, z).transpose();
        LitPoint {
            surface: self,
            local_from_part,
            towards_light: local_from_part * towards_light,
        }
    }

    /// α of the narrowest lobe; infinite if all are matt.
    pub fn narrowest(&self) -> f64 {
        let facets = self.lobes.iter().filter_map(|(_, lobe)| lobe.facets());
        facets.map(Ggx::least).fold(f64::INFINITY, f64::min)
    }

    /// Greatest angle (rad) by which the direction midway between light and eye may turn against
    /// the normal for the BRDF to be the same to [`SAME`]: |d ln D/dθ| ≤ 2/α.
    pub fn constant_turn(&self) -> f64 {
        SAME / 2.0 * self.narrowest()
    }
}
