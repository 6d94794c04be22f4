//! Validation of the accuracy and plan tables: height tolerance and named methods.

use super::file::{AccuracyTable, ModelTable};
use super::resolver::Resolver;
use crate::error::Result;
use crate::frame::Blur;
use crate::laser::CUTOFF_RADII;
use crate::plan::rules::{MAX_REFLECTIONS, MAX_SAMPLES_PER_SIDE};

impl Resolver<'_> {
    pub(super) fn tolerance(&self, table: &AccuracyTable) -> Result<Option<f64>> {
        let tolerance = table.max_height_error_um;
        tolerance.map_or(Ok(0.0), |t| {
            self.positive(t, "accuracy.max_height_error_um")
        })?;
        Ok(tolerance)
    }

    /// Validates the methods. `images`: the scene writes frames. `line`: the laser is a line laser.
    /// `by_field`: speckle uses the field method.
    pub(super) fn methods(
        &self,
        table: &ModelTable,
        (images, line): (bool, bool),
        by_field: bool,
    ) -> Result<ModelTable> {
        let samples = table.samples_per_side.unwrap_or(1);
        self.check(
            (1..=MAX_SAMPLES_PER_SIDE).contains(&samples),
            "model.samples_per_side",
            "from 1 to 16",
        )?;
        let radii = table.beam_cutoff_radii.unwrap_or(CUTOFF_RADII);
        self.check(
            (1.0..=CUTOFF_RADII).contains(&radii),
            "model.beam_cutoff_radii",
            "a number from 1 to 4",
        )?;
        self.check(
            (1..=MAX_REFLECTIONS).contains(&table.max_bounces.unwrap_or(1)),
            "model.max_bounces",
            "from 1 to 64",
        )?;
        self.check(
            by_field || table.local_speckle_motion != Some(true),
            "model.local_speckle_motion",
            "false: it takes speckle by field",
        )?;
        self.check(
            by_field || table.defocus_model != Some(Blur::Coherent),
            "model.defocus_model",
            "\"none\" or \"incoherent\": \"coherent\" takes speckle by field",
        )?;
        if table.geometry_only == Some(true) {
            self.check(
                line && !images,
                "model.geometry_only",
                "false: it takes a line laser (laser.line) and no save_images",
            )?;
        }
        Ok(table.clone())
    }
}
