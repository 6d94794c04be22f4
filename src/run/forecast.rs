//! What a scan will take: memory by arithmetic, and time and disk from a few of its frames.

use super::Control;
use super::frames::FrameContent;
use super::pilot::spread_frames;
use super::simulation::Simulation;
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::coverage::HeadPose;
use crate::mesh::memory;
use crate::scene::Scene;
use serde::Serialize;
use std::time::Instant;

/// Frames from which a forecast is made.
const FRAMES: u32 = 3;

/// Bytes a pixel takes while its frame is in work: its count, and for a picture the
/// counts row by row, these as bytes, and the file, which noise makes as large.
const COUNT: u64 = 2;
const PICTURE: u64 = 3 * 2;
/// Bytes a pixel takes in `render`: the truth (36), twice while its parts are written
/// (60), light, counts and picture.
const RENDERED: u64 = 36 + 60 + 4 + COUNT + PICTURE;

/// Bytes of a point in the report: as read from the journal, and all in a row.
const POINT: u64 = 2 * size_of::<CloudPoint>() as u64;
/// Bytes of a frame in the report, whatever was measured in it.
const POSE: u64 = size_of::<HeadPose>() as u64;
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

/// Frames that are in work at the same time.
fn at_once(frames: u64) -> u64 {
    frames.min(rayon::current_num_threads() as u64)
}

/// Bytes of so many images in work.
fn images(scene: &Scene, count: u64) -> u64 {
    let picture = if scene.write_frames { PICTURE } else { 0 };
    count * pixels(scene) * (COUNT + picture)
}

fn pixels(scene: &Scene) -> u64 {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    u64::from(columns) * u64::from(rows)
}

fn sensor(scene: &Scene) -> String {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    format!("of {columns} × {rows} pixels")
}

/// Refuses what cannot but run out of memory: `count` images of the scene in work.
pub(crate) fn require_images(scene: &Scene, count: u64) -> Result<()> {
    let work = format!("{count} images {} at once", sensor(scene));
    memory::require(work, images(scene, count), memory::available())
}

/// The same of a whole scan: its images, if it takes any, and the poses of its report.
pub(crate) fn require_scan(scene: &Scene, frames: u64, takes_images: bool) -> Result<()> {
    let images = match takes_images {
        true => images(scene, at_once(frames)),
        false => 0,
    };
    let work = format!(
        "a scan of {frames} frames, {} images {} at once and {POSE} bytes a frame in the report,",
        at_once(frames),
        sensor(scene)
    );
    memory::require(work, images + frames * POSE, memory::available())
}

/// The same of a frame with its truth.
pub(crate) fn require_render(scene: &Scene) -> Result<()> {
    let work = format!(
        "a frame {} with its truth, {RENDERED} bytes a pixel,",
        sensor(scene)
    );
    memory::require(work, RENDERED * pixels(scene), memory::available())
}
