//! How wide lines are by their neighbourhood: one column's own width is mostly speckle.

use super::neighbourhood::Neighbourhood;
use super::slope::{Run, VARIANCE_OF_A_CLIMB};
use super::{Flags, Peak};

/// What a column's line is expected to be, by the lines around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Expected {
    /// Standard deviation, px.
    pub sigma: f64,
    /// Share of its variance that is the climb's within the column.
    pub climb: f64,
    /// Mean light of the lines around, counts.
    pub light: f64,
    /// Whether there are none around, and it is taken as it is.
    pub alone: bool,
}

/// Steepest line that tells how wide one without a climb is, rows a column: its climb
/// adds no more than a pixel does.
const LEVEL: f64 = 1.0;

/// What the lines without flags around each say it is; that they are saturated does not
/// matter. Its width is theirs, less their climbs and with its own; of level ones if there
/// are any. Without any, what itself is.
///
/// `None` where more than a tenth of the neighbours are flagged as wide: those left
/// are then the narrow ones of lines that are wider, and would give too small a width.
pub(super) fn expected(peaks: &[Peak], runs: &[Run]) -> Vec<Option<Expected>> {
    let columns = peaks.last().map_or(0, |p| p.column as usize + 1);
    let climb = |run: &Run| run.slope.powi(2) * VARIANCE_OF_A_CLIMB;
    let those = |chosen: &dyn Fn(&Peak, &Run) -> bool, of: &dyn Fn(&Peak, &Run) -> f64| {
        let chosen = peaks.iter().zip(runs).filter(|(p, run)| chosen(p, run));
        Neighbourhood::new(columns, chosen.map(|(p, run)| (p.column, of(p, run))))
    };
    let valid = |p: &Peak| {
        let other = Flags::OUTSIDE | Flags::SATURATED;
        p.flags.difference(other).is_empty()
    };
    let without_climb = |p: &Peak, run: &Run| (p.sigma.powi(2) - climb(run)).max(0.0).sqrt();
    let alike = those(&|p, _| valid(p), &without_climb);
    let level = those(
        &|p, run| valid(p) && run.slope.abs() <= LEVEL,
        &without_climb,
    );
    // At an edge, or narrow one and all: they say no more than how wide they are themselves.
    let doubtful = those(
        &|p, _| {
            valid(&Peak {
                flags: p.flags.difference(Flags::EDGE),
                ..*p
            })
        },
        &without_climb,
    );
    let wide = those(&|p, _| p.flags.contains(Flags::WIDE), &|p, _| p.sigma);
    // Means are of squares.
    let root = |p: &Peak, _: &Run| p.intensity.max(0.0).sqrt();
    let lights = those(&|p, _| valid(p), &root);
    let of = |(peak, run): (&Peak, &Run)| {
        let (count, width) = alike.around(peak.column);
        let (wider, _) = wide.around(peak.column);
        if 9 * wider > count {
            return None;
        }
        let Some(width) = level.around(peak.column).1.or(width) else {
            let width = doubtful.around(peak.column).1;
            let sigma = width.map(|width| (width * width + climb(run)).sqrt());
            return Some(Expected {
                sigma: sigma.unwrap_or(peak.sigma),
                climb: 0.0,
                light: peak.intensity,
                alone: true,
            });
        };
        let variance = width * width + climb(run);
        let light = lights.around(peak.column).1.unwrap_or(0.0).powi(2);
        Some(Expected {
            sigma: variance.sqrt(),
            climb: climb(run) / variance.max(f64::MIN_POSITIVE),
            light,
            alone: light <= 0.0,
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

    fn level(peaks: &[Peak]) -> Vec<Option<Expected>> {
        expected(peaks, &vec![Run::default(); peaks.len()])
    }

    /// A wide line at column 50 among narrower ones counts as wide as these; flagged
    /// ones do not count.
    #[test]
    fn a_width_is_that_of_the_neighbourhood() {
        let mut peaks: Vec<Peak> = (0..100).map(peak).collect();
        peaks[7].flags = Flags::WIDE;
        peaks[7].sigma = 1e3;
        for expected in level(&peaks) {
            // Fewest and most wide ones: 15 of the first 32 that count, 17 of the
            // last 33.
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

    /// A wall that climbs by 30 rows a column between two level lines of σ = 2 px: its
    /// columns are stretches of σ = √(4 + 900/12) px, the others' are as wide as they are.
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
