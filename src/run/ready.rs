//! From a scene to a simulation: the hierarchy built and the plan chosen.

use super::control::{Control, Coverage};
use super::planner::scene_plan_with;
use super::simulation::{Simulation, plan};
use crate::accel::{Accel, Clusters};
use crate::error::Result;
use crate::mesh::Watch;
use crate::plan::Plan;
use crate::plan::accuracy::geometry_only;
use crate::scene::Scene;
use std::sync::Arc;

/// Builds the hierarchy a scene asks for; `watch` hears how far that is.
pub(crate) fn hierarchy(scene: &Scene, watch: &Watch) -> Result<Accel> {
    let threads = rayon::current_num_threads();
    Accel::build_with(scene.accel, &scene.mesh, threads, watch)?.with_copies(scene.copies.clone())
}

/// The same while `control` watches.
pub(crate) fn hierarchy_watched(scene: &Scene, control: &Control) -> Result<Accel> {
    hierarchy(scene, &|share| {
        if let Some(building) = control.building {
            building(share);
        }
        control.check()
    })
}

/// A simulation that traces what `coverage` says.
pub(crate) fn simulation(
    scene: &Scene,
    coverage: Coverage,
    control: &Control,
) -> Result<Simulation> {
    let accel = hierarchy_watched(scene, control)?;
    match coverage {
        Coverage::Footprint => Simulation::of_footprint(scene, accel),
        Coverage::Exhaustive => Simulation::of_everything(scene, accel),
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
    scene_plan_with(scene, &Arc::new(hierarchy(scene, &|_| Ok(()))?))
}

impl Simulation {
    /// Plans the scene and builds all that its frames share. Errors: too little memory, a
    /// failure of Embree. A tolerance that no plan keeps is no error: [`Plan::accuracy`] says so.
    pub fn new(scene: &Scene) -> Result<Simulation> {
        Simulation::of_footprint(scene, hierarchy(scene, &|_| Ok(()))?)
    }

    /// The same while `control` watches: `building` hears of the hierarchy, which takes most of
    /// the time. Errors: [`crate::Error::Interrupted`] too.
    pub fn watched(scene: &Scene, control: &Control) -> Result<Simulation> {
        simulation(scene, Coverage::Footprint, control)
    }

    pub(crate) fn of_footprint(scene: &Scene, accel: Accel) -> Result<Simulation> {
        let simulation = Simulation::of_everything(scene, accel)?;
        Ok(simulation.with_clusters(Arc::new(Clusters::new(&scene.mesh))))
    }

    /// One of another scene with the same part, whose hierarchy is shared.
    pub(crate) fn of_same_part(&self, scene: &Scene) -> Result<Simulation> {
        let plan = scene_plan_with(scene, &self.accel)?;
        let other = Simulation::with_plan(scene, self.accel.clone(), plan)?;
        Ok(other.with_clusters_of(self))
    }

    /// One that traces every sample, to the same bytes.
    #[doc(hidden)]
    pub fn exhaustive(scene: &Scene) -> Result<Simulation> {
        Simulation::of_everything(scene, hierarchy(scene, &|_| Ok(()))?)
    }

    pub(crate) fn of_everything(scene: &Scene, accel: Accel) -> Result<Simulation> {
        let accel = Arc::new(accel);
        let plan = scene_plan_with(scene, &accel)?;
        Simulation::with_plan(scene, accel, plan)
    }

    /// One that takes no images, only [`Self::geometric`] profiles of a line laser.
    #[doc(hidden)]
    pub fn geometry(scene: &Scene) -> Result<Simulation> {
        let accel = hierarchy(scene, &|_| Ok(()))?;
        Simulation::of_geometry(scene, accel)
    }

    pub(crate) fn of_geometry(scene: &Scene, accel: Accel) -> Result<Simulation> {
        let plan = geometry_only(plan(scene, &accel));
        Simulation::with_plan(scene, Arc::new(accel), plan)
    }
}
