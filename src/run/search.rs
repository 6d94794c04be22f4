//! Search for the cheapest plan that satisfies a tolerance in the pilot frames.

use super::height_errors::HeightErrors;
use super::methods::{reference_config, with_scene_overrides};
use super::pilot::PilotStrips;
use super::simulation::Simulation;
use crate::accel::{Accel, TriangleClusters};
use crate::error::Result;
use crate::frame::Sampling;
use crate::mesh::ProgressFn;
use crate::plan::accuracy::{Accuracy, PilotSample, candidates, geometry_only, is_no_finer_than};
use crate::plan::height_error::{PROMISED_SHARE, SIGMAS_OF_99};
use crate::plan::rules::ModelConfig;
use crate::scene::Scene;
use std::sync::Arc;

/// Limit for other errors as a fraction of the height scatter, if speckle exceeds the tolerance
/// even without other errors. They increase the scatter by 0.5 %.
const SHARE_OF_LIMIT: f64 = 0.1;
/// Smallest number of samples per side of the reference model, and the number used if too many
/// points at edges exceed the tolerance even for the finest plan.
const FULL_SAMPLES: [u32; 2] = [8, 16];
/// Number of evaluated strips, and the number used if a few strips cannot establish that a plan is
/// sufficient.
const STRIPS: [u32; 2] = [48, 192];
/// Fraction of points beyond the tolerance up to which more strips are evaluated.
const UNSURE: f64 = PROMISED_SHARE / 2.0;

/// Chosen plan, its accuracy, and the pilot data of the choice.
pub(crate) struct PlanChoice {
    pub plan: ModelConfig,
    pub accuracy: Accuracy,
    pub pilot: PilotSample,
    pub pilot_strips: PilotStrips,
    /// Finest plan among the candidates.
    pub finest: ModelConfig,
}

/// Requirement for a plan.
struct ToleranceGoal {
    planned_um: f64,
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
                errors.share_at_most(self.planned_um, self.left) <= PROMISED_SHARE
            }
            Criterion::ByEstimate => errors.share_beyond(self.planned_um) <= UNSURE,
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
    let (mut samples, mut strips) = (FULL_SAMPLES[0], STRIPS[0]);
    let mut done = 0.0;
    loop {
        let side = samples.max(2 * most);
        let reference = ModelConfig {
            samples_per_side: side,
            reflections: base.reflections,
            ..reference_config(base, &asked)
        };
        let simulation = Simulation::with_plan(scene, accel.clone(), reference)?;
        // A second round may follow.
        let watch = |share: f64| watch(done + (1.0 - done) * share / 2.0);
        let looked = PilotStrips::new(simulation.with_clusters(clusters.clone()), strips, &watch)?;
        done = (1.0 + done) / 2.0;
        let plans = candidates(base, side / 2).into_iter();
        let plans: Vec<ModelConfig> = plans
            .map(|plan| with_scene_overrides(scene, plan))
            .collect();
        let choice = among(scene, looked, base, plans, tolerance_um)?;
        let Accuracy {
            sufficient,
            pilot_points,
            unsettled_share,
            ..
        } = choice.accuracy;
        if sufficient || pilot_points == 0 || side > FULL_SAMPLES[0] {
            return Ok(choice);
        }
        if unsettled_share <= UNSURE && strips == STRIPS[0] {
            strips = STRIPS[1];
        } else if unsettled_share > UNSURE {
            samples = FULL_SAMPLES[1];
        } else {
            return Ok(choice);
        }
    }
}

/// Chooses among `images` and, if the scene allows it, the geometric plan.
fn among(
    scene: &Scene,
    mut looked: PilotStrips,
    base: &ModelConfig,
    images: Vec<ModelConfig>,
    tolerance_um: f64,
) -> Result<PlanChoice> {
    let finer = |best: ModelConfig, plan: ModelConfig| {
        if is_no_finer_than(&best, &plan) {
            plan
        } else {
            best
        }
    };
    let finest = images.iter().cloned().reduce(finer);
    let finest = finest.expect("there is a plan with an image");
    let mut radii: Vec<f64> = images.iter().map(|plan| plan.cutoff_radii).collect();
    radii.sort_by(f64::total_cmp);
    radii.dedup();
    let pilot = looked.pilot(&radii)?;
    let best = looked.errors(&finest)?;
    let (mut limit, mut scatter) = (None, 0.0);
    if base.speckle.is_some() {
        let smooth = ModelConfig {
            speckle: None,
            blur: finest.blur.without_field(),
            ..finest.clone()
        };
        let errors = looked.errors(&smooth)?;
        limit = errors.within_of_both().filter(|&um| um > tolerance_um);
        // Computed from all points, because speckle may displace points at edges arbitrarily.
        scatter = SHARE_OF_LIMIT * SIGMAS_OF_99 * errors.noise_um;
    }
    let goal = ToleranceGoal {
        planned_um: tolerance_um.max(scatter),
        left: looked.left(),
    };
    let line = scene.laser.fan.is_some() && !scene.write_frames && base.reflections.is_none();
    let geometry = line && scene.methods.geometry_only != Some(false);
    let (plan, sufficient) = match best.points {
        // Without points there is no evidence that an effect can be omitted.
        0 => (with_scene_overrides(scene, base.clone()), false),
        _ => {
            let cost = |plan: &ModelConfig| pilot.cost_ms(plan);
            let is_kept =
                |plan: &ModelConfig, judged| Ok(goal.is_kept(&looked.errors(plan)?, judged));
            cheapest(&finest, images, geometry, &cost, is_kept)?
        }
    };
    let errors = looked.errors(&plan)?;
    let mut accuracy = Accuracy {
        tolerance_um,
        planned_um: goal.planned_um,
        speckle_limit_um: limit,
        predicted_um: errors.within_um,
        predicted_share: errors.share_beyond(goal.planned_um),
        share_at_most: errors.share_at_most(goal.planned_um, goal.left),
        unsettled_share: best.share_beyond(goal.planned_um),
        sufficient,
        cost_ms: pilot.cost_ms(&plan),
        cost_without_ms: pilot.cost_ms(&with_scene_overrides(scene, base.clone())),
        pilot_frames: looked.frames(),
        pilot_points: errors.points,
        statement: String::new(),
    };
    accuracy.statement = accuracy.in_words(plan.speckle.is_some());
    Ok(PlanChoice {
        plan,
        accuracy,
        pilot,
        pilot_strips: looked,
        finest,
    })
}

