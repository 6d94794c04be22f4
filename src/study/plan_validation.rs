//! Comparison of a plan for a tolerance with the reference model.

use crate::accel::TriangleClusters;
use crate::error::Result;
use crate::plan::rules::ModelConfig;
use crate::profile::Peak;
use crate::run::Simulation;
use crate::run::height_errors::HeightErrors;
use crate::run::methods::reference_config;
use crate::run::planner::scene_plan_with;
use crate::run::setup::hierarchy;
use crate::scene::Scene;
use serde::Serialize;
use std::sync::Arc;
use std::time::Instant;

/// Verification of a plan against its tolerance.
#[derive(Debug, Clone, Serialize)]
pub struct PlanValidation {
    /// Verified plan.
    pub plan: ModelConfig,
    /// Evaluated frames: the requested frames that were not used to choose the plan.
    pub frames: Vec<u32>,
    /// Height errors in these frames, relative to the reference model with the plan's light paths
    /// for indirect light.
    pub error: HeightErrors,
    /// Fraction of points whose error exceeds the tolerance, or that only one of the two models
    /// detects.
    pub beyond: f64,
    /// Fraction as in `beyond`, relative to the reference model with many more paths; `None` if the
    /// plan traces no indirect light.
    pub beyond_of_paths: Option<f64>,
    /// Times of the reference model, of the scene without a tolerance, and of the plan, for all
    /// these frames, ms. Only pixels near the line are traced. The exception is the reference model
    /// of metal and paint, whose light may fall elsewhere.
    pub ms: [f64; 3],
}

/// Compares the plan of a scene with a tolerance to the reference model. Frames from which the plan
/// was chosen are excluded, unless no frames would remain.
pub fn validate_plan(scene: &Scene, frames: &[u32]) -> Result<PlanValidation> {
    let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
    let (scene, accel) = (&*scene, Arc::new(accel));
    let plan = scene_plan_with(scene, &accel, &|_| Ok(()))?;
    let base = ModelConfig {
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
    let clusters = Arc::new(TriangleClusters::new(&scene.mesh));
    let glossy = scene.surface.glossy().next().is_some();
    let run = |plan: &ModelConfig, everywhere: bool| {
        let mut simulation = Simulation::with_plan(scene, accel.clone(), plan.clone())?;
        if !everywhere {
            simulation = simulation.with_clusters(clusters.clone());
        }
        let start = Instant::now();
        let peaks: Vec<Vec<Peak>> = frames.iter().map(|&f| simulation.frame_peaks(f)).collect();
        Result::Ok((peaks, start.elapsed().as_secs_f64() * 1e3, simulation))
    };
    let most = reference_config(&base, &plan);
    let same_paths = ModelConfig {
        reflections: plan.reflections,
        ..most.clone()
    };
    let full = run(&same_paths, glossy)?;
    let (without, planned) = (run(&base, false)?, run(&plan, false)?);
    let against = |truth: Vec<Vec<Peak>>| {
        let pairs: Vec<_> = planned.0.iter().cloned().zip(truth).collect();
        HeightErrors::of(&pairs, &planned.2.calibration, 1.0)
    };
    let target_error_um = plan.accuracy.as_ref().map_or(0.0, |a| a.target_error_um);
    let beyond_of_paths = match plan.reflections {
        None => None,
        Some(_) => Some(against(run(&most, glossy)?.0).share_beyond(target_error_um)),
    };
    let error = against(full.0);
    Ok(PlanValidation {
        frames,
        beyond: error.share_beyond(target_error_um),
        error,
        beyond_of_paths,
        ms: [full.1, without.1, planned.1],
        plan,
    })
}
