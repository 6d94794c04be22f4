//! The frames of a scan: many at once, each its image and then its record into the journal.

use super::journal::{Checksum, FrameRecord, Journal, checksum};
use super::simulation::Simulation;
use super::{Control, files};
use crate::error::Result;
use crate::frame::Blur;
use crate::inspect::cloud::CloudPoint;
use crate::profile::Peak;
use crate::report::picture::encode_counts;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// What a frame is when it is measured.
pub struct FrameContent {
    pub points: Vec<CloudPoint>,
    /// Peaks whose blur is wider than two standard deviations of their sharp line.
    pub blurred: u32,
    /// Its image's file, if the scene asks for it.
    pub image: Option<Vec<u8>>,
}

impl FrameContent {
    pub fn of(simulation: &Simulation, frame: u32) -> FrameContent {
        let (image, peaks, points) = simulation.taken(frame);
        let max_count = simulation.scene.camera.sensor.max_count();
        let image = image.filter(|_| simulation.scene.write_frames);
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

/// Images that are checked before more of the journal is read.
const REPAIRED_TOGETHER: usize = 1024;

/// Frames taken together in less than this are so short that threads wait for each other at the end.
const SHORT: Duration = Duration::from_millis(50);

/// Frames a thread takes together at most.
const MOST_EACH: usize = 64;

/// The frames of a scan in the making.
pub struct Run<'a> {
    pub simulation: &'a Simulation,
    pub out: &'a Path,
    pub control: &'a Control<'a>,
    /// The end of the names of files that are not whole.
    pub unfinished: &'a str,
    /// Frames finished so far.
    pub done: AtomicU64,
}

impl Run<'_> {
    /// A frame's image.
    fn name(&self, frame: u32) -> PathBuf {
        self.out.join(format!("frames/frame-{frame:06}.png"))
    }

    /// Takes a frame, measures it and writes its image.
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

    /// Takes those frames again whose images are not what the journal says. A frame
    /// depends on its number alone, so the journal's record stays right.
    pub fn repair(&self, journal: &mut Journal) -> Result<()> {
        (self.control.progress)(self.done.load(Ordering::Relaxed));
        if !self.simulation.scene.write_frames {
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

    /// Takes the frames, some at a time, into the journal in their order, which is written while the next are
    /// taken. Of the ones at hand when the run stops, those up to the first unfinished one are kept.
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
