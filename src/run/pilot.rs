//! Pilot of the ladder: strips of a few frames, computed with the reference model and with the
//! rungs.

use super::error_model::error_model;
use super::height_errors::HeightErrors;
use super::simulation::Simulation;
use crate::camera::{ColumnView, ImageColumns, SparseImage};
use crate::error::Result;
use crate::frame::{Blur, IndirectLight, Sampling};
use crate::math::DVec2;
use crate::mesh::ProgressFn;
use crate::plan::accuracy::{PilotPoint, PilotSample, SpeckleGrainSize};
use crate::plan::rules::ModelConfig;
use crate::profile::{Peak, UncertaintyModel};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;

/// Maximum number of columns of a strip. The width of a line is estimated from this number of
/// columns on either side.
const COLUMNS: usize = 64;
/// Number of frames per evaluated frame that are searched for lit columns.
const FRAMES_ASKED: u32 = 4;
/// Maximum number of light paths in all strips, about 10 s on one core.
const PATHS: f64 = (1u32 << 22) as f64;

/// Column range of a frame.
struct PilotStrip {
    frame: u32,
    columns: Range<usize>,
}

/// Strips of frames, computed with the reference model.
pub(crate) struct PilotStrips {
    full: Simulation,
    strips: Vec<PilotStrip>,
    /// Indirect light of each strip, used for all plans.
    ghosts: Vec<Vec<IndirectLight>>,
    /// Lines of the reference model in each strip.
    truth: Vec<Vec<Peak>>,
    /// Fraction of the scan's lit columns that was not evaluated.
    left: f64,
    /// Cached results.
    known: Vec<(ModelConfig, HeightErrors)>,
}

/// Returns the central frames of `wanted` equal parts of the scan, or all frames if there are
/// fewer.
pub(crate) fn spread_frames(frames: u32, wanted: u32) -> Vec<u32> {
    let wanted = wanted.min(frames);
    let middle = |i: u32| (frames as u64 * (2 * i as u64 + 1) / (2 * wanted as u64)) as u32;
    (0..wanted).map(middle).collect()
}

/// Returns about `wanted` strips, and the fraction of all lit columns outside them. Each strip is a
/// cell of the lit columns. The strips are in different frames if enough frames are lit.
fn strips(full: &Simulation, wanted: u32) -> (Vec<PilotStrip>, f64) {
    let frames = full.scene.scan.frames;
    let asked = spread_frames(frames, FRAMES_ASKED * wanted);
    let lit = |&frame: &u32| Some((frame, full.lit_columns(frame)?));
    let lit: Vec<(u32, Range<usize>)> = asked.par_iter().filter_map(lit).collect();
    let columns: usize = lit.iter().map(|(_, columns)| columns.len()).sum();
    let all = columns as f64 * frames as f64 / asked.len() as f64;
    let chosen = spread_frames(lit.len() as u32, wanted);
    let each = (wanted as usize).div_ceil(chosen.len().max(1));
    let mut strips = Vec::new();
    for (i, frame) in chosen.into_iter().enumerate() {
        let (frame, lit) = &lit[frame as usize];
        // Complete cells give columns at the ends of the line equal probability.
        let cells = lit.len().div_ceil(COLUMNS);
        let each = each.min(cells);
        let edge = |cell: usize| lit.start + cell * lit.len() / cells;
        // Multiples of the golden ratio are uniformly distributed for every count.
        let first = ((i as f64 * 0.618_034).fract() * cells as f64) as usize;
        for k in 0..each {
            let cell = (first + k * cells / each) % cells;
            strips.push(PilotStrip {
                frame: *frame,
                columns: edge(cell)..edge(cell + 1),
            });
        }
    }
    let looked: usize = strips.iter().map(|strip| strip.columns.len()).sum();
    (strips, (1.0 - looked as f64 / all.max(1.0)).max(0.0))
}

impl PilotStrips {
    /// Evaluates about `wanted` strips with the reference model `full`. `watch` is called with the
    /// progress of the indirect light.
    pub fn new(full: Simulation, wanted: u32, watch: &ProgressFn) -> Result<PilotStrips> {
        let (strips, left) = strips(&full, wanted);
        let times = full.plan.reflections.map_or(1.0, |planned| {
            let all = f64::from(planned.from_laser) * strips.len() as f64;
            (PATHS / all).min(1.0)
        });
        let mut ghosts = Vec::new();
        for strip in &strips {
            ghosts.push(full.strip_ghosts(strip.frame, &strip.columns, times));
            watch(ghosts.len() as f64 / strips.len() as f64)?;
        }
        let mut looked = PilotStrips {
            full,
            strips,
            ghosts,
            truth: Vec::new(),
            left,
            known: Vec::new(),
        };
        looked.truth = looked.peaks(&looked.full);
        Ok(looked)
    }

    /// Returns the lines of a simulation in each strip.
    fn peaks(&self, simulation: &Simulation) -> Vec<Vec<Peak>> {
        let pairs = self.strips.par_iter().zip(&self.ghosts);
        pairs
            .map(|(strip, ghosts)| strip.peaks(simulation, ghosts))
            .collect()
    }

    pub fn frames(&self) -> Vec<u32> {
        let frames: BTreeSet<u32> = self.strips.iter().map(|strip| strip.frame).collect();
        frames.into_iter().collect()
    }

