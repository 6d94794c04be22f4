//! Model configuration of a scene, with its effects, predicted accuracy and required scene data.

use super::height_error::PROMISED_SHARE;
use crate::camera::SpeckleSizeRange;
use crate::frame::{Blur, DefocusSettings, Reflections, Sampling, reach_px};
use crate::math::Aperture;
use crate::speckle::frame_field::MAX_PUPIL_SCALE;
use crate::speckle::lookup::Method;
use serde::{Serialize, Serializer};

/// Model configuration of a scene: the simulated effects and the method of each.
#[derive(Debug, Clone, Serialize)]
pub struct ModelConfig {
    /// True if profiles are computed from laser rays and projected hits, without images.
    pub geometry_only: bool,
    /// Method of reading speckle; `None` for incoherent light.
    pub speckle: Option<Method>,
    /// True if counts include sensor noise, provided that the scene defines it.
    pub noise: bool,
    /// Samples along each side of a pixel.
    pub samples_per_side: u32,
    /// Selection of the traced samples.
    pub sampling: Sampling,
    /// Blur model of the lens.
    pub blur: Blur,
    /// Beam cut-off, in beam radii.
    pub beam_cutoff_radii: f64,
    /// Simulation of indirect light; `None` if it is omitted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reflections: Option<Reflections>,
    /// Noise of indirect light relative to sensor noise, where either is significant: 99th
    /// percentile over positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reflections_noise: Option<f64>,
    /// Minimum 1/e² half width of the line's image on the part, for a surface perpendicular to the
    /// beam, pixels.
    pub line_half_width_px: f64,
    /// 1/e² half width of the line's image on the slopes of the part, pixels: 1st percentile over
    /// positions.
    pub narrowest_half_width_px: f64,
    /// Speckle size on the sensor where the line may be visible.
    #[serde(flatten)]
    pub grain: SpeckleSizeRange,
    /// Maximum blur diameter of the lens on the intersection of laser plane and part, pixels.
    pub defocus_blur_px: f64,
    /// Fraction of points whose blur is wider than two standard deviations of the line. With a
    /// tolerance, it refers to points of the pilot frames, otherwise to positions on the laser
    /// plane.
    pub defocused_fraction: f64,
    /// Maximum factor by which this blur increases the speckle noise of centroids, relative to
    /// sharp images; 1 without speckle.
    pub defocus_noise_factor: f64,
    /// Airy radius 1.22·λ·N·(1 + |m|), pixels.
    pub airy_radius_px: f64,
    /// Displacement of the line's image for 1 mm along the beam, pixels per mm.
    pub px_per_mm: f64,
    /// Tilt that brings the laser plane into focus, degrees.
    pub scheimpflug_tilt_deg: Option<[f64; 2]>,
    /// Distance along the optical axis to the laser plane, mm. With the tilt above, the lens must
    /// be focused at this distance.
    pub laser_plane_distance_mm: Option<f64>,
    /// True if the pattern moves relative to moving surfaces that are out of focus.
    pub local_speckle_motion: bool,
    /// All effects, each with its method and reason.
    pub effects: Vec<Effect>,
    /// Predicted accuracy; `None` if the scene states no tolerance.
    pub accuracy: Option<Accuracy>,
}

impl ModelConfig {
    /// Returns the parameters of the lens blur for a frame.
    pub(crate) fn lens_blur(&self) -> DefocusSettings {
        let grain = self.grain.speckle_extent_px;
        let reach = reach_px(self.defocus_blur_px, grain[0].max(grain[1])).ceil() as usize;
        DefocusSettings {
            blur: self.blur,
            reach: if self.blur == Blur::None { 0 } else { reach },
            line_sigma: self.line_half_width_px / 2.0,
            narrowest_sigma: self.narrowest_half_width_px / 2.0,
        }
    }

    /// Returns the pupil width of speckle fields relative to the lens's pupil, for coherent blur.
    /// The margin covers the spatial frequencies of the line.
    pub(crate) fn pupil_scale(&self) -> Option<f64> {
        let sigma = self.line_half_width_px / 2.0;
        let grain = self.grain.speckle_extent_px[0].max(self.grain.speckle_extent_px[1]);
        // For a Gaussian, the power spectrum of √E has a standard deviation of 1/(4πσ). The margin
        // is 3.1 standard deviations on either side.
        let wider = (1.0 + 0.5 * grain / sigma).min(MAX_PUPIL_SCALE);
        (self.blur == Blur::Coherent).then_some(wider)
    }
}

/// Effect that can change heights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EffectKind {
    /// Width of the laser line.
    LineWidth,
    /// Speckle.
    Speckle,
    /// Shot noise and read noise.
    SensorNoise,
    /// Integration of light over a pixel.
    PixelIntegration,
    /// Variation of the surface within a pixel.
    SurfaceWithinPixel,
    /// Light outside the beam cut-off.
    LightFarFromLine,
    /// Defocus blur of the lens.
    Defocus,
    /// Diffraction blur of the lens.
    Diffraction,
    /// Indirect light.
    Reflections,
    /// Motion during the exposure.
    ExposureMotion,
    /// Relative motion of speckle on moving surfaces out of focus.
    SpeckleOutOfFocus,
}

