//! The cheapest plan that keeps a tolerance of height: what each effect does to the
//! points of a few frames, and what each way of modelling them costs.

use super::Sampling;
use super::height_error::{HeightError, quantile, share_beyond};
use super::plan::Plan;
use super::samples::sampling_error;
use crate::speckle::lookup::Method;
use crate::speckle::pattern::Aperture;
use crate::speckle::theory::sampling_deviation;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::{PI, TAU};

/// What of it a plan may predict: predictions are of first order and from few frames.
const PLANNED_SHARE: f64 = 0.005;
/// Where speckle alone scatters heights by more than the tolerance, all else is planned
/// to this share of that scatter: it adds half a percent to it.
const SHARE_OF_LIMIT: f64 = 0.1;

/// What was promised, and what is predicted.
#[derive(Debug, Clone, Serialize)]
pub struct Accuracy {
    /// Stated by the scene, µm.
    pub tolerance_um: f64,
    /// Error against the full model that was planned for, µm: the tolerance, or what
    /// speckle leaves of its meaning.
    pub planned_um: f64,
    /// By what speckle alone moves heights in 1 of 100 points or more, µm: with
    /// these optics no single point is surer.
    pub speckle_limit_um: Option<f64>,
    /// Predicted error against the full model: 99 of 100 points by less, µm.
    pub predicted_um: Option<f64>,
    /// Predicted share of points off by more than `planned_um`.
    pub predicted_share: f64,
    /// Whether the plan is good enough; no plan is, if not.
    pub sufficient: bool,
    /// Predicted time of one frame on one core, ms.
    pub cost_ms: f64,
    /// Frames looked at for it.
    pub pilot_frames: Vec<u32>,
    /// All this in words.
    pub statement: String,
}

/// What a point of a pilot frame tells. Row errors, px.
#[derive(Debug, Clone, Copy)]
pub struct PilotPoint {
    /// Way of the point for an error of its row by 1 px, µm.
    pub um_per_px: f64,
    /// Standard deviation of the line's image.
    pub sigma: f64,
    /// Counts of its middle.
    pub height: f64,
    /// Standard deviations of the row from speckle, from the sensor's noise, and from
    /// pixels that err by one count.
    pub speckle: f64,
    pub noise: f64,
    pub per_count: f64,
    /// Diameter of the lens's blur there, px.
    pub blur: f64,
    /// By what it differs in geometry alone; `None` if that has no such point.
    pub geometry: Option<f64>,
    /// By what it differs with 1 and with 2 × 2 samples a pixel.
    pub coarse: [Option<f64>; 2],
}

/// A few frames of the scene without speckle and noise.
pub struct Pilot {
    pub frames: Vec<u32>,
    pub points: Vec<PilotPoint>,
    /// Lines found in a frame, on average.
    pub lines: f64,
    pub pixels: f64,
    pub columns: f64,
    /// Standard deviation of the counts of dark pixels.
    pub dark: f64,
    /// By what counts differ if they do: by one, or by an electron's where that is more.
    pub step: f64,
    /// Of the scene's speckle.
    pub grain: Option<Grain>,
}

/// Of the scene's speckle.
#[derive(Debug, Clone)]
pub struct Grain {
    pub aperture: Aperture,
    /// Minimal speckle size h, px.
    pub size: f64,
    pub contrast: f64,
    /// Standard deviation of what n × n samples miss of a pixel's mean, in units of the
    /// mean and for a contrast of 1, by n.
    pub missed: BTreeMap<u32, f64>,
}

impl Grain {
    /// For plans with these numbers of samples; a pixel is `grains` wide.
    pub fn new(aperture: Aperture, grains: f64, contrast: f64, plans: &[Plan]) -> Grain {
        let counts: BTreeSet<u32> = plans.iter().map(|p| p.samples_per_side).collect();
        let size = 1.0 / grains;
        // Past this many no affordable number of samples does.
        let grains = grains.min(16.0);
        let missed = |n: u32| (n, sampling_deviation(aperture, grains, n as usize));
        Grain {
            aperture,
            size,
            contrast,
            missed: counts.into_iter().map(missed).collect(),
        }
    }
}

/// Samples a side that plans choose from.
const SAMPLES: [u32; 8] = [1, 2, 3, 4, 6, 8, 12, 16];
/// Beam radii at which plans may end light, beside that at which none is seen.
const RADII: [f64; 6] = [1.25, 1.5, 1.75, 2.0, 2.25, 2.5];

/// By what `1/e²` half widths of the line its pixels' samples may stand wrong where
/// facets bend (half a pixel off a plane: a quarter of the tolerance of planes).
const BEND: f64 = 0.0025;

impl Pilot {
    /// Standard deviation of the row from speckle for that of one pixel's light, if
    /// pixels err independently: the centroid of a Gaussian line, Σ y²·G² = σ/(4√π).
    fn centroid(sigma: f64, pixel: f64) -> f64 {
        pixel * (sigma / (4.0 * PI.sqrt())).sqrt()
    }

