//! Figures measured over independent patterns, and held against theory.

use super::pattern::PatternSpec;
use crate::math::rng::{Key, Purpose};
use serde::Serialize;

/// One measured figure against theory; `pass` when they differ by no more
/// than `tolerance`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Check {
    /// What was measured.
    pub measured: f64,
    /// What it should be.
    pub theory: f64,
    /// Greatest difference that passes.
    pub tolerance: f64,
    /// Of `measured`, one standard deviation.
    pub standard_error: f64,
    /// Whether the two agree.
    pub pass: bool,
}

impl Check {
    pub(super) fn new(measured: Estimate, theory: f64, tolerance: f64) -> Check {
        Check {
            measured: measured.value,
            theory,
            tolerance,
            standard_error: measured.standard_error,
            pass: (measured.value - theory).abs() <= tolerance,
        }
    }
}

/// A mean over realisations and its standard error.
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

    /// Contrast from its squares.
    pub fn contrast(squares: &[f64]) -> Estimate {
        let square = Estimate::mean(squares);
        let value = square.value.sqrt();
        Estimate {
            value,
            standard_error: square.standard_error / (2.0 * value),
        }
    }
}

/// The same spec under the seed of its `index`-th realisation.
pub(super) fn realisation(spec: &PatternSpec, index: usize) -> PatternSpec {
    let key = Key::new(spec.seed, Purpose::SpecklePattern);
    PatternSpec {
        seed: key.with(index as u64).bits(0),
        ..*spec
    }
}
