//! Choice of the first rung of the ladder that satisfies a tolerance in the pilot frames.

use super::height_errors::HeightErrors;
use super::methods::{reference_config, with_scene_overrides};
use super::pilot::PilotStrips;
use super::simulation::Simulation;
use crate::accel::{Accel, TriangleClusters};
use crate::error::Result;
use crate::frame::{self, Sampling};
use crate::mesh::ProgressFn;
use crate::plan::accuracy::Accuracy;
use crate::plan::height_error::{PROMISED_SHARE, SIGMAS_OF_99};
use crate::plan::ladder::{LADDER, Rung};
use crate::plan::rules::ModelConfig;
use crate::scene::Scene;
use std::sync::Arc;

/// Limit for other errors as a fraction of the height scatter, if speckle exceeds the tolerance
/// even without other errors. They increase the scatter by 0.5 %.
const SHARE_OF_LIMIT: f64 = 0.1;
/// Smallest number of samples per side of the reference model, and the number used if too many
/// points at edges exceed the tolerance even for the full rung.
const FULL_SAMPLES: [u32; 2] = [8, 16];
/// Fraction of points of a few strips beyond the tolerance above which a plan is rejected.
const REJECTED: f64 = 2.0 * PROMISED_SHARE;
/// Fraction of points beyond the tolerance up to which all strips are evaluated.
const UNSURE: f64 = PROMISED_SHARE / 2.0;

/// Chosen plan, its accuracy, and the strips of the choice.
pub(crate) struct PlanChoice {
    pub plan: ModelConfig,
    pub accuracy: Accuracy,
    pub pilot_strips: PilotStrips,
    /// Configuration of the full rung.
    pub finest: ModelConfig,
}

/// Requirement for a plan.
struct ToleranceGoal {
    target_error_um: f64,
    /// Fraction of the scan that was not evaluated.
    left: f64,
}

/// Criterion by which a plan is sufficient.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Criterion {
    /// At most 1 % of the points are beyond the tolerance, at 95 % confidence.
    AtConfidence95,
    /// Estimate for too few evaluated points: at most 0.5 % of these are beyond the tolerance.
    ByEstimate,
}

impl ToleranceGoal {
    fn is_kept(&self, errors: &HeightErrors, judged: Criterion) -> bool {
        match judged {
            Criterion::AtConfidence95 => {
                errors.exceedance_upper_95(self.target_error_um, self.left) <= PROMISED_SHARE
            }
            Criterion::ByEstimate => errors.share_beyond(self.target_error_um) <= UNSURE,
        }
    }
}

/// Chooses a plan for the tolerance of a scene; `base` is its plan without a tolerance. All plans
/// with images use equal indirect light. Scenes with indirect light require images. `watch` is
/// called with the progress.
pub(crate) fn choose(
    scene: &Scene,
    accel: &Arc<Accel>,
    base: &ModelConfig,
    tolerance_um: f64,
    watch: &ProgressFn,
) -> Result<PlanChoice> {
    let clusters = Arc::new(TriangleClusters::new(&scene.mesh));
    let asked = with_scene_overrides(scene, base.clone());
    let most = base.samples_per_side.max(asked.samples_per_side);
    // More strips or a second reference may follow each step.
    let half = |done: f64| move |share: f64| watch(done + (1.0 - done) * share / 2.0);
    let (mut samples, mut done) = (FULL_SAMPLES[0], 0.0);
    loop {
        let side = samples.max(2 * most);
        let reference = ModelConfig {
            samples_per_side: side,
            reflections: base.reflections,
            ..reference_config(base, &asked)
        };
        let simulation = Simulation::with_plan(scene, accel.clone(), reference)?;
        let simulation = simulation.with_clusters(clusters.clone());
        let looked = PilotStrips::new(simulation, &half(done))?;
        done = (1.0 + done) / 2.0;
        let mut choice = among(scene, looked, base, side / 2, tolerance_um)?;
        if choice.needs_more_strips() && choice.pilot_strips.evaluate_all(&half(done))? {
            done = (1.0 + done) / 2.0;
            choice = among(scene, choice.pilot_strips, base, side / 2, tolerance_um)?;
        }
        if !choice.needs_more_samples() || side > FULL_SAMPLES[0] {
            return Ok(choice);
        }
        samples = FULL_SAMPLES[1];
    }
}

