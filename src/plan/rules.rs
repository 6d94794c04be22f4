//! Rules that choose the simulated effects and their methods, no finer than the scene requires.

pub use super::config::{
    Effect, EffectKind, ExposureMotion, ModelConfig, SpeckleOptics, SpeckleStep,
};
use super::cutoff::beam_cutoff_radii;
use super::defocus::noise_factor;
use super::visible_line::{SensorOptics, VisibleLine};
use crate::camera::{Camera, SpeckleSizeRange};
use crate::frame::{Blur, SAMPLING_TOLERANCE_PX, Sampling, narrowest, sampling_error};
use crate::laser::CUTOFF_RADII;
use crate::math::{Aperture, DVec2, DVec3};
use crate::speckle::lookup::Method;
use crate::speckle::theory::{centroid_noise, samples_across_pixel};
use glam::DMat2;
use std::f64::consts::PI;

/// Maximum error of the correlation of two frames up to which relative motion of the pattern is
/// omitted. The correlations of the patterns have this accuracy.
const CORRELATION_TOLERANCE: f64 = 0.01;

/// Minimum correlation of two frames that must be accurate. Below it, only the statistics of each
/// frame matter.
pub const CORRELATED: f64 = 0.1;

/// Maximum relative error of speckle contrast due to sampling. The contrast of the pattern has this
/// accuracy.
const CONTRAST_TOLERANCE: f64 = 0.005;

/// Maximum number of samples along each side of a pixel.
pub const MAX_SAMPLES_PER_SIDE: u32 = 16;
/// Maximum number of simulated bounces.
pub const MAX_REFLECTIONS: u32 = 64;

/// Returns the samples per side that keep the centroid error of the line below
/// [`SAMPLING_TOLERANCE_PX`], and the error of speckle contrast below [`CONTRAST_TOLERANCE`].
fn samples_per_side(sigma_px: f64, speckle_size_px: f64, speckle: Option<&SpeckleOptics>) -> u32 {
    let line = (1..=MAX_SAMPLES_PER_SIDE)
        .find(|&n| {
            // Below σn = ½, the error increases with n before it decreases.
            sigma_px * n as f64 > 0.5 && sampling_error(sigma_px, n) < SAMPLING_TOLERANCE_PX
        })
        .unwrap_or(MAX_SAMPLES_PER_SIDE);
    let grain = speckle.map_or(1, |optics| {
        // With more grains per pixel than this, no affordable number of samples suffices.
        let grains = (1.0 / speckle_size_px).min(MAX_SAMPLES_PER_SIDE as f64);
        samples_across_pixel(optics.aperture, grains, CONTRAST_TOLERANCE) as u32
    });
    line.max(grain).clamp(1, MAX_SAMPLES_PER_SIDE)
}

impl ModelConfig {
    /// Chooses the configuration for the illuminated surface `seen` along the path of the scan.
    /// `exposure` is `None` if the speed is unknown.
    pub fn new(
        optics: &SensorOptics,
        seen: &VisibleLine,
        exposure: Option<ExposureMotion>,
        speckle: Option<SpeckleOptics>,
    ) -> ModelConfig {
        let &SensorOptics {
            laser,
            camera,
            camera_from_laser,
            glossy,
        } = optics;
        let line = LineImageBounds::for_positions(optics, seen);
        let pitch = camera.sensor.pixel_pitch;
        let airy_radius_px = 1.22 * camera.speckle_size(laser.beam.wavelength) / pitch;
        let sigma = line.half_width_px / 2.0;
        let samples = samples_per_side(sigma, line.grain.speckle_size_px, speckle.as_ref());
        let plane_point = camera_from_laser.translation;
        let plane_normal = camera_from_laser.rotation.y_axis;
        let focused =
            Camera::focused_on_plane(camera.lens.focal_length, (plane_point, plane_normal));
        let mut plan = ModelConfig {
            geometry_only: false,
            speckle: speckle.as_ref().map(|optics| optics.method),
            noise: camera.sensor.noise.is_some(),
            samples_per_side: samples,
            sampling: Sampling::Planes,
            blur: match line.blur(speckle.as_ref()) {
                // On glossy surfaces, even a blur that does not widen the line may displace it.
                Blur::None if glossy => Blur::Mean,
                blur => blur,
            },
            beam_cutoff_radii: match glossy {
                true => CUTOFF_RADII,
                false => beam_cutoff_radii(laser, camera, &seen.places),
            },
            reflections: None,
            reflections_noise: None,
            line_half_width_px: line.half_width_px,
            narrowest_half_width_px: line.narrowest_px,
            grain: line.grain,
            defocus_blur_px: line.defocus_blur_px,
            defocused_fraction: line.defocused_fraction,
            defocus_noise_factor: noise_factor(
                speckle.as_ref(),
                line.grain.speckle_extent_px[1],
                sigma,
                line.defocus_blur_px,
            ),
            airy_radius_px,
            px_per_mm: line.px_per_mm,
            scheimpflug_tilt_deg: focused.map(|(_, tilt)| tilt.to_array().map(f64::to_degrees)),
            laser_plane_distance_mm: focused
                .map(|(distance, _)| distance - camera.lens.position())
                .filter(|distance| distance.is_finite() && *distance > 0.0),
            local_speckle_motion: false,
            effects: Vec::new(),
            accuracy: None,
        };
        let slip = speckle.as_ref().map(|optics| line.slip(optics));
        plan.local_speckle_motion = slip.as_ref().is_some_and(|slip| slip.modelled);
        plan.effects = plan.explain(speckle.as_ref(), exposure, &line);
        plan.effects.extend(slip);
        plan
    }

