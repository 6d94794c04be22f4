//! Which effects are modelled and how finely, and why: no more than the scene
//! needs.

pub use super::chosen::{Effect, EffectKind, ExposureMotion, Plan, SpeckleOptics, SpeckleStep};
use super::cutoff::cutoff_radii;
use super::defocus::noise_factor;
use super::in_view::Optics;
use crate::camera::{Camera, GrainExtent};
use crate::frame::sampling_error;
use crate::frame::{Blur, Sampling};
use crate::laser::CUTOFF_RADII;
use crate::math::{DVec2, DVec3};
use crate::speckle::lookup::Method;
use crate::speckle::theory::{AIRY_SIGMA, centroid_noise, samples_across_pixel};

/// Error of the correlation of two frames up to which the pattern's slip is left out:
/// what correlations of the patterns are good to.
const CORRELATION_TOLERANCE: f64 = 0.01;

/// Correlation of two frames from which on it is to be right; below, only the statistics
/// of each count.
pub const CORRELATED: f64 = 0.1;

/// Relative error of speckle contrast that sampling may cause: what the pattern's own
/// contrast is good to.
const CONTRAST_TOLERANCE: f64 = 0.005;

/// Error of the line's centroid that sampling may cause, pixels.
const SAMPLING_TOLERANCE_PX: f64 = 1e-3;
/// Most samples along each side of a pixel.
pub const MAX_SAMPLES_PER_SIDE: u32 = 16;
/// Most reflections that are followed.
pub const MAX_REFLECTIONS: u32 = 64;

/// Samples a side at which the line's centroid is good to
/// [`SAMPLING_TOLERANCE_PX`] and the contrast of speckle to [`CONTRAST_TOLERANCE`].
fn samples_per_side(sigma_px: f64, speckle_size_px: f64, speckle: Option<&SpeckleOptics>) -> u32 {
    let line = (1..=MAX_SAMPLES_PER_SIDE)
        .find(|&n| {
            // Below σn = ½ the error grows with n before it falls.
            sigma_px * n as f64 > 0.5 && sampling_error(sigma_px, n) < SAMPLING_TOLERANCE_PX
        })
        .unwrap_or(MAX_SAMPLES_PER_SIDE);
    let grain = speckle.map_or(1, |optics| {
        // Past this many grains a pixel no affordable number of samples does.
        let grains = (1.0 / speckle_size_px).min(MAX_SAMPLES_PER_SIDE as f64);
        samples_across_pixel(optics.aperture, grains, CONTRAST_TOLERANCE) as u32
    });
    line.max(grain).clamp(1, MAX_SAMPLES_PER_SIDE)
}

impl Plan {
    /// The plan for light that falls on these `places` (laser frame, mm) along the path
    /// of the scan; `exposure` is `None` if the speed is unknown.
    pub fn new(
        optics: &Optics,
        places: &[DVec3],
        exposure: Option<ExposureMotion>,
        speckle: Option<SpeckleOptics>,
    ) -> Plan {
        let &Optics {
            laser,
            camera,
            camera_from_laser,
            glossy,
        } = optics;
        let line = LineImage::over(optics, places);
        let pitch = camera.sensor.pixel_pitch;
        let airy_radius_px = 1.22 * camera.speckle_size(laser.beam.wavelength) / pitch;
        let sigma = line.half_width_px / 2.0;
        let samples = samples_per_side(sigma, line.grain.speckle_size_px, speckle.as_ref());
        let plane_point = camera_from_laser.translation;
        let plane_normal = camera_from_laser.rotation.y_axis;
        let focused =
            Camera::focused_on_plane(camera.lens.focal_length, (plane_point, plane_normal));
        let mut plan = Plan {
            geometry_only: false,
            speckle: speckle.as_ref().map(|optics| optics.method),
            noise: camera.sensor.noise.is_some(),
            samples_per_side: samples,
            sampling: Sampling::Planes,
            blur: match line.blur(speckle.as_ref()) {
                // One that does not widen the line may still move it.
                Blur::None if glossy => Blur::Mean,
                blur => blur,
            },
            cutoff_radii: match glossy {
                true => CUTOFF_RADII,
                false => cutoff_radii(laser, camera, places),
            },
            reflections: None,
            reflections_noise: None,
            line_half_width_px: line.half_width_px,
            grain: line.grain,
            defocus_blur_px: line.defocus_blur_px,
            blurred_share: line.blurred_share,
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
                .map(|(distance, _)| distance)
                .filter(|distance| distance.is_finite() && *distance > 0.0),
            speckle_slips: false,
            effects: Vec::new(),
            accuracy: None,
        };
        let slip = speckle.as_ref().map(|optics| line.slip(optics));
        plan.speckle_slips = slip.as_ref().is_some_and(|slip| slip.modelled);
        plan.effects = plan.explain(speckle.as_ref(), exposure, sigma);
        plan.effects.extend(slip);
        plan
    }