/// Returns the cheapest plan that `is_kept` accepts, else the finest, and whether it is surely
/// sufficient. The geometric plan is far cheaper than any image and is tested first if allowed.
/// Plans that are no finer than a failed plan in any respect are not tested.
fn cheapest(
    finest: &ModelConfig,
    mut images: Vec<ModelConfig>,
    geometry: bool,
    cost: &impl Fn(&ModelConfig) -> f64,
    mut is_kept: impl FnMut(&ModelConfig, Criterion) -> Result<bool>,
) -> Result<(ModelConfig, bool)> {
    if finest.geometry_only || geometry {
        let plan = geometry_only(finest.clone());
        if is_kept(&plan, Criterion::AtConfidence95)? {
            return Ok((plan, true));
        }
    }
    if finest.geometry_only {
        return Ok((finest.clone(), false));
    }
    let judged = match is_kept(finest, Criterion::AtConfidence95)? {
        true => Criterion::AtConfidence95,
        false if is_kept(finest, Criterion::ByEstimate)? => Criterion::ByEstimate,
        false => return Ok((finest.clone(), false)),
    };
    let sure = judged == Criterion::AtConfidence95;
    let mut is_kept = |plan: &ModelConfig| is_kept(plan, judged);
    // If planar sampling is sufficient, other methods can be tested without tracing every sample.
    let planes = ModelConfig {
        sampling: Sampling::Planes,
        ..finest.clone()
    };
    let flat = images.iter().any(|plan| plan.sampling == planes.sampling);
    let basis = match flat && is_kept(&planes)? {
        true => &planes,
        false => finest,
    };
    let mut failed: Vec<ModelConfig> = Vec::new();
    images.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    let hopeless = |plan: &ModelConfig, failed: &[ModelConfig]| {
        failed.iter().any(|f| is_no_finer_than(plan, f))
    };
    // Each method in turn is made coarser by bisection while the other methods stay the finest.
    for axis in axes(basis, &images) {
        let (mut low, mut high) = (0, axis.len());
        while low < high {
            let middle = (low + high) / 2;
            match is_kept(&axis[middle])? {
                true => high = middle,
                false => low = middle + 1,
            }
        }
        failed.extend(low.checked_sub(1).map(|i| axis[i].clone()));
    }
    for plan in images {
        if hopeless(&plan, &failed) {
            continue;
        }
        if is_kept(&plan)? {
            return Ok((plan, sure));
        }
        failed.push(plan);
    }
    Ok((finest.clone(), sure))
}

/// Returns, for each method, the finest plan with this method made coarser, starting with the
/// coarsest.
fn axes(finest: &ModelConfig, images: &[ModelConfig]) -> [Vec<ModelConfig>; 6] {
    let with = |change: &dyn Fn(&mut ModelConfig, &ModelConfig)| {
        let mut plans: Vec<ModelConfig> = Vec::new();
        for plan in images {
            let mut changed = finest.clone();
            change(&mut changed, plan);
            let seen = |other: &ModelConfig| {
                is_no_finer_than(other, &changed) && is_no_finer_than(&changed, other)
            };
            let coarser = is_no_finer_than(&changed, finest) && !seen(finest);
            if coarser && !plans.iter().any(seen) {
                plans.push(changed);
            }
        }
        // The plans differ in one method, so they have a total order.
        plans.sort_by(|a, b| match is_no_finer_than(a, b) {
            true => std::cmp::Ordering::Less,
            false => std::cmp::Ordering::Greater,
        });
        plans
    };
    [
        with(&|changed, plan| changed.sampling = plan.sampling),
        with(&|changed, plan| {
            changed.speckle = plan.speckle;
            if plan.speckle.is_none() {
                changed.blur = changed.blur.without_field();
            }
        }),
        with(&|changed, plan| changed.noise = plan.noise),
        with(&|changed, plan| changed.blur = plan.blur),
        with(&|changed, plan| changed.samples_per_side = plan.samples_per_side),
        with(&|changed, plan| changed.cutoff_radii = plan.cutoff_radii),
    ]
}

impl PlanChoice {
    /// Returns the 99 % quantile of the height change that `change` causes in the finest plan, µm.
    pub fn influence(&mut self, change: impl FnOnce(&mut ModelConfig)) -> Result<Option<f64>> {
        let mut plan = self.finest.clone();
        change(&mut plan);
        if plan.samples_per_side == 1 {
            plan.sampling = Sampling::Planes;
        }
        Ok(self.pilot_strips.errors(&plan)?.within_um)
    }
}

#[cfg(test)]
#[path = "search_tests.rs"]
mod tests;
