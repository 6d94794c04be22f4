//! Detection of the laser line in every column of a frame.

use super::background::{Background, CountHistogram, background, detection_sigmas};
use super::flags::{WIDE_RATIO, compare_neighbours, line_flags, median};
use super::line::{DetectedLine, PeakEstimate};
use super::neighbourhood::Neighbourhood;
use super::peak_estimators::{WINDOW_SIGMAS, half_height_sigma, is_saturated, locate};
use super::reflection_flags::{self, SecondaryPeak};
use super::{Peak, PeakSelection, PeakSettings};
use crate::camera::{ColumnView, ImageColumns};
use std::ops::Range;

/// Minimum height of a further line, as a fraction of the height of the highest line in the column.
pub const CANDIDATE_SHARE: f64 = 0.1;

/// Number of individually stored pixels per block for which the maximum is retained.
const BLOCK: usize = 32;

/// Signal detected in a column.
struct ColumnDetection<'a> {
    /// Column in which all counts that may belong to a line are individually stored.
    column: ColumnView<'a>,
    /// Range of the block maxima of this column.
    tops: Range<usize>,
    background: Background,
    /// Minimum count of the highest pixel of a line.
    level: u16,
    top: usize,
    sigma: f64,
}

/// Located line of a column.
struct ColumnPeak<'a> {
    column: u32,
    line: DetectedLine<'a>,
    /// True if the column has another line.
    double: bool,
    /// Position, and intensity of the line in counts.
    located: (PeakEstimate, f64),
}

impl ColumnPeak<'_> {
    /// Returns the peak in an image of `rows` rows.
    fn peak(&self, rows: usize) -> Peak {
        let (line, (located, intensity)) = (&self.line, &self.located);
        let window = (WINDOW_SIGMAS * line.sigma).max(1.0);
        let inside = located.row >= window && located.row + window <= rows as f64;
        Peak {
            column: self.column,
            row: located.row,
            intensity: *intensity,
            height: line.height,
            sigma: located.sigma,
            noise: line.background.noise,
            flags: line_flags(self.double, is_saturated(line), inside),
        }
    }
}

/// Returns the line of each column of an image, in the order of columns. Columns without a line are
/// omitted.
///
/// A line exceeds the background of its column by [`PeakSettings::threshold`]. The default is the
/// height that noise reaches [`super::FALSE_PEAKS_PER_FRAME`] times per frame. Up to half of the
/// rows of a column may belong to the line.
///
/// ```
/// use lasertrace::camera::Counts;
/// use lasertrace::profile::{PeakSettings, find_peaks};
///
/// // Each of 20 columns has a Gaussian line of σ = 2 px at row 30.25.
/// let column = |row: usize| {
///     let away = (row as f64 + 0.5 - 30.25) / 2.0;
///     (10.0 + 800.0 * (-0.5 * away * away).exp()).round() as u16
/// };
/// let counts = (0..20).flat_map(|_| (0..60).map(column)).collect();
/// let peaks = find_peaks(&Counts::of_columns(counts, 60), &PeakSettings::new(1023));
/// assert_eq!(peaks.len(), 20);
/// // Counts are rounded by at most ½, so the row error is well below 0.02 px.
/// assert!(peaks.iter().all(|peak| (peak.row - 30.25).abs() < 0.02));
/// ```
pub fn find_peaks(image: &dyn ImageColumns, settings: &PeakSettings) -> Vec<Peak> {
    let (columns, rows) = (image.columns(), image.rows());
    let z = detection_sigmas(columns * rows);
    let mut histograms = [CountHistogram::default(), CountHistogram::default()];
    let mut tops = Vec::new();
    let detected = (0..columns).map(|column| {
        let column = image.column(column);
        detect(column, (z, settings.threshold), &mut histograms, &mut tops)
    });
    let found: Vec<Option<ColumnDetection>> = detected.collect();
    // If speckle breaks up the line, the width at half height is the width of a grain.
    let sigma = median(found.iter().flatten().map(|c| c.sigma)).max(settings.expected_sigma);
    let width = 2.354_82 * sigma;
    let mut lines = Vec::with_capacity(columns);
    let mut others = Vec::new();
    for (number, found) in found.iter().enumerate() {
        let Some(found) = found else { continue };
        let (line, tops) = select_peak(found, &tops[found.tops.clone()], width, settings);
        if let Some(located) = locate(&line, settings.finder) {
            let double = tops.len() > 1;
            let beside = tops.into_iter().filter(|&top| top != line.top);
            others.extend(beside.map(|top| SecondaryPeak {
                column: number as u32,
                row: top as f64 + 0.5,
                sigma: half_height_sigma(&found.column, top, found.background.mean),
            }));
            lines.push(ColumnPeak {
                column: number as u32,
                line,
                double,
                located,
            });
        }
    }
    fit_windows(&mut lines, columns, settings);
    let mut peaks: Vec<Peak> = lines.into_iter().map(|line| line.peak(rows)).collect();
    compare_neighbours(&mut peaks, columns, settings);
    reflection_flags::flag(&mut peaks, &others, settings.expected_sigma);
    peaks
}

/// Largest number of lines per column that [`find_lines`] returns, as devices have.
pub const MOST_LINES: usize = 4;

