//! Images of a laser line whose place is known, for trying finders on.

use crate::camera::Counts;
use crate::math::rng::{Key, Purpose};
use crate::speckle::coordinate::Coordinate;
use crate::speckle::lookup::Lookup;
use rand_distr::{Distribution, Normal};
use serde::Serialize;
use std::f64::consts::{PI, SQRT_2};

/// Lines of an image: all alike but for where they lie in their pixels.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Condition {
    /// Standard deviation of the light across the line, px.
    pub sigma: f64,
    /// Skewness of the light across the line, 0 for a Gaussian, up to 0.99 (that of
    /// a half-Gaussian): Azzalini's (1985) skew-normal distribution.
    pub skewness: f64,
    /// Counts above the black level at the middle of a Gaussian line.
    pub height: f64,
    /// Standard deviation of normal noise in each pixel, counts.
    pub noise: f64,
    /// Minimal speckle size h, px; 0: light without speckle.
    pub speckle_px: f64,
}

pub const BLACK: f64 = 64.0;
pub const MAX_COUNT: u16 = 1023;
/// Places of the line in its pixel that are tried.
pub const PHASES: usize = 16;

/// Texels of the patterns per grain, and slices that share nothing with each other.
const TEXELS: f64 = 4.0;
const SEPARATE_SLICES: f64 = 3.0;

impl Condition {
    fn rows(&self) -> usize {
        2 * (8.0 * self.sigma).ceil() as usize + 24
    }

    /// Row of the light's centre of gravity in a column.
    pub fn truth(&self, column: usize) -> f64 {
        (self.rows() / 2) as f64 + (column % PHASES) as f64 / PHASES as f64
    }

    /// Light per row and unit of area at `x` from the centre of gravity: the
    /// skew-normal density 2φ(u)Φ(αu)/ω of this mean, deviation and skewness.
    fn density(&self, x: f64) -> f64 {
        // Skewness γ gives δ by δ² = (π/2)·γ^⅔/(γ^⅔ + ((4-π)/2)^⅔).
        let g = self.skewness.powf(2.0 / 3.0);
        let delta = (PI / 2.0 * g / (g + ((4.0 - PI) / 2.0).powf(2.0 / 3.0))).sqrt();
        let delta = delta.min(0.999);
        let alpha = delta / (1.0 - delta * delta).sqrt();
        let scale = self.sigma / (1.0 - 2.0 * delta * delta / PI).sqrt();
        let u = x / scale + delta * (2.0 / PI).sqrt();
        (-0.5 * u * u).exp() / (2.0 * PI).sqrt() * libm::erfc(-alpha * u / SQRT_2) / scale
    }

    /// Samples of a pixel a side at which line and grains are resolved.
    fn samples(&self) -> usize {
        let grain = match self.speckle_px > 0.0 {
            true => (3.0 / self.speckle_px).ceil(),
            false => 1.0,
        };
        grain.max((4.0 / self.sigma).ceil()).clamp(4.0, 16.0) as usize
    }

    /// Counts of `columns` lines, cut at [`MAX_COUNT`]. Column c of all
    /// images with the same seed has the same noise.
    pub fn image(&self, columns: usize, lookup: &Lookup, seed: u64) -> Counts {
        let rows = self.rows();
        let n = self.samples();
        let area = self.height * self.sigma * (2.0 * PI).sqrt();
        let place = |row: usize, i: usize| row as f64 + (i as f64 + 0.5) / n as f64;
        let light: Vec<f64> = (0..PHASES * rows * n)
            .map(|k| {
                let (phase, sample) = (k / (rows * n), k % (rows * n));
                let x = place(sample / n, sample % n) - self.truth(phase);
                area * self.density(x) / n as f64
            })
            .collect();
        let normal = Normal::new(0.0, self.noise).expect("a finite width");
        let key = Key::new(seed, Purpose::SensorNoise);
        let mut counts = Counts::filled(columns, rows, 0);
        let by_column = counts.by_column_mut().chunks_exact_mut(rows).enumerate();
        for (column, counts) in by_column {
            let light = &light[column % PHASES * rows * n..][..rows * n];
            let mut stream = key.with(column as u64).stream();
            for (row, count) in counts.iter_mut().enumerate() {
                let sum: f64 = (0..n)
                    .map(|i| {
                        let light = light[row * n + i];
                        match self.speckle_px > 0.0 && light > 1e-6 * self.height {
                            true => light * self.speckle(column, place(row, i), lookup),
                            false => light,
                        }
                    })
                    .sum();
                let value = BLACK + sum + normal.sample(&mut stream);
                *count = value.round().clamp(0.0, MAX_COUNT as f64) as u16;
            }
        }
        counts
    }

    /// Mean over the width of a pixel of the speckle's intensity at `row`. Columns
    /// stand three grains or a pixel and two grains apart, so that each is a new
    /// trial; where the pattern repeats, another slice or other rows are read.
    fn speckle(&self, column: usize, row: f64, lookup: &Lookup) -> f64 {
        let n = self.samples();
        let texels = TEXELS / self.speckle_px;
        let apart = (texels + 2.0 * TEXELS).max(3.0 * TEXELS);
        let along = column as f64 * apart;
        let turn = (along / 1024.0).floor();
        let slice = turn % SEPARATE_SLICES * 32.0 / SEPARATE_SLICES;
        let across = (turn / SEPARATE_SLICES).floor() * (6.0 * self.sigma * texels + 8.0);
        let sum: f64 = (0..n)
            .map(|i| {
                let s = along + (i as f64 + 0.5) / n as f64 * texels;
                let t = across + row * texels;
                lookup.intensity(Coordinate { s, t, u: slice }) as f64
            })
            .sum();
        sum / n as f64
    }
}
