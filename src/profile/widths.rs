//! Expected line width from the neighbourhood. The width of a single column is dominated by
//! speckle.

use super::neighbourhood::Neighbourhood;
use super::slope::{LineSlope, VARIANCE_OF_A_CLIMB};
use super::{Flags, Peak};

/// Expected properties of the line in a column, from the surrounding lines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ExpectedLine {
    /// Standard deviation, px.
    pub sigma: f64,
    /// Fraction of the variance that is caused by the slope within the column.
    pub slope_rows_per_column: f64,
    /// Mean light of the surrounding lines, counts.
    pub light: f64,
    /// True if no surrounding lines exist and the properties of the line itself are used.
    pub is_isolated: bool,
}

/// Maximum slope, rows per column, of lines that define the width of a level line. The variance
/// added by such a slope is at most the variance of pixel integration.
const LEVEL: f64 = 1.0;

/// Returns the expected line of each column from the surrounding lines without flags.
///
/// Saturated lines are included. The width is the mean width of the surrounding lines after
/// subtraction of their slopes, plus the slope of the line itself. Level lines are preferred. If no
/// surrounding lines exist, the measured properties of the line are used.
///
/// Returns `None` where more than a tenth of the neighbours have the flag for wide lines. The
/// unflagged lines are then the narrow part of a distribution of wider lines, and their mean is too
/// small.
pub(super) fn expected(peaks: &[Peak], runs: &[LineSlope]) -> Vec<Option<ExpectedLine>> {
    let columns = peaks.last().map_or(0, |p| p.column as usize + 1);
    let climb = |run: &LineSlope| run.slope.powi(2) * VARIANCE_OF_A_CLIMB;
    let those = |chosen: &dyn Fn(&Peak, &LineSlope) -> bool,
                 of: &dyn Fn(&Peak, &LineSlope) -> f64| {
        let chosen = peaks.iter().zip(runs).filter(|(p, run)| chosen(p, run));
        Neighbourhood::new(columns, chosen.map(|(p, run)| (p.column, of(p, run))))
    };
    let valid = |p: &Peak| {
        let other = Flags::UNCERTAINTY_NOT_VALID | Flags::SATURATED;
        p.flags.difference(other).is_empty()
    };
    let without_climb = |p: &Peak, run: &LineSlope| (p.sigma.powi(2) - climb(run)).max(0.0).sqrt();
    let alike = those(&|p, _| valid(p), &without_climb);
    let level = those(
        &|p, run| valid(p) && run.slope.abs() <= LEVEL,
        &without_climb,
    );
    // Lines at an edge, including narrow lines. They are only used for their own mean width.
    let doubtful = those(
        &|p, _| {
            valid(&Peak {
                flags: p.flags.difference(Flags::DISCONTINUITY),
                ..*p
            })
        },
        &without_climb,
    );
    let wide = those(&|p, _| p.flags.contains(Flags::WIDE), &|p, _| p.sigma);
    // `Neighbourhood` averages squares.
    let root = |p: &Peak, _: &LineSlope| p.intensity.max(0.0).sqrt();
    let lights = those(&|p, _| valid(p), &root);
    let of = |(peak, run): (&Peak, &LineSlope)| {
        let (count, width) = alike.around(peak.column);
        let (wider, _) = wide.around(peak.column);
        if 9 * wider > count {
            return None;
        }
        let Some(width) = level.around(peak.column).1.or(width) else {
            let width = doubtful.around(peak.column).1;
            let sigma = width.map(|width| (width * width + climb(run)).sqrt());
            return Some(ExpectedLine {
                sigma: sigma.unwrap_or(peak.sigma),
                slope_rows_per_column: 0.0,
                light: peak.intensity,
                is_isolated: true,
            });
        };
        let variance = width * width + climb(run);
        let light = lights.around(peak.column).1.unwrap_or(0.0).powi(2);
        Some(ExpectedLine {
            sigma: variance.sqrt(),
            slope_rows_per_column: climb(run) / variance.max(f64::MIN_POSITIVE),
            light,
            is_isolated: light <= 0.0,
        })
    };
    peaks.iter().zip(runs).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peak(column: u32) -> Peak {
        Peak {
            column,
            row: 10.0,
            intensity: 1e3,
            height: 100.0,
            sigma: if column.is_multiple_of(2) { 3.0 } else { 5.0 },
            noise: 1.0,
            flags: Flags::empty(),
        }
    }

    fn level(peaks: &[Peak]) -> Vec<Option<ExpectedLine>> {
        expected(peaks, &vec![LineSlope::default(); peaks.len()])
    }

    /// The expected width of a wide line at column 50 is the width of its narrower neighbours.
    /// Flagged lines do not contribute.
    #[test]
    fn a_width_is_that_of_the_neighbourhood() {
        let mut peaks: Vec<Peak> = (0..100).map(peak).collect();
        peaks[7].flags = Flags::WIDE;
        peaks[7].sigma = 1e3;
        for expected in level(&peaks) {
            // Minimum and maximum number of wide lines: 15 of the first 32 that contribute, and 17
            // of the last 33.
            let square = expected.unwrap().sigma.powi(2);
            assert!((16.49..=17.25).contains(&square), "{square}");
        }
        for peak in &mut peaks[60..70] {
            peak.flags = Flags::WIDE;
        }
        let widths = level(&peaks);
        assert!(widths[65].is_none() && widths[20].is_some());
        assert_eq!(level(&[]), []);
    }

    /// A wall of 30 rows per column between two level lines of σ = 2 px. The expected width is
    /// σ = √(4 + 900/12) px in its columns and 2 px in the other columns.
    #[test]
    fn a_climb_widens_its_own_columns() {
        let line = |column: u32| {
            let climbed = (column as f64 - 40.0).clamp(0.0, 10.0);
            let steep = (1.0..10.0).contains(&climbed);
            Peak {
                row: 30.0 * climbed,
                sigma: if steep { 79f64.sqrt() } else { 2.0 },
                ..peak(column)
            }
        };
        let peaks: Vec<Peak> = (0..90).map(line).collect();
        let expected = expected(&peaks, &super::super::slope::runs(&peaks));
        for (peak, expected) in peaks.iter().zip(expected) {
            // The line bends in columns 40 and 50.
            if ![40, 50].contains(&peak.column) {
                let sigma = expected.unwrap().sigma;
                assert!((sigma / peak.sigma - 1.0).abs() < 1e-9, "{peak:?} {sigma}");
            }
        }
    }
}
