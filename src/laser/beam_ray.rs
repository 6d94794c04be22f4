//! Sampling of the laser light along flow lines.

use super::{FanProfile, Laser};
use crate::math::{DVec2, DVec3, normal_quantile};
use std::f64::consts::{FRAC_PI_2, SQRT_2};

/// Flow line of the beam through one point of the aperture: r/w(z) = const.
#[derive(Debug, Clone, Copy)]
pub struct BeamRay<'a> {
    laser: &'a Laser,
    /// Fan angle, rad.
    angle: f64,
    /// Offset from the axis or from the laser plane, in beam radii.
    offset_radii: DVec2,
}

impl Laser {
    /// Returns the flow line for a sample `u` of the unit square. Uniform samples have equal power.
    #[doc(hidden)]
    pub fn sample_ray(&self, u: DVec2) -> BeamRay<'_> {
        // The irradiance exp(−2r²/w²) has a standard deviation of w/2.
        let off = |u: f64| normal_quantile(u) / 2.0;
        let (angle, off) = match &self.fan {
            None => (0.0, DVec2::new(off(u.x), off(u.y))),
            Some(fan) => {
                let half = fan.angle / 2.0;
                let angle = match &fan.profile {
                    FanProfile::Uniform => half * (2.0 * u.x - 1.0),
                    FanProfile::Gaussian => {
                        // Light beyond ±π/2 would propagate backwards.
                        let tail = 0.5 * libm::erfc(SQRT_2 * FRAC_PI_2 / half);
                        half / 2.0 * normal_quantile(tail + u.x * (1.0 - 2.0 * tail))
                    }
                    FanProfile::Measured(profile) => profile.quantile(u.x),
                };
                (angle, DVec2::new(0.0, off(u.y)))
            }
        };
        BeamRay {
            laser: self,
            angle,
            offset_radii: off,
        }
    }

    /// Returns the distance of `p` (laser frame) from the aperture along its flow line, mm. The
    /// distance is measured along the axis, or from the origin of a fan.
    #[doc(hidden)]
    pub fn distance(&self, p: DVec3) -> f64 {
        match &self.fan {
            None => p.z,
            Some(_) => p.x.hypot(p.z),
        }
    }

    /// Returns the first coordinate of the sample of [`Self::sample_ray`] whose flow line passes `p`
    /// (laser frame), 0 to 1: the fraction of the power at smaller fan angles. It is 0 without a
    /// fan.
    pub(crate) fn fan_quantile(&self, p: DVec3) -> f64 {
        let Some(fan) = &self.fan else {
            return 0.0;
        };
        let phi = p.x.atan2(p.z);
        let relative = phi / (fan.angle / 2.0);
        let below = match &fan.profile {
            FanProfile::Uniform => relative,
            FanProfile::Gaussian => {
                let whole = libm::erf(SQRT_2 * FRAC_PI_2 / (fan.angle / 2.0));
                libm::erf(SQRT_2 * relative) / whole
            }
            FanProfile::Measured(profile) => return profile.cumulative(phi),
        };
        ((1.0 + below) / 2.0).clamp(0.0, 1.0)
    }
}

impl BeamRay<'_> {
    /// Returns the position at a distance from the aperture, mm (laser frame).
    pub fn at(&self, distance: f64) -> DVec3 {
        let (sin, cos) = self.angle.sin_cos();
        let center = DVec3::new(distance * sin, 0.0, distance * cos);
        let radius = self.laser.beam.radius(distance) * self.laser.width_ratio(center);
        let off = self.offset_radii * radius;
        DVec3::new(off.x + center.x, off.y, center.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laser::{Beam, Fan};
    use crate::math::rng::{Purpose, RngKey};

    /// The quantile of a point on a flow line is the sample of the flow line, to the accuracy of
    /// the normal quantile, 1e-9.
    #[test]
    fn the_fan_quantile_is_the_inverse_of_sampling() {
        for profile in [FanProfile::Uniform, FanProfile::Gaussian] {
            let laser = Laser {
                beam: Beam {
                    wavelength: 660e-6,
                    power_mw: 1.0,
                    waist_radius: 0.05,
                    waist_distance: 60.0,
                    m_squared: 1.2,
                },
                fan: Some(Fan {
                    angle: 0.8,
                    profile: profile.clone(),
                }),
            };
            for u in [0.01, 0.3, 0.5, 0.99] {
                let point = laser.sample_ray(DVec2::new(u, 0.7)).at(120.0);
                let found = laser.fan_quantile(point);
                assert!((found - u).abs() < 1e-6, "{profile:?} {u} {found}");
            }
        }
    }

    /// The power of the flow lines through a part of a plane agrees with the integral of the
    /// irradiance. The tolerance is five standard deviations of the fraction for n = 200 000 (false
    /// alarm below 1e-5 in total).
    #[test]
    fn streams_carry_the_lasers_power() {
        let beam = Beam {
            wavelength: 660e-6,
            power_mw: 1.0,
            waist_radius: 0.05,
            waist_distance: 60.0,
            m_squared: 1.2,
        };
        let fan = |profile| {
            Some(Fan {
                angle: 0.4,
                profile,
            })
        };
        let z = 100.0;
        for (fan, middle, half) in [
            (None, DVec2::new(0.1, -0.15), DVec2::new(0.1, 0.2)),
            (
                fan(FanProfile::Uniform),
                DVec2::new(12.0, 0.2),
                DVec2::new(3.0, 0.15),
            ),
            (
                fan(FanProfile::Gaussian),
                DVec2::new(-9.0, 0.0),
                DVec2::new(6.0, 0.1),
            ),
        ] {
            let laser = Laser { beam, fan };
            let steps = 200;
            let mut expected = 0.0;
            for i in 0..steps * steps {
                let at = DVec2::new((i % steps) as f64, (i / steps) as f64) + 0.5;
                let p = middle + half * (at * (2.0 / steps as f64) - 1.0);
                if let Some(light) = laser.at(p.extend(z)) {
                    expected +=
                        light.flux.z * 4.0 * half.element_product() / (steps * steps) as f64;
                }
            }
            let n = 200_000;
            let key = RngKey::new(8, Purpose::Reflections);
            let met = |i: u64| {
                let stream =
                    laser.sample_ray(DVec2::new(key.with(i).uniform(0), key.with(i).uniform(1)));
                // Iterates to the intersection with the plane.
                let mut p = stream.at(z);
                for _ in 0..5 {
                    p = stream.at(laser.distance(p * (z / p.z)));
                }
                ((p.truncate() - middle).abs() / half).max_element() < 1.0
            };
            let share = (0..n).filter(|&i| met(i)).count() as f64 / n as f64;
            let sigma = (expected * (1.0 - expected) / n as f64).sqrt();
            assert!((0.02..0.98).contains(&expected));
            assert!((share - expected).abs() < 5.0 * sigma, "{share} {expected}");
        }
    }
}
