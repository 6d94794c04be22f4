//! Detection of lines caused by indirect light. After two or more hits on the part, light forms a
//! line or a glow where the laser plane does not intersect a surface.
//!
//! The test uses one image only. A spurious line usually occurs in the same columns as the line
//! that causes it or another line. Light reflected by a rough surface is wider than the laser line.
//! The spurious line ends at the end of the reflecting wall, while the true line continues. Lines
//! are therefore tracked across columns. A line is suspected if a second line in its columns has
//! the expected width and meets one of two conditions. Either it is much narrower, or it is more
//! often the only line in its columns.

use super::{Flags, Peak};
use std::collections::BTreeMap;

/// Ratio of widths above which a line is wider than another.
///
/// The widths of two equal lines, each averaged over [`AVERAGING_COLUMNS`] columns, vary by 10 %
/// due to speckle. Their ratio exceeds the limit once in 10⁴ cases (3.7 standard deviations of the
/// ratio, 14 %).
const WIDTH_RATIO: f64 = 1.5;
/// Number of columns on either side over which widths are averaged.
const AVERAGING_COLUMNS: usize = 16;
/// Maximum number of missing columns within a track; speckle may darken single columns.
const MAX_GAP_COLUMNS: u32 = 3;
/// Maximum row difference between consecutive columns of a track, in line widths σ (at least 1 px).
const MAX_TRACK_JUMP_SIGMAS: f64 = 3.0;
/// Minimum number of columns of a track that is compared with others. A shorter track may be a
/// grain.
const MIN_TRACK_COLUMNS: usize = 8;

/// Line in a column that was not selected as the peak.
#[derive(Debug, Clone, Copy)]
pub(super) struct SecondaryPeak {
    pub column: u32,
    pub row: f64,
    /// Standard deviation, px.
    pub sigma: f64,
}

/// Line in one column.
#[derive(Clone, Copy)]
struct TrackPoint {
    column: u32,
    row: f64,
    sigma: f64,
    /// Index of the peak; `None` if the line was not selected.
    peak: Option<usize>,
    /// True if the column has no other line.
    is_only_peak: bool,
}

/// Line tracked over columns.
#[derive(Default)]
struct Track {
    seen: Vec<TrackPoint>,
    /// Cumulative sums of squared widths; entry i is the sum over the first i columns.
    squares: Vec<f64>,
}

impl Track {
    fn push(&mut self, seen: TrackPoint) {
        let sum = self.squares.last().copied().unwrap_or(0.0);
        if self.squares.is_empty() {
            self.squares.push(0.0);
        }
        self.squares.push(sum + seen.sigma * seen.sigma);
        self.seen.push(seen);
    }

    /// Returns the root mean square width around the column at index `at`.
    fn sigma(&self, at: usize) -> f64 {
        let (from, to) = (
            at.saturating_sub(AVERAGING_COLUMNS),
            (at + AVERAGING_COLUMNS + 1).min(self.seen.len()),
        );
        ((self.squares[to] - self.squares[from]) / (to - from) as f64).sqrt()
    }

    /// Returns the fraction of the columns without another line.
    fn unpaired_fraction(&self) -> f64 {
        let alone = self.seen.iter().filter(|seen| seen.is_only_peak).count();
        alone as f64 / self.seen.len() as f64
    }
}

/// Sets [`Flags::SUSPECTED_REFLECTION`] for the peaks of a frame.
///
/// `peaks` and the other lines in `others` are in the order of columns. `expected_sigma` is the
/// expected width, px. If it is 0, the median width of lines without another line in the column is
/// used.
pub(super) fn flag(peaks: &mut [Peak], others: &[SecondaryPeak], expected_sigma: f64) {
    if others.is_empty() {
        return;
    }
    let tracks = tracks(peaks, others);
    let expected = match expected_sigma > 0.0 {
        true => expected_sigma,
        false => super::flags::median(
            (tracks.iter().flat_map(|track| &track.seen))
                .filter(|seen| seen.is_only_peak)
                .map(|seen| seen.sigma),
        ),
    };
    // For each column, the tracks that contain it and the index within the track.
    let mut columns: BTreeMap<u32, Vec<(usize, usize)>> = BTreeMap::new();
    for (track, at) in
        (tracks.iter().enumerate()).flat_map(|(i, t)| (0..t.seen.len()).map(move |at| (i, at)))
    {
        let column = tracks[track].seen[at].column;
        columns.entry(column).or_default().push((track, at));
    }
    let alone: Vec<f64> = tracks.iter().map(Track::unpaired_fraction).collect();
    let mut doubted = vec![0; tracks.len()];
    for of_column in columns.values().filter(|of_column| of_column.len() > 1) {
        for &(own, at) in of_column {
            let sigma = tracks[own].sigma(at);
            let is_ghost = of_column.iter().any(|&(other, there)| {
                let beside = tracks[other].sigma(there);
                let tells = other != own
                    && tracks[other].seen.len() >= MIN_TRACK_COLUMNS
                    && beside <= WIDTH_RATIO * expected.max(f64::MIN_POSITIVE);
                let wider = sigma > WIDTH_RATIO * beside.max(expected);
                let comes_and_goes = 2.0 * alone[own] < alone[other];
                tells && (wider || comes_and_goes)
            });
            if is_ghost {
                doubted[own] += 1;
                if let Some(peak) = tracks[own].seen[at].peak {
                    peaks[peak].flags.insert(Flags::SUSPECTED_REFLECTION);
                }
            }
        }
    }
    // The continuation of a suspected line into columns without the other line is suspected too.
    for (track, doubted) in tracks.iter().zip(doubted) {
        if 2 * doubted > track.seen.len() {
            for peak in track.seen.iter().filter_map(|seen| seen.peak) {
                peaks[peak].flags.insert(Flags::SUSPECTED_REFLECTION);
            }
        }
    }
}

