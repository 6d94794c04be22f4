//! Image in which individual counts are sampled only near light.
//!
//! The other pixels are dark and have one distribution. Line detection needs their individual
//! counts only where one of them is as high as a line.

use super::column::{ColumnView, ImageColumns, LazyDarkPixels};
use super::{Counts, DarkNoiseTable};
use crate::math::rng::RngKey;
use std::cell::OnceCell;
use std::ops::Range;
use std::sync::Arc;

/// Key components that separate dark pixels (individual counts, histograms, order) from lit ones.
/// They exceed the pixel count of any sensor.
const DARK: u64 = u64::MAX;
const COUNTED: u64 = u64::MAX - 1;
const ORDER: u64 = u64::MAX - 2;

/// Number of rows next to light that are sampled immediately, because line detection reads some of
/// them. The value affects speed only.
const LIT_MARGIN_ROWS: usize = 16;

/// Counts of an image near its light.
///
/// For the other pixels of a column, a histogram of the counts is sampled; it is sufficient for the
/// noise estimate of the column. Their order is sampled when individual counts are requested.
/// Histogram and order together are equivalent to independent samples, because identically
/// distributed pixels are exchangeable.
pub struct SparseImage {
    rows: usize,
    /// Sampled rows of every column, and the index of their first count in `drawn`.
    columns: Vec<(Range<usize>, usize)>,
    /// Sampled counts in column-major order.
    drawn: Vec<u16>,
    /// Distribution of dark pixels; `None` if all pixels are sampled.
    dark: Option<Arc<DarkNoiseTable>>,
    key: RngKey,
    /// Columns whose pixels have all been sampled.
    whole: Vec<OnceCell<Vec<u16>>>,
}

impl SparseImage {
    /// Samples the dark pixels near light. `lit` holds for every column the rows from the first to
    /// the last with light; it is empty for a column without light. The caller must
    /// [set](Self::set) the counts of lit pixels. `key` is the random key of the frame.
    pub fn new(
        rows: usize,
        lit: &[Range<usize>],
        dark: Arc<DarkNoiseTable>,
        key: RngKey,
    ) -> SparseImage {
        let mut drawn = Vec::with_capacity(lit.len() * 4 * LIT_MARGIN_ROWS);
        let mut add = |(column, lit): (usize, &Range<usize>)| {
            let near = match lit.is_empty() {
                true => 0..0,
                false => {
                    lit.start.saturating_sub(LIT_MARGIN_ROWS)..(lit.end + LIT_MARGIN_ROWS).min(rows)
                }
            };
            let start = drawn.len();
            drawn.resize(start + near.len(), 0);
            let first = column * rows;
            let pixels = first + near.start..first + near.end;
            dark.draw(pixels, key.with(DARK), &mut drawn[start..]);
            (near, start)
        };
        SparseImage {
            rows,
            columns: lit.iter().enumerate().map(&mut add).collect(),
            whole: vec![OnceCell::new(); lit.len()],
            drawn,
            dark: Some(dark),
            key,
        }
    }

    /// Creates an image in which every pixel is sampled.
    pub fn of_all(image: Counts, key: RngKey) -> SparseImage {
        let (columns, rows) = (image.columns(), image.rows());
        SparseImage {
            rows,
            columns: (0..columns)
                .map(|column| (0..rows, column * rows))
                .collect(),
            drawn: image.into_by_column(),
            dark: None,
            key,
            whole: vec![OnceCell::new(); columns],
        }
    }

    /// Sets the count of a sampled pixel.
    pub fn set(&mut self, column: usize, row: usize, count: u16) {
        let (near, start) = &self.columns[column];
        self.drawn[start + row - near.start] = count;
    }

