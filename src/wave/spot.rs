//! Height noise of a laser spot from wave optics, compared with the limit of Dorsch, Häusler &
//! Herrmann (1994), "Laser triangulation: fundamental uncertainty in distance measurement", Applied
//! Optics 33, 1306.

use super::correlation::{MeanEstimate, bootstrap, interval};
use super::image::{ImageGrid, WavePupil, intensity_at_focus, pupil_field};
use super::patch::{lit, patch_filling_view};
use crate::error::Result;
use crate::math::Aperture;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DMat3, DVec2, DVec3};
use crate::speckle::motion::Source;
use rayon::prelude::*;
use std::f64::consts::PI;

const PIXELS_PER_GRAIN: f64 = 3.0;
/// Number of scatterers per squared grain. Each amplitude is circular Gaussian, so a few per grain
/// are sufficient.
const SCATTERERS_PER_GRAIN: f64 = 4.0;
/// Margin of the centroid window beyond the edge of the spot, grains. The wings of the Airy disc
/// extend further, and each octave of them adds an equal amount of noise.
const MARGIN_GRAINS: f64 = 2.0;

/// Radius of the spots of [`limit_setups`], grains.
pub const LIMIT_RADIUS_GRAINS: f64 = 16.0;

/// Irradiance of a spot as a function of the distance from its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SpotShape {
    /// Uniform up to the radius.
    Disc,
    /// exp(−2r²/w²), where w is half the radius at which the spot is cut off.
    Gaussian,
}

/// Triangulation sensor with a collimated round beam. The surface normal bisects the angle between
/// laser and camera, so the camera sees a round spot.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpotSetup {
    /// Wavelength of the laser, mm.
    pub wavelength_mm: f64,
    /// Sine of half the angle that the pupil subtends at the surface, D/(2L).
    pub sin_aperture: f64,
    /// Angle between laser beam and viewing ray, rad.
    pub triangulation: f64,
    /// Distribution of the irradiance over the spot.
    pub shape: SpotShape,
    /// Radius of the spot, in grains h_o = λ/(2·sin u).
    pub radius_grains: f64,
    /// Number of independent surfaces, 2 or more.
    pub realisations: u64,
    /// Random seed of the rough surfaces.
    pub seed: u64,
}

/// Height noise of one sensor.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpotRow {
    /// Sensor and spot.
    #[serde(flatten)]
    pub setup: SpotSetup,
    /// Limit λ/(2π·sin u·sin θ), µm.
    pub speckle_limit_um: f64,
    /// Standard deviation of the height from wave optics divided by the limit, with its 95 %
    /// interval.
    pub ratio: MeanEstimate,
    /// Expected ratio, from [`expected_ratio`].
    pub expected: f64,
}

/// Distance from pupil to surface, mm. All other lengths scale with it.
const DISTANCE: f64 = 300.0;

/// Computes the standard deviation of the height from the centroid of a spot's coherent image,
/// divided by the limit δz = λ/(2π·sin u·sin θ) for speckle contrast 1.
///
/// Fully developed speckle of correlation area A = ∬μ² = 4h²/π and irradiance E has a centroid of
/// variance A·∬E²x²/(∬E)². For a uniform disc much wider than a grain, this is A/(4π) = (h/π)² for
/// any radius: exactly the limit. A Gaussian spot gives A/(8π), 1/√2 of the limit. Narrower spots
/// have less noise ([`expected_ratio`]). The centroid is computed over the full spot, in one window
/// for all surfaces. Both coordinates are used, because the spot is round.
///
/// # Errors
/// Returns the errors of [`pupil_field`].
pub fn spot_height_noise(setup: &SpotSetup) -> Result<SpotRow> {
    let key = RngKey::new(setup.seed, Purpose::WaveScatterers);
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
        speckle_limit_um: setup.wavelength_mm * 1e3
            / (2.0 * PI * setup.sin_aperture * setup.triangulation.sin()),
        // δz = δx/sin θ, and the limit of δx is h_o/π.
        ratio: interval(deviation(&all), drawn.into_iter()),
        expected: expected_ratio(setup.shape, setup.radius_grains),
    })
}

/// Returns sensors for several apertures, triangulation angles and wavelengths, with a uniform spot
/// of [`LIMIT_RADIUS_GRAINS`]. Every pair of these values occurs once.
pub fn limit_setups(realisations: u64, seed: u64) -> Vec<SpotSetup> {
    let wavelengths_nm = [405.0, 660.0, 850.0];
    let mut setups = Vec::new();
    for (i, sin_aperture) in [0.01, 0.02, 0.05].into_iter().enumerate() {
        for (j, triangulation_deg) in [15.0f64, 30.0, 60.0].into_iter().enumerate() {
            setups.push(SpotSetup {
                wavelength_mm: wavelengths_nm[(i + j) % 3] * 1e-6,
                sin_aperture,
                triangulation: triangulation_deg.to_radians(),
                shape: SpotShape::Disc,
                radius_grains: LIMIT_RADIUS_GRAINS,
                realisations,
                // Every row has separate surfaces.
                seed: seed.wrapping_add(setups.len() as u64),
            });
        }
    }
    setups
}

