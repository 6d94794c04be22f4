//! Fourier transforms of rectangles.

use crate::math::DVec2;
use rustfft::num_complex::Complex32;
use rustfft::{FftDirection, FftPlannerScalar};
use std::cell::RefCell;
use std::f64::consts::TAU;

/// Returns the smallest length of at least `least` without a prime factor above 5. Such lengths are
/// fast to transform.
pub(super) fn fast_length(least: usize) -> usize {
    (least.max(1)..)
        .find(|&n| is_fast(n))
        .expect("a power of two is one")
}

/// Returns the largest margin of at most `most`, and at least 1, that is a fast length.
pub(super) fn fast_margin(most: usize) -> usize {
    (1..=most).rev().find(|&n| is_fast(n)).unwrap_or(1)
}

fn is_fast(n: usize) -> bool {
    let rest = [2, 3, 5].into_iter().fold(n, |mut n, prime| {
        while n.is_multiple_of(prime) {
            n /= prime;
        }
        n
    });
    rest == 1
}

/// Passband: frequencies of the rectangle that the lens may transmit.
pub(super) struct PassBand {
    /// Columns and rows of the rectangle.
    size: [usize; 2],
    /// Indices of the frequencies.
    columns: Vec<usize>,
    rows: Vec<usize>,
}

impl PassBand {
    /// Returns the passband of frequencies up to `most`, in cycles per sample, along both sides.
    pub fn new(size: [usize; 2], most: DVec2) -> PassBand {
        let within = |n: usize, most: f64| -> Vec<usize> {
            (0..n)
                .filter(|&i| signed_frequency(i, n).abs() <= most)
                .collect()
        };
        PassBand {
            size,
            columns: within(size[0], most.x),
            rows: within(size[1], most.y),
        }
    }

    /// Returns the passband of a real image. It holds only non-negative column frequencies; the
    /// others follow by conjugate symmetry.
    pub fn of_real(size: [usize; 2], most: DVec2) -> PassBand {
        let mut band = PassBand::new(size, most);
        band.columns.retain(|&x| 2 * x <= size[0]);
        band
    }

    /// Returns the frequencies in cycles per sample, from −½ to ½. Values are stored in the same
    /// order, column by column.
    pub fn frequencies(&self) -> impl Iterator<Item = DVec2> + '_ {
        let [columns, rows] = self.size;
        self.columns.iter().flat_map(move |&x| {
            let of_row = move |&y: &usize| {
                DVec2::new(signed_frequency(x, columns), signed_frequency(y, rows))
            };
            self.rows.iter().map(of_row)
        })
    }

    /// Returns the frequencies along columns and along rows, cycles per sample.
    pub fn along(&self) -> [Vec<f64>; 2] {
        let of =
            |numbers: &[usize], n: usize| numbers.iter().map(|&i| signed_frequency(i, n)).collect();
        [
            of(&self.columns, self.size[0]),
            of(&self.rows, self.size[1]),
        ]
    }

    /// Returns the number of frequencies.
    pub fn len(&self) -> usize {
        self.columns.len() * self.rows.len()
    }
}

/// Sub-pixel position at which the inverse transform is evaluated, once per pixel.
pub(super) struct OutputSampling {
    /// Samples per side of a pixel.
    side: usize,
    /// Offset from the first sample of the pixel, in samples, along columns and rows.
    place: [f64; 2],
}

impl OutputSampling {
    /// Returns the position `place`, in pixels from the pixel's centre (column, row).
    pub fn at(place: DVec2, side: usize) -> OutputSampling {
        let along = |i: usize| (place[i] + 0.5) * side as f64 - 0.5;
        OutputSampling {
            side,
            place: [along(0), along(1)],
        }
    }
}

/// Fourier transforms of rectangles within a [`PassBand`], with cached plans and buffers.
pub(super) struct Transform {
    /// `FftPlanner` selects algorithms by the instruction set of the processor. Its AVX and SSE
    /// algorithms differ in the last digits of f32, which changes counts by 1.
    planner: FftPlannerScalar<f32>,
    scratch: Vec<Complex32>,
    by_column: Vec<Complex32>,
}

thread_local! {
    static FFT_CACHE: RefCell<Transform> = RefCell::new(Transform {
        planner: FftPlannerScalar::new(),
        scratch: Vec::new(),
        by_column: Vec::new(),
    });
}

impl Transform {
    /// Calls `then` with the transform of the current thread.
    pub fn with<T>(then: impl FnOnce(&mut Transform) -> T) -> T {
        FFT_CACHE.with_borrow_mut(then)
    }

