//! Tests of peaks, points and their uncertainty.

#[path = "../common/effort.rs"]
mod effort;
#[path = "../common/intervals.rs"]
mod intervals;
#[path = "../common/plates.rs"]
mod plates;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/random.rs"]
mod random;
#[path = "../common/tilted.rs"]
mod tilted;

mod accuracy;
mod calibration;
mod cameras;
mod compare;
mod coverage;
mod deviation;
mod device;
mod feature_coverage;
mod features;
mod filters;
mod fit;
mod grain_points;
mod measure;
mod objects;
mod peaks;
mod real_line;
mod real_recordings;
mod ring_gauge;
mod silent_outliers;
mod systematic;
mod topography;
mod uncertainty;

use lasertrace::run::{Export, RunControl, ScanOptions, TraceMode};
use std::sync::atomic::AtomicBool;

/// Returns the control of a run that shows no progress and is not interrupted.
fn control() -> RunControl<'static> {
    static STOP: AtomicBool = AtomicBool::new(false);
    RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &STOP,
    }
}

/// Options of a scan of all frames with a further output.
fn scan_options(also: Export) -> ScanOptions {
    ScanOptions {
        coverage: TraceMode::Footprint,
        frames: None,
        resume: false,
        geometry_only: false,
        strict: false,
        also: vec![also],
    }
}
