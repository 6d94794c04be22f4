//! Trace mode, selection of frames, progress and cancellation of a run.

use crate::error::{Error, Result};
use crate::scene::Scene;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// Selection of the samples of a frame that are traced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TraceMode {
    /// Samples that may see lit surface.
    Footprint,
    /// All samples. The output is byte-identical, which verifies the footprint.
    Exhaustive,
}

/// Progress reports and cancellation of a long run.
pub struct RunControl<'a> {
    /// Called with the number of frames done so far, from any thread.
    pub progress: &'a (dyn Fn(u64) + Sync),
    /// Called with the progress of the preparation (0 to 1), from any thread. Preparation builds
    /// the hierarchy and plans the indirect light; `None` disables the reports.
    pub setup_progress: Option<&'a (dyn Fn(f64) + Sync)>,
    /// Called once before a scan whose frames take more than one hour, with its predicted duration
    /// and a remedy; `None` skips the prediction.
    pub notice: Option<&'a (dyn Fn(&str) + Sync)>,
    /// Can be set from any thread. The work then ends with [`Error::Interrupted`] at its next
    /// check. A scan first finishes the frames in progress and can be resumed.
    pub stop: &'a AtomicBool,
}

impl RunControl<'_> {
    /// Reports the progress of the preparation.
    pub(crate) fn prepared(&self, share: f64) -> Result<()> {
        if let Some(building) = self.setup_progress {
            building(share);
        }
        self.check()
    }

    pub(crate) fn check(&self) -> Result<()> {
        match self.stop.load(Ordering::Relaxed) {
            true => Err(Error::Interrupted),
            false => Ok(()),
        }
    }
}

/// Refuses an empty range and frames outside the scan.
pub(crate) fn check_frames(scene: &Scene, frames: &Range<u32>) -> Result<()> {
    if !frames.is_empty() && frames.end <= scene.scan.frames {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "frames {}..{}: expected A..B with A < B, B at most {}, the number of frames of {}",
        frames.start,
        frames.end,
        scene.scan.frames,
        scene.path.display()
    )))
}

/// Refuses a frame outside the scan.
pub(crate) fn check_frame(scene: &Scene, frame: u32) -> Result<()> {
    if frame < scene.scan.frames {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "frame {frame}: the scan of {} has frames 0 to {}",
        scene.path.display(),
        scene.scan.frames - 1
    )))
}
