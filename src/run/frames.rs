//! The frames of a scan: many at once, each into its files and then into the journal.

use super::journal::{Checksum, FrameRecord, Journal, checksum};
use super::simulation::Simulation;
use super::{Control, files};
use crate::error::Result;
use crate::frame::Blur;
use crate::inspect::cloud::CloudPoint;
use crate::profile::Peak;
use crate::report::picture::encode_counts;
use rayon::prelude::*;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// What a frame is when it is measured.
pub struct FrameContent {
    pub points: Vec<CloudPoint>,
    /// Peaks whose blur is wider than two standard deviations of their sharp line.
    pub blurred: u32,
    /// Bytes of its files: the profile, and the image if the scene asks for it.
    pub files: Vec<Vec<u8>>,
}

impl FrameContent {
    pub fn of(simulation: &Simulation, frame: u32) -> FrameContent {
        let (counts, peaks, points) = simulation.take(frame);
        let image = counts.filter(|_| simulation.scene.write_frames);
        let profile = [profile_csv(&peaks, &points)].into_iter();
        let is_blurred = |peak: &&Peak| {
            let blur = simulation.defocus_blur_px(peak).unwrap_or(0.0);
            let sharp = match simulation.plan.blur {
                Blur::None => peak.sigma.powi(2),
                _ => peak.sigma.powi(2) - blur * blur / 16.0,
            };
            blur * blur > 4.0 * sharp
        };
        FrameContent {
            blurred: peaks.iter().filter(is_blurred).count() as u32,
            files: profile.chain(image.as_ref().map(encode_counts)).collect(),
            points,
        }
    }
}

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
    /// The files a frame has.
    fn names(&self, frame: u32) -> Vec<PathBuf> {
        let profile = self.out.join(format!("profiles/profile-{frame:06}.csv"));
        let image = self.out.join(format!("frames/frame-{frame:06}.png"));
        match self.simulation.scene.write_frames {
            true => vec![profile, image],
            false => vec![profile],
        }
    }

    /// Takes a frame, measures it and writes its files.
    fn frame(&self, frame: u32) -> Result<FrameRecord> {
        self.control.check()?;
        let content = FrameContent::of(self.simulation, frame);
        let mut files = Vec::new();
        for (name, bytes) in self.names(frame).iter().zip(&content.files) {
            files.push(checksum(bytes));
            files::write_checked_later(name, bytes, self.unfinished)?;
        }
        Ok(FrameRecord {
            frame,
            files,
            blurred: content.blurred,
            points: content.points,
        })
    }

    /// Takes those frames again whose files are not what the journal says. A frame
    /// depends on its number alone, so the journal's record stays right.
    pub fn repair(&self, first: u32, kept: &[Vec<Checksum>]) -> Result<()> {
        (self.control.progress)(kept.len() as u64);
        kept.par_iter().enumerate().try_for_each(|(i, sums)| {
            self.control.check()?;
            let frame = first + i as u32;
            let names = self.names(frame);
            let is_whole = |(name, sum): (&PathBuf, &Checksum)| {
                std::fs::read(name).is_ok_and(|bytes| checksum(&bytes) == *sum)
            };
            match names.len() == sums.len() && names.iter().zip(sums).all(is_whole) {
                true => Ok(()),
                false => self.frame(frame).map(drop),
            }
        })
    }

    /// Takes the frames, some at a time, into the journal in their order. Of the ones
    /// at hand when the run stops, those up to the first unfinished one are kept.
    pub fn frames(&self, mut left: impl Iterator<Item = u32>, journal: &mut Journal) -> Result<()> {
        let together = 8 * rayon::current_num_threads();
        loop {
            let now: Vec<u32> = left.by_ref().take(together).collect();
            if now.is_empty() {
                return Ok(());
            }
            let mut records: Vec<Result<FrameRecord>> = now
                .into_par_iter()
                .map(|frame| {
                    let record = self.frame(frame)?;
                    (self.control.progress)(1 + self.done.fetch_add(1, Ordering::Relaxed));
                    Ok(record)
                })
                .collect();
            let stop = records.iter().position(Result::is_err);
            let after = records.split_off(stop.unwrap_or(records.len()));
            let finished: Vec<FrameRecord> = records.into_iter().flatten().collect();
            journal.append(&finished)?;
            if let Some(Err(error)) = after.into_iter().next() {
                return Err(error);
            }
        }
    }
}

/// One line a measured column: pixels, then the point in the part's frame.
fn profile_csv(peaks: &[Peak], points: &[CloudPoint]) -> Vec<u8> {
    let mut text = String::from(
        "column,row_px,intensity_dn,width_px,flags,x_mm,y_mm,z_mm,deviation_um,sigma_um\n",
    );
    // Points are in the order of their peaks, and a peak may have none.
    let mut points = points.iter().peekable();
    for peak in peaks {
        let Peak {
            column,
            row,
            intensity,
            sigma,
            flags,
            ..
        } = peak;
        // Writing to a string does not fail.
        let _ = write!(text, "{column},{row:.5},{intensity:.1},{sigma:.3},{flags}");
        let _ = match points.next_if(|point| point.column == peak.column) {
            Some(point) => {
                let [x, y, z] = point.position.to_array();
                let deviation = point.deviation * 1e3;
                let sigma = point.sigma * 1e3;
                writeln!(text, ",{x:.6},{y:.6},{z:.6},{deviation:.4},{sigma:.4}")
            }
            None => writeln!(text, ",,,,,"),
        };
    }
    text.into_bytes()
}
