//! A plan for a tolerance held against the full model.

use crate::accel::Clusters;
use crate::error::Result;
use crate::plan::rules::Plan;
use crate::profile::Peak;
use crate::run::Simulation;
use crate::run::height_errors::HeightErrors;
use crate::run::methods::full;
use crate::run::planner::scene_plan_with;
use crate::run::ready::hierarchy;
use crate::scene::Scene;
use serde::Serialize;
use std::sync::Arc;
use std::time::Instant;

/// Whether a plan does what it promised.
#[derive(Debug, Clone, Serialize)]
pub struct Kept {
    /// The plan that was judged.
    pub plan: Plan,
    /// Frames taken: those of the ones asked for that the plan was not made from.
    pub frames: Vec<u32>,
    /// Against the full model, over these: its light reflected more than once follows the plan's own paths.
    pub error: HeightErrors,
    /// Share of points off by more than was planned for, or found by one of the two only.
    pub beyond: f64,
    /// The same against the full model with many times the paths; `None` if the plan follows none.
    pub beyond_of_paths: Option<f64>,
    /// Times of the full model, of the scene without a tolerance, and of the plan, ms for all these frames; at
    /// the line's pixels alone, but of the full model of metal and paint, whose light may lie elsewhere.
    pub ms: [f64; 3],
}

/// Holds the plan of a scene with a tolerance against the full model, in those of `frames`
/// that it was not made from, or in all of them if it was made from all.
pub fn keeps_word(scene: &Scene, frames: &[u32]) -> Result<Kept> {
    let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
    let (scene, accel) = (&*scene, Arc::new(accel));
    let plan = scene_plan_with(scene, &accel, &|_| Ok(()))?;
    let base = Plan {
        reflections: plan.reflections,
        ..crate::run::simulation::plan(scene, &accel)
    };
    let seen = plan.accuracy.as_ref().map(|a| a.pilot_frames.clone());
    let seen = seen.unwrap_or_default();
    let unseen = frames.iter().copied().filter(|frame| !seen.contains(frame));
    let unseen: Vec<u32> = unseen.collect();
    let frames = if unseen.is_empty() {
        frames.to_vec()
    } else {
        unseen
    };
    let clusters = Arc::new(Clusters::new(&scene.mesh));
    let glossy = scene.surface.glossy().next().is_some();
    let run = |plan: &Plan, everywhere: bool| {
        let mut simulation = Simulation::with_plan(scene, accel.clone(), plan.clone())?;
        if !everywhere {
            simulation = simulation.with_clusters(clusters.clone());
        }
        let start = Instant::now();
        let peaks: Vec<Vec<Peak>> = frames.iter().map(|&f| simulation.frame_peaks(f)).collect();
        Result::Ok((peaks, start.elapsed().as_secs_f64() * 1e3, simulation))
    };
    let most = full(&base, &plan);
    let same_paths = Plan {
        reflections: plan.reflections,
        ..most.clone()
    };
    let full = run(&same_paths, glossy)?;
    let (without, planned) = (run(&base, false)?, run(&plan, false)?);
    let against = |truth: Vec<Vec<Peak>>| {
        let pairs: Vec<_> = planned.0.iter().cloned().zip(truth).collect();
        HeightErrors::of(&pairs, &planned.2.calibration, 1.0)
    };
    let planned_um = plan.accuracy.as_ref().map_or(0.0, |a| a.planned_um);
    let beyond_of_paths = match plan.reflections {
        None => None,
        Some(_) => Some(against(run(&most, glossy)?.0).share_beyond(planned_um)),
    };
    let error = against(full.0);
    Ok(Kept {
        frames,
        beyond: error.share_beyond(planned_um),
        error,
        beyond_of_paths,
        ms: [full.1, without.1, planned.1],
        plan,
    })
}
