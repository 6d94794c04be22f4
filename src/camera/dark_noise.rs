//! Counts of pixels without light, which are the majority.
//!
//! All dark pixels have one distribution. Sampling a count from a table of this distribution is
//! about ten times faster than rounding a normal number. For pixels whose positions are not needed,
//! only a histogram of the counts is sampled.

use super::{Noise, Sensor};
use crate::math::binomial::binomial;
use crate::math::rng::RngKey;
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::Range;

/// Number of pixels sampled at once.
const GROUP: usize = 8;
/// Number of cells sampled from 64 random bits.
const CELLS_PER_WORD: usize = 4;
/// Number of bits of a cell index. The table has 2^`CELL_BITS` cells of equal probability.
const CELL_BITS: usize = 13;
const CELLS: usize = 1 << CELL_BITS;
/// Marks a cell that contains more than one count. No cell with a single count has this value.
const SPLIT_CELL: u32 = u32::MAX;
/// Largest number of mixed cells for which a cell represents two pixels. The value affects speed
/// only.
const MOST_MIXED: usize = CELLS / 64;

/// Distribution of the counts of dark pixels, stored as the inverse of its cumulative distribution.
/// Probabilities are exact to 2⁻⁵².
pub struct DarkNoiseTable {
    /// Count of every cell; if `pairs`, plus 2¹⁶ times the count of a second pixel.
    cells: Box<[u32; CELLS]>,
    /// Whether a cell represents two pixels. It does if noise covers few counts.
    pairs: bool,
    /// Probability of a count of at most k.
    cumulative: Vec<f64>,
    /// Counts with non-zero probability, ascending.
    counts: Vec<u16>,
    /// Binary division of `counts`, in depth-first order with the lower part first.
    splits: Vec<Split>,
}

/// Division of a range of indices into `counts` into two parts.
struct Split {
    /// First index of the upper part.
    middle: usize,
    /// Probability that a count of the range is in the lower part.
    probability: f64,
    /// ln(1 − p), where p is the probability of the less probable part.
    ln_not: f64,
    /// Index of the split of the upper part, whether or not that part is divided.
    upper: usize,
}

/// Largest number of distinct counts for which the histogram is sampled by dividing the range.
/// Above it, sampling pixels from the table and counting them is faster. The value affects speed
/// only.
const MOST_DIVIDED: usize = 128;

/// Largest mean dark current for which the table is built, electrons. Above it, building the table
/// takes longer than simulating a frame.
const MOST_DARK_CURRENT: f64 = 1e3;

impl DarkNoiseTable {
    /// Builds the table. Returns `None` if the pixels have different distributions (`dsnu_e` > 0,
    /// or PRNU with ambient light), or if the mean of dark current and ambient light exceeds
    /// [`MOST_DARK_CURRENT`].
    pub fn new(sensor: &Sensor) -> Option<DarkNoiseTable> {
        let noise = sensor.noise.unwrap_or_default();
        let mean = sensor.dark_current_e(&noise) + sensor.ambient_e(&noise);
        if sensor.fixed_dark_noise_e() > 0.0 || mean > MOST_DARK_CURRENT {
            return None;
        }
        let full = sensor.full_well_e * sensor.gain_dn_per_e + sensor.black_level_dn;
        let dark = Electrons::new(sensor, &noise);
        let at_most = |k: u16| {
            // A count is at most k if the value before rounding is below k + ½.
            let border = k as f64 + 0.5;
            if k == sensor.max_count() || full < border {
                return 1.0;
            }
            dark.below((border - sensor.black_level_dn) / sensor.gain_dn_per_e)
        };
        let cumulative: Vec<f64> = (0..=sensor.max_count()).map(at_most).collect();
        let below = |k: u16| k.checked_sub(1).map_or(0.0, |k| cumulative[k as usize]);
        let drawn = |k: &u16| cumulative[*k as usize] > below(*k).max(f64::EPSILON);
        let counts = (0..=sensor.max_count()).filter(drawn).collect();
        let mut dark = DarkNoiseTable {
            cells: Box::new([SPLIT_CELL; CELLS]),
            pairs: true,
            cumulative,
            counts,
            splits: Vec::new(),
        };
        dark.fill_cells();
        let mixed = dark
            .cells
            .iter()
            .filter(|cell| **cell == SPLIT_CELL)
            .count();
        if mixed > MOST_MIXED {
            dark.pairs = false;
            dark.fill_cells();
        }
        dark.split(0..dark.counts.len());
        Some(dark)
    }

