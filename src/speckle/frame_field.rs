//! The speckle field of one frame: the pupil is put where the frame's own pose has
//! it, on the endless plane of phasors, and transformed.
//!
//! A frame is one pose, so it needs one slice, at whatever place the pupil has
//! then. Reading a ring of slices made beforehand ([`super::lookup`]) costs twice
//! the taps, and between two slices its correlation is off by a share of theirs.
//! Made for its own place, a frame correlates with every other by the overlap law
//! of the two places, along both axes of the pupil and over any way; and what a
//! phase across the pupil does, defocus foremost, is done to the phasors.

use super::fixed::Fixed;
use super::lookup::{Coherence, Layer};
use super::pattern::{Columns, PatternSpec, PhasorPlane, ROWS, carrier, rows_of};
use crate::error::Result;
use crate::math::DVec2;
use glam::{Vec2, Vec4, Vec4Swizzles};
use rustfft::num_complex::Complex32;
use std::f64::consts::PI;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

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

/// Makes the fields of frames; `spec.slices` is not used. The independent patterns
/// of partly coherent light are one field read at places far apart, where it has
/// nothing in common: their sum repeats, at 1/n of its variance, at the distances
/// between these.
///
/// One of 1024² takes 4 ms on one core and 8 MB, and 1 ms and 2 MB of it before any row
/// is read.
pub struct FrameFields {
    spec: PatternSpec,
    plane: PhasorPlane,
    /// 1/response of linear interpolation, by offset from the carrier.
    sharpening: Vec<f64>,
    lost: Vec2,
    layers: Vec<Layer>,
    spare_lines: Spare,
    spare_groups: Spare,
}

/// Memory of fields that are gone: new memory is slow, since the system clears it
/// page by page.
#[derive(Default)]
struct Spare(Mutex<Vec<Vec<Complex32>>>);

impl Spare {
    fn all(&self) -> MutexGuard<'_, Vec<Vec<Complex32>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Empty, if new, and else with whatever it held.
    fn take(&self) -> Vec<Complex32> {
        self.all().pop().unwrap_or_default()
    }
}

impl FrameFields {
    /// # Errors
    /// As [`PatternSpec::validate`] and for a `coherence` out of range.
    pub fn new(spec: &PatternSpec, coherence: Coherence) -> Result<FrameFields> {
        spec.validate()?;
        coherence.validate()?;
        let plane = PhasorPlane::new(spec);
        let reach = plane.reach();
        let [column, row] = plane.sharpened_correlations();
        Ok(FrameFields {
            spec: *spec,
            sharpening: (-reach..=reach).map(|k| plane.sharpening(k)).collect(),
            plane,
            lost: Vec2::new((2.0 * (1.0 - column)) as f32, (2.0 * (1.0 - row)) as f32),
            layers: coherence.layers(spec),
            spare_lines: Spare::default(),
            spare_groups: Spare::default(),
        })
    }

    pub fn spec(&self) -> &PatternSpec {
        &self.spec
    }

    /// The field at `place`.
    pub fn field(&self, place: &PupilPlace) -> FrameField<'_> {
        self.part(place, |_| true)
    }

    /// The field at `place`, to be read where it slips along the pupil's way, whose
    /// direction over the field is `along` (unit vector).
    pub fn slipping(&self, place: &PupilPlace, along: DVec2) -> SlippingField<'_> {
        let width = self.spec.aperture.extent();
        let way = place.shift.dot(along);
        let first = (way / width - 0.5).floor();
        let strips = [first, first + 1.0].map(|strip| {
            let low = strip * width;
            let inside = |q: DVec2| (low..low + width).contains(&q.dot(along));
            (self.part(place, inside), low + width / 2.0 - way)
        });
        let [near, far] = [&strips[0], &strips[1]].map(|(_, middle)| middle * middle);
        SlippingField {
            strips,
            turn: along * (PI / self.spec.texels_per_speckle * (far - near)),
        }
    }

    /// The field of those phasors that `keep` (place on the plane, diameters) takes.
    fn part(&self, place: &PupilPlace, keep: impl Fn(DVec2) -> bool) -> FrameField<'_> {
        let width = self.spec.pupil_width();
        let centre = place.shift * width;
        let origin = carrier(centre);
        let [x, y] = [0, 1].map(|axis| {
            let from_centre = origin[axis] as f64 - centre[axis];
            let factor = |(k, sharpening): (usize, &f64)| {
                let offset = k as f64 - self.plane.reach() as f64;
                let p = (offset + from_centre) / width;
                let phase = 4.0 * place.defocus * p * (p + place.shift[axis]);
                Complex32::new(
                    (sharpening * phase.cos()) as f32,
                    (sharpening * phase.sin()) as f32,
                )
            };
            let factors = self.sharpening.iter().enumerate().map(factor);
            factors.collect::<Vec<_>>()
        });
        let keep = |x: i64, y: i64| keep(DVec2::new(x as f64, y as f64) / width);
        FrameField {
            fields: self,
            columns: (self.plane).columns(centre, [&x, &y], keep, self.spare_lines.take()),
            size_mask: self.spec.size - 1,
            groups: (0..self.spec.size / ROWS)
                .map(|_| OnceLock::new())
                .collect(),
            lost: self.lost,
            first_weight: self.layers[0].weight,
            further_layers: (self.layers[1..].iter())
                .map(|layer| (layer.weight, DVec2::new(layer.offset.s, layer.offset.t)))
                .collect(),
        }
    }
}