/// Returns the expected ratio to the limit for a spot of finite radius, over the full image.
///
/// It is π times the root of ∫ jinc²(d)·E(m + d/2)·E(m − d/2)·m_x² dm dd/(∫E)², lengths in grains.
/// A uniform disc has 0.85, 0.93, 0.96, 0.97 at a = 3, 8, 16, 20. The midpoint rule is accurate to
/// 1e-3.
pub fn expected_ratio(shape: SpotShape, radius: f64) -> f64 {
    const SAMPLE_SPACING_MM: f64 = 0.05;
    let sum: f64 = (0..(2.0 * radius / SAMPLE_SPACING_MM) as usize)
        .map(|i| {
            let d = (i as f64 + 0.5) * SAMPLE_SPACING_MM;
            let covariance = Aperture::Circle
                .field_correlation(DVec2::new(d, 0.0))
                .powi(2);
            covariance * 2.0 * PI * d * SAMPLE_SPACING_MM * half_moment(shape, radius, d)
        })
        .sum();
    sum.sqrt() * PI
}

/// Returns ½·∫E(m + d/2)·E(m − d/2)·m² dm/(∫E)². For a disc, the integral is computed in strips
/// along d over the intersection of two discs. For a Gaussian it is a closed form.
fn half_moment(shape: SpotShape, radius: f64, d: f64) -> f64 {
    match shape {
        SpotShape::Gaussian => {
            // The standard deviation is a/4, where a is the radius.
            let variance = (radius / 4.0).powi(2);
            (-d * d / (4.0 * variance)).exp() / (8.0 * PI)
        }
        SpotShape::Disc => {
            const STRIPS: usize = 60;
            let half = (radius * radius - d * d / 4.0).max(0.0).sqrt();
            let strip = |k: usize| {
                let (sin, cos) = ((k as f64 + 0.5) / STRIPS as f64 * PI / 2.0).sin_cos();
                let v = half * sin;
                let u = (radius * radius - v * v).sqrt() - d / 2.0;
                4.0 * half * cos * (PI / 2.0 / STRIPS as f64) * (u.powi(3) / 3.0 + v * v * u)
            };
            0.5 * (0..STRIPS).map(strip).sum::<f64>() / (PI * radius * radius).powi(2)
        }
    }
}

/// Returns the centroid of one surface's image, grains.
fn centroid(setup: &SpotSetup, key: RngKey) -> Result<DVec2> {
    let grain = setup.wavelength_mm / (2.0 * setup.sin_aperture);
    let radius = setup.radius_grains * grain;
    let (sin, cos) = (setup.triangulation / 2.0).sin_cos();
    let to_laser = DVec3::new(-sin, 0.0, cos);
    let pupil = WavePupil {
        centre: DVec3::new(sin, 0.0, cos) * DISTANCE,
        right: DVec3::new(cos, 0.0, -sin),
        up: DVec3::Y,
        diameter: 2.0 * DISTANCE * setup.sin_aperture,
        aperture: Aperture::Circle,
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
    // Eight grains outside the window keep the wings of the periodic image out of it.
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

    /// The ratio converges to 1 for wide uniform spots and to 1/√2 for wide Gaussian spots.
    #[test]
    fn wide_spots_tend_to_the_limit() {
        let disc = |radius| expected_ratio(SpotShape::Disc, radius);
        assert!((disc(8.0) - 0.929).abs() < 1e-3 && (disc(16.0) - 0.959).abs() < 1e-3);
        assert!((disc(100.0) - 1.0).abs() < 0.01);
        let gaussian = expected_ratio(SpotShape::Gaussian, 200.0);
        assert!((gaussian - 0.5f64.sqrt()).abs() < 0.005, "{gaussian}");
    }

    /// Nine sensors of 40 surfaces, with two coordinates each, have a standard error of 1/√(4·360)
    /// = 2.6 %. The tolerance is three standard errors (false alarm 0.3 %, fixed seed) plus 2 % for
    /// the window.
    #[test]
    fn spots_of_finite_radius_stray_as_expected() {
        for (shape, radius_grains) in [(SpotShape::Disc, 6.0), (SpotShape::Gaussian, 8.0)] {
            let mut square = 0.0;
            for setup in limit_setups(40, 7) {
                let setup = SpotSetup {
                    shape,
                    radius_grains,
                    ..setup
                };
                let row = spot_height_noise(&setup).unwrap();
                square += (row.ratio.value / row.expected).powi(2) / 9.0;
            }
            let ratio = square.sqrt();
            assert!((ratio - 1.0).abs() < 0.1, "{shape:?}: {ratio}");
        }
    }
}
