//! A simulation with the points of its recent frames. Flags depend on neighbouring frames, which
//! a loop over frames then measures once.

use crate::threads;
use lasertrace::Simulation;
use lasertrace::inspect::cloud::CloudPoint;
use pyo3::prelude::*;
use std::collections::HashMap;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Maximum number of recent frames. Their points occupy about 0.2 MB each for a sensor of 1280
/// columns.
const RECENT: usize = 64;

/// Points of a frame, with the flags of this frame only.
pub type Measured = Arc<Vec<CloudPoint>>;

/// Simulation and recent frames.
pub struct Recent {
    pub core: Simulation,
    /// Points by frame. The lock is held only briefly and with the GIL.
    frames: Mutex<HashMap<u32, Measured>>,
}

impl Recent {
    pub fn new(core: Simulation) -> Recent {
        Recent {
            core,
            frames: Mutex::default(),
        }
    }

    fn frames(&self) -> MutexGuard<'_, HashMap<u32, Measured>> {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Stores the points of a frame. Frames far from it are removed.
    pub fn insert(&self, _: Python<'_>, frame: u32, points: Measured) {
        let mut frames = self.frames();
        frames.retain(|other, _| (other.abs_diff(frame) as usize) < RECENT / 2);
        frames.insert(frame, points);
    }

    /// Returns the points of a frame with the flags of a scan of this frame.
    pub fn flagged(
        &self,
        py: Python<'_>,
        threads: usize,
        frame: u32,
        points: &Measured,
    ) -> PyResult<Vec<CloudPoint>> {
        self.insert(py, frame, points.clone());
        let known = self.frames().clone();
        let measured = Mutex::new(Vec::new());
        let flagged = threads::run(py, threads, |stop| {
            let of = |frame: u32| {
                if stop.load(Relaxed) {
                    return Ok(Vec::new());
                }
                if let Some(points) = known.get(&frame) {
                    return Ok(points.to_vec());
                }
                let (_, points) = self.core.profile(frame);
                let mut measured = measured.lock().unwrap_or_else(PoisonError::into_inner);
                measured.push((frame, Arc::new(points.clone())));
                Ok(points)
            };
            let mut points = points.to_vec();
            let compared = self
                .core
                .compare_piece(&(frame..frame + 1), &mut points, of);
            compared.map(|()| points)
        })?;
        let measured = measured
            .into_inner()
            .unwrap_or_else(PoisonError::into_inner);
        for (frame, points) in measured {
            self.insert(py, frame, points);
        }
        flagged.map_err(crate::raised)
    }
}