    fn explain(
        &self,
        speckle: Option<&SpeckleOptics>,
        exposure: Option<ExposureMotion>,
        sigma: f64,
    ) -> Vec<Effect> {
        let effect = Effect::new;
        vec![
            self.pixel_effect(sigma),
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

    fn pixel_effect(&self, sigma: f64) -> Effect {
        let n = self.samples_per_side;
        Effect::new(
            EffectKind::PixelIntegration,
            true,
            match n {
                1 => "1 ray a pixel".into(),
                _ => format!("{n} × {n} samples a pixel; 1 ray on flat surface, all at edges"),
            },
            format!(
                "line's 1/e² half width {:.2} px: sampling moves its centroid by < {:.1e} px; \
                 dark beyond {:.2} radii",
                self.line_half_width_px,
                sampling_error(sigma, n).max(1e-6),
                self.cutoff_radii
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

/// The image of the line over the part.
struct LineImage {
    half_width_px: f64,
    defocus_blur_px: f64,
    blurred_share: f64,
    px_per_mm: f64,
    /// Largest 1/e² half width of the line itself, mm.
    widest: f64,
    /// Largest |1 − L_f/L_o|.
    defocus: f64,
    /// Largest b/σ, and largest share by which the lens makes the line wider; σ/h of the thinnest line.
    blur_sigmas: f64,
    widening: f64,
    sigma_grains: f64,
    grain: GrainExtent,
}

/// Share by which the lens may make lines wider so that it is left out.
const WIDENING_TOLERANCE: f64 = 0.02;
/// Widest blur, in standard deviations of the line, and thinnest line, in grains, for which speckle may be
/// multiplied into the light: its centroid noise then is at most 3 % short, and the lens's share of it
/// at most as much.
const MOST_SIGMAS: f64 = 1.0;
const LEAST_GRAINS: f64 = 2.0;

impl LineImage {
    /// What is to be done of the lens's blur.
    fn blur(&self, speckle: Option<&SpeckleOptics>) -> Blur {
        let method = speckle.map(|optics| optics.method);
        let texture = self.blur_sigmas <= MOST_SIGMAS && self.sigma_grains >= LEAST_GRAINS;
        match method {
            _ if self.widening < WIDENING_TOLERANCE => Blur::None,
            Some(Method::Field) if !texture => Blur::Coherent,
            _ => Blur::Mean,
        }
    }

    /// Whether the pattern's slip on surfaces out of focus is modelled, and why. Slip adds
    /// up from frame to frame, so that the pair of correlated frames counts whose
    /// correlation it changes most.
    fn slip(&self, optics: &SpeckleOptics) -> Effect {
        let pair = |step: &SpeckleStep| {
            // Two frames' lines overlap by ∫E(x)E(x − s)dx/∫E² = exp(−s²/w²).
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

    /// The image at these places of the laser's light; of one pixel where there is none.
    fn over(optics: &Optics, places: &[DVec3]) -> LineImage {
        let Optics {
            laser,
            camera,
            camera_from_laser,
            ..
        } = optics;
        let mut image = LineImage {
            half_width_px: f64::INFINITY,
            defocus_blur_px: 0.0,
            blurred_share: 0.0,
            px_per_mm: f64::INFINITY,
            widest: 0.0,
            defocus: 0.0,
            blur_sigmas: 0.0,
            widening: 0.0,
            sigma_grains: f64::INFINITY,
            grain: GrainExtent::NONE,
        };
        let grains = |pixel| camera.grains_per_pixel(pixel, laser.beam.wavelength);
        let each = 1.0 / places.len().max(1) as f64;
        for &p in places {
            let pixel = camera.project(camera_from_laser.point(p));
            let moved = |by: DVec3| {
                Some((camera.project(camera_from_laser.point(p + by))? - pixel?).length())
            };
            let width = laser.beam.radius(p.x.hypot(p.z));
            if let Some(pixel) = pixel {
                image.grain = image.grain.with(grains(pixel));
            }
            let blur = camera.defocus_blur(camera_from_laser.point(p));
            let blur_px = blur.unwrap_or(0.0) / camera.sensor.pixel_pitch;
            image.defocus_blur_px = image.defocus_blur_px.max(blur_px);
            if let Some(px) = moved(DVec3::Y * width) {
                image.half_width_px = image.half_width_px.min(px);
                image.blurred_share += f64::from(blur_px > px) * each;
                let (sigma, airy) = (px / 2.0, AIRY_SIGMA * image.grain.speckle_extent_px[1]);
                let added = (blur_px * blur_px / 16.0 + airy * airy) / (sigma * sigma);
                image.widening = image.widening.max((1.0 + added).sqrt() - 1.0);
                image.blur_sigmas = image.blur_sigmas.max(blur_px / sigma);
                let grains = sigma / image.grain.speckle_extent_px[1];
                image.sigma_grains = image.sigma_grains.min(grains);
            }
            if let Some(px) = moved(DVec3::Z * 1e-3) {
                image.px_per_mm = image.px_per_mm.min(px * 1e3);
            }
            image.widest = image.widest.max(width);
            let defocus = camera.defocus(camera_from_laser.point(p)).unwrap_or(0.0);
            image.defocus = image.defocus.max(defocus.abs());
        }
        if !image.half_width_px.is_finite() || !image.px_per_mm.is_finite() {
            image.half_width_px = 1.0;
            image.px_per_mm = 1.0;
        }
        if image.grain == GrainExtent::NONE {
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
