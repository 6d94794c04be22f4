//! Line in a column, and its estimated position.

use super::background::Background;
use crate::camera::ColumnView;

/// Line detected in a column.
#[derive(Clone, Copy)]
pub(super) struct DetectedLine<'a> {
    pub column: ColumnView<'a>,
    pub background: Background,
    /// Row of the highest pixel; `height` is its height above background.
    pub top: usize,
    pub height: f64,
    /// Standard deviation, estimated from the width at half height, px.
    pub sigma: f64,
    pub max_count: u16,
}

/// Row and standard deviation of a line, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PeakEstimate {
    pub row: f64,
    pub sigma: f64,
}
