//! Line laser: a beam expanded into a fan by a Powell or cylindrical lens.

use super::beam::BeamShape;
use super::measured_profile::MeasuredProfile;
use super::{Beam, BeamCrossSection};
use crate::math::DVec3;
use std::f64::consts::{FRAC_2_PI, FRAC_PI_2, SQRT_2};

/// Power per radian of the fan angle φ.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub enum FanProfile {
    /// Powell lens: P/Φ within the full angle Φ, 0 outside.
    Uniform,
    /// Cylindrical lens: Gaussian with the full angle Φ at 1/e².
    Gaussian,
    /// Measured within the full angle Φ, 0 outside.
    Measured(MeasuredProfile),
}

/// Expansion of a beam into a line by a lens.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Fan {
    /// Full angle Φ, rad, in (0, π).
    pub angle: f64,
    /// Distribution of the power over the angle.
    pub profile: FanProfile,
}

impl Fan {
    /// Returns p(φ), the fraction of the beam power per radian, 1/rad; its integral is 1.
    pub fn power_per_radian(&self, phi: f64) -> f64 {
        let half = self.angle / 2.0;
        match &self.profile {
            FanProfile::Uniform if phi.abs() <= half => 1.0 / self.angle,
            FanProfile::Uniform => 0.0,
            // Light beyond ±π/2 would propagate backwards. It is removed, and the rest is
            // normalised to 1.
            FanProfile::Gaussian => {
                FRAC_2_PI.sqrt() / half * (-2.0 * (phi / half).powi(2)).exp()
                    / libm::erf(SQRT_2 * FRAC_PI_2 / half)
            }
            FanProfile::Measured(profile) => profile.power_per_radian(phi),
        }
    }

    /// Returns the greatest fraction of the beam power per radian, 1/rad, relative to the width of the
    /// line.
    pub(crate) fn greatest_peak_per_radian(&self) -> f64 {
        match &self.profile {
            FanProfile::Measured(profile) => profile.greatest_peak_per_radian(),
            _ => self.power_per_radian(0.0),
        }
    }

    /// Returns whether the light ends at the angles ±Φ/2.
    pub fn is_bounded(&self) -> bool {
        self.profile != FanProfile::Gaussian
    }

    /// Returns the 1/e² radius at a point (laser frame) relative to the beam.
    pub(super) fn width_ratio(&self, p: DVec3) -> f64 {
        match &self.profile {
            FanProfile::Measured(profile) => profile.width_ratio(p.x.atan2(p.z)),
            _ => 1.0,
        }
    }

    /// Returns whether `p` (laser frame) is within the fan. The test |φ| ≤ Φ/2 does not require the
    /// arc tangent. Since tan x ≥ x, it usually does not require the tangent either.
    fn covers(&self, p: DVec3) -> bool {
        let (half, x) = (self.angle / 2.0, p.x.abs());
        // The irradiance is proportional to 1/ρ. Points within a picometre are treated as points at
        // the aperture.
        p.z > 1e-9 && (!self.is_bounded() || x <= p.z * half || x <= p.z * half.tan())
    }

    /// Returns the section of a line laser with E = p(φ)/ρ·√(2/π)/w(ρ)·exp(-2y²/w²). The symbol ρ
    /// is the distance from the y axis of the laser frame, which is the origin line of the fan. The
    /// symbol y is the distance from the laser plane.
    pub(super) fn sheet(&self, beam: &Beam, p: DVec3) -> Option<BeamCrossSection> {
        if !self.covers(p) {
            return None;
        }
        let per_radian = match self.profile {
            FanProfile::Uniform => 1.0 / self.angle,
            _ => self.power_per_radian(p.x.atan2(p.z)),
        };
        let rho = (p.x * p.x + p.z * p.z).sqrt();
        let BeamShape {
            radius: w,
            slope,
            aperture_radius_ratio: at_aperture,
        } = beam.shape(rho);
        let w = w * self.width_ratio(p);
        let inverse = 1.0 / (rho * w);
        let irradiance = beam.power_mw * per_radian * FRAC_2_PI.sqrt() * inverse;
        // 1/ρ
        let unit = w * inverse;
        Some(BeamCrossSection {
            flux: irradiance * DVec3::new(p.x * unit, p.y * slope, p.z * unit),
            radius: w,
            aperture_point: DVec3::new(0.0, p.y * at_aperture, 0.0),
        })
    }
}