    /// Divides a range of counts recursively, each time as close to its median as possible.
    fn split(&mut self, counts: Range<usize>) {
        if counts.len() < 2 {
            return;
        }
        // Counts between consecutive entries have zero probability.
        let below = |place: usize| match place {
            0 => 0.0,
            place => self.cumulative[self.counts[place - 1] as usize],
        };
        let (low, high) = (below(counts.start), below(counts.end));
        let lower = |middle: usize| (below(middle) - low) / (high - low);
        let off = |middle: &usize| (lower(*middle) - 0.5).abs();
        let middles = counts.start + 1..counts.end;
        let middle = middles.min_by(|a, b| off(a).total_cmp(&off(b)));
        let middle = middle.expect("it has two counts");
        let chance = lower(middle);
        let own = self.splits.len();
        self.splits.push(Split {
            middle,
            probability: chance,
            ln_not: (-chance.min(1.0 - chance)).ln_1p(),
            upper: 0,
        });
        self.split(counts.start..middle);
        self.splits[own].upper = self.splits.len();
        self.split(middle..counts.end);
    }

    /// Samples the histogram of the counts of `pixels` dark pixels. Calls `is(count, times)` for
    /// every count that occurs, in ascending order. The result is distributed as the histogram of
    /// independently sampled pixels; the probabilities of each binomial number are accurate to
    /// 5e-5.
    pub fn histogram(&self, pixels: u32, key: RngKey, is: &mut impl FnMut(u16, u32)) {
        if self.counts.len() <= MOST_DIVIDED {
            return self.divide(0..self.counts.len(), 0, pixels, key, is);
        }
        let first = self.counts[0];
        let last = self.counts[self.counts.len() - 1];
        let mut times = vec![0; usize::from(last - first) + 1];
        for from in (0..pixels).step_by(GROUP) {
            let drawn = self.group(key, u64::from(from) / GROUP as u64);
            for count in drawn.into_iter().take((pixels - from) as usize) {
                times[usize::from(count - first)] += 1;
            }
        }
        let counted = (first..=last).zip(times);
        counted
            .filter(|&(_, times)| times > 0)
            .for_each(|(count, times)| is(count, times));
    }

    fn divide(
        &self,
        counts: Range<usize>,
        split: usize,
        pixels: u32,
        key: RngKey,
        is: &mut impl FnMut(u16, u32),
    ) {
        if pixels == 0 {
            return;
        }
        if counts.len() == 1 {
            return is(self.counts[counts.start], pixels);
        }
        let own = &self.splits[split];
        let lower = binomial(pixels, own.probability, own.ln_not, key.with(split as u64));
        self.divide(counts.start..own.middle, split + 1, lower, key, is);
        self.divide(own.middle..counts.end, own.upper, pixels - lower, key, is);
    }

    fn fill_cells(&mut self) {
        for cell in 0..CELLS {
            let edge = |i: usize| i as f64 / CELLS as f64;
            let (counts, end) = self.quantiles(edge(cell));
            let whole = end >= edge(cell + 1);
            self.cells[cell] = if whole { counts } else { SPLIT_CELL };
        }
    }

    /// Returns the counts of a cell's pixels for `u` in [0, 1), and the value of `u` at which these
    /// counts change.
    fn quantiles(&self, mut u: f64) -> (u32, f64) {
        let (mut counts, mut start, mut chance) = (0, 0.0, 1.0);
        for pixel in 0..1 + u32::from(self.pairs) {
            let count = self.cumulative.partition_point(|&c| c <= u);
            let below = count.checked_sub(1).map_or(0.0, |k| self.cumulative[k]);
            let own = self.cumulative[count] - below;
            counts |= (count as u32) << (16 * pixel);
            u = ((u - below) / own).min(1.0f64.next_down());
            start += chance * below;
            chance *= own;
        }
        (counts, start + chance)
    }

    /// Samples the counts of the dark pixels with the given indices.
    pub fn draw(&self, pixels: Range<usize>, key: RngKey, counts: &mut [u16]) {
        for group in pixels.start / GROUP..pixels.end.div_ceil(GROUP) {
            let first = GROUP * group;
            let wanted = first.max(pixels.start)..(first + GROUP).min(pixels.end);
            let drawn = self.group(key, group as u64);
            // A length known at compile time is copied as one vector.
            match wanted.len() {
                GROUP => counts[first - pixels.start..][..GROUP].copy_from_slice(&drawn),
                some => counts[wanted.start - pixels.start..][..some]
                    .copy_from_slice(&drawn[wanted.start - first..][..some]),
            }
        }
    }

