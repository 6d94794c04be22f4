//! The samples of a frame in blocks, the unit in which they are traced.

use crate::accel::WIDTH;
use glam::UVec2;

/// A set of blocks. The samples of a sensor form sub-rows, `samples_per_side` to
/// a row of pixels and as many samples to a pixel; a block is sixteen samples of
/// a sub-row side by side. Blocks are the same whatever is traced: Embree settles
/// ties between triangles by the order it meets them in, which depends on the
/// other rays of the packet.
pub(super) struct Blocks {
    pub sub_rows: usize,
    /// Samples of a sub-row.
    pub samples: usize,
    words_per_row: usize,
    words: Vec<u64>,
}

impl Blocks {
    pub fn none(resolution: UVec2, samples_per_side: u32) -> Blocks {
        let sub_rows = resolution.y as usize * samples_per_side as usize;
        let samples = resolution.x as usize * samples_per_side as usize;
        let words_per_row = samples.div_ceil(WIDTH).div_ceil(64);
        Blocks {
            sub_rows,
            samples,
            words_per_row,
            words: vec![0; words_per_row * sub_rows],
        }
    }

    pub fn all(resolution: UVec2, samples_per_side: u32) -> Blocks {
        let mut blocks = Blocks::none(resolution, samples_per_side);
        blocks.insert_all();
        blocks
    }

    pub fn insert_all(&mut self) {
        for sub_row in 0..self.sub_rows {
            self.insert(sub_row, 0, self.samples - 1);
        }
    }

    /// Adds the blocks of samples `first` to `last` of a sub-row.
    pub fn insert(&mut self, sub_row: usize, first: usize, last: usize) {
        let (first, last) = (first / WIDTH, last / WIDTH);
        let row = &mut self.words[sub_row * self.words_per_row..][..self.words_per_row];
        for (word, bits) in (first / 64..).zip(&mut row[first / 64..=last / 64]) {
            let from = first.saturating_sub(64 * word);
            let to = (last - 64 * word).min(63);
            *bits |= (u64::MAX << from) & (u64::MAX >> (63 - to));
        }
    }

    /// The first samples of a sub-row's blocks in the set, from left to right.
    pub fn of(&self, sub_row: usize) -> impl Iterator<Item = usize> + '_ {
        let row = &self.words[sub_row * self.words_per_row..][..self.words_per_row];
        row.iter().enumerate().flat_map(|(word, &bits)| {
            let mut left = bits;
            std::iter::from_fn(move || {
                let bit = left.trailing_zeros() as usize;
                left &= left.wrapping_sub(1);
                (bit < 64).then_some((64 * word + bit) * WIDTH)
            })
        })
    }

    /// Number of blocks in the set.
    #[cfg(test)]
    pub fn count(&self) -> usize {
        self.words.iter().map(|w| w.count_ones() as usize).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_inserted_is_there_and_nothing_else() {
        // 2100 samples: 132 blocks, three words, the last block of four samples.
        let resolution = UVec2::new(1050, 2);
        for (first, last) in [
            (0, 0),
            (15, 16),
            (1023, 1024),
            (500, 2099),
            (0, 2099),
            (2080, 2096),
        ] {
            let mut blocks = Blocks::none(resolution, 2);
            blocks.insert(2, first, last);
            let expected: Vec<usize> = (first / 16..=last / 16).map(|b| 16 * b).collect();
            assert_eq!(blocks.of(2).collect::<Vec<_>>(), expected, "{first} {last}");
            assert_eq!(blocks.count(), expected.len());
        }
        let all = Blocks::all(resolution, 2);
        assert_eq!((all.sub_rows, all.samples, all.count()), (4, 2100, 4 * 132));
        assert_eq!(Blocks::all(UVec2::ONE, 1).of(0).collect::<Vec<_>>(), [0]);
    }
}