    fn each(&mut self, lines: &mut [Complex32], length: usize, direction: FftDirection) {
        let fft = self.planner.plan_fft(length, direction);
        let needed = fft.get_inplace_scratch_len();
        if self.scratch.len() < needed {
            self.scratch.resize(needed, Complex32::ZERO);
        }
        fft.process_with_scratch(lines, &mut self.scratch[..needed]);
    }

    /// Returns the spectrum of a rectangle that is zero outside `rows`. The first of these rows has
    /// index `first`. The contents of `rows` are overwritten.
    pub fn forward(
        &mut self,
        rows: &mut [Complex32],
        first: usize,
        band: &PassBand,
    ) -> Vec<Complex32> {
        let width = band.size[0];
        self.each(rows, width, FftDirection::Forward);
        self.transform_columns(band, |by_column, height| {
            for (y, row) in rows.chunks(width).enumerate() {
                for (column, &x) in by_column.chunks_mut(height).zip(&band.columns) {
                    column[first + y] = row[x];
                }
            }
        })
    }

    /// Returns the spectrum of real rows in a real passband. Rows 2i and 2i + 1 are the real and
    /// imaginary parts of row i of `pairs`. Rows beyond them are zero.
    pub fn rfft2(&mut self, pairs: &mut [Complex32], band: &PassBand) -> Vec<Complex32> {
        let width = band.size[0];
        self.each(pairs, width, FftDirection::Forward);
        self.transform_columns(band, |by_column, height| {
            for (y, pair) in (0..).step_by(2).zip(pairs.chunks(width)) {
                for (column, &x) in by_column.chunks_mut(height).zip(&band.columns) {
                    let (here, mirrored) = (pair[x], pair[(width - x) % width].conj());
                    let [sum, difference] = [here + mirrored, here - mirrored];
                    column[y] = sum * 0.5;
                    // An odd number of rows has no partner for the last one.
                    if let Some(next) = column.get_mut(y + 1) {
                        *next = Complex32::new(difference.im, -difference.re) * 0.5;
                    }
                }
            }
        })
    }

    /// Transforms the columns of a band after `fill` has set them.
    fn transform_columns(
        &mut self,
        band: &PassBand,
        fill: impl FnOnce(&mut [Complex32], usize),
    ) -> Vec<Complex32> {
        let height = band.size[1];
        let mut by_column = std::mem::take(&mut self.by_column);
        by_column.clear();
        by_column.resize(band.columns.len() * height, Complex32::ZERO);
        fill(&mut by_column, height);
        self.each(&mut by_column, height, FftDirection::Forward);
        let columns = by_column.chunks(height);
        let values = columns.flat_map(|column| band.rows.iter().map(|&y| column[y]));
        let values = values.collect();
        self.by_column = by_column;
        values
    }

    /// Computes the image of a spectrum, row by row.
    pub fn backward(
        &mut self,
        spectrum: &[Complex32],
        band: &PassBand,
        drawn: &OutputSampling,
    ) -> Vec<Complex32> {
        self.inverse_transform_columns(spectrum, band, drawn, 1, |row, x, column| {
            row[x % row.len()] += column[0];
        })
    }

    /// Computes the real image of a spectrum, as pairs of rows (see [`Transform::rfft2`]).
    pub fn backward_real(
        &mut self,
        spectrum: &[Complex32],
        band: &PassBand,
        drawn: &OutputSampling,
    ) -> Vec<Complex32> {
        self.inverse_transform_columns(spectrum, band, drawn, 2, |pair, x, column| {
            let width = pair.len();
            let here = column[0];
            let next = column.get(1).copied().unwrap_or_default();
            if (2 * x).is_multiple_of(band.size[0]) {
                pair[x % width] += Complex32::new(here.re, next.re);
            } else {
                let mirrored = (band.size[0] - x) % width;
                pair[x % width] += here + next * Complex32::I;
                pair[mirrored] += here.conj() + next.conj() * Complex32::I;
            }
        })
    }

