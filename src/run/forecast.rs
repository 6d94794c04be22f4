//! Forecast of a scan: memory by calculation, time and disk space from a few frames.

use super::RunControl;
use super::frames::FrameContent;
use super::memory_estimate::{POSE, at_once, images};
use super::pilot::spread_frames;
use super::simulation::Simulation;
use super::warning_kind::SHORTER_SCAN;
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::mesh::memory;
use crate::report::chart::short;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::time::Instant;

/// Number of frames with light that are simulated for a forecast.
const FRAMES: u32 = 3;
/// Time after which no further frame is simulated, s. Frames that take so long differ little in
/// duration.
const ENOUGH: f64 = 2.0;
/// Number of paths of indirect light above which the duration of a frame is extrapolated.
const MAX_PATHS: f64 = (1u32 << 18) as f64;
/// Maximum number of frames whose lit columns are counted.
const FRAMES_ASKED: u32 = 256;

/// Memory per point in the report, bytes: one copy from the journal and one in a contiguous array.
const POINT: u64 = 2 * size_of::<CloudPoint>() as u64;
/// Disk space per point, bytes: in `cloud.ply`, in `profiles.npy`, and the maximum in the journal.
const POINT_ON_DISK: u64 = 79 + 106 + 136;
/// Disk space per frame in the journal without its points, bytes.
const RECORD: u64 = 36 + 80;
/// Approximate size of report, images and summary on disk, bytes; `REPORTING` is their memory.
const REPORT: u64 = 1_500_000;
const REPORTING: u64 = 9_000_000;

/// Resources of the complete scan of a scene on this machine with the current threads.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ResourceEstimate {
    /// Number of frames.
    pub frames: u32,
    /// Number of threads.
    pub threads: usize,
    /// Approximate peak memory without mesh and hierarchy, bytes.
    pub memory_bytes: u64,
    /// Free memory, bytes; `None` if the system does not report it.
    pub memory_available_bytes: Option<u64>,
    /// Approximate disk space of all files, bytes.
    pub disk_bytes: u64,
    /// Approximate duration including preparation, s.
    pub seconds: f64,
}

impl ResourceEstimate {
    /// Returns whether the memory suffices for the scan.
    pub fn fits(&self) -> bool {
        self.memory_available_bytes
            .is_none_or(|available| self.memory_bytes <= available)
    }
}

/// Predicts a scan of these frames from a few simulated ones. `preparing` is the time to build the
/// simulation, s.
pub(crate) fn forecast_of(
    simulation: &Simulation,
    frames: &Range<u32>,
    preparing: f64,
    control: &RunControl,
) -> Result<ResourceEstimate> {
    let scene = &simulation.scene;
    let threads = rayon::current_num_threads();
    let count = frames.len() as u64;
    let SampledFrames {
        seconds,
        points,
        bytes,
    } = taken(simulation, frames, control)?;
    let files = bytes + points * POINT_ON_DISK as f64;
    Ok(ResourceEstimate {
        frames: frames.len() as u32,
        threads,
        // Images and report are in memory at different times.
        memory_bytes: images(scene, at_once(count)).max(report(count, points as u64)),
        memory_available_bytes: memory::available(),
        disk_bytes: files as u64 + count * RECORD + REPORT,
        seconds: preparing + seconds / at_once(count) as f64,
    })
}

/// Duration above which a scan is announced, s.
const LONG: f64 = 3600.0;
/// Number of frames per thread above which the duration is predicted. The prediction simulates one
/// frame per thread.
const FRAMES_PER_THREAD: usize = 8;

/// Passes a text with the predicted duration of these frames and a remedy to `control.notice` if
/// they take more than one hour.
pub(crate) fn announce_long_scan(
    simulation: &Simulation,
    frames: impl Iterator<Item = u32>,
    control: &RunControl,
) -> Result<()> {
    let Some(notice) = control.notice else {
        return Ok(());
    };
    let frames: Vec<u32> = frames.collect();
    let threads = rayon::current_num_threads();
    if frames.len() <= FRAMES_PER_THREAD * threads {
        return Ok(());
    }
    let asked = spread_frames(frames.len() as u32, FRAMES_ASKED.max(threads as u32));
    let count = asked.len();
    let lit = asked.into_par_iter().map(|i| frames[i as usize]);
    let lit: Vec<u32> = (lit.filter(|&frame| simulation.columns_at_most(frame) > 0)).collect();
    // As many frames as in a scan are in progress at once. Their stages are parallel, too.
    let some = spread_frames(lit.len() as u32, threads as u32);
    let start = Instant::now();
    some.par_iter().try_for_each(|&i| -> Result<()> {
        control.check()?;
        FrameContent::of(simulation, lit[i as usize]);
        Ok(())
    })?;
    let each = start.elapsed().as_secs_f64() / some.len().max(1) as f64;
    let seconds = each * frames.len() as f64 * lit.len() as f64 / count as f64;
    if seconds > LONG {
        notice(&long_scan_text(frames.len(), seconds));
    }
    Ok(())
}

