//! From irradiance to counts: the linear model of EMVA 1288 (release 4.0).

use crate::math::DVec2;
use crate::math::binomial::{EXPANDED, expanded_quantile};
use crate::math::rng::{Key, Stream};
use glam::UVec2;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// h·c, in mJ·mm: the energy of a photon is this over its wavelength in mm.
const PLANCK_TIMES_LIGHT_SPEED: f64 = 6.626_070_15e-34 * 299_792_458.0 * 1e6;

/// A sensor of square pixels whose counts are linear in the light, up to full well.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Sensor {
    /// Columns, rows.
    pub resolution: UVec2,
    /// From the middle of the whole sensor to that of what is read of it, pixels.
    pub off_middle: DVec2,
    /// Time to read the image; 0: none.
    pub readout_ms: f64,
    /// mm.
    pub pixel_pitch: f64,
    /// Exposure time; of several, the longest.
    pub exposure_ms: f64,
    /// The longest over each shorter one, from the longest on; empty for a single exposure. Where a longer one is full a pixel has the
    /// count of the next, times this.
    pub shorter: Vec<f64>,
    /// Electrons per photon.
    pub quantum_efficiency: f64,
    /// Counts per electron.
    pub gain_dn_per_e: f64,
    /// Bits of a count: the highest is 2^`bit_depth` − 1.
    pub bit_depth: u32,
    /// Electrons at which a pixel is full.
    pub full_well_e: f64,
    /// Counts without light.
    pub black_level_dn: f64,
    /// `None`: counts are the rounded expectation.
    pub noise: Option<Noise>,
}

/// Noise: Poisson shot noise and Gaussian read noise, new in every frame, and how pixels differ, the same in
/// all frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct Noise {
    /// Standard deviation of read noise, electrons.
    pub read_noise_e: f64,
    /// Electrons that come without light, a second of exposure, with shot noise of their own.
    pub dark_current_e_per_s: f64,
    /// Relative standard deviation of the pixels' responses to light (PRNU), normal.
    pub prnu: f64,
    /// Standard deviation of the pixels' dark signals (DSNU), normal, electrons.
    pub dsnu_e: f64,
}

/// How a pixel differs from the mean of all, in every frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPattern {
    /// Electrons over those of the mean pixel, at least 0.
    pub response: f64,
    /// Signal without light over that of the mean pixel, electrons.
    pub dark_e: f64,
}

impl PixelPattern {
    /// A pixel like the mean of all.
    pub const MEAN: PixelPattern = PixelPattern {
        response: 1.0,
        dark_e: 0.0,
    };
}

impl Noise {
    /// The pixel with this key.
    pub fn pattern(&self, key: Key) -> PixelPattern {
        if self.prnu == 0.0 && self.dsnu_e == 0.0 {
            return PixelPattern::MEAN;
        }
        let mut stream = key.stream();
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        PixelPattern {
            response: (1.0 + self.prnu * normal()).max(0.0),
            dark_e: self.dsnu_e * normal(),
        }
    }
}

impl Sensor {
    /// Expected electrons of a pixel per irradiance (mW/mm²) for light of
    /// `wavelength` (mm): η·A·t·λ/(hc).
    pub fn electrons_per_irradiance(&self, wavelength: f64) -> f64 {
        // mW/mm² · mm² · ms = µJ.
        let millijoules = self.pixel_pitch.powi(2) * self.exposure_ms * 1e-3;
        self.quantum_efficiency * millijoules * wavelength / PLANCK_TIMES_LIGHT_SPEED
    }

    /// The sensor with squares of so many pixels a side whose electrons are added before they are read: of b² pixels dark current is b²
    /// times that of one, DSNU b times, PRNU 1/b. The rest is that of what is read.
    pub fn binned_charge(self, side: u32) -> Sensor {
        let b = f64::from(side);
        let noise = self.noise.map(|noise| Noise {
            read_noise_e: noise.read_noise_e,
            dark_current_e_per_s: noise.dark_current_e_per_s * b * b,
            prnu: noise.prnu / b,
            dsnu_e: noise.dsnu_e * b,
        });
        Sensor {
            resolution: self.resolution / side,
            off_middle: self.off_middle / b,
            pixel_pitch: self.pixel_pitch * b,
            readout_ms: self.readout_ms / b,
            noise,
            ..self
        }
    }

