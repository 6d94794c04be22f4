//! The cheapest plan that keeps a tolerance in the frames looked at.

use super::height_errors::HeightErrors;
use super::methods::{full, named};
use super::pilot::Looked;
use super::simulation::Simulation;
use crate::accel::{Accel, Clusters};
use crate::error::Result;
use crate::frame::Sampling;
use crate::mesh::Watch;
use crate::plan::accuracy::{Accuracy, Pilot, candidates, geometry_only, no_finer};
use crate::plan::height_error::{PROMISED_SHARE, SIGMAS_OF_99};
use crate::plan::rules::Plan;
use crate::scene::Scene;
use std::sync::Arc;

/// Where speckle alone scatters heights by more than the tolerance, all else is planned
/// to this share of that scatter: it adds half a percent to it.
const SHARE_OF_LIMIT: f64 = 0.1;
/// Samples a side of the full model at least, and where so many leave too much at edges.
const FULL_SAMPLES: [u32; 2] = [8, 16];
/// Parts of frames that are looked at, and where so few cannot say that a plan is good enough.
const STRIPS: [u32; 2] = [48, 192];
/// Share of points beyond up to which it is for more parts to say how many there are.
const UNSURE: f64 = PROMISED_SHARE / 2.0;

/// A plan that was chosen, what was found of it, and by what.
pub(crate) struct Choice {
    pub plan: Plan,
    pub accuracy: Accuracy,
    pub pilot: Pilot,
    pub looked: Looked,
    /// The finest plan that could have been chosen.
    pub finest: Plan,
}

/// What a plan must keep.
struct Goal {
    planned_um: f64,
    /// Share of the scan that was not looked at.
    left: f64,
}

/// By what a plan is judged to be good enough.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Judged {
    /// At most one point of a hundred is beyond, at 95 % confidence.
    Surely,
    /// Where too few points were looked at to say so of any plan: half as many of these are.
    ByEstimate,
}

impl Goal {
    fn is_kept(&self, errors: &HeightErrors, judged: Judged) -> bool {
        match judged {
            Judged::Surely => errors.share_at_most(self.planned_um, self.left) <= PROMISED_SHARE,
            Judged::ByEstimate => errors.share_beyond(self.planned_um) <= UNSURE,
        }
    }
}

