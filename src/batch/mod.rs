//! Frames and files: many frames at once, nothing half-written left behind.

#[cfg(feature = "race")]
mod bench_bvh;
mod files;
mod render;
mod scan;
mod simulation;
mod speckle;
mod wave;

#[cfg(feature = "race")]
pub use bench_bvh::{BvhBench, bench_bvh};
pub use render::{RenderSummary, render};
pub use scan::{ScanSummary, scan};
pub use simulation::{Simulation, plan};
pub use speckle::{Grain, SpeckleSummary, speckle};
pub use wave::{
    ComparedMotion, WaveEffort, WaveSummary, reference_motions, wave_patch, wave_reference,
};

use crate::error::{Error, Result};
use crate::scene::Scene;
use std::sync::atomic::{AtomicBool, Ordering};

/// Which samples of a frame are traced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Coverage {
    /// Those that may see lit surface.
    Footprint,
    /// All, to the same bytes: the check of the footprint.
    Exhaustive,
}

impl Coverage {
    fn simulation(self, scene: &Scene) -> Result<Simulation<'_>> {
        match self {
            Coverage::Footprint => Simulation::new(scene),
            Coverage::Exhaustive => Simulation::exhaustive(scene),
        }
    }
}

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

/// Refuses a frame the scan does not have.
fn check_frame(scene: &Scene, frame: u32) -> Result<()> {
    if frame < scene.scan.frames {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "--frame {frame}: the scan of {} has frames 0 to {}",
        scene.path.display(),
        scene.scan.frames - 1
    )))
}
