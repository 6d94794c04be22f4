//! Speckle field of a frame in which the surface points move differently.
//!
//! The speckle of a surface point in one pose follows from its speckle in another pose, the
//! *reference*, if the two poses have light in common. Light that has left the pupil does not
//! return, so references can be near. The phasor plane is divided into strips across the path of
//! the pupil. Each strip is as wide as the pupil, so the pupil covers at most two. The reference of
//! a strip is the pose at which it filled the pupil.
//!
//! The fields of the strips are independent, and their powers are the areas of the pupil that they
//! fill. Their sum is a Gaussian field of constant variance (contrast 1). A strip enters at the
//! pupil's rim with zero power, so the field has no jumps. Two frames have in common the phasors in
//! the overlap of their pupils.
//!
//! Out of focus, light that reaches an image point through the pupil point X starts at a different
//! surface point than light through the pupil centre. For a phasor at the pupil position p and a
//! defocus d, this offset is the gradient of the phase κ·d·p². The phase is expanded about the
//! centre X of a strip:
//!
//! - The linear part is the position at which the strip is read: the surface point from which the
//!   light through X starts.
//! - The quadratic part is κ·d·r², with r from the centre of the strip. Its change since the
//!   reference is the chirp [`PupilStrip::defocus`].
//!
//! Displacement and chirp are therefore parts of one phase, and each is counted once.

use super::frame_field::{FrameField, FrameFields};
use crate::math::DVec2;
use rustfft::num_complex::Complex32;
use std::f64::consts::TAU;
use wide::f32x4;

/// Strip of the phasor plane. Positions on the plane are in pupil diameters, along the sensor's
/// columns and rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PupilStrip {
    /// Number of the strip along the path.
    pub number: f64,
    /// Position of the pupil at the reference pose.
    pub reference: DVec2,
    /// Defocus phase of the pupil's rim relative to its centre, rad, from the displacement along
    /// the viewing ray since the reference; see [`super::motion::defocus_phase`].
    pub defocus: f64,
    /// Offset on the plane at which the phasors of the strip are taken. It differs between visits
    /// to the same position.
    pub phasor_offset: DVec2,
}

impl PupilStrip {
    /// Returns the numbers of the two strips under a pupil at `way` along its path, for strips
    /// `width` diameters wide.
    pub fn numbers(way: f64, width: f64) -> [f64; 2] {
        let first = (way / width - 0.5).floor();
        [first, first + 1.0]
    }

    /// Returns the position of the centre of strip `number` along the path.
    pub fn middle(number: f64, width: f64) -> f64 {
        (number + 0.5) * width
    }
}

/// Field of a frame in two strips, each read at a separate position.
pub struct StripField {
    strips: [FrameField; 2],
    /// Phase rotation of a strip's field per texel of its reading position, rad.
    turns: [DVec2; 2],
}

impl FrameFields {
    /// Returns the width of a strip, pupil diameters.
    pub fn strip_width(&self) -> f64 {
        self.spec().aperture.extent()
    }

    /// Computes the field of a pupil at `shift` whose path is along `along` (unit vector).
    ///
    /// The passband of each frame is centred on its pupil, so the zero frequency is a different
    /// phasor in the next frame. The sum of two strips that are read at two positions must not
    /// depend on this choice. The fields of both strips are therefore referred to one phasor that
    /// is constant while both strips are in the pupil. The midpoint between the centres of the
    /// strips is used, because the phases κ·d·r² of the two centres cancel there.
    pub fn strips(&self, shift: DVec2, along: DVec2, strips: &[PupilStrip; 2]) -> StripField {
        let spec = self.spec();
        let width = self.strip_width() * spec.pupil_width();
        let direction = self.on_plane(along) / spec.pupil_width();
        let half_way = (strips[0].reference + strips[1].reference) / 2.0;
        let parts = strips.map(|strip| {
            let aside = self.on_plane(strip.phasor_offset);
            let low = strip.number * width;
            let inside = |q: DVec2| (low..low + width).contains(&(q - aside).dot(direction));
            let from_middle = self.on_plane(shift - strip.reference) / spec.pupil_width();
            let chirp = |axis: usize, p: f64| 4.0 * strip.defocus * (p + from_middle[axis]).powi(2);
            let (field, zero) = self.part(shift + strip.phasor_offset, inside, chirp);
            let from_half_way = zero - aside - self.on_plane(half_way);
            (field, from_half_way * (TAU / spec.size as f64))
        });
        let [(first, turn), (second, other)] = parts;
        StripField {
            strips: [first, second],
            turns: [turn, other],
        }
    }
}

