//! Which samples a run traces, which frames it takes, and how it is watched and stopped.

use crate::error::{Error, Result};
use crate::scene::Scene;
use std::ops::Range;
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

/// How a long run tells where it is and hears that it should stop.
pub struct Control<'a> {
    /// Called with the number of frames done so far, from any thread.
    pub progress: &'a (dyn Fn(u64) + Sync),
    /// Called with the share that is ready of what comes before frames, from any thread: the hierarchy, and how
    /// reflections are followed; `None`: nobody looks.
    pub building: Option<&'a (dyn Fn(f64) + Sync)>,
    /// Set by anyone, from any thread: the work ends with [`Error::Interrupted`] where it next
    /// asks, a scan after the frames that are in work; it can be resumed.
    pub stop: &'a AtomicBool,
}

impl Control<'_> {
    /// Tells how much of what comes before frames is ready.
    pub(crate) fn prepared(&self, share: f64) -> Result<()> {
        if let Some(building) = self.building {
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

/// Refuses frames the scan does not have, and none.
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

/// Refuses a frame the scan does not have.
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
