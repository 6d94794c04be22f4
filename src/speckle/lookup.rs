//! Reading speckle: the intensity at (s, t, u), wrapping in all three.

pub use super::coordinate::Coordinate;
use super::fixed::Fixed;
use super::pattern::{PatternSpec, refuse};
use super::slices::Slices;
use super::texture::Texture;
use crate::error::Result;
use glam::{Vec4, Vec4Swizzles};
use serde::{Deserialize, Serialize};

/// How the pattern is interpolated; what a reading costs, `cargo bench --bench speckle` tells. Losses
/// are of contrast, anywhere between texels and slices, at N/d = 4 and 64 slices.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Intensity, linear in s, t and u (Bergmann et al. 2016). Loses 7 % of
    /// the contrast.
    Trilinear,
    /// Complex field, linear in s, t and u, divided by the variance the blend
    /// leaves. A sum of circular Gaussian fields is one, whatever the weights:
    /// the intensity is exponential at every point and loses nothing (measured
    /// below 0.1 %). Wants N/d ≥ 4, where interpolation has no visible
    /// effect on the grains; halfway between slices they are a slice's width
    /// too large, which adds 0.4 % to the contrast of a pixel with q = 1. That
    /// pixel takes 7 × 7 readings for 0.5 %: see
    /// [`super::theory::samples_across_pixel`]. A scan does not read it from a
    /// ring but from a [`super::frame_field`] of each frame's own.
    Field,
    /// Field blended between slices, its intensity integrated over the pixel
    /// beforehand: one reading is one pixel. Contrast within 1 % of the closed
    /// form, most of it the slices' 0.4 %. All pixels have the q of the
    /// pattern, so where h varies over the sensor, its contrast does not.
    Prefiltered {
        /// Pixel pitch over minimal speckle size, p/h; at least ½.
        q: f64,
    },
}

impl Method {
    /// Floats per texel.
    pub(super) fn channels(&self) -> usize {
        match self {
            Method::Trilinear => 1,
            Method::Field | Method::Prefiltered { .. } => 2,
        }
    }

    fn validate(&self, spec: &PatternSpec) -> Result<()> {
        let most = spec.pupil_width() / 4.0;
        match *self {
            Method::Prefiltered { q } if !(q >= 0.5 && q <= most) => refuse(
                "prefiltered pixel, in speckles",
                q.to_string(),
                &format!("a number from 0.5 to {most}"),
            ),
            _ => Ok(()),
        }
    }
}

/// What lowers the contrast of the light itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Coherence {
    /// Degree of polarisation 𝒫 of the light on the sensor, 0 to 1.
    pub polarisation_degree: f64,
    /// Number of independent patterns of equal power (wavelengths, sources).
    pub independent_patterns: usize,
}

impl Coherence {
    /// One wavelength, polarised: contrast 1.
    pub const FULL: Coherence = Coherence {
        polarisation_degree: 1.0,
        independent_patterns: 1,
    };

    /// C = √((1 + 𝒫²)/2N) (Goodman 2007, sections 3.4 and 3.3).
    pub fn contrast(&self) -> f64 {
        let p = self.polarisation_degree;
        ((1.0 + p * p) / (2.0 * self.independent_patterns as f64)).sqrt()
    }

    pub(super) fn validate(&self) -> Result<()> {
        let p = self.polarisation_degree;
        if !(0.0..=1.0).contains(&p) {
            return refuse("polarisation_degree", p.to_string(), "a number in [0, 1]");
        }
        let n = self.independent_patterns;
        if !(1..=64).contains(&n) {
            return refuse(
                "independent_patterns",
                n.to_string(),
                "a number from 1 to 64",
            );
        }
        Ok(())
    }

    /// The patterns that add up to this light: N times two orthogonal
    /// polarisations of powers (1 ± 𝒫)/2N. They are the stored pattern read
    /// far apart: at steps of a low-discrepancy lattice in (s,t) (Roberts
    /// 2018) and evenly round the path in u. At one place and time they are
    /// independent; the sum repeats, at 1/n of its variance, at the distances
    /// between them, as every pattern does at its period.
    pub(super) fn layers(&self, spec: &PatternSpec) -> Vec<Layer> {
        let n = self.independent_patterns;
        let p = self.polarisation_degree;
        let powers = [(1.0 + p) / 2.0, (1.0 - p) / 2.0];
        let powers = (0..n).flat_map(|_| powers).filter(|power| *power > 0.0);
        let powers: Vec<f64> = powers.collect();
        let count = powers.len();
        let texels = |share: f64| (spec.size as f64 * share.fract()).round();
        powers
            .into_iter()
            .enumerate()
            .map(|(j, power)| Layer {
                weight: (power / n as f64) as f32,
                offset: Coordinate {
                    s: texels(0.754_877_666_246_693 * j as f64),
                    t: texels(0.569_840_290_998_053 * j as f64),
                    u: (spec.slices * j / count) as f64,
                },
            })
            .collect()
    }
}

/// One of the independent patterns of a [`Coherence`].
pub(super) struct Layer {
    pub weight: f32,
    pub offset: Coordinate,
}

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
        method.validate(spec)?;
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
            Method::Prefiltered { .. } => self.prefiltered(at),
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

    #[inline(always)]
    fn prefiltered(&self, at: Coordinate) -> f32 {
        let cell = self.cell(at, 2);
        let (v, w) = (1.0 - cell.w, cell.w);
        let gain = 1.0 / (1.0 - w * v * self.texture.links[cell.slice].lost.z);
        let [this, next] = self.columns(cell).map(fold);
        let sum = v * v * this.x + 2.0 * v * w * this.y + w * w * next.x;
        // Undoing the interpolation's blur can overshoot below zero in a dark
        // grain.
        sum.max(0.0) * gain
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
    use crate::speckle::pattern::Aperture;

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
