//! Counts of pixels that see no light, which are most: drawn from their
//! distribution by table, some ten times faster than as rounded normal numbers.

use super::Sensor;
use crate::math::rng::Key;
use std::f64::consts::FRAC_1_SQRT_2;

/// Pixels that share 64 random bits.
pub const GROUP: usize = 5;
/// Bits of a pixel's share: 4096 cells of equal probability.
const CELL_BITS: u32 = 12;
const CELLS: usize = 1 << CELL_BITS;
/// No count: they end at 2¹⁶ - 1.
const MIXED: u32 = u32::MAX;

/// The distribution of the counts of dark pixels under read noise: by the inverse
/// of its cumulative distribution, exact to 2⁻⁵³.
pub struct DarkCounts {
    /// The count all over a cell; [`MIXED`] where counts meet in it.
    cells: Box<[u32; CELLS]>,
    /// Chance of a count of at most k.
    cumulative: Vec<f64>,
}

impl DarkCounts {
    /// `None` for a sensor without read noise: then dark counts are all the same.
    pub fn new(sensor: &Sensor) -> Option<DarkCounts> {
        let sigma = sensor.noise?.read_noise_e * sensor.gain_dn_per_e;
        if sigma <= 0.0 {
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
            cumulative: (0..=sensor.max_count()).map(at_most).collect(),
        };
        for cell in 0..CELLS {
            let edge = |i: usize| i as f64 / CELLS as f64;
            let count = dark.quantile(edge(cell));
            if dark.cumulative[count as usize] >= edge(cell + 1) {
                dark.cells[cell] = count.into();
            }
        }
        Some(dark)
    }

    /// The count below which a share `u` < 1 of the counts lies.
    fn quantile(&self, u: f64) -> u16 {
        self.cumulative.partition_point(|&c| c <= u) as u16
    }

    /// Sets the counts of a group of dark pixels, or of less, from 64 random `bits`;
    /// `pixel` gives the key of a pixel.
    #[inline]
    pub fn draw(&self, counts: &mut [u16], bits: u64, pixel: impl Fn(usize) -> Key) {
        let cell = |i: usize| (bits >> (CELL_BITS as usize * i)) as usize % CELLS;
        let drawn: [u32; GROUP] = std::array::from_fn(|i| self.cells[cell(i)]);
        for (count, drawn) in counts.iter_mut().zip(drawn) {
            *count = drawn as u16;
        }
        if drawn.contains(&MIXED) {
            for i in (0..counts.len()).filter(|&i| drawn[i] == MIXED) {
                let within = pixel(i).uniform(0);
                counts[i] = self.quantile((cell(i) as f64 + within) / CELLS as f64);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Noise;
    use crate::math::rng::Purpose;
    use glam::UVec2;

    fn sensor(black_level_dn: f64, full_well_e: f64) -> Sensor {
        Sensor {
            resolution: UVec2::new(4, 4),
            pixel_pitch: 0.005,
            exposure_ms: 2.0,
            quantum_efficiency: 0.6,
            gain_dn_per_e: 0.25,
            bit_depth: 8,
            full_well_e,
            black_level_dn,
            noise: Some(Noise { read_noise_e: 6.0 }),
        }
    }

    /// Frequencies of n = 200 000 counts against those that `Sensor::count` gives,
    /// by the two-sample χ² over counts seen at least 20 times: with k of them its
    /// mean is k - 1 and its standard deviation √(2(k - 1)); 6 of these on top
    /// are passed with a chance below 1e-6. Black levels amid the range, cut at
    /// zero, and cut at a full well of 2 electrons.
    #[test]
    fn counts_are_distributed_as_those_drawn_one_by_one() {
        for (black, full_well) in [(100.0, 1e4), (0.3, 1e4), (100.2, 2.0), (254.0, 1e4)] {
            let sensor = sensor(black, full_well);
            let dark = DarkCounts::new(&sensor).unwrap();
            let key = Key::new(4, Purpose::SensorNoise);
            let n = 200_000;
            let (mut drawn, mut truth) = ([0.0f64; 256], [0.0f64; 256]);
            for group in 0..n / GROUP as u64 {
                let mut counts = [0; GROUP];
                let pixel = |i: usize| key.with(7).with(group * GROUP as u64 + i as u64);
                dark.draw(&mut counts, key.bits(group), pixel);
                for count in counts {
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
                "{black} {full_well}: {chi2} > {bound}"
            );
        }
    }

    #[test]
    fn no_noise_needs_no_table() {
        let mut silent = sensor(100.0, 1e4);
        silent.noise = Some(Noise { read_noise_e: 0.0 });
        assert!(DarkCounts::new(&silent).is_none());
    }
}
