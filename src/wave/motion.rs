//! Displacement and decorrelation of speckle from wave optics, compared with the tensor formula and
//! the overlap law.

use super::correlation::{PairCorrelation, correlate_pairs};
use super::image::{
    ImageGrid, WaveImage, WavePupil, intensity_at_focus, pupil_field_watched, pupil_samples,
};
use super::patch::{RoughPoint, lit, moved, patch_filling_view};
use crate::error::{Error, Result};
use crate::math::rng::{Purpose, RngKey};
use crate::math::{Aperture, DVec2};
use crate::speckle::motion::{
    RigidMotion, Source, SurfaceView, ViewRay, bergmann_scalar_sum, defocus_phase,
    overlap_correlation, overlap_correlation_defocused, speckle_shift,
};
use rayon::prelude::*;

/// Image pixels per grain. The average over a pixel raises γ by 1 % at 4 pixels per grain, and by a
/// quarter of this at 8.
const PIXELS_PER_GRAIN: f64 = 8.0;
/// Minimum number of pupil samples across. It sets the resolution of the staircase rims of the disc
/// and of its overlap.
const PUPIL_SAMPLES: f64 = 40.0;
/// Scatterers per squared grain; see [`Patch::points`](super::patch::Patch::points).
const SCATTERERS_PER_GRAIN: f64 = 8.0;

/// Motion to be measured.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionCase {
    /// Description of the motion.
    pub name: String,
    /// Position of the surface between laser and camera.
    pub view: SurfaceView,
    /// Motion of part, laser and camera.
    pub motion: RigidMotion,
}

/// Extent of the simulation.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct WaveSampling {
    /// Wavelength of the laser, mm.
    pub wavelength_mm: f64,
    /// Width of the compared image region, in grains λL_f/D.
    pub region_grains: f64,
    /// Number of independent surfaces, 2 or more. Error bars are proportional to 1/√`realisations`.
    pub realisations: u64,
    /// Random seed of the rough surfaces.
    pub seed: u64,
}

/// Predicted and measured values of one [`MotionCase`]. Displacements are on the sensor (µm), and
/// intervals cover 95 %.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MotionRow {
    /// Description of the motion.
    pub name: String,
    /// δ = |A_p|/D from the tensor formula.
    pub delta: f64,
    /// Sum d₁ + d₂ + d₃ of Bergmann et al. (2016).
    pub seed_sum: f64,
    /// Defocus phase of the motion along the viewing ray, rad.
    pub defocus_phase: f64,
    /// Overlap law at δ, the correlation of a ring of slices at u = δ.
    pub gamma_overlap: f64,
    /// Overlap law with the defocus of the motion along the viewing ray.
    pub gamma_defocused: f64,
    /// Displacement of the pattern from the formula, along columns and rows.
    pub displacement_um: [f64; 2],
    /// Result of wave optics, with `displacement` in mm on the sensor.
    pub waves: PairCorrelation,
}

/// Simulates each case with exact paths. Each rough surface is imaged half the motion before and
/// half the motion after the view, at which the formula is evaluated. Every case has separate
/// surfaces, so the rows are independent.
///
/// Results with 24 surfaces per row for [`reference_cases`](super::cases::reference_cases):
///
/// - All γ are within 0.02 of `gamma_defocused`, with intervals of ±0.01.
/// - The overlap law without defocus is 0.2 too high for 1.5 mm along the viewing ray.
/// - Displacements are within 0.3 µm of the tensor formula, 1/70 of a grain, where γ > 0.5.
///
/// The simulation has systematic errors. γ is 0.002 … 0.005 too high because of the pupil's
/// staircase, and 0.003 because of scatterers and pixels. With 96 surfaces, the excess is 0.007 ±
/// 0.003 at γ = 0.58 and 0.017 ± 0.004 at γ = 0.21.
///
/// A lit spot of a few grains decorrelates less than predicted. The speckles of the pupil field are
/// then not small compared with the shift.
///
/// # Errors
/// Returns the errors of [`pupil_field`](super::image::pupil_field). Returns [`Error::Usage`] for a
/// view without direction (the point is the centre of the pupil).
pub fn measure_motions(cases: &[MotionCase], sampling: &WaveSampling) -> Result<Vec<MotionRow>> {
    measure_motions_watched(cases, sampling, &|_| {})
}

/// Measures the cases like [`measure_motions`]. After each partial sum, calls `added` with its
/// number of terms, from any thread.
pub fn measure_motions_watched(
    cases: &[MotionCase],
    sampling: &WaveSampling,
    added: &(dyn Fn(usize) + Sync),
) -> Result<Vec<MotionRow>> {
    let key = RngKey::new(sampling.seed, Purpose::WaveScatterers);
    let rows = cases.iter().enumerate();
    rows.map(|(k, case)| measure_motion(case, sampling, key.with(k as u64), added))
        .collect()
}

/// Returns the number of terms exp(ikr) that [`measure_motions`] sums for a case: scatterers times
/// pupil samples, for two images of each surface. It returns the errors of [`measure_motions`].
pub fn motion_terms(case: &MotionCase, sampling: &WaveSampling) -> Result<f64> {
    let scale = case.view.magnification;
    let shift = speckle_shift(&case.view, &case.motion);
    let plan = PatchSizes::of(case, shift.sensor / scale, sampling)?;
    let grains = plan.grid.pixels as f64 / PIXELS_PER_GRAIN;
    let scatterers = (plan.patch / plan.cell).powi(2);
    Ok(2.0 * sampling.realisations as f64 * scatterers * pupil_samples(grains))
}

