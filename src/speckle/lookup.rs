//! Reads the speckle intensity at (s, t, u), which is periodic in all three coordinates.

pub use super::coordinate::Coordinate;
use super::fixed_point::FixedPoint;
use super::method::PatternLayer;
pub use super::method::{Coherence, Method};
use super::pattern::PatternSpec;
use super::slices::Slices;
use super::texture::SliceStorage;
use crate::error::Result;
use glam::{Vec4, Vec4Swizzles};

/// Interpolated speckle patterns, in memory.
pub struct SpeckleTexture {
    method: Method,
    /// Weight of the first layer, which is read without an offset.
    first_weight: f32,
    further_layers: Vec<PatternLayer>,
    slices_per_diameter: f64,
    size_mask: usize,
    slices_mask: usize,
    texture: SliceStorage,
}

impl SpeckleTexture {
    /// Computes the slices of `spec` and stores them for `method`.
    pub fn new(spec: &PatternSpec, method: Method, coherence: Coherence) -> Result<SpeckleTexture> {
        spec.validate()?;
        coherence.validate()?;
        let slices = Slices::new(spec);
        let mut layers = coherence.layers(spec);
        Ok(SpeckleTexture {
            method,
            first_weight: layers.remove(0).weight,
            further_layers: layers,
            size_mask: spec.size - 1,
            slices_mask: spec.slices - 1,
            slices_per_diameter: slices.per_diameter(),
            texture: SliceStorage::new(spec, &slices, method),
        })
    }

    /// Returns the number of slices per pupil diameter of speckle shift across the pupil: u =
    /// `slices_per_diameter` · δ; see [`super::slices`].
    pub fn slices_per_diameter(&self) -> f64 {
        self.slices_per_diameter
    }

    /// Returns the memory of the patterns, bytes.
    pub fn memory(&self) -> usize {
        size_of_val(&self.texture.texels[..])
    }

    /// Returns the speckle intensity, mean 1.
    #[inline(always)]
    pub fn intensity(&self, at: Coordinate) -> f32 {
        let mut sum = self.first_weight * self.layer(at);
        for PatternLayer { weight, offset } in &self.further_layers {
            sum += weight
                * self.layer(Coordinate {
                    s: at.s + offset.s,
                    t: at.t + offset.t,
                    u: at.u + offset.u,
                });
        }
        sum
    }

    #[inline(always)]
    fn layer(&self, at: Coordinate) -> f32 {
        match self.method {
            Method::Trilinear => self.trilinear(at),
            Method::Field => self.field(at),
        }
    }

    #[inline(always)]
    fn trilinear(&self, at: Coordinate) -> f32 {
        let cell = self.cell(at, 1);
        let read = |corner| {
            let [top, bottom] = self.texture.rows::<2>(corner);
            let left = top[0] + cell.ft * (bottom[0] - top[0]);
            let right = top[1] + cell.ft * (bottom[1] - top[1]);
            left + cell.fs * (right - left)
        };
        let (a, b) = (read(cell.here), read(cell.next));
        a + cell.w * (b - a)
    }

    #[inline(always)]
    fn field(&self, at: Coordinate) -> f32 {
        let cell = self.cell(at, 2);
        let w = cell.w;
        let link = &self.texture.links[cell.slice];
        let turn = w * self.texture.phases.at(link, cell.s, cell.t);

        // Fraction of the variance that the three interpolations keep. The division is done here,
        // while the taps are being loaded, and not at the end.
        let f = Vec4::new(cell.fs, cell.ft, w, 0.0);
        let kept = Vec4::ONE - f * (Vec4::ONE - f) * link.lost;
        let gain = 1.0 / (kept.x * kept.y * kept.z);

        let [this, next] = self.columns(cell);
        let blended = fold((1.0 - w) * this + next * turn.xxxx() + next.yxwz() * turn.zwzw());
        let power = blended * blended;
        (power.x + power.y) * gain
    }