impl StripField {
    /// Returns the weights of the independent patterns; their sum is 1.
    pub fn weights(&self) -> impl Iterator<Item = f32> + '_ {
        self.strips[0].weights()
    }

    /// Returns the amplitude of one independent pattern, mean square 1, with the strips read at the
    /// positions `at` (texels).
    pub fn amplitude_of(&self, pattern: usize, at: [DVec2; 2]) -> Complex32 {
        let turn = self.turns[1].dot(at[1]) - self.turns[0].dot(at[0]);
        let turn = Complex32::from_polar(1.0, turn as f32);
        let [a, b] = [0, 1].map(|i| self.strips[i].amplitude_of(pattern, at[i]));
        a + b * turn
    }

    /// Returns the speckle intensity, mean 1, with the strips read at the positions `at` (texels).
    #[inline(always)]
    pub fn intensity(&self, at: [DVec2; 2]) -> f32 {
        let [first, second] = &self.strips;
        let turn = self.turns[1].dot(at[1]) - self.turns[0].dot(at[0]);
        let turn = DVec2::from_angle(turn).as_vec2();
        let layer = |offset: DVec2| {
            let (a, gain_a) = first.amplitude(at[0] + offset);
            let (b, gain_b) = second.amplitude(at[1] + offset);
            (a * gain_a.sqrt() + b.rotate(turn) * gain_b.sqrt()).length_squared()
        };
        let mut sum = self.first_weight() * layer(DVec2::ZERO);
        for &(weight, offset) in &first.further_layers {
            sum += weight * layer(offset);
        }
        sum
    }

    fn first_weight(&self) -> f32 {
        self.strips[0].first_weight
    }

    /// Returns the speckle intensity at the first `count` of four positions; the other values are
    /// undefined. The positions are `steps` texels along s and t (at most [`FrameField::REACH`])
    /// from `at`. Results differ from [`StripField::intensity`] by rounding.
    #[inline(always)]
    pub fn around(&self, at: [DVec2; 2], steps: [[f32x4; 2]; 2], count: usize) -> f32x4 {
        let turn = self.turns[1].dot(at[1]) - self.turns[0].dot(at[0]);
        // The phase is reduced to half a turn, so that f32 is sufficient below. The rounding is a
        // cast, because `round` is a call on baseline x86-64.
        let whole = (turn / TAU + (0.5f64).copysign(turn)) as i64 as f64;
        let mut turns = f32x4::splat((turn - whole * TAU) as f32);
        for (sign, (turn, [s, t])) in [-1.0, 1.0].into_iter().zip(self.turns.iter().zip(steps)) {
            let turn = turn.as_vec2() * sign;
            turns += s * turn.x + t * turn.y;
        }
        let (sin, cos) = turns.sin_cos();
        let layer = |offset: DVec2| {
            let [a, b] = [0, 1].map(|i| {
                let [s, t] = steps[i];
                let (amplitude, kept) = self.strips[i].amplitudes(at[i] + offset, s, t, count);
                let gain = f32x4::ONE / kept.sqrt();
                amplitude.map(|part| part * gain)
            });
            let re = a[0] + b[0] * cos - b[1] * sin;
            let im = a[1] + b[0] * sin + b[1] * cos;
            re * re + im * im
        };
        let mut sum = self.first_weight() * layer(DVec2::ZERO);
        for &(weight, offset) in &self.strips[0].further_layers {
            sum += weight * layer(offset);
        }
        sum
    }
}

#[cfg(test)]
mod tests;
