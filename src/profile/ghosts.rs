//! Which lines may be reflections: light that met the part twice or more, and shows a line, or a glow, where there is
//! no surface in the laser's sheet.
//!
//! A frame tells by its image. A reflection needs light elsewhere, and mostly shares its columns with the line that
//! it comes from or falls beside; what a rough surface reflects is wider than the sheet; it ends where the wall that
//! reflects it ends, while the line goes on by itself. So lines are followed from column to column, and one is
//! doubted beside another that is as narrow as the sheet and is more often alone, or is narrower by far.

use super::{Flags, Peak};
use std::collections::BTreeMap;

/// A line beside another counts as wider from this ratio of widths on: that of two lines alike, whose widths
/// each scatter by 10 % over [`NEAR`] columns of speckle, is beyond it once in 10⁴ times (3.7 standard deviations of
/// their ratio, 14 %).
const WIDER: f64 = 1.5;
/// Columns to either side whose widths are averaged.
const NEAR: usize = 16;
/// Columns that a line may miss, as speckle darkens it, without being another from then on.
const GAP: u32 = 3;
/// How far (line widths, σ; at least pixels) a line may be off from one column to the next.
const STEP: f64 = 3.0;
/// A line tells nothing of others if it is seen in fewer columns: it may be a grain.
const SHORTEST: usize = 8;

/// A line of a column that holds another too, which is not the one chosen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Other {
    pub column: u32,
    pub row: f64,
    /// Standard deviation, px.
    pub sigma: f64,
}

/// A line in one column.
#[derive(Clone, Copy)]
struct Seen {
    column: u32,
    row: f64,
    sigma: f64,
    /// Number of the peak it is; `None`: another was chosen.
    peak: Option<usize>,
    /// Whether the column has no other.
    alone: bool,
}

/// A line followed over columns.
#[derive(Default)]
struct Track {
    seen: Vec<Seen>,
    /// Sums of squares of widths, before each.
    squares: Vec<f64>,
}

impl Track {
    fn push(&mut self, seen: Seen) {
        let sum = self.squares.last().copied().unwrap_or(0.0);
        if self.squares.is_empty() {
            self.squares.push(0.0);
        }
        self.squares.push(sum + seen.sigma * seen.sigma);
        self.seen.push(seen);
    }

    /// Root mean square width around one of its columns.
    fn sigma(&self, at: usize) -> f64 {
        let (from, to) = (
            at.saturating_sub(NEAR),
            (at + NEAR + 1).min(self.seen.len()),
        );
        ((self.squares[to] - self.squares[from]) / (to - from) as f64).sqrt()
    }

    /// Share of its columns in which there is no other line.
    fn alone(&self) -> f64 {
        let alone = self.seen.iter().filter(|seen| seen.alone).count();
        alone as f64 / self.seen.len() as f64
    }
}

/// Sets [`Flags::GHOST`] of the peaks of a frame, in the order of columns, with what else their columns hold in the
/// same order. A line is expected to be `expected_sigma` wide (px; 0: as wide as those that are alone).
pub(super) fn flag(peaks: &mut [Peak], others: &[Other], expected_sigma: f64) {
    if others.is_empty() {
        return;
    }
    let tracks = tracks(peaks, others);
    let expected = match expected_sigma > 0.0 {
        true => expected_sigma,
        false => super::flags::median(
            (tracks.iter().flat_map(|track| &track.seen))
                .filter(|seen| seen.alone)
                .map(|seen| seen.sigma),
        ),
    };
    // Of each column the tracks that have it, and where in them.
    let mut columns: BTreeMap<u32, Vec<(usize, usize)>> = BTreeMap::new();
    for (track, at) in
        (tracks.iter().enumerate()).flat_map(|(i, t)| (0..t.seen.len()).map(move |at| (i, at)))
    {
        let column = tracks[track].seen[at].column;
        columns.entry(column).or_default().push((track, at));
    }
    let alone: Vec<f64> = tracks.iter().map(Track::alone).collect();
    let mut doubted = vec![0; tracks.len()];
    for of_column in columns.values().filter(|of_column| of_column.len() > 1) {
        for &(own, at) in of_column {
            let sigma = tracks[own].sigma(at);
            let is_ghost = of_column.iter().any(|&(other, there)| {
                let beside = tracks[other].sigma(there);
                let tells = other != own
                    && tracks[other].seen.len() >= SHORTEST
                    && beside <= WIDER * expected.max(f64::MIN_POSITIVE);
                let wider = sigma > WIDER * beside.max(expected);
                let comes_and_goes = 2.0 * alone[own] < alone[other];
                tells && (wider || comes_and_goes)
            });
            if is_ghost {
                doubted[own] += 1;
                if let Some(peak) = tracks[own].seen[at].peak {
                    peaks[peak].flags.insert(Flags::GHOST);
                }
            }
        }
    }
    // What goes on where the other line is not seen is the same line.
    for (track, doubted) in tracks.iter().zip(doubted) {
        if 2 * doubted > track.seen.len() {
            for peak in track.seen.iter().filter_map(|seen| seen.peak) {
                peaks[peak].flags.insert(Flags::GHOST);
            }
        }
    }
}

/// The lines of a frame, each followed over its columns: from column to column the nearest pairs belong together.
fn tracks(peaks: &[Peak], others: &[Other]) -> Vec<Track> {
    let mut tracks: Vec<Track> = Vec::new();
    // Those that may go on.
    let mut open: Vec<usize> = Vec::new();
    let mut rest = others;
    for (number, peak) in peaks.iter().enumerate() {
        let count = rest
            .iter()
            .take_while(|other| other.column == peak.column)
            .count();
        let (beside, later) = rest.split_at(count);
        rest = later;
        let seen = |row, sigma, number| Seen {
            column: peak.column,
            row,
            sigma,
            peak: number,
            alone: count == 0,
        };
        let mut lines = vec![seen(peak.row, peak.sigma, Some(number))];
        lines.extend(
            beside
                .iter()
                .map(|other| seen(other.row, other.sigma, None)),
        );
        open.retain(|&track| {
            let last = tracks[track].seen.last();
            last.is_some_and(|last| last.column + GAP + 1 >= peak.column)
        });
        let mut pairs = Vec::new();
        for (i, line) in lines.iter().enumerate() {
            for &track in &open {
                let last = tracks[track].seen[tracks[track].seen.len() - 1];
                let off = (line.row - last.row).abs();
                if off <= STEP * line.sigma.max(last.sigma).max(1.0) {
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

    /// An image of 200 columns whose lines are, by column, of these rows, heights and widths.
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
        let flagged = peaks.iter().filter(|p| p.flags.contains(Flags::GHOST));
        flagged.map(|peak| peak.column).collect()
    }

    /// A glow beside the line that outshines it in the columns 60 to 120, and is all there is from 110 on: the line itself is not
    /// doubted where it is the brightest.
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

    /// A sharp line of a mirror, brighter than the line and as narrow: it comes and goes while the line stays.
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

    /// Two surfaces, one before the other over half of the columns: each is alone as often. No line is doubted.
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
