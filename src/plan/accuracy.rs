//! What a tolerance of height asks, which plans there are to choose from, and what is said of
//! the one that is chosen.

pub use super::chosen::Accuracy;
use super::chosen::Plan;
use super::height_error::HeightError;
use crate::frame::{Blur, Sampling};
use crate::math::Aperture;

/// What a point of a pilot frame tells.
#[derive(Debug, Clone, Copy)]
pub struct PilotPoint {
    /// Way of the point for an error of its row by 1 px, µm.
    pub um_per_px: f64,
    /// Standard deviation of the line's image, px.
    pub sigma: f64,
    /// Standard deviation of the row from speckle, px.
    pub speckle: f64,
    /// Diameter of the lens's blur there, px.
    pub blur: f64,
}

/// What the plan knows of the scene's frames.
pub struct Pilot {
    /// Points of the lines in the pilot frames.
    pub points: Vec<PilotPoint>,
    /// Of the sensor.
    pub pixels: f64,
    /// Columns of the sensor.
    pub columns: f64,
    /// Pixels of a frame that are looked at when light ends at so many beam radii.
    pub looked_at: Vec<(f64, f64)>,
    /// `None`: the scene has no speckle.
    pub grain: Option<Grain>,
}

/// Of the scene's speckle.
#[derive(Debug, Clone)]
pub struct Grain {
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
    /// Minimal speckle size h along the sensor's columns, px.
    pub size: f64,
    /// Contrast of the light before pixels integrate it, 0 to 1.
    pub contrast: f64,
}

impl Pilot {
    /// Error of each point for one effect of a plan.
    pub(super) fn each(&self, error: impl Fn(&PilotPoint) -> HeightError) -> Vec<HeightError> {
        let in_um = |point: &PilotPoint| error(point).times(point.um_per_px);
        self.points.iter().map(in_um).collect()
    }
}

/// Samples a side that plans choose from.
const SAMPLES: [u32; 7] = [1, 2, 3, 4, 6, 8, 12];
/// Beam radii at which plans may end light, beside that at which none is seen.
const RADII: [f64; 6] = [1.25, 1.5, 1.75, 2.0, 2.25, 2.5];

/// A plan without images, and what only images show.
pub fn geometry_only(base: Plan) -> Plan {
    Plan {
        geometry_only: true,
        speckle: None,
        noise: false,
        blur: Blur::None,
        reflections: None,
        ..base
    }
}

/// Every plan with an image that is `base` done otherwise, with up to `finest` samples a
/// side: cheaper, or more finely.
pub fn candidates(base: &Plan, finest: u32) -> Vec<Plan> {
    let speckles = [None, base.speckle];
    let noises = [false, base.noise];
    let samples = SAMPLES.iter().copied().filter(|&n| n < finest);
    let samples: Vec<u32> = samples.chain([finest]).collect();
    let radii = RADII.iter().filter(|&&r| r < base.cutoff_radii);
    let radii: Vec<f64> = radii.copied().chain([base.cutoff_radii]).collect();
    let blurs = [Blur::None, Blur::Mean, Blur::Coherent];
    let blurs = blurs.into_iter().filter(|&blur| blur <= base.blur);
    let mut plans = Vec::new();
    let both = speckles[base.speckle.is_none() as usize..].iter();
    // A field is speckle's.
    let both = both.flat_map(|speckle| {
        let blurs = blurs.clone().map(move |blur| (speckle, blur));
        blurs.filter(|(speckle, blur)| speckle.is_some() || *blur < Blur::Coherent)
    });
    for (speckle, blur) in both {
        for &noise in &noises[!base.noise as usize..] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                for &samples_per_side in &samples {
                    plans.extend(radii.iter().map(|&cutoff_radii| Plan {
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

/// Whether a plan is in nothing finer than another.
pub fn no_finer(plan: &Plan, other: &Plan) -> bool {
    let rays = |plan: &Plan| plan.sampling == Sampling::Rays && plan.samples_per_side > 1;
    plan.speckle.is_some() <= other.speckle.is_some()
        && plan.blur <= other.blur
        && plan.noise <= other.noise
        && rays(plan) <= rays(other)
        && plan.samples_per_side <= other.samples_per_side
        && plan.cutoff_radii <= other.cutoff_radii
}
