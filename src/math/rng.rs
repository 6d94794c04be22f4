//! Stateless random numbers: a key names the use of the number, and a counter its index.
//!
//! No sequence is shared between uses. The numbers therefore do not depend on the order of
//! evaluation or the number of threads.

/// Use of a random number. It is part of the key, so two uses at one pixel have independent
/// numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Phases of the phasors of a speckle pattern.
    SpecklePattern = 1,
    /// Shot and read noise of pixels.
    SensorNoise = 2,
    /// Positions and heights of the scatterers of a rough surface.
    WaveScatterers = 3,
    /// Indices of bootstrap resampling.
    Bootstrap = 4,
    /// Errors whose median is computed.
    Median = 5,
    /// Errors of the observations of a calibration.
    Calibration = 7,
    /// Parameter values of the samples of a data set.
    Samples = 8,
    /// Fixed-pattern differences between pixels, equal in all frames.
    FixedPattern = 9,
    /// Rays of `bench-bvh`.
    RaceRays = 16,
    /// Widening of each box of the Rust bounding volume hierarchy.
    BoxPadding = 17,
    /// Paths of indirect light.
    Reflections = 10,
    /// Rays that find the visible region of the part when models are chosen.
    PlanRays = 18,
    /// Systematic errors of sensor and stage.
    Systematic = 19,
    /// Heights of the topography of a surface.
    Topography = 20,
}

/// Mixes 64 bits by Stafford's variant 13 of the finalizer, the output function of SplitMix64
/// (Steele, Lea & Flood 2014).
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// Hash of seed, purpose and indices. Create one per use and extend it per index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RngKey(u64);

impl RngKey {
    /// Returns the key of one purpose; equal seeds give equal numbers.
    pub fn new(seed: u64, purpose: Purpose) -> RngKey {
        RngKey(mix(seed.wrapping_add(GOLDEN))).with(purpose as u64)
    }

    /// Returns a separate key for `index`: a frame, a pixel or a sample.
    pub fn with(self, index: u64) -> RngKey {
        RngKey(
            mix(self.0 ^ mix(index.wrapping_mul(GOLDEN).wrapping_add(GOLDEN))).wrapping_add(GOLDEN),
        )
    }

    /// Returns 64 random bits of this key at index `counter`.
    pub fn bits(self, counter: u64) -> u64 {
        mix(self
            .0
            .wrapping_add(counter.wrapping_add(1).wrapping_mul(GOLDEN)))
    }

    /// Returns the uniform number at index `counter`, in [0, 1), a multiple of 2⁻⁵³.
    pub fn uniform(self, counter: u64) -> f64 {
        (self.bits(counter) >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Returns the numbers of this key in order, for samplers that consume an unknown count.
    pub fn counter_stream(self) -> KeyStream {
        KeyStream {
            key: self,
            counter: 0,
        }
    }
}

/// Sequence of the counters 0, 1, 2 … of one key.
pub struct KeyStream {
    key: RngKey,
    counter: u64,
}

impl rand_core::TryRng for KeyStream {
    type Error = std::convert::Infallible;

    fn try_next_u32(&mut self) -> Result<u32, Self::Error> {
        Ok((self.try_next_u64()? >> 32) as u32)
    }

    fn try_next_u64(&mut self) -> Result<u64, Self::Error> {
        let bits = self.key.bits(self.counter);
        self.counter += 1;
        Ok(bits)
    }

    fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), Self::Error> {
        for chunk in bytes.chunks_mut(8) {
            let bits = self.try_next_u64()?.to_le_bytes();
            chunk.copy_from_slice(&bits[..chunk.len()]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_differ_by_seed_purpose_and_index() {
        let key = RngKey::new(1, Purpose::SensorNoise).with(3).with(4);
        let others = [
            RngKey::new(2, Purpose::SensorNoise).with(3).with(4),
            RngKey::new(1, Purpose::SpecklePattern).with(3).with(4),
            RngKey::new(1, Purpose::SensorNoise).with(4).with(3),
            RngKey::new(1, Purpose::SensorNoise).with(3),
        ];
        assert!(others.iter().all(|o| o.bits(0) != key.bits(0)));
    }

    /// Tests that neighbouring pixels and neighbouring counters give independent uniform numbers.
    ///
    /// Mean, variance and lag-one correlation of n numbers must lie within 5 standard errors
    /// (1/√12n, 1/√180n, 1/12√n). The false-alarm probability is below 2e-6 per test, and the seed
    /// is fixed.
    #[test]
    fn numbers_along_pixels_and_counters_are_uniform_and_uncorrelated() {
        let n = 1 << 18;
        let root = RngKey::new(7, Purpose::SensorNoise);
        let along_pixels: Vec<f64> = (0..n).map(|i| root.with(i).uniform(0)).collect();
        let along_counter: Vec<f64> = (0..n).map(|i| root.uniform(i)).collect();
        for numbers in [along_pixels, along_counter] {
            let n = n as f64;
            let mean = numbers.iter().sum::<f64>() / n;
            let var = numbers.iter().map(|x| (x - 0.5).powi(2)).sum::<f64>() / n;
            let lag = numbers
                .windows(2)
                .map(|w| (w[0] - 0.5) * (w[1] - 0.5))
                .sum::<f64>()
                / n;
            assert!((mean - 0.5).abs() < 5.0 / (12.0 * n).sqrt(), "{mean}");
            assert!((var - 1.0 / 12.0).abs() < 5.0 / (180.0 * n).sqrt(), "{var}");
            assert!(lag.abs() < 5.0 / (12.0 * n.sqrt()), "{lag}");
        }
    }
}