    /// Returns two channels of the slice and of the next slice. The four taps are weighted and
    /// added by column: left in x and y, right in z and w.
    #[inline(always)]
    fn columns(&self, cell: TexelCell) -> [Vec4; 2] {
        const LEFT: Vec4 = Vec4::new(1.0, 1.0, 0.0, 0.0);
        const SIGN: Vec4 = Vec4::new(-1.0, -1.0, 1.0, 1.0);
        let columns = LEFT + cell.fs * SIGN;
        let lower = cell.ft * columns;
        let upper = columns - lower;
        [cell.here, cell.next].map(|corner| {
            let [top, bottom] = self.texture.rows::<4>(corner);
            upper * Vec4::from_array(*top) + lower * Vec4::from_array(*bottom)
        })
    }

    #[inline(always)]
    fn cell(&self, at: Coordinate, channels: usize) -> TexelCell {
        let [s, t, u] = [at.s, at.t, at.u].map(FixedPoint::new);
        let slice = u.index(self.slices_mask);
        let next = (slice + 1) & self.slices_mask;
        let row = t.index(self.size_mask) * self.texture.row_stride;
        let texel = row + channels * s.index(self.size_mask);
        TexelCell {
            slice,
            here: slice * self.texture.slice_stride + texel,
            next: next * self.texture.slice_stride + texel,
            fs: s.fraction(),
            ft: t.fraction(),
            w: u.fraction(),
            s,
            t,
        }
    }
}

/// Position of a coordinate among the texels.
#[derive(Clone, Copy)]
struct TexelCell {
    slice: usize,
    /// Index of the first tap in this slice and in the next.
    here: usize,
    next: usize,
    /// Fractions towards the next column, row and slice.
    fs: f32,
    ft: f32,
    w: f32,
    s: FixedPoint,
    t: FixedPoint,
}

/// Returns the sum of the left and right column, in x and y.
#[inline(always)]
fn fold(columns: Vec4) -> Vec4 {
    columns + columns.zwzw()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Aperture;

    const SPEC: PatternSpec = PatternSpec {
        size: 256,
        texels_per_speckle: 4.0,
        aperture: Aperture::Circle,
        slices: 16,
        seed: 5,
    };

    /// At integer coordinates, every method returns the pattern itself. The values repeat after
    /// full periods, also below zero.
    #[test]
    fn whole_coordinates_read_the_pattern_and_wrap() {
        let slices = Slices::new(&SPEC);
        for method in [Method::Trilinear, Method::Field] {
            let lookup = SpeckleTexture::new(&SPEC, method, Coherence::FULL).unwrap();
            for (k, s, t) in [(0, 0, 0), (3, 17, 200), (15, 255, 255)] {
                let pattern = match method {
                    Method::Field => slices.sharpened(k),
                    _ => slices.pattern(k),
                };
                let stored = pattern.field[t * SPEC.size + s].norm_sqr();
                let at = |n: f64| Coordinate {
                    s: s as f64 + n * 256.0,
                    t: t as f64 - n * 256.0,
                    u: k as f64 + n * 16.0,
                };
                for n in [0.0, 1.0, -3.0] {
                    let read = lookup.intensity(at(n));
                    assert!(
                        (read - stored).abs() < 1e-5 * (1.0 + stored),
                        "{method:?} {k} {s} {t} {n}"
                    );
                }
            }
        }
    }

    /// The intensity is continuous across every cell border, including the wraps. Over 2e-6 of a
    /// texel it changes much less than between grains.
    #[test]
    fn intensity_is_continuous_across_texels_slices_and_wraps() {
        for method in [Method::Trilinear, Method::Field] {
            let lookup = SpeckleTexture::new(&SPEC, method, Coherence::FULL).unwrap();
            for i in 0..256 {
                let base = [i as f64, 3.3 + i as f64 * 0.37, 0.25 + i as f64 * 0.0613];
                for axis in 0..3 {
                    let mut below = base;
                    below.rotate_right(axis);
                    let mut above = below;
                    below[axis] -= 1e-6;
                    above[axis] += 1e-6;
                    let [a, b] =
                        [below, above].map(|[s, t, u]| lookup.intensity(Coordinate { s, t, u }));
                    assert!(
                        (a - b).abs() < 5e-5 * (1.0 + a),
                        "{method:?} axis {axis} at {base:?}: {a} {b}"
                    );
                }
            }
        }
    }
}
