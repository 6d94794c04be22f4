//! Pupil of the lens in terms of spatial frequencies on the sensor.
//!
//! A lag Δ on the sensor (pixels) is g = G·Δ grains ([`Camera::grains_per_pixel`]). A point at the
//! origin produces the field ∫ P(u)·exp(iπβ·uᵀMu)·exp(−2πi·u·g) d²u over pupil points u in pupil
//! diameters (Goodman 2005, 6.4). The pupil point u therefore corresponds to the frequency Gᵀu in
//! cycles per pixel.
//!
//! β = (D²/λ)·(1/z_o − 1/z_f) is the signed blur diameter in grains, positive for points nearer
//! than the focus distance z_f. M = cosθ·(1 − n·nᵀ) is the foreshortening of the pupil, where n
//! holds the direction cosines of the chief ray. On a sensor parallel to the lens, the blur has the
//! shape of the pupil.

use super::circular_otf::{self, CircularOtfTable};
use crate::camera::Camera;
use crate::math::quadrature::gauss_legendre;
use crate::math::{Aperture, DMat2, DVec2};
use std::f64::consts::PI;
use wide::f32x8;

/// Pupil for the light around one sensor position.
#[derive(Debug, Clone, Copy)]
pub(super) struct PupilOtf {
    pub aperture: Aperture,
    /// G, grains per pixel.
    pub grains: DMat2,
    /// Map from frequencies in cycles per pixel to pupil points, G⁻ᵀ.
    pupil_from_frequency: DMat2,
    /// Foreshortening matrix M.
    foreshortening: DMat2,
    /// Direction cosines n.
    direction: DVec2,
}

impl PupilOtf {
    /// Builds the pupil at a sensor position (column, row), for a wavelength in mm.
    pub fn new(camera: &Camera, place: DVec2, wavelength: f64) -> PupilOtf {
        let grains = camera.grains_per_pixel(place, wavelength);
        let n = camera.model().chief_rays().cosines(place);
        let cosine = (1.0 - n.length_squared()).sqrt();
        PupilOtf {
            aperture: camera.lens.aperture,
            grains,
            pupil_from_frequency: grains.transpose().inverse(),
            foreshortening: (DMat2::IDENTITY - DMat2::from_cols(n * n.x, n * n.y)) * cosine,
            direction: n,
        }
    }

    /// Returns the pupil point of a frequency, cycles per pixel.
    pub fn point(&self, frequency: DVec2) -> DVec2 {
        self.pupil_from_frequency * frequency
    }

    /// Returns the open fraction of a frequency cell, and uᵀMu. `frequency` and `cell` (along
    /// columns and rows) are in cycles per pixel. The fraction is 1 or 0 except at the pupil rim.
    /// The lens multiplies a field by this fraction and adds the phase πβ·uᵀMu.
    pub fn amplitude_and_phase(&self, frequency: DVec2, cell: DVec2) -> (f32, f32) {
        const PARTS: usize = 4;
        let u = self.point(frequency);
        let reach = self.point(cell).length();
        let scaled = |u: DVec2| u / DVec2::new(1.0, self.aperture.ratio());
        let contains = |u: DVec2| self.aperture.contains(scaled(u));
        let rim = scaled(u).length();
        let share = if rim + reach / self.aperture.ratio() < 0.5 {
            1.0
        } else if rim - reach / self.aperture.ratio() > 0.5 * self.aperture.extent() {
            0.0
        } else {
            let part = |i: usize| (i as f64 + 0.5) / PARTS as f64 - 0.5;
            let open = (0..PARTS * PARTS)
                .map(|k| DVec2::new(part(k % PARTS), part(k / PARTS)) * cell)
                .filter(|&off| contains(self.point(frequency + off)))
                .count();
            open as f64 / (PARTS * PARTS) as f64
        };
        (share as f32, u.dot(self.foreshortening * u) as f32)
    }

