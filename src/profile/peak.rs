//! The laser line in each sensor column.

/// The line in one column.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Peak {
    pub column: u32,
    /// Row coordinate of the line; pixel j covers [j, j+1].
    pub row: f64,
    /// Sum of the counts above background in the window.
    pub intensity: f64,
}

/// Peaks lower than this above background are noise: five standard deviations of
/// the column, and two counts where the column has no noise at all.
const DETECTION_SIGMAS: f64 = 5.0;
const DETECTION_COUNTS: f64 = 2.0;

/// Half width of the centroid's window, in standard deviations of the line. At 3
/// the pixels that the window's ends cut still hold enough light, unevenly, to
/// pull the centroid of a line of σ = 1 px by 0.003 px.
const WINDOW_SIGMAS: f64 = 4.0;

/// Columns that are gathered at once: a cache line of a row.
const STRIP: usize = 32;

/// The brightest peak of each column of a row-by-row image; columns without a
/// line are left out.
pub fn find_peaks(counts: &[u16], columns: usize) -> Vec<Peak> {
    let rows = counts.len() / columns;
    let mut strip = vec![0; STRIP * rows];
    let mut peaks = Vec::with_capacity(columns);
    for first in (0..columns).step_by(STRIP) {
        let width = STRIP.min(columns - first);
        for (i, row) in counts.chunks_exact(columns).enumerate() {
            for (j, &count) in row[first..first + width].iter().enumerate() {
                strip[j * rows + i] = count;
            }
        }
        let found = strip.chunks_exact(rows).take(width).enumerate();
        peaks.extend(found.filter_map(|(j, column)| {
            let (row, intensity) = brightest_peak(column)?;
            Some(Peak {
                column: (first + j) as u32,
                row,
                intensity,
            })
        }));
    }
    peaks
}

/// Row and intensity of the brightest peak of a column.
fn brightest_peak(column: &[u16]) -> Option<(f64, f64)> {
    let &highest = column.iter().max()?;
    let (background, noise) = background(column, highest);
    let top = column.iter().position(|&count| count == highest)?;
    let height = highest as f64 - background;
    if height < (DETECTION_SIGMAS * noise).max(DETECTION_COUNTS) {
        return None;
    }
    let sigma = half_height_sigma(column, top, background + height / 2.0);
    // The window is centred on the centroid it gives: truncation is then
    // symmetric and does not pull. From half a pixel off it settles fast.
    let mut row = top as f64 + 0.5;
    let mut intensity = 0.0;
    for _ in 0..20 {
        let half = (WINDOW_SIGMAS * sigma).max(1.0);
        let moved = windowed_centroid(column, background, row - half, row + half)?;
        let step = moved.0 - row;
        (row, intensity) = moved;
        if step.abs() < 1e-6 {
            break;
        }
    }
    Some((row, intensity))
}

/// Mean and standard deviation of the column, whose greatest count is `highest`,
/// without its line: from the median and its absolute deviation (×1.4826 for
/// normal noise, and one count for what rounding hides), what lies further than
/// four deviations off is left out, again and again until nothing changes.
fn background(column: &[u16], highest: u16) -> (f64, f64) {
    let mut scratch = column.to_vec();
    let middle = scratch.len() / 2;
    let median = *scratch.select_nth_unstable(middle).1;
    scratch.iter_mut().for_each(|c| *c = c.abs_diff(median));
    let deviation = *scratch.select_nth_unstable(middle).1;
    let (mut mean, mut sigma) = (median as f64, 1.4826 * deviation as f64 + 1.0);
    let mut kept = 0;
    // Each round ends with other counts kept or is the last; ten are plenty.
    for _ in 0..10 {
        // Casts saturate.
        let low = (mean - 4.0 * sigma).ceil() as u16;
        let high = ((mean + 4.0 * sigma).floor() as u16).min(highest);
        let (n, sum, squares) = moments(column, low, high);
        if n == kept || n == 0 {
            break;
        }
        kept = n;
        mean = sum as f64 / n as f64;
        sigma = (squares as f64 / n as f64 - mean * mean).max(0.0).sqrt();
    }
    (mean, sigma)
}

