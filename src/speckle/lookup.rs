//! Reading speckle: the intensity at (s, t, u), wrapping in all three.

use super::pattern::{Pattern, PatternSpec};
use super::slices::{Link, PATH_RADIUS, Slices};
use crate::error::Result;
use crate::math::DVec2;
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use serde::{Deserialize, Serialize};

/// Where a pattern is read: s and t in texels, u in slices; finite. All wrap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinate {
    pub s: f64,
    pub t: f64,
    pub u: f64,
}

/// How the pattern is interpolated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Intensity, linear in s, t and u (Bergmann et al. 2016).
    Trilinear,
    /// Complex field, linear in s, t and u, divided by the variance the blend
    /// leaves.
    Field,
}

/// Interpolated speckle patterns, in memory.
pub struct Lookup {
    slices_mask: usize,
    size_mask: usize,
    /// Floats per slice and per row of the stored texels.
    slice_stride: usize,
    row_stride: usize,
    slices_per_diameter: f64,
    texture: Texture,
}

enum Texture {
    Intensity(Vec<f32>),
    Field {
        /// Real and imaginary parts in turn.
        texels: Vec<f32>,
        blends: Vec<Blend>,
        lost: [f32; 3],
    },
}

/// A [`Link`] in the units the hot loop needs.
#[derive(Clone, Copy)]
struct Blend {
    /// Phase of the next slice against this one, turns per texel.
    turns: [f32; 2],
    /// 1 − μ.
    novelty: f32,
}

impl Lookup {
    /// Makes the slices of `spec` and stores them for `method`.
    pub fn new(spec: &PatternSpec, method: Method) -> Result<Lookup> {
        spec.validate()?;
        let slices = Slices::new(spec);
        let channels = match method {
            Method::Trilinear => 1,
            Method::Field => 2,
        };
        // One more row and column than the period, so that the second tap
        // never wraps.
        let row_stride = channels * (spec.size + 1);
        let slice_stride = row_stride * (spec.size + 1);
        let mut texels = vec![0.0; slice_stride * spec.slices];
        texels
            .par_chunks_exact_mut(slice_stride)
            .enumerate()
            .for_each(|(k, out)| {
                let pattern = slices.pattern(k);
                match method {
                    Method::Trilinear => store(out, &pattern, |a| [a.norm_sqr()]),
                    Method::Field => store(out, &pattern, |a| [a.re, a.im]),
                }
            });
        let texture = match method {
            Method::Trilinear => Texture::Intensity(texels),
            Method::Field => Texture::Field {
                texels,
                blends: (0..spec.slices)
                    .map(|k| Blend::new(slices.link(k), spec.size))
                    .collect(),
                lost: lost_variance(spec),
            },
        };
        Ok(Lookup {
            slices_mask: spec.slices - 1,
            size_mask: spec.size - 1,
            slice_stride,
            row_stride,
            slices_per_diameter: spec.slices as f64 / (std::f64::consts::TAU * PATH_RADIUS),
            texture,
        })
    }
}

impl Lookup {
    /// Slices per pupil diameter travelled by the speckle field across the
    /// pupil: `u = slices_per_diameter · δ`.
    pub fn slices_per_diameter(&self) -> f64 {
        self.slices_per_diameter
    }

    /// Speckle intensity, mean 1.
    #[inline]
    pub fn intensity(&self, at: Coordinate) -> f32 {
        let (s, fs) = wrap(at.s, self.size_mask);
        let (t, ft) = wrap(at.t, self.size_mask);
        let (k, w) = wrap(at.u, self.slices_mask);
        let next = (k + 1) & self.slices_mask;
        match &self.texture {
            Texture::Intensity(texels) => {
                let corner = t * self.row_stride + s;
                let read = |k: usize| {
                    let [a, b] = self.rows::<2>(texels, k * self.slice_stride + corner);
                    mix(mix(a[0], a[1], fs), mix(b[0], b[1], fs), ft)
                };
                mix(read(k), read(next), w)
            }
            Texture::Field {
                texels,
                blends,
                lost,
            } => {
                let corner = t * self.row_stride + 2 * s;
                let read = |k: usize| {
                    let [a, b] = self.rows::<4>(texels, k * self.slice_stride + corner);
                    let column: [f32; 4] = std::array::from_fn(|i| mix(a[i], b[i], ft));
                    Complex32::new(mix(column[0], column[2], fs), mix(column[1], column[3], fs))
                };
                let blend = blends[k];
                let turns = blend.turns[0] * (s as f32 + fs) + blend.turns[1] * (t as f32 + ft);
                let field = read(k) * (1.0 - w) + read(next) * unit_phasor(turns) * w;
                let variance =
                    kept_variance(lost, fs, ft) * (1.0 - 2.0 * w * (1.0 - w) * blend.novelty);
                field.norm_sqr() / variance
            }
        }
    }

