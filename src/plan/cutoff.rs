//! Choice of the beam cut-off.

use crate::camera::Camera;
use crate::laser::{CUTOFF_RADII, Laser};
use crate::math::DVec3;
use std::f64::consts::PI;

/// Maximum contribution of light at the cut-off to a pixel, relative to the standard deviation of
/// its dark counts. Speckle increases the contribution, but by a factor of twenty only in 2e-9 of
/// all positions.
const MAX_CUTOFF_LIGHT_SIGMAS: f64 = 0.01;

/// Returns the beam radii beyond which the laser contributes at most [`MAX_CUTOFF_LIGHT_SIGMAS`] to
/// a pixel. The brightest pixel has an upper bound: a white surface perpendicular to the beam, with
/// the waist at that surface. The surface is at the nearest of the visible `places` (laser frame).
pub(super) fn beam_cutoff_radii(laser: &Laser, camera: &Camera, places: &[DVec3]) -> f64 {
    if places.is_empty() {
        return CUTOFF_RADII;
    }
    let beam = &laser.beam;
    let nearest = places.iter().map(|p| p.x.hypot(p.z));
    let nearest = nearest.fold(f64::INFINITY, f64::min);
    let irradiance = beam.power_mw * 2.0 / PI / beam.waist_radius
        * match &laser.fan {
            None => 1.0 / beam.waist_radius,
            // √(2/π) = 2/π·√(π/2).
            Some(fan) => (PI / 2.0).sqrt() * fan.greatest_peak_per_radian() / nearest,
        };
    let solid_angle = camera.greatest_pupil_solid_angle();
    let electrons =
        irradiance / PI * solid_angle * camera.sensor.electrons_per_irradiance(beam.wavelength);
    let unseen = MAX_CUTOFF_LIGHT_SIGMAS * camera.sensor.dark_variance_e().sqrt();
    let exponent = (electrons / unseen).ln();
    // The exponent is infinite if the aperture is visible.
    (exponent / 2.0).max(1.0).sqrt().min(CUTOFF_RADII)
}