    /// The same whose counts are added: read noise is b times that of a pixel, full well, black level and the highest count
    /// b² times; and b² roundings have the variance b²/12, of which the sum's own is 1/12. All rows are read.
    pub fn binned_counts(self, side: u32) -> Sensor {
        let (b, readout_ms) = (f64::from(side), self.readout_ms);
        let rounding_e = ((b * b - 1.0) / 12.0).sqrt() / self.gain_dn_per_e;
        let mut sensor = self.binned_charge(side);
        if let Some(noise) = &mut sensor.noise {
            noise.read_noise_e = (noise.read_noise_e * b).hypot(rounding_e);
        }
        Sensor {
            readout_ms,
            full_well_e: sensor.full_well_e * b * b,
            black_level_dn: sensor.black_level_dn * b * b,
            bit_depth: sensor.bit_depth + (2.0 * b.log2()).ceil() as u32,
            ..sensor
        }
    }

    /// Highest count: of several exposures, merged.
    pub fn max_count(&self) -> u16 {
        self.merged(f64::from(self.highest()), self.longest_over_shortest())
    }

    /// Highest count of one exposure.
    fn highest(&self) -> u16 {
        ((1u32 << self.bit_depth) - 1) as u16
    }

    /// The count of a pixel that is full in all exposures.
    pub fn saturation_count(&self) -> u16 {
        self.merged(self.full_scale(), self.longest_over_shortest())
    }

    /// The count at which one exposure is full: that of the full well, if the scale does not end before.
    pub fn full_scale(&self) -> f64 {
        f64::from(self.digitised(self.full_well_e))
    }

    /// 1 for a single exposure.
    pub fn longest_over_shortest(&self) -> f64 {
        self.shorter.last().copied().unwrap_or(1.0)
    }

    /// Time of all exposures.
    pub fn all_exposures_ms(&self) -> f64 {
        self.exposure_ms * (1.0 + self.shorter.iter().map(|ratio| 1.0 / ratio).sum::<f64>())
    }

    /// A count of an exposure that is so many times shorter than the longest, as one of that.
    fn merged(&self, count: f64, ratio: f64) -> u16 {
        // Rounded by the cast, which ends at the highest count there is.
        ((count - self.black_level_dn).max(0.0) * ratio + self.black_level_dn + 0.5) as u16
    }

    /// Counts of a pixel that expects `electrons`; `key` is the pixel's own in this frame.
    pub fn count(&self, electrons: f64, key: Key) -> u16 {
        self.count_of(&PixelPattern::MEAN, electrons, key)
    }

    /// The same of a pixel like this where the mean one expects `electrons` of light.
    pub fn count_of(&self, pixel: &PixelPattern, electrons: f64, key: Key) -> u16 {
        let longest = self.single(pixel, electrons, 1.0, key);
        if self.shorter.is_empty() {
            return longest;
        }
        let full = self.full_scale();
        let (mut count, mut ratio) = (longest, 1.0);
        for (number, &shorter) in (1..).zip(&self.shorter) {
            if f64::from(count) < full {
                break;
            }
            ratio = shorter;
            count = self.single(pixel, electrons / ratio, ratio, key.with(number));
        }
        match ratio {
            1.0 => count,
            _ => self.merged(f64::from(count), ratio),
        }
    }

    /// The count of one exposure, so many times shorter than the longest.
    fn single(&self, pixel: &PixelPattern, electrons: f64, ratio: f64, key: Key) -> u16 {
        let electrons = match self.noise {
            None => electrons,
            Some(noise) => {
                let expected = electrons * pixel.response + self.dark_current_e(&noise) / ratio;
                noisy(expected, noise.read_noise_e, key) + pixel.dark_e
            }
        };
        self.digitised(electrons.min(self.full_well_e))
    }

    pub(super) fn dark_current_e(&self, noise: &Noise) -> f64 {
        noise.dark_current_e_per_s * self.exposure_ms * 1e-3
    }

    /// Standard deviation of counts without light over pixels and frames, electrons; rounding is not in it.
    pub fn dark_noise_e(&self) -> f64 {
        self.noise.map_or(0.0, |noise| {
            let fixed = noise.read_noise_e.hypot(noise.dsnu_e);
            fixed.hypot(self.dark_current_e(&noise).sqrt())
        })
    }

