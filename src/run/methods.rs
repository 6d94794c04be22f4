//! Plans as others are measured against them, and as the scene names their methods.

use crate::frame::{Blur, Sampling};
use crate::laser::CUTOFF_RADII;
use crate::plan::Plan;
use crate::plan::accuracy::geometry_only;
use crate::scene::Scene;
use crate::speckle::lookup::Method;

/// Paths of the full model for each of a plan's: of their variance a quarter is left.
const PATHS: f64 = 4.0;

/// What others are measured against: every sample traced, at least twice as many as the
/// scene's rules or its plan ask for, to the end of the beam; and light that is reflected more than
/// once by [`PATHS`] times the plan's paths.
pub(crate) fn full(base: &Plan, plan: &Plan) -> Plan {
    let most = base.samples_per_side.max(plan.samples_per_side);
    Plan {
        geometry_only: false,
        sampling: Sampling::Rays,
        samples_per_side: (2 * most).max(8),
        cutoff_radii: CUTOFF_RADII,
        speckle_slips: plan.speckle_slips,
        reflections: plan.reflections.map(|planned| planned.times(PATHS)),
        ..base.clone()
    }
}

/// `plan` with the methods that the scene names.
pub(crate) fn named(scene: &Scene, mut plan: Plan) -> Plan {
    let methods = &scene.methods;
    plan.geometry_only = methods.geometry_only.unwrap_or(plan.geometry_only);
    if let Some(wanted) = methods.speckle {
        plan.speckle = scene.speckle.map(|s| s.method).filter(|_| wanted);
    }
    if let Some(wanted) = methods.noise {
        plan.noise = wanted && scene.camera.sensor.noise.is_some();
    }
    plan.blur = match methods.blur.unwrap_or(plan.blur) {
        Blur::Coherent if plan.speckle != Some(Method::Field) => Blur::Mean,
        blur => blur,
    };
    plan.speckle_slips = methods.speckle_slips.unwrap_or(plan.speckle_slips);
    plan.samples_per_side = methods.samples_per_side.unwrap_or(plan.samples_per_side);
    plan.sampling = methods.sampling.unwrap_or(plan.sampling);
    plan.cutoff_radii = methods.cutoff_radii.unwrap_or(plan.cutoff_radii);
    match plan.geometry_only {
        true => geometry_only(plan),
        false => plan,
    }
}