impl EffectKind {
    /// Returns the name for outputs.
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

/// Effect with its method, reason and influence.
#[derive(Debug, Clone, Serialize)]
pub struct Effect {
    /// Kind of effect.
    pub effect: EffectKind,
    /// True if results include the effect.
    pub modelled: bool,
    /// Method of the model as text, or a note that the effect is omitted.
    pub method: String,
    /// Reason, with the decisive numbers.
    pub why: String,
    /// Height error due to the effect or to its residual, µm: 99th percentile of the points. `None`
    /// without a tolerance, and for effects without a formula.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_effect_um: Option<f64>,
}

impl Effect {
    /// Builds an effect without influence.
    pub fn new(effect: EffectKind, modelled: bool, method: String, why: String) -> Effect {
        Effect {
            effect,
            modelled,
            method,
            why,
            height_effect_um: None,
        }
    }
}

/// Speckle parameters for the choice of the configuration.
#[derive(Debug, Clone)]
pub struct SpeckleOptics {
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
    /// Contrast of the light before integration; 1 for polarised light of a single wavelength.
    pub contrast: f64,
    /// Method of reading speckle.
    pub method: Method,
    /// Frame pairs at increasing lags; empty if relative motion of speckle cannot be simulated.
    pub steps: Vec<SpeckleStep>,
}

/// Motion during one exposure, for the choice of the configuration.
#[derive(Debug, Clone, Copy)]
pub struct ExposureMotion {
    /// Displacement of the sensor head relative to the part, mm.
    pub way: f64,
    /// Number of poses whose light is averaged.
    pub poses: u32,
}

/// Effect of scan motion between two frames on the speckle of a surface point.
#[derive(Debug, Clone, Copy)]
pub struct SpeckleStep {
    /// Lag between the two frames, frames.
    pub frames: u32,
    /// Displacement of the point perpendicular to the laser plane, mm.
    pub across_sheet: f64,
    /// Correlation γ of its intensities before and after.
    pub gamma: f64,
    /// Displacement of the pattern relative to a surface with defocus 1 − L_f/L_o = 1, grains.
    pub slip_grains: f64,
    /// Maximum difference of pattern displacement between positions of the view and its centre,
    /// grains.
    pub spread_grains: f64,
}

/// Required and predicted accuracy.
#[derive(Debug, Clone, Serialize)]
pub struct Accuracy {
    /// Name of the chosen rung of the ladder.
    pub rung: &'static str,
    /// Tolerance stated by the scene, µm.
    pub tolerance_um: f64,
    /// Error limit relative to the reference model for the choice of the configuration, µm. It is
    /// the larger of the tolerance and the scatter due to speckle.
    pub target_error_um: f64,
    /// Height error that speckle exceeds in 1 % of the points, µm. `Some` if it exceeds the
    /// tolerance: no configuration can then meet the tolerance for single points.
    pub speckle_limited_error_um: Option<f64>,
    /// Error relative to the reference model in the pilot frames, µm: 99th percentile of the
    /// points. `None` if more points are lost.
    pub predicted_um: Option<f64>,
    /// Fraction of the pilot points whose error exceeds `target_error_um`, or that only one of both
    /// models finds.
    pub exceedance_estimate: f64,
    /// Upper limit of that fraction over the scan, at 95 % confidence.
    pub exceedance_upper_95: f64,
    /// Fraction of points at which the reference model changes by more than `target_error_um` if its
    /// number of samples per side is halved.
    pub sampling_exceedance: f64,
    /// True if the configuration meets the limit; if false, no configuration does.
    pub sufficient: bool,
    /// Pilot frames of the prediction; parts of them were simulated.
    pub pilot_frames: Vec<u32>,
    /// Number of points in the simulated parts of the pilot frames.
    pub pilot_points: usize,
    /// Summary as text.
    pub statement: String,
}

impl Accuracy {
    /// Returns the text of [`Accuracy::statement`]. `modelled`: true if speckle is simulated.
    pub fn in_words(&self, modelled: bool) -> String {
        let Accuracy {
            tolerance_um,
            target_error_um,
            pilot_points,
            ..
        } = self;
        if *pilot_points == 0 {
            return "no frame that was looked at has a line: nothing could be predicted".into();
        }
        let how = match modelled {
            true => "It is simulated, and the model is selected",
            false => "The scene omits it, and the model is selected",
        };
        // The text names the quantity, because repeatability in data sheets is different and
        // excludes speckle.
        let of = "of single points at different positions, with speckle: ";
        let limit = self.speckle_limited_error_um.map(|limit| {
            format!(
                "no sensor with these optics measures single points to {tolerance_um} µm: \
                 speckle alone moves 1 of 100 by more than {limit:.2} µm. {how} to \
                 {target_error_um:.2} µm. "
            )
        });
        let predicted = self.predicted_um.map_or(
            "more than 1 of 100 points are lost or found where the full model has none".into(),
            |um| format!("within {um:.2} µm of the full model in 99 of 100 points"),
        );
        let sure = format!(
            "; of {pilot_points} points in {} frames {:.2} % are further off than \
             {target_error_um:.2} µm, of the scan at most {:.1} % (95 % confidence)",
            self.pilot_frames.len(),
            100.0 * self.exceedance_estimate,
            100.0 * self.exceedance_upper_95
        );
        let verdict = match self.sufficient {
            true => "",
            false if self.exceedance_estimate <= PROMISED_SHARE => {
                "; so few points cannot say that at most 1 % are, and no method here does better"
            }
            false => "; no method here does better, and it is not enough",
        };
        let unsettled = match self.sampling_exceedance > PROMISED_SHARE {
            true => format!(
                "; the full model itself has not settled: with half as many samples a side it \
                 moves {:.1} % of the points further than that",
                100.0 * self.sampling_exceedance
            ),
            false => String::new(),
        };
        of.to_owned()
            + &limit.unwrap_or_default()
            + &format!("predicted: {predicted}{sure}{verdict}{unsettled}")
    }
}