    /// Returns the fraction of the scan's lit columns that was not evaluated.
    pub fn left(&self) -> f64 {
        self.left
    }

    /// Returns the height errors of a plan relative to the reference model, by strip.
    pub fn errors(&mut self, plan: &ModelConfig) -> Result<HeightErrors> {
        let same = |(known, _): &&(ModelConfig, HeightErrors)| same_methods(known, plan);
        if let Some((_, errors)) = self.known.iter().find(same) {
            return Ok(errors.clone());
        }
        let simulation = self.full.with_plan_shared(plan.clone())?;
        let found = self.peaks(&simulation).into_iter();
        let pairs: Vec<_> = found.zip(self.truth.iter().cloned()).collect();
        let errors = HeightErrors::of(&pairs, &self.full.calibration, 1.0);
        self.known.push((plan.clone(), errors.clone()));
        Ok(errors)
    }

    /// Returns the pilot points.
    pub fn pilot(&self) -> Result<PilotSample> {
        let calm = ModelConfig {
            speckle: None,
            noise: false,
            sampling: Sampling::Planes,
            samples_per_side: 4,
            blur: Blur::None,
            reflections: None,
            ..self.full.plan.clone()
        };
        let scene = &self.full.scene;
        let simulation = self.full.with_plan_shared(calm)?;
        let lines = self.strips.par_iter();
        let lines: Vec<Vec<Peak>> = lines.map(|strip| strip.peaks(&simulation, &[])).collect();
        let points = lines.iter().flat_map(|peaks| self.points(peaks));
        Ok(PilotSample {
            points: points.collect(),
            grain: scene.speckle.map(|speckle| SpeckleGrainSize {
                aperture: speckle.aperture,
                size: simulation.plan.grain.speckle_extent_px[1],
                contrast: speckle.coherence.contrast(),
            }),
        })
    }

    /// Returns the pilot points of lines without speckle and noise.
    fn points(&self, peaks: &[Peak]) -> Vec<PilotPoint> {
        let scene = &self.full.scene;
        let speckle = error_model(scene, Blur::None).without_shot_noise();
        let none = UncertaintyModel::new(scene.measure.finder, 0.0, None);
        let [with, without] = [speckle, none].map(|model| {
            let mut peaks = peaks.to_vec();
            peaks.iter_mut().for_each(|peak| peak.noise = 0.0);
            model.row_errors(&peaks, scene.camera.sensor.resolution.x as usize)
        });
        let point = |(i, peak): (usize, &Peak)| {
            let place = DVec2::new(peak.column as f64 + 0.5, peak.row);
            let jacobian = self.full.calibration.point_jacobian(place)?;
            // The remainder without speckle is the bias of the peak estimator.
            let variance = with[i].sigma.powi(2) - without[i].sigma.powi(2);
            Some(PilotPoint {
                um_per_px: jacobian.by_pixel[1].length() * 1e3,
                // A line within one pixel has a measured width of zero.
                sigma: peak.sigma.max(0.1),
                speckle: variance.max(0.0).sqrt(),
                blur: self.full.defocus_blur_px(peak).unwrap_or(0.0),
            })
        };
        let valid = peaks.iter().enumerate().filter(|(_, p)| p.flags.is_valid());
        valid.filter_map(point).collect()
    }
}

impl PilotStrip {
    /// Returns the lines of the strip, detected as if the sensor had no other columns.
    fn peaks(&self, simulation: &Simulation, ghosts: &[IndirectLight]) -> Vec<Peak> {
        let first = self.columns.start as u32;
        if simulation.plan.geometry_only {
            let mut peaks = simulation.geometric_peaks(&simulation.pose(self.frame)).0;
            peaks.retain(|peak| self.columns.contains(&(peak.column as usize)));
            return peaks;
        }
        let light = simulation.strip(self.frame, &self.columns, ghosts);
        let image = simulation.counts_near_light(self.frame, &light);
        let strip = SomeColumns {
            image,
            columns: self.columns.clone(),
        };
        let mut peaks = simulation.peaks(&strip).0;
        peaks.iter_mut().for_each(|peak| peak.column += first);
        peaks
    }
}

/// Image of a column range of another image.
struct SomeColumns {
    image: SparseImage,
    columns: Range<usize>,
}

impl ImageColumns for SomeColumns {
    fn columns(&self) -> usize {
        self.columns.len()
    }

    fn rows(&self) -> usize {
        self.image.rows()
    }

    fn column(&self, column: usize) -> ColumnView<'_> {
        self.image.column(self.columns.start + column)
    }
}

/// Returns whether two plans choose equal methods.
fn same_methods(a: &ModelConfig, b: &ModelConfig) -> bool {
    let chosen = |plan: &ModelConfig| {
        let one = plan.samples_per_side == 1;
        // With one sample, both kinds of rays are equal.
        let sampling = match plan.sampling {
            Sampling::Rays if one => Sampling::Planes,
            sampling => sampling,
        };
        (
            plan.geometry_only,
            plan.noise,
            sampling,
            plan.samples_per_side,
        )
    };
    chosen(a) == chosen(b)
        && a.blur == b.blur
        && a.speckle == b.speckle
        && a.beam_cutoff_radii == b.beam_cutoff_radii
}