    /// Computes the image of a point from its real transfer function in `band`, as pairs of rows of
    /// `width` samples (see [`Transform::rfft2`]).
    ///
    /// The point is at the first column and at the middle row. Columns before the point are at the
    /// end of a row. The image has all columns of `band`, whose number is even, and ends `margin` rows
    /// from the point.
    pub fn centred_kernel(
        &mut self,
        transfer: &[f32],
        band: &PassBand,
        margin: usize,
        width: usize,
    ) -> Vec<Complex32> {
        let spectrum: Vec<Complex32> = transfer.iter().map(|&value| value.into()).collect();
        let image = self.backward_real(&spectrum, band, &OutputSampling::at(DVec2::ZERO, 1));
        let [columns, rows] = band.size;
        let value = |x: usize, y: usize| {
            let pair = image[y / 2 * columns + x];
            if y.is_multiple_of(2) {
                pair.re
            } else {
                pair.im
            }
        };
        let (half, height) = (columns / 2, 2 * margin + 1);
        let mut pairs = vec![Complex32::ZERO; width * height.div_ceil(2)];
        for y in 0..height {
            let row = &mut pairs[y / 2 * width..][..width];
            let from = (y + rows - margin) % rows;
            let mut set = |x: usize, value: f32| match y % 2 {
                0 => row[x].re = value,
                _ => row[x].im = value,
            };
            set(0, value(0, from));
            for x in 1..half {
                set(x, value(x, from));
                set(width - x, value(columns - x, from));
            }
            // The outermost column occurs on both sides.
            set(half, 0.5 * value(half, from));
            set(width - half, 0.5 * value(half, from));
        }
        pairs
    }

    /// Computes the inverse transform of the columns. Every output row packs `together` image rows;
    /// `add` unpacks the values of one column.
    fn inverse_transform_columns(
        &mut self,
        spectrum: &[Complex32],
        band: &PassBand,
        drawn: &OutputSampling,
        together: usize,
        add: impl Fn(&mut [Complex32], usize, &[Complex32]),
    ) -> Vec<Complex32> {
        let [width, height] = [0, 1].map(|i| band.size[i] / drawn.side);
        let turn = |i: usize, n: usize, by: f64| {
            let (sin, cos) = (TAU * signed_frequency(i, n) * by).sin_cos();
            // The frequency ½ cycle per sample represents both signs, whose phases are opposite.
            let sin = if 2 * i == n { 0.0 } else { sin };
            Complex32::new(cos as f32, sin as f32)
        };
        let [columns, rows] = band.size;
        // Index of each frequency row in the output, and its phase factor.
        let of_row = |&y: &usize| (y % height, turn(y, rows, drawn.place[1]));
        let of_rows: Vec<(usize, Complex32)> = band.rows.iter().map(of_row).collect();
        let mut by_column = std::mem::take(&mut self.by_column);
        by_column.clear();
        by_column.resize(band.columns.len() * height, Complex32::ZERO);
        let scale = 1.0 / (columns * rows) as f32;
        let of_columns = by_column.chunks_mut(height).zip(&band.columns);
        for ((onto, &x), values) in of_columns.zip(spectrum.chunks(of_rows.len())) {
            let x_turn = turn(x, columns, drawn.place[0]) * scale;
            for (value, &(y, y_turn)) in values.iter().zip(&of_rows) {
                onto[y] += value * y_turn * x_turn;
            }
        }
        self.each(&mut by_column, height, FftDirection::Inverse);
        let mut image = vec![Complex32::ZERO; width * height.div_ceil(together)];
        // Processes eight columns at a time, so that written values are contiguous.
        for (from, numbers) in by_column.chunks(8 * height).zip(band.columns.chunks(8)) {
            for (y, row) in image.chunks_mut(width).enumerate() {
                for (column, &x) in from.chunks(height).zip(numbers) {
                    add(row, x, &column[together * y..]);
                }
            }
        }
        self.by_column = by_column;
        self.each(&mut image, width, FftDirection::Inverse);
        image
    }
}

