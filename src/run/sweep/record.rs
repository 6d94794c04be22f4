//! What is kept of a place.

use super::figures::Figures;
use crate::run::journal;
use serde::{Deserialize, Serialize};

#[derive(Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    pub place: u64,
    pub outcome: Outcome,
    /// Warnings, or why it was refused.
    pub message: String,
    pub figures: Figures,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Outcome {
    Good,
    Warned,
    Refused,
}

impl journal::Record for Record {
    /// Whether all figures are finite.
    fn is_sound(&self) -> bool {
        self.figures.values().all(|figure| figure.is_finite())
    }
}

impl Record {
    pub fn refused(place: u64, message: String) -> Record {
        Record {
            place,
            outcome: Outcome::Refused,
            message,
            figures: Figures::new(),
        }
    }
}
