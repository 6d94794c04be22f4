//! The background of a column, and what stands out from it.

use crate::camera::Column;
use std::cmp::Reverse;
use std::ops::Range;

/// Peaks expected per frame in which no light falls on the sensor.
pub const FALSE_PEAKS_PER_FRAME: f64 = 1e-3;

/// Standard deviation of rounding to whole counts.
const ROUNDING: f64 = 0.288_675_134_594_812_9;

/// What a column holds without its line, counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Background {
    pub mean: f64,
    pub noise: f64,
    /// Height above the mean from which on a pixel is no noise.
    pub threshold: f64,
}

/// Standard deviations that normal noise passes [`FALSE_PEAKS_PER_FRAME`] times in
/// a frame of `pixels`: 6.0 for 1280 × 512.
pub(super) fn detection_sigmas(pixels: usize) -> f64 {
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

/// The same quantile `z` where the deviation is itself estimated with `freedom`
/// degrees of freedom: Student's t, by the first two terms of Fisher & Cornish
/// (1960).
fn students_quantile(z: f64, freedom: f64) -> f64 {
    let first = (z.powi(3) + z) / 4.0;
    let second = (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0;
    z + first / freedom + second / (freedom * freedom)
}

/// Counts above the background that a line of a frame of `pixels` has at least, if the
/// background's noise is `noise` counts and is known well.
pub fn least_height(pixels: usize, noise: f64) -> f64 {
    detection_sigmas(pixels) * noise.max(ROUNDING)
}

/// Returns the background of a column with this histogram. It is estimated from all rows, unless a line covers many of
/// them: then only from the rows outside the line. If a halo of the line reaches all of these, the mean is estimated
/// from all rows and includes the halo up to the threshold. `scratch` is an empty histogram and is empty again
/// afterwards.
pub(super) fn background(
    column: &Column,
    z: f64,
    histogram: &Histogram,
    scratch: &mut Histogram,
) -> Background {
    let rows = column.rows();
    let of_all = background_from(&Start::of(rows, histogram), z, histogram);
    if !may_be_wide(rows, histogram) {
        return of_all;
    }
    let whole = column.whole();
    let counts = whole.drawn().1;
    let line = brightest_half(counts);
    let outside = outside(counts, &line);
    let [inside, [mean, variance]] = [&counts[line], &outside[..]].map(mean_and_variance);
    if inside[0] - mean < CONTRAST * variance.sqrt() {
        return of_all;
    }
    let column = Column::from(&outside[..]);
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
fn background_from(start: &Start, z: f64, histogram: &Histogram) -> Background {
    let (mut mean, mut sigma) = (start.median as f64, start.scale);
    // A halo around the line would widen the limits at each step.
    let limit = 1.5 * sigma;
    let (mut kept, mut high) = (0, 0);
    // Each round ends with other counts kept or is the last; ten are plenty.
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
        // The cut removes low counts only; `high` bounds the line's.
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
    fn of(rows: usize, histogram: &Histogram) -> Start {
        let middle = rows / 2;
        let median = histogram.value(middle);
        // Of normal noise that lies two deviations above zero 2.3 % is cut off.
        let cut = 50 * histogram.at(0) > rows as u64;
        let scale = match cut {
            // One deviation above the median; all below may be zeros.
            true => {
                let rank = (0.68 * (rows - middle) as f64) as usize;
                (histogram.value(middle + rank) - median) as f64
            }
            // ×1.4826 for normal noise.
            false => 1.4826 * histogram.deviation(median, middle) as f64,
        };
        Start {
            median,
            scale: scale + 1.0,
            cut,
        }
    }
}

/// Least difference of the mean counts in the brightest half of the rows and in the others, in standard deviations of
/// the latter, from which a line is in that half. For n rows without a line the difference has a standard error of 2/√n
/// deviations: from 16 rows on the limit is twelve of them, where the brightest of n/2 halves reaches four or five. The
/// deviation itself may be underestimated by two, as half of few rows may be zeros.
const CONTRAST: f64 = 6.0;

/// Standard errors by which rows nearer to a line are brighter where it has a halo.
const HALO: f64 = 3.0;

/// Returns whether more than 1/16 of the rows may belong to a line. If a line covers at most half of the rows, the
/// darker half are noise, and twice their range above the lowest count bounds the noise.
fn may_be_wide(rows: usize, histogram: &Histogram) -> bool {
    let middle = histogram.value(rows.saturating_sub(1) / 2);
    let range = middle - histogram.value(0);
    // Four counts for rounding.
    let bound = middle.saturating_add(range).saturating_add(4);
    let bright = rows as u64 - histogram.moments(0, bound).0;
    16 * bright > rows as u64
}

/// Returns the contiguous half of the rows with the most light. The other rows are an almost unbiased sample of the
/// noise, as they are selected by place and not by counts.
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

/// Returns the counts outside a line, the farthest first.
fn outside(counts: &[u16], line: &Range<usize>) -> Vec<u16> {
    let center = line.start + line.end;
    let mut rows: Vec<usize> = (0..line.start).chain(line.end..counts.len()).collect();
    rows.sort_by_key(|row| Reverse((2 * row + 1).abs_diff(center)));
    rows.into_iter().map(|row| counts[row]).collect()
}

/// Returns mean and variance, at least the variance of rounding.
fn mean_and_variance(counts: &[u16]) -> [f64; 2] {
    let (n, sum, squares) = (counts.iter()).fold((0.0, 0.0, 0.0), |(n, sum, squares), &count| {
        let count = f64::from(count);
        (n + 1.0, sum + count, squares + count * count)
    });
    let mean = sum / n;
    [mean, (squares / n - mean * mean).max(ROUNDING * ROUNDING)]
}

/// Returns whether light of a line reaches all rows outside it, which are given from the farthest on: the second quarter
/// of them is brighter than the first. The tails of a line itself, which covers half of the rows, end within the other two.
fn has_halo(outside: &[u16]) -> bool {
    let quarter = outside.len() / 4;
    let quarters = [&outside[..quarter], &outside[quarter..2 * quarter]];
    let [[far, a], [near, b]] = quarters.map(mean_and_variance);
    near - far > HALO * ((a + b) / quarter as f64).sqrt()
}

/// Variance of a variance that is estimated from one half of normal noise over
/// that from both: 5σ⁴ against 2σ⁴.
const ONE_SIDED_VARIANCE: f64 = 2.5;

/// Standard deviation by the counts above the median alone, half of all: where the
/// black level lies in the noise, the sensor cuts the lower half off, and the
/// deviation from the mean, `sigma`, is too small by up to 1.7.
fn upper_deviation(histogram: &Histogram, median: u16, mut sigma: f64) -> f64 {
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

/// How often each count stands in a column. A column holds a thousand pixels and,
/// but for its line, a dozen values: what is asked of it is cheaper asked of these.
#[derive(Default)]
pub(super) struct Histogram {
    /// Of every fourth pixel from each of the first four: neighbours are often alike,
    /// and an increment waits for the one before it in the same place.
    times: Vec<[u16; 4]>,
    highest: usize,
}

impl Histogram {
    /// Counts a column no longer than a sensor's side; the histogram must be empty. Of the counts
    /// that are drawn the highest is this. Gives the highest of those that are not.
    pub fn count(&mut self, column: &Column, highest: u16) -> Option<u16> {
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
        column.others(&mut |count, times| {
            self.reach(count);
            // All rows of the largest sensor do not fit one lane.
            for (more, lane) in (0..).zip(&mut self.times[count as usize]) {
                *lane += ((times + more) / 4) as u16;
            }
            others = Some(count);
        });
        others
    }

    /// Makes room for a count.
    fn reach(&mut self, count: u16) {
        self.highest = self.highest.max(count as usize);
        if self.times.len() <= self.highest {
            self.times.resize(self.highest + 1, [0; 4]);
        }
    }

    /// The highest count of the column.
    pub fn highest(&self) -> u16 {
        self.highest as u16
    }

    /// Empties it of the counts of a column, of whose others this is the highest.
    pub fn clear(&mut self, column: &Column, others: Option<u16>) {
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

    /// Values from `low` to `high` and how often each is there.
    fn range(&self, low: u16, high: u16) -> impl Iterator<Item = (u64, u64)> + '_ {
        let high = self.highest.min(high as usize);
        (low as usize..=high).map(|value| (value as u64, self.at(value)))
    }

    /// The count at a place of the sorted column.
    fn value(&self, place: usize) -> u16 {
        let mut below = 0;
        let passes = |value: &usize| {
            below += self.at(*value);
            below > place as u64
        };
        (0..=self.highest).find(passes).unwrap_or(self.highest) as u16
    }

    /// The distance from `median` at a place of the column sorted by it.
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

    /// Number, sum and sum of squares of the counts from `low` to `high`.
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
    use crate::math::rng::{Key, Purpose};
    use rand_distr::{Distribution, Normal};

    /// ½·erfc(6/√2) = 9.866e-10.
    #[test]
    fn the_threshold_is_the_quantile() {
        let pixels = (FALSE_PEAKS_PER_FRAME / 9.866e-10) as usize;
        assert!((detection_sigmas(pixels) - 6.0).abs() < 1e-3);
        // One-sided 0.0005 of Student's t with 30 degrees of freedom, by tables;
        // the third term is 0.01.
        assert!((students_quantile(3.2905, 30.0) - 3.646).abs() < 0.02);
    }

    /// Noise of 3 counts on a black level amid the range, and cut at zero: the
    /// estimate has standard error 3/√(2·n) two-sided and √2.5 times as much from
    /// one half (fourth moment 3σ⁴ over a half: variance of 2x² over one half is
    /// 5σ⁴, of x² 2σ⁴), plus what lies beyond four sigmas, 0.05 %. Bounds: 5
    /// standard errors of 100 columns of 500 pixels, false alarm under 1e-6, and
    /// the bias of the cut at the median, which rounding moves by up to half a
    /// count: (½/3)² of the deviation and the trimming at 4 sigmas of a narrower
    /// noise: 3 %.
    #[test]
    fn noise_is_measured_also_where_the_black_level_cuts_it() {
        let normal = Normal::new(0.0, 3.0).unwrap();
        for (black, bias) in [(100.0_f64, 0.001), (0.0, 0.03)] {
            let mut sum = 0.0;
            for column in 0..100 {
                let mut stream = Key::new(1, Purpose::SensorNoise).with(column).stream();
                let counts: Vec<u16> = (0..500)
                    .map(|_| (black + normal.sample(&mut stream)).max(0.0).round() as u16)
                    .collect();
                let highest = *counts.iter().max().unwrap();
                let [mut histogram, mut scratch] = [Histogram::default(), Histogram::default()];
                let column = Column::from(&counts[..]);
                histogram.count(&column, highest);
                let found = background(&column, 6.0, &histogram, &mut scratch);
                sum += found.noise / 100.0;
            }
            let truth = (9.0f64 + 1.0 / 12.0).sqrt();
            let bound = bias + 5.0 * (2.5f64 / (2.0 * 50_000.0)).sqrt();
            assert!((sum / truth - 1.0).abs() < bound, "{black}: {sum}");
        }
    }

    /// What a histogram says against the sorted column, random columns of few and of
    /// many values, of even and odd length.
    #[test]
    fn a_histogram_answers_as_the_sorted_column_does() {
        let key = Key::new(2, Purpose::SensorNoise);
        let mut histogram = Histogram::default();
        for (i, most) in [1.0, 3.0, 40.0, 1000.0].into_iter().enumerate() {
            for length in [1, 2, 101, 256] {
                let value = |j: u64| (key.with(i as u64).uniform(j) * most) as u16;
                let column: Vec<u16> = (0..length).map(value).collect();
                let mut sorted = column.clone();
                sorted.sort_unstable();
                histogram.count(&Column::from(&column[..]), sorted[sorted.len() - 1]);
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
                histogram.clear(&Column::from(&column[..]), None);
            }
        }
        assert!(histogram.times.iter().all(|times| *times == [0; 4]));
    }
}
