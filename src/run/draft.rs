//! One frame of a scene whose values change, as soon as may be.

use super::error_model::camera_from_laser;
use super::methods::named;
use super::ready::exposed;
use super::simulation::{Simulation, optics, patterns, plan_for};
use crate::error::{Error, Result};
use crate::plan::in_view::InView;
use crate::scene::Scene;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

impl Simulation {
    /// One of another scene with the same part, to look at one frame. Its plan is made by the rules for what that
    /// frame shows, without the search for the cheapest one; and what it states of errors is what this simulation
    /// states: to work that out takes longer than a frame. Errors: [`Error::Interrupted`] once `stop` is set, which also
    /// ends the simulation's frames.
    pub(crate) fn draft(
        &self,
        scene: &Scene,
        frame: u32,
        stop: &Arc<AtomicBool>,
    ) -> Result<Simulation> {
        let check_stop = || match stop.load(Ordering::Relaxed) {
            true => Err(Error::Interrupted),
            false => Ok(()),
        };
        check_stop()?;
        let scene = &exposed(scene, &self.accel);
        let camera_from_laser = camera_from_laser(scene);
        let optics = optics(scene, &camera_from_laser);
        let part_from_laser = scene.part_from_head(frame) * scene.head_from_laser;
        check_stop()?;
        let seen = InView::along(&optics, &self.accel, 1, |_| part_from_laser);
        let plan = named(scene, plan_for(scene, seen));
        check_stop()?;
        let (accel, errors) = (self.accel.clone(), self.errors.clone());
        let speckle = patterns(scene, &accel, &plan)?;
        let mut other = Simulation::with_patterns(scene, accel, plan, speckle, errors);
        other.stop = Some(stop.clone());
        other.column_correlation = OnceLock::from(self.column_correlation().to_vec());
        Ok(other.with_clusters_of(self))
    }
}
