//! The irradiance of a frame, kept for the pixels that light may reach alone.

use super::pixels::{Pixels, Rows};
use glam::UVec2;

/// Irradiance on the sensor averaged over each pixel, mW/mm².
#[derive(Debug, Clone, PartialEq)]
pub struct Irradiance {
    pub(super) rows: Rows,
    /// Of those pixels, row by row.
    values: Vec<f32>,
}

impl Irradiance {
    /// `values` of the pixels of `rows`.
    pub(super) fn new(rows: Rows, values: Vec<f32>) -> Irradiance {
        debug_assert_eq!(rows.total(), values.len());
        Irradiance { rows, values }
    }

    /// No light.
    pub(super) fn dark(resolution: UVec2) -> Irradiance {
        Irradiance::new(Rows::new(Pixels::none(resolution)), Vec::new())
    }

    /// Of its pixels, row by row.
    pub(super) fn values(&self) -> &[f32] {
        &self.values
    }

    /// See [`Self::values`].
    pub(super) fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// The mean of as many images of one sensor.
    pub fn mean(mut images: Vec<Irradiance>) -> Irradiance {
        match images.len() {
            1 => images.remove(0),
            count => Irradiance::sum_of(&images, 1.0 / count as f32),
        }
    }

    /// The sum of images of one sensor, at least one.
    pub fn sum(images: &[Irradiance]) -> Irradiance {
        Irradiance::sum_of(images, 1.0)
    }

    /// Of so much of each.
    fn sum_of(images: &[Irradiance], share: f32) -> Irradiance {
        let (columns, rows) = (images[0].columns(), images[0].rows());
        let mut pixels = Pixels::none(UVec2::new(columns as u32, rows as u32));
        let mut values = Vec::new();
        let mut sums = vec![0.0; columns];
        for row in 0..rows {
            for (column, e) in images.iter().flat_map(|image| image.row(row)) {
                sums[column] += e * share;
                pixels.insert(row, column, column);
            }
            values.extend(
                pixels
                    .of(row)
                    .map(|column| std::mem::take(&mut sums[column])),
            );
        }
        Irradiance::new(Rows::new(pixels), values)
    }

    /// Columns of the sensor, dark ones too.
    pub fn columns(&self) -> usize {
        self.rows.pixels.columns
    }

    /// Rows of the sensor, dark ones too.
    pub fn rows(&self) -> usize {
        self.rows.pixels.rows
    }

    /// Number of pixels that may be lit.
    pub fn looked_at(&self) -> usize {
        self.values.len()
    }

    /// Columns of a row that may be lit, from left to right, and their irradiance.
    pub fn row(&self, row: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        let values = &self.values[self.rows.range(row)];
        self.rows.pixels.of(row).zip(values.iter().copied())
    }

    /// Of every pixel, row by row.
    pub fn dense(&self) -> Vec<f32> {
        let columns = self.columns();
        let mut image = vec![0.0; columns * self.rows()];
        for row in 0..self.rows() {
            for (column, e) in self.row(row) {
                image[row * columns + column] = e;
            }
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_keep_their_values_and_means_are_of_all_pixels() {
        let image = |runs: &[(usize, usize, usize)], first: f32| {
            let mut pixels = Pixels::none(UVec2::new(70, 3));
            for &(row, from, to) in runs {
                pixels.insert(row, from, to);
            }
            let count = (0..3).map(|row| pixels.count(row)).sum::<usize>();
            Irradiance::new(
                Rows::new(pixels),
                (0..count).map(|i| first + i as f32).collect(),
            )
        };
        let a = image(&[(0, 60, 69), (2, 0, 1)], 1.0);
        let b = image(&[(0, 68, 69), (1, 5, 5)], 10.0);
        assert_eq!(a.row(2).collect::<Vec<_>>(), [(0, 11.0), (1, 12.0)]);
        assert_eq!(a.row(1).count(), 0);
        let dense = a.dense();
        assert_eq!(
            (dense.len(), dense[69], dense[140], dense[70]),
            (210, 10.0, 11.0, 0.0)
        );
        let mean = Irradiance::mean(vec![a.clone(), b.clone()]).dense();
        let (a_dense, b_dense) = (a.dense(), b.dense());
        let expected = a_dense.iter().zip(&b_dense).map(|(a, b)| a / 2.0 + b / 2.0);
        assert_eq!(mean, expected.collect::<Vec<_>>());
        assert_eq!(Irradiance::mean(vec![a.clone()]), a);
    }
}