/// Chooses for the tolerance of a scene; `base` is its plan without one. Light that is reflected more than once is
/// the same for all plans that take images; they must be taken if there is any. `watch` hears how far it was followed.
pub(crate) fn choose(
    scene: &Scene,
    accel: &Arc<Accel>,
    base: &Plan,
    tolerance_um: f64,
    watch: &Watch,
) -> Result<Choice> {
    let clusters = Arc::new(Clusters::new(&scene.mesh));
    let asked = named(scene, base.clone());
    let most = base.samples_per_side.max(asked.samples_per_side);
    let (mut samples, mut strips) = (FULL_SAMPLES[0], STRIPS[0]);
    let mut done = 0.0;
    loop {
        let side = samples.max(2 * most);
        let reference = Plan {
            samples_per_side: side,
            reflections: base.reflections,
            ..full(base, &asked)
        };
        let simulation = Simulation::with_plan(scene, accel.clone(), reference)?;
        // There may be another round.
        let watch = |share: f64| watch(done + (1.0 - done) * share / 2.0);
        let looked = Looked::new(simulation.with_clusters(clusters.clone()), strips, &watch)?;
        done = (1.0 + done) / 2.0;
        let plans = candidates(base, side / 2).into_iter();
        let plans: Vec<Plan> = plans.map(|plan| named(scene, plan)).collect();
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

/// Chooses among `images` and, where the scene allows it, geometry alone.
fn among(
    scene: &Scene,
    mut looked: Looked,
    base: &Plan,
    images: Vec<Plan>,
    tolerance_um: f64,
) -> Result<Choice> {
    let finer = |best: Plan, plan: Plan| if no_finer(&best, &plan) { plan } else { best };
    let finest = images.iter().cloned().reduce(finer);
    let finest = finest.expect("there is a plan with an image");
    let mut radii: Vec<f64> = images.iter().map(|plan| plan.cutoff_radii).collect();
    radii.sort_by(f64::total_cmp);
    radii.dedup();
    let pilot = looked.pilot(&radii)?;
    let best = looked.errors(&finest)?;
    let (mut limit, mut scatter) = (None, 0.0);
    if base.speckle.is_some() {
        let smooth = Plan {
            speckle: None,
            blur: finest.blur.without_field(),
            ..finest.clone()
        };
        let errors = looked.errors(&smooth)?;
        limit = errors.within_of_both().filter(|&um| um > tolerance_um);
        // Of all points rather than of those at edges, which speckle may throw anywhere.
        scatter = SHARE_OF_LIMIT * SIGMAS_OF_99 * errors.noise_um;
    }
    let goal = Goal {
        planned_um: tolerance_um.max(scatter),
        left: looked.left(),
    };
    let line = scene.laser.fan.is_some() && !scene.write_frames && base.reflections.is_none();
    let geometry = line && scene.methods.geometry_only != Some(false);
    let (plan, sufficient) = match best.points {
        // Nothing speaks for leaving anything out.
        0 => (named(scene, base.clone()), false),
        _ => {
            let cost = |plan: &Plan| pilot.cost_ms(plan);
            let is_kept = |plan: &Plan, judged| Ok(goal.is_kept(&looked.errors(plan)?, judged));
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
        cost_without_ms: pilot.cost_ms(&named(scene, base.clone())),
        pilot_frames: looked.frames(),
        pilot_points: errors.points,
        statement: String::new(),
    };
    accuracy.statement = accuracy.in_words(plan.speckle.is_some());
    Ok(Choice {
        plan,
        accuracy,
        pilot,
        looked,
        finest,
    })
}

/// The cheapest plan that `is_kept` takes, else the finest; and whether it surely does. Geometry
/// alone, far cheaper than any image, is asked first if it may be taken. What is
/// no finer in anything than a plan that fails is not asked.
fn cheapest(
    finest: &Plan,
    mut images: Vec<Plan>,
    geometry: bool,
    cost: &impl Fn(&Plan) -> f64,
    mut is_kept: impl FnMut(&Plan, Judged) -> Result<bool>,
) -> Result<(Plan, bool)> {
    if finest.geometry_only || geometry {
        let plan = geometry_only(finest.clone());
        if is_kept(&plan, Judged::Surely)? {
            return Ok((plan, true));
        }
    }
    if finest.geometry_only {
        return Ok((finest.clone(), false));
    }
    let judged = match is_kept(finest, Judged::Surely)? {
        true => Judged::Surely,
        false if is_kept(finest, Judged::ByEstimate)? => Judged::ByEstimate,
        false => return Ok((finest.clone(), false)),
    };
    let sure = judged == Judged::Surely;
    let mut is_kept = |plan: &Plan| is_kept(plan, judged);
    // What planes do well need not be traced to learn what else does.
    let planes = Plan {
        sampling: Sampling::Planes,
        ..finest.clone()
    };
    let flat = images.iter().any(|plan| plan.sampling == planes.sampling);
    let basis = match flat && is_kept(&planes)? {
        true => &planes,
        false => finest,
    };
    let mut failed: Vec<Plan> = Vec::new();
    images.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    let hopeless = |plan: &Plan, failed: &[Plan]| failed.iter().any(|f| no_finer(plan, f));
    // One method after the other made coarser, all else being the finest, by bisection.
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

/// The finest plan with one of its methods coarser, from the coarsest on, method by method.
fn axes(finest: &Plan, images: &[Plan]) -> [Vec<Plan>; 6] {
    let with = |change: &dyn Fn(&mut Plan, &Plan)| {
        let mut plans: Vec<Plan> = Vec::new();
        for plan in images {
            let mut changed = finest.clone();
            change(&mut changed, plan);
            let seen = |other: &Plan| no_finer(other, &changed) && no_finer(&changed, other);
            let coarser = no_finer(&changed, finest) && !seen(finest);
            if coarser && !plans.iter().any(seen) {
                plans.push(changed);
            }
        }
        // Of one method, so each is finer than the one before.
        plans.sort_by(|a, b| match no_finer(a, b) {
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

impl Choice {
    /// How far heights move if the finest plan is changed so: 99 of 100 points by less, µm.
    pub fn influence(&mut self, change: impl FnOnce(&mut Plan)) -> Result<Option<f64>> {
        let mut plan = self.finest.clone();
        change(&mut plan);
        if plan.samples_per_side == 1 {
            plan.sampling = Sampling::Planes;
        }
        Ok(self.looked.errors(&plan)?.within_um)
    }
}

#[cfg(test)]
#[path = "search_tests.rs"]
mod tests;
