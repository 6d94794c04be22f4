//! Stateless random numbers: a key says what the number is for, a counter which
//! one it is. No sequence is shared, so any order and any number of threads
//! gives the same numbers.

/// What a random number is used for; part of its key, so that two uses at the
/// same pixel never share numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Phases of a speckle pattern's phasors.
    SpecklePattern = 1,
    /// Shot and read noise of pixels.
    SensorNoise = 2,
    /// Places and heights of a rough surface's scatterers.
    WaveScatterers = 3,
    /// Which values a bootstrap draws again.
    Bootstrap = 4,
    /// Errors of a calibration's observations.
    Calibration = 7,
    /// Values of the samples of a data set.
    Samples = 8,
    /// Rays of `bench-bvh`.
    RaceRays = 16,
    /// What each box of the tree in Rust is widened by.
    BoxPadding = 17,
    /// Paths of light that is reflected more than once.
    Reflections = 9,
    /// Rays by which the plan finds what of the part is in view.
    PlanRays = 18,
}

/// Stafford's mix 13 of the 64-bit finaliser (the output function of
/// SplitMix64; Steele, Lea & Flood 2014).
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// Hash of seed, purpose and indices; make one per use, extend it per index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Key(u64);

impl Key {
    /// A key for one purpose; equal seeds give equal numbers.
    pub fn new(seed: u64, purpose: Purpose) -> Key {
        Key(mix(seed.wrapping_add(GOLDEN))).with(purpose as u64)
    }

    /// A key of its own for `index`: a frame, a pixel, a sample.
    pub fn with(self, index: u64) -> Key {
        Key(mix(self.0 ^ mix(index.wrapping_mul(GOLDEN).wrapping_add(GOLDEN))).wrapping_add(GOLDEN))
    }

    /// The `counter`-th 64 random bits of this key.
    pub fn bits(self, counter: u64) -> u64 {
        mix(self
            .0
            .wrapping_add(counter.wrapping_add(1).wrapping_mul(GOLDEN)))
    }

    /// The `counter`-th uniform number in [0, 1), a multiple of 2⁻⁵³.
    pub fn uniform(self, counter: u64) -> f64 {
        (self.bits(counter) >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// The numbers of this key in order, for samplers that draw an unknown
    /// number of them.
    pub fn stream(self) -> Stream {
        Stream {
            key: self,
            counter: 0,
        }
    }
}

/// The counters 0, 1, 2 … of one key.
pub struct Stream {
    key: Key,
    counter: u64,
}

impl rand_core::TryRng for Stream {
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
        let key = Key::new(1, Purpose::SensorNoise).with(3).with(4);
        let others = [
            Key::new(2, Purpose::SensorNoise).with(3).with(4),
            Key::new(1, Purpose::SpecklePattern).with(3).with(4),
            Key::new(1, Purpose::SensorNoise).with(4).with(3),
            Key::new(1, Purpose::SensorNoise).with(3),
        ];
        assert!(others.iter().all(|o| o.bits(0) != key.bits(0)));
    }

    /// Neighbouring pixels and neighbouring counters are independent uniforms:
    /// mean, variance and lag-one correlation of n numbers lie within 5 standard
    /// errors (1/√12n, 1/√180n, 1/12√n); chance of a false alarm under 2e-6 each,
    /// and the seed is fixed.
    #[test]
    fn numbers_along_pixels_and_counters_are_uniform_and_uncorrelated() {
        let n = 1 << 18;
        let root = Key::new(7, Purpose::SensorNoise);
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
