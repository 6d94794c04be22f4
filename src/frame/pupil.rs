//! The pupil as frequencies on the sensor see it.
//!
//! A lag Δ on the sensor (pixels) is g = G·Δ grains ([`Camera::grains_per_pixel`]). The field
//! that a point at the origin makes there is ∫ P(u)·exp(iπβ·uᵀMu)·exp(−2πi·u·g) d²u over pupil
//! points u in pupil diameters (Goodman 2005, 6.4), so u is the frequency Gᵀu in cycles a
//! pixel. β = (D²/λ)·(1/z_o − 1/z_f) is the diameter of the blur in grains, signed, positive for what
//! is nearer than the focus z_f; M = cosθ·(1 − n·nᵀ), n the chief ray's direction
//! cosines, is what a pupil seen from the side leaves of it: on a sensor parallel to the lens the
//! blur has the pupil's shape.

use super::disc::{self, Disc};
use crate::camera::Camera;
use crate::math::quadrature::gauss_legendre;
use crate::math::{Aperture, DMat2, DVec2};
use std::f64::consts::PI;
use wide::f32x8;

/// Of the light around one place of the sensor.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pupil {
    pub aperture: Aperture,
    /// G, grains a pixel.
    pub grains: DMat2,
    /// From frequencies in cycles a pixel to pupil points, G⁻ᵀ.
    from_frequency: DMat2,
    /// M.
    oblique: DMat2,
    /// n.
    direction: DVec2,
}

impl Pupil {
    /// Around a place (column, row) on the sensor, for a wavelength in mm.
    pub fn new(camera: &Camera, place: DVec2, wavelength: f64) -> Pupil {
        let grains = camera.grains_per_pixel(place, wavelength);
        let n = camera.model().chief_rays().cosines(place);
        let cosine = (1.0 - n.length_squared()).sqrt();
        Pupil {
            aperture: camera.lens.aperture,
            grains,
            from_frequency: grains.transpose().inverse(),
            oblique: (DMat2::IDENTITY - DMat2::from_cols(n * n.x, n * n.y)) * cosine,
            direction: n,
        }
    }

    /// Pupil point of a frequency, cycles a pixel.
    pub fn point(&self, frequency: DVec2) -> DVec2 {
        self.from_frequency * frequency
    }

    /// Of a frequency (cycles a pixel): the share of its `cell` (cycles a pixel along columns and rows) that is
    /// open, 1 but at the pupil's rim, and uᵀMu. A field leaves the lens with that share, and turned by πβ
    /// times the latter.
    pub fn opening(&self, frequency: DVec2, cell: DVec2) -> (f32, f32) {
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
        (share as f32, u.dot(self.oblique * u) as f32)
    }

    /// Greatest frequency along columns and rows that a field may pass with, cycles a pixel; of the mean
    /// light it is twice that.
    pub fn most(&self) -> DVec2 {
        let (column, row) = (self.grains.x_axis, self.grains.y_axis);
        DVec2::new(column.length(), row.length()) * (0.5 * self.aperture.extent())
    }

    /// Area of the pupil over that of the frequencies' `cell`, cycles a pixel along columns and rows.
    pub fn cells(&self, cell: DVec2) -> f64 {
        let area = match self.aperture {
            Aperture::Circle => PI / 4.0,
            Aperture::Ellipse(ratio) => PI / 4.0 * ratio,
            Aperture::Square => 1.0,
        };
        area / (self.from_frequency.determinant().abs() * cell.x * cell.y)
    }

    /// How far (pixels, along columns' and rows' direction) a point's light is spread for
    /// |β| `blur`: the blur's edge and `grains` grains more.
    pub fn reach(&self, blur: f64, grains: f64) -> DVec2 {
        let narrow = 1.0 / self.aperture.ratio();
        let size = |of: DMat2| {
            let rows = of.transpose();
            DVec2::new(rows.x_axis.length(), rows.y_axis.length())
        };
        let lag = self.grains.inverse();
        size(lag * self.oblique) * (self.aperture.extent() * blur / 2.0)
            + size(lag) * (grains * narrow)
    }