    /// Returns the cut-off frequency of fields along columns and rows, cycles per pixel. The
    /// cut-off frequency of the mean light is twice as high.
    pub fn cutoff_frequency(&self) -> DVec2 {
        let (column, row) = (self.grains.x_axis, self.grains.y_axis);
        DVec2::new(column.length(), row.length()) * (0.5 * self.aperture.extent())
    }

    /// Returns the area of the pupil relative to the area of a frequency `cell`, cycles per pixel
    /// along columns and rows.
    pub fn cells(&self, cell: DVec2) -> f64 {
        let area = match self.aperture {
            Aperture::Circle => PI / 4.0,
            Aperture::Ellipse(ratio) => PI / 4.0 * ratio,
            Aperture::Square => 1.0,
        };
        area / (self.pupil_from_frequency.determinant().abs() * cell.x * cell.y)
    }

    /// Returns the blur radius of a point for |β| = `blur`, pixels along columns and rows. It
    /// includes a margin of `grains` grains.
    pub fn reach(&self, blur: f64, grains: f64) -> DVec2 {
        let narrow = 1.0 / self.aperture.ratio();
        let size = |of: DMat2| {
            let rows = of.transpose();
            DVec2::new(rows.x_axis.length(), rows.y_axis.length())
        };
        let lag = self.grains.inverse();
        size(lag * self.foreshortening) * (self.aperture.extent() * blur / 2.0)
            + size(lag) * (grains * narrow)
    }

    /// Returns the optical transfer function of the mean light at eight frequencies (cycles per
    /// pixel, along columns and along rows). It is the real autocorrelation of the pupil with its
    /// phase, ∫ P(u + ν/2)·P(u − ν/2)·cos(2πβ·u·Mν) d²u / ∫P d²u (Hopkins 1955). It is 1 at zero
    /// frequency, and 0 where shifted pupils do not overlap. `rule`: see [`PupilOtf::cubature_rule`].
    fn otf(&self, frequency: [f32x8; 2], blur: f64, rule: &[(f64, f64)]) -> f32x8 {
        let of = |m: &DMat2, [x, y]: [f32x8; 2]| {
            let [a, b, c, d] = m.to_cols_array().map(|v| v as f32);
            [x * a + y * c, x * b + y * d]
        };
        let [one, pi] = [f32x8::ONE, f32x8::PI];
        let near_sinc = |x: f32x8| one - x * x * (1.0 / 6.0) * (one - x * x * (1.0 / 20.0));
        let sinc = |r: f32x8| {
            let x = r * pi;
            (x.abs().simd_lt(f32x8::splat(0.1))).select(near_sinc(x), x.sin_cos().0 / x)
        };
        let lag = of(&self.pupil_from_frequency, frequency);
        let slope = of(&self.foreshortening, lag).map(|s| s * blur as f32);
        if self.aperture == Aperture::Square {
            let left = lag.map(|lag| (one - lag.abs()).max(f32x8::ZERO));
            return left[0] * left[1] * sinc(slope[0] * left[0]) * sinc(slope[1] * left[1]);
        }
        let ratio = self.aperture.ratio() as f32;
        // The ellipse is scaled to a disc. Two discs overlap in a lens shape, integrated in strips
        // across the lag.
        let (lag, slope) = ([lag[0], lag[1] / ratio], [slope[0], slope[1] * ratio]);
        let length = (lag[0] * lag[0] + lag[1] * lag[1]).sqrt();
        let tiny = length.simd_lt(f32x8::splat(1e-12));
        let along = [
            tiny.select(one, lag[0] / length),
            tiny.select(f32x8::ZERO, lag[1] / length),
        ];
        let by = slope[0] * along[0] + slope[1] * along[1];
        let across = slope[1] * along[0] - slope[0] * along[1];
        let widest = length.min(one).acos();
        let mut sum = f32x8::ZERO;
        // The phase across the lag is small, except for positions far from the axis.
        let is_near = (across * pi).to_array().iter().all(|x| x.abs() < 0.5);
        for &(x, weight) in rule {
            let (sin, cos) = (widest * x as f32).sin_cos();
            let phase = pi * by * (cos - length);
            let of_across = match is_near {
                true => near_sinc(across * sin * pi),
                false => sinc(across * sin),
            };
            sum += sin * sin * phase.sin_cos().1 * of_across * weight as f32;
        }
        sum * widest * (4.0 / std::f32::consts::PI)
    }

