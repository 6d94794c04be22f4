//! Requirements of a height tolerance: pilot data.

pub use super::config::Accuracy;
use super::config::ModelConfig;
use super::height_error::HeightError;
use crate::frame::Blur;
use crate::math::Aperture;

/// Error sensitivities at one point of a pilot frame.
#[derive(Debug, Clone, Copy)]
pub struct PilotPoint {
    /// Displacement of the point for a row error of 1 px, µm.
    pub um_per_px: f64,
    /// Standard deviation of the line's image, px.
    pub sigma: f64,
    /// Standard deviation of the row due to speckle, px.
    pub speckle: f64,
    /// Diameter of the lens's blur at the point, px.
    pub blur: f64,
}

/// Data from pilot frames of the scene.
pub struct PilotSample {
    /// Points of the lines in the pilot frames.
    pub points: Vec<PilotPoint>,
    /// Speckle of the scene; `None` without speckle.
    pub grain: Option<SpeckleGrainSize>,
}

/// Speckle statistics of the scene.
#[derive(Debug, Clone)]
pub struct SpeckleGrainSize {
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
    /// Minimal speckle size h along the sensor's columns, px.
    pub size: f64,
    /// Contrast before pixel integration, 0 to 1.
    pub contrast: f64,
}

impl PilotSample {
    /// Returns the height error of each point for one effect of a configuration.
    pub(super) fn each(&self, error: impl Fn(&PilotPoint) -> HeightError) -> Vec<HeightError> {
        let in_um = |point: &PilotPoint| error(point).scaled(point.um_per_px);
        self.points.iter().map(in_um).collect()
    }
}

/// Returns the configuration without images and without effects that require images.
pub fn geometry_only(base: ModelConfig) -> ModelConfig {
    ModelConfig {
        geometry_only: true,
        speckle: None,
        noise: false,
        blur: Blur::None,
        reflections: None,
        ..base
    }
}
