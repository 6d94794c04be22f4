//! A line laser: a beam spread into a fan by a Powell or cylindrical lens.

use super::beam::Shape;
use super::{Beam, Section};
use crate::math::DVec3;
use std::f64::consts::{FRAC_2_PI, FRAC_PI_2, SQRT_2};

/// Power per radian of fan angle φ.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub enum FanProfile {
    /// Powell lens: P/Φ over the full angle Φ, nothing outside.
    Uniform,
    /// Cylindrical lens: Gaussian of which Φ is the full angle at 1/e².
    Gaussian,
}

/// The opening of a beam to a line by a lens.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Fan {
    /// Full angle Φ, rad, in (0, π).
    pub angle: f64,
    /// How power is spread over the angle.
    pub profile: FanProfile,
}

impl Fan {
    /// p(φ) as a share of the beam's power, 1/rad; its integral is 1.
    pub fn power_per_radian(&self, phi: f64) -> f64 {
        let half = self.angle / 2.0;
        match self.profile {
            FanProfile::Uniform if phi.abs() <= half => 1.0 / self.angle,
            FanProfile::Uniform => 0.0,
            // Light past ±π/2 would go backwards; the rest is scaled up to 1.
            FanProfile::Gaussian => {
                FRAC_2_PI.sqrt() / half * (-2.0 * (phi / half).powi(2)).exp()
                    / libm::erf(SQRT_2 * FRAC_PI_2 / half)
            }
        }
    }

    /// Whether light goes towards `p` (laser frame). |φ| ≤ Φ/2 without the arc
    /// tangent, and mostly without the tangent, which is no less than its angle.
    fn covers(&self, p: DVec3) -> bool {
        let (half, x) = (self.angle / 2.0, p.x.abs());
        // The irradiance goes as 1/ρ; a picometre off, a surface is at the aperture.
        p.z > 1e-9
            && (self.profile == FanProfile::Gaussian || x <= p.z * half || x <= p.z * half.tan())
    }

    /// E = p(φ)/ρ·√(2/π)/w(ρ)·exp(-2y²/w²) with ρ the distance from the fan's
    /// origin line (the laser frame's y axis) and y that from the sheet.
    pub(super) fn sheet(&self, beam: &Beam, p: DVec3) -> Option<Section> {
        if !self.covers(p) {
            return None;
        }
        let per_radian = match self.profile {
            FanProfile::Uniform => 1.0 / self.angle,
            FanProfile::Gaussian => self.power_per_radian(p.x.atan2(p.z)),
        };
        let rho = (p.x * p.x + p.z * p.z).sqrt();
        let Shape {
            radius: w,
            slope,
            at_aperture,
        } = beam.shape(rho);
        let inverse = 1.0 / (rho * w);
        let irradiance = beam.power_mw * per_radian * FRAC_2_PI.sqrt() * inverse;
        // 1/ρ
        let unit = w * inverse;
        Some(Section {
            flux: irradiance * DVec3::new(p.x * unit, p.y * slope, p.z * unit),
            radius: w,
            aperture_point: DVec3::new(0.0, p.y * at_aperture, 0.0),
        })
    }
}
