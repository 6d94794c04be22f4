//! The speckle field of one frame: the pupil is put where the frame's own pose has
//! it, on the endless plane of phasors, and transformed.
//!
//! A frame is one pose, so it needs one slice, at whatever place the pupil has
//! then. Reading a ring of slices made beforehand ([`super::lookup`]) costs twice
//! the taps, and between two slices its correlation is off by a share of theirs.
//! Made for its own place, a frame correlates with every other by the overlap law
//! of the two places, along both axes of the pupil and over any way; and what a
//! phase across the pupil does, defocus foremost, is done to the phasors.

use super::coordinate::GrainMap;
use super::fixed::{Period, REACH};
use super::method::{Coherence, Layer};
use super::pattern::{Columns, PatternSpec, PhasorPlane, ROWS, carrier, rows_of};
use crate::error::Result;
use crate::math::Aperture;
use crate::math::DVec2;
use glam::{Vec2, Vec4, Vec4Swizzles};
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use wide::{f32x4, i32x4};

/// Where a frame's pupil stands among the speckle field's phasors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PupilPlace {
    /// Shift of the pupil over the field, c = −A_p/D, in pupil diameters.
    pub shift: DVec2,
    /// Phase φ by which the way along the viewing ray has defocused the pupil's rim
    /// against its centre (rad); see [`super::motion::defocus_phase`].
    ///
    /// A phasor p diameters from the pupil's centre is turned by 4φ·(|p|² + c·p).
    /// The first term alone would move the pattern too, for the pupil's shift while
    /// it is chirped is a slope of phase; the second takes that back, exactly where
    /// φ is proportional to c, as on a straight way from c = 0. Where patterns
    /// travel is for the displacement on the sensor to say.
    pub defocus: f64,
}

