//! Figures measured over independent patterns, and their comparison with theory.

use super::pattern::PatternSpec;
use crate::math::rng::{Purpose, RngKey};
use serde::Serialize;

/// Comparison of one measured figure with theory.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StatisticalCheck {
    /// Measured value.
    pub measured: f64,
    /// Value from theory.
    pub theory: f64,
    /// Largest accepted difference.
    pub tolerance: f64,
    /// Standard error of `measured`.
    pub standard_error: f64,
    /// True if `measured` and `theory` differ by at most `tolerance`.
    pub pass: bool,
}

impl StatisticalCheck {
    pub(super) fn new(measured: Estimate, theory: f64, tolerance: f64) -> StatisticalCheck {
        StatisticalCheck {
            measured: measured.value,
            theory,
            tolerance,
            standard_error: measured.standard_error,
            pass: (measured.value - theory).abs() <= tolerance,
        }
    }
}

/// Mean over realisations, with its standard error.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    pub value: f64,
    pub standard_error: f64,
}

impl Estimate {
    pub fn mean(values: &[f64]) -> Estimate {
        let n = values.len() as f64;
        let value = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|v| (v - value).powi(2)).sum::<f64>() / (n - 1.0);
        Estimate {
            value,
            standard_error: (variance / n).sqrt(),
        }
    }

    /// Computes the contrast from its squares.
    pub fn contrast(squares: &[f64]) -> Estimate {
        let square = Estimate::mean(squares);
        let value = square.value.sqrt();
        Estimate {
            value,
            standard_error: square.standard_error / (2.0 * value),
        }
    }
}

/// Returns `spec` with the random seed of its `index`-th realisation.
pub(super) fn realisation(spec: &PatternSpec, index: usize) -> PatternSpec {
    let key = RngKey::new(spec.seed, Purpose::SpecklePattern);
    PatternSpec {
        seed: key.with(index as u64).bits(0),
        ..*spec
    }
}
