//! Irradiance of a frame, stored sparsely for the pixels that may be lit.

use super::pixel_mask::{PixelMask, PixelNumbering};
use glam::UVec2;

/// Irradiance on the sensor averaged over each pixel, mW/mm².
#[derive(Debug, Clone, PartialEq)]
pub struct Irradiance {
    pub(super) rows: PixelNumbering,
    /// Values of the pixels that may be lit, row by row.
    values: Vec<f32>,
}

impl Irradiance {
    /// Builds the image from the `values` of the pixels of `rows`.
    pub(super) fn new(rows: PixelNumbering, values: Vec<f32>) -> Irradiance {
        debug_assert_eq!(rows.total(), values.len());
        Irradiance { rows, values }
    }

    /// Returns a uniform image of the given resolution.
    pub fn even(resolution: UVec2, value: f32) -> Irradiance {
        let rows = PixelNumbering::new(PixelMask::all(resolution));
        let values = vec![value; rows.total()];
        Irradiance::new(rows, values)
    }

    /// Returns an image without light.
    pub(crate) fn dark(resolution: UVec2) -> Irradiance {
        Irradiance::new(PixelNumbering::new(PixelMask::none(resolution)), Vec::new())
    }

    /// Returns the values of the pixels that may be lit, row by row.
    pub(super) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Returns [`Self::values`] mutably.
    pub(super) fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Returns the mean of images of one sensor.
    pub fn mean(mut images: Vec<Irradiance>) -> Irradiance {
        match images.len() {
            1 => images.remove(0),
            count => Irradiance::sum_of(&images, 1.0 / count as f32),
        }
    }

    /// Returns the sum of images of one sensor, at least one.
    pub fn sum(images: &[Irradiance]) -> Irradiance {
        Irradiance::sum_of(images, 1.0)
    }

    /// Returns the sum of the images, each multiplied by `share`.
    fn sum_of(images: &[Irradiance], share: f32) -> Irradiance {
        let (columns, rows) = (images[0].columns(), images[0].rows());
        let mut pixels = PixelMask::none(UVec2::new(columns as u32, rows as u32));
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
        Irradiance::new(PixelNumbering::new(pixels), values)
    }

    /// Returns the number of sensor columns, including dark ones.
    pub fn columns(&self) -> usize {
        self.rows.pixels.columns
    }

    /// Returns the number of sensor rows, including dark ones.
    pub fn rows(&self) -> usize {
        self.rows.pixels.rows
    }

    /// Returns the number of pixels that may be lit.
    pub fn traced_pixels(&self) -> usize {
        self.values.len()
    }

    /// Returns the columns of a row that may be lit, from left to right, and their irradiance.
    pub fn row(&self, row: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        let values = &self.values[self.rows.range(row)];
        self.rows.pixels.of(row).zip(values.iter().copied())
    }

    /// Returns the irradiance of every pixel, row by row.
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
            let mut pixels = PixelMask::none(UVec2::new(70, 3));
            for &(row, from, to) in runs {
                pixels.insert(row, from, to);
            }
            let count = (0..3).map(|row| pixels.count(row)).sum::<usize>();
            Irradiance::new(
                PixelNumbering::new(pixels),
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
