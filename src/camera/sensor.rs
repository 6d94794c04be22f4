//! Conversion of irradiance to counts: the linear camera model of EMVA 1288, release 4.0.

use crate::math::DVec2;
use crate::math::binomial::{EXPANDED, expanded_quantile};
use crate::math::rng::{KeyStream, RngKey};
use glam::UVec2;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// h·c in mJ·mm; the photon energy is this value divided by the wavelength in mm.
const PLANCK_TIMES_LIGHT_SPEED: f64 = 6.626_070_15e-34 * 299_792_458.0 * 1e6;

/// Sensor with square pixels and a linear response up to full well.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Sensor {
    /// Number of columns and rows.
    pub resolution: UVec2,
    /// Vector from the sensor centre to the centre of the region of interest, pixels.
    pub off_middle: DVec2,
    /// Readout time of an image, ms; 0 if it is neglected.
    pub readout_ms: f64,
    /// Pixel pitch, mm.
    pub pixel_pitch: f64,
    /// Exposure time, ms; with several exposures, the longest.
    pub exposure_ms: f64,
    /// Ratios of the longest exposure to each shorter one, in order of decreasing exposure; empty
    /// for a single exposure. If a pixel is full in a longer exposure, the count of the next one
    /// times this ratio is used.
    pub shorter: Vec<f64>,
    /// Electrons per photon.
    pub quantum_efficiency: f64,
    /// Counts per electron.
    pub gain_dn_per_e: f64,
    /// Bits per count; the highest count is 2^`bit_depth` − 1.
    pub bit_depth: u32,
    /// Full-well capacity, electrons.
    pub full_well_e: f64,
    /// Counts without light.
    pub black_level_dn: f64,
    /// Sensor noise; if `None`, counts are the rounded expected values.
    pub noise: Option<Noise>,
}

/// Sensor noise. Poisson shot noise and Gaussian read noise change with every frame. The fixed
/// patterns PRNU and DSNU are equal in all frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct Noise {
    /// Standard deviation of the read noise, electrons.
    pub read_noise_e: f64,
    /// Dark current, electrons per second of exposure; it contributes shot noise.
    pub dark_current_e_per_s: f64,
    /// Photo response non-uniformity (PRNU): relative standard deviation of the pixel response,
    /// normal distribution.
    pub prnu: f64,
    /// Dark signal non-uniformity (DSNU): standard deviation of the dark signal, normal
    /// distribution, electrons.
    pub dsnu_e: f64,
    /// Photoelectrons of ambient light, electrons per second of exposure; they contribute shot
    /// noise and PRNU.
    #[serde(skip_serializing_if = "is_zero")]
    pub ambient_e_per_s: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Fixed-pattern deviation of a pixel from the mean pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPattern {
    /// Response relative to the mean pixel, at least 0.
    pub response: f64,
    /// Dark signal relative to the mean pixel, electrons.
    pub dark_e: f64,
}

impl PixelPattern {
    /// Pixel without deviation from the mean.
    pub const MEAN: PixelPattern = PixelPattern {
        response: 1.0,
        dark_e: 0.0,
    };
}

impl Noise {
    /// Returns the fixed pattern of the pixel with this key.
    pub fn pattern(&self, key: RngKey) -> PixelPattern {
        if self.prnu == 0.0 && self.dsnu_e == 0.0 {
            return PixelPattern::MEAN;
        }
        let mut stream = key.counter_stream();
        let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
        PixelPattern {
            response: (1.0 + self.prnu * normal()).max(0.0),
            dark_e: self.dsnu_e * normal(),
        }
    }
}

impl Sensor {
    /// Returns the expected electrons of a pixel per irradiance (mW/mm²) for light of `wavelength`
    /// (mm): η·A·t·λ/(hc).
    pub fn electrons_per_irradiance(&self, wavelength: f64) -> f64 {
        // mW/mm² · mm² · ms = µJ.
        let millijoules = self.pixel_pitch.powi(2) * self.exposure_ms * 1e-3;
        self.quantum_efficiency * millijoules * wavelength / PLANCK_TIMES_LIGHT_SPEED
    }

