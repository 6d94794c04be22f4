//! What is kept of a place.

use super::figures::Figures;
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
