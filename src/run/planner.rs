//! Plan of a scene: its rules, the methods it sets and, with a tolerance, the first sufficient rung
//! of the ladder.

use super::ladder::{PlanChoice, choose};
use super::methods::with_scene_overrides;
use super::reflections::SecondHitSurvey;
use super::simulation::plan;
use crate::accel::Accel;
use crate::error::Result;
use crate::frame::Sampling;
use crate::mesh::ProgressFn;
use crate::plan::accuracy::{PilotSample, geometry_only};
use crate::plan::display::to_text;
use crate::plan::height_error::quantile;
use crate::plan::rules::{Effect, EffectKind, ModelConfig};
use crate::scene::{ModelTable, Scene};
use crate::speckle::lookup::Method;
use std::sync::Arc;

const REASON_OVERRIDE: &str = "named in [model]";

/// Returns a plan without a tolerance, with effects that reflect the methods in the scene.
fn apply_overrides(methods: &ModelTable, mut plan: ModelConfig) -> ModelConfig {
    let mut list: Vec<Effect> = slip_named(methods).into_iter().collect();
    // Any method in the scene may change the blur.
    list.extend([plan.defocus_effect(), plan.diffraction_effect()]);
    let mut tell = |effect, modelled, method: &str| {
        list.push(Effect::new(
            effect,
            modelled,
            method.into(),
            REASON_OVERRIDE.into(),
        ));
    };
    if plan.geometry_only {
        tell(EffectKind::LineWidth, false, NO_WIDTH);
        tell(EffectKind::Speckle, false, "none");
    } else {
        if methods.speckle.is_some() {
            tell(
                EffectKind::Speckle,
                plan.speckle.is_some(),
                speckle_method(&plan),
            );
        }
        if methods.noise.is_some() {
            tell(EffectKind::SensorNoise, plan.noise, noise_method(&plan));
        }
        let ModelTable {
            samples_per_side,
            pixel_sampling: sampling,
            beam_cutoff_radii,
            ..
        } = methods;
        if samples_per_side.is_some() || sampling.is_some() || beam_cutoff_radii.is_some() {
            tell(EffectKind::PixelIntegration, true, &to_text(&plan));
        }
    }
    plan.effects
        .retain(|e| list.iter().all(|l| l.effect != e.effect));
    plan.effects.splice(0..0, list);
    plan
}

fn slip_named(methods: &ModelTable) -> Option<Effect> {
    let slips = methods.local_speckle_motion?;
    let method = if slips {
        "slips"
    } else {
        "moves with the surface"
    };
    Some(Effect::new(
        EffectKind::SpeckleOutOfFocus,
        slips,
        method.into(),
        REASON_OVERRIDE.into(),
    ))
}

const NO_WIDTH: &str = "laser rays without width";

fn speckle_method(plan: &ModelConfig) -> &'static str {
    match plan.speckle {
        Some(Method::Field) => "complex field of each frame",
        Some(Method::Trilinear) => "ring of intensities",
        None => "light taken as incoherent",
    }
}

fn noise_method(plan: &ModelConfig) -> &'static str {
    match plan.noise {
        true => "drawn for each pixel",
        false => "counts are the rounded expectation",
    }
}

/// Makes the plan of a scene with an existing hierarchy. `watch` is called with the progress of
/// planning indirect light.
pub(crate) fn scene_plan_with(
    scene: &Scene,
    accel: &Arc<Accel>,
    watch: &ProgressFn,
) -> Result<ModelConfig> {
    let base = plan(scene, accel);
    let again = SecondHitSurvey::of(scene, accel, &base)?;
    let (reflections, effect) = again.planned(scene, accel, &base, &|share| watch(share / 2.0))?;
    let (reflections, reflections_noise) = reflections.unzip();
    let base = ModelConfig {
        reflections,
        reflections_noise,
        ..base
    };
    let mut plan = select_plan(scene, accel, base, &|share| watch(0.5 + share / 2.0))?;
    // The effect is inserted before the motion effects.
    let motion = |e: &Effect| e.effect == EffectKind::ExposureMotion;
    let at = plan.effects.iter().position(motion);
    plan.effects
        .insert(at.unwrap_or(plan.effects.len()), effect);
    watch(1.0)?;
    Ok(plan)
}

/// Returns the plan for the scene's tolerance, or the plan of the rules without a tolerance.
fn select_plan(
    scene: &Scene,
    accel: &Arc<Accel>,
    base: ModelConfig,
    watch: &ProgressFn,
) -> Result<ModelConfig> {
    let Some(tolerance) = scene.tolerance_um else {
        return Ok(apply_overrides(
            &scene.methods,
            with_scene_overrides(scene, base),
        ));
    };
    let mut choice = choose(scene, accel, &base, tolerance, watch)?;
    let pilot = choice.pilot_strips.pilot()?;
    choice.plan.defocused_fraction = pilot
        .defocused_fraction()
        .unwrap_or(base.defocused_fraction);
    let effects = effects(scene, &mut choice, &pilot, &base)?;
    Ok(ModelConfig {
        effects,
        accuracy: Some(choice.accuracy),
        ..choice.plan
    })
}