    /// Error of each point for one effect of a plan.
    pub(super) fn each(&self, error: impl Fn(&PilotPoint) -> HeightError) -> Vec<HeightError> {
        let in_um = |point: &PilotPoint| error(point).times(point.um_per_px);
        self.points.iter().map(in_um).collect()
    }

    /// How much more errors of lines that speckle breaks up stray: a column it darkens
    /// has the same errors of its pixels over less light, so that 99 of 100 are within up
    /// to 4.5 standard deviations, not 2.6 (measured: the demo's rows for samples and
    /// noise in `lasertrace chart`).
    fn dark_columns(&self) -> f64 {
        1.0 + 0.75 * self.grain.as_ref().map_or(0.0, |grain| grain.contrast)
    }

    /// What speckle left out does.
    pub fn speckle(&self) -> Vec<HeightError> {
        self.each(|p| HeightError::random(p.speckle))
    }

    pub fn noise(&self) -> Vec<HeightError> {
        let more = self.dark_columns();
        self.each(|p| HeightError::random(more * p.noise))
    }

    /// What it does to take the line as having no width.
    pub fn geometry(&self) -> Vec<HeightError> {
        self.each(|p| HeightError::bias(p.geometry))
    }

    /// Variance of the row where pixels' light differs by little, d counts each, and so
    /// some are rounded to other counts: by d·(1 - d) a pixel (a step in d of 1 cases), at
    /// most ¼. `moment`: Σ y²·|d|/(Σ light)².
    fn rounding(&self, point: &PilotPoint, moment: f64) -> f64 {
        (self.step * moment).min(0.25 * (self.step * point.per_count).powi(2))
    }

    /// What n × n samples a pixel leave: of the line, its first alias and what the pilot
    /// found, falling as the square of n, and at edges as its power of 1.5, as n rows of
    /// samples miss an oblique edge by independent parts of 1/n each; of speckle what they miss of the
    /// pixel's mean; of both what rounding makes of it, which if it is little happens in few
    /// columns. They miss G''/(24·n²) of a line G = A·exp(-y²/2σ²), and
    /// ∫y²·|G''| = 5.447·A·σ, ∫|G''| = 2.426·A/σ.
    pub fn samples(&self, plan: &Plan) -> Vec<HeightError> {
        let n = plan.samples_per_side;
        let missed = match (plan.speckle, &self.grain) {
            (Some(Method::Prefiltered { .. }) | None, _) | (_, None) => 0.0,
            (Some(_), Some(grain)) => grain.contrast * grain.missed[&n],
        };
        let more = self.dark_columns();
        self.each(|p| {
            let curved = |n: f64| 5.447 / (48.0 * PI * n * n * p.height * p.sigma);
            // What rounding does not explain is an edge.
            let edge = |found: f64| found.abs() > 3.0 * self.rounding(p, curved(2.0)).sqrt();
            let share = 2.0 / n as f64;
            let found = match (n, p.coarse[1].unwrap_or(0.0)) {
                (1 | 2, _) => p.coarse[n as usize - 1].map(f64::abs),
                (_, found) if edge(found) => Some(more * found.abs() * share.powf(1.5)),
                (_, found) => Some(found.abs() * share * share),
            };
            let alias = sampling_error(p.sigma, n);
            let n = n as f64;
            let rounded =
                (2.0 * missed * p.sigma + 0.101 / (n * n * p.sigma)) * p.height / self.step;
            let broken = missed * p.sigma / (PI * p.height);
            let grains = Self::centroid(p.sigma, missed);
            let variance = self.rounding(p, curved(n) + broken);
            HeightError::bias(found.map(|found| found + alias))
                .and(HeightError::random(more * grains))
                .and(HeightError::rare(more * more * variance, rounded))
        })
    }

    /// What it leaves to take samples from planes.
    pub fn planes(&self, plan: &Plan) -> Vec<HeightError> {
        let used = plan.sampling == Sampling::Planes && plan.samples_per_side > 1;
        let bend = if used { BEND } else { 0.0 };
        self.each(|p| HeightError::bias(Some(bend * 2.0 * p.sigma)))
    }

    /// What it leaves to end light at r beam radii, z = 2r standard deviations, less half
    /// a pixel, as pixels end whole: were the other end hidden, the centroid would move by
    /// σ·φ(z); of speckle goes what is beyond, and dark pixels have other noise there.
    pub fn cutoff(&self, plan: &Plan) -> Vec<HeightError> {
        let more = self.dark_columns();
        self.each(|p| {
            let z = (2.0 * plan.cutoff_radii - 0.5 / p.sigma).max(0.0);
            let moment = (-0.5 * z * z).exp() / TAU.sqrt();
            // ∫y²·G² beyond z σ, of all: G² is a Gaussian of σ/√2.
            let lost = libm::erfc(z) + 2.0 * z * (-z * z).exp() / PI.sqrt();
            // The finder's window ends at 4 σ.
            let dark = (1.0 - (z / 4.0).powi(3)).max(0.0) * 2.0;
            let speckle = plan.speckle.map_or(0.0, |_| p.speckle * p.speckle * lost);
            let noise = if plan.noise {
                dark * (self.dark * p.per_count).powi(2)
            } else {
                0.0
            };
            HeightError::bias(Some(moment * p.sigma))
                .and(HeightError::random(more * (speckle + noise).sqrt()))
        })
    }

