//! Image of sensor counts.

use super::column::{ColumnView, ImageColumns};
use wide::u16x8;

/// Counts of a sensor's pixels. Storage is column-major because lines are detected per column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Counts {
    rows: usize,
    by_column: Vec<u16>,
}

impl Counts {
    /// Creates an image with equal counts; it must have at least one column and one row.
    pub fn filled(columns: usize, rows: usize, count: u16) -> Counts {
        Counts::of_columns(vec![count; columns * rows], rows)
    }

    /// Creates an image from counts in column-major order.
    pub fn of_columns(by_column: Vec<u16>, rows: usize) -> Counts {
        assert!(rows > 0 && !by_column.is_empty(), "an image has pixels");
        assert!(by_column.len().is_multiple_of(rows), "columns are whole");
        Counts { rows, by_column }
    }

    /// Creates an image from counts in row-major order, the order of image files.
    pub fn of_rows(counts: &[u16], columns: usize) -> Counts {
        Counts {
            rows: counts.len() / columns,
            by_column: transposed(counts, columns),
        }
    }

    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Returns the number of columns.
    pub fn columns(&self) -> usize {
        self.by_column.len() / self.rows
    }

    /// Returns the counts of a column, starting with the first row.
    pub fn column(&self, column: usize) -> &[u16] {
        &self.by_column[column * self.rows..][..self.rows]
    }

    /// Returns the counts in row-major order.
    pub fn to_rows(&self) -> Vec<u16> {
        transposed(&self.by_column, self.rows)
    }

    /// Returns the counts in column-major order.
    pub fn by_column(&self) -> &[u16] {
        &self.by_column
    }

    /// Converts the image into its counts in column-major order without copying them.
    pub fn into_by_column(self) -> Vec<u16> {
        self.by_column
    }

    /// Returns the counts in column-major order, mutable.
    pub fn by_column_mut(&mut self) -> &mut [u16] {
        &mut self.by_column
    }
}

impl ImageColumns for Counts {
    fn columns(&self) -> usize {
        Counts::columns(self)
    }

    fn rows(&self) -> usize {
        Counts::rows(self)
    }

    fn column(&self, column: usize) -> ColumnView<'_> {
        ColumnView::from(Counts::column(self, column))
    }
}

/// Rows and columns of a block that is transposed at once.
const TILE: usize = 8;

/// Converts counts from row-major to column-major order.
fn transposed(counts: &[u16], columns: usize) -> Vec<u16> {
    let rows = counts.len() / columns;
    let mut by_column = vec![0; counts.len()];
    let turn = |band: &[u16], first: usize, width: usize| {
        let mut tile = [u16x8::ZERO; TILE];
        for (lanes, row) in tile.iter_mut().zip(band.chunks_exact(columns)) {
            lanes.as_mut_array()[..width].copy_from_slice(&row[first..first + width]);
        }
        u16x8::transpose(tile)
    };
    for (i, band) in counts.chunks(columns * TILE).enumerate() {
        let height = band.len() / columns;
        for first in (0..columns).step_by(TILE) {
            let width = TILE.min(columns - first);
            // With a width known at compile time, rows are copied as vectors.
            let turned = match width {
                TILE => turn(band, first, TILE),
                _ => turn(band, first, width),
            };
            for (column, lanes) in (first..first + width).zip(turned) {
                let to = &mut by_column[column * rows + i * TILE..][..height];
                to.copy_from_slice(&lanes.as_array()[..height]);
            }
        }
    }
    by_column
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Transposing twice restores the image, for complete tiles and for partial tiles at the
    /// border.
    #[test]
    fn columns_are_those_of_the_rows_and_turn_back_into_them() {
        for (columns, rows) in [(1, 1), (1, 9), (8, 8), (17, 5), (9, 24), (64, 31)] {
            let counts: Vec<u16> = (0..columns * rows).map(|i| i as u16).collect();
            let image = Counts::of_rows(&counts, columns);
            assert_eq!((image.columns(), image.rows()), (columns, rows));
            for column in 0..columns {
                let expected: Vec<u16> = (0..rows)
                    .map(|row| (row * columns + column) as u16)
                    .collect();
                assert_eq!(image.column(column), expected);
            }
            assert_eq!(image.to_rows(), counts);
        }
    }
}
