//! Length of speckle grains on a sensor that is tilted or off the axis. Exact paths are compared
//! with the law and with the patterns.

use super::correlation::{MeanEstimate, bootstrap, interval};
use crate::error::Result;
use crate::math::Aperture;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3};
use crate::speckle::frame_field::{FrameFields, PupilPosition, field_spec};
use crate::speckle::lookup::Coherence;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Points across the pupil in the sum of exact paths. The error of their staircase rim is 1e-3 of
/// the area.
const PUPIL_POINTS: usize = 160;
/// Number of patterns, and readings along each side of a pattern.
const PATTERNS: u64 = 14;
const READINGS: usize = 96;
/// Lags at which patterns are compared, divided by their half length from exact paths.
const LAGS: [f64; 9] = [0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4];

/// x at which |2J₁(πx)/(πx)|² is ½.
const HALF_WIDTH: f64 = 0.514_497;

/// Position and direction at which grains are measured. The circular pupil is centred at the
/// origin, perpendicular to the z axis.
#[derive(Debug, Clone, PartialEq)]
pub struct GrainCase {
    /// Description of position and direction.
    pub name: String,
    /// Position on the sensor, mm.
    pub place: DVec3,
    /// Unit vector in the sensor plane, along which the grain is measured.
    pub along: DVec3,
}

/// Full width at half maximum of the autocovariance along a direction, µm.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct GrainRow {
    /// Description of position and direction.
    pub name: String,
    /// Law 1.029·λ/(D·|Mᵀe|); see [`grain_lengths`].
    pub law_um: f64,
    /// Length from sums of exact paths over the pupil.
    pub waves_um: f64,
    /// Length from the patterns used for frames, with its 95 % interval.
    pub texture_um: MeanEstimate,
}

/// Computes the grain lengths for a pupil of the diameter D and a wavelength λ, both in mm.
///
/// The law uses the physical tensor M: |Mᵀe| = |Pᵀ(I − nnᵀ)e|/ℓ. Here n is the direction and ℓ the
/// distance to the position, e the direction on the sensor, and P the plane of the pupil. In wave
/// optics, the fields at two positions a and b have the correlation μ = mean of exp(ik(|q − a| − |q
/// − b|)). The mean is over the points q of the pupil (van Cittert–Zernike, exact distances). The
/// correlation of the intensities is |μ|².
///
/// # Errors
/// Returns the errors of [`FrameFields::new`].
pub fn grain_lengths(
    cases: &[GrainCase],
    pupil_diameter: f64,
    wavelength_mm: f64,
    seed: u64,
) -> Result<Vec<GrainRow>> {
    let grain = wavelength_mm / pupil_diameter;
    let waves: Vec<f64> = (cases.par_iter())
        .map(|case| exact_half_length(case, pupil_diameter, wavelength_mm))
        .collect();
    let measured = (0..PATTERNS)
        .map(|k| {
            pattern_covariances(
                cases,
                &waves,
                grain,
                RngKey::new(seed, Purpose::SpecklePattern).bits(k),
            )
        })
        .collect::<Result<Vec<_>>>()?;
    let row = |(i, case): (usize, &GrainCase)| {
        let length = |drawn: &[usize]| {
            let mean = |lag: usize| {
                let each = drawn.iter().map(|&k| measured[k][i][lag]);
                each.sum::<f64>() / drawn.len() as f64
            };
            2e3 * waves[i] * share_at_half(&std::array::from_fn(mean))
        };
        let all: Vec<usize> = (0..measured.len()).collect();
        let n = case.place.normalize();
        let across = (case.along - n * n.dot(case.along)).truncate() / case.place.length();
        GrainRow {
            name: case.name.clone(),
            law_um: 2e3 * HALF_WIDTH * grain / across.length(),
            waves_um: 2e3 * waves[i],
            texture_um: interval(
                length(&all),
                bootstrap(measured.len(), seed, length).into_iter(),
            ),
        }
    };
    Ok(cases.iter().enumerate().map(row).collect())
}

/// Returns the distance at which |μ|² is ½, mm, by bisection. The upper bound starts at half a
/// round grain for this distance and is increased until the correlation is below ½.
fn exact_half_length(case: &GrainCase, pupil_diameter: f64, wavelength_mm: f64) -> f64 {
    let radius = pupil_diameter / 2.0;
    let at = |i: usize| radius * ((2 * i + 1) as f64 / PUPIL_POINTS as f64 - 1.0);
    let points = (0..PUPIL_POINTS.pow(2))
        .map(|k| DVec3::new(at(k % PUPIL_POINTS), at(k / PUPIL_POINTS), 0.0));
    let pupil: Vec<DVec3> = points.filter(|q| q.length() <= radius).collect();
    let correlation = |distance: f64| {
        let half = case.along * (distance / 2.0);
        let [a, b] = [case.place - half, case.place + half];
        let (mut re, mut im) = (0.0, 0.0);
        for q in &pupil {
            let waves = (q.distance(a) - q.distance(b)) / wavelength_mm;
            let (sin, cos) = (TAU * waves).sin_cos();
            (re, im) = (re + cos, im + sin);
        }
        (re * re + im * im) / (pupil.len() * pupil.len()) as f64
    };
    let mut high = wavelength_mm / pupil_diameter * case.place.length() / 2.0;
    while correlation(high) > 0.5 && high < case.place.length() {
        high *= 1.2;
    }
    let mut low = 0.0;
    for _ in 0..40 {
        let middle = (low + high) / 2.0;
        match correlation(middle) > 0.5 {
            true => low = middle,
            false => high = middle,
        }
    }
    high
}