/// Chooses among the rungs that the scene allows. Their samples per side are at most
/// `full_samples`.
fn among(
    scene: &Scene,
    mut looked: PilotStrips,
    base: &ModelConfig,
    full_samples: u32,
    tolerance_um: f64,
) -> Result<PlanChoice> {
    let line = scene.laser.fan.is_some() && !scene.save_images && base.reflections.is_none();
    let cut =
        frame::unmet_plane_cut_requirement(&scene.laser, &scene.camera, &scene.surface).is_none();
    let allowed = |rung: &&Rung| {
        (cut || !rung.is_plane_cut())
            && match scene.methods.geometry_only {
                Some(geometry_only) => rung.takes_images() != geometry_only,
                None => rung.takes_images() || line,
            }
    };
    let config = |rung: &'static Rung| {
        let config = rung.config(base, full_samples);
        (rung, with_scene_overrides(scene, config))
    };
    let rungs: Vec<_> = LADDER.iter().filter(allowed).map(config).collect();
    let (_, finest) = rungs.last().cloned().expect("a method is allowed");
    let best = looked.errors(&finest)?;
    let (mut limit, mut scatter) = (None, 0.0);
    if base.speckle.is_some() {
        let smooth = ModelConfig {
            speckle: None,
            blur: finest.blur.without_field(),
            ..finest.clone()
        };
        let errors = looked.errors_in_few(&smooth)?;
        limit = errors.within_of_both().filter(|&um| um > tolerance_um);
        // Computed from all points, because speckle may displace points at edges arbitrarily.
        scatter = SHARE_OF_LIMIT * SIGMAS_OF_99 * errors.half_width_68_um;
    }
    let goal = ToleranceGoal {
        target_error_um: tolerance_um.max(scatter),
        left: looked.left(),
    };
    let is_kept = |plan: &ModelConfig, judged| {
        let few = looked.errors_in_few(plan)?;
        Ok(few.share_beyond(goal.target_error_um) <= REJECTED
            && goal.is_kept(&looked.errors(plan)?, judged))
    };
    let (chosen, sufficient) = match best.points {
        // Without points there is no evidence that an effect can be omitted.
        0 => (first_complete(&rungs), false),
        _ => first_sufficient(&rungs, is_kept)?,
    };
    let (rung, plan) = rungs[chosen].clone();
    let errors = looked.errors(&plan)?;
    let mut accuracy = Accuracy {
        rung: rung.name,
        tolerance_um,
        target_error_um: goal.target_error_um,
        speckle_limited_error_um: limit,
        predicted_um: errors.percentile_99_um,
        exceedance_estimate: errors.share_beyond(goal.target_error_um),
        exceedance_upper_95: errors.exceedance_upper_95(goal.target_error_um, goal.left),
        sampling_exceedance: best.share_beyond(goal.target_error_um),
        sufficient,
        pilot_frames: looked.frames(),
        pilot_points: errors.points,
        statement: String::new(),
    };
    accuracy.statement = accuracy.in_words(plan.speckle.is_some());
    Ok(PlanChoice {
        plan,
        accuracy,
        pilot_strips: looked,
        finest,
    })
}

/// Returns the index of the first rung without omissions, else of the last.
fn first_complete(rungs: &[(&Rung, ModelConfig)]) -> usize {
    let complete = rungs.iter().position(|(rung, _)| !rung.omits());
    complete.unwrap_or(rungs.len() - 1)
}

/// Returns the index of the first rung that `is_kept` accepts, and whether it is surely sufficient.
/// Nothing is omitted if the last rung is not surely sufficient, and the last rung is used if it is
/// not sufficient by estimate either.
fn first_sufficient(
    rungs: &[(&Rung, ModelConfig)],
    mut is_kept: impl FnMut(&ModelConfig, Criterion) -> Result<bool>,
) -> Result<(usize, bool)> {
    let last = rungs.len() - 1;
    let finest = &rungs[last].1;
    let (first, judged) = match is_kept(finest, Criterion::AtConfidence95)? {
        true => (0, Criterion::AtConfidence95),
        false if is_kept(finest, Criterion::ByEstimate)? => {
            (first_complete(rungs), Criterion::ByEstimate)
        }
        false => return Ok((last, false)),
    };
    let sure = judged == Criterion::AtConfidence95;
    for (i, (_, plan)) in rungs.iter().enumerate().take(last).skip(first) {
        if is_kept(plan, judged)? {
            return Ok((i, sure));
        }
    }
    Ok((last, sure))
}

impl PlanChoice {
    /// Returns whether more strips may establish that a plan is sufficient.
    fn needs_more_strips(&self) -> bool {
        let accuracy = &self.accuracy;
        !accuracy.sufficient && accuracy.pilot_points > 0 && accuracy.sampling_exceedance <= UNSURE
    }

    /// Returns whether too many points exceed the tolerance even for the full rung.
    fn needs_more_samples(&self) -> bool {
        let accuracy = &self.accuracy;
        !accuracy.sufficient && accuracy.pilot_points > 0 && accuracy.sampling_exceedance > UNSURE
    }

    /// Returns the 99 % quantile of the height change that `change` causes in the full rung, µm. It
    /// is estimated from a few strips.
    pub fn influence(&mut self, change: impl FnOnce(&mut ModelConfig)) -> Result<Option<f64>> {
        let mut plan = self.finest.clone();
        change(&mut plan);
        if plan.samples_per_side == 1 {
            plan.sampling = Sampling::Planes;
        }
        Ok(self.pilot_strips.errors_in_few(&plan)?.percentile_99_um)
    }
}

#[cfg(test)]
#[path = "ladder_tests.rs"]
mod tests;
