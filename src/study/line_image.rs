//! Line of a laser in an image: position, width, brightness and saturation in each column.

use super::patches::residuals;
use super::sampled::{SampledStatistics, Statistic, median};
use crate::camera::Counts;
use crate::error::{InputError, Place, Result};
use crate::profile::{MOST_LINES, Peak, PeakSettings, find_lines, find_peaks};
use std::path::Path;

/// Columns of a block.
pub const BLOCK: usize = 32;
/// Smallest fraction of the columns that need a line.
const LEAST_FOUND: f64 = 0.2;
/// A parabola removes three of the degrees of freedom of a block.
pub const FREEDOM: f64 = BLOCK as f64 / (BLOCK as f64 - 3.0);

/// Statistics of the image of a line.
pub const STATISTICS: [Statistic; 7] = [
    Statistic {
        name: "width_at_half_height_px",
        terms: "width of the laser beam, blur of the lens, saturation, veiling glare",
    },
    Statistic {
        name: "scatter_px",
        terms: "speckle contrast and grain, noise, saturation",
    },
    Statistic {
        name: "row_correlation",
        terms: "grain of the speckle, noise",
    },
    Statistic {
        name: "height_dn",
        terms: "laser power, reflectance, exposure time and quantum efficiency together",
    },
    Statistic {
        name: "contrast_of_brightness",
        terms: "speckle contrast, saturation, reflectance",
    },
    Statistic {
        name: "saturated_columns_fraction",
        terms: "laser power, reflectance, exposure time and quantum efficiency together",
    },
    Statistic {
        name: "saturated_pixels_per_column",
        terms: "brightness and width of the line, veiling glare",
    },
];

/// Lines of each column, in the order of rows.
///
/// # Errors
/// Returns `Error::Input` for images without a line in a fifth of the columns.
pub fn lines_by_column(
    path: &Path,
    counts: &Counts,
    settings: &PeakSettings,
) -> Result<Vec<Vec<Peak>>> {
    let count = counts.columns();
    let mut of_column: Vec<Vec<Peak>> = vec![Vec::new(); count];
    for line in find_lines(counts, settings, MOST_LINES) {
        of_column[line.column as usize].push(line);
    }
    let found = of_column.iter().filter(|lines| !lines.is_empty()).count();
    require_line(path, found, count)?;
    Ok(of_column)
}

/// Returns an error if a line was found in fewer than a fifth of the columns.
fn require_line(path: &Path, found: usize, count: usize) -> Result<()> {
    if found as f64 >= LEAST_FOUND * count as f64 && count >= 4 * BLOCK {
        return Ok(());
    }
    let found = format!("a line in {found} of {count} columns");
    let expected = format!(
        "an image of {} columns or more with a line in a fifth of them; line_along = \"rows\" for a vertical line",
        4 * BLOCK
    );
    Err(InputError::new(path, Place::File, found, expected).into())
}

/// Returns the highest line of a column.
pub fn highest(lines: &[Peak]) -> Option<&Peak> {
    lines.iter().max_by(|a, b| a.height.total_cmp(&b.height))
}

/// Returns values minus the parabola that fits the finite ones. The result is NaN for values that
/// are not finite, and for all if fewer than six are.
pub fn without_parabola(values: &[f64]) -> Vec<f64> {
    let mut rest = vec![f64::NAN; values.len()];
    let unit = |i: usize| i as f64 / values.len() as f64 - 0.5;
    let valid: Vec<usize> = (0..values.len())
        .filter(|&i| values[i].is_finite())
        .collect();
    if valid.len() >= 6
        && let Some(found) = residuals(
            &valid,
            |&i| [1.0, unit(i), unit(i) * unit(i)],
            |&i| values[i],
        )
    {
        for (i, value) in valid.into_iter().zip(found) {
            rest[i] = value;
        }
    }
    rest
}

/// Block of columns with a line.
struct ColumnBlock {
    widths: Vec<f64>,
    heights: Vec<f64>,
    intensities: Vec<f64>,
    /// Rows and brightness minus their parabolas, for all columns of the block.
    rows: Vec<f64>,
    brightness: Vec<f64>,
    saturated_columns: usize,
    saturated_pixels: usize,
}

