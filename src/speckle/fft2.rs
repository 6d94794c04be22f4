//! Two-dimensional Fourier transform of one period.

use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlannerScalar};
use std::sync::Arc;

/// Transforms of size × size values, unnormalised. Each transform transposes its result, so forward
/// and inverse together restore the order.
pub struct Spectrum {
    size: usize,
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
}

impl Spectrum {
    pub fn new(size: usize) -> Spectrum {
        let mut planner = FftPlannerScalar::new();
        Spectrum {
            size,
            forward: planner.plan_fft_forward(size),
            inverse: planner.plan_fft_inverse(size),
        }
    }

    pub fn forward(&self, values: &mut Vec<Complex32>) {
        self.apply(&self.forward, values);
    }

    pub fn inverse(&self, values: &mut Vec<Complex32>) {
        self.apply(&self.inverse, values);
    }

    fn apply(&self, fft: &Arc<dyn Fft<f32>>, values: &mut Vec<Complex32>) {
        fft.process(values);
        *values = self.transposed(values);
        fft.process(values);
    }

    fn transposed(&self, values: &[Complex32]) -> Vec<Complex32> {
        let n = self.size;
        let mut out = vec![Complex32::ZERO; n * n];
        // Eight rows at a time: one cache line of input holds values of all eight.
        for (block, rows) in out.chunks_exact_mut(8 * n).enumerate() {
            for (column, line) in values.chunks_exact(n).enumerate() {
                for (row, value) in rows.chunks_exact_mut(n).zip(&line[8 * block..]) {
                    row[column] = *value;
                }
            }
        }
        out
    }

    /// Returns the frequency of index i, cycles per texel, in [−½, ½).
    pub fn frequency(&self, i: usize) -> f64 {
        let half = self.size / 2;
        ((i + half) % self.size) as f64 / self.size as f64 - 0.5
    }
}
