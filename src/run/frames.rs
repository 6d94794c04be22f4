//! Simulation of the frames of a scan in parallel. Each image is written before its journal record.

use super::journal::{Checksum, FrameRecord, Journal, checksum};
use super::simulation::Simulation;
use super::{RunControl, files};
use crate::error::Result;
use crate::frame::Blur;
use crate::inspect::cloud::CloudPoint;
use crate::profile::Peak;
use crate::report::picture::encode_counts;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Result of a measured frame.
pub struct FrameContent {
    pub points: Vec<CloudPoint>,
    /// Number of peaks whose blur is wider than two standard deviations of their sharp line.
    pub blurred: u32,
    /// Image file, if the scene requests it.
    pub image: Option<Vec<u8>>,
}

impl FrameContent {
    pub fn of(simulation: &Simulation, frame: u32) -> FrameContent {
        let (image, peaks, points) = simulation.taken(frame);
        let max_count = simulation.scene.camera.sensor.max_count();
        let image = image.filter(|_| simulation.scene.save_images);
        let of_pupil = simulation
            .scene
            .camera
            .lens
            .aperture
            .variance_along_height();
        let is_blurred = |peak: &&Peak| {
            let blur = simulation.defocus_blur_px(peak).unwrap_or(0.0);
            let sharp = match simulation.plan.blur {
                Blur::None => peak.sigma.powi(2),
                _ => peak.sigma.powi(2) - blur * blur * of_pupil,
            };
            blur * blur > 4.0 * sharp
        };
        FrameContent {
            blurred: peaks.iter().filter(is_blurred).count() as u32,
            image: image.map(|image| encode_counts(&image.into_counts(), max_count)),
            points,
        }
    }
}

/// Number of images that are checked before reading on in the journal.
const REPAIRED_TOGETHER: usize = 1024;

/// Duration of a batch below which threads idle noticeably at its end.
const SHORT: Duration = Duration::from_millis(50);

/// Maximum number of frames per thread and batch.
const MOST_EACH: usize = 64;

/// A scan in progress.
pub struct FrameRunner<'a> {
    pub simulation: &'a Simulation,
    pub out: &'a Path,
    pub control: &'a RunControl<'a>,
    /// Suffix of the names of unfinished files.
    pub unfinished: &'a str,
    /// Number of frames finished so far.
    pub done: AtomicU64,
}

impl FrameRunner<'_> {
    /// Returns the path of a frame's image.
    fn name(&self, frame: u32) -> PathBuf {
        self.out.join(format!("frames/frame-{frame:06}.png"))
    }

    /// Simulates a frame, measures it and writes its image.
    fn frame(&self, frame: u32) -> Result<FrameRecord> {
        self.control.check()?;
        let content = FrameContent::of(self.simulation, frame);
        if let Some(image) = &content.image {
            files::write_checked_later(&self.name(frame), image, self.unfinished)?;
        }
        Ok(FrameRecord {
            frame,
            image: content.image.as_deref().map(checksum),
            blurred: content.blurred,
            points: content.points,
        })
    }

    /// Simulates again the frames whose images differ from their checksum in the journal. A frame
    /// depends only on its number, so its record in the journal remains correct.
    pub fn repair(&self, journal: &mut Journal) -> Result<()> {
        (self.control.progress)(self.done.load(Ordering::Relaxed));
        if !self.simulation.scene.save_images {
            return Ok(());
        }
        let mut images = Vec::new();
        journal.each(|record| {
            images.extend(record.image.map(|sum| (record.frame, sum)));
            if images.len() == REPAIRED_TOGETHER {
                self.repair_some(&images)?;
                images.clear();
            }
            Ok(())
        })?;
        self.repair_some(&images)
    }

    fn repair_some(&self, images: &[(u32, Checksum)]) -> Result<()> {
        images.par_iter().try_for_each(|&(frame, sum)| {
            self.control.check()?;
            let found = std::fs::read(self.name(frame)).map(|bytes| checksum(&bytes));
            match found.is_ok_and(|found| found == sum) {
                true => Ok(()),
                false => self.frame(frame).map(drop),
            }
        })
    }

    /// Simulates the frames in batches and appends them to the journal in order. A batch is written
    /// while the next one is simulated. If the run stops, the batch is kept up to its first
    /// unfinished frame.
    pub fn frames(&self, mut left: impl Iterator<Item = u32>, journal: &mut Journal) -> Result<()> {
        let threads = rayon::current_num_threads();
        let mut each = 8;
        let mut finished: Vec<FrameRecord> = Vec::new();
        loop {
            let now: Vec<u32> = left.by_ref().take(each * threads).collect();
            let (is_last, start) = (now.is_empty(), Instant::now());
            let (written, mut records) =
                rayon::join(|| journal.append(&finished), || self.records(now));
            written?;
            if is_last {
                return Ok(());
            }
            if start.elapsed() < SHORT && each < MOST_EACH {
                each *= 2;
            }
            let stop = records.iter().position(Result::is_err);
            let after = records.split_off(stop.unwrap_or(records.len()));
            finished = records.into_iter().flatten().collect();
            if let Some(Err(error)) = after.into_iter().next() {
                journal.append(&finished)?;
                return Err(error);
            }
        }
    }

    fn records(&self, frames: Vec<u32>) -> Vec<Result<FrameRecord>> {
        let records = frames.into_par_iter().map(|frame| {
            let record = self.frame(frame)?;
            (self.control.progress)(1 + self.done.fetch_add(1, Ordering::Relaxed));
            Ok(record)
        });
        records.collect()
    }
}