    // Inlined, because a call would return the array through memory and stall on it.
    #[inline(always)]
    fn group(&self, key: RngKey, group: u64) -> [u16; GROUP] {
        // Values stay in registers; arrays would stall on store forwarding.
        let words = match self.pairs {
            true => {
                let [a, b, c, d] = self.draw_cells(key, group);
                [a | b << 32, c | d << 32]
            }
            false => [0, 1].map(|half| {
                let [a, b, c, d] = self.draw_cells(key, 2 * group + half);
                a | b << 16 | c << 32 | d << 48
            }),
        };
        std::array::from_fn(|i| (words[i / 4] >> (16 * (i % 4))) as u16)
    }

    /// Samples the contents of cells from the 64 random bits with the given number.
    #[inline(always)]
    fn draw_cells(&self, key: RngKey, number: u64) -> [u64; CELLS_PER_WORD] {
        let bits = key.bits(number);
        let mut drawn = std::array::from_fn(|i| self.cells[cell(bits, i)]);
        if drawn.contains(&SPLIT_CELL) {
            drawn = self.settled(drawn, bits, key.with(number));
        }
        drawn.map(u64::from)
    }

    /// Replaces the mixed cells by counts sampled within the cell.
    #[cold]
    fn settled(
        &self,
        drawn: [u32; CELLS_PER_WORD],
        bits: u64,
        key: RngKey,
    ) -> [u32; CELLS_PER_WORD] {
        std::array::from_fn(|i| match drawn[i] {
            SPLIT_CELL => {
                let within = key.uniform(i as u64);
                self.quantiles((cell(bits, i) as f64 + within) / CELLS as f64)
                    .0
            }
            counts => counts,
        })
    }
}

/// Distribution of the electrons of a pixel without light.
struct Electrons {
    read_noise_e: f64,
    /// Numbers of dark-current electrons and their probabilities.
    current: Vec<(f64, f64)>,
}

impl Electrons {
    fn new(sensor: &Sensor, noise: &Noise) -> Electrons {
        let mean = sensor.dark_current_e(noise) + sensor.ambient_e(noise);
        // Nine standard deviations, plus a margin for the longer tails of small means. The omitted
        // probability is below 2⁻⁵².
        let reach = 9.0 * mean.sqrt() + 20.0;
        let numbers = (mean - reach).max(0.0).floor() as u64..=(mean + reach) as u64;
        let chance = |k: u64| {
            let k = k as f64;
            let log = if mean > 0.0 { k * mean.ln() } else { 0.0 };
            let never = mean == 0.0 && k > 0.0;
            (
                k,
                if never {
                    0.0
                } else {
                    (log - mean - libm::lgamma(k + 1.0)).exp()
                },
            )
        };
        let mut current: Vec<(f64, f64)> = numbers.map(chance).filter(|&(_, c)| c > 0.0).collect();
        // The logarithms of large numbers are rounded, so the probabilities are normalised.
        let all: f64 = current.iter().map(|(_, chance)| chance).sum();
        current.iter_mut().for_each(|(_, chance)| *chance /= all);
        Electrons {
            read_noise_e: noise.read_noise_e,
            current,
        }
    }

    /// Returns the probability of fewer than `electrons` electrons.
    fn below(&self, electrons: f64) -> f64 {
        // The probability beyond nine standard deviations is below 2⁻⁵².
        let reach = 9.0 * self.read_noise_e;
        match &self.current[..] {
            [least, ..] if electrons < least.0 - reach => return 0.0,
            [.., most] if electrons > most.0 + reach => return 1.0,
            _ => {}
        }
        let of_reading = |more: f64| match self.read_noise_e > 0.0 {
            true => 0.5 * libm::erfc(-more / self.read_noise_e * FRAC_1_SQRT_2),
            false => f64::from(more > 0.0),
        };
        let chances = self.current.iter();
        let sum: f64 = chances
            .map(|(k, chance)| chance * of_reading(electrons - k))
            .sum();
        sum.min(1.0)
    }
}