    /// Errors of a plan against the full model.
    pub fn errors(&self, plan: &Plan) -> Vec<HeightError> {
        let mut parts = Vec::new();
        if plan.speckle.is_none() {
            parts.push(self.speckle());
        }
        if !plan.noise {
            parts.push(self.noise());
        }
        match plan.geometry_only {
            true => parts.push(self.geometry()),
            false => parts.extend([self.samples(plan), self.planes(plan), self.cutoff(plan)]),
        }
        let none = self.each(|_| HeightError::random(0.0));
        parts.into_iter().fold(none, |sum, part| {
            sum.into_iter().zip(part).map(|(a, b)| a.and(b)).collect()
        })
    }

    /// The cheapest of `candidates` that is predicted to keep the tolerance, else the
    /// most accurate, and its prediction.
    pub fn choose(&self, candidates: Vec<Plan>, tolerance_um: f64) -> (Plan, Accuracy) {
        let scatter = quantile(&self.speckle()).filter(|&limit| limit > tolerance_um);
        let planned_um = scatter.map_or(tolerance_um, |s| tolerance_um.max(SHARE_OF_LIMIT * s));
        let share = |plan: &Plan| share_beyond(&self.errors(plan), planned_um);
        let cost = |plan| (self.cost_ms(&plan), plan);
        let mut by_cost: Vec<(f64, Plan)> = candidates.into_iter().map(cost).collect();
        by_cost.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut plans = by_cost.iter().map(|(_, plan)| plan);
        let cheapest = plans.find(|plan| share(plan) <= PLANNED_SHARE);
        let insufficient = cheapest.is_none();
        let within = |plan: &Plan| quantile(&self.errors(plan)).unwrap_or(f64::INFINITY);
        let finest = || {
            // Of equally good ones the first, which is the cheapest.
            let ranked = by_cost.iter().map(|(_, plan)| (within(plan), plan));
            let finest = ranked.min_by(|a, b| a.0.total_cmp(&b.0));
            finest.expect("there are candidates").1
        };
        let plan = cheapest.unwrap_or_else(finest).clone();
        let errors = self.errors(&plan);
        let mut accuracy = Accuracy {
            tolerance_um,
            planned_um,
            speckle_limit_um: scatter,
            predicted_um: quantile(&errors),
            predicted_share: share_beyond(&errors, planned_um),
            sufficient: !insufficient && !self.points.is_empty(),
            cost_ms: self.cost_ms(&plan),
            pilot_frames: self.frames.clone(),
            statement: String::new(),
        };
        accuracy.statement = match self.points.is_empty() {
            true => "no frame that was looked at has a line: nothing could be predicted".into(),
            false => accuracy.in_words(plan.speckle.is_some()),
        };
        (plan, accuracy)
    }
}

/// A plan without images, and what only images show.
pub fn geometry_only(base: Plan) -> Plan {
    Plan {
        geometry_only: true,
        speckle: None,
        noise: false,
        ..base
    }
}

/// Every plan that is `base` done otherwise: cheaper, or more finely.
pub fn candidates(base: &Plan, geometry: bool) -> Vec<Plan> {
    let mut plans = Vec::new();
    if geometry {
        plans.push(geometry_only(base.clone()));
    }
    let speckles = [None, base.speckle];
    let noises = [false, base.noise];
    let radii = RADII.iter().filter(|&&r| r < base.cutoff_radii);
    let radii: Vec<f64> = radii.copied().chain([base.cutoff_radii]).collect();
    for speckle in &speckles[base.speckle.is_none() as usize..] {
        for &noise in &noises[!base.noise as usize..] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                for samples_per_side in SAMPLES {
                    plans.extend(radii.iter().map(|&cutoff_radii| Plan {
                        speckle: *speckle,
                        noise,
                        sampling,
                        samples_per_side,
                        cutoff_radii,
                        ..base.clone()
                    }));
                }
            }
        }
    }
    plans
}

impl Accuracy {
    fn in_words(&self, modelled: bool) -> String {
        let Accuracy {
            tolerance_um,
            planned_um,
            ..
        } = self;
        let how = match modelled {
            true => "It is modelled, and all else",
            false => "It is left out by name, and all is planned",
        };
        let limit = self.speckle_limit_um.map(|limit| {
            format!(
                "no sensor with these optics measures single points to {tolerance_um} µm: \
                 speckle alone moves 1 of 100 by more than {limit:.2} µm. {how} to \
                 {planned_um:.2} µm. "
            )
        });
        let predicted = self.predicted_um.map_or("unknown".into(), |um| {
            format!("within {um:.2} µm of the full model in 99 of 100 points")
        });
        let verdict = match self.sufficient {
            true => "",
            false => "; no method here does better, and it is not enough",
        };
        limit.unwrap_or_default() + &format!("predicted: {predicted}{verdict}")
    }
}

#[cfg(test)]
#[path = "accuracy_tests.rs"]
mod tests;