    /// Returns the sensor with charge binning of `side` × `side` pixels: electrons are added before
    /// readout. With b = `side`, dark current increases by a factor of b² and DSNU by b. PRNU
    /// decreases by a factor of b. Properties of the readout do not change.
    pub fn binned_charge(self, side: u32) -> Sensor {
        let b = f64::from(side);
        let noise = self.noise.map(|noise| Noise {
            read_noise_e: noise.read_noise_e,
            dark_current_e_per_s: noise.dark_current_e_per_s * b * b,
            prnu: noise.prnu / b,
            dsnu_e: noise.dsnu_e * b,
            ambient_e_per_s: noise.ambient_e_per_s * b * b,
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

    /// Returns the sensor with digital binning of `side` × `side` pixels: counts are added after
    /// readout.
    ///
    /// With b = `side`, read noise increases by a factor of b. Full well, black level and the
    /// highest count increase by b². The b² roundings have the variance b²/12; the rounding of the
    /// sum accounts for 1/12. All rows are read.
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

    /// Returns the highest count, after merging if there are several exposures.
    pub fn max_count(&self) -> u16 {
        self.merged(f64::from(self.highest()), self.hdr_ratio())
    }

    /// Returns the highest count of a single exposure.
    fn highest(&self) -> u16 {
        ((1u32 << self.bit_depth) - 1) as u16
    }

    /// Returns the count of a pixel that is full in all exposures.
    pub fn saturation_count(&self) -> u16 {
        self.merged(self.full_scale(), self.hdr_ratio())
    }

    /// Returns the count at which a single exposure saturates: the count of the full well, limited
    /// by the bit depth.
    pub fn full_scale(&self) -> f64 {
        f64::from(self.digitised(self.full_well_e))
    }

    /// Returns the ratio of the longest to the shortest exposure; 1 for a single exposure.
    pub fn hdr_ratio(&self) -> f64 {
        self.shorter.last().copied().unwrap_or(1.0)
    }

    /// Returns the sum of all exposure times, ms.
    pub fn total_exposure_ms(&self) -> f64 {
        self.exposure_ms * (1.0 + self.shorter.iter().map(|ratio| 1.0 / ratio).sum::<f64>())
    }

    /// Converts the count of an exposure that is shorter by `ratio` to the scale of the longest
    /// exposure.
    fn merged(&self, count: f64, ratio: f64) -> u16 {
        // Adding ½ makes the cast round to nearest. The cast saturates at the largest `u16`.
        ((count - self.black_level_dn).max(0.0) * ratio + self.black_level_dn + 0.5) as u16
    }

    /// Samples the count of a pixel whose expected number of electrons is `electrons`. `key` is the
    /// random key of the pixel in this frame.
    pub fn count(&self, electrons: f64, key: RngKey) -> u16 {
        self.count_of(&PixelPattern::MEAN, electrons, key)
    }

    /// Samples the count of a pixel with the given fixed pattern. `electrons` is the expected
    /// number of photoelectrons of the mean pixel.
    pub fn count_of(&self, pixel: &PixelPattern, electrons: f64, key: RngKey) -> u16 {
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

    /// Samples the count of an exposure that is shorter than the longest by `ratio`.
    fn single(&self, pixel: &PixelPattern, electrons: f64, ratio: f64, key: RngKey) -> u16 {
        let electrons = match self.noise {
            None => electrons,
            Some(noise) => {
                let light = electrons + self.ambient_e(&noise) / ratio;
                let expected = light * pixel.response + self.dark_current_e(&noise) / ratio;
                noisy(expected, noise.read_noise_e, key) + pixel.dark_e
            }
        };
        self.digitised(electrons.min(self.full_well_e))
    }

    pub(super) fn dark_current_e(&self, noise: &Noise) -> f64 {
        noise.dark_current_e_per_s * self.exposure_ms * 1e-3
    }

    /// Returns the mean photoelectrons of ambient light.
    pub(crate) fn ambient_e(&self, noise: &Noise) -> f64 {
        noise.ambient_e_per_s * self.exposure_ms * 1e-3
    }

    /// Returns the standard deviation of the counts without laser light over pixels and frames,
    /// electrons, without rounding. With the read noise σ_d, the dark current and the ambient light
    /// contribute their means as variances (EMVA 1288), and PRNU and DSNU their patterns.
    pub fn dark_noise_e(&self) -> f64 {
        self.noise.map_or(0.0, |noise| {
            let ambient = self.ambient_e(&noise);
            let fixed = noise.read_noise_e.hypot(noise.dsnu_e);
            let fixed = fixed.hypot(self.dark_current_e(&noise).sqrt());
            fixed.hypot(ambient.sqrt()).hypot(noise.prnu * ambient)
        })
    }

    /// Returns the standard deviation of the fixed pattern of the counts without laser light,
    /// electrons.
    pub(crate) fn fixed_dark_noise_e(&self) -> f64 {
        self.noise.map_or(0.0, |noise| {
            noise.dsnu_e.hypot(noise.prnu * self.ambient_e(&noise))
        })
    }

    /// Returns the variance of dark counts including rounding, electrons².
    pub(crate) fn dark_variance_e(&self) -> f64 {
        let rounding = 1.0 / (12.0 * self.gain_dn_per_e.powi(2));
        self.dark_noise_e().powi(2) + rounding
    }

    fn digitised(&self, electrons: f64) -> u16 {
        let dn = electrons * self.gain_dn_per_e + self.black_level_dn;
        // Rounded by the cast, because `round` is a function call on baseline x86-64.
        (dn.clamp(0.0, self.highest() as f64) + 0.5) as u16
    }
}

fn noisy(electrons: f64, read_noise_e: f64, key: RngKey) -> f64 {
    let mut stream = key.counter_stream();
    let read: f64 = StandardNormal.sample(&mut stream);
    shot(electrons, &mut stream) + read_noise_e * read
}

/// Samples a Poisson number that increases monotonically with the mean for equal random numbers.
/// Pixels of nearly equal light then have nearly equal noise.
///
/// For λ ≥ 12, a normal number is transformed by the expansion of Cornish and Fisher (1938) to
/// order 1/λ. For smaller λ, a uniform number is transformed by summing probabilities. The error of
/// the cumulative distribution is below 3.2e-5 for all λ and k.
fn shot(mean: f64, stream: &mut KeyStream) -> f64 {
    if mean >= EXPANDED {
        return expanded_quantile(mean, 0.0, StandardNormal.sample(stream));
    }
    let uniform: f64 = StandardUniform.sample(stream);
    let mut term = (-mean).exp();
    let mut at_most = term;
    let mut k = 0.0;
    // Rounding may leave the sum of all terms below the largest uniform number.
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

    /// A photon of 660 nm has an energy of 3.0098e-19 J (hc = 1.98645e-25 J·m).
    #[test]
    fn electrons_count_photons() {
        // 1 mW/mm² on (5 µm)² for 2 ms is 5e-8 mJ = 5e-11 J.
        let expected = 0.6 * 5e-11 / 3.009_767e-19;
        let found = sensor().electrons_per_irradiance(660e-6);
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
    }

    /// Tests mean and variance (photon transfer) of n = 40 000 pixels. The variance in counts is
    /// K²(μ + σ_d²) + 1/12. Bounds are 5 standard errors (false alarm below 1e-6): σ/√n for the
    /// mean, σ²·√(2/n) for the variance.
    #[test]
    fn noise_follows_the_photon_transfer_curve() {
        let sensor = sensor();
        let n = 40_000u64;
        for electrons in [0.0, 3.0, 100.0, 2_000.0] {
            let key = RngKey::new(1, Purpose::SensorNoise).with(electrons as u64);
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

    /// Evaluates two frames of n = 40 000 pixels at several exposures as in EMVA 1288. Half the
    /// variance of their difference is K²(σ_d² + µ) + 1/12, where µ includes dark current and 1/12
    /// is rounding. The covariance of the frames is K²(DSNU² + PRNU²·µ²), from the fixed patterns.
    /// Noise of at least one count makes rounding errors uniform. Bounds are 5 standard errors:
    /// σ²·√(2/n) for the variance, √((v² + c²)/n) for the covariance c, with v the variance of a
    /// frame.
    #[test]
    fn photon_transfer_finds_what_was_put_in() {
        let mut sensor = sensor();
        sensor.gain_dn_per_e = 0.5;
        let noise = Noise {
            read_noise_e: 6.0,
            dark_current_e_per_s: 1e4,
            prnu: 0.05,
            dsnu_e: 4.0,
            ambient_e_per_s: 0.0,
        };
        sensor.noise = Some(noise);
        let (n, k) = (40_000u64, sensor.gain_dn_per_e);
        let patterns = RngKey::new(1, Purpose::FixedPattern);
        for (exposure_ms, rate) in [(0.1, 0.0), (2.0, 0.0), (2.0, 500.0)] {
            sensor.exposure_ms = exposure_ms;
            let light = exposure_ms * rate;
            let frame = |frame: u64| -> Vec<f64> {
                let key = RngKey::new(1, Purpose::SensorNoise).with(frame);
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
                // The fixed patterns vary the shot noise of the pixels by 5 % about its mean.
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

    /// Tests merged exposures of 1, 1/4 and 1/16. Counts below the full scale of 758 come from the
    /// longest exposure, higher ones from a shorter exposure. The mean remains linear in the light.
    /// The variance is r²(K²(μ/r + σ²) + 1/12), except near a transition between exposures. Bounds
    /// are 5 standard errors of 40 000 pixels. A pixel's noise selects the exposure, which biases
    /// the mean near a transition by less than the noise. Means are therefore tested 10 % away from
    /// a transition.
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
            let key = RngKey::new(2, Purpose::SensorNoise).with(electrons as u64);
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
            sensor.count(1e9, RngKey::new(1, Purpose::SensorNoise)),
            8 + 16 * 750
        );
    }

    /// Compares sums of 40 000 blocks of 3 × 3 pixels, as counts and as charge, with the binned
    /// sensor. Mean and variance agree within 5 standard errors, σ/√n and σ²·√(2/n). The sum of
    /// counts has an additional tolerance of half a count for rounding.
    #[test]
    fn binned_pixels_are_sums_of_pixels() {
        let single = sensor();
        let (side, n, light) = (3u32, 40_000u64, 200.0);
        let key = RngKey::new(1, Purpose::SensorNoise);
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
        // Nine times 1023 needs 14 bits.
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
        let key = RngKey::new(1, Purpose::SensorNoise);
        assert_eq!(sensor.count(1e12, key), 8 + 750);
        sensor.full_well_e = 1e9;
        assert_eq!(sensor.count(1e12, key), 1023);
        assert_eq!(sensor.count(1e300, key), 1023);
    }

    /// For equal random numbers, more light never reduces the count of a pixel, except where the
    /// sampling method changes. A small change of light rarely changes the count.
    #[test]
    fn nearly_the_same_light_has_nearly_the_same_noise() {
        let sensor = sensor();
        let key = RngKey::new(3, Purpose::SensorNoise);
        for electrons in [0.5, 6.0, 13.0, 150.0, 2_000.0] {
            let n = 20_000u64;
            let other = |i| {
                let count = |electrons| sensor.count(electrons, key.with(i));
                let (less, more) = (count(electrons), count(electrons + 0.04));
                assert!(less <= more && more - less <= 1, "{electrons} {i}");
                more > less
            };
            // 0.04 electrons are 0.01 counts, so 1 % of the pixels (200) are expected to change.
            // Five standard deviations more occur with a probability of 3e-7.
            let changed = (0..n).filter(|&i| other(i)).count();
            assert!(changed <= 200 + 71, "{electrons}: {changed}");
        }
    }
}
