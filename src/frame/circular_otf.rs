//! Transfer function of the mean light for a round pupil, tabulated once for all tiles and frames.
//!
//! On the axis, the transfer function T depends on the lag ν between two overlapping discs (pupil
//! diameters) and on the blur β. T = 4/π·∫ √(1 − x²)·cos(πβν(x − ν)) dx over x from ν to 1 (Hopkins
//! 1955).
//!
//! The table is interpolated linearly, with a total error of at most 6e-4. Interpolation over ν has
//! the error ∂²T/∂ν²·Δν²/8, where |∂²T/∂ν²| < (πβ/2)² and Δν is proportional to 1/β. Interpolation
//! over β has the error ∂²T/∂β²·Δβ²/8, where |∂²T/∂β²| < ½.

use crate::math::quadrature::gauss_legendre;
use std::f64::consts::PI;
use std::sync::OnceLock;

/// Step of β between rows.
const BLUR_TABLE_STEP: f64 = 1.0 / 16.0;
const ROWS: usize = 2048;
/// Largest |β| in the table.
pub(super) const MAX_BLUR: f64 = BLUR_TABLE_STEP * (ROWS - 2) as f64;

static TABLE: [OnceLock<OtfRow>; ROWS] = [const { OnceLock::new() }; ROWS];

/// Transfer function of one blur, as a function of the lag.
struct OtfRow {
    /// Values at lags from 0 to 1, and one more for interpolation.
    values: Vec<f32>,
    intervals: f32,
}

impl OtfRow {
    fn new(blur: f64) -> OtfRow {
        let intervals = 256 + (32.0 * blur) as usize;
        // The number of nodes follows `Pupil::rule`.
        let rule = gauss_legendre(8 + (blur * PI / 8.0).ceil() as usize);
        let value = |i: usize| {
            let lag = (i as f64 / intervals as f64).min(1.0);
            let widest = lag.acos();
            let part = |&(x, weight): &(f64, f64)| {
                let (sin, cos) = (x * widest).sin_cos();
                weight * sin * sin * (PI * blur * lag * (cos - lag)).cos()
            };
            (4.0 / PI * widest * rule.iter().map(part).sum::<f64>()) as f32
        };
        OtfRow {
            values: (0..=intervals + 1).map(value).collect(),
            intervals: intervals as f32,
        }
    }

    /// Returns the transfer at a lag of at most 1.
    #[inline(always)]
    fn at(&self, lag: f32) -> f32 {
        let place = lag * self.intervals;
        let i = place as usize;
        let [before, after] = [self.values[i], self.values[i + 1]];
        before + (place - i as f32) * (after - before)
    }
}

/// Transfer functions for a range of blurs.
pub(super) struct CircularOtfTable {
    first: usize,
    rows: Vec<&'static OtfRow>,
}

impl CircularOtfTable {
    /// Prepares the table for |β| from `low` to `high`, at most [`MAX_BLUR`].
    pub fn new(low: f64, high: f64) -> CircularOtfTable {
        let first = (low / BLUR_TABLE_STEP) as usize;
        let last = (high / BLUR_TABLE_STEP) as usize + 1;
        let row = |k: usize| TABLE[k].get_or_init(|| OtfRow::new(k as f64 * BLUR_TABLE_STEP));
        CircularOtfTable {
            first,
            rows: (first..=last).map(row).collect(),
        }
    }

    /// Returns the transfer at a lag, for a |β| in the prepared range.
    #[inline(always)]
    pub fn transfer(&self, lag: f32, blur: f32) -> f32 {
        if lag >= 1.0 {
            return 0.0;
        }
        let place = blur * (1.0 / BLUR_TABLE_STEP as f32) - self.first as f32;
        let row = (place.max(0.0) as usize).min(self.rows.len() - 2);
        let [near, far] = [0, 1].map(|i| self.rows[row + i].at(lag));
        near + (place - row as f32) * (far - near)
    }
}
