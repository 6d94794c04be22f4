//! Effect of lens blur on the noise of a line.

use super::calibration::Calibration;
use super::variances::{SIGMAS_PX, SpeckleGrain, VarianceGrid, Variances};
use crate::camera::Camera;
use crate::math::DVec2;
use crate::speckle::imaged_line::ImagedLine;
use crate::speckle::theory::defocus_noise;
use rayon::prelude::*;

/// Steps per octave of the tables over σ/h; table values change by a few per cent per step.
const STEPS_PER_OCTAVE: f64 = 4.0;
/// First and last octave of the tables; see [`defocus_noise`].
const OCTAVES: (f64, f64) = (-2.0, 4.0);
/// Largest pixel size, in grains, for which diffraction is computed. Larger pixels average out the
/// difference.
const WIDEST_PIXEL: f64 = 2.0;
/// Relative increase of the mean width caused by columns that speckle leaves dark, divided by L². L
/// is the relative variance of the light of a column.
///
/// A dark column is wide, because only the tails of its image remain. Simulated fields of lines of
/// 0.33 to 2 h give 0.26 to 0.46 for pixels of h/2, and 0.38 to 0.53 for much smaller pixels.
const WIDER_BY_DARK_COLUMNS: f64 = 1.0 / 3.0;

/// Speckle noise of lines in the laser plane after blurring by the lens.
///
/// Defocus widens a line of standard deviation σ to √(σ² + v), where v is the second moment of the
/// defocused pupil. For a disc of diameter b, v = b²/16. Diffraction then acts as on a line of this
/// width in focus ([`ImagedLine`]), where the window includes tails ∝ 1/y². The measured width W
/// determines σ. The standard deviation of the centroid is
///
/// ```text
/// std² = std₀(σ)² + κ²·b²·h/σ      (κ: [`defocus_noise`])
/// ```
///
/// where h is the minimal speckle size and std₀ is the standard deviation for the line in focus
/// ([`ImagedLine`]).
#[derive(Debug, Clone)]
pub struct DefocusNoise {
    camera: Camera,
    calibration: Calibration,
    grain: SpeckleGrain,
    /// κ, tabulated over the ratio of σ to the grain size of the pupil width.
    kappa: Vec<f64>,
    /// Lines in focus, tabulated over the ratio of σ to the grain size along the column.
    lines: Vec<Step>,
}

#[derive(Debug, Clone, Copy)]
struct Step {
    /// Squares of σ and, in `imaged`, of the width of the image; unit: squared grains along the
    /// column.
    square: f64,
    imaged: f64,
    over_texture: f64,
}

fn octave(step: usize) -> f64 {
    OCTAVES.0 + step as f64 / STEPS_PER_OCTAVE
}

impl DefocusNoise {
    /// Creates the model for the lens and the laser plane of `calibration`.
    pub fn new(camera: &Camera, calibration: &Calibration, grain: SpeckleGrain) -> DefocusNoise {
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
        DefocusNoise {
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

    /// Returns the diameter of the blur on the sensor at `place`, px. The value is 0 if the viewing
    /// ray does not intersect the laser plane.
    fn blur_px(&self, place: DVec2) -> f64 {
        let point = self.calibration.point_at(place);
        let blur = point.and_then(|point| self.camera.defocus_blur(point));
        blur.unwrap_or(0.0) / self.camera.sensor.pixel_pitch
    }

    /// Returns the second moment of the defocused pupil, px², and the grain size along the column,
    /// px.
    fn pupil(&self, place: DVec2) -> (f64, f64) {
        let ratio = self.grain.aperture.ratio();
        let of_pupil = self.grain.aperture.variance_along_height();
        let grain = self.grain.along_column_px(place) / ratio;
        (self.blur_px(place).powi(2) * of_pupil, grain)
    }

    /// Returns the increase of the squared width by diffraction, in squared grains along the
    /// column. `by` returns the abscissa of a step.
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

    /// Returns the measured width, px, of a line of standard deviation `sigma` px at `place`.
    pub(super) fn measured(&self, places: &VarianceGrid, place: DVec2, sigma: f64) -> f64 {
        let (defocus, grain) = self.pupil(place);
        let square = sigma * sigma + defocus;
        let added = self.diffraction(square / (grain * grain), |step| step.square);
        let light = places.at(place, sigma.max(SIGMAS_PX.0)).light;
        (square + added * grain * grain).sqrt() * dark_columns(light)
    }

    /// Returns the standard deviation of a line in the sharp image, given its measured width in px.
    fn sharp(&self, places: &VarianceGrid, place: DVec2, width: f64) -> f64 {
        let (defocus, grain) = self.pupil(place);
        // The lower limit, a quarter of a grain, applies to lines that are dominated by blur.
        let least = (0.25 * grain).max(SIGMAS_PX.0);
        let mut sigma = width;
        // Each step reduces the error to a fifth or less, because L is proportional to 1/σ.
        for _ in 0..4 {
            let light = places.at(place, sigma.max(least)).light;
            let square = (width / dark_columns(light)).powi(2);
            let added = self.diffraction(square / (grain * grain), |step| step.imaged);
            let left = square - added * grain * grain - defocus;
            sigma = left.max(least * least).sqrt();
        }
        sigma
    }

    /// Returns the variances of a line with a measured width of `width` px at `place`.
    pub(super) fn at(&self, places: &VarianceGrid, place: DVec2, width: f64) -> Variances {
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

/// Returns the ratio of the mean width of lines to the width of their mean image. `light` is the
/// relative variance of the light of a column.
fn dark_columns(light: f64) -> f64 {
    1.0 + WIDER_BY_DARK_COLUMNS * light * light
}