/// Computes the statistics of an image, with the line that a scan measures. `seed` selects the
/// bootstrap samples.
///
/// # Errors
/// Returns `Error::Input` for images without a line in a fifth of the columns.
pub fn line_statistics(
    path: &Path,
    counts: &Counts,
    settings: &PeakSettings,
    seed: u64,
) -> Result<SampledStatistics> {
    let mut peaks: Vec<Option<Peak>> = vec![None; counts.columns()];
    for peak in find_peaks(counts, settings) {
        peaks[peak.column as usize] = Some(peak);
    }
    let found = peaks.iter().flatten().count();
    require_line(path, found, counts.columns())?;
    let blocks = peaks
        .chunks(BLOCK)
        .map(|peaks| block(counts, settings.max_count, peaks));
    let blocks: Vec<ColumnBlock> = blocks.filter(|block| !block.heights.is_empty()).collect();
    Ok(SampledStatistics::of(&blocks, found, seed, values))
}

fn block(counts: &Counts, max_count: u16, peaks: &[Option<Peak>]) -> ColumnBlock {
    let valid = || peaks.iter().flatten();
    let of = |value: fn(&Peak) -> f64| -> Vec<f64> {
        let values = peaks
            .iter()
            .map(|peak| peak.as_ref().map_or(f64::NAN, value));
        without_parabola(&values.collect::<Vec<f64>>())
    };
    let saturated = |peak: &Peak| {
        let column = counts.column(peak.column as usize);
        column.iter().filter(|&&count| count >= max_count).count()
    };
    ColumnBlock {
        widths: valid().map(|peak| width(counts, peak)).collect(),
        heights: valid().map(|peak| peak.height).collect(),
        intensities: valid().map(|peak| peak.intensity).collect(),
        rows: of(|peak| peak.row),
        brightness: of(|peak| peak.intensity),
        saturated_columns: valid().filter(|peak| saturated(peak) > 0).count(),
        saturated_pixels: valid().map(saturated).sum(),
    }
}

/// Returns the width of a line at half of its height above the median of the column, px. The rows
/// of both ends are interpolated linearly. The width is NaN if the row of the line is darker.
fn width(counts: &Counts, peak: &Peak) -> f64 {
    let column = counts.column(peak.column as usize);
    let mut sorted = column.to_vec();
    sorted.sort_unstable();
    let level = f64::from(sorted[sorted.len() / 2]) + peak.height / 2.0;
    let at = |row: usize| f64::from(column[row]) - level;
    let top = (peak.row.max(0.0) as usize).min(column.len() - 1);
    if at(top) < 0.0 {
        return f64::NAN;
    }
    let part = |inside: usize, outside: usize| at(inside) / (at(inside) - at(outside));
    let first = (0..top).rev().find(|&row| at(row) < 0.0);
    let last = (top + 1..column.len()).find(|&row| at(row) < 0.0);
    let low = first.map_or(0.0, |row| (row + 1) as f64 - part(row + 1, row));
    let high = last.map_or(column.len() as f64 - 1.0, |row| {
        (row - 1) as f64 + part(row - 1, row)
    });
    high - low
}

/// Returns the mean product of values at a lag of `lag` columns in the same block.
fn covariance<'a>(blocks: impl Iterator<Item = &'a Vec<f64>>, lag: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for values in blocks {
        let pairs = values.iter().zip(values.get(lag..).unwrap_or_default());
        for product in pairs.map(|(a, b)| a * b).filter(|p| p.is_finite()) {
            sum += product;
            count += 1.0;
        }
    }
    sum / count
}

fn values(blocks: &[&ColumnBlock]) -> Vec<f64> {
    let all = |of: fn(&ColumnBlock) -> &Vec<f64>| -> Vec<f64> {
        let values = blocks.iter().flat_map(|block| of(block)).copied();
        values.filter(|value| value.is_finite()).collect()
    };
    let intensities = all(|block| &block.intensities);
    let columns = intensities.len() as f64;
    let mean = intensities.iter().sum::<f64>() / columns;
    let rows = |lag| covariance(blocks.iter().map(|block| &block.rows), lag);
    let brightness = covariance(blocks.iter().map(|block| &block.brightness), 0);
    let of_columns = |of: fn(&ColumnBlock) -> usize| {
        blocks.iter().map(|block| of(block)).sum::<usize>() as f64 / columns
    };
    vec![
        median(all(|block| &block.widths)),
        (FREEDOM * rows(0)).sqrt(),
        rows(1) / rows(0).max(f64::MIN_POSITIVE),
        median(all(|block| &block.heights)),
        (FREEDOM * brightness).sqrt() / mean,
        of_columns(|block| block.saturated_columns),
        of_columns(|block| block.saturated_pixels),
    ]
}
