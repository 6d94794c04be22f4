//! The pixels of a frame that may see light, and the blocks in which the rays
//! through their centres are traced.

use crate::accel::WIDTH;
use glam::UVec2;

/// A set of pixels. Rays are traced by blocks of sixteen pixels of a row side by
/// side. Blocks are the same whatever is traced: Embree settles ties between
/// triangles by the order it meets them in, which depends on the other rays of the
/// packet.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pixels {
    pub columns: usize,
    pub rows: usize,
    words_per_row: usize,
    words: Vec<u64>,
}

impl Pixels {
    pub fn none(resolution: UVec2) -> Pixels {
        let [columns, rows] = resolution.to_array().map(|n| n as usize);
        let words_per_row = columns.div_ceil(64);
        Pixels {
            columns,
            rows,
            words_per_row,
            words: vec![0; words_per_row * rows],
        }
    }

    pub fn all(resolution: UVec2) -> Pixels {
        let mut pixels = Pixels::none(resolution);
        pixels.insert_all();
        pixels
    }

    pub fn insert_all(&mut self) {
        for row in 0..self.rows {
            self.insert(row, 0, self.columns - 1);
        }
    }

    /// Adds columns `first` to `last` of a row.
    pub fn insert(&mut self, row: usize, first: usize, last: usize) {
        let words = &mut self.words[row * self.words_per_row..][..self.words_per_row];
        for (word, bits) in (first / 64..).zip(&mut words[first / 64..=last / 64]) {
            let from = first.saturating_sub(64 * word);
            let to = (last - 64 * word).min(63);
            *bits |= (u64::MAX << from) & (u64::MAX >> (63 - to));
        }
    }

    fn row(&self, row: usize) -> &[u64] {
        &self.words[row * self.words_per_row..][..self.words_per_row]
    }

    /// Columns of a row's pixels, from left to right.
    pub fn of(&self, row: usize) -> impl Iterator<Item = usize> + '_ {
        let words = self.row(row).iter().enumerate();
        words.flat_map(|(word, &bits)| {
            let mut left = bits;
            std::iter::from_fn(move || {
                let bit = left.trailing_zeros() as usize;
                left &= left.wrapping_sub(1);
                (bit < 64).then_some(64 * word + bit)
            })
        })
    }

    /// First columns of the blocks of a row that hold a pixel of the set, or one
    /// within `around` (0 or 1) columns and rows of a pixel of the set.
    pub fn blocks(&self, row: usize, around: usize) -> impl Iterator<Item = usize> + '_ {
        let rows = row.saturating_sub(around)..(row + around + 1).min(self.rows);
        let word = move |i: usize| {
            let rows = rows.clone();
            rows.fold(0, |bits, row| bits | self.row(row)[i])
        };
        (0..self.words_per_row).flat_map(move |i| {
            let mut bits = word(i);
            if around > 0 {
                let before = if i > 0 { word(i - 1) } else { 0 };
                let after = match i + 1 < self.words_per_row {
                    true => word(i + 1),
                    false => 0,
                };
                bits |= bits << 1 | bits >> 1 | before >> 63 | after << 63;
            }
            let blocks = (0..64 / WIDTH).filter(move |k| bits >> (WIDTH * k) & 0xffff != 0);
            let first = blocks.map(move |k| 64 * i + WIDTH * k);
            first.filter(|&first| first < self.columns)
        })
    }

    /// Number of a row's pixels.
    pub fn count(&self, row: usize) -> usize {
        self.row(row).iter().map(|w| w.count_ones() as usize).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_inserted_is_there_and_nothing_else() {
        // 2100 columns: 33 words, 132 blocks, the last of four pixels.
        let resolution = UVec2::new(2100, 3);
        for (first, last) in [
            (0, 0),
            (15, 16),
            (1023, 1024),
            (500, 2099),
            (0, 2099),
            (2080, 2096),
            (2095, 2095),
        ] {
            let mut pixels = Pixels::none(resolution);
            pixels.insert(2, first, last);
            assert_eq!(
                pixels.of(2).collect::<Vec<_>>(),
                (first..=last).collect::<Vec<_>>()
            );
            assert_eq!(pixels.count(2), last - first + 1);
            assert!(pixels.count(0) == 0 && pixels.count(1) == 0);
            let blocks = |first: usize, last: usize| -> Vec<usize> {
                (first / 16..=last / 16).map(|b| 16 * b).collect()
            };
            let found = |row, around| pixels.blocks(row, around).collect::<Vec<_>>();
            assert_eq!(found(2, 0), blocks(first, last), "{first} {last}");
            let wider = blocks(first.saturating_sub(1), (last + 1).min(2099));
            assert_eq!(found(2, 1), wider, "{first} {last}");
            assert_eq!(found(1, 1), wider, "{first} {last}");
            assert!(found(1, 0).is_empty() && found(0, 1).is_empty());
        }
        let all = Pixels::all(resolution);
        assert_eq!((all.rows, all.columns, all.count(1)), (3, 2100, 2100));
        let one = Pixels::all(UVec2::ONE);
        assert_eq!(one.blocks(0, 1).collect::<Vec<_>>(), [0]);
    }
}
