//! Mean line width around a column. The width of a single column is dominated by speckle.

/// Number of columns on either side over which the line width is averaged.
const NEIGHBOURS: usize = 32;

/// Number of columns on either side that count as adjacent.
pub(super) const ADJACENT_COLUMNS: usize = 2;

/// Line widths with cumulative sums, for averages around any column.
pub(super) struct Neighbourhood {
    /// Sum of the squared widths, and number of widths, in the columns before.
    sums: Vec<(f64, usize)>,
}

impl Neighbourhood {
    /// Creates the sums from (column, width) pairs of a frame, at most one per column.
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

    /// Returns the number of widths around a column and their root mean square.
    ///
    /// To first order in speckle, the mean variance of a column about its centroid is the variance
    /// of the line. The scatter of the centroid reduces it by the amount that the ratio adds. A
    /// median would be a few per cent too small.
    pub fn around(&self, column: u32) -> (usize, Option<f64>) {
        self.within(column, NEIGHBOURS)
    }

    /// Returns the root mean square width of the adjacent columns, for lines that end within a few
    /// columns.
    pub fn adjacent_width(&self, column: u32) -> Option<f64> {
        self.within(column, ADJACENT_COLUMNS).1
    }

    /// Returns the number and the root mean square of the widths within `reach` columns.
    pub fn within(&self, column: u32, reach: usize) -> (usize, Option<f64>) {
        let column = column as usize;
        let from = self.sums[column.saturating_sub(reach)];
        let to = self.sums[(column + reach + 1).min(self.sums.len() - 1)];
        let count = to.1 - from.1;
        let mean = (to.0 - from.0).max(0.0) / count as f64;
        (count, (count > 0).then(|| mean.sqrt()))
    }
}
