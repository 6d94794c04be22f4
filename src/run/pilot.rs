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
/// Number of strips.
const STRIPS: u32 = 192;
/// Number of strips that are evaluated first.
const FIRST_STRIPS: usize = 48;
/// Number of strips from which the influence of effects is estimated and clearly insufficient plans
/// are rejected.
const FEW_STRIPS: usize = 16;
/// Number of frames per strip that are searched for lit columns.
const FRAMES_ASKED: u32 = 2;
/// Maximum number of light paths in all strips, about 10 s on one core.
const PATHS: f64 = (1u32 << 22) as f64;

/// Column range of a frame.
struct PilotStrip {
    frame: u32,
    columns: Range<usize>,
}

/// Strips of frames, computed with the reference model. The first strips, or all of them, are
/// evaluated.
pub(crate) struct PilotStrips {
    full: Simulation,
    /// All strips. Any number of the first strips is distributed over the entire scan.
    strips: Vec<PilotStrip>,
    /// Number of lit columns in the scan.
    lit_columns: f64,
    /// Indirect light of each evaluated strip, used for all plans.
    ghosts: Vec<Vec<IndirectLight>>,
    /// Lines of the reference model in each evaluated strip.
    truth: Vec<Vec<Peak>>,
    /// Cached lines of plans, for some of the first strips.
    known: Vec<(ModelConfig, Vec<Vec<Peak>>)>,
}

/// Returns the central frames of `wanted` equal parts of the scan, or all frames if there are
/// fewer.
pub(crate) fn spread_frames(frames: u32, wanted: u32) -> Vec<u32> {
    let wanted = wanted.min(frames);
    let middle = |i: u32| (frames as u64 * (2 * i as u64 + 1) / (2 * wanted as u64)) as u32;
    (0..wanted).map(middle).collect()
}

/// Returns about [`STRIPS`] strips along the scan, and the number of lit columns of the scan. Each
/// strip is a cell of the lit columns. The strips are in different frames if enough frames are lit.
fn strips(full: &Simulation) -> (Vec<PilotStrip>, f64) {
    let frames = full.scene.scan.frames;
    let asked = spread_frames(frames, FRAMES_ASKED * STRIPS);
    let lit = |&frame: &u32| Some((frame, full.lit_columns(frame)?));
    let lit: Vec<(u32, Range<usize>)> = asked.par_iter().filter_map(lit).collect();
    let columns: usize = lit.iter().map(|(_, columns)| columns.len()).sum();
    let all = columns as f64 * frames as f64 / asked.len() as f64;
    let chosen = spread_frames(lit.len() as u32, STRIPS);
    let each = (STRIPS as usize).div_ceil(chosen.len().max(1));
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
    (strips, all)
}

impl PilotStrips {
    /// Evaluates the first strips with the reference model `full`. `watch` is called with the
    /// progress of the indirect light.
    pub fn new(full: Simulation, watch: &ProgressFn) -> Result<PilotStrips> {
        let (strips, lit_columns) = strips(&full);
        // The radical inverses of 0, 1, 2, … are uniformly distributed (van der Corput 1935).
        let mut strips: Vec<_> = strips.into_iter().enumerate().collect();
        strips.sort_by_key(|(i, _)| i.reverse_bits());
        let mut looked = PilotStrips {
            full,
            strips: strips.into_iter().map(|(_, strip)| strip).collect(),
            lit_columns,
            ghosts: Vec::new(),
            truth: Vec::new(),
            known: Vec::new(),
        };
        looked.evaluate(FIRST_STRIPS.min(looked.strips.len()), watch)?;
        Ok(looked)
    }

    /// Evaluates the remaining strips. Returns false if there are none.
    pub fn evaluate_all(&mut self, watch: &ProgressFn) -> Result<bool> {
        let more = self.truth.len() < self.strips.len();
        if more {
            self.evaluate(self.strips.len(), watch)?;
        }
        Ok(more)
    }

    /// Evaluates the first `count` strips.
    fn evaluate(&mut self, count: usize, watch: &ProgressFn) -> Result<()> {
        let times = self.full.plan.reflections.map_or(1.0, |planned| {
            let all = f64::from(planned.from_laser) * self.strips.len() as f64;
            (PATHS / all).min(1.0)
        });
        let done = self.truth.len();
        for strip in &self.strips[done..count] {
            let ghosts = self.full.strip_ghosts(strip.frame, &strip.columns, times);
            self.ghosts.push(ghosts);
            watch((self.ghosts.len() - done) as f64 / (count - done) as f64)?;
        }
        let truth = self.peaks(&self.full, done..count);
        self.truth.extend(truth);
        Ok(())
    }

    /// Returns the lines of a simulation in each of these strips.
    fn peaks(&self, simulation: &Simulation, strips: Range<usize>) -> Vec<Vec<Peak>> {
        let pairs = self.strips[strips.clone()].par_iter();
        let pairs = pairs.zip(&self.ghosts[strips]);
        pairs
            .map(|(strip, ghosts)| strip.peaks(simulation, ghosts))
            .collect()
    }

    /// Returns the frames of the evaluated strips.
    pub fn frames(&self) -> Vec<u32> {
        let strips = &self.strips[..self.truth.len()];
        let frames: BTreeSet<u32> = strips.iter().map(|strip| strip.frame).collect();
        frames.into_iter().collect()
    }

    /// Returns the fraction of the scan's lit columns that was not evaluated.
    pub fn left(&self) -> f64 {
        let strips = &self.strips[..self.truth.len()];
        let looked: usize = strips.iter().map(|strip| strip.columns.len()).sum();
        (1.0 - looked as f64 / self.lit_columns.max(1.0)).max(0.0)
    }

    /// Returns the height errors of a plan relative to the reference model, by evaluated strip.
    pub fn errors(&mut self, plan: &ModelConfig) -> Result<HeightErrors> {
        self.errors_in(plan, self.truth.len())
    }

    /// Returns the height errors of a plan in the first [`FEW_STRIPS`].
    pub fn errors_in_few(&mut self, plan: &ModelConfig) -> Result<HeightErrors> {
        self.errors_in(plan, FEW_STRIPS.min(self.truth.len()))
    }

    fn errors_in(&mut self, plan: &ModelConfig, count: usize) -> Result<HeightErrors> {
        let known = self.known.iter();
        let mut known = known.map(|(known, _)| same_methods(known, plan));
        let index = known.position(|same| same).unwrap_or(self.known.len());
        if index == self.known.len() {
            self.known.push((plan.clone(), Vec::new()));
        }
        let done = self.known[index].1.len();
        if done < count {
            let simulation = self.full.with_plan_shared(plan.clone())?;
            let found = self.peaks(&simulation, done..count);
            self.known[index].1.extend(found);
        }
        let found = self.known[index].1[..count].iter().cloned();
        let pairs: Vec<_> = found.zip(self.truth.iter().cloned()).collect();
        Ok(HeightErrors::of(&pairs, &self.full.calibration, 1.0))
    }

    /// Returns the pilot points of the first [`FEW_STRIPS`].
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
        let lines = self.strips[..FEW_STRIPS.min(self.strips.len())].par_iter();
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