/// A field, read by linear interpolation. Its rows are made when they are first
/// read: a laser's line reads few.
pub struct FrameField<'a> {
    fields: &'a FrameFields,
    columns: Columns,
    size_mask: usize,
    /// By groups of [`ROWS`]; of a row one texel more than the period, so that the
    /// right tap never wraps.
    groups: Vec<OnceLock<Vec<Complex32>>>,
    /// 2(1−μ), μ the correlation of fields one column and one row apart: a blend
    /// (1−f)A + fB keeps 1 − f(1−f)·2(1−μ) of the variance.
    lost: Vec2,
    first_weight: f32,
    /// Weight, and where in (s, t) each further independent pattern is read.
    further_layers: Vec<(f32, DVec2)>,
}

impl Drop for FrameField<'_> {
    fn drop(&mut self) {
        let lines = std::mem::take(&mut self.columns.lines);
        self.fields.spare_lines.all().push(lines);
        let groups = self.groups.drain(..).filter_map(OnceLock::into_inner);
        self.fields.spare_groups.all().extend(groups);
    }
}

impl FrameField<'_> {
    /// Speckle intensity at (s, t) in texels, mean 1.
    pub fn intensity(&self, at: DVec2) -> f32 {
        self.four([at; 4])[0]
    }

    /// [`Self::intensity`] at four places, which costs little more than at one.
    #[inline(always)]
    pub fn four(&self, at: [DVec2; 4]) -> [f32; 4] {
        let layer = |offset: DVec2| {
            let (amplitudes, gains) = self.amplitudes(at.map(|at| at + offset));
            Vec4::from_array(amplitudes.map(|a| a.length_squared())) * gains
        };
        let mut sum = self.first_weight * layer(DVec2::ZERO);
        for &(weight, offset) in &self.further_layers {
            sum += weight * layer(offset);
        }
        sum.to_array()
    }

    #[cold]
    fn group(&self, group: usize) -> Vec<Complex32> {
        let size = self.size_mask + 1;
        let mut texels = self.fields.spare_groups.take();
        texels.clear();
        texels.resize(ROWS * (size + 1), Complex32::ZERO);
        let mut rows = rows_of(&mut texels, size + 1);
        let period = rows.each_mut().map(|row| &mut row[..size]);
        self.fields.plane.rows(&self.columns, group, period);
        rows.into_iter().for_each(|row| row[size] = row[0]);
        texels
    }

    /// The blends of four texels each, and what to multiply their powers by for the
    /// variance that blending lost.
    #[inline(always)]
    fn amplitudes(&self, at: [DVec2; 4]) -> ([Vec2; 4], Vec4) {
        let places = at.map(|at| (Fixed::new(at.x), Fixed::new(at.y)));
        let fs = Vec4::from_array(places.map(|(s, _)| s.fraction()));
        let ft = Vec4::from_array(places.map(|(_, t)| t.fraction()));
        let kept = |f: Vec4, lost: f32| Vec4::ONE - f * (Vec4::ONE - f) * lost;
        let gains = (kept(fs, self.lost.x) * kept(ft, self.lost.y)).recip();
        let blend = |i: usize| {
            let (s, t) = places[i];
            let row = t.index(self.size_mask);
            let below = (row + 1) & self.size_mask;
            let column = s.index(self.size_mask);
            let taps = |row: usize| {
                let group = self.groups[row / ROWS].get_or_init(|| self.group(row / ROWS));
                let pair = &group[row % ROWS * (self.size_mask + 2) + column..][..2];
                Vec4::new(pair[0].re, pair[0].im, pair[1].re, pair[1].im)
            };
            let (top, bottom) = (taps(row), taps(below));
            let sides = top + ft[i] * (bottom - top);
            sides.xy() + fs[i] * (sides.zw() - sides.xy())
        };
        ([0, 1, 2, 3].map(blend), gains)
    }
}

/// A field in two parts that are displaced each by its own slip.
///
/// The plane of phasors is cut into strips across the pupil's way, as wide as the
/// pupil, so that it stands on two at most. Strip k is displaced by −S·m_k, m_k the
/// way from the pupil's middle to the strip's (diameters): by nothing when it fills
/// the pupil, and from frame to frame by S times the pupil's step. Two strips then
/// slip alike; for their sum to do so, the phase between them must follow: a frame's
/// band is centred on its own pupil, c, so its strips turn by 2π·c·(their distance
/// apart) from frame to frame, and η_k = π·(d/N)·(along·S)·m_k² takes that back.
/// (It is the difference of chirps |q−c|² and |q−u_k|² over a strip around u_k.)
pub struct SlippingField<'a> {
    strips: [(FrameField<'a>, f64); 2],
    /// η of the second strip less that of the first, for each texel of S.
    turn: DVec2,
}

impl SlippingField<'_> {
    /// Speckle intensity at (s, t), mean 1, for a slip S in texels a diameter.
    #[inline(always)]
    pub fn intensity(&self, at: DVec2, slip: DVec2) -> f32 {
        let [(first, near), (second, far)] = &self.strips;
        let places = [at - slip * *near, at - slip * *far];
        let turn = DVec2::from_angle(self.turn.dot(slip)).as_vec2();
        let layer = |offset: DVec2| {
            let amplitude = |field: &FrameField, at: DVec2| {
                let (amplitudes, gains) = field.amplitudes([at + offset; 4]);
                amplitudes[0] * gains.x.sqrt()
            };
            let (a, b) = (amplitude(first, places[0]), amplitude(second, places[1]));
            (a + b.rotate(turn)).length_squared()
        };
        let mut sum = first.first_weight * layer(DVec2::ZERO);
        for &(weight, offset) in &first.further_layers {
            sum += weight * layer(offset);
        }
        sum
    }
}

#[cfg(test)]
mod tests;