    /// The `L` floats from `corner` on and those one row further.
    #[inline]
    fn rows<const L: usize>(&self, texels: &[f32], corner: usize) -> [[f32; L]; 2] {
        [corner, corner + self.row_stride]
            .map(|start| std::array::from_fn(|i| texels[start..start + L][i]))
    }
}

impl Blend {
    fn new(link: Link, size: usize) -> Blend {
        Blend {
            turns: link.shift.map(|shift| shift as f32 / size as f32),
            novelty: (1.0 - link.correlation) as f32,
        }
    }
}

/// Copies a pattern into its padded place.
fn store<const C: usize>(
    out: &mut [f32],
    pattern: &Pattern,
    texel: impl Fn(Complex32) -> [f32; C],
) {
    let size = pattern.size;
    let rows = (0..=size).map(|t| t % size);
    for (row, t) in out.chunks_exact_mut(C * (size + 1)).zip(rows) {
        let line = &pattern.field[t * size..][..size];
        for (value, &amplitude) in row.chunks_exact_mut(C).zip(line.iter().chain(&line[..1])) {
            value.copy_from_slice(&texel(amplitude));
        }
    }
}

/// What linear interpolation takes from the variance of the field: with p =
/// 2f(1−f) the chance that two taps drawn by weight differ in column, and r
/// in row, the variance left is 1 − a·p − b·r + c·p·r.
fn lost_variance(spec: &PatternSpec) -> [f32; 3] {
    let mu = |x: f64, y: f64| {
        let lag = DVec2::new(x, y) / spec.texels_per_speckle;
        spec.aperture.field_correlation(lag)
    };
    let (column, row, both) = (mu(1.0, 0.0), mu(0.0, 1.0), mu(1.0, 1.0));
    [1.0 - column, 1.0 - row, 1.0 - column - row + both].map(|x| x as f32)
}

#[inline]
fn kept_variance(lost: &[f32; 3], fs: f32, ft: f32) -> f32 {
    let p = 2.0 * fs * (1.0 - fs);
    let r = 2.0 * ft * (1.0 - ft);
    1.0 - lost[0] * p - lost[1] * r + lost[2] * p * r
}

/// Index modulo the period `mask + 1`, and the fraction past it.
#[inline]
fn wrap(x: f64, mask: usize) -> (usize, f32) {
    // Cast and correct instead of `floor`, which is a call on baseline x86-64.
    let cut = x as i64;
    let whole = cut - (cut as f64 > x) as i64;
    (whole as usize & mask, (x - whole as f64) as f32)
}

#[inline]
fn mix(a: f32, b: f32, w: f32) -> f32 {
    a + w * (b - a)
}

/// exp(2πi·turns), to 1e-5 in single precision: Taylor series of sine and cosine at half the
/// angle, then doubled.
#[inline]
fn unit_phasor(turns: f32) -> Complex32 {
    let nearest = (turns + 0.5f32.copysign(turns)) as i32 as f32;
    let x = std::f32::consts::PI * (turns - nearest);
    let y = x * x;
    let sin = x
        * (1.0
            - y / 6.0 * (1.0 - y / 20.0 * (1.0 - y / 42.0 * (1.0 - y / 72.0 * (1.0 - y / 110.0)))));
    let cos =
        1.0 - y / 2.0 * (1.0 - y / 12.0 * (1.0 - y / 30.0 * (1.0 - y / 56.0 * (1.0 - y / 90.0))));
    Complex32::new(1.0 - 2.0 * sin * sin, 2.0 * sin * cos)
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

    #[test]
    fn phasors_are_on_the_circle_at_the_right_angle() {
        for i in -4000..=4000 {
            let turns = i as f32 * 0.00321;
            let (sin, cos) = (std::f64::consts::TAU * turns as f64).sin_cos();
            let z = unit_phasor(turns);
            assert!(
                (z.re as f64 - cos).abs() < 1e-5 && (z.im as f64 - sin).abs() < 1e-5,
                "{turns}"
            );
        }
    }

    /// At texels and slices every method gives the pattern itself; a period
    /// further, before zero too, the same.
    #[test]
    fn whole_coordinates_read_the_pattern_and_wrap() {
        let slices = Slices::new(&SPEC);
        for method in [Method::Trilinear, Method::Field] {
            let lookup = Lookup::new(&SPEC, method).unwrap();
            for (k, s, t) in [(0, 0, 0), (3, 17, 200), (15, 255, 255)] {
                let stored = slices.pattern(k).field[t * SPEC.size + s].norm_sqr();
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
            let lookup = Lookup::new(&SPEC, method).unwrap();
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
                        (a - b).abs() < 1e-4,
                        "{method:?} axis {axis} at {base:?}: {a} {b}"
                    );
                }
            }
        }
    }
}
