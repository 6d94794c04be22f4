//! Pixels of a frame that may receive light, and the tiles in which their centre rays are traced.

use crate::accel::WIDTH;
use glam::{DVec2, UVec2};
use std::ops::Range;

/// Pixels along each side of a tile.
pub(super) const SIDE: usize = 4;
const _: () = assert!(SIDE * SIDE == WIDTH && 64 % SIDE == 0);

/// Columns per block.
pub(super) const BLOCK: usize = u64::BITS as usize;

/// Returns the centre of a pixel on the sensor.
pub(super) fn middle(column: usize, row: usize) -> DVec2 {
    DVec2::new(column as f64, row as f64) + 0.5
}

/// Pixel set as a bit mask. Rays are traced in tiles of 4 × 4 pixels, because sixteen pixels in one
/// row hit more triangles. Tiles do not depend on the set. Embree resolves ties between triangles
/// by traversal order, which depends on the other rays of the packet.
#[derive(Debug, Clone, PartialEq)]
pub struct PixelMask {
    pub(super) columns: usize,
    pub(super) rows: usize,
    words_per_row: usize,
    words: Vec<u64>,
}

impl PixelMask {
    /// Returns the empty set on a sensor of the given resolution.
    pub fn none(resolution: UVec2) -> PixelMask {
        let [columns, rows] = resolution.to_array().map(|n| n as usize);
        let words_per_row = columns.div_ceil(64);
        PixelMask {
            columns,
            rows,
            words_per_row,
            words: vec![0; words_per_row * rows],
        }
    }

    /// Returns all pixels of a sensor of the given resolution.
    pub fn all(resolution: UVec2) -> PixelMask {
        let mut pixels = PixelMask::none(resolution);
        pixels.insert_all();
        pixels
    }

    /// Adds every pixel.
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

    /// Removes all pixels outside these columns.
    pub fn keep_columns(&mut self, columns: &Range<usize>) {
        let below = |column: usize, word: usize| match column.saturating_sub(64 * word) {
            count if count < 64 => (1 << count) - 1,
            _ => u64::MAX,
        };
        for words in self.words.chunks_exact_mut(self.words_per_row) {
            for (i, word) in words.iter_mut().enumerate() {
                *word &= below(columns.end, i) & !below(columns.start, i);
            }
        }
    }

    /// Returns the range of columns that contain pixels of the set.
    pub fn span(&self) -> Option<Range<usize>> {
        let ends = (0..self.rows).filter_map(|row| {
            let words = self.row(row);
            let first = words.iter().position(|&bits| bits != 0)?;
            let last = words.iter().rposition(|&bits| bits != 0)?;
            let start = 64 * first + words[first].trailing_zeros() as usize;
            Some(start..64 * (last + 1) - words[last].leading_zeros() as usize)
        });
        ends.reduce(|a, b| a.start.min(b.start)..a.end.max(b.end))
    }

    fn row(&self, row: usize) -> &[u64] {
        &self.words[row * self.words_per_row..][..self.words_per_row]
    }

