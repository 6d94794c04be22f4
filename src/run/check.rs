//! What can be said of a scene before a scan.

use super::forecast::{Forecast, forecast_of};
use super::ready;
use super::reason::Warning;
use super::survey::MeasuringRange;
use super::warnings::{Foreseen, foreseen};
use super::{Control, Coverage};
use crate::error::Result;
use crate::plan::rules::Plan;
use crate::scene::Scene;
use serde::Serialize;
use std::time::Instant;

/// A scene's plan, what its scan takes, and what will spoil it.
#[derive(Debug, Serialize)]
pub struct Checked {
    /// Which effects are modelled, how and why.
    pub plan: Plan,
    /// Of the whole scan.
    pub forecast: Forecast,
    /// `null` if the camera sees nothing of the laser's light.
    pub measuring_range: Option<MeasuringRange>,
    /// Empty for a good scene.
    pub warnings: Vec<Warning>,
}

/// Plans a scene and looks along the whole path of its scan for what will spoil it.
///
/// # Errors
/// [`crate::error::Error::Memory`] if not even one frame fits; `control`'s.
pub fn check(scene: &Scene, control: &Control) -> Result<Checked> {
    let start = Instant::now();
    let simulation = ready::simulation(scene, Coverage::Footprint, control)?;
    let frames = 0..scene.scan.frames;
    let preparing = start.elapsed().as_secs_f64();
    let forecast = forecast_of(&simulation, &frames, preparing, control)?;
    let images = !simulation.plan.geometry_only;
    let Foreseen { range, warnings } = foreseen(scene, &simulation.accel, frames, images);
    Ok(Checked {
        plan: simulation.plan,
        forecast,
        measuring_range: range,
        warnings,
    })
}
