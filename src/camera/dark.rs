//! Counts of pixels that see no light, which are most. All have one distribution: by its table each is
//! drawn some ten times faster than as a rounded normal number; and of many, whose places nobody
//! asks for, only how often each count is there.

use super::{Noise, Sensor};
use crate::math::binomial::binomial;
use crate::math::rng::Key;
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::Range;

/// Pixels drawn at a time.
const GROUP: usize = 8;
/// Cells drawn from 64 random bits.
const DRAWN: usize = 4;
/// Bits of a cell's number: so many cells of equal probability.
const CELL_BITS: usize = 13;
const CELLS: usize = 1 << CELL_BITS;
/// A cell in which counts meet. (Were this its counts, they would be found there.)
const MIXED: u32 = u32::MAX;
/// With more mixed cells than these a cell is of one pixel: a choice of speed alone.
const MOST_MIXED: usize = CELLS / 64;

/// The distribution of the counts of dark pixels, by the inverse of its cumulative distribution, exact to
/// 2⁻⁵².
pub struct DarkCounts {
    /// The counts all over a cell: of a pixel, and 2¹⁶ times that of another.
    cells: Box<[u32; CELLS]>,
    /// Whether a cell is of two pixels: where noise is of few counts.
    pairs: bool,
    /// Chance of a count of at most k.
    cumulative: Vec<f64>,
    /// The counts that are drawn at all, from the lowest on.
    counts: Vec<u16>,
    /// How these are divided, a range before its parts, of which the lower comes first.
    splits: Vec<Split>,
}

/// A range of places among the counts in two.
struct Split {
    /// The first of the upper part.
    middle: usize,
    /// That a count of the range is in the lower part.
    chance: f64,
    /// ln(1 − chance) of the rarer part.
    ln_not: f64,
    /// Number of the split of the upper part, or the one that it would have.
    upper: usize,
}

/// With more counts than these, drawing pixels by the table and counting them is faster than dividing the range: a
/// choice of speed alone.
const MOST_DIVIDED: usize = 128;

/// Electrons of dark current up to which the table is made: beyond, its making takes longer than a frame.
const MOST_DARK_CURRENT: f64 = 1e3;

