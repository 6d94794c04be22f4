//! What a scene says of how well it is to be simulated: a tolerance, and methods by
//! name.

use super::resolve::Resolver;
use crate::accel::Backend;
use crate::error::Result;
use crate::integrator::Sampling;
use crate::integrator::plan::MAX_SAMPLES_PER_SIDE;
use crate::laser::CUTOFF_RADII;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How far results may be from those of the full model. Without it nothing that the
/// scene asks for is left out.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AccuracyTable {
    /// Greatest error of height, µm, that the simulation may add in 99 of 100 points:
    /// what moves heights by less is left out, and the cheapest methods that are good
    /// enough are taken.
    pub height_um: Option<f64>,
}

/// Methods to use whatever the plan would choose. Default: the plan chooses.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanTable {
    /// Profiles from laser rays and what the camera sees of them, without images.
    pub geometry_only: Option<bool>,
    /// Whether speckle is modelled if the scene has it.
    pub speckle: Option<bool>,
    /// Whether the pattern moves with each place of the surface, which slips out of focus
    /// and turns, or with the middle of the view; takes speckle by field.
    pub speckle_slips: Option<bool>,
    /// Whether the sensor's noise is modelled if the scene has it.
    pub noise: Option<bool>,
    /// Samples along each side of a pixel, 1 to 16.
    pub samples_per_side: Option<u32>,
    /// Where the samples of a pixel come from: `planes` (one ray where the surface is
    /// flat) or `rays` (one for each).
    pub sampling: Option<Sampling>,
    /// Beam radii at which light is taken to end, 1 to 4.
    pub cutoff_radii: Option<f64>,
    /// What finds the triangles rays meet.
    pub accel: Option<Backend>,
}

impl Resolver<'_> {
    pub(super) fn tolerance(&self, table: &AccuracyTable) -> Result<Option<f64>> {
        let tolerance = table.height_um;
        tolerance.map_or(Ok(0.0), |t| self.positive(t, "accuracy.height_um"))?;
        Ok(tolerance)
    }

    /// `images`: the scene asks for files of frames; `line`: its laser has a fan;
    /// `by_field`: speckle is read by field.
    pub(super) fn methods(
        &self,
        table: &PlanTable,
        (images, line): (bool, bool),
        by_field: bool,
    ) -> Result<PlanTable> {
        let samples = table.samples_per_side.unwrap_or(1);
        self.check(
            (1..=MAX_SAMPLES_PER_SIDE).contains(&samples),
            "plan.samples_per_side",
            "from 1 to 16",
        )?;
        let radii = table.cutoff_radii.unwrap_or(CUTOFF_RADII);
        self.check(
            (1.0..=CUTOFF_RADII).contains(&radii),
            "plan.cutoff_radii",
            "a number from 1 to 4",
        )?;
        self.check(
            by_field || table.speckle_slips != Some(true),
            "plan.speckle_slips",
            "false: it takes speckle by field",
        )?;
        if table.geometry_only == Some(true) {
            self.check(
                line && !images,
                "plan.geometry_only",
                "false: it takes a line laser (laser.line) and no write_frames",
            )?;
        }
        Ok(table.clone())
    }
}
