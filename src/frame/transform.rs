//! Fourier transforms of rectangles.

use crate::math::DVec2;
use rustfft::num_complex::Complex32;
use rustfft::{FftDirection, FftPlanner};
use std::cell::RefCell;
use std::f64::consts::TAU;

/// The next length that transforms fast: of no prime factor above 5.
pub(super) fn fast_length(least: usize) -> usize {
    let smooth = |&n: &usize| {
        let rest = [2, 3, 5].into_iter().fold(n, |mut n, prime| {
            while n.is_multiple_of(prime) {
                n /= prime;
            }
            n
        });
        rest == 1
    };
    (least.max(1)..)
        .find(smooth)
        .expect("a power of two is one")
}

/// Frequencies of a rectangle that the lens may let pass, of its columns' and of its rows' transforms.
pub(super) struct Band {
    /// Columns and rows of the rectangle.
    size: [usize; 2],
    /// Numbers of the frequencies.
    columns: Vec<usize>,
    rows: Vec<usize>,
}

impl Band {
    /// Those up to `most` (cycles a sample) along both sides.
    pub fn new(size: [usize; 2], most: DVec2) -> Band {
        let within = |n: usize, most: f64| -> Vec<usize> {
            (0..n).filter(|&i| signed(i, n).abs() <= most).collect()
        };
        Band {
            size,
            columns: within(size[0], most.x),
            rows: within(size[1], most.y),
        }
    }

    /// The frequencies, cycles a sample from −½ to ½, in the order in which their values are held:
    /// column by column.
    pub fn frequencies(&self) -> impl Iterator<Item = DVec2> + '_ {
        let [columns, rows] = self.size;
        self.columns.iter().flat_map(move |&x| {
            let of_row = move |&y: &usize| DVec2::new(signed(x, columns), signed(y, rows));
            self.rows.iter().map(of_row)
        })
    }

    /// Number of the frequency that lies as far on the other side of zero.
    pub fn mirrored(&self, i: usize) -> usize {
        let [columns, rows] = [self.columns.len(), self.rows.len()];
        (columns - i / rows) % columns * rows + (rows - i % rows) % rows
    }

    /// How many they are.
    pub fn len(&self) -> usize {
        self.columns.len() * self.rows.len()
    }
}

/// An image that is drawn from a spectrum: one value of each pixel.
pub(super) struct Drawn {
    /// Samples along the side of a pixel.
    side: usize,
    /// Where, in samples from the pixel's first, along the columns and along the rows.
    column: f64,
    row: f64,
}

impl Drawn {
    /// At a place in pixels from the pixel's centre.
    pub fn at(column: f64, row: f64, side: usize) -> Drawn {
        let [column, row] = [column, row].map(|place| (place + 0.5) * side as f64 - 0.5);
        Drawn { side, column, row }
    }
}

/// Transforms rectangles within a [`Band`], and keeps what it needs to do so again.
pub(super) struct Transform {
    planner: FftPlanner<f32>,
    scratch: Vec<Complex32>,
    by_column: Vec<Complex32>,
}

thread_local! {
    static KEPT: RefCell<Transform> = RefCell::new(Transform {
        planner: FftPlanner::new(),
        scratch: Vec::new(),
        by_column: Vec::new(),
    });
}

impl Transform {
    /// With what this thread has kept.
    pub fn with<T>(then: impl FnOnce(&mut Transform) -> T) -> T {
        KEPT.with_borrow_mut(then)
    }

    fn each(&mut self, lines: &mut [Complex32], length: usize, direction: FftDirection) {
        let fft = self.planner.plan_fft(length, direction);
        let needed = fft.get_inplace_scratch_len();
        if self.scratch.len() < needed {
            self.scratch.resize(needed, Complex32::ZERO);
        }
        fft.process_with_scratch(lines, &mut self.scratch[..needed]);
    }

