//! Random scenes.

// Each test file uses what it needs of this.
#![allow(dead_code)]

use lasertrace::math::DVec3;
use lasertrace::math::rng::{Purpose, RngKey};

/// A sequence of random choices, the same on every run.
pub struct Random(RngKey, u64);

impl Random {
    pub fn new(seed: u64) -> Random {
        Random(RngKey::new(seed, Purpose::SensorNoise), 0)
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        self.1 += 1;
        low + (high - low) * self.0.uniform(self.1)
    }

    /// Uniform in the logarithm.
    pub fn scale(&mut self, low: f64, high: f64) -> f64 {
        self.between(low.ln(), high.ln()).exp()
    }

    /// One of 0 to n - 1.
    pub fn choice(&mut self, n: usize) -> usize {
        self.between(0.0, n as f64) as usize
    }

    pub fn vector(&mut self, half: f64) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.between(-half, half)))
    }

    pub fn direction(&mut self) -> DVec3 {
        loop {
            let v = self.vector(1.0);
            if (0.1..1.0).contains(&v.length()) {
                return v.normalize();
            }
        }
    }
}
