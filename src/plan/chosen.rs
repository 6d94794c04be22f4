//! A plan, what it says of effects, what it promised, and what of a scene it depends on.

use super::height_error::PROMISED_SHARE;
use crate::camera::GrainExtent;
use crate::frame::{Blur, LensBlur, Reflections, Sampling, reach_px};
use crate::math::Aperture;
use crate::speckle::frame_field::WIDEST;
use crate::speckle::lookup::Method;
use serde::{Serialize, Serializer};

/// What a frame of this scene needs. Each way of doing it is a value here.
#[derive(Debug, Clone, Serialize)]
pub struct Plan {
    /// Profiles come from laser rays and the camera's view of them, without images.
    pub geometry_only: bool,
    /// How speckle is read; `None`: light is taken as incoherent.
    pub speckle: Option<Method>,
    /// Whether counts have the sensor's noise, if the scene gives any.
    pub noise: bool,
    /// Samples along each side of a pixel.
    pub samples_per_side: u32,
    /// Which samples are traced.
    pub sampling: Sampling,
    /// What is done of the lens's blur.
    pub blur: Blur,
    /// Beam radii at which light is taken to end.
    pub cutoff_radii: f64,
    /// How light that is reflected more than once is followed; `None`: it is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reflections: Option<Reflections>,
    /// Noise of its paths over the sensor's own where either shows: 99 of 100 places have less.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reflections_noise: Option<f64>,
    /// 1/e² half width of the line's image where it is narrowest on the part, for
    /// a surface across the beam, pixels.
    pub line_half_width_px: f64,
    /// 1/e² half width of the line's image on the part's own slopes, pixels: 1 % of the places have a narrower one.
    pub narrowest_half_width_px: f64,
    /// Speckle on the sensor where it may see the line.
    #[serde(flatten)]
    pub grain: GrainExtent,
    /// Blur of the lens where the laser plane crosses the part, at its largest,
    /// pixels.
    pub defocus_blur_px: f64,
    /// Share whose blur is wider than two standard deviations of the line: of the points of
    /// the frames the plan looked at, without a tolerance of places of the laser plane.
    pub blurred_share: f64,
    /// How many times as far speckle moves centroids under that blur as in sharp images, at
    /// most; 1 without speckle.
    pub defocus_noise_factor: f64,
    /// Airy radius 1.22·λ·N·(1 + |m|), pixels.
    pub airy_radius_px: f64,
    /// Movement of the line's image for 1 mm along the beam, pixels per mm.
    pub px_per_mm: f64,
    /// Tilt that brings the laser plane into focus, degrees.
    pub scheimpflug_tilt_deg: Option<[f64; 2]>,
    /// Distance along the optical axis at which the laser plane meets it, mm: to
    /// be in focus with that tilt, the lens must be focused there.
    pub laser_plane_distance_mm: Option<f64>,
    /// Whether the pattern slips on surfaces out of focus as they move.
    pub speckle_slips: bool,
    /// Every effect with its method and the reason.
    pub effects: Vec<Effect>,
    /// `None`: the scene states no tolerance.
    pub accuracy: Option<Accuracy>,
}

impl Plan {
    /// The lens's blur, as a frame has to know it.
    pub(crate) fn lens_blur(&self) -> LensBlur {
        let grain = self.grain.speckle_extent_px;
        let reach = reach_px(self.defocus_blur_px, grain[0].max(grain[1])).ceil() as usize;
        LensBlur {
            blur: self.blur,
            reach: if self.blur == Blur::None { 0 } else { reach },
            line_sigma: self.line_half_width_px / 2.0,
            narrowest_sigma: self.narrowest_half_width_px / 2.0,
        }
    }

    /// Where the field on the surface goes through the lens: how many times as wide as the lens's
    /// its pupil is to be, so that nothing of the line's own breadth of frequencies is missed.
    pub(crate) fn wider(&self) -> Option<f64> {
        let sigma = self.line_half_width_px / 2.0;
        let grain = self.grain.speckle_extent_px[0].max(self.grain.speckle_extent_px[1]);
        // The power of √E's spectrum has a standard deviation of 1/(4πσ) for a Gaussian: 3.1 of these
        // on either side.
        let wider = (1.0 + 0.5 * grain / sigma).min(WIDEST);
        (self.blur == Blur::Coherent).then_some(wider)
    }
}

