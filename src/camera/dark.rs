//! Counts of pixels that see no light, which are most: drawn from their
//! distribution by table, some ten times faster than as rounded normal numbers.

use super::Sensor;
use crate::math::rng::Key;
use std::f64::consts::FRAC_1_SQRT_2;

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

/// The distribution of the counts of dark pixels under read noise: by the inverse
/// of its cumulative distribution, exact to 2⁻⁵².
pub struct DarkCounts {
    /// The counts all over a cell: of a pixel, and 2¹⁶ times that of another.
    cells: Box<[u32; CELLS]>,
    /// Whether a cell is of two pixels: where noise is of few counts.
    pairs: bool,
    /// Chance of a count of at most k.
    cumulative: Vec<f64>,
}

impl DarkCounts {
    /// `None` for a sensor without read noise, whose dark counts are all the same, and for one
    /// whose dark pixels have more than read noise.
    pub fn new(sensor: &Sensor) -> Option<DarkCounts> {
        let noise = sensor.noise?;
        let sigma = noise.read_noise_e * sensor.gain_dn_per_e;
        if sigma <= 0.0 || noise.adds_to_dark() {
            return None;
        }
        let full = sensor.full_well_e * sensor.gain_dn_per_e + sensor.black_level_dn;
        let at_most = |k: u16| {
            // A count is at most k where the unrounded one is below k + ½.
            let border = k as f64 + 0.5;
            if k == sensor.max_count() || full < border {
                return 1.0;
            }
            let deviations = (border - sensor.black_level_dn) / sigma;
            libm::erfc(-deviations * FRAC_1_SQRT_2) / 2.0
        };
        let mut dark = DarkCounts {
            cells: Box::new([MIXED; CELLS]),
            pairs: true,
            cumulative: (0..=sensor.max_count()).map(at_most).collect(),
        };
        dark.fill_cells();
        let mixed = dark.cells.iter().filter(|cell| **cell == MIXED).count();
        if mixed > MOST_MIXED {
            dark.pairs = false;
            dark.fill_cells();
        }
        Some(dark)
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

    /// Counts of so many dark pixels.
    pub fn draw(&self, pixels: usize, key: Key) -> Vec<u16> {
        let groups = pixels.div_ceil(GROUP);
        let mut counts = Vec::with_capacity(groups * GROUP);
        for group in 0..groups {
            counts.extend_from_slice(&self.group(key, group as u64));
        }
        counts.truncate(pixels);
        counts
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

    /// Frequencies of n = 200 000 counts against those that `Sensor::count` gives,
    /// by the two-sample χ² over counts seen at least 20 times: with k of them its
    /// mean is k - 1 and its standard deviation √(2(k - 1)); 6 of these on top
    /// are passed with a chance below 1e-6. Black levels amid the range, cut at
    /// zero, and cut at a full well of 2 electrons; noise of few counts and of many.
    #[test]
    fn counts_are_distributed_as_those_drawn_one_by_one() {
        let mut paired = [0; 2];
        for (black, full_well, noise) in [
            (100.0, 1e4, 6.0),
            (100.3, 1e4, 2.0),
            (0.3, 1e4, 6.0),
            (0.3, 1e4, 2.0),
            (100.2, 2.0, 6.0),
            (254.0, 1e4, 6.0),
            (60.0, 1e4, 30.0),
        ] {
            let sensor = sensor(black, full_well, noise);
            let dark = DarkCounts::new(&sensor).unwrap();
            paired[usize::from(dark.pairs)] += 1;
            let key = Key::new(4, Purpose::SensorNoise);
            let n = 200_000;
            let (mut drawn, mut truth) = ([0.0f64; 256], [0.0f64; 256]);
            for group in 0..n / GROUP as u64 {
                for count in dark.group(key, group) {
                    drawn[count as usize] += 1.0;
                }
            }
            for i in 0..n {
                truth[sensor.count(0.0, key.with(9).with(i)) as usize] += 1.0;
            }
            let pairs = drawn.iter().zip(&truth).filter(|&(a, b)| a + b >= 40.0);
            let k = pairs.clone().count() as f64;
            let chi2: f64 = pairs.map(|(a, b)| (a - b).powi(2) / (a + b)).sum();
            let bound = k - 1.0 + 6.0 * (2.0 * (k - 1.0)).sqrt();
            assert!(
                chi2 <= bound.max(12.0),
                "{black} {full_well} {noise}: {chi2} > {bound}"
            );
        }
        assert!(paired[0] > 0 && paired[1] > 0, "{paired:?}");
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

    #[test]
    fn no_noise_needs_no_table() {
        let mut silent = sensor(100.0, 1e4, 6.0);
        silent.noise = Some(Noise::default());
        assert!(DarkCounts::new(&silent).is_none());
    }
}
