//! Background of a column and the detection threshold for lines.

use crate::camera::ColumnView;
use crate::math::students_quantile;
use std::cmp::Reverse;
use std::ops::Range;

/// Expected number of false peaks per frame without light.
pub const FALSE_PEAKS_PER_FRAME: f64 = 1e-3;

/// Standard deviation of rounding to integer counts, 1/√12.
const ROUNDING: f64 = 0.288_675_134_594_812_9;

/// Background statistics of a column, counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Background {
    pub mean: f64,
    pub noise: f64,
    /// Height above the mean at which a pixel is accepted as signal.
    pub threshold: f64,
}

/// Returns the number of standard deviations that normal noise exceeds [`FALSE_PEAKS_PER_FRAME`]
/// times in a frame of `pixels`. For 1280 × 512 pixels it is 6.0.
pub fn detection_sigmas(pixels: usize) -> f64 {
    let chance = FALSE_PEAKS_PER_FRAME / pixels as f64;
    let exceeds = |z: f64| 0.5 * libm::erfc(z / std::f64::consts::SQRT_2);
    let (mut low, mut high) = (0.0, 40.0);
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        if exceeds(middle) > chance {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// Returns the minimum height above background, in counts, of a line that exceeds the noise by
/// `sigmas` standard deviations; see [`detection_sigmas`]. The background has a well-known standard
/// deviation of `noise` counts.
pub fn least_height(sigmas: f64, noise: f64) -> f64 {
    sigmas * noise.max(ROUNDING)
}

/// Returns the background of a column with the given histogram.
///
/// All rows are used unless a line may cover many of them. In that case, only the rows outside the
/// line are used. If a halo of the line reaches all of these, the mean is estimated from all rows
/// and includes the halo up to the threshold. `scratch` must be an empty histogram and is empty on
/// return.
pub(super) fn background(
    column: &ColumnView,
    z: f64,
    histogram: &CountHistogram,
    scratch: &mut CountHistogram,
) -> Background {
    let rows = column.rows();
    let of_all = background_from(&Start::of(rows, histogram), z, histogram);
    if !may_be_wide(rows, histogram) {
        return of_all;
    }
    let whole = column.materialise();
    let counts = whole.drawn().1;
    let line = brightest_half(counts);
    let outside = outside(counts, &line);
    let [inside, [mean, variance]] = [&counts[line], &outside[..]].map(mean_and_variance);
    if inside[0] - mean < CONTRAST * variance.sqrt() {
        return of_all;
    }
    let column = ColumnView::from(&outside[..]);
    scratch.count(&column, outside.iter().copied().max().unwrap_or(0));
    let mut found = background_from(&Start::of(outside.len(), scratch), z, scratch);
    scratch.clear(&column, None);
    if has_halo(&outside) {
        found.mean = of_all.mean.min(found.mean + found.threshold);
    }
    found
}

/// Returns the mean and standard deviation of the counts within four standard deviations of the
/// mean, iterated to a fixed point from `start`. The standard deviation is at most 1.5 times the
/// initial scale. The threshold is [`students_quantile`] of `z`.
fn background_from(start: &Start, z: f64, histogram: &CountHistogram) -> Background {
    let (mut mean, mut sigma) = (start.median as f64, start.scale);
    // A halo around the line would widen the limits at each step.
    let limit = 1.5 * sigma;
    let (mut kept, mut high) = (0, 0);
    // The loop ends when the set of counts no longer changes; ten iterations are sufficient.
    for _ in 0..10 {
        // Casts saturate.
        let low = (mean - 4.0 * sigma).ceil() as u16;
        high = (mean + 4.0 * sigma).floor() as u16;
        let (n, sum, squares) = histogram.moments(low, high);
        if n == kept || n == 0 {
            break;
        }
        kept = n;
        mean = sum as f64 / n as f64;
        sigma = (squares as f64 / n as f64 - mean * mean).max(0.0).sqrt();
        sigma = sigma.min(limit);
    }
    let mut freedom = kept.max(1) as f64;
    if start.cut && sigma > 0.0 {
        // The cut removes low counts only; `high` excludes the counts of the line.
        let median = histogram.value(histogram.moments(0, high).0 as usize / 2);
        let upper = upper_deviation(histogram, median, sigma);
        sigma = sigma.max(upper).min(limit);
        freedom /= ONE_SIDED_VARIANCE;
    }
    let noise = sigma.max(ROUNDING);
    Background {
        mean,
        noise,
        threshold: students_quantile(z, freedom) * noise,
    }
}

/// Robust location and scale of noise.
struct Start {
    median: u16,
    /// Standard deviation, counts, plus one count for the effect of rounding.
    scale: f64,
    /// True if the black level cuts the noise at zero.
    cut: bool,
}

impl Start {
    fn of(rows: usize, histogram: &CountHistogram) -> Start {
        let middle = rows / 2;
        let median = histogram.value(middle);
        // A black level two standard deviations above zero cuts off 2.3 % of normal noise.
        let cut = 50 * histogram.at(0) > rows as u64;
        let scale = match cut {
            // One standard deviation above the median; all counts below the median may be zero.
            true => {
                let rank = (0.68 * (rows - middle) as f64) as usize;
                (histogram.value(middle + rank) - median) as f64
            }
            // Factor 1.4826 for normal noise.
            false => 1.4826 * histogram.deviation(median, middle) as f64,
        };
        Start {
            median,
            scale: scale + 1.0,
            cut,
        }
    }
}

/// Minimum contrast of a line, in standard deviations of the darker rows. The contrast is the mean
/// count of the brightest half of the rows minus the mean count of the other rows.
///
/// If no line is present, the contrast of n rows has a standard error of 2/√n standard deviations.
/// From 16 rows on, the limit is at least twelve standard errors. The brightest of n/2 halves
/// reaches four or five. The standard deviation may be underestimated by a factor of two, because
/// half of few rows may be zeros.
const CONTRAST: f64 = 6.0;

/// Minimum excess of the rows closer to a line, in standard errors, that indicates a halo.
const HALO: f64 = 3.0;

/// Returns whether more than 1/16 of the rows may belong to a line. If a line covers at most half
/// of the rows, the darker half is noise. Twice the range of the darker half above the lowest count
/// bounds the noise.
fn may_be_wide(rows: usize, histogram: &CountHistogram) -> bool {
    let middle = histogram.value(rows.saturating_sub(1) / 2);
    let range = middle - histogram.value(0);
    // Four counts for rounding.
    let bound = middle.saturating_add(range).saturating_add(4);
    let bright = rows as u64 - histogram.moments(0, bound).0;
    16 * bright > rows as u64
}

/// Returns the contiguous half of the rows with the most light. The other rows are an almost
/// unbiased sample of the noise, because they are selected by position and not by counts.
fn brightest_half(counts: &[u16]) -> Range<usize> {
    let half = counts.len() / 2;
    let mut sum: u64 = counts[..half].iter().map(|&count| u64::from(count)).sum();
    let (mut first, mut most) = (0, sum);
    for row in half..counts.len() {
        sum = sum + u64::from(counts[row]) - u64::from(counts[row - half]);
        if sum > most {
            (first, most) = (row + 1 - half, sum);
        }
    }
    first..first + half
}

/// Returns the counts outside a line in order of decreasing distance from it.
fn outside(counts: &[u16], line: &Range<usize>) -> Vec<u16> {
    let center = line.start + line.end;
    let mut rows: Vec<usize> = (0..line.start).chain(line.end..counts.len()).collect();
    rows.sort_by_key(|row| Reverse((2 * row + 1).abs_diff(center)));
    rows.into_iter().map(|row| counts[row]).collect()
}

/// Returns the mean and the variance; the variance is at least the variance of rounding.
fn mean_and_variance(counts: &[u16]) -> [f64; 2] {
    let (n, sum, squares) = (counts.iter()).fold((0.0, 0.0, 0.0), |(n, sum, squares), &count| {
        let count = f64::from(count);
        (n + 1.0, sum + count, squares + count * count)
    });
    let mean = sum / n;
    [mean, (squares / n - mean * mean).max(ROUNDING * ROUNDING)]
}

/// Returns whether light of a line reaches all rows outside it. `outside` is sorted by decreasing
/// distance. The criterion is that the second quarter is brighter than the first. The tails of a
/// line that covers half of the rows end within the other two quarters.
fn has_halo(outside: &[u16]) -> bool {
    let quarter = outside.len() / 4;
    let quarters = [&outside[..quarter], &outside[quarter..2 * quarter]];
    let [[far, a], [near, b]] = quarters.map(mean_and_variance);
    near - far > HALO * ((a + b) / quarter as f64).sqrt()
}

/// Variance of a variance estimated from one half of normal noise, relative to an estimate from
/// both halves: 5σ⁴ compared with 2σ⁴.
const ONE_SIDED_VARIANCE: f64 = 2.5;

/// Returns the standard deviation of the counts above the median only.
///
/// If the black level lies within the noise, the sensor cuts off the lower half. The standard
/// deviation about the mean, `sigma`, is then too small by a factor of up to 1.7.
fn upper_deviation(histogram: &CountHistogram, median: u16, mut sigma: f64) -> f64 {
    sigma *= 1.7;
    for _ in 0..3 {
        let high = (median as f64 + 4.0 * sigma) as u16;
        let (mut n, mut squares) = (0u64, 0u64);
        for (value, times) in histogram.range(0, high) {
            n += times;
            squares += times * value.saturating_sub(median as u64).pow(2);
        }
        sigma = (2.0 * squares as f64 / n as f64).sqrt();
    }
    sigma
}

/// Histogram of the counts of a column. A column has a thousand pixels but only about a dozen
/// distinct values apart from its line. Quantiles and moments are therefore cheaper with a
/// histogram.
#[derive(Default)]
pub(super) struct CountHistogram {
    /// Four partial histograms, one for every fourth pixel. Adjacent pixels often have equal
    /// counts, and consecutive increments of one address would wait for each other.
    times: Vec<[u16; 4]>,
    highest: usize,
}

impl CountHistogram {
    /// Adds the counts of a column no longer than a sensor side; the histogram must be empty.
    ///
    /// `highest` is the largest individually stored count. Returns the largest count of the
    /// remaining pixels, or `None` if there are no remaining pixels.
    pub fn count(&mut self, column: &ColumnView, highest: u16) -> Option<u16> {
        self.reach(highest);
        let (fours, rest) = column.drawn().1.as_chunks::<4>();
        for pixels in fours {
            for (lane, &count) in pixels.iter().enumerate() {
                self.times[count as usize][lane] += 1;
            }
        }
        for &count in rest {
            self.times[count as usize][0] += 1;
        }
        let mut others = None;
        column.undrawn_histogram(&mut |count, times| {
            self.reach(count);
            // One lane cannot count all rows of the largest sensor.
            for (more, lane) in (0..).zip(&mut self.times[count as usize]) {
                *lane += ((times + more) / 4) as u16;
            }
            others = Some(count);
        });
        others
    }

    /// Extends the histogram to include `count`.
    fn reach(&mut self, count: u16) {
        self.highest = self.highest.max(count as usize);
        if self.times.len() <= self.highest {
            self.times.resize(self.highest + 1, [0; 4]);
        }
    }

    /// Returns the highest count of the column.
    pub fn highest(&self) -> u16 {
        self.highest as u16
    }

    /// Removes the counts of a column. `others` is the value returned by [`Self::count`].
    pub fn clear(&mut self, column: &ColumnView, others: Option<u16>) {
        let (_, drawn) = column.drawn();
        if self.highest < 2 * column.rows() {
            self.times[..=self.highest].fill([0; 4]);
        } else {
            let others = others.map_or(0, |highest| highest as usize + 1);
            self.times[..others].fill([0; 4]);
            for &count in drawn {
                self.times[count as usize] = [0; 4];
            }
        }
        self.highest = 0;
    }

    fn at(&self, value: usize) -> u64 {
        self.times[value].iter().map(|&times| times as u64).sum()
    }

    /// Returns the values from `low` to `high` with their frequencies.
    fn range(&self, low: u16, high: u16) -> impl Iterator<Item = (u64, u64)> + '_ {
        let high = self.highest.min(high as usize);
        (low as usize..=high).map(|value| (value as u64, self.at(value)))
    }

    /// Returns the count at index `place` of the sorted column.
    fn value(&self, place: usize) -> u16 {
        let mut below = 0;
        let passes = |value: &usize| {
            below += self.at(*value);
            below > place as u64
        };
        (0..=self.highest).find(passes).unwrap_or(self.highest) as u16
    }

    /// Returns the absolute deviation from `median` at index `place` of the sorted deviations.
    fn deviation(&self, median: u16, place: usize) -> u16 {
        let median = median as usize;
        let mut within = 0;
        let passes = |distance: &usize| {
            if let Some(below) = median.checked_sub(*distance) {
                within += self.at(below);
            }
            if *distance > 0 && median + distance <= self.highest {
                within += self.at(median + distance);
            }
            within > place as u64
        };
        let furthest = median.max(self.highest);
        (0..=furthest).find(passes).unwrap_or(furthest) as u16
    }

    /// Returns the number, the sum and the sum of squares of the counts from `low` to `high`.
    fn moments(&self, low: u16, high: u16) -> (u64, u64, u64) {
        let add = |(n, sum, squares), (value, times)| {
            let all = value * times;
            (n + times, sum + all, squares + value * all)
        };
        self.range(low, high).fold((0, 0, 0), add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use rand_distr::{Distribution, Normal};

    /// The reference value is ½·erfc(6/√2) = 9.866e-10.
    #[test]
    fn the_threshold_is_the_quantile() {
        let pixels = (FALSE_PEAKS_PER_FRAME / 9.866e-10) as usize;
        assert!((detection_sigmas(pixels) - 6.0).abs() < 1e-3);
        // Tabulated one-sided 0.0005 quantile of Student's t with 30 degrees of freedom. The third
        // term of the expansion is 0.01.
        assert!((students_quantile(3.2905, 30.0) - 3.646).abs() < 0.02);
    }

    /// The noise estimate is unbiased for noise of 3 counts, both uncut and cut at zero.
    ///
    /// The estimate has a standard error of 3/√(2·n) from both sides. From one half, it is larger
    /// by √2.5. The fourth moment is 3σ⁴, so the variance of 2x² over one half is 5σ⁴ and the
    /// variance of x² is 2σ⁴. Counts beyond four sigmas contribute 0.05 %. The tolerance is 5
    /// standard errors of 100 columns of 500 pixels (false alarm below 1e-6) plus the bias of the
    /// cut at the median. Rounding moves the median by up to half a count, which changes the
    /// variance by (½/3)². With the trimming of a narrower noise at 4 sigmas, the bias is 3 %.
    #[test]
    fn noise_is_measured_also_where_the_black_level_cuts_it() {
        let normal = Normal::new(0.0, 3.0).unwrap();
        for (black, bias) in [(100.0_f64, 0.001), (0.0, 0.03)] {
            let mut sum = 0.0;
            for column in 0..100 {
                let mut stream = RngKey::new(1, Purpose::SensorNoise)
                    .with(column)
                    .counter_stream();
                let counts: Vec<u16> = (0..500)
                    .map(|_| (black + normal.sample(&mut stream)).max(0.0).round() as u16)
                    .collect();
                let highest = *counts.iter().max().unwrap();
                let [mut histogram, mut scratch] =
                    [CountHistogram::default(), CountHistogram::default()];
                let column = ColumnView::from(&counts[..]);
                histogram.count(&column, highest);
                let found = background(&column, 6.0, &histogram, &mut scratch);
                sum += found.noise / 100.0;
            }
            let truth = (9.0f64 + 1.0 / 12.0).sqrt();
            let bound = bias + 5.0 * (2.5f64 / (2.0 * 50_000.0)).sqrt();
            assert!((sum / truth - 1.0).abs() < bound, "{black}: {sum}");
        }
    }

    /// The histogram agrees with the sorted column, for random columns with few and with many
    /// distinct values and of even and odd length.
    #[test]
    fn a_histogram_answers_as_the_sorted_column_does() {
        let key = RngKey::new(2, Purpose::SensorNoise);
        let mut histogram = CountHistogram::default();
        for (i, most) in [1.0, 3.0, 40.0, 1000.0].into_iter().enumerate() {
            for length in [1, 2, 101, 256] {
                let value = |j: u64| (key.with(i as u64).uniform(j) * most) as u16;
                let column: Vec<u16> = (0..length).map(value).collect();
                let mut sorted = column.clone();
                sorted.sort_unstable();
                histogram.count(&ColumnView::from(&column[..]), sorted[sorted.len() - 1]);
                let median = sorted[sorted.len() / 2];
                let mut distances: Vec<u16> = column.iter().map(|c| c.abs_diff(median)).collect();
                distances.sort_unstable();
                for place in [0, sorted.len() / 2, sorted.len() - 1] {
                    assert_eq!(histogram.value(place), sorted[place]);
                    assert_eq!(histogram.deviation(median, place), distances[place]);
                }
                let (low, high) = (median / 2, median.saturating_add(7));
                let inside = column.iter().filter(|c| (low..=high).contains(c));
                let inside: Vec<u64> = inside.map(|&c| c as u64).collect();
                let squares = inside.iter().map(|c| c * c).sum::<u64>();
                let sums = (inside.len() as u64, inside.iter().sum(), squares);
                assert_eq!(histogram.moments(low, high), sums);
                histogram.clear(&ColumnView::from(&column[..]), None);
            }
        }
        assert!(histogram.times.iter().all(|times| *times == [0; 4]));
    }
}
