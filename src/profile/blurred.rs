//! What the lens's blur does to the noise of a line.

use super::calibration::Calibration;
use super::variances::{Places, SIGMAS_PX, SpeckleGrain, Variances};
use crate::camera::Camera;
use crate::math::{Aperture, DVec2};
use crate::speckle::theory::{AIRY_SIGMA, defocus_noise};
use rayon::prelude::*;

/// Steps of a table of κ: quarters of an octave of σ/h, over which it changes by a few percent.
const STEPS_PER_OCTAVE: f64 = 4.0;
/// Least and most of its octaves: see [`defocus_noise`].
const OCTAVES: (f64, f64) = (-2.0, 4.0);

/// Speckle of lines on the laser's plane that the lens spreads.
///
/// A line of standard deviation σ and a grain h become W² = σ² + s² + v, s = 0.42·h of diffraction
/// and v the second moment of the defocused pupil: b²/16 of a disc, b its diameter. Of a
/// line that was measured W wide σ is what is left, and its centroid scatters by
///
/// ```text
/// std² = std₀(σ)² + κ²·b²·h/σ      (κ: [`defocus_noise`])
/// ```
///
/// std₀ being that of the sharp line: by waves diffraction, which widens it, leaves that
/// as it is from a width σ of 0.4 h on ([`crate::wave::centroid`]).
#[derive(Debug, Clone)]
pub struct Blurred {
    camera: Camera,
    calibration: Calibration,
    grain: SpeckleGrain,
    /// κ at steps of σ/h.
    kappa: Vec<f64>,
}

impl Blurred {
    /// Of the lens and the laser plane that `calibration` knows.
    pub fn new(camera: &Camera, calibration: &Calibration, grain: SpeckleGrain) -> Blurred {
        let middle = grain.resolution.as_dvec2() / 2.0;
        let pixel = (1.0 / grain.along_column_px(middle)).min(16.0);
        let steps = ((OCTAVES.1 - OCTAVES.0) * STEPS_PER_OCTAVE) as usize;
        let kappa = (0..=steps).into_par_iter().map(|i| {
            let sigma = (OCTAVES.0 + i as f64 / STEPS_PER_OCTAVE).exp2();
            defocus_noise(grain.aperture, pixel, sigma)
        });
        Blurred {
            camera: camera.clone(),
            calibration: calibration.clone(),
            kappa: kappa.collect(),
            grain,
        }
    }

    fn kappa(&self, sigma: f64) -> f64 {
        let last = self.kappa.len() - 1;
        let at = (sigma.log2() - OCTAVES.0) * STEPS_PER_OCTAVE;
        let at = at.clamp(0.0, last as f64);
        let first = (at as usize).min(last - 1);
        let share = at - first as f64;
        self.kappa[first] * (1.0 - share) + self.kappa[first + 1] * share
    }

    /// Diameter of the blur on the sensor where the laser's plane is seen at a place, px; 0 where it is
    /// not.
    fn blur_px(&self, place: DVec2) -> f64 {
        let point = self.calibration.point_at(place);
        let blur = point.and_then(|point| self.camera.defocus_blur(point));
        blur.unwrap_or(0.0) / self.camera.sensor.pixel_pitch
    }

    /// What the lens adds to the square of a line's width at a place, px².
    pub(super) fn spread(&self, place: DVec2) -> f64 {
        let (blur, grain) = (self.blur_px(place), self.grain.along_column_px(place));
        let of_pupil = match self.grain.aperture {
            Aperture::Circle => 1.0 / 16.0,
            Aperture::Ellipse(ratio) => ratio * ratio / 16.0,
            Aperture::Square => 1.0 / 12.0,
        };
        blur * blur * of_pupil + (AIRY_SIGMA * grain).powi(2)
    }

    /// Variances of a line that was measured `width` wide at a place.
    pub(super) fn at(&self, places: &Places, place: DVec2, width: f64) -> Variances {
        let (blur, grain) = (self.blur_px(place), self.grain.along_column_px(place));
        let left = width * width - self.spread(place);
        // Of what is blurred beyond recognition the width that a quarter of a grain would have.
        let sigma = left.max((0.25 * grain).powi(2)).sqrt().max(SIGMAS_PX.0);
        let sharp = places.at(place, sigma);
        let added =
            (self.grain.contrast * self.kappa(sigma / grain) * blur).powi(2) * grain / sigma;
        Variances {
            speckle: sharp.speckle + added,
            light: sharp.light,
            ..places.at(place, width)
        }
    }
}
