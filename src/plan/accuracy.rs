//! Requirements of a height tolerance: pilot data, and the candidate configurations.

pub use super::config::Accuracy;
use super::config::ModelConfig;
use super::height_error::HeightError;
use crate::frame::{Blur, Sampling};
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
    /// Number of sensor pixels.
    pub pixels: f64,
    /// Number of sensor columns.
    pub columns: f64,
    /// Traced pixels per frame (second value) at a cut-off in beam radii (first value).
    pub traced_pixels: Vec<(f64, f64)>,
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

/// Candidate numbers of samples per side of a pixel.
const SAMPLE_CHOICES: [u32; 7] = [1, 2, 3, 4, 6, 8, 12];
/// Candidate cut-offs in beam radii, in addition to the cut-off beyond which light is invisible.
const RADII: [f64; 6] = [1.25, 1.5, 1.75, 2.0, 2.25, 2.5];

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

/// Returns all configurations with images that differ from `base` only in their methods. They have
/// up to `finest` samples per side, so they may be cheaper or finer than `base`.
pub fn candidates(base: &ModelConfig, finest: u32) -> Vec<ModelConfig> {
    let speckles = [None, base.speckle];
    let noises = [false, base.noise];
    let samples = SAMPLE_CHOICES.iter().copied().filter(|&n| n < finest);
    let samples: Vec<u32> = samples.chain([finest]).collect();
    let radii = RADII.iter().filter(|&&r| r < base.cutoff_radii);
    let radii: Vec<f64> = radii.copied().chain([base.cutoff_radii]).collect();
    let blurs = [Blur::None, Blur::Mean, Blur::Coherent];
    let blurs = blurs.into_iter().filter(|&blur| blur <= base.blur);
    let mut plans = Vec::new();
    let both = speckles[base.speckle.is_none() as usize..].iter();
    // Coherent blur requires speckle.
    let both = both.flat_map(|speckle| {
        let blurs = blurs.clone().map(move |blur| (speckle, blur));
        blurs.filter(|(speckle, blur)| speckle.is_some() || *blur < Blur::Coherent)
    });
    for (speckle, blur) in both {
        for &noise in &noises[!base.noise as usize..] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                for &samples_per_side in &samples {
                    plans.extend(radii.iter().map(|&cutoff_radii| ModelConfig {
                        speckle: *speckle,
                        blur,
                        noise,
                        sampling,
                        samples_per_side,
                        cutoff_radii,
                        ..base.clone()
                    }));
                }
            }
        }
    }
    plans
}

/// Returns true if no method of `plan` is finer than in `other`.
pub fn is_no_finer_than(plan: &ModelConfig, other: &ModelConfig) -> bool {
    let rays = |plan: &ModelConfig| plan.sampling == Sampling::Rays && plan.samples_per_side > 1;
    plan.speckle.is_some() <= other.speckle.is_some()
        && plan.blur <= other.blur
        && plan.noise <= other.noise
        && rays(plan) <= rays(other)
        && plan.samples_per_side <= other.samples_per_side
        && plan.cutoff_radii <= other.cutoff_radii
}
