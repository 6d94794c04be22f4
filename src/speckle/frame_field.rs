//! Speckle field of one frame. The pupil is positioned on the infinite phasor plane according to
//! the pose of the frame, and the phasors inside it are Fourier transformed.
//!
//! A frame has one pose and needs one slice, at the pupil position of this pose. A precomputed ring
//! of slices ([`super::lookup`]) needs twice the taps, and its correlation has an error between two
//! slices. With one field per pose, two frames correlate by the overlap law of their pupil
//! positions, along both axes of the pupil and over any displacement. A phase across the pupil,
//! mainly defocus, is applied to the phasors.

use super::coordinate::GrainMap;
use super::fixed_point::{PeriodicIndex, REACH};
use super::method::{Coherence, PatternLayer};
use super::pattern::{PatternSpec, PhasorPlane, PupilColumns, ROWS, carrier, rows_of};
use crate::error::Result;
use crate::math::Aperture;
use crate::math::DVec2;
use glam::{Vec2, Vec4, Vec4Swizzles};
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use wide::{f32x4, i32x4};

/// Position of a frame's pupil on the phasor plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PupilPosition {
    /// Shift c = −A_p/D of the pupil over the field, in pupil diameters.
    pub shift: DVec2,
    /// Defocus phase φ of the pupil's rim relative to its centre, from the displacement along the
    /// viewing ray, rad; see [`super::motion::defocus_phase`].
    ///
    /// A phasor p diameters from the pupil centre is rotated by 4φ·(|p|² + c·p). The first term
    /// would also move the pattern, because a shift of a chirped pupil is a linear phase. The
    /// second term cancels this motion. The cancellation is exact if φ is proportional to c, as on
    /// a straight path from c = 0. The motion of the pattern is described by the displacement on
    /// the sensor only.
    pub defocus: f64,
}

