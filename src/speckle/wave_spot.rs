//! Noise of a laser spot's height by waves, next to the limit of Dorsch, Häusler &
//! Herrmann (1994), "Laser triangulation: fundamental uncertainty in distance
//! measurement", Applied Optics 33, 1306.

use super::motion::Source;
use super::wave::{ImageGrid, Pupil, intensity_at_focus, pupil_field};
use super::wave_correlation::{Estimate, bootstrap, interval};
use super::wave_patch::{lit, patch_filling_view};
use crate::error::Result;
use crate::math::rng::{Key, Purpose};
use crate::math::{DMat3, DVec2, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

const PIXELS_PER_GRAIN: f64 = 3.0;
/// Amplitudes are circular Gaussian one by one, so a few a grain are enough.
const SCATTERERS_PER_GRAIN: f64 = 4.0;
/// The centroid is taken as far beyond the spot's edge, grains: wings of the Airy
/// disc reach further, and each octave of them adds as much noise.
const MARGIN_GRAINS: f64 = 2.0;

/// Light of a spot by the distance from its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SpotShape {
    /// Even up to the radius.
    Disc,
    /// exp(−2r²/w²), w being half the radius at which it is cut.
    Gaussian,
}

/// A triangulation sensor with a collimated round beam and a surface that faces
/// midway between laser and camera: the camera sees a round spot.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpotSetup {
    pub wavelength_mm: f64,
    /// Sine of half the angle under which the surface sees the pupil, D/(2L).
    pub sin_aperture: f64,
    /// Angle between laser beam and viewing ray, rad.
    pub triangulation: f64,
    pub shape: SpotShape,
    /// Radius of the spot in grains h_o = λ/(2·sin u).
    pub radius_grains: f64,
    /// Independent surfaces, 2 or more.
    pub realisations: u64,
    pub seed: u64,
}

/// Height noise of one sensor.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpotRow {
    #[serde(flatten)]
    pub setup: SpotSetup,
    /// λ/(2π·sin u·sin θ), µm.
    pub limit_um: f64,
    /// Standard deviation of the height by waves over the limit, 95 % interval.
    pub ratio: Estimate,
}

/// Distance from pupil to surface, mm; all else scales with it.
const DISTANCE: f64 = 300.0;

/// Standard deviation of the height told by the centroid of a spot's coherent
/// image, over the limit δz = λ/(2π·sin u·sin θ) for speckle contrast 1.
///
/// Fully developed speckle of correlation area A = ∬μ² = 4h²/π under light E has a
/// centroid of variance A·∬E²x²/(∬E)². For an even disc much wider than a grain
/// that is A/(4π) = (h/π)² whatever its radius: exactly the limit. A Gaussian spot
/// gives A/(8π), 1/√2 of the limit. The centroid is over all of the spot, the same
/// window for all surfaces; both its coordinates count, the spot being round.
///
/// # Errors
/// As [`pupil_field`].
pub fn spot_height_noise(setup: &SpotSetup) -> Result<SpotRow> {
    let key = Key::new(setup.seed, Purpose::WaveScatterers);
    let centroids = (0..setup.realisations)
        .into_par_iter()
        .map(|k| centroid(setup, key.with(k)))
        .collect::<Result<Vec<DVec2>>>()?;
    // The mean is 0 by symmetry.
    let deviation = |drawn: &[usize]| {
        let squares: f64 = drawn.iter().map(|&k| centroids[k].length_squared()).sum();
        (squares / (2 * drawn.len()) as f64).sqrt() * PI
    };
    let all: Vec<usize> = (0..centroids.len()).collect();
    let drawn = bootstrap(centroids.len(), setup.seed, deviation);
    Ok(SpotRow {
        setup: *setup,
        limit_um: setup.wavelength_mm * 1e3
            / (2.0 * PI * setup.sin_aperture * setup.triangulation.sin()),
        // δz = δx/sin θ, and the limit of δx is h_o/π.
        ratio: interval(deviation(&all), drawn.into_iter()),
    })
}

/// Centroid of one surface's image, grains.
fn centroid(setup: &SpotSetup, key: Key) -> Result<DVec2> {
    let grain = setup.wavelength_mm / (2.0 * setup.sin_aperture);
    let radius = setup.radius_grains * grain;
    let (sin, cos) = (setup.triangulation / 2.0).sin_cos();
    let to_laser = DVec3::new(-sin, 0.0, cos);
    let pupil = Pupil {
        centre: DVec3::new(sin, 0.0, cos) * DISTANCE,
        right: DVec3::new(cos, 0.0, -sin),
        up: DVec3::Y,
        diameter: 2.0 * DISTANCE * setup.sin_aperture,
    };
    let points = patch_filling_view(
        DVec3::ZERO,
        DVec3::Z,
        [pupil.right, pupil.up],
        DVec2::splat(2.0 * radius),
        DVec2::splat(grain / SCATTERERS_PER_GRAIN.sqrt()),
        setup.wavelength_mm,
    )
    .points(key);
    let source = Source::Wavefront {
        direction: -to_laser,
        curvature_per_mm: DMat3::ZERO,
    };
    let mut scatterers = lit(&points, &source, DVec3::ZERO, |x| {
        let r = x.reject_from_normalized(to_laser).length() / radius;
        match setup.shape {
            _ if r > 1.0 => 0.0,
            SpotShape::Disc => 1.0,
            SpotShape::Gaussian => (-8.0 * r * r).exp(),
        }
    });
    scatterers.retain(|s| s.amplitude > 0.0);
    let window = setup.radius_grains + MARGIN_GRAINS;
    // Eight grains beside the window keep the wings of the periodic image out.
    let pixels = ((2.0 * window + 8.0) * PIXELS_PER_GRAIN / 16.0).ceil() as usize * 16;
    let grid = ImageGrid {
        pixels,
        pixel_mm: grain / PIXELS_PER_GRAIN,
        focus_distance: DISTANCE,
    };
    let field = pupil_field(&scatterers, &pupil, setup.wavelength_mm, &grid)?;
    let image = intensity_at_focus(&field, &grid);
    let reach = (window * PIXELS_PER_GRAIN) as isize;
    let (mut light, mut moment) = (0.0, DVec2::ZERO);
    for up in -reach..=reach {
        for right in -reach..=reach {
            let place = DVec2::new(right as f64, up as f64) / PIXELS_PER_GRAIN;
            if place.length() <= window {
                let intensity = image.at(right, up);
                light += intensity;
                moment += place * intensity;
            }
        }
    }
    Ok(moment / light)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[ignore]
    fn explore() {
        for (shape, radius, n) in [
            (SpotShape::Disc, 3.0, 1000),
            (SpotShape::Disc, 5.0, 1000),
            (SpotShape::Disc, 8.0, 1000),
            (SpotShape::Disc, 12.0, 600),
            (SpotShape::Gaussian, 8.0, 1000),
            (SpotShape::Gaussian, 12.0, 600),
        ] {
            let start = std::time::Instant::now();
            let row = spot_height_noise(&SpotSetup {
                wavelength_mm: 660e-6,
                sin_aperture: 0.0167,
                triangulation: 0.5,
                shape,
                radius_grains: radius,
                realisations: n,
                seed: 1,
            })
            .unwrap();
            println!("{shape:?} {radius} {:?} {:?}", row.ratio, start.elapsed());
        }
    }
}
