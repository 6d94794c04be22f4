//! From a scene to a simulation: the hierarchy built and the plan chosen.

use super::control::{Control, Coverage};
use super::planner::scene_plan_with;
use super::reflections;
use super::sensor_figures::PeakCounts;
use super::simulation::{Simulation, plan};
use super::survey::Survey;
use crate::accel::{Accel, Clusters};
use crate::error::Result;
use crate::mesh::Watch;
use crate::plan::Plan;
use crate::plan::accuracy::geometry_only;
use crate::scene::Scene;
use std::borrow::Cow;
use std::sync::Arc;

/// Builds the hierarchy a scene asks for; `watch` hears how far that is. The scene comes back with its
/// exposure set.
pub(crate) fn hierarchy<'a>(scene: &'a Scene, watch: &Watch) -> Result<(Cow<'a, Scene>, Accel)> {
    let threads = rayon::current_num_threads();
    let accel = Accel::build_with(scene.accel, &scene.mesh, threads, watch)?;
    let accel = accel.with_copies(scene.copies.clone())?;
    Ok((exposed(scene, &accel), accel))
}

/// The scene with the exposure that it leaves to the light: the line's middle reaches the scene's share of full
/// scale, without speckle and blur, in 95 of 100 places that the camera sees along the path, or less.
pub(crate) fn exposed<'a>(scene: &'a Scene, accel: &Accel) -> Cow<'a, Scene> {
    let Some(share) = scene.auto_exposure else {
        return Cow::Borrowed(scene);
    };
    let survey = Survey::of(scene, accel, 0..scene.scan.frames);
    // Without light any exposure does.
    let times =
        PeakCounts::of(scene, &survey).map_or(1.0, |light| share * light.full_scale / light.bright);
    let exposure_ms = scene.camera.sensor.exposure_ms * times.clamp(1e-9, 1e9);
    Cow::Owned(scene.exposed(exposure_ms))
}

/// The same while `control` watches.
pub(crate) fn hierarchy_watched<'a>(
    scene: &'a Scene,
    control: &Control,
) -> Result<(Cow<'a, Scene>, Accel)> {
    hierarchy(scene, &|share| control.prepared(share))
}

/// A simulation that traces what `coverage` says.
pub(crate) fn simulation(
    scene: &Scene,
    coverage: Coverage,
    control: &Control,
) -> Result<Simulation> {
    // Planning reflections takes seconds, as building large hierarchies does: each is half of what is shown.
    let building = if reflections::asked(scene) { 0.5 } else { 1.0 };
    let (scene, accel) = hierarchy(scene, &|share| control.prepared(building * share))?;
    let planning = |share| control.prepared(building + (1.0 - building) * share);
    match coverage {
        Coverage::Footprint => Simulation::of_footprint(&scene, accel, &planning),
        Coverage::Exhaustive => Simulation::of_everything(&scene, accel, &planning),
    }
}

/// The plan of a scene as a run will follow it; builds the hierarchy.
///
/// ```
/// use lasertrace::Scene;
///
/// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
/// let plan = lasertrace::run::scene_plan(&scene)?;
/// assert!(!plan.geometry_only && plan.speckle.is_none());
/// for effect in &plan.effects {
///     println!("{}: {} ({})", effect.effect.name(), effect.method, effect.why);
/// }
/// # Ok::<(), lasertrace::Error>(())
/// ```
pub fn scene_plan(scene: &Scene) -> Result<Plan> {
    let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
    scene_plan_with(&scene, &Arc::new(accel), &|_| Ok(()))
}

impl Simulation {
    /// Plans the scene and builds all that its frames share. Errors: too little memory, a
    /// failure of Embree. A tolerance that no plan keeps is no error: [`Plan::accuracy`] says so.
    pub fn new(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::of_footprint(&scene, accel, &|_| Ok(()))
    }

    /// The same while `control` watches: `building` hears of the hierarchy, and of the planning of reflections.
    /// Errors: [`crate::Error::Interrupted`] too.
    pub fn watched(scene: &Scene, control: &Control) -> Result<Simulation> {
        simulation(scene, Coverage::Footprint, control)
    }

    pub(crate) fn of_footprint(scene: &Scene, accel: Accel, watch: &Watch) -> Result<Simulation> {
        let simulation = Simulation::of_everything(scene, accel, watch)?;
        Ok(simulation.with_clusters(Arc::new(Clusters::new(&scene.mesh))))
    }

    /// One of another scene with the same part, whose hierarchy is shared.
    pub(crate) fn of_same_part(&self, scene: &Scene) -> Result<Simulation> {
        let scene = &exposed(scene, &self.accel);
        let plan = scene_plan_with(scene, &self.accel, &|_| Ok(()))?;
        let other = Simulation::with_plan(scene, self.accel.clone(), plan)?;
        Ok(other.with_clusters_of(self))
    }

    /// One that traces every sample, to the same bytes.
    #[doc(hidden)]
    pub fn exhaustive(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::of_everything(&scene, accel, &|_| Ok(()))
    }

    pub(crate) fn of_everything(scene: &Scene, accel: Accel, watch: &Watch) -> Result<Simulation> {
        let accel = Arc::new(accel);
        let plan = scene_plan_with(scene, &accel, watch)?;
        Simulation::with_plan(scene, accel, plan)
    }

    /// One that takes no images, only [`Self::geometric`] profiles of a line laser.
    #[doc(hidden)]
    pub fn geometry(scene: &Scene) -> Result<Simulation> {
        let (scene, accel) = hierarchy(scene, &|_| Ok(()))?;
        Simulation::of_geometry(&scene, accel)
    }

    pub(crate) fn of_geometry(scene: &Scene, accel: Accel) -> Result<Simulation> {
        let plan = geometry_only(plan(scene, &accel));
        Simulation::with_plan(scene, Arc::new(accel), plan)
    }
}