    fn explain(
        &self,
        speckle: Option<&SpeckleOptics>,
        exposure: Option<ExposureMotion>,
        line: &LineImageBounds,
    ) -> Vec<Effect> {
        let effect = Effect::new;
        let sigma = line.half_width_px / 2.0;
        vec![
            self.pixel_effect(line),
            effect(
                EffectKind::Speckle,
                speckle.is_some(),
                if speckle.is_some() {
                    "patterns tied to the part"
                } else {
                    "none"
                }
                .into(),
                format!(
                    "grain {}; it moves each centroid by about {:.2} px (1σ)",
                    self.grain,
                    centroid_noise(
                        self.grain.speckle_extent_px[1],
                        sigma,
                        speckle.map_or(1.0, |s| s.contrast)
                    )
                ),
            ),
            self.defocus_effect(),
            self.diffraction_effect(),
            self.exposure_effect(exposure),
        ]
    }

    fn pixel_effect(&self, line: &LineImageBounds) -> Effect {
        let n = self.samples_per_side;
        // For narrower lines, samples are means over parts of the pixel.
        let sigma = (line.narrowest_px / 2.0).max(narrowest(n));
        Effect::new(
            EffectKind::PixelIntegration,
            true,
            match n {
                1 => "1 ray a pixel".into(),
                _ => format!("{n} × {n} samples a pixel; 1 ray on flat surface, all at edges"),
            },
            format!(
                "line's 1/e² half width {:.2} px, {:.2} px on steep surfaces: sampling moves its centroid \
                 by < {:.1e} px; dark beyond {:.2} radii",
                self.line_half_width_px,
                line.narrowest_px,
                sampling_error(sigma, n).max(1e-6),
                self.beam_cutoff_radii
            ),
        )
    }

    fn exposure_effect(&self, exposure: Option<ExposureMotion>) -> Effect {
        let poses = exposure.map_or(1, |exposure| exposure.poses);
        let speed = exposure.map_or("no scan.frame_rate_hz is given".into(), |exposure| {
            let way = exposure.way * 1e3;
            format!("the head goes {way:.2} µm over the part in one exposure")
        });
        Effect::new(
            EffectKind::ExposureMotion,
            poses > 1,
            match poses {
                1 => "head at rest".into(),
                _ => format!("mean of {poses} poses"),
            },
            format!(
                "{speed}; 1 px is {:.1} µm along the beam",
                1e3 / self.px_per_mm
            ),
        )
    }
}

/// Image of the line over the part.
struct LineImageBounds {
    half_width_px: f64,
    /// Width on the slopes of the part, see [`ModelConfig::narrowest_half_width_px`].
    narrowest_px: f64,
    defocus_blur_px: f64,
    defocused_fraction: f64,
    px_per_mm: f64,
    /// Maximum 1/e² half width of the line on the part, mm.
    widest: f64,
    /// Maximum |1 − L_f/L_o|.
    defocus: f64,
    /// Fraction of positions at which speckle cannot be multiplied into the blurred light, see
    /// [`MOST_SIGMAS`].
    coherent_share: f64,
    /// Fraction of positions at which the lens lowers the line's peak by [`LOSS_TOLERANCE`] or
    /// more.
    lowered_share: f64,
    grain: SpeckleSizeRange,
}