/// Returns up to `most` lines of each column, at most [`MOST_LINES`], in the order of columns and
/// rows. The highest lines of a column are returned. Each line is located in its own window, and
/// flags that compare columns are not set.
///
/// Lines of a column are separated by at least their width, and exceed both the threshold and
/// [`CANDIDATE_SHARE`] of the highest line.
pub fn find_lines(image: &dyn ImageColumns, settings: &PeakSettings, most: usize) -> Vec<Peak> {
    let (columns, rows) = (image.columns(), image.rows());
    let z = detection_sigmas(columns * rows);
    let mut histograms = [CountHistogram::default(), CountHistogram::default()];
    let mut tops = Vec::new();
    let mut peaks = Vec::new();
    for number in 0..columns {
        tops.clear();
        let column = image.column(number);
        let found = detect(column, (z, settings.threshold), &mut histograms, &mut tops);
        let Some(found) = found else { continue };
        let sigma = found.sigma.max(settings.expected_sigma);
        let column = found.column;
        let mut lines = candidates(column.drawn(), &tops, found.level, 2.354_82 * sigma);
        lines.sort_by_key(|&top| std::cmp::Reverse(column.at(top)));
        lines.truncate(most.min(MOST_LINES));
        lines.sort_unstable();
        let double = lines.len() > 1;
        for top in lines {
            let background = found.background;
            let line = DetectedLine {
                column,
                background,
                top,
                height: f64::from(column.at(top)) - background.mean,
                sigma: half_height_sigma(&column, top, background.mean),
                max_count: settings.max_count,
            };
            if let Some(located) = locate(&line, settings.finder) {
                let found = ColumnPeak {
                    column: number as u32,
                    line,
                    double,
                    located,
                };
                peaks.push(found.peak(rows));
            }
        }
    }
    peaks
}

/// Maximum number of window fits, and the relative change of the width below which fitting ends.
///
/// A window of two standard deviations of the line, half the correct width, yields 0.88 of the
/// width. A window of 3.5 standard deviations yields 0.99, and the next iteration is accurate to
/// 0.001.
const MOST_FITS: usize = 8;
const FITTED: f64 = 1e-3;

/// Locates each line again in a window fitted to its width, until the widths no longer change.
///
/// On a slope towards the camera, a line is wider than expected. A window that truncates the line
/// increases its error. On a slope away from the camera, the line is narrower, and noise around it
/// would move it. The first fit is independent of the change in width. With a threshold, a
/// negligible change could decide which noise is in the window.
fn fit_windows(lines: &mut [ColumnPeak], columns: usize, settings: &PeakSettings) {
    for _ in 0..MOST_FITS {
        if fit_windows_once(lines, columns, settings) < FITTED {
            break;
        }
    }
}

/// Returns the largest relative change of a window width.
fn fit_windows_once(lines: &mut [ColumnPeak], columns: usize, settings: &PeakSettings) -> f64 {
    let single = lines.iter().filter(|found| !found.double);
    let widths = single.map(|found| (found.column, found.located.0.sigma));
    let around = Neighbourhood::new(columns, widths);
    let mut most = 0.0f64;
    for found in lines {
        let (_, Some(width)) = around.around(found.column) else {
            continue;
        };
        // A line much wider than its neighbours is a different line, not a speckle effect.
        let alike = found.located.0.sigma <= WIDE_RATIO * width;
        if !alike {
            continue;
        }
        let other = DetectedLine {
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

/// Returns the highest count of each [`BLOCK`] of a column.
fn tops_of(column: &[u16]) -> impl Iterator<Item = u16> + '_ {
    // Chunks of constant length allow vectorisation of the maximum.
    let (blocks, rest) = column.as_chunks::<BLOCK>();
    let highest = |counts: &[u16]| counts.iter().copied().max();
    let tops = blocks
        .iter()
        .map(|block| block.iter().fold(0, |top, &c| c.max(top)));
    tops.chain(highest(rest))
}

/// Returns the highest line of a column if it exceeds the threshold.
///
/// Appends the block maxima of the column to `all`. The threshold is `fixed`, or follows from the
/// noise and `z`. Both histograms must be empty.
fn detect<'a>(
    mut column: ColumnView<'a>,
    (z, fixed): (f64, Option<f64>),
    [histogram, scratch]: &mut [CountHistogram; 2],
    all: &mut Vec<u16>,
) -> Option<ColumnDetection<'a>> {
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
        column = column.materialise();
        all.truncate(start);
        all.extend(tops_of(column.drawn().1));
    }
    let (first, counts) = column.drawn();
    let block = BLOCK * all[start..].iter().position(|&top| top == highest)?;
    let in_block = counts[block..].iter().position(|&count| count == highest)?;
    let top = first + block + in_block;
    let sigma = half_height_sigma(&column, top, background.mean);
    Some(ColumnDetection {
        column,
        tops: start..all.len(),
        background,
        level,
        top,
        sigma,
    })
}

/// Returns the line selected by the settings, and the row of the maximum of each line in the
/// column.
fn select_peak<'a>(
    found: &ColumnDetection<'a>,
    tops: &[u16],
    width: f64,
    settings: &PeakSettings,
) -> (DetectedLine<'a>, Vec<usize>) {
    let column = found.column;
    let tops = candidates(column.drawn(), tops, found.level, width);
    let top = match settings.choice {
        PeakSelection::Strongest => found.top,
        PeakSelection::First => *tops.first().unwrap_or(&found.top),
        PeakSelection::Last => *tops.last().unwrap_or(&found.top),
    };
    let mean = found.background.mean;
    let line = DetectedLine {
        column,
        background: found.background,
        top,
        height: column.at(top) as f64 - mean,
        sigma: half_height_sigma(&column, top, mean).max(settings.expected_sigma),
        max_count: settings.max_count,
    };
    (line, tops)
}

/// Returns the rows of the maxima of the runs at or above `level`.
///
/// Runs separated by less than `width` are merged, because speckle breaks up lines. `blocks` holds
/// the maximum of each [`BLOCK`] of the individually stored pixels, which start at row `first`.
/// Most blocks are dark and are skipped.
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
