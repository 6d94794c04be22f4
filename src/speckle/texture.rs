//! Memory layout of the patterns for the lookup.

use super::fixed_point::{FRACTION_BITS, FixedPoint};
use super::method::Method;
use super::pattern::PatternSpec;
use super::slices::Slices;
use glam::{DVec4, Vec4};
use rayon::prelude::*;
use rustfft::num_complex::Complex32;

/// Texels of all slices, by slice and row. Each slice has one row and one column more than the
/// period, so that the second tap never wraps.
pub struct SliceStorage {
    /// Floats per row and per slice.
    pub row_stride: usize,
    pub slice_stride: usize,
    pub texels: Vec<f32>,
    /// Links from each slice to the next.
    pub links: Vec<SliceTransition>,
    pub phases: Phases,
}

/// Relation of a slice to the next slice.
#[derive(Clone, Copy)]
pub struct SliceTransition {
    /// Phase of the next slice relative to this slice, with each slice stored about its carrier:
    /// integer turns per period along s and t.
    turns: [i64; 2],
    /// 2(1−μ), where μ is the correlation of the fields at a lag of one column, one row and one
    /// slice. A blend (1−f)A + fB keeps 1 − f(1−f)·2(1−μ) of the variance. Columns and rows are
    /// treated as independent. This is exact for a square pupil and accurate to 4e-4 for a circle
    /// at N/d = 4.
    pub lost: Vec4,
}

/// Rotations by `COUNT` angles around the circle, and their derivatives.
pub struct Phases {
    table: Box<[[Vec4; 2]; Phases::COUNT]>,
    /// log₂ of the fixed-point steps between two angles.
    shift: u32,
}

impl SliceStorage {
    /// Creates the texture; `spec` and `method` must be valid.
    pub fn new(spec: &PatternSpec, slices: &Slices, method: Method) -> SliceStorage {
        let row_stride = method.channels() * (spec.size + 1);
        let slice_stride = row_stride * (spec.size + 1);
        let mut texels = vec![0.0; slice_stride * spec.slices];
        let slice = |(k, out): (usize, &mut [f32])| match method {
            Method::Trilinear => store(out, &slices.pattern(k).field, |a| [a.norm_sqr()]),
            Method::Field => store(out, &slices.sharpened(k).field, |a| [a.re, a.im]),
        };
        texels
            .par_chunks_exact_mut(slice_stride)
            .enumerate()
            .for_each(slice);
        SliceStorage {
            row_stride,
            slice_stride,
            texels,
            links: links(spec, slices),
            phases: Phases::new(spec.size),
        }
    }

    /// Returns the `L` floats from `corner` on, and the `L` floats one row below.
    #[inline(always)]
    pub fn rows<const L: usize>(&self, corner: usize) -> [&[f32; L]; 2] {
        let span = &self.texels[corner..corner + self.row_stride + L];
        let rows = (span.first_chunk(), span.last_chunk());
        let (Some(top), Some(bottom)) = rows else {
            unreachable!("a span holds two rows' taps")
        };
        [top, bottom]
    }
}

impl Phases {
    const COUNT: usize = 512;

    fn new(size: usize) -> Phases {
        let shift = FRACTION_BITS + size.ilog2() - Phases::COUNT.ilog2();
        let angle = std::f64::consts::TAU / Phases::COUNT as f64;
        let table = std::array::from_fn(|k| {
            let (sin, cos) = (angle * k as f64).sin_cos();
            let slope = angle / (1u64 << shift) as f64;
            [
                DVec4::new(cos, cos, -sin, sin).as_vec4(),
                (slope * DVec4::new(-sin, -sin, -cos, cos)).as_vec4(),
            ]
        });
        Phases {
            table: Box::new(table),
            shift,
        }
    }

    /// Returns the rotation (cos, cos, −sin, sin) of the next slice at (s, t), to 2e-5. It is the
    /// nearest tabulated rotation plus a first-order correction.
    #[inline(always)]
    pub fn at(&self, link: &SliceTransition, s: FixedPoint, t: FixedPoint) -> Vec4 {
        let half = 1 << (self.shift - 1);
        let turn = s
            .times(link.turns[0])
            .wrapping_add(t.times(link.turns[1]))
            .wrapping_add(half);
        let [value, slope] = self.table[(turn >> self.shift) as usize % Phases::COUNT];
        let rest = (turn & (2 * half - 1)) as i32 - half as i32;
        value + rest as f32 * slope
    }
}

fn links(spec: &PatternSpec, slices: &Slices) -> Vec<SliceTransition> {
    let lost = |mu: f64| (2.0 * (1.0 - mu)) as f32;
    let [column, row] = slices.sharpened_correlations().map(lost);
    let link = |k| SliceTransition {
        turns: slices.carrier_step(k),
        lost: Vec4::new(column, row, lost(slices.correlation_with_next(k)), 0.0),
    };
    (0..spec.slices).map(link).collect()
}

/// Copies texels into the padded layout.
fn store<const C: usize>(
    out: &mut [f32],
    texels: &[Complex32],
    channels: impl Fn(&Complex32) -> [f32; C],
) {
    let size = (texels.len() as f64).sqrt() as usize;
    let row_stride = C * (size + 1);
    let mut texels = texels.iter().map(channels);
    for row in out.chunks_exact_mut(row_stride).take(size) {
        for (value, texel) in row.chunks_exact_mut(C).take(size).zip(&mut texels) {
            value.copy_from_slice(&texel);
        }
        row.copy_within(..C, size * C);
    }
    out.copy_within(..row_stride, size * row_stride);
}