/// Number, sum and sum of squares of the counts from `low` to `high`.
fn moments(column: &[u16], low: u16, high: u16) -> (u64, u64, u64) {
    // Runs so short that 32 bits hold their sums: then and without branches the
    // loop is vectorised.
    let largest = (high as u32).max(1);
    let run = (u32::MAX / (largest * largest)).min(256) as usize;
    let (mut n, mut sum, mut squares) = (0u64, 0u64, 0u64);
    for run in column.chunks(run) {
        let mut of_run = (0u32, 0u32, 0u32);
        for &count in run {
            let inside = (low <= count) & (count <= high);
            let count = if inside { count as u32 } else { 0 };
            of_run.0 += inside as u32;
            of_run.1 += count;
            of_run.2 += count * count;
        }
        n += of_run.0 as u64;
        sum += of_run.1 as u64;
        squares += of_run.2 as u64;
    }
    (n, sum, squares)
}

/// Standard deviation of a Gaussian as wide at half height as the run of pixels
/// around `top` that lie above `level`.
fn half_height_sigma(column: &[u16], top: usize, level: f64) -> f64 {
    let above = |count: &&u16| **count as f64 >= level;
    let below_top = column[..top].iter().rev().take_while(above).count();
    let above_top = column[top..].iter().take_while(above).count();
    (below_top + above_top) as f64 / 2.354_82
}

/// Centroid and sum of the counts above background from row `low` to row `high`;
/// a pixel that is partly inside counts for that part, at that part's middle.
fn windowed_centroid(column: &[u16], background: f64, low: f64, high: f64) -> Option<(f64, f64)> {
    let low = low.max(0.0);
    let high = high.min(column.len() as f64);
    let (mut sum, mut moment) = (0.0, 0.0);
    for (i, &count) in column
        .iter()
        .enumerate()
        .take(high.ceil() as usize)
        .skip(low as usize)
    {
        let (from, to) = (low.max(i as f64), high.min(i as f64 + 1.0));
        let weight = (count as f64 - background) * (to - from);
        sum += weight;
        moment += weight * (from + to) / 2.0;
    }
    let row = moment / sum;
    (sum > 0.0 && (low..=high).contains(&row)).then_some((row, sum))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussian(center: f64, sigma: f64, height: f64, base: f64) -> Vec<u16> {
        let cdf = |x: f64| 0.5 * libm::erf((x - center) / sigma / 2f64.sqrt());
        let area = height * sigma * (2.0 * std::f64::consts::PI).sqrt();
        (0..80)
            .map(|i| (base + area * (cdf(i as f64 + 1.0) - cdf(i as f64))).round() as u16)
            .collect()
    }

    /// A line of 40 000 counts is found to 0.002 px: the rounding of each of the
    /// ~8σ pixels, 1/√12 counts at up to 4σ from the middle, moves the centroid
    /// by about √(8σ)·4σ/√12/(2.5σ·40 000) < 1e-4; a cut pixel at the window's
    /// end, from 3.5σ on, holds 2.3e-4 of the light of σ = 1 and misplaces less
    /// than all of it by 4 px: 0.001.
    #[test]
    fn a_gaussian_line_is_found_wherever_it_lies_in_its_pixel() {
        for sigma in [1.0, 2.0, 4.0] {
            for i in 0..20 {
                let center = 40.0 + i as f64 / 20.0;
                let column = gaussian(center, sigma, 40_000.0, 100.0);
                let (row, _) = brightest_peak(&column).unwrap();
                assert!((row - center).abs() < 0.002, "{sigma} {center} {row}");
            }
        }
    }

    #[test]
    fn a_column_without_a_line_has_no_peak() {
        assert_eq!(brightest_peak(&[7; 50]), None);
        let noise: Vec<u16> = (0..50).map(|i| 100 + (i * 7919 % 13) as u16).collect();
        assert_eq!(brightest_peak(&noise), None);
        assert_eq!(brightest_peak(&[0]), None);
    }

    #[test]
    fn a_line_at_the_border_and_a_one_pixel_line_stay_inside() {
        let mut column = vec![0u16; 30];
        column[0] = 900;
        let (row, intensity) = brightest_peak(&column).unwrap();
        assert!((row - 0.5).abs() < 1e-9 && intensity == 900.0, "{row}");
        column[29] = 1000;
        let (row, _) = brightest_peak(&column).unwrap();
        assert!((row - 29.5).abs() < 1e-9, "{row}");
    }

    #[test]
    fn images_are_read_column_by_column() {
        let mut counts = vec![0u16; 3 * 40];
        counts[3 * 20 + 2] = 500;
        let peaks = find_peaks(&counts, 3);
        assert_eq!(peaks.len(), 1);
        assert_eq!(peaks[0].column, 2);
        assert!((peaks[0].row - 20.5).abs() < 1e-9);
    }
}