/// What a frame's field is made from: 144² grains, 1.2 MB.
pub fn field_spec(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        size: 384,
        texels_per_speckle: 384.0 / GRAINS,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

/// Grains along each side of a frame's field: phasors across its pupil.
const GRAINS: f64 = 144.0;

/// Widest that a pupil's surroundings may be, in its diameters: see [`wide_field_spec`].
pub const WIDEST: f64 = 2.5;

/// The same of a pupil `wider` times as wide (1 to [`WIDEST`]), 4.8 MB: the field on the surface that
/// a lens sees under light that changes within a grain. Its phasors are those of the pupil and
/// more around it.
pub fn wide_field_spec(seed: u64, aperture: Aperture, wider: f64) -> PatternSpec {
    PatternSpec {
        size: 768,
        texels_per_speckle: 768.0 / (GRAINS * wider),
        ..field_spec(seed, aperture)
    }
}

/// Makes the fields of frames; `spec.slices` is not used. The independent patterns
/// of partly coherent light are one field read at places far apart, where it has
/// nothing in common: their sum repeats, at 1/n of its variance, at the distances
/// between these.
///
/// A field repeats after N texels along its own axes, and the sensor's lie at an angle
/// to them ([`FrameFields::map`]): along its rows and columns it does not repeat.
pub struct FrameFields {
    spec: PatternSpec,
    plane: PhasorPlane,
    /// 1/response of linear interpolation, by offset from the carrier.
    sharpening: Vec<f64>,
    lost: Vec2,
    layers: Vec<Layer>,
}

/// Direction of the sensor's columns on the field: its slope is the golden ratio's
/// inverse, which no ratio of small whole numbers comes near. A line a tenth of the
/// period thick meets its own grains again after five periods.
const TURN: DVec2 = DVec2::new(0.850_650_808_352_039_9, 0.525_731_112_119_133_6);

impl FrameFields {
    /// # Errors
    /// As [`PatternSpec::validate`] and for a `coherence` out of range.
    pub fn new(spec: &PatternSpec, coherence: Coherence) -> Result<FrameFields> {
        spec.validate_shape()?;
        coherence.validate()?;
        let plane = PhasorPlane::turned(spec, TURN);
        let reach = plane.reach();
        let [column, row] = plane.sharpened_correlations();
        Ok(FrameFields {
            spec: *spec,
            sharpening: (-reach..=reach).map(|k| plane.sharpening(k)).collect(),
            plane,
            lost: Vec2::new((2.0 * (1.0 - column)) as f32, (2.0 * (1.0 - row)) as f32),
            layers: coherence.layers(spec),
        })
    }

    /// How fields lie over a sensor; as [`GrainMap::new`].
    pub fn map(&self, grain: f64, image_distance: f64) -> GrainMap {
        GrainMap::new(self.spec.texels_per_speckle, grain, image_distance).turned(TURN)
    }

    /// Bytes of a field.
    pub fn field_memory(&self) -> usize {
        (self.spec.size + MARGIN).pow(2) * size_of::<Complex32>()
    }

    /// The field at `place`.
    pub fn field(&self, place: &PupilPlace) -> FrameField {
        let shift = TURN.rotate(place.shift);
        let chirp = |axis, p| 4.0 * place.defocus * p * (p + shift[axis]);
        self.part(place.shift, |_| true, chirp).0
    }

    /// The field of those phasors that `keep` (place on the plane, texels) takes, of a
    /// pupil at `shift`, and the phasor that its zero frequency is. `chirp` is the phase
    /// of a phasor, the sum of one along each axis of the plane for so many diameters from
    /// the pupil's centre.
    pub(super) fn part(
        &self,
        shift: DVec2,
        keep: impl Fn(DVec2) -> bool,
        chirp: impl Fn(usize, f64) -> f64,
    ) -> (FrameField, DVec2) {
        let width = self.spec.pupil_width();
        let centre = TURN.rotate(shift) * width;
        let origin = carrier(centre);
        let [x, y] = [0, 1].map(|axis| {
            let from_centre = origin[axis] as f64 - centre[axis];
            let factor = |(k, sharpening): (usize, &f64)| {
                let offset = k as f64 - self.plane.reach() as f64;
                let phase = chirp(axis, (offset + from_centre) / width);
                Complex32::new(
                    (sharpening * phase.cos()) as f32,
                    (sharpening * phase.sin()) as f32,
                )
            };
            let factors = self.sharpening.iter().enumerate().map(factor);
            factors.collect::<Vec<_>>()
        });
        let keep = |x: i64, y: i64| keep(DVec2::new(x as f64, y as f64));
        let columns = self.plane.columns(centre, [&x, &y], keep);
        (
            self.transform(&columns),
            DVec2::from(origin.map(|x| x as f64)),
        )
    }

    /// A place or way on the plane of phasors (diameters, along the sensor's columns and
    /// rows) in texels of the plane.
    pub(super) fn on_plane(&self, place: DVec2) -> DVec2 {
        TURN.rotate(place) * self.spec.pupil_width()
    }

    pub(super) fn spec(&self) -> &PatternSpec {
        &self.spec
    }

    fn transform(&self, columns: &Columns) -> FrameField {
        let size = self.spec.size;
        let stride = size + MARGIN;
        let mut texels = vec![Complex32::ZERO; stride * stride];
        let (period, last) = texels.split_at_mut(size * stride);
        let blocks = period.par_chunks_exact_mut(ROWS * stride).enumerate();
        blocks.for_each_init(
            || self.plane.scratch(),
            |scratch, (block, texels)| {
                let mut rows = rows_of(texels, stride);
                let period = rows.each_mut().map(|row| &mut row[..size]);
                self.plane.rows(columns, block, period, scratch);
                rows.into_iter()
                    .for_each(|row| row.copy_within(..MARGIN, size));
            },
        );
        last.copy_from_slice(&period[..MARGIN * stride]);
        FrameField {
            period: Period::new(size),
            stride,
            texels,
            lost: self.lost,
            first_weight: self.layers[0].weight,
            further_layers: (self.layers[1..].iter())
                .map(|layer| (layer.weight, DVec2::new(layer.offset.s, layer.offset.t)))
                .collect(),
        }
    }
}

/// Texels of a field that repeat its first ones, so that four places at a time and the
/// taps to their right and below need not be wrapped: what [`Period::near`] takes, one for
/// the tap, and one because rounding may give the period itself.
const MARGIN: usize = 2 * REACH + 2;

/// A field in memory, read by linear interpolation.
pub struct FrameField {
    period: Period,
    /// Texels per row, and rows: [`MARGIN`] more than the period.
    stride: usize,
    texels: Vec<Complex32>,
    /// 2(1−μ), μ the correlation of fields one column and one row apart: a blend
    /// (1−f)A + fB keeps 1 − f(1−f)·2(1−μ) of the variance.
    lost: Vec2,
    pub(super) first_weight: f32,
    /// Weight, and where in (s, t) each further independent pattern is read.
    pub(super) further_layers: Vec<(f32, DVec2)>,
}

impl FrameField {
    /// Texels that places read together may be off their middle.
    pub const REACH: f64 = REACH as f64;

    /// Speckle intensity at (s, t) in texels, mean 1.
    #[inline(always)]
    pub fn intensity(&self, at: DVec2) -> f32 {
        let layer = |at| {
            let (amplitude, gain) = self.amplitude(at);
            amplitude.length_squared() * gain
        };
        let mut sum = self.first_weight * layer(at);
        for &(weight, offset) in &self.further_layers {
            sum += weight * layer(at + offset);
        }
        sum
    }

    /// Weights of the independent patterns, whose sum is 1.
    pub fn weights(&self) -> impl Iterator<Item = f32> + '_ {
        let further = self.further_layers.iter().map(|&(weight, _)| weight);
        std::iter::once(self.first_weight).chain(further)
    }

    /// Amplitude of one of these patterns at (s, t) in texels, of mean square 1.
    pub fn amplitude_of(&self, pattern: usize, at: DVec2) -> Complex32 {
        let offset = pattern
            .checked_sub(1)
            .map_or(DVec2::ZERO, |i| self.further_layers[i].1);
        let (amplitude, gain) = self.amplitude(at + offset);
        let Vec2 { x: re, y: im } = amplitude * gain.sqrt();
        Complex32::new(re, im)
    }

    /// Speckle intensity at the first `count` of four places, `s` and `t` texels (at most
    /// [`FrameField::REACH`]) from `at`; differs by rounding. Zero at the others.
    #[inline(always)]
    pub fn around(&self, at: DVec2, s: f32x4, t: f32x4, count: usize) -> f32x4 {
        let mut sum = self.first_weight * self.powers(at, s, t, count);
        for &(weight, offset) in &self.further_layers {
            sum += weight * self.powers(at + offset, s, t, count);
        }
        sum
    }

    #[inline(always)]
    fn powers(&self, at: DVec2, s: f32x4, t: f32x4, count: usize) -> f32x4 {
        let ([re, im], kept) = self.amplitudes(at, s, t, count);
        (re * re + im * im) / kept
    }

    /// Amplitudes, as [`FrameField::around`], and the share of the variance that blending kept.
    #[inline(always)]
    pub(super) fn amplitudes(
        &self,
        at: DVec2,
        s: f32x4,
        t: f32x4,
        count: usize,
    ) -> ([f32x4; 2], f32x4) {
        let (columns, fs) = self.period.near(at.x, s);
        let (rows, ft) = self.period.near(at.y, t);
        let firsts: i32x4 = rows * i32x4::splat(self.stride as i32) + columns;
        let (firsts, down) = (firsts.to_array(), ft.to_array());
        let sides = |i: usize| {
            if i >= count {
                return f32x4::ZERO;
            }
            let (top, bottom) = self.pairs(firsts[i] as usize);
            f32x4::from((top + down[i] * (bottom - top)).to_array())
        };
        let sides = [sides(0), sides(1), sides(2), sides(3)];
        let [re, im, right_re, right_im] = f32x4::transpose(sides);
        let blend = |left: f32x4, right: f32x4| left + fs * (right - left);
        let kept = |f: f32x4, lost: f32| 1.0 - f * (1.0 - f) * lost;
        (
            [blend(re, right_re), blend(im, right_im)],
            kept(fs, self.lost.x) * kept(ft, self.lost.y),
        )
    }

    /// A texel with its neighbour to the right, and those below.
    #[inline(always)]
    fn pairs(&self, first: usize) -> (Vec4, Vec4) {
        let texels = &self.texels[first..][..self.stride + 2];
        let pair = |at: usize| {
            let pair = &texels[at..at + 2];
            Vec4::new(pair[0].re, pair[0].im, pair[1].re, pair[1].im)
        };
        (pair(0), pair(self.stride))
    }

    /// The blend of four texels, and what to multiply its power by for the variance
    /// that blending lost.
    #[inline(always)]
    pub(super) fn amplitude(&self, at: DVec2) -> (Vec2, f32) {
        let (column, fs) = self.period.place(at.x);
        let (row, ft) = self.period.place(at.y);
        let gain =
            1.0 / ((1.0 - fs * (1.0 - fs) * self.lost.x) * (1.0 - ft * (1.0 - ft) * self.lost.y));
        let (top, bottom) = self.pairs(row * self.stride + column);
        let sides = top + ft * (bottom - top);
        (sides.xy() + fs * (sides.zw() - sides.xy()), gain)
    }
}

#[cfg(test)]
mod tests;
