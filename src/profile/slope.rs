//! Slope of a line between columns. On steep surfaces, a line climbs many rows within one column,
//! which elongates its image in the column.

use super::{Flags, Peak};

/// Gap between the lines of two adjacent columns, in line widths, above which they are separate
/// lines.
pub const JUMP_SIGMAS: f64 = 3.0;

/// Variance of the rows of a straight line in a column in which it climbs by one row, px².
pub(super) const VARIANCE_OF_A_CLIMB: f64 = 1.0 / 12.0;

/// Returns whether the lines of two adjacent columns are one line. `sigma` is the width of the
/// lines in the frame, px.
///
/// A line that climbs by H rows within a column extends by ±H/2 = ±√3·σ about its centroid. Here σ²
/// is the excess of its variance over the variance of the line. The extents of one line are
/// contiguous. A gap of [`JUMP_SIGMAS`] line widths is tolerated, because speckle changes both
/// extents.
pub(super) fn touching(a: &Peak, b: &Peak, sigma: f64) -> bool {
    let half = |peak: &Peak| 3f64.sqrt() * (peak.sigma.powi(2) - sigma.powi(2)).max(0.0).sqrt();
    let reach = (JUMP_SIGMAS * sigma + half(a) + half(b)).max(1.0);
    a.column + 1 == b.column && (a.row - b.row).abs() <= reach
}

/// Returns whether the line ends at a peak. `continues` states whether it continues in the columns
/// before and after. A line does not end at the border of the image, which has `columns` columns.
pub(super) fn is_end(peak: &Peak, continues: [bool; 2], columns: usize) -> bool {
    let at_border = [peak.column == 0, peak.column as usize + 1 == columns];
    (0..2).any(|side| !continues[side] && !at_border[side])
}

/// Returns the slope of the line at a peak, rows per column, from the available neighbours.
pub(super) fn slope(before: Option<&Peak>, peak: &Peak, after: Option<&Peak>) -> f64 {
    match (before, after) {
        (Some(before), Some(after)) => (after.row - before.row) / 2.0,
        (Some(before), None) => peak.row - before.row,
        (None, Some(after)) => after.row - peak.row,
        (None, None) => 0.0,
    }
}

/// Local geometry of an unbroken line at a column.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct LineSlope {
    /// Slope, rows per column.
    pub slope: f64,
    /// Difference of the slopes after and before the column, rows per column.
    pub bend: f64,
}

/// Returns slope and bend for the peaks of a frame, in the order of columns; both are zero for
/// peaks at an edge.
pub(super) fn runs(peaks: &[Peak]) -> Vec<LineSlope> {
    let run = |i: usize| {
        let peak = &peaks[i];
        if peak.flags.contains(Flags::DISCONTINUITY) {
            return LineSlope::default();
        }
        let beside = |other: &&Peak| other.column.abs_diff(peak.column) == 1;
        let before = i.checked_sub(1).map(|i| &peaks[i]).filter(beside);
        let after = peaks.get(i + 1).filter(beside);
        let bend = match (before, after) {
            (Some(before), Some(after)) => after.row - 2.0 * peak.row + before.row,
            _ => 0.0,
        };
        LineSlope {
            slope: slope(before, peak, after),
            bend,
        }
    };
    (0..peaks.len()).map(run).collect()
}
