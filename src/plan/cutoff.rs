//! Where light is taken to end.

use crate::camera::Camera;
use crate::laser::{CUTOFF_RADII, Laser};
use crate::math::DVec3;
use std::f64::consts::PI;

/// What light at the cutoff adds to any pixel at most, of the standard deviation of a dark pixel's counts. Speckle
/// makes more of it, but twenty times as much in 2e-9 of all places only.
const UNSEEN: f64 = 0.01;

/// Beam radii beyond which the laser adds no more than [`UNSEEN`] to a pixel, from
/// an upper bound of the brightest pixel: white paint across the beam at the nearest of
/// the `places` (laser frame) that the sensor sees, the waist lying there.
pub(super) fn cutoff_radii(laser: &Laser, camera: &Camera, places: &[DVec3]) -> f64 {
    if places.is_empty() {
        return CUTOFF_RADII;
    }
    let beam = &laser.beam;
    let nearest = places.iter().map(|p| p.x.hypot(p.z));
    let nearest = nearest.fold(f64::INFINITY, f64::min);
    let irradiance = beam.power_mw * 2.0 / PI / beam.waist_radius
        * match laser.fan {
            None => 1.0 / beam.waist_radius,
            // √(2/π) = 2/π·√(π/2).
            Some(fan) => (PI / 2.0).sqrt() * fan.power_per_radian(0.0) / nearest,
        };
    let solid_angle = camera.greatest_pupil_solid_angle();
    let electrons =
        irradiance / PI * solid_angle * camera.sensor.electrons_per_irradiance(beam.wavelength);
    let unseen = UNSEEN * camera.sensor.dark_variance_e().sqrt();
    let exponent = (electrons / unseen).ln();
    // Infinite for light that is seen at the aperture.
    (exponent / 2.0).max(1.0).sqrt().min(CUTOFF_RADII)
}
