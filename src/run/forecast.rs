//! What a scan will take: memory by arithmetic, and time and disk from a few of its frames.

use super::Control;
use super::frames::FrameContent;
use super::need::{POSE, at_once, images};
use super::pilot::spread_frames;
use super::simulation::Simulation;
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::mesh::memory;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::time::Instant;

/// Frames of those with light that are taken for a forecast.
const FRAMES: u32 = 3;
/// Seconds after which no further one is taken: frames that slow differ by less than they take.
const ENOUGH: f64 = 2.0;
/// Frames of which it is asked how many of the sensor's columns may be lit.
const FRAMES_ASKED: u32 = 256;

/// Bytes of a point in the report: as read from the journal, and all in a row.
const POINT: u64 = 2 * size_of::<CloudPoint>() as u64;
/// Bytes of a point on disk: in `cloud.ply`, `profiles.npy`, and at most in the journal.
const POINT_ON_DISK: u64 = 79 + 106 + 136;
/// Bytes of a frame in the journal beside its points.
const RECORD: u64 = 36 + 80;
/// Report, pictures and summary on disk, about, and in memory while they are made.
const REPORT: u64 = 1_500_000;
const REPORTING: u64 = 9_000_000;

/// What the whole scan of a scene takes on this machine with the threads at hand.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Forecast {
    /// Number of frames.
    pub frames: u32,
    /// Threads at hand.
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

/// Foretells a scan of these frames from a few of them, which are taken for that by a
/// simulation that took `preparing` seconds to make.
pub(crate) fn forecast_of(
    simulation: &Simulation,
    frames: &Range<u32>,
    preparing: f64,
    control: &Control,
) -> Result<Forecast> {
    let scene = &simulation.scene;
    let threads = rayon::current_num_threads();
    let count = frames.len() as u64;
    let Taken {
        seconds,
        points,
        bytes,
    } = taken(simulation, frames, control)?;
    let files = bytes + points * POINT_ON_DISK as f64;
    Ok(Forecast {
        frames: frames.len() as u32,
        threads,
        // One after the other.
        memory_bytes: images(scene, at_once(count)).max(report(count, points as u64)),
        memory_available_bytes: memory::available(),
        disk_bytes: files as u64 + count * RECORD + REPORT,
        seconds: preparing + seconds / at_once(count) as f64,
    })
}

/// What frames take together: seconds of one core, points, and bytes of their images.
#[derive(Default)]
struct Taken {
    seconds: f64,
    points: f64,
    bytes: f64,
}

/// Estimated from few of the frames: points and bytes in proportion to the columns that
/// may be lit, which are asked of many frames (the ratio estimate, Cochran 1977); seconds
/// of frames with light and of dark ones each in proportion to their number.
fn taken(simulation: &Simulation, frames: &Range<u32>, control: &Control) -> Result<Taken> {
    let asked = spread_frames(frames.len() as u32, FRAMES_ASKED);
    let share = frames.len() as f64 / asked.len() as f64;
    let width = |i: u32| simulation.columns_at_most(frames.start + i);
    let (lit, dark): (Vec<_>, Vec<_>) = asked
        .into_par_iter()
        .map(|i| (frames.start + i, width(i)))
        .partition(|&(_, columns)| columns > 0);
    let mut all = Taken::default();
    for (kind, most) in [(lit, FRAMES), (dark, 1)] {
        let (mut sample, mut columns, mut count) = (Taken::default(), 0, 0);
        for i in spread_frames(kind.len() as u32, most) {
            if sample.seconds > ENOUGH {
                break;
            }
            control.check()?;
            let (frame, lit) = kind[i as usize];
            let start = Instant::now();
            let content = FrameContent::of(simulation, frame);
            sample.seconds += start.elapsed().as_secs_f64();
            sample.points += content.points.len() as f64;
            sample.bytes += content.image.map_or(0, |image| image.len()) as f64;
            columns += lit;
            count += 1;
        }
        let by_number = share * kind.len() as f64 / count.max(1) as f64;
        let all_columns: usize = kind.iter().map(|(_, columns)| columns).sum();
        let by_columns = match columns {
            0 => by_number,
            _ => share * all_columns as f64 / columns as f64,
        };
        all.seconds += by_number * sample.seconds;
        all.points += by_columns * sample.points;
        all.bytes += by_columns * sample.bytes;
    }
    Ok(all)
}

/// Bytes of a report of so many frames and points, while it is made.
fn report(frames: u64, points: u64) -> u64 {
    REPORTING + frames * POSE + points * POINT
}

/// Whether the report fits even if every column of every frame gives a point.
pub(crate) fn any_report_fits(scene: &Scene, frames: u64) -> bool {
    let columns = u64::from(scene.camera.sensor.resolution.x);
    memory::available().is_none_or(|available| report(frames, frames * columns) <= available)
}

/// Refuses a scan of which as many points are foretold as do not fit.
pub(crate) fn require_points(
    simulation: &Simulation,
    frames: &Range<u32>,
    control: &Control,
) -> Result<()> {
    let points = taken(simulation, frames, control)?.points as u64;
    let count = frames.len() as u64;
    let work = format!(
        "the report of a scan of {count} frames and about {points} points, {POINT} bytes each,"
    );
    memory::require(work, report(count, points), memory::available())
}