    /// Prepares transfer functions at these frequencies, cycles per pixel along columns and along
    /// rows.
    pub fn passes<'a>(&'a self, frequencies: &'a [DVec2]) -> OtfEvaluator<'a> {
        let n = self.direction;
        let is_near = n.length_squared() <= 0.06;
        let [a, b, c, d] = self.pupil_from_frequency.to_cols_array().map(|v| v as f32);
        let (cosine, n) = (self.cosine() as f32, n.as_vec2());
        let lag = |frequency: &DVec2| {
            let [x, y] = frequency.to_array().map(|f| f as f32);
            let (x, y) = (x * a + y * c, x * b + y * d);
            let square = x * x + y * y;
            let off = x * n.x + y * n.y;
            let along = 1.0 - off * off / square.max(1e-12);
            [square.sqrt(), cosine * along]
        };
        OtfEvaluator {
            pupil: self,
            frequencies,
            lags: match self.aperture == Aperture::Circle && is_near {
                true => frequencies.iter().map(lag).collect(),
                false => Vec::new(),
            },
        }
    }

    fn cosine(&self) -> f64 {
        (1.0 - self.direction.length_squared()).sqrt()
    }

    /// Returns quadrature nodes for [`PupilOtf::otf`] at |β| = `blur`. The phase is at most
    /// π|β|/4 along the strips. A rule of n ≥ φ/2 + 6 nodes integrates cos(φx) over 0 to 1 with the
    /// full precision of f32.
    fn cubature_rule(blur: f64) -> Vec<(f64, f64)> {
        gauss_legendre(6 + (blur.abs() * PI / 8.0).ceil() as usize)
    }
}

/// [`PupilOtf::otf`] of any number of frequencies, tabulated for a round pupil near the axis.
///
/// Near the axis, the effective blur along a lag ν is β·νᵀMν/ν². The component of M across the lag,
/// at most |n|²/2 of the other one, is neglected. Up to βν = 1, where light is transmitted, the
/// relative error of the transfer is (π·|n|²/2)²/12, 3e-4.
pub(super) struct OtfEvaluator<'a> {
    pupil: &'a PupilOtf,
    frequencies: &'a [DVec2],
    /// Lags, and νᵀMν/ν²; empty if the table does not apply.
    lags: Vec<[f32; 2]>,
}

impl OtfEvaluator<'_> {
    /// Returns the transfer functions at a blur β.
    pub fn at(&self, blur: f64) -> Vec<f32> {
        if blur.abs() < circular_otf::MAX_BLUR && !self.lags.is_empty() {
            let (blur, cosine) = (blur.abs(), self.pupil.cosine());
            let disc = CircularOtfTable::new(blur * cosine.powi(3), blur * cosine);
            let pass = |&[lag, along]: &[f32; 2]| disc.transfer(lag, along * blur as f32);
            return self.lags.iter().map(pass).collect();
        }
        let rule = PupilOtf::cubature_rule(blur);
        let mut passes = Vec::with_capacity(self.frequencies.len() + 7);
        for eight in self.frequencies.chunks(8) {
            let of = |axis: usize| {
                let mut lanes = [0.0; 8];
                for (lane, frequency) in lanes.iter_mut().zip(eight) {
                    *lane = frequency[axis] as f32;
                }
                f32x8::from(lanes)
            };
            let eight = self.pupil.otf([of(0), of(1)], blur, &rule);
            passes.extend(eight.to_array());
        }
        passes
    }
}

#[cfg(test)]
#[path = "pupil_tests.rs"]
mod tests;
