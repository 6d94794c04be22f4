//! Fast simulation of one frame of a scene that is being edited.

use super::error_model::camera_from_laser;
use super::methods::with_scene_overrides;
use super::setup::with_auto_exposure;
use super::simulation::{Simulation, optics, patterns, plan_for};
use crate::error::{Error, Result};
use crate::plan::visible_line::VisibleLine;
use crate::scene::Scene;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

impl Simulation {
    /// Builds a simulation of another scene with this part, for one frame.
    ///
    /// The plan follows from the rules for the surface in this frame, without the ladder for the
    /// cheapest plan. The error model is copied from this simulation, because its computation takes
    /// longer than a frame.
    ///
    /// Errors: [`Error::Interrupted`] once `stop` is set. `stop` also cancels frames of the
    /// simulation.
    pub(crate) fn preview(
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
        let scene = &with_auto_exposure(scene, &self.accel);
        let camera_from_laser = camera_from_laser(scene);
        let optics = optics(scene, &camera_from_laser);
        let part_from_laser = scene.part_from_head(frame) * scene.head_from_laser;
        check_stop()?;
        let seen = VisibleLine::along(&optics, &self.accel, 1, |_| part_from_laser);
        let plan = with_scene_overrides(scene, plan_for(scene, seen));
        check_stop()?;
        let (accel, errors) = (self.accel.clone(), self.errors.clone());
        let speckle = patterns(scene, &accel, &plan)?;
        let mut other = Simulation::with_patterns(scene, accel, plan, speckle, errors);
        other.stop = Some(stop.clone());
        other.column_correlation = OnceLock::from(self.column_correlation().to_vec());
        Ok(other.with_clusters_of(self))
    }
}