impl DarkCounts {
    /// `None` where each pixel has a distribution of its own, as `dsnu_e` makes them differ, or where more
    /// than [`MOST_DARK_CURRENT`] comes without light.
    pub fn new(sensor: &Sensor) -> Option<DarkCounts> {
        let noise = sensor.noise.unwrap_or_default();
        if noise.dsnu_e > 0.0 || sensor.dark_current_e(&noise) > MOST_DARK_CURRENT {
            return None;
        }
        let full = sensor.full_well_e * sensor.gain_dn_per_e + sensor.black_level_dn;
        let dark = Electrons::new(sensor, &noise);
        let at_most = |k: u16| {
            // A count is at most k where the unrounded one is below k + ½.
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
        let mut dark = DarkCounts {
            cells: Box::new([MIXED; CELLS]),
            pairs: true,
            cumulative,
            counts,
            splits: Vec::new(),
        };
        dark.fill_cells();
        let mixed = dark.cells.iter().filter(|cell| **cell == MIXED).count();
        if mixed > MOST_MIXED {
            dark.pairs = false;
            dark.fill_cells();
        }
        dark.split(0..dark.counts.len());
        Some(dark)
    }

    /// Divides a range of the counts where half of what is drawn is on either side, as nearly as there is a
    /// place.
    fn split(&mut self, counts: Range<usize>) {
        if counts.len() < 2 {
            return;
        }
        // Those between are not drawn.
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
            chance,
            ln_not: (-chance.min(1.0 - chance)).ln_1p(),
            upper: 0,
        });
        self.split(counts.start..middle);
        self.splits[own].upper = self.splits.len();
        self.split(middle..counts.end);
    }

    /// How often each count is there among so many dark pixels: `is(count, times)` for each that is, from the
    /// lowest on. The same as if each pixel was drawn by itself, each binomial number to 5e-5 of its shares.
    pub fn times(&self, pixels: u32, key: Key, is: &mut impl FnMut(u16, u32)) {
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
        key: Key,
        is: &mut impl FnMut(u16, u32),
    ) {
        if pixels == 0 {
            return;
        }
        if counts.len() == 1 {
            return is(self.counts[counts.start], pixels);
        }
        let own = &self.splits[split];
        let lower = binomial(pixels, own.chance, own.ln_not, key.with(split as u64));
        self.divide(counts.start..own.middle, split + 1, lower, key, is);
        self.divide(own.middle..counts.end, own.upper, pixels - lower, key, is);
    }

    fn fill_cells(&mut self) {
        for cell in 0..CELLS {
            let edge = |i: usize| i as f64 / CELLS as f64;
            let (counts, end) = self.quantiles(edge(cell));
            let whole = end >= edge(cell + 1);
            self.cells[cell] = if whole { counts } else { MIXED };
        }
    }

    /// The counts of a cell's pixels that are drawn by a number `u` in [0, 1), and the
    /// number from which on they are others.
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

    /// Draws the counts of the dark pixels with these numbers.
    pub fn draw(&self, pixels: Range<usize>, key: Key, counts: &mut [u16]) {
        for group in pixels.start / GROUP..pixels.end.div_ceil(GROUP) {
            let first = GROUP * group;
            let wanted = first.max(pixels.start)..(first + GROUP).min(pixels.end);
            let drawn = self.group(key, group as u64);
            // Of a known length, which is copied as one vector.
            match wanted.len() {
                GROUP => counts[first - pixels.start..][..GROUP].copy_from_slice(&drawn),
                some => counts[wanted.start - pixels.start..][..some]
                    .copy_from_slice(&drawn[wanted.start - first..][..some]),
            }
        }
    }

    // A call would give its answer by memory, and be waited for.
    #[inline(always)]
    fn group(&self, key: Key, group: u64) -> [u16; GROUP] {
        // Side by side in registers: as arrays they would wait for their own bytes.
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

    /// Counts of cells drawn from the key's 64 bits with this number.
    #[inline(always)]
    fn draw_cells(&self, key: Key, number: u64) -> [u64; DRAWN] {
        let bits = key.bits(number);
        let mut drawn = std::array::from_fn(|i| self.cells[cell(bits, i)]);
        if drawn.contains(&MIXED) {
            drawn = self.settled(drawn, bits, key.with(number));
        }
        drawn.map(u64::from)
    }

    /// The same with the cells in which counts meet drawn from within.
    #[cold]
    fn settled(&self, drawn: [u32; DRAWN], bits: u64, key: Key) -> [u32; DRAWN] {
        std::array::from_fn(|i| match drawn[i] {
            MIXED => {
                let within = key.uniform(i as u64);
                self.quantiles((cell(bits, i) as f64 + within) / CELLS as f64)
                    .0
            }
            counts => counts,
        })
    }
}

/// Electrons of a pixel without light.
struct Electrons {
    read_noise_e: f64,
    /// Numbers of electrons of dark current and their chances.
    current: Vec<(f64, f64)>,
}

impl Electrons {
    fn new(sensor: &Sensor, noise: &Noise) -> Electrons {
        let mean = sensor.dark_current_e(noise);
        // Nine deviations; of small means, whose tails are longer, as much as leaves out 2⁻⁵² too.
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
        // Of large numbers the logarithms are rounded.
        let all: f64 = current.iter().map(|(_, chance)| chance).sum();
        current.iter_mut().for_each(|(_, chance)| *chance /= all);
        Electrons {
            read_noise_e: noise.read_noise_e,
            current,
        }
    }