/// Returns the autocovariances of a pattern at the [`LAGS`] of each case. The lags are in units of
/// the exact half length of the case.
fn pattern_covariances(
    cases: &[GrainCase],
    half_lengths: &[f64],
    grain: f64,
    seed: u64,
) -> Result<Vec<[f64; LAGS.len()]>> {
    let fields = FrameFields::new(&field_spec(seed, Aperture::Circle), Coherence::FULL)?;
    let field = fields.field(&PupilPosition {
        shift: DVec2::ZERO,
        defocus: 0.0,
    });
    // Displacements are not evaluated, so the distance on the axis does not matter.
    let map = fields.map(grain, 1.0);
    let texels = |p: DVec3| map.texels(p.truncate() / p.length());
    let read = |at: DVec2| field.intensity(at) as f64 - 1.0;
    let covariance = |case: &GrainCase, lag: f64| {
        let half = case.along * (lag / 2.0);
        let (a, b) = (texels(case.place - half), texels(case.place + half));
        let products = (0..READINGS * READINGS).map(|k| {
            let grid = DVec2::new((k % READINGS) as f64, (k / READINGS) as f64) * 4.01;
            read(a + grid) * read(b + grid)
        });
        products.sum::<f64>() / (READINGS * READINGS) as f64
    };
    let of = |(case, half): (&GrainCase, &f64)| LAGS.map(|lag| covariance(case, lag * half));
    Ok((cases.par_iter().zip(half_lengths)).map(of).collect())
}

/// Returns the lag at which the autocovariances at [`LAGS`] fall to half the variance of 1. The
/// autocovariance is interpolated linearly between lags.
fn share_at_half(covariances: &[f64; LAGS.len()]) -> f64 {
    let after = covariances.iter().position(|&c| c < 0.5);
    let after = after.unwrap_or(LAGS.len() - 1).max(1);
    let (a, b) = (covariances[after - 1], covariances[after]);
    LAGS[after] - (LAGS[after] - LAGS[after - 1]) * (0.5 - b) / (a - b)
}

/// Returns positions behind a lens of 62.5 mm image distance. The sensor is tilted by τ, and the
/// position is at the angle θ off the axis in the direction of the tilt. Each position is measured
/// along the tilt and across it.
pub fn reference_grains() -> Vec<GrainCase> {
    const DISTANCE: f64 = 62.5;
    let mut cases = Vec::new();
    for [tilt, field] in [[0, 0], [0, 25], [35, 0], [35, 5], [35, -15], [-20, 10]] {
        let (tau, theta) = (f64::from(tilt).to_radians(), f64::from(field).to_radians());
        let along = DVec3::new(tau.cos(), 0.0, tau.sin());
        // Intersection of the plane z = d + x·tanτ with the ray x = z·tanθ.
        let z = DISTANCE / (1.0 - tau.tan() * theta.tan());
        for (side, along) in [("along", along), ("across", DVec3::Y)] {
            cases.push(GrainCase {
                name: format!("sensor tilted {tilt}°, {field}° off the axis, {side}"),
                place: DVec3::new(z * theta.tan(), 0.0, z),
                along,
            });
        }
    }
    cases
}

#[cfg(test)]
mod tests {
    use super::*;

    const D: f64 = 50.0 / 11.0;
    const WAVELENGTH: f64 = 660e-6;

    /// The closed forms of the half lengths on a tilted plane are h·cosτ/(cosθ·cos²(θ + τ)) along
    /// the tilt and h·cosτ/cos(θ + τ) across it. The law is exact to the rounding of its constant.
    ///
    /// The error of wave optics is (D/2d)² = 1.3e-3 for the aperture angle, which the law assumes
    /// small, plus 1e-3 for the pupil's staircase. These errors are doubled for fields of 25°.
    ///
    /// Patterns of 129 024 pairs deviate from wave optics by at most twice the half-width of their
    /// intervals plus 1 %. The half-width is less than 2 %. Linear interpolation over a tenth has
    /// an error of up to 0.2 %.
    #[test]
    fn law_waves_and_patterns_agree_on_tilted_sensors_and_off_the_axis() {
        let cases = reference_grains();
        let rows = grain_lengths(&cases, D, WAVELENGTH, 6).unwrap();
        let h = WAVELENGTH * 62.5 / D;
        for (pair, [tau, theta]) in rows.chunks(2).zip([
            [0.0f64, 0.0f64],
            [0.0, 25.0],
            [35.0, 0.0],
            [35.0, 5.0],
            [35.0, -15.0],
            [-20.0, 10.0],
        ]) {
            let (tau, theta) = (tau.to_radians(), theta.to_radians());
            let cos = (theta + tau).cos();
            let expected = [
                h * tau.cos() / (theta.cos() * cos * cos),
                h * tau.cos() / cos,
            ];
            for (row, expected) in pair.iter().zip(expected) {
                let law = 2e3 * HALF_WIDTH * expected;
                assert!((row.law_um / law - 1.0).abs() < 1e-9, "{row:?} {law}");
                assert!((row.waves_um / law - 1.0).abs() < 4e-3, "{row:?} {law}");
                let e = row.texture_um;
                let half = (e.high - e.low) / 2.0;
                assert!(half < 0.02 * law, "{row:?}");
                let off = (e.value - row.waves_um).abs();
                assert!(off < 2.0 * half + 0.01 * law, "{row:?}");
            }
        }
    }
}
