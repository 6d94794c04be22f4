//! Record of a run of a sweep.

use super::figures::Figures;
use crate::run::journal;
use serde::{Deserialize, Serialize};

#[derive(Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    pub place: u64,
    pub outcome: RunOutcome,
    /// Warnings, or the reason of the refusal.
    pub message: String,
    pub figures: Figures,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum RunOutcome {
    Good,
    Warned,
    Refused,
}

impl journal::Record for RunRecord {
    /// Returns whether all figures are finite.
    fn is_sound(&self) -> bool {
        self.figures.values().all(|figure| figure.is_finite())
    }
}

impl RunRecord {
    pub fn refused(place: u64, message: String) -> RunRecord {
        RunRecord {
            place,
            outcome: RunOutcome::Refused,
            message,
            figures: Figures::new(),
        }
    }
}
