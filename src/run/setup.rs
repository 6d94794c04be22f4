//! Builds simulations from scenes: builds the hierarchy and chooses the plan.

use super::control::{RunControl, TraceMode};
use super::light_survey::LightSurvey;
use super::planner::scene_plan_with;
use super::sensor_figures::PeakCounts;
use super::simulation::{Simulation, plan};
use crate::accel::{Accel, TriangleClusters};
use crate::error::Result;
use crate::math::Rigid;
use crate::mesh::ProgressFn;
use crate::plan::ModelConfig;
use crate::plan::accuracy::geometry_only;
use crate::scene::Scene;
use std::borrow::Cow;
use std::sync::Arc;

/// Builds the hierarchy that a scene requires and returns the scene with its exposure set. `watch`
/// is called with the progress. Errors: a scene of several cameras.
pub(crate) fn hierarchy<'a>(
    scene: &'a Scene,
    watch: &ProgressFn,
) -> Result<(Cow<'a, Scene>, Accel)> {
    scene.require_one_camera()?;
    let threads = rayon::current_num_threads();
    let accel = Accel::build_with(scene.accel, &scene.mesh, threads, watch)?;
    let mut accel = accel.with_copies(scene.copies.clone())?;
    if let Some(nominal) = &scene.nominal {
        let poses = scene.copies.iter();
        let poses: Vec<Rigid> = poses
            .map(|&pose| pose * nominal.part_from_nominal)
            .collect();
        let of_mesh = Accel::build_with(scene.accel, &nominal.mesh, threads, &|_| Ok(()))?;
        accel = accel.with_nominal(of_mesh.with_copies(poses)?);
    }
    Ok((with_auto_exposure(scene, &accel), accel))
}

/// Returns the scene with automatic exposure resolved. At 95 % of the positions that the camera
/// sees along the path, the line's centre then reaches at most the scene's fraction of full scale.
/// The light is computed without speckle and blur.
pub(crate) fn with_auto_exposure<'a>(scene: &'a Scene, accel: &Accel) -> Cow<'a, Scene> {
    let Some(share) = scene.auto_exposure else {
        return Cow::Borrowed(scene);
    };
    let survey = LightSurvey::of(scene, accel, 0..scene.scan.frames);
    // Without light the exposure has no effect.
    let times =
        PeakCounts::of(scene, &survey).map_or(1.0, |light| share * light.full_scale / light.bright);
    let exposure_ms = scene.camera.sensor.exposure_ms * times.clamp(1e-9, 1e9);
    Cow::Owned(scene.with_exposure(exposure_ms))
}

/// Builds the hierarchy of a scene and reports the progress to `control`.
pub(crate) fn hierarchy_watched<'a>(
    scene: &'a Scene,
    control: &RunControl,
) -> Result<(Cow<'a, Scene>, Accel)> {
    hierarchy(scene, &|share| control.prepared(share))
}

/// Builds a simulation that traces the pixels selected by `coverage`.
pub(crate) fn simulation(
    scene: &Scene,
    coverage: TraceMode,
    control: &RunControl,
) -> Result<Simulation> {
    // Planning of indirect light takes seconds, like building a large hierarchy. Each counts as
    // half of the displayed progress.
    let building = if scene.considers_indirect_light() {
        0.5
    } else {
        1.0
    };
    let (scene, accel) = hierarchy(scene, &|share| control.prepared(building * share))?;
    let planning = |share| control.prepared(building + (1.0 - building) * share);
    match coverage {
        TraceMode::Footprint => Simulation::with_footprint(&scene, accel, &planning),
        TraceMode::Exhaustive => Simulation::tracing_all_pixels(&scene, accel, &planning),
    }
}

/// Returns the plan of a scene that a run will follow. Builds the hierarchy.
///
/// ```
/// use lasertrace::Scene;
///
/// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
/// let model = lasertrace::run::scene_plan(&scene)?;
/// assert!(!model.geometry_only && model.speckle.is_none());
/// for effect in &model.effects {
///     println!("{}: {} ({})", effect.effect.name(), effect.method, effect.why);
/// }
/// # Ok::<(), lasertrace::Error>(())
/// ```
pub fn scene_plan(scene: &Scene) -> Result<ModelConfig> {
    let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
    scene_plan_with(&scene, &Arc::new(accel), &|_| Ok(()))
}

impl Simulation {
    /// Plans the scene and builds the data that its frames have in common.
    ///
    /// Errors: too little memory, or a failure of Embree. A tolerance that no plan satisfies is not
    /// an error; [`ModelConfig::accuracy`] reports it.
    pub fn new(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::with_footprint(&scene, accel, &|_| Ok(()))
    }

    /// Plans and builds like [`Self::new`], under the control of `control`. Its `building` is
    /// called with the progress of the hierarchy and of planning indirect light. Errors also
    /// include [`crate::Error::Interrupted`].
    pub fn watched(scene: &Scene, control: &RunControl) -> Result<Simulation> {
        simulation(scene, TraceMode::Footprint, control)
    }

    pub(crate) fn with_footprint(
        scene: &Scene,
        accel: Accel,
        watch: &ProgressFn,
    ) -> Result<Simulation> {
        let simulation = Simulation::tracing_all_pixels(scene, accel, watch)?;
        Ok(simulation.with_clusters(Arc::new(TriangleClusters::new(&scene.mesh))))
    }

    /// Builds a simulation of another scene with this part. Both use one hierarchy.
    pub(crate) fn reusing_part(&self, scene: &Scene) -> Result<Simulation> {
        let scene = &with_auto_exposure(scene, &self.accel);
        let plan = scene_plan_with(scene, &self.accel, &|_| Ok(()))?;
        let other = Simulation::with_plan(scene, self.accel.clone(), plan)?;
        Ok(other.with_clusters_of(self))
    }

    /// Builds a simulation that traces every sample. Its output is byte-identical.
    #[doc(hidden)]
    pub fn exhaustive(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::tracing_all_pixels(&scene, accel, &|_| Ok(()))
    }

    pub(crate) fn tracing_all_pixels(
        scene: &Scene,
        accel: Accel,
        watch: &ProgressFn,
    ) -> Result<Simulation> {
        let accel = Arc::new(accel);
        let plan = scene_plan_with(scene, &accel, watch)?;
        Simulation::with_plan(scene, accel, plan)
    }

    /// Builds a simulation without images, only with [`Self::geometric`] profiles of a line laser.
    #[doc(hidden)]
    pub fn geometry(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::geometry_only(&scene, accel)
    }

    pub(crate) fn geometry_only(scene: &Scene, accel: impl Into<Arc<Accel>>) -> Result<Simulation> {
        let accel = accel.into();
        let plan = geometry_only(plan(scene, &accel));
        Simulation::with_plan(scene, accel, plan)
    }
}
