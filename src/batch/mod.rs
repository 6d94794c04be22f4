//! Frames and files: many frames at once, nothing half-written left behind.

mod files;
mod render;
mod scan;
mod simulation;

pub use render::{RenderSummary, render};
pub use scan::{ScanSummary, scan};
pub use simulation::{Simulation, plan};

use crate::error::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// How a long run tells where it is and hears that it should stop.
pub struct Control<'a> {
    /// Called with the number of frames done so far, from any thread.
    pub progress: &'a (dyn Fn(u64) + Sync),
    pub stop: &'a AtomicBool,
}

impl Control<'_> {
    fn check(&self) -> Result<()> {
        match self.stop.load(Ordering::Relaxed) {
            true => Err(Error::Interrupted),
            false => Ok(()),
        }
    }
}
