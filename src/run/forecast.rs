//! What a scan will take: memory by arithmetic, and time and disk from a few of its frames.

use super::Control;
use super::frames::FrameContent;
use super::need::{POSE, at_once, images};
use super::pilot::spread_frames;
use super::simulation::Simulation;
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::mesh::memory;
use serde::Serialize;
use std::time::Instant;

/// Frames from which a forecast is made.
const FRAMES: u32 = 3;

/// Bytes of a point in the report: as read from the journal, and all in a row.
const POINT: u64 = 2 * size_of::<CloudPoint>() as u64;
/// Bytes of a point on disk: in `cloud.ply`, and at most in the journal.
const POINT_ON_DISK: u64 = 67 + 92;
/// Bytes of a frame in the journal beside its points.
const RECORD: u64 = 36 + 80;
/// Report, pictures and summary on disk, about, and in memory while they are made.
const REPORT: u64 = 1_500_000;
const REPORTING: u64 = 9_000_000;

/// What the whole scan of a scene takes on this machine with the threads at hand.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Forecast {
    pub frames: u32,
    pub threads: usize,
    /// At its peak, beside mesh and hierarchy; about.
    pub memory_bytes: u64,
    /// Memory that is free now; `None` where the system does not say.
    pub memory_available_bytes: Option<u64>,
    /// Of all files together; about.
    pub disk_bytes: u64,
    /// About; preparing included.
    pub seconds: f64,
}

impl Forecast {
    /// Whether the scan would end for want of memory.
    pub fn fits(&self) -> bool {
        self.memory_available_bytes
            .is_none_or(|available| self.memory_bytes <= available)
    }
}

/// Foretells a scan from three frames spread over it, which are taken for that by a
/// simulation that took `preparing` seconds to make.
pub(crate) fn forecast_of(
    simulation: &Simulation,
    preparing: f64,
    control: &Control,
) -> Result<Forecast> {
    let scene = &simulation.scene;
    let taken = spread_frames(scene.scan.frames, FRAMES);
    let start = Instant::now();
    let (mut points, mut bytes) = (0, 0);
    for &frame in &taken {
        control.check()?;
        let content = FrameContent::of(simulation, frame);
        points += content.points.len() as u64;
        bytes += content
            .files
            .iter()
            .map(|file| file.len() as u64)
            .sum::<u64>();
    }
    let share = scene.scan.frames as f64 / taken.len() as f64;
    let threads = rayon::current_num_threads();
    let frames = scene.scan.frames as u64;
    let points = points as f64 * share;
    let files = bytes as f64 * share + points * POINT_ON_DISK as f64;
    Ok(Forecast {
        frames: scene.scan.frames,
        threads,
        // One after the other.
        memory_bytes: images(scene, at_once(frames))
            .max(REPORTING + frames * POSE + points as u64 * POINT),
        memory_available_bytes: memory::available(),
        disk_bytes: files as u64 + frames * RECORD + REPORT,
        seconds: preparing + start.elapsed().as_secs_f64() * share / at_once(frames) as f64,
    })
}