/// Returns the announcement of a long scan.
fn long_scan_text(frames: usize, seconds: f64) -> String {
    format!(
        "The simulation of {frames} frames takes about {} h on this machine. {SHORTER_SCAN}",
        short(seconds / 3600.0)
    )
}

/// Total of several frames: core time in seconds, number of points, and bytes of the images.
#[derive(Default)]
struct SampledFrames {
    seconds: f64,
    points: f64,
    bytes: f64,
}

/// Simulates frames and measures their duration.
struct FrameTimer<'a> {
    simulation: &'a Simulation,
    /// Simulations with fewer paths, and their numbers of paths relative to `simulation`.
    fewer: Option<[(Simulation, f64); 2]>,
}

impl FrameTimer<'_> {
    fn new(simulation: &Simulation) -> Result<FrameTimer<'_>> {
        let pixels = simulation.scene.camera.sensor.resolution.as_dvec2();
        let paths = simulation.plan.reflections.map_or(0.0, |reflections| {
            f64::from(reflections.from_laser) + reflections.per_pixel * pixels.element_product()
        });
        let fewer = |times: f64| -> Result<(Simulation, f64)> {
            let mut plan = simulation.plan.clone();
            plan.reflections = plan.reflections.map(|paths| paths.scaled(times));
            Ok((simulation.with_plan_shared(plan)?, times))
        };
        let times = MAX_PATHS / paths;
        let fewer = match times < 1.0 {
            true => Some([fewer(times / 4.0)?, fewer(times)?]),
            false => None,
        };
        Ok(FrameTimer { simulation, fewer })
    }

    /// Returns the duration of a frame, s, and its content. The duration depends linearly on the
    /// number of paths. With fewer paths, the content has more noise.
    fn frame(&self, frame: u32) -> (f64, FrameContent) {
        let timed = |simulation: &Simulation| {
            let start = Instant::now();
            let content = FrameContent::of(simulation, frame);
            (start.elapsed().as_secs_f64(), content)
        };
        let Some([(few, few_times), (more, more_times)]) = &self.fewer else {
            return timed(self.simulation);
        };
        let (short, _) = timed(few);
        let (long, content) = timed(more);
        let per_path = ((long - short) / (more_times - few_times)).max(0.0);
        (long + per_path * (1.0 - more_times), content)
    }
}

/// Estimates the total from a few frames. Points and bytes are in proportion to the number of
/// columns that may be lit, which is evaluated for many frames (ratio estimator, Cochran 1977). The
/// time of lit and of dark frames is in proportion to their numbers.
fn taken(
    simulation: &Simulation,
    frames: &Range<u32>,
    control: &RunControl,
) -> Result<SampledFrames> {
    let asked = spread_frames(frames.len() as u32, FRAMES_ASKED);
    let share = frames.len() as f64 / asked.len() as f64;
    let width = |i: u32| simulation.columns_at_most(frames.start + i);
    let (lit, dark): (Vec<_>, Vec<_>) = asked
        .into_par_iter()
        .map(|i| (frames.start + i, width(i)))
        .partition(|&(_, columns)| columns > 0);
    let timer = FrameTimer::new(simulation)?;
    let mut all = SampledFrames::default();
    for (kind, most) in [(lit, FRAMES), (dark, 1)] {
        let (mut sample, mut columns, mut count) = (SampledFrames::default(), 0, 0);
        for i in spread_frames(kind.len() as u32, most) {
            if sample.seconds > ENOUGH {
                break;
            }
            control.check()?;
            let (frame, lit) = kind[i as usize];
            let (seconds, content) = timer.frame(frame);
            sample.seconds += seconds;
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

/// Returns the memory of a report of these frames and points while it is written, bytes.
fn report(frames: u64, points: u64) -> u64 {
    REPORTING + frames * POSE + points * POINT
}

/// Returns whether the report fits into memory even if every column of every frame gives a point.
pub(crate) fn any_report_fits(scene: &Scene, frames: u64) -> bool {
    let columns = u64::from(scene.camera.sensor.resolution.x);
    memory::available().is_none_or(|available| report(frames, frames * columns) <= available)
}

/// Refuses a scan whose predicted points exceed the available memory.
pub(crate) fn ensure_points_fit(
    simulation: &Simulation,
    frames: &Range<u32>,
    control: &RunControl,
) -> Result<()> {
    let points = taken(simulation, frames, control)?.points as u64;
    let count = frames.len() as u64;
    let work = format!(
        "the report of a scan of {count} frames and about {points} points, {POINT} bytes each,"
    );
    memory::require(work, report(count, points), memory::available())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_scan_is_announced_with_its_duration_and_existing_keys() {
        assert_eq!(
            long_scan_text(219, 5400.0),
            "The simulation of 219 frames takes about 1.50 h on this machine. Lower scan.frames and raise \
             scan.step_mm, use model.geometry_only, or divide the frames between machines (scan --shard)."
        );
    }
}
