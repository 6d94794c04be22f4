//! What a tolerance of height asks, which plans there are to choose from, and what is said of
//! the one that is chosen.

use super::height_error::{HeightError, PROMISED_SHARE};
use super::rules::Plan;
use crate::frame::Sampling;
use crate::math::Aperture;
use serde::Serialize;

/// What was promised, and what is predicted.
#[derive(Debug, Clone, Serialize)]
pub struct Accuracy {
    /// Stated by the scene, µm.
    pub tolerance_um: f64,
    /// Error against the full model that was planned for, µm: the tolerance, or what
    /// speckle leaves of its meaning.
    pub planned_um: f64,
    /// By what speckle alone moves heights in 1 of 100 points or more, µm, if that is more
    /// than the tolerance: with these optics no single point is surer.
    pub speckle_limit_um: Option<f64>,
    /// Error against the full model in the frames looked at: 99 of 100 points by less, µm.
    /// `None` if more are lost.
    pub predicted_um: Option<f64>,
    /// Share of the points looked at that are off by more than `planned_um`, or found by
    /// one of the two only.
    pub predicted_share: f64,
    /// Upper limit of that share over the scan, at 95 % confidence.
    pub share_at_most: f64,
    /// Share of the points that the full model itself moves by more than `planned_um` when
    /// it takes half as many samples along each side of a pixel.
    pub unsettled_share: f64,
    /// Whether the plan is good enough; no plan is, if not.
    pub sufficient: bool,
    /// Predicted time of one frame on one core, ms.
    pub cost_ms: f64,
    /// The same of the scene without a tolerance.
    pub cost_without_ms: f64,
    /// Frames looked at for it, and the points in their parts that were.
    pub pilot_frames: Vec<u32>,
    /// Number of points of these frames that were looked at.
    pub pilot_points: usize,
    /// All this in words.
    pub statement: String,
}

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
    let mut plans = Vec::new();
    for speckle in &speckles[base.speckle.is_none() as usize..] {
        for &noise in &noises[!base.noise as usize..] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                for &samples_per_side in &samples {
                    plans.extend(radii.iter().map(|&cutoff_radii| Plan {
                        speckle: *speckle,
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
        && plan.noise <= other.noise
        && rays(plan) <= rays(other)
        && plan.samples_per_side <= other.samples_per_side
        && plan.cutoff_radii <= other.cutoff_radii
}

impl Accuracy {
    /// What [`Accuracy::statement`] says; `modelled`: speckle is.
    pub fn in_words(&self, modelled: bool) -> String {
        let Accuracy {
            tolerance_um,
            planned_um,
            pilot_points,
            ..
        } = self;
        if *pilot_points == 0 {
            return "no frame that was looked at has a line: nothing could be predicted".into();
        }
        let how = match modelled {
            true => "It is modelled, and all else",
            false => "It is left out by name, and all is planned",
        };
        let limit = self.speckle_limit_um.map(|limit| {
            format!(
                "no sensor with these optics measures single points to {tolerance_um} µm: \
                 speckle alone moves 1 of 100 by more than {limit:.2} µm. {how} to \
                 {planned_um:.2} µm. "
            )
        });
        let predicted = self.predicted_um.map_or(
            "more than 1 of 100 points are lost or found where the full model has none".into(),
            |um| format!("within {um:.2} µm of the full model in 99 of 100 points"),
        );
        let sure = format!(
            "; of {pilot_points} points in {} frames {:.2} % are further off than \
             {planned_um:.2} µm, of the scan at most {:.1} % (95 % confidence)",
            self.pilot_frames.len(),
            100.0 * self.predicted_share,
            100.0 * self.share_at_most
        );
        let verdict = match self.sufficient {
            true => "",
            false if self.predicted_share <= PROMISED_SHARE => {
                "; so few points cannot say that at most 1 % are, and no method here does better"
            }
            false => "; no method here does better, and it is not enough",
        };
        let unsettled = match self.unsettled_share > PROMISED_SHARE {
            true => format!(
                "; the full model itself has not settled: with half as many samples a side it \
                 moves {:.1} % of the points further than that",
                100.0 * self.unsettled_share
            ),
            false => String::new(),
        };
        limit.unwrap_or_default() + &format!("predicted: {predicted}{sure}{verdict}{unsettled}")
    }
}