/// Returns the effects of a scene, their influence on heights, and their methods.
fn effects(
    scene: &Scene,
    choice: &mut PlanChoice,
    pilot: &PilotSample,
    base: &ModelConfig,
) -> Result<Vec<Effect>> {
    let methods = &scene.methods;
    let plan = &choice.plan.clone();
    let mut list = List(Vec::new());
    list.randomness(scene, choice)?;
    let (method, why) = match plan.geometry_only {
        true => (NO_WIDTH, "no image is taken"),
        false => ("image", "bends, edges and shadows shape the line"),
    };
    let no_image = choice.influence(|finest| *finest = geometry_only(finest.clone()))?;
    let width = list.add(EffectKind::LineWidth, !plan.geometry_only, method, no_image);
    width.why = because(methods.geometry_only.is_some(), why);
    if !plan.geometry_only {
        list.image(methods, choice, plan)?;
    }
    let replaced = [EffectKind::Speckle, EffectKind::PixelIntegration];
    let others = base.effects.iter();
    let others = others.filter(|e| !replaced.contains(&e.effect));
    list.0.extend(others.cloned().map(|mut effect| {
        match effect.effect {
            EffectKind::Defocus => {
                effect = plan.defocus_effect();
                effect.height_effect_um = quantile(&pilot.defocus());
            }
            EffectKind::Diffraction => {
                effect = plan.diffraction_effect();
                effect.height_effect_um = quantile(&pilot.diffraction());
            }
            EffectKind::SpeckleOutOfFocus => return slip_named(methods).unwrap_or(effect),
            _ => {}
        }
        effect
    }));
    Ok(list.0)
}

fn because(named: bool, why: &str) -> String {
    match named {
        true => REASON_OVERRIDE.into(),
        false => why.into(),
    }
}

struct List(Vec<Effect>);

impl List {
    fn add(
        &mut self,
        effect: EffectKind,
        modelled: bool,
        method: &str,
        height_effect_um: Option<f64>,
    ) -> &mut Effect {
        self.0.push(Effect {
            height_effect_um,
            ..Effect::new(effect, modelled, method.to_owned(), String::new())
        });
        self.0.last_mut().expect("it was pushed")
    }

    fn randomness(&mut self, scene: &Scene, choice: &mut PlanChoice) -> Result<()> {
        let methods = &scene.methods;
        let plan = &choice.plan.clone();
        if scene.speckle.is_some() {
            let influence = choice.influence(|finest| {
                finest.speckle = None;
                finest.blur = finest.blur.without_field();
            })?;
            let modelled = plan.speckle.is_some();
            let speckle = self.add(
                EffectKind::Speckle,
                modelled,
                speckle_method(plan),
                influence,
            );
            let why = format!("grain {}", plan.grain);
            speckle.why = because(methods.speckle.is_some(), &why);
        }
        if scene.camera.sensor.noise.is_some() {
            let influence = choice.influence(|finest| finest.noise = false)?;
            let noise = self.add(
                EffectKind::SensorNoise,
                plan.noise,
                noise_method(plan),
                influence,
            );
            noise.why = because(methods.noise.is_some(), "shot noise and read noise");
        }
        Ok(())
    }

    /// Adds the effects of the imaging methods, with their residual errors.
    fn image(
        &mut self,
        methods: &ModelTable,
        choice: &mut PlanChoice,
        plan: &ModelConfig,
    ) -> Result<()> {
        let n = plan.samples_per_side;
        let method = format!("{n} × {n} samples a pixel");
        let left = choice.influence(|finest| finest.samples_per_side = n)?;
        self.add(EffectKind::PixelIntegration, true, &method, left)
            .why = because(methods.samples_per_side.is_some(), "what these still leave");
        let (modelled, method) = match plan.sampling {
            Sampling::Rays => (true, "a ray for each sample"),
            Sampling::PlaneCut => (true, "exact rows of every facet"),
            Sampling::Planes if n == 1 => (false, "1 ray a pixel"),
            Sampling::Planes => (false, "flat between pixels, rays at edges"),
        };
        let left = choice.influence(|finest| finest.sampling = plan.sampling)?;
        self.add(EffectKind::SurfaceWithinPixel, modelled, method, left)
            .why = because(
            methods.pixel_sampling.is_some(),
            "what facets that bend leave",
        );
        let method = format!("dark beyond {:.2} beam radii", plan.beam_cutoff_radii);
        let left = choice.influence(|finest| finest.beam_cutoff_radii = plan.beam_cutoff_radii)?;
        self.add(EffectKind::LightFarFromLine, false, &method, left)
            .why = because(methods.beam_cutoff_radii.is_some(), "what that cuts off");
        Ok(())
    }
}
