//! Parts of a few frames, as the full model and as others have them: what a plan for a
//! tolerance is chosen by.

use super::error_model::error_model;
use super::height_errors::HeightErrors;
use super::simulation::Simulation;
use crate::camera::{Column, Columns, NearLight};
use crate::error::Result;
use crate::frame::{Blur, Ghosts, Sampling};
use crate::math::DVec2;
use crate::mesh::Watch;
use crate::plan::accuracy::{Grain, Pilot, PilotPoint};
use crate::plan::rules::Plan;
use crate::profile::{ErrorModel, Peak};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;

/// Columns of one at most: so many to either side decide how wide a line is taken to be.
const COLUMNS: usize = 64;
/// Frames, for each that is looked at, in which a line is looked for.
const FRAMES_ASKED: u32 = 4;
/// Paths from the laser at most, in all strips: some ten seconds of one core.
const PATHS: f64 = (1u32 << 22) as f64;

/// Columns of a frame.
struct Strip {
    frame: u32,
    columns: Range<usize>,
}

/// Parts of frames as the full model has them.
pub(crate) struct Looked {
    full: Simulation,
    strips: Vec<Strip>,
    /// Light that is reflected more than once, strip by strip: the same for all plans.
    ghosts: Vec<Vec<Ghosts>>,
    /// The full model's lines, strip by strip.
    truth: Vec<Vec<Peak>>,
    /// Share of the lit columns of the scan that was not looked at.
    left: f64,
    /// What was asked before.
    known: Vec<(Plan, HeightErrors)>,
}

/// `wanted` frames in the middle of as many equal parts of the scan; fewer if it has
/// fewer.
pub(crate) fn spread_frames(frames: u32, wanted: u32) -> Vec<u32> {
    let wanted = wanted.min(frames);
    let middle = |i: u32| (frames as u64 * (2 * i as u64 + 1) / (2 * wanted as u64)) as u32;
    (0..wanted).map(middle).collect()
}

/// About `wanted` strips, of different frames as far as something is lit in as many, each a
/// cell of the lit columns; and the share of all lit columns that these leave out.
fn strips(full: &Simulation, wanted: u32) -> (Vec<Strip>, f64) {
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
        // Whole cells, so that columns at the ends of the line are as likely as others.
        let cells = lit.len().div_ceil(COLUMNS);
        let each = each.min(cells);
        let edge = |cell: usize| lit.start + cell * lit.len() / cells;
        // Multiples of the golden ratio lie evenly at any number of them.
        let first = ((i as f64 * 0.618_034).fract() * cells as f64) as usize;
        for k in 0..each {
            let cell = (first + k * cells / each) % cells;
            strips.push(Strip {
                frame: *frame,
                columns: edge(cell)..edge(cell + 1),
            });
        }
    }
    let looked: usize = strips.iter().map(|strip| strip.columns.len()).sum();
    (strips, (1.0 - looked as f64 / all.max(1.0)).max(0.0))
}