fn measure_motion(
    case: &MotionCase,
    sampling: &WaveSampling,
    key: RngKey,
    added: &(dyn Fn(usize) + Sync),
) -> Result<MotionRow> {
    let scale = case.view.magnification;
    let shift = speckle_shift(&case.view, &case.motion);
    let plan = PatchSizes::of(case, shift.sensor / scale, sampling)?;
    let pairs = (0..sampling.realisations)
        .into_par_iter()
        .map(|k| {
            let points = plan.points(key.with(k));
            Ok([
                plan.image(&points, -0.5, added)?,
                plan.image(&points, 0.5, added)?,
            ])
        })
        .collect::<Result<Vec<_>>>()?;
    let mut waves = correlate_pairs(&pairs, shift.sensor / scale, plan.region, sampling.seed);
    waves.displacement = waves.displacement.map(|d| d.map(|e| e.scaled(scale)));
    let phase = defocus_phase(&case.view, &case.motion, sampling.wavelength_mm);
    Ok(MotionRow {
        name: case.name.clone(),
        delta: shift.delta,
        seed_sum: bergmann_scalar_sum(&case.view, &case.motion),
        defocus_phase: phase,
        gamma_overlap: overlap_correlation(shift.delta),
        gamma_defocused: overlap_correlation_defocused(shift.delta, phase),
        displacement_um: (shift.sensor * 1e3).to_array(),
        waves,
    })
}

/// Sizes of one simulation.
struct PatchSizes<'a> {
    case: &'a MotionCase,
    wavelength_mm: f64,
    ray: ViewRay,
    grid: ImageGrid,
    /// Number of compared pixels along each side.
    region: usize,
    /// Width of the patch across the viewing ray, and spacing of its points (mm).
    patch: f64,
    cell: f64,
}

impl PatchSizes<'_> {
    /// Computes the sizes for a case.
    ///
    /// The patch contains the region, its blur circle, the slip of the pattern on the surface and
    /// three grains on each side. The window of the periodic image is as wide as the patch. A
    /// narrower patch in a wider window was tested. A fraction 0.2/r of an Airy disc lies beyond r
    /// grains. A shift of the pupil field changes the phase of this light, and without it γ was 4 %
    /// too high at r = 13. If the patch fills the window, the wings of the disc wrap around and no
    /// light is missing.
    fn of<'a>(
        case: &'a MotionCase,
        displacement: DVec2,
        sampling: &WaveSampling,
    ) -> Result<PatchSizes<'a>> {
        let view = &case.view;
        let ray = ViewRay::of(view)
            .ok_or_else(|| Error::Usage("the surface point lies at the pupil's centre".into()))?;
        let grain = sampling.wavelength_mm * view.focus_distance / view.pupil_diameter;
        let blur = view.pupil_diameter * (1.0 - view.focus_distance / ray.length).abs();
        let slip = displacement - ray.project(case.motion.part - case.motion.camera);
        let region = sampling.region_grains * grain;
        let needed = region + blur + slip.length() + 6.0 * grain;
        let grains = (needed / grain).max(PUPIL_SAMPLES);
        let pixels = ((grains * PIXELS_PER_GRAIN / 16.0).ceil() as usize).saturating_mul(16);
        let pixel_mm = grain / PIXELS_PER_GRAIN;
        Ok(PatchSizes {
            case,
            wavelength_mm: sampling.wavelength_mm,
            grid: ImageGrid {
                pixels,
                pixel_mm,
                focus_distance: view.focus_distance,
            },
            region: (sampling.region_grains * PIXELS_PER_GRAIN).round() as usize,
            patch: pixels as f64 * pixel_mm * ray.length / view.focus_distance,
            // Out of focus, a point of the image sums over the full blur circle.
            cell: (grain / SCATTERERS_PER_GRAIN.sqrt()).hypot(blur / 16.0),
            ray,
        })
    }

    fn points(&self, key: RngKey) -> Vec<RoughPoint> {
        patch_filling_view(
            self.case.view.point,
            self.case.view.normal,
            self.ray.basis,
            DVec2::splat(self.patch),
            DVec2::splat(self.cell),
            2.0 * self.wavelength_mm,
        )
        .points(key)
    }

    /// Computes the image after the fraction `share` of the motion.
    fn image(
        &self,
        points: &[RoughPoint],
        share: f64,
        added: &(dyn Fn(usize) + Sync),
    ) -> Result<WaveImage> {
        let view = &self.case.view;
        let motion = &self.case.motion;
        let points = moved(
            points,
            view.point,
            motion.rotation * share,
            motion.part * share,
        );
        let laser = motion.laser * share;
        let source = match view.source {
            Source::Point(s) => Source::Point(s + laser),
            wavefront => wavefront,
        };
        let pupil = WavePupil {
            centre: view.pupil_centre + motion.camera * share,
            right: self.ray.basis[0],
            up: self.ray.basis[1],
            diameter: view.pupil_diameter,
            aperture: Aperture::Circle,
        };
        let scatterers = lit(&points, &source, view.point + laser, |_| 1.0);
        let sampled = || added(scatterers.len());
        let field = pupil_field_watched(
            &scatterers,
            &pupil,
            self.wavelength_mm,
            &self.grid,
            &sampled,
        )?;
        Ok(intensity_at_focus(&field, &self.grid))
    }
}

#[cfg(test)]
mod tests;
