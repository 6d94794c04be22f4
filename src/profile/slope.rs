//! How a line runs from column to column. Where the surface is steep it climbs many rows
//! within one column, and what a column sees of it is long for no other reason.

use super::{Flags, Peak};

/// Two columns' lines are apart beyond this many line widths between their ends.
pub const JUMP_SIGMAS: f64 = 3.0;

/// Variance of the rows of a straight line over a column in which it climbs by one row.
pub(super) const VARIANCE_OF_A_CLIMB: f64 = 1.0 / 12.0;

/// Whether the lines of neighbouring columns are one line; `sigma` is the width of the
/// frame's lines, px.
///
/// A column's line that climbs by H rows is a stretch of ±H/2 = ±√3·σ about its centroid,
/// σ² being what its variance has more than the line's own. Stretches of one line meet;
/// there is room for [`JUMP_SIGMAS`] widths of the line between their ends, since speckle
/// makes both shorter or longer.
pub(super) fn touching(a: &Peak, b: &Peak, sigma: f64) -> bool {
    let half = |peak: &Peak| 3f64.sqrt() * (peak.sigma.powi(2) - sigma.powi(2)).max(0.0).sqrt();
    let reach = (JUMP_SIGMAS * sigma + half(a) + half(b)).max(1.0);
    a.column + 1 == b.column && (a.row - b.row).abs() <= reach
}

/// Rows a column that the line climbs at a peak, from the neighbours that are given.
pub(super) fn slope(before: Option<&Peak>, peak: &Peak, after: Option<&Peak>) -> f64 {
    match (before, after) {
        (Some(before), Some(after)) => (after.row - before.row) / 2.0,
        (Some(before), None) => peak.row - before.row,
        (None, Some(after)) => after.row - peak.row,
        (None, None) => 0.0,
    }
}

/// How an unbroken line runs at a column.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Run {
    /// Rows a column.
    pub slope: f64,
    /// Change of the slope from the column before to the one after.
    pub bend: f64,
}

/// The runs of a frame's peaks, in the order of columns; level where a peak is at an edge.
pub(super) fn runs(peaks: &[Peak]) -> Vec<Run> {
    let run = |i: usize| {
        let peak = &peaks[i];
        if peak.flags.contains(Flags::EDGE) {
            return Run::default();
        }
        let beside = |other: &&Peak| other.column.abs_diff(peak.column) == 1;
        let before = i.checked_sub(1).map(|i| &peaks[i]).filter(beside);
        let after = peaks.get(i + 1).filter(beside);
        let bend = match (before, after) {
            (Some(before), Some(after)) => after.row - 2.0 * peak.row + before.row,
            _ => 0.0,
        };
        Run {
            slope: slope(before, peak, after),
            bend,
        }
    };
    (0..peaks.len()).map(run).collect()
}
