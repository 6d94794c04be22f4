//! An image of which only what is near light is drawn: the rest is dark, all its pixels have one
//! distribution, and nobody looks at them but where one is as high as a line.

use super::column::{Column, Columns, Undrawn};
use super::{Counts, DarkCounts};
use crate::math::rng::Key;
use std::cell::OnceCell;
use std::ops::Range;
use std::sync::Arc;

/// Tell the keys of dark pixels, by themselves, counted and put in order, from those of lit ones: no sensor has
/// as many.
const DARK: u64 = u64::MAX;
const COUNTED: u64 = u64::MAX - 1;
const ORDER: u64 = u64::MAX - 2;

/// Rows beside light that are drawn at once, as the search for lines looks at some: a choice of speed alone.
const BESIDE: usize = 16;

/// The counts of an image near its light. Of the other pixels of a column it is drawn how often each count is
/// there, which is the column's own noise, and, where someone asks for them, in which order: together
/// as if each were drawn by itself, as pixels of one distribution are in any order alike.
pub struct NearLight {
    rows: usize,
    /// Of each column the rows that are drawn, and where their counts begin.
    columns: Vec<(Range<usize>, usize)>,
    /// Column after column.
    drawn: Vec<u16>,
    /// `None`: all pixels are drawn.
    dark: Option<Arc<DarkCounts>>,
    key: Key,
    /// Columns that were drawn as a whole.
    whole: Vec<OnceCell<Vec<u16>>>,
}

impl NearLight {
    /// Draws the dark pixels beside light; `lit` are the rows of each column from the first with light to the
    /// last, empty if there is none. The lit ones are to be [set](Self::set). `key` is the frame's.
    pub fn new(rows: usize, lit: &[Range<usize>], dark: Arc<DarkCounts>, key: Key) -> NearLight {
        let mut drawn = Vec::with_capacity(lit.len() * 4 * BESIDE);
        let mut add = |(column, lit): (usize, &Range<usize>)| {
            let near = match lit.is_empty() {
                true => 0..0,
                false => lit.start.saturating_sub(BESIDE)..(lit.end + BESIDE).min(rows),
            };
            let start = drawn.len();
            drawn.resize(start + near.len(), 0);
            let first = column * rows;
            let pixels = first + near.start..first + near.end;
            dark.draw(pixels, key.with(DARK), &mut drawn[start..]);
            (near, start)
        };
        NearLight {
            rows,
            columns: lit.iter().enumerate().map(&mut add).collect(),
            whole: vec![OnceCell::new(); lit.len()],
            drawn,
            dark: Some(dark),
            key,
        }
    }

    /// An image of which every pixel is drawn.
    pub fn of_all(image: Counts, key: Key) -> NearLight {
        let (columns, rows) = (image.columns(), image.rows());
        NearLight {
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

    /// Sets the count of a pixel that is drawn.
    pub fn set(&mut self, column: usize, row: usize, count: u16) {
        let (near, start) = &self.columns[column];
        self.drawn[start + row - near.start] = count;
    }

    /// The image with all its pixels drawn.
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

    /// Adds the counts of a column, all of them.
    fn draw(&self, column: usize, counts: &mut Vec<u16>) {
        let (near, start) = &self.columns[column];
        let first = counts.len();
        self.times(column, &mut |count, times| {
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

impl Columns for NearLight {
    fn columns(&self) -> usize {
        self.columns.len()
    }

    fn rows(&self) -> usize {
        self.rows
    }

    fn column(&self, column: usize) -> Column<'_> {
        let (near, start) = &self.columns[column];
        let drawn = &self.drawn[*start..][..near.len()];
        Column::partly(self.rows, (near.start, drawn), self, column)
    }
}

impl Undrawn for NearLight {
    fn times(&self, column: usize, mut is: &mut dyn FnMut(u16, u32)) {
        let Some(dark) = &self.dark else { return };
        let others = self.rows - self.columns[column].0.len();
        let key = self.key.with(COUNTED).with(column as u64);
        dark.times(others as u32, key, &mut is);
    }

    fn whole(&self, column: usize) -> &[u16] {
        self.whole[column].get_or_init(|| {
            let mut counts = Vec::with_capacity(self.rows);
            self.draw(column, &mut counts);
            counts
        })
    }
}

/// Puts values in an order of which all are equally likely, to 2⁻³² of their number (Durstenfeld 1964).
fn shuffle(values: &mut [u16], key: Key) {
    let mut left = values.len() as u64;
    while left > 1 {
        // Half of the bits of a number for each place.
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

    /// Of the values 0 to 19, put in order 40 000 times, each is equally often at each place, and so is each pair of
    /// values at the first two: 400 and 380 numbers of which 2000 and 105 are expected. χ² of k numbers has a
    /// mean of at most k and a standard deviation of √(2k); six of these on top are passed with a chance
    /// below 1e-6.
    #[test]
    fn all_orders_are_equally_likely() {
        let (values, times) = (20, 40_000);
        let (mut places, mut pairs) = (vec![0.0; 400], vec![0.0; 400]);
        for i in 0..times {
            let mut order: Vec<u16> = (0..values).collect();
            shuffle(&mut order, Key::new(3, Purpose::SensorNoise).with(i));
            for (place, &value) in order.iter().enumerate() {
                places[place * 20 + value as usize] += 1.0;
            }
            pairs[usize::from(order[0] * values + order[1])] += 1.0;
        }
        for (found, k) in [(places, 400.0), (pairs, 380.0)] {
            // Of k numbers alike, one is in each of k ways.
            let all: f64 = found.iter().sum();
            let off = |n: &f64| (n - all / k).powi(2) / (all / k);
            let chi2: f64 = found.iter().filter(|&&n| n > 0.0).map(off).sum();
            assert!(chi2 < k + 6.0 * f64::sqrt(2.0 * k), "{chi2} {k}");
        }
    }
}
