//! The plan of a scene: what its rules ask, what it names, and with a tolerance the
//! cheapest that keeps it.

use super::pilot::pilot;
use super::simulation::{hierarchy, plan};
use crate::accel::Accel;
use crate::error::Result;
use crate::integrator::accuracy::{HeightError, Pilot, candidates, quantile};
use crate::integrator::plan::Effect;
use crate::integrator::{Plan, Sampling};
use crate::laser::CUTOFF_RADII;
use crate::scene::Scene;
use crate::speckle::lookup::Method;
use std::sync::Arc;

/// The plan of a scene as a run will follow it; with a tolerance builds the hierarchy.
pub fn scene_plan(scene: &Scene) -> Result<Plan> {
    match scene.tolerance_um {
        None => Ok(named(scene, plan(scene))),
        Some(_) => scene_plan_with(scene, &Arc::new(hierarchy(scene, &|_| Ok(()))?)),
    }
}

/// What others are measured against: every sample traced, at least twice as many as
/// asked for, to the end of the beam.
pub(super) fn full(base: &Plan) -> Plan {
    Plan {
        geometry_only: false,
        sampling: Sampling::Rays,
        samples_per_side: (2 * base.samples_per_side).max(8),
        cutoff_radii: CUTOFF_RADII,
        ..base.clone()
    }
}

pub(super) fn geometry_only(base: Plan) -> Plan {
    Plan {
        geometry_only: true,
        speckle: None,
        noise: false,
        ..base
    }
}

/// `plan` with the methods that the scene names.
fn named(scene: &Scene, mut plan: Plan) -> Plan {
    let methods = &scene.methods;
    plan.geometry_only = methods.geometry_only.unwrap_or(plan.geometry_only);
    if let Some(wanted) = methods.speckle {
        plan.speckle = scene.speckle.map(|s| s.method).filter(|_| wanted);
    }
    if let Some(wanted) = methods.noise {
        plan.noise = wanted && scene.camera.sensor.noise.is_some();
    }
    plan.samples_per_side = methods.samples_per_side.unwrap_or(plan.samples_per_side);
    plan.sampling = methods.sampling.unwrap_or(plan.sampling);
    plan.cutoff_radii = methods.cutoff_radii.unwrap_or(plan.cutoff_radii);
    match plan.geometry_only {
        true => geometry_only(plan),
        false => plan,
    }
}

/// The same over a hierarchy that is there.
pub(super) fn scene_plan_with<'s>(scene: &'s Scene, accel: &Arc<Accel<'s>>) -> Result<Plan> {
    let base = plan(scene);
    let Some(tolerance) = scene.tolerance_um else {
        return Ok(named(scene, base));
    };
    let geometry = scene.laser.fan.is_some() && !scene.write_frames;
    let plans = candidates(
        &base,
        geometry && scene.methods.geometry_only != Some(false),
    );
    let plans: Vec<Plan> = plans.into_iter().map(|plan| named(scene, plan)).collect();
    let pilot = pilot(scene, accel, &base, &plans)?;
    let (mut plan, accuracy) = pilot.choose(plans, tolerance);
    plan.effects = effects(scene, &pilot, &base, &plan);
    plan.accuracy = Some(accuracy);
    Ok(plan)
}

/// How a choice was made: the method, and the tolerance or the scene.
fn effects(scene: &Scene, pilot: &Pilot, base: &Plan, plan: &Plan) -> Vec<Effect> {
    let [speckle_ms, noise_ms] = pilot.cost_of_randomness_ms(plan);
    let because = |name: Option<bool>, share: &str| match name {
        Some(_) => "named in [plan]".to_owned(),
        None => share.to_owned(),
    };
    let mut effects = Vec::new();
    let mut add = |effect, modelled, method: &str, why: String, errors: Vec<HeightError>, cost| {
        effects.push(Effect {
            influence_um: quantile(&errors),
            cost_ms: cost,
            ..Effect::new(effect, modelled, method.to_owned(), why)
        });
    };
    let left_out = "left out";
    if scene.speckle.is_some() {
        let method = match plan.speckle {
            Some(Method::Field) => "complex field of each frame",
            Some(Method::Trilinear) => "ring of intensities",
            Some(Method::Prefiltered { .. }) => "ring integrated over pixels",
            None => left_out,
        };
        let why = format!("grain {:.2} px", plan.speckle_size_px);
        let why = because(scene.methods.speckle, &why);
        add(
            "speckle",
            plan.speckle.is_some(),
            method,
            why,
            pilot.speckle(),
            Some(speckle_ms),
        );
    }
    if scene.camera.sensor.noise.is_some() {
        let method = if plan.noise {
            "drawn for each pixel"
        } else {
            left_out
        };
        let why = because(scene.methods.noise, "shot noise, read noise");
        add(
            "sensor noise",
            plan.noise,
            method,
            why,
            pilot.noise(),
            Some(noise_ms),
        );
    }
    let image = Plan {
        geometry_only: false,
        ..plan.clone()
    };
    let (method, why) = match plan.geometry_only {
        true => ("laser rays without width", "no image is taken"),
        false => ("image", "bends, edges and shadows shape the line"),
    };
    let why = because(scene.methods.geometry_only, why);
    let cost = pilot.cost_ms(&image);
    add(
        "width of the line",
        !plan.geometry_only,
        method,
        why,
        pilot.geometry(),
        Some(cost),
    );
    if !plan.geometry_only {
        let n = plan.samples_per_side;
        let method = format!("{n} × {n} samples a pixel");
        let why = because(
            scene.methods.samples_per_side.map(|_| true),
            "what these still leave",
        );
        add(
            "pixel integration",
            true,
            &method,
            why,
            pilot.samples(plan),
            None,
        );
        let (modelled, method, why) = match plan.sampling {
            Sampling::Rays => (true, "a ray for each sample", ""),
            Sampling::Planes if n == 1 => (false, "1 ray a pixel", ""),
            Sampling::Planes => (
                false,
                "flat between pixels, rays at edges",
                "facets that bend",
            ),
        };
        let why = because(scene.methods.sampling.map(|_| true), why);
        add(
            "surface within a pixel",
            modelled,
            method,
            why,
            pilot.planes(plan),
            None,
        );
        let method = format!("dark beyond {:.2} beam radii", plan.cutoff_radii);
        let why = because(
            scene.methods.cutoff_radii.map(|_| true),
            "what that cuts off",
        );
        add(
            "light far from the line",
            false,
            &method,
            why,
            pilot.cutoff(plan),
            None,
        );
    }
    let replaced = ["speckle", "pixel integration"];
    let others = base
        .effects
        .iter()
        .filter(|e| !replaced.contains(&e.effect));
    effects.extend(others.cloned());
    effects
}