    /// Chance of fewer than these.
    fn below(&self, electrons: f64) -> f64 {
        // Beyond nine deviations are less than 2⁻⁵² of all.
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

/// The `i`-th cell that random bits name.
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

    /// Sensors with a black level amid the range, cut at zero, and cut at a full well of 2 electrons; noise of few
    /// counts and of many, or none; dark current with it and alone.
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

    /// The two-sample χ² over counts seen at least 20 times: with k of them its mean is k − 1 and its standard
    /// deviation √(2(k − 1)); six of these on top are passed with a chance below 1e-6.
    fn compare(drawn: &[f64; 256], truth: &[f64; 256], what: &dyn std::fmt::Debug) {
        let pairs = drawn.iter().zip(truth).filter(|&(a, b)| a + b >= 40.0);
        let k = pairs.clone().count() as f64;
        let chi2: f64 = pairs.map(|(a, b)| (a - b).powi(2) / (a + b)).sum();
        let bound = k - 1.0 + 6.0 * (2.0 * (k - 1.0)).sqrt();
        assert!(chi2 <= bound.max(12.0), "{what:?}: {chi2} > {bound}");
    }

    /// Frequencies of n = 200 000 counts against those that `Sensor::count` gives.
    #[test]
    fn counts_are_distributed_as_those_drawn_one_by_one() {
        let mut paired = [0; 2];
        for sensor in sensors() {
            let dark = DarkCounts::new(&sensor).unwrap();
            paired[usize::from(dark.pairs)] += 1;
            let key = Key::new(4, Purpose::SensorNoise);
            let n = 200_000;
            let [mut drawn, mut of_many, mut truth] = [[0.0f64; 256]; 3];
            for group in 0..n / GROUP as u64 {
                for count in dark.group(key, group) {
                    drawn[count as usize] += 1.0;
                }
            }
            for column in 0..n / 1000 {
                dark.times(1000, key.with(column), &mut |count, times| {
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

    /// Times of counts scatter from column to column and go together as those of pixels drawn one by one do:
    /// of 4000 columns of 500 pixels the covariance of the times of each two counts is n·(p·δ − p·q). Of
    /// numbers as near to normal as these (20 and more expected) a covariance has a standard error of
    /// √((v·w + c²)/4000); 5.5 of them are passed by one of some 100 pairs with a chance of 4e-6.
    #[test]
    fn times_scatter_as_those_of_pixels_by_themselves() {
        for sensor in [
            sensor(100.3, 1e4, 6.0),
            sensor(0.3, 1e4, 6.0),
            sensor(100.3, 1e4, 12.0),
        ] {
            let dark = DarkCounts::new(&sensor).unwrap();
            let (columns, n) = (4000, 500.0);
            let chance = |k: usize| {
                dark.cumulative[k] - k.checked_sub(1).map_or(0.0, |k| dark.cumulative[k])
            };
            let often: Vec<usize> = (0..256).filter(|&k| n * chance(k) >= 20.0).collect();
            assert!(often.len() >= 4);
            let mut products = vec![0.0; often.len() * often.len()];
            for column in 0..columns {
                let mut off = [0.0; 256];
                let key = Key::new(8, Purpose::SensorNoise).with(column);
                dark.times(500, key, &mut |k, times| off[k as usize] = f64::from(times));
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

    /// What neighbours have is what two pixels by themselves would: frequencies of pairs of
    /// counts against the product of their chances, by χ² over those expected 20 times,
    /// bound as above. For both of a cell, and for the last of one and the first of the next.
    #[test]
    fn neighbours_are_independent() {
        for noise in [2.0, 30.0] {
            let dark = DarkCounts::new(&sensor(100.3, 1e4, noise)).unwrap();
            let key = Key::new(5, Purpose::SensorNoise);
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

    /// Of the far tail: the share of frames of 10⁶ dark pixels with one 4.83 deviations or more above the
    /// middle, of which 0.67 are expected a frame. Of 4000 frames the number with none is binomial; bounds are 5 standard
    /// deviations, false alarm under 1e-6.
    #[test]
    fn counts_far_from_the_middle_are_as_rare_as_they_are() {
        let sensor = sensor(100.0, 1e4, 12.0);
        let dark = DarkCounts::new(&sensor).unwrap();
        // σ is 3 counts, and a count of 115 begins at 114.5: 4.83 σ.
        let pixel = 0.5 * libm::erfc(14.5 / 3.0 * FRAC_1_SQRT_2);
        let none = (-1e6 * pixel).exp();
        let mut without = 0.0;
        for frame in 0..4000 {
            let key = Key::new(9, Purpose::SensorNoise).with(frame);
            let mut highest = 0;
            dark.times(1_000_000, key, &mut |count, _| highest = count);
            without += f64::from(u32::from(highest < 115));
        }
        let deviation = (4000.0 * none * (1.0 - none)).sqrt();
        let off = without - 4000.0 * none;
        assert!(off.abs() < 5.0 * deviation, "{without} {}", 4000.0 * none);
    }

    /// Without noise all counts are one; pixels that differ have no common distribution, and of more dark
    /// current than is worth a table none is made.
    #[test]
    fn a_table_is_of_pixels_that_are_alike() {
        let mut silent = sensor(100.0, 1e4, 6.0);
        silent.noise = None;
        let dark = DarkCounts::new(&silent).unwrap();
        assert_eq!(dark.counts, [100]);
        let noise = |dark_current_e_per_s, dsnu_e| {
            let mut sensor = sensor(100.0, 1e4, 6.0);
            sensor.noise = Some(Noise {
                dark_current_e_per_s,
                dsnu_e,
                ..Noise::default()
            });
            DarkCounts::new(&sensor).is_some()
        };
        assert!(noise(1e5, 0.0) && !noise(1e5, 1.0) && !noise(1e6, 0.0));
    }
}
