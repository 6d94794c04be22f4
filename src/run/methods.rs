//! The reference model, and plans with the methods that the scene sets.

use crate::frame::{Blur, Sampling};
use crate::laser::CUTOFF_RADII;
use crate::plan::ModelConfig;
use crate::plan::accuracy::geometry_only;
use crate::scene::Scene;
use crate::speckle::lookup::Method;

/// Ratio of the number of paths in the reference model to that in the plan. It reduces the variance
/// to one quarter.
const PATHS: f64 = 4.0;

/// Returns the reference model. Every sample is traced, up to the cutoff radius of the beam. The
/// number of samples per side is at least twice the larger of `base` and `plan`. Indirect light
/// uses [`PATHS`] times the paths of the plan.
pub(crate) fn reference_config(base: &ModelConfig, plan: &ModelConfig) -> ModelConfig {
    let most = base.samples_per_side.max(plan.samples_per_side);
    ModelConfig {
        geometry_only: false,
        sampling: Sampling::Rays,
        samples_per_side: (2 * most).max(8),
        beam_cutoff_radii: CUTOFF_RADII,
        local_speckle_motion: plan.local_speckle_motion,
        reflections: plan.reflections.map(|planned| planned.scaled(PATHS)),
        ..base.clone()
    }
}

/// Returns `plan` with the methods that the scene sets.
pub(crate) fn with_scene_overrides(scene: &Scene, mut plan: ModelConfig) -> ModelConfig {
    let methods = &scene.methods;
    plan.geometry_only = methods.geometry_only.unwrap_or(plan.geometry_only);
    if let Some(wanted) = methods.speckle {
        plan.speckle = scene.speckle.map(|s| s.method).filter(|_| wanted);
    }
    if let Some(wanted) = methods.noise {
        plan.noise = wanted && scene.camera.sensor.noise.is_some();
    }
    plan.blur = match methods.defocus_model.unwrap_or(plan.blur) {
        Blur::Coherent if plan.speckle != Some(Method::Field) => Blur::Mean,
        blur => blur,
    };
    plan.local_speckle_motion = methods
        .local_speckle_motion
        .unwrap_or(plan.local_speckle_motion);
    plan.samples_per_side = methods.samples_per_side.unwrap_or(plan.samples_per_side);
    plan.sampling = methods.pixel_sampling.unwrap_or(plan.sampling);
    plan.beam_cutoff_radii = methods.beam_cutoff_radii.unwrap_or(plan.beam_cutoff_radii);
    match plan.geometry_only {
        true => geometry_only(plan),
        false => plan,
    }
}