    /// Returns the columns of a row's pixels, from left to right.
    pub fn of(&self, row: usize) -> impl Iterator<Item = usize> + '_ {
        let words = self.row(row).iter().enumerate();
        words.flat_map(|(word, &bits)| ones(bits).map(move |bit| 64 * word + bit))
    }

    /// Returns the number of blocks of [`BLOCK`] columns; the last may be narrower.
    pub fn blocks(&self) -> usize {
        self.words_per_row
    }

    /// Returns the columns of a row's pixels in a block, from left to right.
    pub fn in_block(&self, row: usize, block: usize) -> impl Iterator<Item = usize> + '_ {
        ones(self.row(row)[block]).map(move |bit| BLOCK * block + bit)
    }

    /// Returns true if the set contains the pixel. `column` may be beyond the sensor.
    pub fn contains(&self, row: usize, column: usize) -> bool {
        column < self.columns && self.row(row)[column / BLOCK] >> (column % BLOCK) & 1 == 1
    }

    /// Returns the number of tile rows; the last may be lower.
    pub fn bands(&self) -> usize {
        self.rows.div_ceil(SIDE)
    }

    /// Returns the first columns of a tile row's tiles that contain a pixel of the set. Pixels
    /// within `around` (0 or 1) columns and rows of the set count too.
    pub fn tiles(&self, band: usize, around: usize) -> impl Iterator<Item = usize> + '_ {
        let first = SIDE * band;
        let rows = first.saturating_sub(around)..(first + SIDE + around).min(self.rows);
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
            // Reduces each group of four bits to its first bit, set if any of the four is set.
            bits |= bits >> 1;
            bits = (bits | bits >> 2) & 0x1111_1111_1111_1111;
            let first = ones(bits).map(move |bit| 64 * i + bit);
            first.filter(|&first| first < self.columns)
        })
    }

    /// Returns a bit mask of the set's pixels in a row, from `column` to the end of its tile.
    fn in_tile(&self, row: usize, column: usize) -> u64 {
        self.row(row)[column / 64] >> (column % 64) & 0xf
    }

    /// Returns a bit mask of the pixels in a tile that are in the set. Pixels within `around` (0 or
    /// 1) columns and rows of the set count too.
    pub fn near_in_tile(&self, band: usize, first: usize, around: usize) -> u16 {
        let top = SIDE * band;
        let rows = top.saturating_sub(around)..(top + SIDE + around).min(self.rows);
        if around == 0 {
            let own = rows.map(|row| self.in_tile(row, first) << (SIDE * (row - top)));
            return own.sum::<u64>() as u16;
        }
        rows.fold(0, |bits, row| {
            let mut near = self.in_tile(row, first);
            let beside = |column: usize| self.row(row)[column / 64] >> (column % 64) & 1;
            near |= near << 1 | near >> 1;
            if first > 0 {
                near |= beside(first - 1);
            }
            if first + SIDE < self.columns {
                near |= beside(first + SIDE) << (SIDE - 1);
            }
            let near = (near & 0xf) as u16;
            // Limits the surrounding rows to the rows of the tile.
            let from = row.saturating_sub(around).max(top) - top;
            let to = (row + around).min(top + SIDE - 1) - top;
            (from..=to).fold(bits, |bits, row| bits | near << (SIDE * row))
        })
    }

    /// Returns the number of pixels in a row.
    pub fn count(&self, row: usize) -> usize {
        self.row(row).iter().map(|w| w.count_ones() as usize).sum()
    }
}

/// Pixel set whose pixels are numbered row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PixelNumbering {
    pub pixels: PixelMask,
    /// Index of the first pixel of each row, followed by the total number.
    starts: Vec<usize>,
    /// Number of pixels of the row before each word.
    before: Vec<u32>,
}

impl PixelNumbering {
    pub fn new(pixels: PixelMask) -> PixelNumbering {
        let mut starts = Vec::with_capacity(pixels.rows + 1);
        let mut before = Vec::with_capacity(pixels.words.len());
        let mut end = 0;
        for words in pixels.words.chunks_exact(pixels.words_per_row) {
            starts.push(end);
            let mut count = 0;
            for word in words {
                before.push(count);
                count += word.count_ones();
            }
            end += count as usize;
        }
        starts.push(end);
        PixelNumbering {
            pixels,
            starts,
            before,
        }
    }

    /// Returns the index of a row's first pixel.
    pub fn start(&self, row: usize) -> usize {
        self.starts[row]
    }

    /// Returns the index of a pixel; `None` if it is not in the set.
    pub fn number(&self, row: usize, column: usize) -> Option<usize> {
        let (word, bit) = (
            row * self.pixels.words_per_row + column / BLOCK,
            column % BLOCK,
        );
        let bits = self.pixels.words[word];
        let before = self.before[word] + (bits & ((1 << bit) - 1)).count_ones();
        (bits >> bit & 1 == 1).then(|| self.starts[row] + before as usize)
    }