/// Relative loss of a line's peak up to which the lens is not simulated.
const LOSS_TOLERANCE: f64 = 0.02;
/// Fraction of positions that is ignored when choosing the sampling and the blur model.
const FEW: f64 = 0.01;
/// Maximum blur in standard deviations of the line, and minimum line width in grains, for which
/// speckle may be multiplied into the light. Its centroid noise is then at most 3 % too small, and
/// the contribution of the lens to this noise is at most as large.
const MOST_SIGMAS: f64 = 1.0;
const LEAST_GRAINS: f64 = 2.0;

/// Returns the relative loss of a line's peak in the lens, for a standard deviation `sigma`. The
/// result is of first order in the grain size and of second order in the blur, all in one unit.
///
/// In focus, the transfer function of a round pupil decreases with the frequency f as 1 −
/// (4/π)·h·f, and of a square pupil as 1 − h·f. The mean frequency of a Gaussian line is
/// √(2/π)/(2πσ), which gives the loss. A Gaussian of the width of the Airy core would decrease with
/// f² and give less than a fifth of this loss at σ = 3 h.
fn peak_loss(aperture: Aperture, sigma: f64, grain: f64, blur: f64) -> f64 {
    let slope = match aperture {
        Aperture::Circle => 4.0 / PI,
        Aperture::Ellipse(ratio) => 4.0 / PI / ratio,
        Aperture::Square => 1.0,
    };
    let diffraction = slope * grain * (2.0 / PI).sqrt() / (2.0 * PI * sigma);
    let widened = 1.0 + aperture.variance_along_height() * (blur / sigma).powi(2);
    diffraction + 1.0 - widened.sqrt().recip()
}

/// Returns the 1/e² half width across the line of a beam's image at a position on a plane, pixels.
/// `radius` is the beam radius, mm; vectors are in the laser frame. The change of the beam over the
/// plane is converted to the sensor by the Jacobian of the projection.
fn width_on_plane(optics: &SensorOptics, place: DVec3, normal: DVec3, radius: f64) -> Option<f64> {
    let along = normal.any_orthonormal_vector();
    let axes = [along, normal.cross(along)];
    // Small step, for which the projection is linear to a relative error below 10⁻³.
    let step = 1e-4 * place.length();
    let project = |p: DVec3| optics.camera.project(optics.camera_from_laser.point(p));
    let derivative = |axis: DVec3| {
        Some((project(place + axis * step)? - project(place - axis * step)?) / (2.0 * step))
    };
    let by_axis = DMat2::from_cols(derivative(axes[0])?, derivative(axes[1])?);
    // Light of a beam changes along its radius; on its axis, it changes equally in both directions.
    let off = |axis: DVec3| optics.laser.off_middle(axis);
    let [a, b] = axes.map(off);
    let inverse = by_axis.inverse();
    // Columns of the Jacobian: change of the beam position per column and per row.
    let by_pixel = [inverse.x_axis, inverse.y_axis].map(|step| a * step.x + b * step.y);
    // Maximum change along any direction on the sensor.
    let change = match optics.laser.fan {
        Some(_) => DVec2::new(by_pixel[0].y, by_pixel[1].y).length(),
        None => by_pixel[0].length().hypot(by_pixel[1].length()),
    };
    Some(radius / change).filter(|width| width.is_finite())
}

impl LineImageBounds {
    /// Chooses the blur model.
    fn blur(&self, speckle: Option<&SpeckleOptics>) -> Blur {
        let method = speckle.map(|optics| optics.method);
        match method {
            _ if self.lowered_share <= FEW => Blur::None,
            Some(Method::Field) if self.coherent_share > FEW => Blur::Coherent,
            _ => Blur::Mean,
        }
    }

    /// Decides whether relative motion of the pattern on surfaces out of focus is simulated. The
    /// motion is cumulative over frames. The decision therefore uses the pair of correlated frames
    /// whose correlation it changes most.
    fn slip(&self, optics: &SpeckleOptics) -> Effect {
        let pair = |step: &SpeckleStep| {
            // Overlap of two frames' lines: ∫E(x)E(x − s)dx/∫E² = exp(−s²/w²).
            let shared = (-(step.across_sheet / self.widest).powi(2)).exp() * step.gamma;
            let grains = step.slip_grains * self.defocus + step.spread_grains;
            let frames = step.frames;
            let kept = optics.aperture.field_correlation(DVec2::X * grains);
            (shared > CORRELATED).then_some((shared * (1.0 - kept * kept), shared, grains, frames))
        };
        let pairs = optics.steps.iter().filter_map(pair);
        let worst = pairs.max_by(|a, b| a.0.total_cmp(&b.0));
        let modelled = worst.is_some_and(|(error, ..)| error > CORRELATION_TOLERANCE);
        let method = match modelled {
            true => "two strips of the pupil's field, each read where its light was seen",
            false => "moves with the surface",
        };
        let why = match worst {
            Some((error, shared, grains, frames)) => format!(
                "over {frames} frame{} it moves up to {grains:.2} grains otherwise than the middle of \
                 the view: without, their correlation, {shared:.3} at most, is off by {error:.3}",
                if frames == 1 { "" } else { "s" },
            ),
            None if optics.steps.is_empty() => {
                "intensities are read, or speckle moves but hardly changes".into()
            }
            None => "neighbouring frames are not correlated".into(),
        };
        Effect::new(EffectKind::SpeckleOutOfFocus, modelled, method.into(), why)
    }