/// Returns the `i`-th cell index encoded in the random bits.
fn cell(bits: u64, i: usize) -> usize {
    (bits >> (CELL_BITS * i)) as usize % CELLS
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Noise;
    use crate::math::rng::Purpose;
    use glam::UVec2;

    fn sensor(black_level_dn: f64, full_well_e: f64, read_noise_e: f64) -> Sensor {
        Sensor {
            off_middle: glam::DVec2::ZERO,
            readout_ms: 0.0,
            resolution: UVec2::new(4, 4),
            pixel_pitch: 0.005,
            exposure_ms: 2.0,
            shorter: Vec::new(),
            quantum_efficiency: 0.6,
            gain_dn_per_e: 0.25,
            bit_depth: 8,
            full_well_e,
            black_level_dn,
            noise: Some(Noise {
                read_noise_e,
                ..Noise::default()
            }),
        }
    }

    /// Sensors with a black level within the range, clipped at zero, and clipped at a full well of
    /// 2 electrons. Noise covers few counts, many counts or none. Dark current occurs with and
    /// without read noise.
    fn sensors() -> Vec<Sensor> {
        let of_reading = [
            (100.0, 1e4, 6.0),
            (100.3, 1e4, 2.0),
            (0.3, 1e4, 6.0),
            (0.3, 1e4, 2.0),
            (100.2, 2.0, 6.0),
            (254.0, 1e4, 6.0),
            (60.0, 1e4, 30.0),
            (120.0, 1e4, 60.0),
            (60.3, 1e4, 0.0),
        ];
        let mut sensors: Vec<Sensor> = of_reading.map(|(b, f, r)| sensor(b, f, r)).into();
        for (current, read) in [(1e3, 6.0), (4e4, 2.0), (4e4, 0.0)] {
            let mut sensor = sensor(20.3, 1e4, read);
            sensor.noise.as_mut().unwrap().dark_current_e_per_s = current;
            sensors.push(sensor);
        }
        sensors
    }

    /// Two-sample χ² test over the counts that occur at least 20 times per sample. With k such
    /// counts, χ² has mean k − 1 and standard deviation √(2(k − 1)). Six standard deviations above
    /// the mean are exceeded with a probability below 1e-6.
    fn compare(drawn: &[f64; 256], truth: &[f64; 256], what: &dyn std::fmt::Debug) {
        let pairs = drawn.iter().zip(truth).filter(|&(a, b)| a + b >= 40.0);
        let k = pairs.clone().count() as f64;
        let chi2: f64 = pairs.map(|(a, b)| (a - b).powi(2) / (a + b)).sum();
        let bound = k - 1.0 + 6.0 * (2.0 * (k - 1.0)).sqrt();
        assert!(chi2 <= bound.max(12.0), "{what:?}: {chi2} > {bound}");
    }

    /// Frequencies of n = 200 000 counts agree with the frequencies from `Sensor::count`.
    #[test]
    fn counts_are_distributed_as_those_drawn_one_by_one() {
        let mut paired = [0; 2];
        for sensor in sensors() {
            let dark = DarkNoiseTable::new(&sensor).unwrap();
            paired[usize::from(dark.pairs)] += 1;
            let key = RngKey::new(4, Purpose::SensorNoise);
            let n = 200_000;
            let [mut drawn, mut of_many, mut truth] = [[0.0f64; 256]; 3];
            for group in 0..n / GROUP as u64 {
                for count in dark.group(key, group) {
                    drawn[count as usize] += 1.0;
                }
            }
            for column in 0..n / 1000 {
                dark.histogram(1000, key.with(column), &mut |count, times| {
                    of_many[count as usize] += f64::from(times);
                });
            }
            for i in 0..n {
                truth[sensor.count(0.0, key.with(9).with(i)) as usize] += 1.0;
            }
            assert_eq!(of_many.iter().sum::<f64>(), n as f64);
            compare(&drawn, &truth, &sensor);
            compare(&of_many, &truth, &sensor);
        }
        assert!(paired[0] > 0 && paired[1] > 0, "{paired:?}");
    }

    /// Histogram frequencies have the covariance of independently sampled pixels. For 4000 columns
    /// of n = 500 pixels, the covariance of the frequencies of two counts is n·(p·δ − p·q). The
    /// frequencies are nearly normal (20 or more expected). A covariance c of variances v and w
    /// therefore has a standard error of √((v·w + c²)/4000). One of about 100 pairs exceeds 5.5
    /// standard errors with a probability of 4e-6.
    #[test]
    fn times_scatter_as_those_of_pixels_by_themselves() {
        for sensor in [
            sensor(100.3, 1e4, 6.0),
            sensor(0.3, 1e4, 6.0),
            sensor(100.3, 1e4, 12.0),
        ] {
            let dark = DarkNoiseTable::new(&sensor).unwrap();
            let (columns, n) = (4000, 500.0);
            let chance = |k: usize| {
                dark.cumulative[k] - k.checked_sub(1).map_or(0.0, |k| dark.cumulative[k])
            };
            let often: Vec<usize> = (0..256).filter(|&k| n * chance(k) >= 20.0).collect();
            assert!(often.len() >= 4);
            let mut products = vec![0.0; often.len() * often.len()];
            for column in 0..columns {
                let mut off = [0.0; 256];
                let key = RngKey::new(8, Purpose::SensorNoise).with(column);
                dark.histogram(500, key, &mut |k, times| off[k as usize] = f64::from(times));
                for (i, product) in products.iter_mut().enumerate() {
                    let [a, b] = [often[i / often.len()], often[i % often.len()]];
                    *product += (off[a] - n * chance(a)) * (off[b] - n * chance(b));
                }
            }
            for (i, product) in products.iter().enumerate() {
                let (a, b) = (often[i / often.len()], often[i % often.len()]);
                let (p, q) = (chance(a), chance(b));
                let expected = n * (if a == b { p } else { 0.0 } - p * q);
                let variances = n * p * (1.0 - p) * n * q * (1.0 - q);
                let error = ((variances + expected * expected) / columns as f64).sqrt();
                let found = product / columns as f64;
                assert!(
                    (found - expected).abs() < 5.5 * error,
                    "{a} {b}: {found} {expected}"
                );
            }
        }
    }

    /// Neighbouring pixels are statistically independent. The frequencies of pairs of counts are
    /// compared with the products of their probabilities. The χ² test covers pairs expected at
    /// least 20 times and has the bound of `compare`. Tested are the two pixels of one cell, and
    /// the last pixel of a cell with the first pixel of the next.
    #[test]
    fn neighbours_are_independent() {
        for noise in [2.0, 30.0] {
            let dark = DarkNoiseTable::new(&sensor(100.3, 1e4, noise)).unwrap();
            let key = RngKey::new(5, Purpose::SensorNoise);
            let groups = 400_000;
            let mut times = [(); 2].map(|_| vec![0.0f64; 256 * 256]);
            for counts in (0..groups).map(|group| dark.group(key, group)) {
                for (times, first) in times.iter_mut().zip([2, 3]) {
                    times[counts[first] as usize * 256 + counts[first + 1] as usize] += 1.0;
                }
            }
            let below = |k: usize| k.checked_sub(1).map_or(0.0, |k| dark.cumulative[k]);
            let chance = |k: usize| dark.cumulative[k] - below(k);
            for times in times {
                let expected = |i: usize| groups as f64 * chance(i / 256) * chance(i % 256);
                let seen = (0..times.len()).filter(|&i| expected(i) >= 20.0);
                let k = seen.clone().count() as f64;
                let chi2: f64 = seen
                    .map(|i| (times[i] - expected(i)).powi(2) / expected(i))
                    .sum();
                let bound = k - 1.0 + 6.0 * (2.0 * (k - 1.0)).sqrt();
                assert!(chi2 <= bound, "{noise}: {chi2} > {bound}, {k} pairs");
            }
        }
    }

    /// The far tail has the correct probability. A frame of 10⁶ dark pixels has on average 0.67
    /// pixels at 4.83 standard deviations or more above the mean. Among 4000 frames, the number
    /// without such a pixel is binomial. The bound is 5 standard deviations (false alarm below
    /// 1e-6).
    #[test]
    fn counts_far_from_the_middle_are_as_rare_as_they_are() {
        let sensor = sensor(100.0, 1e4, 12.0);
        let dark = DarkNoiseTable::new(&sensor).unwrap();
        // σ is 3 counts, and the count 115 begins at 114.5, which is 4.83 σ above the mean.
        let pixel = 0.5 * libm::erfc(14.5 / 3.0 * FRAC_1_SQRT_2);
        let none = (-1e6 * pixel).exp();
        let mut without = 0.0;
        for frame in 0..4000 {
            let key = RngKey::new(9, Purpose::SensorNoise).with(frame);
            let mut highest = 0;
            dark.histogram(1_000_000, key, &mut |count, _| highest = count);
            without += f64::from(u32::from(highest < 115));
        }
        let deviation = (4000.0 * none * (1.0 - none)).sqrt();
        let off = without - 4000.0 * none;
        assert!(off.abs() < 5.0 * deviation, "{without} {}", 4000.0 * none);
    }

    /// The table of a sensor without noise has one count. No table is built for pixels of different
    /// distributions or for a large dark current.
    #[test]
    fn a_table_is_of_pixels_that_are_alike() {
        let mut silent = sensor(100.0, 1e4, 6.0);
        silent.noise = None;
        let dark = DarkNoiseTable::new(&silent).unwrap();
        assert_eq!(dark.counts, [100]);
        let noise = |dark_current_e_per_s, dsnu_e| {
            let mut sensor = sensor(100.0, 1e4, 6.0);
            sensor.noise = Some(Noise {
                dark_current_e_per_s,
                dsnu_e,
                ..Noise::default()
            });
            DarkNoiseTable::new(&sensor).is_some()
        };
        assert!(noise(1e5, 0.0) && !noise(1e5, 1.0) && !noise(1e6, 0.0));
    }
}