    /// Variance of counts without light, rounding among it, electrons².
    pub(crate) fn dark_variance_e(&self) -> f64 {
        let rounding = 1.0 / (12.0 * self.gain_dn_per_e.powi(2));
        self.dark_noise_e().powi(2) + rounding
    }

    fn digitised(&self, electrons: f64) -> u16 {
        let dn = electrons * self.gain_dn_per_e + self.black_level_dn;
        // Rounded by the cast: `round` is a call on baseline x86-64.
        (dn.clamp(0.0, self.highest() as f64) + 0.5) as u16
    }
}

fn noisy(electrons: f64, read_noise_e: f64, key: Key) -> f64 {
    let mut stream = key.stream();
    let read: f64 = StandardNormal.sample(&mut stream);
    shot(electrons, &mut stream) + read_noise_e * read
}

/// A Poisson number that rises with its mean for the same random numbers, so that pixels
/// of nearly the same light have nearly the same noise: the quantile of a normal number,
/// by the expansion of Cornish and Fisher (1938) to 1/λ, and below λ = 12 that of a
/// uniform one by summing. Shares of pixels with at most k electrons are within 3.2e-5 of
/// the true ones, all λ and k.
fn shot(mean: f64, stream: &mut Stream) -> f64 {
    if mean >= EXPANDED {
        return expanded_quantile(mean, 0.0, StandardNormal.sample(stream));
    }
    let uniform: f64 = StandardUniform.sample(stream);
    let mut term = (-mean).exp();
    let mut at_most = term;
    let mut k = 0.0;
    // The sum of all terms may be rounded to below the greatest uniform number.
    while uniform >= at_most && term > 0.0 {
        k += 1.0;
        term *= mean / k;
        at_most += term;
    }
    k
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::Purpose;

    fn sensor() -> Sensor {
        Sensor {
            resolution: UVec2::new(4, 4),
            off_middle: DVec2::ZERO,
            readout_ms: 0.0,
            pixel_pitch: 0.005,
            exposure_ms: 2.0,
            shorter: Vec::new(),
            quantum_efficiency: 0.6,
            gain_dn_per_e: 0.25,
            bit_depth: 10,
            full_well_e: 3_000.0,
            black_level_dn: 8.0,
            noise: Some(Noise {
                read_noise_e: 6.0,
                ..Noise::default()
            }),
        }
    }

    /// A photon of 660 nm carries 3.0098e-19 J (hc = 1.98645e-25 J·m).
    #[test]
    fn electrons_count_photons() {
        // 1 mW/mm² on (5 µm)² for 2 ms is 5e-8 mJ = 5e-11 J.
        let expected = 0.6 * 5e-11 / 3.009_767e-19;
        let found = sensor().electrons_per_irradiance(660e-6);
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
    }

    /// Mean and variance (photon transfer) of n = 40 000 pixels: the variance in
    /// counts is K²(μ + σ_d²) + 1/12. Bounds are 5 standard errors (false alarm
    /// under 1e-6): σ/√n for the mean, σ²·√(2/n) for the variance.
    #[test]
    fn noise_follows_the_photon_transfer_curve() {
        let sensor = sensor();
        let n = 40_000u64;
        for electrons in [0.0, 3.0, 100.0, 2_000.0] {
            let key = Key::new(1, Purpose::SensorNoise).with(electrons as u64);
            let counts: Vec<f64> = (0..n)
                .map(|i| sensor.count(electrons, key.with(i)) as f64)
                .collect();
            let mean = counts.iter().sum::<f64>() / n as f64;
            let var = counts.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / n as f64;
            let expected_mean = 8.0 + 0.25 * electrons;
            let expected_var = 0.0625 * (electrons + 36.0) + 1.0 / 12.0;
            let n = n as f64;
            assert!((mean - expected_mean).abs() < 5.0 * (expected_var / n).sqrt());
            assert!(
                (var - expected_var).abs() < 5.0 * expected_var * (2.0 / n).sqrt(),
                "{electrons}: {var} {expected_var}"
            );
        }
    }

    /// Two frames of n = 40 000 pixels at several exposures, as EMVA 1288 evaluates them: half the variance of
    /// their difference is K²(σ_d² + µ) + 1/12, rounding in it once, with µ of light and dark current;
    /// the covariance of the frames is that of the fixed patterns, K²(DSNU² + PRNU²·µ²). Noise of
    /// a count and more makes rounding even. Bounds are 5 standard errors: σ²·√(2/n) of the one, and of
    /// the other √((v² + c²)/n), v being the variance of a frame over pixels and c the covariance.
    #[test]
    fn photon_transfer_finds_what_was_put_in() {
        let mut sensor = sensor();
        sensor.gain_dn_per_e = 0.5;
        let noise = Noise {
            read_noise_e: 6.0,
            dark_current_e_per_s: 1e4,
            prnu: 0.05,
            dsnu_e: 4.0,
        };
        sensor.noise = Some(noise);
        let (n, k) = (40_000u64, sensor.gain_dn_per_e);
        let patterns = Key::new(1, Purpose::FixedPattern);
        for (exposure_ms, rate) in [(0.1, 0.0), (2.0, 0.0), (2.0, 500.0)] {
            sensor.exposure_ms = exposure_ms;
            let light = exposure_ms * rate;
            let frame = |frame: u64| -> Vec<f64> {
                let key = Key::new(1, Purpose::SensorNoise).with(frame);
                let count = |i| {
                    let pattern = noise.pattern(patterns.with(i));
                    f64::from(sensor.count_of(&pattern, light, key.with(i)))
                };
                (0..n).map(count).collect()
            };
            let (a, b) = (frame(0), frame(1));
            let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
            let (mean_a, mean_b) = (mean(&a), mean(&b));
            let products = |f: &dyn Fn(f64, f64) -> f64| {
                let pairs = a.iter().zip(&b).map(|(a, b)| f(a - mean_a, b - mean_b));
                pairs.sum::<f64>() / n as f64
            };
            let temporal = products(&|a, b| (a - b).powi(2) / 2.0);
            let fixed = products(&|a, b| a * b);
            let dark = 1e4 * exposure_ms * 1e-3;
            let expected_temporal = k * k * (36.0 + light + dark) + 1.0 / 12.0;
            let expected_fixed = k * k * (16.0 + (0.05 * light).powi(2));
            let root = (n as f64).sqrt();
            let of_pixel = expected_temporal + expected_fixed;
            let bounds = [
                // The patterns spread the shot noise of pixels, here by 5 % about its mean.
                5.0 * expected_temporal * 2f64.sqrt() * 1.01 / root,
                5.0 * of_pixel.hypot(expected_fixed) / root,
            ];
            let level = 8.0 + k * (light + dark);
            assert!((mean_a - level).abs() < 5.0 * of_pixel.sqrt() / root);
            assert!(
                (temporal - expected_temporal).abs() < bounds[0],
                "{temporal} {expected_temporal}"
            );
            assert!(
                (fixed - expected_fixed).abs() < bounds[1],
                "{fixed} {expected_fixed}"
            );
        }
    }

    /// Counts of three exposures of 1, 1/4 and 1/16 are those of the longest below its full scale of 758 counts, and beyond of a shorter one: the
    /// mean goes on as the light does, and the variance is that of r times a count, r²(K²(μ/r + σ²) + 1/12), but where it goes from one exposure
    /// to the next. Bounds are five standard errors of 40 000 pixels; what a pixel is chosen by is its own noise, which near the change moves the mean
    /// by less than the noise: means are looked at a tenth beside it.
    #[test]
    fn merged_exposures_go_on_where_one_ends() {
        let mut sensor = sensor();
        sensor.shorter = vec![4.0, 16.0];
        assert_eq!(sensor.saturation_count(), 8 + 16 * 750);
        let (k, n) = (sensor.gain_dn_per_e, 40_000u64);
        for (electrons, ratio) in [
            (2_000.0, 1.0),
            (5_000.0, 4.0),
            (10_000.0, 4.0),
            (30_000.0, 16.0),
        ] {
            let key = Key::new(2, Purpose::SensorNoise).with(electrons as u64);
            let counts: Vec<f64> = (0..n)
                .map(|i| f64::from(sensor.count(electrons, key.with(i))))
                .collect();
            let mean = counts.iter().sum::<f64>() / n as f64;
            let var = counts.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / n as f64;
            let expected = ratio * ratio * (k * k * (electrons / ratio + 36.0) + 1.0 / 12.0);
            let root = (n as f64).sqrt();
            assert!(
                (mean - 8.0 - k * electrons).abs() < 5.0 * expected.sqrt() / root,
                "{electrons}: {mean}"
            );
            assert!(
                (var / expected - 1.0).abs() < 5.0 * 2f64.sqrt() / root,
                "{electrons}: {var} {expected}"
            );
        }
        assert_eq!(
            sensor.count(1e9, Key::new(1, Purpose::SensorNoise)),
            8 + 16 * 750
        );
    }

    /// Sums of 3 × 3 pixels, 40 000 of them, as counts and as charge against the sensor that reads them as one: mean and variance
    /// within five standard errors, σ/√n and σ²·√(2/n); the sum of counts also to the half count that rounding moves at most.
    #[test]
    fn binned_pixels_are_sums_of_pixels() {
        let single = sensor();
        let (side, n, light) = (3u32, 40_000u64, 200.0);
        let key = Key::new(1, Purpose::SensorNoise);
        let moments = |values: &[f64]| {
            let n = values.len() as f64;
            let mean = values.iter().sum::<f64>() / n;
            (
                mean,
                values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n,
            )
        };
        let of_bin = |i: u64, j: u64| key.with(9 * i + j);
        let summed: Vec<f64> = (0..n)
            .map(|i| {
                (0..9)
                    .map(|j| f64::from(single.count(light, of_bin(i, j))))
                    .sum()
            })
            .collect();
        let read = |sensor: &Sensor| -> Vec<f64> {
            let count = |i| f64::from(sensor.count(9.0 * light, key.with(n * 9 + i)));
            (0..n).map(count).collect()
        };
        let counts = single.clone().binned_counts(side);
        let ((mean_a, var_a), (mean_b, var_b)) = (moments(&summed), moments(&read(&counts)));
        let root = (n as f64).sqrt();
        assert!((mean_a - mean_b).abs() < 0.5 + 5.0 * (2.0 * var_a).sqrt() / root);
        assert!(
            (var_a / var_b - 1.0).abs() < 5.0 * 2.0 / root,
            "{var_a} {var_b}"
        );
        // 8 bits and more of nine times 1023.
        assert_eq!(
            (counts.bit_depth, counts.saturation_count()),
            (14, 9 * (8 + 750))
        );
        let charge = single.binned_charge(side);
        let (_, var) = moments(&read(&charge));
        let expected = 0.0625 * (9.0 * light + 36.0) + 1.0 / 12.0;
        assert!(
            (var / expected - 1.0).abs() < 5.0 * 2f64.sqrt() / root,
            "{var} {expected}"
        );
    }

    #[test]
    fn counts_stop_at_full_well_and_at_the_highest_code() {
        let mut sensor = sensor();
        let key = Key::new(1, Purpose::SensorNoise);
        assert_eq!(sensor.count(1e12, key), 8 + 750);
        sensor.full_well_e = 1e9;
        assert_eq!(sensor.count(1e12, key), 1023);
        assert_eq!(sensor.count(1e300, key), 1023);
    }

    /// For the same pixel more light never makes a lower count, but where the way of drawing
    /// changes, and a little more light hardly ever another one.
    #[test]
    fn nearly_the_same_light_has_nearly_the_same_noise() {
        let sensor = sensor();
        let key = Key::new(3, Purpose::SensorNoise);
        for electrons in [0.5, 6.0, 13.0, 150.0, 2_000.0] {
            let n = 20_000u64;
            let other = |i| {
                let count = |electrons| sensor.count(electrons, key.with(i));
                let (less, more) = (count(electrons), count(electrons + 0.04));
                assert!(less <= more && more - less <= 1, "{electrons} {i}");
                more > less
            };
            // 0.04 electrons are 0.01 counts: so many pixels in 100 cross a border, 200 of
            // all; five standard deviations more are seen once in 3e6 times.
            let changed = (0..n).filter(|&i| other(i)).count();
            assert!(changed <= 200 + 71, "{electrons}: {changed}");
        }
    }
}
