//! The transfer of the mean light of a round pupil, tabulated once for all tiles and frames.
//!
//! Seen along the axis it is one function of two numbers: the lag ν between the two discs that
//! overlap (pupil diameters) and the blur β, T = 4/π·∫ √(1 − x²)·cos(πβν(x − ν)) dx over x from ν
//! to 1 (Hopkins 1955). Between its places it is linear: off by ∂²T/∂ν²/8 steps², of which the
//! former is below (πβ/2)² and the latter follows 1/β, and by ∂²T/∂β²/8 steps², of which the former
//! is below ½: 6e-4 together.

use crate::math::quadrature::gauss_legendre;
use std::f64::consts::PI;
use std::sync::OnceLock;

/// Blurs from one row to the next.
const STEP: f64 = 1.0 / 16.0;
const ROWS: usize = 2048;
/// Greatest |β| in the table.
pub(super) const MOST: f64 = STEP * (ROWS - 2) as f64;

static TABLE: [OnceLock<Row>; ROWS] = [const { OnceLock::new() }; ROWS];

/// Of one blur, over lags.
struct Row {
    /// From 0 to 1, and one more.
    values: Vec<f32>,
    intervals: f32,
}

impl Row {
    fn new(blur: f64) -> Row {
        let intervals = 256 + (32.0 * blur) as usize;
        // See `Pupil::rule`.
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
        Row {
            values: (0..=intervals + 1).map(value).collect(),
            intervals: intervals as f32,
        }
    }

    /// At a lag of at most 1.
    #[inline(always)]
    fn at(&self, lag: f32) -> f32 {
        let place = lag * self.intervals;
        let i = place as usize;
        let [before, after] = [self.values[i], self.values[i + 1]];
        before + (place - i as f32) * (after - before)
    }
}

/// Transfers of discs about as far out of focus as each other.
pub(super) struct Disc {
    first: usize,
    rows: Vec<&'static Row>,
}

impl Disc {
    /// For |β| from `low` to `high`, at most [`MOST`].
    pub fn new(low: f64, high: f64) -> Disc {
        let first = (low / STEP) as usize;
        let last = (high / STEP) as usize + 1;
        let row = |k: usize| TABLE[k].get_or_init(|| Row::new(k as f64 * STEP));
        Disc {
            first,
            rows: (first..=last).map(row).collect(),
        }
    }

    /// At a lag, for a |β| of those it is made for.
    #[inline(always)]
    pub fn transfer(&self, lag: f32, blur: f32) -> f32 {
        if lag >= 1.0 {
            return 0.0;
        }
        let place = blur * (1.0 / STEP as f32) - self.first as f32;
        let row = (place.max(0.0) as usize).min(self.rows.len() - 2);
        let [near, far] = [0, 1].map(|i| self.rows[row + i].at(lag));
        near + (place - row as f32) * (far - near)
    }
}
