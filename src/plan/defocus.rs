//! Effects of defocus and diffraction.

use super::accuracy::{PilotPoint, PilotSample};
use super::config::{Effect, EffectKind, ModelConfig, SpeckleOptics};
use super::height_error::HeightError;
use crate::frame::Blur;
use crate::speckle::theory::{AIRY_SIGMA, centroid_noise, defocus_noise};
use std::collections::{BTreeMap, BTreeSet};

/// Returns the factor by which a blur of diameter `blur` increases the speckle noise of centroids.
/// The line has the standard deviation `sigma`, and grains have the size `size`. All are in one
/// unit and much wider than pixels ([`defocus_noise`]). The factor is 1 without speckle.
pub(super) fn noise_factor(
    speckle: Option<&SpeckleOptics>,
    size: f64,
    sigma: f64,
    blur: f64,
) -> f64 {
    speckle.map_or(1.0, |optics| {
        let kappa = defocus_noise(optics.aperture, 0.0, sigma / size);
        let added = kappa * blur * (size / sigma).sqrt();
        (added / centroid_noise(size, sigma, 1.0)).hypot(1.0)
    })
}

impl ModelConfig {
    fn blur_method(&self) -> String {
        match self.blur {
            Blur::None => "sharp image",
            Blur::Mean => "light spread by the pupil, speckle multiplied into it",
            Blur::Coherent => "the field on the surface spread by the pupil",
        }
        .into()
    }

    pub(crate) fn defocus_effect(&self) -> Effect {
        let words = self.defocus_in_words();
        let modelled = self.blur != Blur::None;
        Effect::new(EffectKind::Defocus, modelled, self.blur_method(), words)
    }

    pub(crate) fn diffraction_effect(&self) -> Effect {
        let words = format!("Airy radius {:.2} px", self.airy_radius_px);
        let modelled = self.blur != Blur::None;
        Effect::new(EffectKind::Diffraction, modelled, self.blur_method(), words)
    }

    /// Returns the effect of defocus and the fraction of affected points as text.
    pub fn defocus_in_words(&self) -> String {
        let left = match self.blur {
            Blur::None => "than in these images, for which uncertainties are stated",
            Blur::Mean => {
                "than in focus, of which these images show only a part; uncertainties have all of it"
            }
            Blur::Coherent => "than in focus",
        };
        format!(
            "blur of up to {:.1} px on a line {:.1} px wide: its centroid stays, speckle moves \
             it up to {:.2} times as far {left}; {:.1} % of the points have a blur wider than two \
             standard deviations of their line",
            self.defocus_blur_px,
            2.0 * self.line_half_width_px,
            self.defocus_noise_factor,
            100.0 * self.defocused_fraction
        )
    }
}

impl PilotSample {
    /// Returns the additional speckle noise of heights due to defocus ([`defocus_noise`]), as the
    /// error of images without this effect.
    pub fn defocus(&self) -> Vec<HeightError> {
        let Some(grain) = &self.grain else {
            return self.each(|_| HeightError::random(0.0));
        };
        // The factor varies by a third over all line widths. It is evaluated once per quarter of an
        // octave.
        let step = |p: &PilotPoint| (4.0 * (p.sigma / grain.size).log2()).round() as i32;
        let pixel = (1.0 / grain.size).min(16.0);
        let of_step = |step: i32| {
            (
                step,
                defocus_noise(grain.aperture, pixel, (step as f64 / 4.0).exp2()),
            )
        };
        let steps: BTreeSet<i32> = self.points.iter().map(step).collect();
        let kappa: BTreeMap<i32, f64> = steps.into_iter().map(of_step).collect();
        self.each(|p| {
            let blurred = kappa[&step(p)] * p.blur * (grain.size / p.sigma).sqrt();
            HeightError::random(p.speckle.hypot(grain.contrast * blurred) - p.speckle)
        })
    }

    /// Returns the additional speckle noise of heights due to diffraction. The core of the Airy
    /// pattern is approximated by a Gaussian with a standard deviation s of 0.42 h. The noise
    /// increases by √(σ² + s²)/σ, as for a Gaussian pupil in one dimension. There, the covariance
    /// of the field follows from the line and the pupil.
    pub fn diffraction(&self) -> Vec<HeightError> {
        let core = (self.grain.as_ref()).map_or(0.0, |grain| AIRY_SIGMA * grain.size);
        self.each(|p| HeightError::random(p.speckle * ((core / p.sigma).hypot(1.0) - 1.0)))
    }

    /// Returns the fraction of points whose blur is wider than two standard deviations of their
    /// line.
    pub fn defocused_fraction(&self) -> Option<f64> {
        let blurred = self
            .points
            .iter()
            .filter(|p| p.blur > 2.0 * p.sigma)
            .count();
        (!self.points.is_empty()).then(|| blurred as f64 / self.points.len() as f64)
    }
}
