//! Displacement and decorrelation by waves, next to the tensor formula and the
//! overlap law.

use super::correlation::{PairCorrelation, correlate_pairs};
use super::image::{
    ImageGrid, Pupil, WaveImage, intensity_at_focus, pupil_field_watched, pupil_samples,
};
use super::patch::{RoughPoint, lit, moved, patch_filling_view};
use crate::error::{Error, Result};
use crate::math::rng::{Key, Purpose};
use crate::math::{Aperture, DVec2};
use crate::speckle::motion::{
    Motion, Source, SurfaceView, ViewRay, defocus_phase, overlap_correlation,
    overlap_correlation_defocused, seed_scalar_sum, speckle_shift,
};
use rayon::prelude::*;

/// Image pixels a grain: averaging over a pixel raises γ by 1 % at 4, by a quarter
/// of that at 8.
const PIXELS_PER_GRAIN: f64 = 8.0;
/// Least number of pupil samples across: the disc and its overlap with its shifted
/// self are staircases of this fineness.
const PUPIL_SAMPLES: f64 = 40.0;
/// Scatterers a squared grain; see [`Patch::points`](super::patch::Patch::points).
const SCATTERERS_PER_GRAIN: f64 = 8.0;

/// A motion to measure.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionCase {
    /// The motion in words.
    pub name: String,
    /// Where the surface is between laser and camera.
    pub view: SurfaceView,
    /// Of the surface.
    pub motion: Motion,
}

/// How much to simulate.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct WaveSampling {
    /// Wavelength of the laser.
    pub wavelength_mm: f64,
    /// Width of the compared image region in grains λL_f/D.
    pub region_grains: f64,
    /// Independent surfaces, 2 or more; error bars shrink as 1/√.
    pub realisations: u64,
    /// Of the rough surfaces.
    pub seed: u64,
}

/// Prediction and measurement of one [`MotionCase`]. Displacements are on the
/// sensor (µm), intervals cover 95 %.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MotionRow {
    /// The motion in words.
    pub name: String,
    /// |A_p|/D of the tensor formula.
    pub delta: f64,
    /// The seed's d₁ + d₂ + d₃.
    pub seed_sum: f64,
    /// Phase of the defocus by the motion along the viewing ray, rad.
    pub defocus_phase: f64,
    /// Overlap law at δ, what a ring of slices shows at u = δ.
    pub gamma_overlap: f64,
    /// Overlap law with the defocus of the motion along the viewing ray.
    pub gamma_defocused: f64,
    /// Of the pattern, by the formula: along columns and rows.
    pub displacement_um: [f64; 2],
    /// Waves; `displacement` in mm on the sensor.
    pub waves: PairCorrelation,
}

/// Simulates each case by exact paths: the same rough surfaces half the motion
/// before and half after the view, at which the formula is evaluated. Every case
/// has its own surfaces, so the rows are independent.
///
/// What 24 surfaces a row gave for [`reference_cases`](super::cases::reference_cases): all γ
/// within 0.02 of `gamma_defocused` with intervals of ±0.01 (the overlap law alone
/// is 0.2 too high for 1.5 mm along the viewing ray), displacements within 0.3 µm of
/// the tensor formula, a seventieth of a grain, where γ > 0.5. Systematic errors of
/// the simulation: γ is 0.002 … 0.005 high for the pupil's staircase, 0.003 for
/// scatterers and pixels; with 96 surfaces 0.007 ± 0.003 at γ = 0.58 and
/// 0.017 ± 0.004 at γ = 0.21.
///
/// A lit spot of a few grains only decorrelates less than any of this: the pupil
/// field's own speckles are then not small against the shift.
///
/// # Errors
/// As [`pupil_field`](super::image::pupil_field); at a view without direction (the point is the pupil's
/// centre) [`Error::Usage`].
pub fn measure_motions(cases: &[MotionCase], sampling: &WaveSampling) -> Result<Vec<MotionRow>> {
    measure_motions_watched(cases, sampling, &|_| {})
}

/// Measures the cases as [`measure_motions`] does; calls `added`, from any thread, with every number of terms that was added up.
pub fn measure_motions_watched(
    cases: &[MotionCase],
    sampling: &WaveSampling,
    added: &(dyn Fn(usize) + Sync),
) -> Result<Vec<MotionRow>> {
    let key = Key::new(sampling.seed, Purpose::WaveScatterers);
    let rows = cases.iter().enumerate();
    rows.map(|(k, case)| measure_motion(case, sampling, key.with(k as u64), added))
        .collect()
}

/// Terms exp(ikr) that [`measure_motions`] adds up for a case: scatterers times samples
/// of the pupil, for two images of each surface. Errors: as there.
pub fn motion_terms(case: &MotionCase, sampling: &WaveSampling) -> Result<f64> {
    let scale = case.view.magnification;
    let shift = speckle_shift(&case.view, &case.motion);
    let plan = Plan::of(case, shift.sensor / scale, sampling)?;
    let grains = plan.grid.pixels as f64 / PIXELS_PER_GRAIN;
    let scatterers = (plan.patch / plan.cell).powi(2);
    Ok(2.0 * sampling.realisations as f64 * scatterers * pupil_samples(grains))
}

fn measure_motion(
    case: &MotionCase,
    sampling: &WaveSampling,
    key: Key,
    added: &(dyn Fn(usize) + Sync),
) -> Result<MotionRow> {
    let scale = case.view.magnification;
    let shift = speckle_shift(&case.view, &case.motion);
    let plan = Plan::of(case, shift.sensor / scale, sampling)?;
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
        seed_sum: seed_scalar_sum(&case.view, &case.motion),
        defocus_phase: phase,
        gamma_overlap: overlap_correlation(shift.delta),
        gamma_defocused: overlap_correlation_defocused(shift.delta, phase),
        displacement_um: (shift.sensor * 1e3).to_array(),
        waves,
    })
}

/// Sizes of one simulation.
struct Plan<'a> {
    case: &'a MotionCase,
    wavelength_mm: f64,
    ray: ViewRay,
    grid: ImageGrid,
    /// Compared pixels a side.
    region: usize,
    /// Width of the patch across the viewing ray, spacing of its points (mm).
    patch: f64,
    cell: f64,
}

impl Plan<'_> {
    /// The patch holds the region, its blur circle, the slip of the pattern against
    /// the surface and three grains to each side; and the periodic image's window is
    /// as wide as the patch. A narrower patch in a wider window was tried: beyond r
    /// grains lies 0.2/r of an Airy disc, and light missing there, which a shift of
    /// the pupil field would have turned in phase, raised γ by 4 % at r = 13. In a
    /// window filled by the patch the disc's wings wrap around and none is missing.
    fn of<'a>(
        case: &'a MotionCase,
        displacement: DVec2,
        sampling: &WaveSampling,
    ) -> Result<Plan<'a>> {
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
        Ok(Plan {
            case,
            wavelength_mm: sampling.wavelength_mm,
            grid: ImageGrid {
                pixels,
                pixel_mm,
                focus_distance: view.focus_distance,
            },
            region: (sampling.region_grains * PIXELS_PER_GRAIN).round() as usize,
            patch: pixels as f64 * pixel_mm * ray.length / view.focus_distance,
            // Out of focus a point of the image sums the whole blur circle.
            cell: (grain / SCATTERERS_PER_GRAIN.sqrt()).hypot(blur / 16.0),
            ray,
        })
    }

    fn points(&self, key: Key) -> Vec<RoughPoint> {
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

    /// The image with `share` of the motion done.
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
        let pupil = Pupil {
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