impl Looked {
    /// At about so many strips of a simulation by the full model; `watch` hears how far light that is reflected more
    /// than once was followed.
    pub fn new(full: Simulation, wanted: u32, watch: &Watch) -> Result<Looked> {
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
        let mut looked = Looked {
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

    /// A simulation's lines, strip by strip.
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

    /// Share of the scan's lit columns that were not looked at.
    pub fn left(&self) -> f64 {
        self.left
    }

    /// How far a plan's points are from the full model's, strip by strip.
    pub fn errors(&mut self, plan: &Plan) -> Result<HeightErrors> {
        let same = |(known, _): &&(Plan, HeightErrors)| same_methods(known, plan);
        if let Some((_, errors)) = self.known.iter().find(same) {
            return Ok(errors.clone());
        }
        let simulation = self.full.otherwise(plan.clone())?;
        let found = self.peaks(&simulation).into_iter();
        let pairs: Vec<_> = found.zip(self.truth.iter().cloned()).collect();
        let errors = HeightErrors::of(&pairs, &self.full.calibration, 1.0);
        self.known.push((plan.clone(), errors.clone()));
        Ok(errors)
    }

    /// What formulas know of its points, and what costs are counted from; `radii`: at which
    /// light may end.
    pub fn pilot(&self, radii: &[f64]) -> Result<Pilot> {
        let calm = Plan {
            speckle: None,
            noise: false,
            sampling: Sampling::Planes,
            samples_per_side: 4,
            blur: Blur::None,
            reflections: None,
            ..self.full.plan.clone()
        };
        let scene = &self.full.scene;
        let simulation = self.full.otherwise(calm)?;
        let lines = self.strips.par_iter();
        let lines: Vec<Vec<Peak>> = lines.map(|strip| strip.peaks(&simulation, &[])).collect();
        let points = lines.iter().flat_map(|peaks| self.points(peaks));
        let looked_at = |&radii: &f64| {
            let simulation = self.full.otherwise(Plan {
                cutoff_radii: radii,
                samples_per_side: 1,
                sampling: Sampling::Planes,
                ..simulation.plan.clone()
            })?;
            let pixels = self.strips.par_iter().map(|strip| {
                let light = simulation.strip(strip.frame, &strip.columns, &[]);
                light.looked_at()
            });
            let columns: usize = self.strips.iter().map(|s| s.columns.len()).sum();
            let lit = columns as f64 / (1.0 - self.left).max(1e-9) / scene.scan.frames as f64;
            let a_column = pixels.sum::<usize>() as f64 / columns.max(1) as f64;
            Result::Ok((radii, lit * a_column))
        };
        let resolution = scene.camera.sensor.resolution.as_dvec2();
        Ok(Pilot {
            points: points.collect(),
            pixels: resolution.element_product(),
            columns: resolution.x,
            looked_at: radii.iter().map(looked_at).collect::<Result<_>>()?,
            grain: scene.speckle.map(|speckle| Grain {
                aperture: speckle.aperture,
                size: simulation.plan.grain.speckle_extent_px[1],
                contrast: speckle.coherence.contrast(),
            }),
        })
    }

    /// Of lines without speckle and noise.
    fn points(&self, peaks: &[Peak]) -> Vec<PilotPoint> {
        let scene = &self.full.scene;
        let speckle = error_model(scene, Blur::None).without_shot();
        let none = ErrorModel::new(scene.measure.finder, 0.0, None);
        let [with, without] = [speckle, none].map(|model| {
            let mut peaks = peaks.to_vec();
            peaks.iter_mut().for_each(|peak| peak.noise = 0.0);
            model.row_errors(&peaks, scene.camera.sensor.resolution.x as usize)
        });
        let point = |(i, peak): (usize, &Peak)| {
            let place = DVec2::new(peak.column as f64 + 0.5, peak.row);
            let jacobian = self.full.calibration.point_jacobian(place)?;
            // What is left without speckle is the finder's own bias.
            let variance = with[i].sigma.powi(2) - without[i].sigma.powi(2);
            Some(PilotPoint {
                um_per_px: jacobian.by_pixel[1].length() * 1e3,
                // A line within one pixel measures as of no width.
                sigma: peak.sigma.max(0.1),
                speckle: variance.max(0.0).sqrt(),
                blur: self.full.defocus_blur_px(peak).unwrap_or(0.0),
            })
        };
        let valid = peaks.iter().enumerate().filter(|(_, p)| p.flags.is_valid());
        valid.filter_map(point).collect()
    }
}

impl Strip {
    /// Its lines, found as if the sensor had no other columns.
    fn peaks(&self, simulation: &Simulation, ghosts: &[Ghosts]) -> Vec<Peak> {
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

/// An image of some of another's columns.
struct SomeColumns {
    image: NearLight,
    columns: Range<usize>,
}

impl Columns for SomeColumns {
    fn columns(&self) -> usize {
        self.columns.len()
    }

    fn rows(&self) -> usize {
        self.image.rows()
    }

    fn column(&self, column: usize) -> Column<'_> {
        self.image.column(self.columns.start + column)
    }
}

/// Whether two plans are the same in all that they choose.
fn same_methods(a: &Plan, b: &Plan) -> bool {
    let chosen = |plan: &Plan| {
        let one = plan.samples_per_side == 1;
        let rays = plan.sampling == Sampling::Rays && !one;
        (plan.geometry_only, plan.noise, rays, plan.samples_per_side)
    };
    chosen(a) == chosen(b)
        && a.blur == b.blur
        && a.speckle == b.speckle
        && a.cutoff_radii == b.cutoff_radii
}
