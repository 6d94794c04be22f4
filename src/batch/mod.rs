//! Frames and files: many frames at once, nothing half-written left behind.

#[cfg(feature = "race")]
mod bench_bvh;
mod calibrate;
mod chart;
mod check;
mod files;
mod forecast;
mod frames;
mod height_errors;
mod journal;
mod kept;
mod measure;
mod peak_image;
mod peaks;
mod pilot;
mod planner;
mod reason;
mod render;
mod report;
mod scan;
mod scan_speckle;
mod search;
mod simulation;
mod speckle;
mod surface_view;
mod survey;
mod synthetic;
mod tiers;
mod uncertainty;
mod warnings;
mod wave;

#[cfg(feature = "race")]
pub use bench_bvh::{BvhBench, bench_bvh};
pub use calibrate::{CalibrationSummary, ParameterResult, VIEWS as CALIBRATION_VIEWS, calibrate};
pub use chart::{Chart, ChartEffort, ChartRow, chart, chart_steps};
pub use check::{Checked, MeasuringRange, check};
pub use forecast::Forecast;
pub use height_errors::HeightErrors;
pub use kept::{Kept, keeps_word};
pub use peak_image::{
    FoundLine, GreyImage, ImageSummary, LineAlong, parse_image, peaks_of_image, read_image,
};
pub use peaks::{ChartAxis, FinderError, PeakChart, chart_conditions, peak_chart};
pub use planner::scene_plan;
pub use reason::{Reason, Warning};
pub use render::{RenderSummary, render};
pub use scan::{ScanOptions, ScanSummary, scan};
pub use simulation::{Simulation, part_in_view};
pub use speckle::{Grain, SpeckleSummary, speckle};
pub use uncertainty::{MonteCarlo, monte_carlo};
pub use warnings::refuse;
pub use wave::{
    ComparedMotion, MOST_TERMS, PATCH_STEPS, WaveEffort, WavePatch, WaveSummary, reference_motions,
    wave_patch, wave_reference,
};

use crate::accel::Accel;
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

impl Coverage {
    fn simulation(self, scene: &Scene, control: &Control) -> Result<Simulation> {
        let accel = control.hierarchy(scene)?;
        match self {
            Coverage::Footprint => Simulation::of_footprint(scene, accel),
            Coverage::Exhaustive => Simulation::of_everything(scene, accel),
        }
    }
}

/// How a long run tells where it is and hears that it should stop.
pub struct Control<'a> {
    /// Called with the number of frames done so far, from any thread.
    pub progress: &'a (dyn Fn(u64) + Sync),
    /// Called with the share of the hierarchy that is built, from any thread, before
    /// there are frames; `None`: nobody looks.
    pub building: Option<&'a (dyn Fn(f64) + Sync)>,
    pub stop: &'a AtomicBool,
}

impl Control<'_> {
    fn hierarchy(&self, scene: &Scene) -> Result<Accel> {
        simulation::hierarchy(scene, &|share| {
            if let Some(building) = self.building {
                building(share);
            }
            self.check()
        })
    }

    fn check(&self) -> Result<()> {
        match self.stop.load(Ordering::Relaxed) {
            true => Err(Error::Interrupted),
            false => Ok(()),
        }
    }
}

/// Refuses frames the scan does not have, and none.
fn check_frames(scene: &Scene, frames: &Range<u32>) -> Result<()> {
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
fn check_frame(scene: &Scene, frame: u32) -> Result<()> {
    if frame < scene.scan.frames {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "frame {frame}: the scan of {} has frames 0 to {}",
        scene.path.display(),
        scene.scan.frames - 1
    )))
}