/// Returns the parameters of a frame's field: 144² grains, 1.2 MB.
pub fn field_spec(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        size: 384,
        texels_per_speckle: 384.0 / FIELD_SIZE_GRAINS,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

/// Grains along each side of a frame's field, which is the number of phasors across its pupil.
const FIELD_SIZE_GRAINS: f64 = 144.0;

/// Largest width of a widened pupil, in pupil diameters; see [`wide_field_spec`].
pub const MAX_PUPIL_SCALE: f64 = 2.5;

/// Returns the parameters of a field, 4.8 MB, for a pupil widened by the factor `wider` (1 to
/// [`MAX_PUPIL_SCALE`]). It represents the field on the surface under light that varies within a
/// grain. Its phasors are the phasors of the pupil and further ones around it.
pub fn wide_field_spec(seed: u64, aperture: Aperture, wider: f64) -> PatternSpec {
    PatternSpec {
        size: 768,
        texels_per_speckle: 768.0 / (FIELD_SIZE_GRAINS * wider),
        ..field_spec(seed, aperture)
    }
}

/// Generator of the fields of frames; `spec.slices` is not used.
///
/// The independent patterns of partly coherent light are read from one field at distant positions,
/// where it is uncorrelated. Their sum has repeated structure, with 1/n of its variance, at the
/// distances between these positions.
///
/// A field repeats after N texels along its axes. The axes of the sensor are rotated relative to
/// them ([`FrameFields::map`]), so the field does not repeat along sensor rows and columns.
pub struct FrameFields {
    spec: PatternSpec,
    plane: PhasorPlane,
    /// Inverse response of linear interpolation, by offset from the carrier.
    sharpening: Vec<f64>,
    lost: Vec2,
    layers: Vec<PatternLayer>,
}

/// Direction of the sensor's columns on the field. Its slope is the inverse golden ratio, which
/// ratios of small integers approximate poorly. A line with a thickness of a tenth of the period
/// reaches its first grains again after five periods.
const FIELD_AXIS: DVec2 = DVec2::new(0.850_650_808_352_039_9, 0.525_731_112_119_133_6);

impl FrameFields {
    /// Creates a generator.
    ///
    /// # Errors
    /// Returns the errors of [`PatternSpec::validate`], and an error if `coherence` is out of
    /// range.
    pub fn new(spec: &PatternSpec, coherence: Coherence) -> Result<FrameFields> {
        spec.validate_shape()?;
        coherence.validate()?;
        let plane = PhasorPlane::turned(spec, FIELD_AXIS);
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

    /// Returns the mapping from the sensor to the field; arguments as in [`GrainMap::new`].
    pub fn map(&self, grain: f64, image_distance: f64) -> GrainMap {
        GrainMap::new(self.spec.texels_per_speckle, grain, image_distance).turned(FIELD_AXIS)
    }

    /// Returns the memory of one field, bytes.
    pub fn field_memory(&self) -> usize {
        (self.spec.size + MARGIN).pow(2) * size_of::<Complex32>()
    }

    /// Computes the field at `place`.
    pub fn field(&self, place: &PupilPosition) -> FrameField {
        let shift = FIELD_AXIS.rotate(place.shift);
        let chirp = |axis, p| 4.0 * place.defocus * p * (p + shift[axis]);
        self.part(place.shift, |_| true, chirp).0
    }

    /// Computes the field of the phasors accepted by `keep` (position on the plane, texels), for a
    /// pupil at `shift`. Also returns the position of the phasor at zero frequency, texels.
    /// `chirp(axis, p)` returns the phase for `p` diameters from the pupil centre along one axis of
    /// the plane. The phase of a phasor is the sum over both axes.
    pub(super) fn part(
        &self,
        shift: DVec2,
        keep: impl Fn(DVec2) -> bool,
        chirp: impl Fn(usize, f64) -> f64,
    ) -> (FrameField, DVec2) {
        let width = self.spec.pupil_width();
        let centre = FIELD_AXIS.rotate(shift) * width;
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

    /// Converts a position or displacement on the phasor plane (diameters, along the sensor's
    /// columns and rows) to texels of the plane.
    pub(super) fn on_plane(&self, place: DVec2) -> DVec2 {
        FIELD_AXIS.rotate(place) * self.spec.pupil_width()
    }

    pub(super) fn spec(&self) -> &PatternSpec {
        &self.spec
    }

    fn transform(&self, columns: &PupilColumns) -> FrameField {
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
            period: PeriodicIndex::new(size),
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

/// Number of first texels that a field repeats at its end, so that four samples and the taps to
/// their right and below do not wrap. [`PeriodicIndex::near`] requires 2·`REACH`, the tap requires
/// one, and rounding up to the period itself requires one.
const MARGIN: usize = 2 * REACH + 2;

/// Field in memory, read by linear interpolation.
pub struct FrameField {
    period: PeriodicIndex,
    /// Texels per row, and number of rows: the period plus [`MARGIN`].
    stride: usize,
    texels: Vec<Complex32>,
    /// 2(1−μ), where μ is the correlation of fields at a lag of one column and of one row. A blend
    /// (1−f)A + fB keeps 1 − f(1−f)·2(1−μ) of the variance.
    lost: Vec2,
    pub(super) first_weight: f32,
    /// Weight and (s, t) offset of each further independent pattern.
    pub(super) further_layers: Vec<(f32, DVec2)>,
}

impl FrameField {
    /// Largest distance, in texels, between samples that are read together and their common centre.
    pub const REACH: f64 = REACH as f64;

    /// Returns the speckle intensity at (s, t) in texels, mean 1.
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

    /// Returns the weights of the independent patterns; their sum is 1.
    pub fn weights(&self) -> impl Iterator<Item = f32> + '_ {
        let further = self.further_layers.iter().map(|&(weight, _)| weight);
        std::iter::once(self.first_weight).chain(further)
    }

    /// Returns the amplitude of one independent pattern at (s, t) in texels, mean square 1.
    pub fn amplitude_of(&self, pattern: usize, at: DVec2) -> Complex32 {
        let offset = pattern
            .checked_sub(1)
            .map_or(DVec2::ZERO, |i| self.further_layers[i].1);
        let (amplitude, gain) = self.amplitude(at + offset);
        let Vec2 { x: re, y: im } = amplitude * gain.sqrt();
        Complex32::new(re, im)
    }

    /// Returns the speckle intensity at the first `count` of four positions, and zero at the
    /// others. The positions are `s` and `t` texels (at most [`FrameField::REACH`]) from `at`.
    /// Results differ from [`FrameField::intensity`] by rounding.
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

    /// Returns the amplitudes at the positions of [`FrameField::around`], and the fraction of the
    /// variance that interpolation keeps.
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

    /// Returns a texel with its right neighbour, and the two texels below.
    #[inline(always)]
    fn pairs(&self, first: usize) -> (Vec4, Vec4) {
        let texels = &self.texels[first..][..self.stride + 2];
        let pair = |at: usize| {
            let pair = &texels[at..at + 2];
            Vec4::new(pair[0].re, pair[0].im, pair[1].re, pair[1].im)
        };
        (pair(0), pair(self.stride))
    }

    /// Interpolates four texels. Also returns the factor that restores the power lost by
    /// interpolation.
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