/// Returns the tracks of a frame. Nearest pairs in consecutive columns are connected first.
fn tracks(peaks: &[Peak], others: &[SecondaryPeak]) -> Vec<Track> {
    let mut tracks: Vec<Track> = Vec::new();
    // Tracks that may continue.
    let mut open: Vec<usize> = Vec::new();
    let mut rest = others;
    for (number, peak) in peaks.iter().enumerate() {
        let count = rest
            .iter()
            .take_while(|other| other.column == peak.column)
            .count();
        let (beside, later) = rest.split_at(count);
        rest = later;
        let seen = |row, sigma, number| TrackPoint {
            column: peak.column,
            row,
            sigma,
            peak: number,
            is_only_peak: count == 0,
        };
        let mut lines = vec![seen(peak.row, peak.sigma, Some(number))];
        lines.extend(
            beside
                .iter()
                .map(|other| seen(other.row, other.sigma, None)),
        );
        open.retain(|&track| {
            let last = tracks[track].seen.last();
            last.is_some_and(|last| last.column + MAX_GAP_COLUMNS + 1 >= peak.column)
        });
        let mut pairs = Vec::new();
        for (i, line) in lines.iter().enumerate() {
            for &track in &open {
                let last = tracks[track].seen[tracks[track].seen.len() - 1];
                let off = (line.row - last.row).abs();
                if off <= MAX_TRACK_JUMP_SIGMAS * line.sigma.max(last.sigma).max(1.0) {
                    pairs.push((off, i, track));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut taken: Vec<Option<usize>> = vec![None; lines.len()];
        for (_, i, track) in pairs {
            if taken[i].is_none() && !taken.contains(&Some(track)) {
                taken[i] = Some(track);
            }
        }
        for (line, track) in lines.into_iter().zip(taken) {
            let track = track.unwrap_or_else(|| {
                tracks.push(Track::default());
                open.push(tracks.len() - 1);
                tracks.len() - 1
            });
            tracks[track].push(line);
        }
    }
    tracks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Counts;
    use crate::profile::{PeakSettings, find_peaks};

    /// Returns an image of 200 columns. `lines` returns the (row, height, width) of the lines in a
    /// column.
    fn image(lines: impl Fn(usize) -> Vec<(f64, f64, f64)>) -> Counts {
        let counts = (0..200).flat_map(|column| {
            let lines = lines(column);
            (0..160).map(move |row| {
                let at = |(middle, height, sigma): &(f64, f64, f64)| {
                    let off = (row as f64 + 0.5 - middle) / sigma;
                    height * (-0.5 * off * off).exp()
                };
                (8.0 + lines.iter().map(at).sum::<f64>()).round() as u16
            })
        });
        Counts::of_columns(counts.collect(), 160)
    }

    fn ghosts(image: &Counts, expected_sigma: f64) -> Vec<u32> {
        let settings = PeakSettings {
            expected_sigma,
            ..PeakSettings::new(4095)
        };
        let peaks = find_peaks(image, &settings);
        assert_eq!(peaks.len(), 200);
        let flagged = peaks
            .iter()
            .filter(|p| p.flags.contains(Flags::SUSPECTED_REFLECTION));
        flagged.map(|peak| peak.column).collect()
    }

    /// A wide glow is flagged where it outshines the line (columns 60 to 110) and where it
    /// continues without it (columns 110 to 120). The line itself is not flagged where it is
    /// brighter than the glow.
    #[test]
    fn what_is_wider_than_the_line_beside_it_is_doubted() {
        let line = |column: usize| 40.0 + 0.1 * column as f64;
        let scene = image(|column| match column {
            60..110 => vec![(line(column), 300.0, 2.0), (110.0, 900.0, 6.0)],
            110..120 => vec![(110.0, 900.0, 6.0)],
            130..140 => vec![(line(column), 900.0, 2.0), (110.0, 300.0, 6.0)],
            _ => vec![(line(column), 800.0, 2.0)],
        });
        for expected in [0.0, 2.0] {
            let found = ghosts(&scene, expected);
            assert_eq!(found, (60..120).collect::<Vec<_>>(), "{expected}");
        }
    }

    /// A sharp mirror image of equal width, brighter than the line, is flagged: it occurs in some
    /// columns only, while the line continues.
    #[test]
    fn what_is_only_seen_beside_the_line_is_doubted() {
        let scene = image(|column| match column {
            80..120 => vec![
                (40.0, 300.0, 2.0),
                (100.0 + 0.3 * column as f64, 500.0, 2.0),
            ],
            _ => vec![(40.0, 300.0, 2.0)],
        });
        assert_eq!(ghosts(&scene, 2.0), (80..120).collect::<Vec<_>>());
    }

    /// Two surfaces at different depths, each visible in half of the columns, are not flagged.
    #[test]
    fn a_step_in_depth_is_not_doubted() {
        let scene = image(|column| match column {
            0..95 => vec![(40.0, 700.0, 2.0)],
            95..105 => vec![(40.0, 700.0, 2.0), (90.0, 500.0, 2.2)],
            _ => vec![(90.0, 500.0, 2.2)],
        });
        assert!(ghosts(&scene, 2.0).is_empty());
    }
}