    /// Converts the image into counts; samples the remaining pixels.
    pub fn into_counts(self) -> Counts {
        if self.dark.is_none() {
            return Counts::of_columns(self.drawn, self.rows);
        }
        let mut counts = Vec::with_capacity(self.columns.len() * self.rows);
        for column in 0..self.columns.len() {
            match self.whole[column].get() {
                Some(whole) => counts.extend_from_slice(whole),
                None => self.draw(column, &mut counts),
            }
        }
        Counts::of_columns(counts, self.rows)
    }

    /// Appends the counts of all pixels of a column.
    fn draw(&self, column: usize, counts: &mut Vec<u16>) {
        let (near, start) = &self.columns[column];
        let first = counts.len();
        self.histogram(column, &mut |count, times| {
            counts.extend(std::iter::repeat_n(count, times as usize));
        });
        shuffle(
            &mut counts[first..],
            self.key.with(ORDER).with(column as u64),
        );
        let drawn = &self.drawn[*start..][..near.len()];
        counts.extend_from_slice(drawn);
        counts[first + near.start..].rotate_right(near.len());
    }
}

impl ImageColumns for SparseImage {
    fn columns(&self) -> usize {
        self.columns.len()
    }

    fn rows(&self) -> usize {
        self.rows
    }

    fn column(&self, column: usize) -> ColumnView<'_> {
        let (near, start) = &self.columns[column];
        let drawn = &self.drawn[*start..][..near.len()];
        ColumnView::partly(self.rows, (near.start, drawn), self, column)
    }
}

impl LazyDarkPixels for SparseImage {
    fn histogram(&self, column: usize, mut is: &mut dyn FnMut(u16, u32)) {
        let Some(dark) = &self.dark else { return };
        let others = self.rows - self.columns[column].0.len();
        let key = self.key.with(COUNTED).with(column as u64);
        dark.histogram(others as u32, key, &mut is);
    }

    fn materialise(&self, column: usize) -> &[u16] {
        self.whole[column].get_or_init(|| {
            let mut counts = Vec::with_capacity(self.rows);
            self.draw(column, &mut counts);
            counts
        })
    }
}

/// Shuffles values so that all permutations are equally probable, to 2⁻³² times the number of
/// values (Durstenfeld 1964).
fn shuffle(values: &mut [u16], key: RngKey) {
    let mut left = values.len() as u64;
    while left > 1 {
        // One random number supplies 32 bits for each of two indices.
        let bits = key.bits(left);
        for half in [bits >> 32, bits & u64::from(u32::MAX)] {
            let other = (half * left) >> 32;
            left -= 1;
            values.swap(left as usize, other as usize);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::Purpose;

    /// The values 0 to 19 are shuffled 40 000 times. Each value is equally frequent at each index
    /// (400 cells, 2000 expected). Each pair of values is equally frequent at the first two indices
    /// (380 cells, 105 expected). χ² of k cells has a mean of at most k and a standard deviation of
    /// √(2k). Six standard deviations above the mean are exceeded with a probability below 1e-6.
    #[test]
    fn all_orders_are_equally_likely() {
        let (values, times) = (20, 40_000);
        let (mut places, mut pairs) = (vec![0.0; 400], vec![0.0; 400]);
        for i in 0..times {
            let mut order: Vec<u16> = (0..values).collect();
            shuffle(&mut order, RngKey::new(3, Purpose::SensorNoise).with(i));
            for (place, &value) in order.iter().enumerate() {
                places[place * 20 + value as usize] += 1.0;
            }
            pairs[usize::from(order[0] * values + order[1])] += 1.0;
        }
        for (found, k) in [(places, 400.0), (pairs, 380.0)] {
            // All k cells have equal expected frequency.
            let all: f64 = found.iter().sum();
            let off = |n: &f64| (n - all / k).powi(2) / (all / k);
            let chi2: f64 = found.iter().filter(|&&n| n > 0.0).map(off).sum();
            assert!(chi2 < k + 6.0 * f64::sqrt(2.0 * k), "{chi2} {k}");
        }
    }
}