    /// Returns the indices of a row's pixels.
    pub fn range(&self, row: usize) -> Range<usize> {
        self.starts[row]..self.starts[row + 1]
    }

    pub fn total(&self) -> usize {
        self.starts[self.pixels.rows]
    }
}

/// Returns the indices of the bits that are set.
fn ones(mut bits: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = bits.trailing_zeros() as usize;
        bits &= bits.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_that_are_kept_are_those_of_the_range() {
        for (low, high) in [(0, 1), (60, 70), (64, 128), (5, 2100), (2063, 2064), (7, 7)] {
            let mut pixels = PixelMask::all(UVec2::new(2100, 3));
            pixels.keep_columns(&(low..high));
            let found: Vec<usize> = pixels.of(1).collect();
            assert_eq!(found, (low..high).collect::<Vec<_>>());
            let by_block = (0..pixels.blocks()).flat_map(|block| pixels.in_block(1, block));
            assert!(by_block.eq(found));
            let span = (low < high).then_some(low..high);
            assert_eq!(pixels.span(), span);
        }
        let mut pixels = PixelMask::none(UVec2::new(300, 4));
        pixels.insert(1, 70, 80);
        pixels.insert(3, 130, 290);
        assert_eq!(pixels.span(), Some(70..291));
    }

    #[test]
    fn what_is_inserted_is_there_and_nothing_else() {
        // 2100 columns: 33 words, 525 tiles; nine rows: three tile rows, the last with a single
        // row.
        let resolution = UVec2::new(2100, 9);
        for (first, last) in [
            (0, 0),
            (15, 16),
            (1023, 1024),
            (500, 2099),
            (0, 2099),
            (2080, 2096),
            (2095, 2095),
        ] {
            let mut pixels = PixelMask::none(resolution);
            pixels.insert(4, first, last);
            assert_eq!(
                pixels.of(4).collect::<Vec<_>>(),
                (first..=last).collect::<Vec<_>>()
            );
            assert_eq!(pixels.count(4), last - first + 1);
            assert!(pixels.count(0) == 0 && pixels.count(1) == 0);
            let tiles = |first: usize, last: usize| -> Vec<usize> {
                (first / SIDE..=last / SIDE).map(|b| SIDE * b).collect()
            };
            let found = |band, around| pixels.tiles(band, around).collect::<Vec<_>>();
            assert_eq!(found(1, 0), tiles(first, last), "{first} {last}");
            let wider = tiles(first.saturating_sub(1), (last + 1).min(2099));
            assert_eq!(found(1, 1), wider, "{first} {last}");
            assert_eq!(found(0, 1), wider, "{first} {last}");
            assert!(found(0, 0).is_empty() && found(2, 1).is_empty());
            let near = |band, column, around| pixels.near_in_tile(band, column, around);
            for column in (0..2100).step_by(SIDE) {
                for (band, around) in [(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)] {
                    let is = |bit: usize| {
                        let (x, y) = (column + bit % SIDE, SIDE * band + bit / SIDE);
                        let columns = first.saturating_sub(around)..=last + around;
                        columns.contains(&x) && y.abs_diff(4) <= around
                    };
                    let expected = (0..WIDTH).fold(0, |bits, bit| bits | (is(bit) as u16) << bit);
                    let found = near(band, column, around);
                    assert_eq!(found, expected, "{first} {last} {band} {column} {around}");
                }
            }
            let bits =
                (first..=last.min(first / SIDE * SIDE + 3)).fold(0, |b, c| b | 1 << (c % SIDE));
            assert_eq!(pixels.in_tile(4, first / SIDE * SIDE), bits);
        }
        let all = PixelMask::all(resolution);
        assert_eq!(all.bands(), 3);
        assert_eq!((all.rows, all.columns, all.count(1)), (9, 2100, 2100));
        let one = PixelMask::all(UVec2::ONE);
        assert_eq!(one.tiles(0, 1).collect::<Vec<_>>(), [0]);
    }
}