    /// Transfer of the mean light at eight frequencies (cycles a pixel, along columns and along rows), real: the
    /// autocorrelation of the pupil under its phase, ∫ P(u + ν/2)·P(u − ν/2)·cos(2πβ·u·Mν) d²u /
    /// ∫P d²u (Hopkins 1955). 1 at zero frequency, 0 from where the pupil no longer overlaps itself.
    /// `rule`: see [`Pupil::rule`].
    fn transfers(&self, frequency: [f32x8; 2], blur: f64, rule: &[(f64, f64)]) -> f32x8 {
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
        let lag = of(&self.from_frequency, frequency);
        let slope = of(&self.oblique, lag).map(|s| s * blur as f32);
        if self.aperture == Aperture::Square {
            let left = lag.map(|lag| (one - lag.abs()).max(f32x8::ZERO));
            return left[0] * left[1] * sinc(slope[0] * left[0]) * sinc(slope[1] * left[1]);
        }
        let ratio = self.aperture.ratio() as f32;
        // As a disc, of which two overlap in a lens: strips across the way between them.
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
        // But for places far off the axis what is across hardly counts.
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

    /// For transfers at frequencies in cycles a pixel, along columns and along rows.
    pub fn passes<'a>(&'a self, frequencies: &'a [DVec2]) -> Passes<'a> {
        let n = self.direction;
        let is_near = n.length_squared() <= 0.06;
        let [a, b, c, d] = self.from_frequency.to_cols_array().map(|v| v as f32);
        let (cosine, n) = (self.cosine() as f32, n.as_vec2());
        let lag = |frequency: &DVec2| {
            let [x, y] = frequency.to_array().map(|f| f as f32);
            let (x, y) = (x * a + y * c, x * b + y * d);
            let square = x * x + y * y;
            let off = x * n.x + y * n.y;
            let along = 1.0 - off * off / square.max(1e-12);
            [square.sqrt(), cosine * along]
        };
        Passes {
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

    /// Nodes for [`Pupil::transfers`] at |β| `blur`: the phase is at most π|β|/4 along the strips, and
    /// a rule of n nodes integrates cos(φx) over 0 to 1 to f32's last digits from
    /// n = φ/2 + 6 on.
    fn rule(blur: f64) -> Vec<(f64, f64)> {
        gauss_legendre(6 + (blur.abs() * PI / 8.0).ceil() as usize)
    }
}

/// [`Pupil::transfers`] of any number of frequencies; of a round pupil near the axis by table.
///
/// There the blur along a lag ν is β·νᵀMν/ν², and what M has across it, at most |n|²/2 of that, is left out:
/// as far as light is passed, to βν = 1, that is (π·|n|²/2)²/12 of the transfer, 3e-4.
pub(super) struct Passes<'a> {
    pupil: &'a Pupil,
    frequencies: &'a [DVec2],
    /// Lags, and νᵀMν/ν²; empty where no table has the transfer.
    lags: Vec<[f32; 2]>,
}

impl Passes<'_> {
    /// At a blur β.
    pub fn at(&self, blur: f64) -> Vec<f32> {
        if blur.abs() < disc::MOST && !self.lags.is_empty() {
            let (blur, cosine) = (blur.abs(), self.pupil.cosine());
            let disc = Disc::new(blur * cosine.powi(3), blur * cosine);
            let pass = |&[lag, along]: &[f32; 2]| disc.transfer(lag, along * blur as f32);
            return self.lags.iter().map(pass).collect();
        }
        let rule = Pupil::rule(blur);
        let mut passes = Vec::with_capacity(self.frequencies.len() + 7);
        for eight in self.frequencies.chunks(8) {
            let of = |axis: usize| {
                let mut lanes = [0.0; 8];
                for (lane, frequency) in lanes.iter_mut().zip(eight) {
                    *lane = frequency[axis] as f32;
                }
                f32x8::from(lanes)
            };
            let eight = self.pupil.transfers([of(0), of(1)], blur, &rule);
            passes.extend(eight.to_array());
        }
        passes
    }
}

#[cfg(test)]
#[path = "pupil_tests.rs"]
mod tests;
