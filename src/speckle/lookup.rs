//! Reading speckle: the intensity at (s, t, u), wrapping in all three.

pub use super::coordinate::Coordinate;
use super::fixed::Fixed;
use super::method::Layer;
pub use super::method::{Coherence, Method};
use super::pattern::PatternSpec;
use super::slices::Slices;
use super::texture::Texture;
use crate::error::Result;
use glam::{Vec4, Vec4Swizzles};

/// Interpolated speckle patterns, in memory.
pub struct Lookup {
    method: Method,
    /// The first layer lies where it is asked for.
    first_weight: f32,
    further_layers: Vec<Layer>,
    slices_per_diameter: f64,
    size_mask: usize,
    slices_mask: usize,
    texture: Texture,
}

impl Lookup {
    /// Makes the slices of `spec` and stores them for `method`.
    pub fn new(spec: &PatternSpec, method: Method, coherence: Coherence) -> Result<Lookup> {
        spec.validate()?;
        coherence.validate()?;
        let slices = Slices::new(spec);
        let mut layers = coherence.layers(spec);
        Ok(Lookup {
            method,
            first_weight: layers.remove(0).weight,
            further_layers: layers,
            size_mask: spec.size - 1,
            slices_mask: spec.slices - 1,
            slices_per_diameter: slices.per_diameter(),
            texture: Texture::new(spec, &slices, method),
        })
    }

    /// Slices per pupil diameter the speckle field travels across the pupil,
    /// u = `slices_per_diameter` · δ; see [`super::slices`].
    pub fn slices_per_diameter(&self) -> f64 {
        self.slices_per_diameter
    }

    /// Bytes the patterns take.
    pub fn memory(&self) -> usize {
        size_of_val(&self.texture.texels[..])
    }

    /// Speckle intensity, mean 1.
    #[inline(always)]
    pub fn intensity(&self, at: Coordinate) -> f32 {
        let mut sum = self.first_weight * self.layer(at);
        for Layer { weight, offset } in &self.further_layers {
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

        // What the three blends left of the variance. Divided here, while the
        // taps are still on their way, not at the end.
        let f = Vec4::new(cell.fs, cell.ft, w, 0.0);
        let kept = Vec4::ONE - f * (Vec4::ONE - f) * link.lost;
        let gain = 1.0 / (kept.x * kept.y * kept.z);

        let [this, next] = self.columns(cell);
        let blended = fold((1.0 - w) * this + next * turn.xxxx() + next.yxwz() * turn.zwzw());
        let power = blended * blended;
        (power.x + power.y) * gain
    }

    /// Two channels of the slice and of the next, their four taps weighted but
    /// only added by column: left in x and y, right in z and w.
    #[inline(always)]
    fn columns(&self, cell: Cell) -> [Vec4; 2] {
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
    fn cell(&self, at: Coordinate, channels: usize) -> Cell {
        let [s, t, u] = [at.s, at.t, at.u].map(Fixed::new);
        let slice = u.index(self.slices_mask);
        let next = (slice + 1) & self.slices_mask;
        let row = t.index(self.size_mask) * self.texture.row_stride;
        let texel = row + channels * s.index(self.size_mask);
        Cell {
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

/// Where a coordinate lies among the texels.
#[derive(Clone, Copy)]
struct Cell {
    slice: usize,
    /// First tap in this slice and in the next.
    here: usize,
    next: usize,
    /// Fractions towards the next column, row and slice.
    fs: f32,
    ft: f32,
    w: f32,
    s: Fixed,
    t: Fixed,
}

/// Sum of left and right column, in x and y.
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

    /// At texels and slices every method gives the pattern itself; a period
    /// further, before zero too, the same.
    #[test]
    fn whole_coordinates_read_the_pattern_and_wrap() {
        let slices = Slices::new(&SPEC);
        for method in [Method::Trilinear, Method::Field] {
            let lookup = Lookup::new(&SPEC, method, Coherence::FULL).unwrap();
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

    /// Across every cell border, the wraps included, the intensity is
    /// continuous: 2e-6 of a texel apart it changes by far less than grains do.
    #[test]
    fn intensity_is_continuous_across_texels_slices_and_wraps() {
        for method in [Method::Trilinear, Method::Field] {
            let lookup = Lookup::new(&SPEC, method, Coherence::FULL).unwrap();
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