/// Returns the frequency of index `i` of `n`, cycles per sample, from −½ to ½.
fn signed_frequency(i: usize, n: usize) -> f64 {
    match 2 * i > n {
        true => (i as f64 - n as f64) / n as f64,
        false => i as f64 / n as f64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_has_one_frequency_and_comes_back_moved() {
        let size = [fast_length(17), fast_length(29)];
        assert_eq!(size, [18, 30]);
        let wave = |x: f64, y: f64| {
            let (sin, cos) = (TAU * (-2.0 * x / 18.0 + 7.0 * y / 30.0)).sin_cos();
            Complex32::new(cos as f32, sin as f32)
        };
        let mut grid: Vec<Complex32> = (0..18 * 30)
            .map(|i| wave((i % 18) as f64, (i / 18) as f64))
            .collect();
        let band = PassBand::new(size, DVec2::new(0.2, 0.3));
        assert_eq!(band.len(), 7 * 19);
        let there = Transform::with(|transform| transform.forward(&mut grid, 0, &band));
        for (value, frequency) in there.iter().zip(band.frequencies()) {
            let own = (frequency - DVec2::new(-2.0 / 18.0, 7.0 / 30.0)).length() < 1e-9;
            let expected = if own { 540.0 } else { 0.0 };
            // Rounding of a sum of 540 terms of magnitude 1.
            assert!((value - Complex32::new(expected, 0.0)).norm() < 1e-3);
        }
        // Evaluated at the midpoint between two samples, and a quarter of a pixel further along the
        // columns.
        for by in [0.0, 0.25] {
            let drawn = OutputSampling::at(DVec2::X * by, 2);
            let half = Transform::with(|transform| transform.backward(&there, &band, &drawn));
            for (i, value) in half.iter().enumerate() {
                let (x, y) = ((2 * (i % 9)) as f64, (2 * (i / 9)) as f64 + 0.5);
                let expected = wave(x + 2.0 * by + 0.5, y);
                assert!((value - expected).norm() < 1e-5);
            }
        }
    }

    /// The spectrum of the lit rows equals the spectrum of the complete rectangle.
    #[test]
    fn dark_rows_need_not_be_transformed() {
        let size = [8, 12];
        let band = PassBand::new(size, DVec2::splat(0.5));
        let mut lit: Vec<Complex32> = (0..16)
            .map(|i| Complex32::new((i * i % 7) as f32, 1.0))
            .collect();
        let mut all = vec![Complex32::ZERO; 96];
        all[24..40].copy_from_slice(&lit);
        let image = all.clone();
        let [some, whole] = Transform::with(|transform| {
            [
                transform.forward(&mut lit, 3, &band),
                transform.forward(&mut all, 0, &band),
            ]
        });
        assert_eq!(some, whole);
        let drawn = OutputSampling::at(DVec2::ZERO, 1);
        let back = Transform::with(|transform| transform.backward(&some, &band, &drawn));
        for (back, image) in back.iter().zip(image) {
            assert!((back - image).norm() < 1e-5);
        }
    }

    /// Real transforms of paired rows agree with complex transforms, for even and odd numbers of
    /// rows.
    #[test]
    fn real_rows_are_transformed_as_complex_ones() {
        for (size, lit) in [([18, 30], 7), ([15, 25], 25), ([16, 12], 12)] {
            let most = DVec2::new(0.4, 0.5);
            let [half, band] = [PassBand::of_real(size, most), PassBand::new(size, most)];
            let value = |i: usize| ((i * i + 3 * i) % 23) as f32 - 8.0;
            let mut rows: Vec<Complex32> = (0..size[0] * lit).map(|i| value(i).into()).collect();
            let mut pairs = vec![Complex32::ZERO; size[0] * lit.div_ceil(2)];
            for (i, row) in rows.iter().enumerate() {
                let (x, y) = (i % size[0], i / size[0]);
                let pair = &mut pairs[y / 2 * size[0] + x];
                *pair += if y % 2 == 0 { *row } else { row * Complex32::I };
            }
            let [some, all] = Transform::with(|transform| {
                [
                    transform.rfft2(&mut pairs, &half),
                    transform.forward(&mut rows, 0, &band),
                ]
            });
            let of: Vec<DVec2> = band.frequencies().collect();
            for (value, frequency) in some.iter().zip(half.frequencies()) {
                let at = of.iter().position(|&f| f == frequency).unwrap();
                // Rounding of some hundred terms of magnitude up to 14.
                assert!((value - all[at]).norm() < 1e-2, "{size:?} {frequency}");
            }
            for side in (1..=3).filter(|side| size.iter().all(|n| n.is_multiple_of(*side))) {
                let drawn = OutputSampling::at(DVec2::ZERO, side);
                let width = size[0] / side;
                let [pairs, image] = Transform::with(|transform| {
                    [
                        transform.backward_real(&some, &half, &drawn),
                        transform.backward(&all, &band, &drawn),
                    ]
                });
                for (i, value) in image.iter().enumerate() {
                    let (x, y) = (i % width, i / width);
                    let pair = pairs[y / 2 * width + x];
                    let found = if y.is_multiple_of(2) {
                        pair.re
                    } else {
                        pair.im
                    };
                    assert!((found - value.re).abs() < 1e-4, "{size:?} {side} {x} {y}");
                }
            }
        }
    }
}
