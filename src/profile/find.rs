//! The lines of a frame, column by column, and what is doubtful about them.

use super::background::{Background, Histogram, background, detection_sigmas};
use super::flags::{WIDE_RATIO, compare_neighbours, median, of_line};
use super::ghosts::{self, Other};
use super::line::{Line, Located};
use super::locate::{WINDOW_SIGMAS, half_height_sigma, is_saturated, locate};
use super::neighbourhood::Neighbourhood;
use super::{Choice, Peak, PeakSettings};
use crate::camera::{Column, Columns};
use std::ops::Range;

/// Share of the height of the column's highest line that another has at least.
pub const CANDIDATE_SHARE: f64 = 0.1;

/// Drawn pixels of a column of which the highest is kept.
const BLOCK: usize = 32;

/// What a column holds besides noise.
struct Detected<'a> {
    /// With all counts drawn that may be of a line.
    column: Column<'a>,
    /// Where the highest counts of its blocks are.
    tops: Range<usize>,
    background: Background,
    /// The least count of a line's highest pixel.
    level: u16,
    top: usize,
    sigma: f64,
}

/// A column's line, located.
struct Found<'a> {
    column: u32,
    line: Line<'a>,
    /// Whether the column has another.
    double: bool,
    /// And the line's intensity, counts.
    located: (Located, f64),
}

/// The line of each column of an image, in the order of columns; columns without one
/// are left out. A line exceeds the background of its column by
/// [`PeakSettings::threshold`], by default the height that noise reaches
/// [`super::FALSE_PEAKS_PER_FRAME`] times per frame. Up to half of a column's rows may be line.
///
/// ```
/// use lasertrace::camera::Counts;
/// use lasertrace::profile::{PeakSettings, find_peaks};
///
/// // In each of 20 columns a Gaussian line of σ = 2 px about row 30.25.
/// let column = |row: usize| {
///     let away = (row as f64 + 0.5 - 30.25) / 2.0;
///     (10.0 + 800.0 * (-0.5 * away * away).exp()).round() as u16
/// };
/// let counts = (0..20).flat_map(|_| (0..60).map(column)).collect();
/// let peaks = find_peaks(&Counts::of_columns(counts, 60), &PeakSettings::new(1023));
/// assert_eq!(peaks.len(), 20);
/// // Counts are rounded by at most ½: the row moves by far less than 0.02 px.
/// assert!(peaks.iter().all(|peak| (peak.row - 30.25).abs() < 0.02));
/// ```
pub fn find_peaks(image: &dyn Columns, settings: &PeakSettings) -> Vec<Peak> {
    let (columns, rows) = (image.columns(), image.rows());
    let z = detection_sigmas(columns * rows);
    let mut histograms = [Histogram::default(), Histogram::default()];
    let mut tops = Vec::new();
    let detected = (0..columns).map(|column| {
        let column = image.column(column);
        detect(column, (z, settings.threshold), &mut histograms, &mut tops)
    });
    let found: Vec<Option<Detected>> = detected.collect();
    // Of a line that speckle breaks up, half the height tells a grain's width.
    let sigma = median(found.iter().flatten().map(|c| c.sigma)).max(settings.expected_sigma);
    let width = 2.354_82 * sigma;
    let mut lines = Vec::with_capacity(columns);
    let mut others = Vec::new();
    for (number, found) in found.iter().enumerate() {
        let Some(found) = found else { continue };
        let (line, tops) = chosen(found, &tops[found.tops.clone()], width, settings);
        if let Some(located) = locate(&line, settings.finder) {
            let double = tops.len() > 1;
            let beside = tops.into_iter().filter(|&top| top != line.top);
            others.extend(beside.map(|top| Other {
                column: number as u32,
                row: top as f64 + 0.5,
                sigma: half_height_sigma(&found.column, top, found.background.mean),
            }));
            lines.push(Found {
                column: number as u32,
                line,
                double,
                located,
            });
        }
    }
    fit_windows(&mut lines, columns, settings);
    let peak = |found: Found| {
        let line = found.line;
        let (located, intensity) = found.located;
        let window = (WINDOW_SIGMAS * line.sigma).max(1.0);
        let inside = located.row >= window && located.row + window <= rows as f64;
        Peak {
            column: found.column,
            row: located.row,
            intensity,
            height: line.height,
            sigma: located.sigma,
            noise: line.background.noise,
            flags: of_line(found.double, is_saturated(&line), inside),
        }
    };
    let mut peaks: Vec<Peak> = lines.into_iter().map(peak).collect();
    compare_neighbours(&mut peaks, columns, settings);
    ghosts::flag(&mut peaks, &others, settings.expected_sigma);
    peaks
}

/// Most times that windows are fitted, and the relative change of a width below which no more are.
/// A window of two of the line's standard deviations instead of four, half as wide as it should be,
/// gives 0.88 of the width, one of 3.5 gives 0.99, and the next is right to 0.001.
const MOST_FITS: usize = 8;
const FITTED: f64 = 1e-3;

