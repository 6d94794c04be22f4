//! The lines of a frame, column by column, and what is doubtful about them.

use super::background::{Background, Histogram, background, detection_sigmas};
use super::line::{Line, Located};
use super::locate::{WINDOW_SIGMAS, half_height_sigma, is_saturated, locate};
use super::neighbourhood::Neighbourhood;
use super::slope::{VARIANCE_OF_A_CLIMB, slope, touching};
use super::{Choice, Flags, Peak, PeakSettings};
use crate::camera::Counts;

/// Share of the height of the column's highest line that another has at least.
pub const CANDIDATE_SHARE: f64 = 0.1;
/// A line is wide above this many times the width of the frame's lines, climbing as it does.
pub const WIDE_RATIO: f64 = 2.0;
/// A line is weak below this share of the median height of the frame's lines: a
/// Gaussian beam of which an edge leaves this is lit beyond 2.4 σ only.
pub const WEAK_SHARE: f64 = 0.05;
/// A line is weak below this many times the background's noise.
pub const WEAK_SNR: f64 = 10.0;

/// A line that is narrower, over five columns, than this share of those around, or these than
/// of what is expected, is the tail that an edge along it leaves: of a Gaussian cut beyond 1.5 σ.
pub const NARROW_RATIO: f64 = 0.4;

/// Pixels of a column of which the highest is kept.
const BLOCK: usize = 32;

/// A column of an image.
struct Pixels<'a> {
    counts: &'a [u16],
    /// The highest count of each [`BLOCK`]: most are dark, and need not be looked at.
    tops: &'a [u16],
}

/// What a column holds besides noise.
struct Column {
    background: Background,
    top: usize,
    height: f64,
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
/// are left out. A line is what stands out from its column's own noise so far that noise
/// alone would in [`super::FALSE_PEAKS_PER_FRAME`] of a frame's columns.
pub fn find_peaks(image: &Counts, settings: &PeakSettings) -> Vec<Peak> {
    let (columns, rows) = (image.columns(), image.rows());
    let z = detection_sigmas(columns * rows);
    let mut histogram = Histogram::default();
    let blocks = rows.div_ceil(BLOCK);
    let mut tops = Vec::with_capacity(columns * blocks);
    let detected = (0..columns).map(|column| {
        let counts = image.column(column);
        let first = tops.len();
        tops.extend(tops_of(counts));
        let tops = &tops[first..];
        detect(&Pixels { counts, tops }, z, &mut histogram)
    });
    let found: Vec<Option<Column>> = detected.collect();
    // Of a line that speckle breaks up, half the height tells a grain's width.
    let sigma = median(found.iter().flatten().map(|c| c.sigma)).max(settings.expected_sigma);
    let width = 2.354_82 * sigma;
    let mut lines = Vec::with_capacity(columns);
    for (number, (tops, found)) in tops.chunks_exact(blocks).zip(&found).enumerate() {
        let Some(found) = found else { continue };
        let counts = image.column(number);
        let (line, double) = chosen(&Pixels { counts, tops }, found, width, settings);
        if let Some(located) = locate(&line, settings.finder) {
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
        let mut flags = Flags::empty();
        flags.set(Flags::DOUBLE, found.double);
        flags.set(Flags::SATURATED, is_saturated(&line));
        let window = (WINDOW_SIGMAS * line.sigma).max(1.0);
        let inside = located.row >= window && located.row + window <= rows as f64;
        flags.set(Flags::BORDER, !inside);
        Peak {
            column: found.column,
            row: located.row,
            intensity,
            height: line.height,
            sigma: located.sigma,
            noise: line.background.noise,
            flags,
        }
    };
    let mut peaks: Vec<Peak> = lines.into_iter().map(peak).collect();
    compare_neighbours(&mut peaks, columns, settings.expected_sigma);
    peaks
}

/// Locates again each line in a window of its own width: on a slope towards the camera it is
/// wider than was taken, and cut off by its window it would stray more than a whole one; on one
/// away from it, it is narrower, and noise beside it would move it. However little the widths
/// differ: were it done from some difference on, a trifle could decide on which noise is in
/// the window.
fn fit_windows(lines: &mut [Found], columns: usize, settings: &PeakSettings) {
    let single = lines.iter().filter(|found| !found.double);
    let widths = single.map(|found| (found.column, found.located.0.sigma));
    let around = Neighbourhood::new(columns, widths);
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
            (found.line, found.located) = (other, again);
        }
    }
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

/// The highest line of a column, if it is one.
fn detect(column: &Pixels, z: f64, histogram: &mut Histogram) -> Option<Column> {
    let counts = column.counts;
    let highest = column.tops.iter().copied().max()?;
    let background = background(counts, highest, z, histogram);
    let height = highest as f64 - background.mean;
    if height < background.threshold {
        return None;
    }
    let first = BLOCK * column.tops.iter().position(|&top| top == highest)?;
    let top = first + counts[first..].iter().position(|&count| count == highest)?;
    let sigma = half_height_sigma(counts, top, background.mean);
    Some(Column {
        background,
        top,
        height,
        sigma,
    })
}

/// The line that the settings choose, and whether there is another.
fn chosen<'a>(
    column: &Pixels<'a>,
    found: &Column,
    width: f64,
    settings: &PeakSettings,
) -> (Line<'a>, bool) {
    let Background {
        mean, threshold, ..
    } = found.background;
    let level = mean + threshold.max(CANDIDATE_SHARE * found.height);
    let tops = candidates(column, level.ceil() as u16, width);
    let top = match settings.choice {
        Choice::Strongest => found.top,
        Choice::First => *tops.first().unwrap_or(&found.top),
        Choice::Last => *tops.last().unwrap_or(&found.top),
    };
    let counts = column.counts;
    let height = counts[top] as f64 - mean;
    let line = Line {
        column: counts,
        background: found.background,
        top,
        height,
        sigma: half_height_sigma(counts, top, mean).max(settings.expected_sigma),
        max_count: settings.max_count,
    };
    (line, tops.len() > 1)
}

