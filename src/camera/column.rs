//! Image columns as input of the line detection.

use std::ops::Range;

/// An image that provides access to its columns.
pub trait ImageColumns {
    /// Returns the number of columns.
    fn columns(&self) -> usize;
    /// Returns the number of rows.
    fn rows(&self) -> usize;
    /// Returns the column with the given index.
    fn column(&self, column: usize) -> ColumnView<'_>;
}

/// Source of the pixels of a column whose individual counts have not been sampled.
pub trait LazyDarkPixels {
    /// Calls `is(count, times)` for every count that occurs among the unsampled pixels of `column`,
    /// in ascending order. `times` is the number of pixels with that count.
    fn histogram(&self, column: usize, is: &mut dyn FnMut(u16, u32));
    /// Returns the counts of all pixels of the column.
    fn materialise(&self, column: usize) -> &[u16];
}

/// Counts of a column.
///
/// Individual counts are available for a range of rows. For the other rows only a histogram of the
/// counts is known. Their individual counts are sampled when one of them is accessed.
#[derive(Clone, Copy)]
pub struct ColumnView<'a> {
    rows: usize,
    /// First row with individual counts.
    first: usize,
    drawn: &'a [u16],
    /// Source of the other rows and the column index; `None` if all rows have individual counts.
    undrawn_histogram: Option<(&'a dyn LazyDarkPixels, usize)>,
}

/// Column with individual counts for all rows.
impl<'a> From<&'a [u16]> for ColumnView<'a> {
    fn from(counts: &'a [u16]) -> ColumnView<'a> {
        ColumnView {
            rows: counts.len(),
            first: 0,
            drawn: counts,
            undrawn_histogram: None,
        }
    }
}

impl<'a> ColumnView<'a> {
    /// Creates column `column` of `rows` rows. The individual counts `drawn` belong to consecutive
    /// rows from `first` on.
    pub fn partly(
        rows: usize,
        (first, drawn): (usize, &'a [u16]),
        undrawn_histogram: &'a dyn LazyDarkPixels,
        column: usize,
    ) -> ColumnView<'a> {
        ColumnView {
            rows,
            first,
            drawn,
            undrawn_histogram: (drawn.len() < rows).then_some((undrawn_histogram, column)),
        }
    }

    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Returns the first row with individual counts, and these counts.
    pub fn drawn(&self) -> (usize, &'a [u16]) {
        (self.first, self.drawn)
    }

    /// Calls `is(count, times)` for every count that occurs among the rows without individual
    /// counts.
    pub fn undrawn_histogram(&self, is: &mut dyn FnMut(u16, u32)) {
        if let Some((others, column)) = self.undrawn_histogram {
            others.histogram(column, is);
        }
    }

    /// Returns the column with individual counts for all rows.
    pub fn materialise(&self) -> ColumnView<'a> {
        match self.undrawn_histogram {
            None => *self,
            Some((others, column)) => ColumnView::from(others.materialise(column)),
        }
    }

    /// Returns the count of a row.
    #[inline]
    pub fn at(&self, row: usize) -> u16 {
        match self.drawn.get(row.wrapping_sub(self.first)) {
            Some(&count) => count,
            None => self.materialise().drawn[row],
        }
    }

    /// Returns the counts of a range of rows.
    pub fn between(&self, rows: Range<usize>) -> &'a [u16] {
        let from = rows.start.wrapping_sub(self.first);
        match self.drawn.get(from..from.wrapping_add(rows.len())) {
            Some(counts) => counts,
            None => &self.materialise().drawn[rows],
        }
    }
}
