//! The speckle field of a frame whose surface moves otherwise from place to place.
//!
//! What a pose shows of a surface point follows from where that point was seen in
//! another pose, the *reference*, as long as the two share light. Light that has left
//! the pupil does not come back, so references need not reach far: the plane of
//! phasors is cut into strips across the pupil's way, as wide as the pupil, so that it
//! stands on two at most, and the reference of a strip is the pose in which it filled
//! the pupil.
//!
//! The fields of the strips are independent, and their powers are the areas of pupil
//! that they fill. So their sum is a Gaussian field of the same variance (contrast 1);
//! a strip comes in at the pupil's rim and with no power (no jump); and what two frames
//! share is the same phasors, as many as the two pupils have in common.
//!
//! Out of focus the light through a pupil point X that meets at an image point comes
//! from another surface point than through the pupil's centre. With p the place of a
//! phasor in the pupil and d the defocus, that is the gradient of one phase, κ·d·p².
//! About the middle X of a strip it is the linear part, which a strip is read by: at the
//! surface point from which the light through X comes; and κ·d·r², r from the strip's
//! middle, whose change since the reference is the chirp [`Strip::defocus`]. So
//! displacement and chirp are parts of one phase, each counted once.

use super::frame_field::{FrameField, FrameFields};
use crate::math::DVec2;
use rustfft::num_complex::Complex32;
use std::f64::consts::TAU;
use wide::f32x4;

/// A strip of the pupil's plane. Places on the plane are in pupil diameters, along the
/// sensor's columns and rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strip {
    /// Which strip along the way it is.
    pub number: f64,
    /// Where the pupil stood in the reference pose.
    pub reference: DVec2,
    /// Phase by which the way along the viewing ray since then has defocused the pupil's
    /// rim against its centre, rad; see [`super::motion::defocus_phase`].
    pub defocus: f64,
    /// How far aside of the plane's own phasors its phasors are taken: those of another
    /// visit to the same place.
    pub aside: DVec2,
}

impl Strip {
    /// Numbers of the two strips that a pupil at `way` along its way stands on, strips
    /// being `width` diameters wide.
    pub fn numbers(way: f64, width: f64) -> [f64; 2] {
        let first = (way / width - 0.5).floor();
        [first, first + 1.0]
    }

    /// Where the middle of strip `number` lies along the way.
    pub fn middle(number: f64, width: f64) -> f64 {
        (number + 0.5) * width
    }
}

/// A frame's field in two strips, each to be read at a place of its own.
pub struct StripField {
    strips: [FrameField; 2],
    /// Turn of a strip's field for each texel of the place it is read at, rad.
    turns: [DVec2; 2],
}

impl FrameFields {
    /// Width of a strip, pupil diameters.
    pub fn strip_width(&self) -> f64 {
        self.spec().aperture.extent()
    }

    /// The field of a pupil at `shift` on its way along `along` (unit vector).
    ///
    /// A frame's band is centred on its own pupil, and the band of the next frame on
    /// another phasor. For the sum of two strips that are read at two places to stay
    /// the same, both must be turned back to one phasor; any that stays the same while
    /// both are seen will do. Of the phase κ·d·r² of the two middles nothing is left if it
    /// is half way between these.
    pub fn strips(&self, shift: DVec2, along: DVec2, strips: &[Strip; 2]) -> StripField {
        let spec = self.spec();
        let width = self.strip_width() * spec.pupil_width();
        let direction = self.on_plane(along) / spec.pupil_width();
        let half_way = (strips[0].reference + strips[1].reference) / 2.0;
        let parts = strips.map(|strip| {
            let aside = self.on_plane(strip.aside);
            let low = strip.number * width;
            let inside = |q: DVec2| (low..low + width).contains(&(q - aside).dot(direction));
            let from_middle = self.on_plane(shift - strip.reference) / spec.pupil_width();
            let chirp = |axis: usize, p: f64| 4.0 * strip.defocus * (p + from_middle[axis]).powi(2);
            let (field, zero) = self.part(shift + strip.aside, inside, chirp);
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
    /// Weights of the independent patterns, whose sum is 1.
    pub fn weights(&self) -> impl Iterator<Item = f32> + '_ {
        self.strips[0].weights()
    }

    /// Amplitude of one of these patterns, of mean square 1, where the strips are read at these places
    /// (texels).
    pub fn amplitude_of(&self, pattern: usize, at: [DVec2; 2]) -> Complex32 {
        let turn = self.turns[1].dot(at[1]) - self.turns[0].dot(at[0]);
        let turn = Complex32::from_polar(1.0, turn as f32);
        let [a, b] = [0, 1].map(|i| self.strips[i].amplitude_of(pattern, at[i]));
        a + b * turn
    }

    /// Speckle intensity, mean 1, where the strips are read at these places (texels).
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

    /// The same at the first `count` of four places, so many texels along s and along t (at most
    /// [`FrameField::REACH`]) from `at`; differs by rounding. Others are of no use.
    #[inline(always)]
    pub fn around(&self, at: [DVec2; 2], steps: [[f32x4; 2]; 2], count: usize) -> f32x4 {
        let turn = self.turns[1].dot(at[1]) - self.turns[0].dot(at[0]);
        // Within half a turn, so that it can go on as f32. Rounding by a cast: `round` is a call on
        // baseline x86-64.
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
