//! Propagation of a Gaussian beam (Siegman 1986, Lasers, ch. 17).

use super::BeamCrossSection;
use crate::math::DVec3;
use std::f64::consts::PI;

/// Gaussian beam; lengths in mm, measured along the axis from the aperture.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Beam {
    /// Wavelength, mm.
    pub wavelength: f64,
    /// Total power of the beam, mW.
    pub power_mw: f64,
    /// 1/e² radius of the irradiance at the waist w₀, mm.
    pub waist_radius: f64,
    /// Distance of the waist from the aperture, mm; may be negative.
    pub waist_distance: f64,
    /// Beam quality factor M², ≥ 1.
    pub m_squared: f64,
}

impl Beam {
    /// Returns the Rayleigh range z_R = π·w₀²/(M²·λ), mm, the distance from the waist at which the
    /// radius is √2·w₀.
    pub fn rayleigh_range(&self) -> f64 {
        PI * self.waist_radius.powi(2) / (self.m_squared * self.wavelength)
    }

    /// Returns the far-field half angle λ·M²/(π·w₀), rad. The paraxial theory is valid below 0.5.
    pub fn divergence(&self) -> f64 {
        self.m_squared * self.wavelength / (PI * self.waist_radius)
    }

    /// Returns the 1/e² radius w(z) = w₀·√(1 + (z/z_R)²), mm, at distance `z` from the aperture.
    pub fn radius(&self, z: f64) -> f64 {
        let spread = (z - self.waist_distance) / self.rayleigh_range();
        self.waist_radius * (1.0 + spread * spread).sqrt()
    }

    /// Returns w(z), w′(z)/w(z) and w(0)/w(z) in one computation. With D² = z_R² + z², where z is
    /// measured from the waist, the values are θ·D, z/D² and D(0)/D.
    pub(crate) fn shape(&self, z: f64) -> BeamShape {
        let (divergence, waist) = (self.divergence(), self.waist_distance);
        let range2 = (self.waist_radius / divergence).powi(2);
        let off = z - waist;
        let d2 = range2 + off * off;
        let inverse = 1.0 / d2;
        BeamShape {
            radius: divergence * d2.sqrt(),
            slope: off * inverse,
            aperture_radius_ratio: ((range2 + waist * waist) * inverse).sqrt(),
        }
    }

    /// Returns the section of a round beam with E = 2P/(π·w²)·exp(-2r²/w²) across the axis.
    pub(super) fn round(&self, p: DVec3) -> Option<BeamCrossSection> {
        if p.z <= 0.0 {
            return None;
        }
        let BeamShape {
            radius: w,
            slope,
            aperture_radius_ratio: shrink,
        } = self.shape(p.z);
        let irradiance = 2.0 * self.power_mw / (PI * w * w);
        Some(BeamCrossSection {
            flux: irradiance * DVec3::new(p.x * slope, p.y * slope, 1.0),
            radius: w,
            aperture_point: DVec3::new(p.x * shrink, p.y * shrink, 0.0),
        })
    }
}

/// Beam shape at a distance from the aperture.
pub(crate) struct BeamShape {
    /// 1/e² radius w, mm.
    pub radius: f64,
    /// Relative slope w′/w, 1/mm. Energy flows along r/w = const, so a ray at radius r has the
    /// slope r·w′/w.
    pub slope: f64,
    /// Ratio of the radius at the aperture to the radius at this distance.
    pub aperture_radius_ratio: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The shape agrees with w(z) and its difference quotient over ±h.
    ///
    /// The error of the quotient is h²/6·w‴, and w‴ is at most 0.86·w₀/z_R³. For h = 1e-4 mm and
    /// z_R = 0.37 mm, the shortest range here, this is 3e-8/mm relative to w. Rounding of z by 2⁻⁴⁶
    /// adds a thirtieth of that.
    #[test]
    fn the_shape_is_that_of_the_radius() {
        for (waist_radius, waist_distance) in [(0.01, 150.0), (0.08, 0.0), (2.0, -30.0)] {
            let beam = Beam {
                wavelength: 660e-6,
                power_mw: 1.0,
                waist_radius,
                waist_distance,
                m_squared: 1.3,
            };
            for z in [1e-6, 90.0, 149.9, 151.0, 400.0] {
                let (shape, w) = (beam.shape(z), beam.radius(z));
                let steep = (beam.radius(z + 1e-4) - beam.radius(z - 1e-4)) / 2e-4;
                assert!((shape.radius / w - 1.0).abs() < 1e-14, "{z}");
                assert!((shape.aperture_radius_ratio * w / beam.radius(0.0) - 1.0).abs() < 1e-14);
                assert!((shape.slope - steep / w).abs() < 1e-7, "{z}");
            }
        }
    }
}