/// What can move a height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EffectKind {
    /// Width of the laser line.
    LineWidth,
    /// Speckle.
    Speckle,
    /// Shot noise and read noise.
    SensorNoise,
    /// Light integrated over a pixel.
    PixelIntegration,
    /// Surface that changes within a pixel.
    SurfaceWithinPixel,
    /// Light beyond the beam's cut-off.
    LightFarFromLine,
    /// Blur of what is out of focus.
    Defocus,
    /// Blur by the lens's diffraction.
    Diffraction,
    /// Light reflected more than once.
    Reflections,
    /// Motion during the exposure.
    ExposureMotion,
    /// Slip of speckle on moving surfaces out of focus.
    SpeckleOutOfFocus,
}

impl EffectKind {
    /// As outputs show it.
    pub fn name(self) -> &'static str {
        match self {
            EffectKind::LineWidth => "width of the line",
            EffectKind::Speckle => "speckle",
            EffectKind::SensorNoise => "sensor noise",
            EffectKind::PixelIntegration => "pixel integration",
            EffectKind::SurfaceWithinPixel => "surface within a pixel",
            EffectKind::LightFarFromLine => "light far from the line",
            EffectKind::Defocus => "defocus",
            EffectKind::Diffraction => "diffraction of the lens",
            EffectKind::Reflections => "light reflected more than once",
            EffectKind::ExposureMotion => "motion during the exposure",
            EffectKind::SpeckleOutOfFocus => "speckle out of focus",
        }
    }
}

impl Serialize for EffectKind {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// One line of the plan.
#[derive(Debug, Clone, Serialize)]
pub struct Effect {
    /// Which effect.
    pub effect: EffectKind,
    /// Whether results have it.
    pub modelled: bool,
    /// How it is modelled, or that it is not, in words.
    pub method: String,
    /// The reason, with the numbers that decided.
    pub why: String,
    /// How far it moves heights, or what is left of it does: 99 of 100 points by less,
    /// µm. `None` without a tolerance, and where no formula says it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub influence_um: Option<f64>,
    /// Predicted cost of modelling it, ms of one core a frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cost_ms: Option<f64>,
}

impl Effect {
    /// Without influence and cost.
    pub fn new(effect: EffectKind, modelled: bool, method: String, why: String) -> Effect {
        Effect {
            effect,
            modelled,
            method,
            why,
            influence_um: None,
            cost_ms: None,
        }
    }
}

/// What the plan must know of speckle.
#[derive(Debug, Clone)]
pub struct SpeckleOptics {
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
    /// Contrast of the light itself, 1 if it is polarised and of one wavelength.
    pub contrast: f64,
    /// How speckle is read.
    pub method: Method,
    /// Of pairs of frames ever further apart; none if slip cannot be modelled.
    pub steps: Vec<SpeckleStep>,
}

/// What the plan must know of the motion in one exposure.
#[derive(Debug, Clone, Copy)]
pub struct ExposureMotion {
    /// Of the head over the part, mm.
    pub way: f64,
    /// Poses whose light is averaged.
    pub poses: u32,
}

/// What the scan's way from one frame to another does to the speckle of a surface point.
#[derive(Debug, Clone, Copy)]
pub struct SpeckleStep {
    /// Number of frames that the two lie apart.
    pub frames: u32,
    /// Way of the point across the laser's sheet, mm.
    pub across_sheet: f64,
    /// Correlation γ of its intensities before and after.
    pub gamma: f64,
    /// Slip of the pattern on a surface of defocus 1 − L_f/L_o = 1, grains.
    pub slip_grains: f64,
    /// Greatest way by which places of the view move otherwise than its middle, grains.
    pub spread_grains: f64,
}

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
        // What a data sheet calls repeatability does not know speckle, and is another quantity.
        let of = "of single points from place to place, speckle in them: ";
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
        of.to_owned()
            + &limit.unwrap_or_default()
            + &format!("predicted: {predicted}{sure}{verdict}{unsettled}")
    }
}
