//! What the lens's blur does to the noise of a line.

use super::calibration::Calibration;
use super::variances::{Places, SIGMAS_PX, SpeckleGrain, Variances};
use crate::camera::Camera;
use crate::math::{Aperture, DVec2};
use crate::speckle::imaged_line::ImagedLine;
use crate::speckle::theory::defocus_noise;
use rayon::prelude::*;

/// Steps of tables over σ/h: quarters of an octave, over which they change by a few percent.
const STEPS_PER_OCTAVE: f64 = 4.0;
/// Least and most of their octaves: see [`defocus_noise`].
const OCTAVES: (f64, f64) = (-2.0, 4.0);
/// Widest pixel, in grains, for which diffraction is computed. Wider pixels average the difference.
const WIDEST_PIXEL: f64 = 2.0;
/// Increase of the mean width by columns that speckle leaves dark, over the width and L², L the relative variance of a
/// column's light. A dark column is wide, since only the tails of its image remain. Sampled fields of lines of 0.33 to 2 h
/// give 0.26 to 0.46 for pixels of h/2 and 0.38 to 0.53 for far smaller pixels.
const WIDER_BY_DARK_COLUMNS: f64 = 1.0 / 3.0;

/// Speckle of lines on the laser's plane that the lens spreads.
///
/// A line of standard deviation σ is first widened to √(σ² + v) by defocus, v the second moment of the defocused pupil:
/// b²/16 of a disc, b its diameter. Diffraction then makes of it what [`ImagedLine`] does to a line of that width in
/// focus, where the window includes tails ∝ 1/y². The measured width W gives σ, and the centroid scatters by
///
/// ```text
/// std² = std₀(σ)² + κ²·b²·h/σ      (κ: [`defocus_noise`])
/// ```
///
/// std₀ being that of the line in focus ([`ImagedLine`]).
#[derive(Debug, Clone)]
pub struct Blurred {
    camera: Camera,
    calibration: Calibration,
    grain: SpeckleGrain,
    /// κ at steps of σ over the grain of the pupil's width.
    kappa: Vec<f64>,
    /// At steps of σ over the grain along the column.
    lines: Vec<Step>,
}

/// A line in focus.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// Squares of σ and of the width of its image, grains along the column.
    square: f64,
    imaged: f64,
    over_texture: f64,
}

fn octave(step: usize) -> f64 {
    OCTAVES.0 + step as f64 / STEPS_PER_OCTAVE
}

impl Blurred {
    /// Of the lens and the laser plane that `calibration` knows.
    pub fn new(camera: &Camera, calibration: &Calibration, grain: SpeckleGrain) -> Blurred {
        let middle = grain.resolution.as_dvec2() / 2.0;
        let pixel = (1.0 / grain.along_column_px(middle)).min(16.0);
        let steps = ((OCTAVES.1 - OCTAVES.0) * STEPS_PER_OCTAVE) as usize;
        let kappa = (0..=steps)
            .into_par_iter()
            .map(|i| defocus_noise(grain.aperture, pixel, octave(i).exp2()));
        let lines = (0..=steps).into_par_iter().map(|i| {
            let sigma = octave(i).exp2();
            let line = ImagedLine::new(grain.aperture, pixel.min(WIDEST_PIXEL), sigma);
            Step {
                square: sigma * sigma,
                imaged: line.width.powi(2),
                over_texture: line.over_texture,
            }
        });
        Blurred {
            camera: camera.clone(),
            calibration: calibration.clone(),
            kappa: kappa.collect(),
            lines: lines.collect(),
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

    /// Second moment of the defocused pupil at a place, and the length of a grain along the column, px² and px.
    fn pupil(&self, place: DVec2) -> (f64, f64) {
        let ratio = self.grain.aperture.ratio();
        let of_pupil = match self.grain.aperture {
            Aperture::Square => 1.0 / 12.0,
            _ => ratio * ratio / 16.0,
        };
        let grain = self.grain.along_column_px(place) / ratio;
        (self.blur_px(place).powi(2) * of_pupil, grain)
    }

    /// Returns what diffraction adds to the square of a width, in squares of grains along the column. `by` returns the
    /// abscissa of a step.
    fn diffraction(&self, at: f64, by: impl Fn(&Step) -> f64) -> f64 {
        let after = self.lines.partition_point(|step| by(step) < at);
        let after = after.clamp(1, self.lines.len() - 1);
        let [a, b] = [self.lines[after - 1], self.lines[after]];
        let root = |step: &Step| by(step).sqrt();
        let share = ((at.max(0.0).sqrt() - root(&a)) / (root(&b) - root(&a))).max(0.0);
        let added = [a, b].map(|step| step.imaged - step.square);
        added[0] * (1.0 - share) + added[1] * share
    }

    fn over_texture(&self, sigma: f64) -> f64 {
        let at = (sigma.log2() - OCTAVES.0) * STEPS_PER_OCTAVE;
        let at = at.clamp(0.0, (self.lines.len() - 1) as f64);
        let first = (at as usize).min(self.lines.len() - 2);
        let share = at - first as f64;
        let [a, b] = [first, first + 1].map(|i| self.lines[i].over_texture);
        a * (1.0 - share) + b * share
    }

    /// Returns the width, px, that a line of standard deviation `sigma` px is measured to have at a place.
    pub(super) fn measured(&self, places: &Places, place: DVec2, sigma: f64) -> f64 {
        let (defocus, grain) = self.pupil(place);
        let square = sigma * sigma + defocus;
        let added = self.diffraction(square / (grain * grain), |step| step.square);
        let light = places.at(place, sigma.max(SIGMAS_PX.0)).light;
        (square + added * grain * grain).sqrt() * dark_columns(light)
    }

    /// Standard deviation of a line that was measured `width` px wide at a place.
    fn sharp(&self, places: &Places, place: DVec2, width: f64) -> f64 {
        let (defocus, grain) = self.pupil(place);
        // A line blurred beyond recognition gets the width of a quarter of a grain.
        let least = (0.25 * grain).max(SIGMAS_PX.0);
        let mut sigma = width;
        // Each step leaves a fifth of the error or less: L falls as 1/σ.
        for _ in 0..4 {
            let light = places.at(place, sigma.max(least)).light;
            let square = (width / dark_columns(light)).powi(2);
            let added = self.diffraction(square / (grain * grain), |step| step.imaged);
            let left = square - added * grain * grain - defocus;
            sigma = left.max(least * least).sqrt();
        }
        sigma
    }

    /// Variances of a line that was measured `width` wide at a place.
    pub(super) fn at(&self, places: &Places, place: DVec2, width: f64) -> Variances {
        let (blur, grain) = (self.blur_px(place), self.grain.along_column_px(place));
        let sigma = self.sharp(places, place, width);
        let sharp = places.at(place, sigma);
        let in_focus =
            sharp.speckle * self.over_texture(sigma * self.grain.aperture.ratio() / grain);
        let added =
            (self.grain.contrast * self.kappa(sigma / grain) * blur).powi(2) * grain / sigma;
        Variances {
            speckle: in_focus + added,
            light: sharp.light,
            sharp: sigma,
            ..places.at(place, width)
        }
    }
}

/// Returns the ratio of the mean width of lines to the width of their mean image, for light of the relative variance `light`.
fn dark_columns(light: f64) -> f64 {
    1.0 + WIDER_BY_DARK_COLUMNS * light * light
}