    /// The spectrum of a rectangle that is dark but for these rows, from row `first` on; they are used up.
    pub fn forward(&mut self, rows: &mut [Complex32], first: usize, band: &Band) -> Vec<Complex32> {
        let [width, height] = band.size;
        self.each(rows, width, FftDirection::Forward);
        let mut by_column = std::mem::take(&mut self.by_column);
        by_column.clear();
        by_column.resize(band.columns.len() * height, Complex32::ZERO);
        for (y, row) in rows.chunks(width).enumerate() {
            for (column, &x) in by_column.chunks_mut(height).zip(&band.columns) {
                column[first + y] = row[x];
            }
        }
        self.each(&mut by_column, height, FftDirection::Forward);
        let columns = by_column.chunks(height);
        let values = columns.flat_map(|column| band.rows.iter().map(|&y| column[y]));
        let values = values.collect();
        self.by_column = by_column;
        values
    }

    /// An image of a spectrum's light, row by row.
    pub fn backward(
        &mut self,
        spectrum: &[Complex32],
        band: &Band,
        drawn: &Drawn,
    ) -> Vec<Complex32> {
        let [width, height] = band.size.map(|n| n / drawn.side);
        let turn = |i: usize, n: usize, by: f64| {
            let (sin, cos) = (TAU * signed(i, n) * by).sin_cos();
            Complex32::new(cos as f32, sin as f32)
        };
        let [columns, rows] = band.size;
        // Where each row of the band goes, and how it is turned.
        let of_row = |&y: &usize| (y % height, turn(y, rows, drawn.row));
        let of_rows: Vec<(usize, Complex32)> = band.rows.iter().map(of_row).collect();
        let mut by_column = std::mem::take(&mut self.by_column);
        by_column.clear();
        by_column.resize(band.columns.len() * height, Complex32::ZERO);
        let scale = 1.0 / (columns * rows) as f32;
        let of_columns = by_column.chunks_mut(height).zip(&band.columns);
        for ((onto, &x), values) in of_columns.zip(spectrum.chunks(of_rows.len())) {
            let x_turn = turn(x, columns, drawn.column) * scale;
            for (value, &(y, y_turn)) in values.iter().zip(&of_rows) {
                onto[y] += value * y_turn * x_turn;
            }
        }
        self.each(&mut by_column, height, FftDirection::Inverse);
        let mut image = vec![Complex32::ZERO; width * height];
        // Some columns at a time, so that what is written lies together.
        for (from, numbers) in by_column.chunks(8 * height).zip(band.columns.chunks(8)) {
            for (y, row) in image.chunks_mut(width).enumerate() {
                for (i, x) in numbers.iter().enumerate() {
                    row[x % width] += from[i * height + y];
                }
            }
        }
        self.by_column = by_column;
        self.each(&mut image, width, FftDirection::Inverse);
        image
    }
}

/// Frequency number `i` of `n`, cycles a sample, from −½ to ½.
fn signed(i: usize, n: usize) -> f64 {
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
        let band = Band::new(size, DVec2::new(0.2, 0.3));
        assert_eq!(band.len(), 7 * 19);
        let there = Transform::with(|transform| transform.forward(&mut grid, 0, &band));
        for (value, frequency) in there.iter().zip(band.frequencies()) {
            let own = (frequency - DVec2::new(-2.0 / 18.0, 7.0 / 30.0)).length() < 1e-9;
            let expected = if own { 540.0 } else { 0.0 };
            // Rounding of 540 terms of 1.
            assert!((value - Complex32::new(expected, 0.0)).norm() < 1e-3);
        }
        // In the middle between two samples each, and a quarter of a pixel further on.
        for by in [0.0, 0.25] {
            let drawn = Drawn::at(by, 0.0, 2);
            let half = Transform::with(|transform| transform.backward(&there, &band, &drawn));
            for (i, value) in half.iter().enumerate() {
                let (x, y) = ((2 * (i % 9)) as f64, (2 * (i / 9)) as f64 + 0.5);
                let expected = wave(x + 2.0 * by + 0.5, y);
                assert!((value - expected).norm() < 1e-5);
            }
        }
    }

    /// What lies in a few rows is what the whole rectangle has.
    #[test]
    fn dark_rows_need_not_be_transformed() {
        let size = [8, 12];
        let band = Band::new(size, DVec2::splat(0.5));
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
        let drawn = Drawn::at(0.0, 0.0, 1);
        let back = Transform::with(|transform| transform.backward(&some, &band, &drawn));
        for (back, image) in back.iter().zip(image) {
            assert!((back - image).norm() < 1e-5);
        }
    }
}