/// Locates each line again in a window fitted to its width, until the widths no longer change.
///
/// On a slope towards the camera a line is wider than expected, and a window that truncates it makes it stray more
/// than a complete line. On a slope away from the camera it is narrower, and noise around it would move it. The first
/// fit does not depend on how much the widths differ: a threshold would let a trifle decide which noise is in the window.
fn fit_windows(lines: &mut [Found], columns: usize, settings: &PeakSettings) {
    for _ in 0..MOST_FITS {
        if fit_windows_once(lines, columns, settings) < FITTED {
            break;
        }
    }
}

/// Returns the largest relative change of a window's width.
fn fit_windows_once(lines: &mut [Found], columns: usize, settings: &PeakSettings) -> f64 {
    let single = lines.iter().filter(|found| !found.double);
    let widths = single.map(|found| (found.column, found.located.0.sigma));
    let around = Neighbourhood::new(columns, widths);
    let mut most = 0.0f64;
    for found in lines {
        let (_, Some(width)) = around.around(found.column) else {
            continue;
        };
        // One that is much wider than its neighbours is another line, not their speckle.
        let alike = found.located.0.sigma <= WIDE_RATIO * width;
        if !alike {
            continue;
        }
        let other = Line {
            sigma: width,
            ..found.line
        };
        if let Some(again) = locate(&other, settings.finder) {
            most = most.max((width / found.line.sigma - 1.0).abs());
            (found.line, found.located) = (other, again);
        }
    }
    most
}

/// The highest count of each [`BLOCK`] of a column.
fn tops_of(column: &[u16]) -> impl Iterator<Item = u16> + '_ {
    // Of a known length, for which a maximum is vectorised.
    let (blocks, rest) = column.as_chunks::<BLOCK>();
    let highest = |counts: &[u16]| counts.iter().copied().max();
    let tops = blocks
        .iter()
        .map(|block| block.iter().fold(0, |top, &c| c.max(top)));
    tops.chain(highest(rest))
}

/// The highest line of a column, if it is one. Adds the highest counts of its blocks to `all`.
/// The threshold is `fixed`, or follows from the noise and `z`. Both histograms are empty.
fn detect<'a>(
    mut column: Column<'a>,
    (z, fixed): (f64, Option<f64>),
    [histogram, scratch]: &mut [Histogram; 2],
    all: &mut Vec<u16>,
) -> Option<Detected<'a>> {
    let start = all.len();
    all.extend(tops_of(column.drawn().1));
    let drawn = all[start..].iter().copied().max().unwrap_or(0);
    let others = histogram.count(&column, drawn);
    let mut background = background(&column, z, histogram, scratch);
    background.threshold = fixed.unwrap_or(background.threshold);
    let highest = histogram.highest();
    histogram.clear(&column, others);
    let height = highest as f64 - background.mean;
    if height < background.threshold {
        all.truncate(start);
        return None;
    }
    let level = background.mean + background.threshold.max(CANDIDATE_SHARE * height);
    let level = level.ceil() as u16;
    if others.is_some_and(|others| others >= level) {
        column = column.whole();
        all.truncate(start);
        all.extend(tops_of(column.drawn().1));
    }
    let (first, counts) = column.drawn();
    let block = BLOCK * all[start..].iter().position(|&top| top == highest)?;
    let in_block = counts[block..].iter().position(|&count| count == highest)?;
    let top = first + block + in_block;
    let sigma = half_height_sigma(&column, top, background.mean);
    Some(Detected {
        column,
        tops: start..all.len(),
        background,
        level,
        top,
        sigma,
    })
}

/// The line that the settings choose, and where each line of the column is highest.
fn chosen<'a>(
    found: &Detected<'a>,
    tops: &[u16],
    width: f64,
    settings: &PeakSettings,
) -> (Line<'a>, Vec<usize>) {
    let column = found.column;
    let tops = candidates(column.drawn(), tops, found.level, width);
    let top = match settings.choice {
        Choice::Strongest => found.top,
        Choice::First => *tops.first().unwrap_or(&found.top),
        Choice::Last => *tops.last().unwrap_or(&found.top),
    };
    let mean = found.background.mean;
    let line = Line {
        column,
        background: found.background,
        top,
        height: column.at(top) as f64 - mean,
        sigma: half_height_sigma(&column, top, mean).max(settings.expected_sigma),
        max_count: settings.max_count,
    };
    (line, tops)
}

/// Rows of the highest pixels of the runs at or above `level`; runs whose gap is
/// narrower than `width` are one, as speckle breaks a line up. Of the drawn pixels from row `first`
/// on `blocks` are the highest of each [`BLOCK`]: most are dark, and need not be looked at.
fn candidates(
    (first, drawn): (usize, &[u16]),
    blocks: &[u16],
    level: u16,
    width: f64,
) -> Vec<usize> {
    let mut tops: Vec<usize> = Vec::new();
    let mut last = 0;
    let blocks = drawn.chunks(BLOCK).zip(blocks).enumerate();
    for (block, (counts, _)) in blocks.filter(|(_, (_, top))| **top >= level) {
        for (row, &count) in (first + block * BLOCK..).zip(counts) {
            if count < level {
                continue;
            }
            match tops.last_mut() {
                Some(top) if ((row - last) as f64) <= width + 1.0 => {
                    if count > drawn[*top - first] {
                        *top = row;
                    }
                }
                _ => tops.push(row),
            }
            last = row;
        }
    }
    tops
}