/// Rows of the highest pixels of the runs at or above `level`; runs whose gap is
/// narrower than `width` are one, as speckle breaks a line up.
fn candidates(column: &Pixels, level: u16, width: f64) -> Vec<usize> {
    let mut tops: Vec<usize> = Vec::new();
    let mut last = 0;
    let blocks = column.counts.chunks(BLOCK).zip(column.tops).enumerate();
    for (block, (counts, _)) in blocks.filter(|(_, (_, top))| **top >= level) {
        for (row, &count) in (block * BLOCK..).zip(counts) {
            if count < level {
                continue;
            }
            match tops.last_mut() {
                Some(top) if ((row - last) as f64) <= width + 1.0 => {
                    if count > column.counts[*top] {
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

/// Sets the flags that compare a line with its neighbours and with the others.
pub fn compare_neighbours(peaks: &mut [Peak], columns: usize, expected_sigma: f64) {
    let height = median(peaks.iter().map(|p| p.height));
    let sigma = median(peaks.iter().map(|p| p.sigma)).max(expected_sigma);
    let widths = Neighbourhood::new(columns, peaks.iter().map(|p| (p.column, p.sigma)));
    for i in 0..peaks.len() {
        let peak = &peaks[i];
        let before = i.checked_sub(1).map(|i| &peaks[i]);
        let before = before.filter(|before| touching(before, peak, sigma));
        let after = peaks
            .get(i + 1)
            .filter(|after| touching(peak, after, sigma));
        let first = peak.column == 0;
        let last = peak.column as usize + 1 == columns;
        let unbroken = (first || before.is_some()) && (last || after.is_some());
        let climb = slope(before, peak, after).powi(2) * VARIANCE_OF_A_CLIMB;
        let weak = peak.height < (WEAK_SHARE * height).max(WEAK_SNR * peak.noise);
        let wide = peak.sigma > WIDE_RATIO * (sigma * sigma + climb).sqrt();
        // A column by itself may be as narrow as a grain.
        let beside = widths.beside(peak.column).unwrap_or(peak.sigma);
        let around = widths.around(peak.column).1.unwrap_or(peak.sigma);
        let narrow = beside < NARROW_RATIO * around || around < NARROW_RATIO * expected_sigma;
        let flags = &mut peaks[i].flags;
        flags.set(Flags::EDGE, !unbroken || narrow);
        flags.set(Flags::WEAK, weak);
        flags.set(Flags::WIDE, wide);
    }
}

/// The middle value, the upper of two; 0 of none.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    match values.is_empty() {
        true => 0.0,
        false => *values.select_nth_unstable_by(middle, f64::total_cmp).1,
    }
}
