//! What can be said of a scene before a scan.

use super::Control;
use super::planner::scene_plan_with;
use super::reason::Warning;
use super::warnings::{Foreseen, foreseen};
use crate::error::Result;
use crate::integrator::Plan;
use crate::scene::Scene;
use serde::Serialize;
use std::sync::Arc;

/// A scene's plan, and what will spoil its scan.
#[derive(Debug, Serialize)]
pub struct Checked {
    pub plan: Plan,
    /// `null` if the camera sees nothing of the laser's light.
    pub measuring_range: Option<MeasuringRange>,
    /// Empty for a good scene.
    pub warnings: Vec<Warning>,
}

/// Where the camera sees the laser's light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeasuringRange {
    /// Least and greatest distance from the laser along the beam, mm.
    pub near_mm: f64,
    pub far_mm: f64,
    /// Width in its middle, mm.
    pub width_mm: f64,
}

/// Plans a scene and looks along the whole path of its scan for what will spoil it.
pub fn check(scene: &Scene, control: &Control) -> Result<Checked> {
    let accel = Arc::new(control.hierarchy(scene)?);
    let plan = scene_plan_with(scene, &accel)?;
    let frames = 0..scene.scan.frames;
    let Foreseen { range, warnings } = foreseen(scene, &accel, frames, !plan.geometry_only);
    Ok(Checked {
        plan,
        measuring_range: range,
        warnings,
    })
}