    /// Computes the image of the laser light where it is visible. Without visible light, the width
    /// is one pixel.
    fn for_positions(optics: &SensorOptics, seen: &VisibleLine) -> LineImageBounds {
        let SensorOptics {
            laser,
            camera,
            camera_from_laser,
            ..
        } = optics;
        let mut image = LineImageBounds {
            half_width_px: f64::INFINITY,
            narrowest_px: 1.0,
            defocus_blur_px: 0.0,
            defocused_fraction: 0.0,
            px_per_mm: f64::INFINITY,
            widest: 0.0,
            defocus: 0.0,
            coherent_share: 0.0,
            lowered_share: 0.0,
            grain: SpeckleSizeRange::NONE,
        };
        let grains = |pixel| camera.grains_per_pixel(pixel, laser.beam.wavelength);
        let each = 1.0 / seen.places.len().max(1) as f64;
        let mut widths = Vec::with_capacity(seen.places.len());
        for (i, &p) in seen.places.iter().enumerate() {
            let pixel = camera.project(camera_from_laser.point(p));
            let moved = |by: DVec3| {
                Some((camera.project(camera_from_laser.point(p + by))? - pixel?).length())
            };
            let width = laser.radius(p);
            let of_pixel = |pixel| SpeckleSizeRange::NONE.with(grains(pixel)).speckle_extent_px[1];
            let grain = pixel.map_or(0.0, of_pixel);
            if let Some(pixel) = pixel {
                image.grain = image.grain.with(grains(pixel));
            }
            let blur = camera.defocus_blur(camera_from_laser.point(p));
            let blur_px = blur.unwrap_or(0.0) / camera.sensor.pixel_pitch;
            image.defocus_blur_px = image.defocus_blur_px.max(blur_px);
            if let Some(px) = moved(DVec3::Y * width) {
                let normal = seen.normals.get(i);
                let on_plane = normal.and_then(|&n| width_on_plane(optics, p, n, width));
                let narrowest = on_plane.unwrap_or(px).min(px);
                widths.push(narrowest);
                image.half_width_px = image.half_width_px.min(px);
                image.defocused_fraction += f64::from(blur_px > px) * each;
                let (aperture, sigma) = (camera.lens.aperture, narrowest / 2.0);
                let loss = peak_loss(aperture, sigma, grain, blur_px);
                image.lowered_share += f64::from(loss >= LOSS_TOLERANCE) * each;
                // The height of an ellipse is its smaller axis, so its grains are longer.
                let along = grain / aperture.ratio();
                let is_coherent = blur_px > MOST_SIGMAS * sigma || sigma < LEAST_GRAINS * along;
                image.coherent_share += f64::from(is_coherent) * each;
            }
            if let Some(px) = moved(DVec3::Z * 1e-3) {
                image.px_per_mm = image.px_per_mm.min(px * 1e3);
            }
            image.widest = image.widest.max(width);
            let defocus = camera.defocus(camera_from_laser.point(p)).unwrap_or(0.0);
            image.defocus = image.defocus.max(defocus.abs());
        }
        widths.sort_unstable_by(f64::total_cmp);
        let few = (FEW * widths.len() as f64) as usize;
        image.narrowest_px = widths.get(few).copied().unwrap_or(1.0);
        if !image.half_width_px.is_finite() || !image.px_per_mm.is_finite() {
            image.half_width_px = 1.0;
            image.px_per_mm = 1.0;
        }
        if image.grain == SpeckleSizeRange::NONE {
            image.grain = image
                .grain
                .with(grains(camera.sensor.resolution.as_dvec2() / 2.0));
        }
        image
    }
}

#[cfg(test)]
#[path = "rules_tests.rs"]
mod tests;
