//! A line in a column, and where it was found.

use super::background::Background;
use crate::camera::Column;

/// A line of a column, as it was detected.
#[derive(Clone, Copy)]
pub(super) struct Line<'a> {
    pub column: Column<'a>,
    pub background: Background,
    /// Row of the highest pixel, and its height above background.
    pub top: usize,
    pub height: f64,
    /// Standard deviation by the width at half height.
    pub sigma: f64,
    pub max_count: u16,
}

/// Row and standard deviation of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Located {
    pub row: f64,
    pub sigma: f64,
}
