//! How wide lines are around a column: one column's own width is mostly speckle.

/// Columns to either side that tell how wide a line is.
const NEIGHBOURS: usize = 32;

/// Columns to either side that are next to one.
pub(super) const BESIDE: usize = 2;

/// Widths of lines, ready to be averaged around any column.
pub(super) struct Neighbourhood {
    /// Sum of the squares, and number, of the columns before.
    sums: Vec<(f64, usize)>,
}

impl Neighbourhood {
    /// Of (column, width) in a frame of `columns`, one a column at most.
    pub fn new(columns: usize, widths: impl Iterator<Item = (u32, f64)>) -> Neighbourhood {
        let mut sums = vec![(0.0, 0); columns + 1];
        for (column, width) in widths {
            sums[column as usize + 1] = (width * width, 1);
        }
        for i in 0..columns {
            let (sum, count) = sums[i];
            sums[i + 1].0 += sum;
            sums[i + 1].1 += count;
        }
        Neighbourhood { sums }
    }

    /// Number of the widths around a column, and their root mean square. The mean of a
    /// column's variance about its own centroid is the line's, to first order in
    /// speckle: what the centroid's scatter takes off, the ratio adds. A median would
    /// be some per cent short.
    pub fn around(&self, column: u32) -> (usize, Option<f64>) {
        self.within(column, NEIGHBOURS)
    }

    /// Of those next to it, where a line may end within a few columns.
    pub fn beside(&self, column: u32) -> Option<f64> {
        self.within(column, BESIDE).1
    }

    /// The same of the columns no further than `reach`.
    pub fn within(&self, column: u32, reach: usize) -> (usize, Option<f64>) {
        let column = column as usize;
        let from = self.sums[column.saturating_sub(reach)];
        let to = self.sums[(column + reach + 1).min(self.sums.len() - 1)];
        let count = to.1 - from.1;
        let mean = (to.0 - from.0).max(0.0) / count as f64;
        (count, (count > 0).then(|| mean.sqrt()))
    }
}
