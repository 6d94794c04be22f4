//! Images of a laser line at a known position, for tests of peak finders.

use crate::camera::Counts;
use crate::math::rng::{Purpose, RngKey};
use crate::speckle::coordinate::Coordinate;
use crate::speckle::lookup::SpeckleTexture;
use rand_distr::{Distribution, Normal};
use serde::Serialize;
use std::f64::consts::{PI, SQRT_2};

/// Lines of an image. They differ only in their sub-pixel position.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LineCondition {
    /// Standard deviation of the light across the line, px.
    pub sigma: f64,
    /// Skewness of the light across the line, from 0 (Gaussian) to 0.99 (half-Gaussian). The
    /// distribution is the skew-normal distribution of Azzalini (1985).
    pub skewness: f64,
    /// Counts above the black level at the centre of a Gaussian line.
    pub height: f64,
    /// Standard deviation of the normal noise in each pixel, counts.
    pub noise: f64,
    /// Minimal speckle size h, px; 0: no speckle.
    pub speckle_px: f64,
}

pub const BLACK: f64 = 64.0;
pub const MAX_COUNT: u16 = 1023;
/// Number of sub-pixel positions of the line.
pub const PHASES: usize = 16;

/// Texels of the patterns per grain. The next constant is the number of statistically independent
/// slices.
const TEXELS: f64 = 4.0;
const SEPARATE_SLICES: f64 = 3.0;

impl LineCondition {
    fn rows(&self) -> usize {
        2 * (8.0 * self.sigma).ceil() as usize + 24
    }

    /// Returns the row of the centroid of the light in a column.
    pub fn truth(&self, column: usize) -> f64 {
        (self.rows() / 2) as f64 + (column % PHASES) as f64 / PHASES as f64
    }

    /// Returns the light per row and unit area at `x` from the centroid. It is the skew-normal
    /// density 2φ(u)Φ(αu)/ω with this mean, deviation and skewness.
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

    /// Returns the number of samples per pixel side that resolves line and grains.
    fn samples(&self) -> usize {
        let grain = match self.speckle_px > 0.0 {
            true => (3.0 / self.speckle_px).ceil(),
            false => 1.0,
        };
        grain.max((4.0 / self.sigma).ceil()).clamp(4.0, 16.0) as usize
    }

    /// Returns the counts of `columns` lines, clipped at [`MAX_COUNT`]. Column c has equal noise in
    /// all images with equal seed.
    pub fn image(&self, columns: usize, lookup: &SpeckleTexture, seed: u64) -> Counts {
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
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let mut counts = Counts::filled(columns, rows, 0);
        let by_column = counts.by_column_mut().chunks_exact_mut(rows).enumerate();
        for (column, counts) in by_column {
            let light = &light[column % PHASES * rows * n..][..rows * n];
            let mut stream = key.with(column as u64).counter_stream();
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

    /// Returns the speckle intensity at `row`, averaged over the width of a pixel. Columns are
    /// separated by the larger of three grains and a pixel plus two grains, so each is an
    /// independent trial. Where the pattern repeats, a different slice or different rows are used.
    fn speckle(&self, column: usize, row: f64, lookup: &SpeckleTexture) -> f64 {
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
