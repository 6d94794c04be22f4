//! From irradiance to counts: the linear model of EMVA 1288 (release 4.0).

use crate::math::rng::Key;
use glam::UVec2;
use rand_distr::{Distribution, Normal, Poisson};

/// h·c, in mJ·mm: the energy of a photon is this over its wavelength in mm.
const PLANCK_TIMES_LIGHT_SPEED: f64 = 6.626_070_15e-34 * 299_792_458.0 * 1e6;

#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Sensor {
    /// Columns, rows.
    pub resolution: UVec2,
    /// mm.
    pub pixel_pitch: f64,
    pub exposure_ms: f64,
    /// Electrons per photon.
    pub quantum_efficiency: f64,
    pub gain_dn_per_e: f64,
    pub bit_depth: u32,
    pub full_well_e: f64,
    pub black_level_dn: f64,
    /// `None`: counts are the rounded expectation.
    pub noise: Option<Noise>,
}

/// Temporal noise: Poisson shot noise and Gaussian read noise.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Noise {
    pub read_noise_e: f64,
}

impl Sensor {
    /// Expected electrons of a pixel per irradiance (mW/mm²) for light of
    /// `wavelength` (mm): η·A·t·λ/(hc).
    pub fn electrons_per_irradiance(&self, wavelength: f64) -> f64 {
        // mW/mm² · mm² · ms = µJ.
        let millijoules = self.pixel_pitch.powi(2) * self.exposure_ms * 1e-3;
        self.quantum_efficiency * millijoules * wavelength / PLANCK_TIMES_LIGHT_SPEED
    }

    /// Highest count.
    pub fn max_count(&self) -> u16 {
        ((1u32 << self.bit_depth) - 1) as u16
    }

    /// The count of a full pixel: that of the full well, if the scale does not end
    /// before.
    pub fn saturation_count(&self) -> u16 {
        self.digitised(self.full_well_e)
    }

    /// Counts of a pixel that expects `electrons`; `key` is the pixel's own.
    pub fn count(&self, electrons: f64, key: Key) -> u16 {
        let electrons = match self.noise {
            None => electrons,
            Some(noise) => noisy(electrons, noise, key),
        };
        self.digitised(electrons.min(self.full_well_e))
    }

    fn digitised(&self, electrons: f64) -> u16 {
        let dn = electrons * self.gain_dn_per_e + self.black_level_dn;
        // Rounded by the cast: `round` is a call on baseline x86-64.
        (dn.clamp(0.0, self.max_count() as f64) + 0.5) as u16
    }
}

/// Above this mean a Poisson number is drawn as a rounded normal one: its skewness
/// is then below 1e-3, and no saturated pixel needs more.
const POISSON_LIMIT: f64 = 1e6;

fn noisy(electrons: f64, noise: Noise, key: Key) -> f64 {
    let mut stream = key.stream();
    // First, so that pixels of nearly the same light have nearly the same noise however
    // many numbers the shot noise takes.
    let read = Normal::new(0.0, noise.read_noise_e).expect("a finite width");
    let read = read.sample(&mut stream);
    let shot = if electrons <= 0.0 {
        0.0
    } else if electrons > POISSON_LIMIT {
        Normal::new(electrons, electrons.sqrt())
            .expect("a finite mean")
            .sample(&mut stream)
            .round()
    } else {
        Poisson::new(electrons)
            .expect("a mean above 0 and below 1e6")
            .sample(&mut stream)
    };
    shot + read
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::Purpose;

    fn sensor() -> Sensor {
        Sensor {
            resolution: UVec2::new(4, 4),
            pixel_pitch: 0.005,
            exposure_ms: 2.0,
            quantum_efficiency: 0.6,
            gain_dn_per_e: 0.25,
            bit_depth: 10,
            full_well_e: 3_000.0,
            black_level_dn: 8.0,
            noise: Some(Noise { read_noise_e: 6.0 }),
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

    #[test]
    fn counts_stop_at_full_well_and_at_the_highest_code() {
        let mut sensor = sensor();
        let key = Key::new(1, Purpose::SensorNoise);
        assert_eq!(sensor.count(1e12, key), 8 + 750);
        sensor.full_well_e = 1e9;
        assert_eq!(sensor.count(1e12, key), 1023);
        assert_eq!(sensor.count(1e300, key), 1023);
    }
}
