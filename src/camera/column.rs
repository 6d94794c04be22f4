//! A column of an image as the search for lines sees it.

use std::ops::Range;

/// An image that gives its columns.
pub trait Columns {
    /// Number of columns.
    fn columns(&self) -> usize;
    /// Number of rows.
    fn rows(&self) -> usize;
    /// The column with this number.
    fn column(&self, column: usize) -> Column<'_>;
}

/// What of a column is not drawn.
pub trait Undrawn {
    /// How often each count is there in column number `column`: `is(count, times)` for each that is, from
    /// the lowest on.
    fn times(&self, column: usize, is: &mut dyn FnMut(u16, u32));
    /// The column's counts, all of them.
    fn whole(&self, column: usize) -> &[u16];
}

/// Counts of a column. Some rows are drawn, and of the others it is known how often each count is there;
/// these are drawn too when one of them is asked for.
#[derive(Clone, Copy)]
pub struct Column<'a> {
    rows: usize,
    /// Of the first that is drawn.
    first: usize,
    drawn: &'a [u16],
    /// With the column's number; `None`: all is drawn.
    others: Option<(&'a dyn Undrawn, usize)>,
}

/// All counts of a column.
impl<'a> From<&'a [u16]> for Column<'a> {
    fn from(counts: &'a [u16]) -> Column<'a> {
        Column {
            rows: counts.len(),
            first: 0,
            drawn: counts,
            others: None,
        }
    }
}

impl<'a> Column<'a> {
    /// Column number `column` of `rows` rows, of which those from row `first` on are drawn, so many as there
    /// are counts.
    pub fn partly(
        rows: usize,
        (first, drawn): (usize, &'a [u16]),
        others: &'a dyn Undrawn,
        column: usize,
    ) -> Column<'a> {
        Column {
            rows,
            first,
            drawn,
            others: (drawn.len() < rows).then_some((others, column)),
        }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The row of the first count that is drawn, and those that are.
    pub fn drawn(&self) -> (usize, &'a [u16]) {
        (self.first, self.drawn)
    }

    /// How often each count is among those that are not drawn.
    pub fn others(&self, is: &mut dyn FnMut(u16, u32)) {
        if let Some((others, column)) = self.others {
            others.times(column, is);
        }
    }

    /// The same with all its counts drawn.
    pub fn whole(&self) -> Column<'a> {
        match self.others {
            None => *self,
            Some((others, column)) => Column::from(others.whole(column)),
        }
    }

    /// The count of a row.
    #[inline]
    pub fn at(&self, row: usize) -> u16 {
        match self.drawn.get(row.wrapping_sub(self.first)) {
            Some(&count) => count,
            None => self.whole().drawn[row],
        }
    }

    /// The counts of rows of the column.
    pub fn between(&self, rows: Range<usize>) -> &'a [u16] {
        let from = rows.start.wrapping_sub(self.first);
        match self.drawn.get(from..from.wrapping_add(rows.len())) {
            Some(counts) => counts,
            None => &self.whole().drawn[rows],
        }
    }
}
