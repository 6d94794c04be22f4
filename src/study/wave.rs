//! Comparison with the wave-optics reference: a table of reference motions and line widths, and a
//! patch of a scene.

use crate::accel::Ray;
use crate::error::{Error, Result, printable};
use crate::math::Aperture;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3, rotation_vector};
use crate::report::picture::encode_for_eyes;
use crate::report::wave_plot::{centroid_plot, motion_plot};
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::setup;
use crate::run::surface_view::surface_view;
use crate::run::{RunControl, files};
use crate::scene::Scene;
use crate::speckle::frame_field::{FrameFields, PupilPosition, field_spec};
use crate::speckle::lookup::Coherence;
use crate::speckle::motion::{RigidMotion, SurfaceView};
use crate::wave::cases::{REFERENCE_WAVELENGTH_MM, reference_cases};
use crate::wave::centroid::{CentroidRow, LineSetup, line_centroid_noise};
use crate::wave::grain::{GrainCase, GrainRow, grain_lengths, reference_grains};
use crate::wave::image::{
    ImageGrid, WaveImage, WavePupil, intensity_at_focus, pupil_field_watched, pupil_samples,
};
use crate::wave::motion::{
    MotionCase, MotionRow, WaveSampling, measure_motions_watched, motion_terms,
};
use crate::wave::patch::{lit, patch_filling_view};
use crate::wave::spot::{SpotRow, limit_setups, spot_height_noise};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Extent of the simulation.
#[derive(Debug, Clone, Copy)]
pub struct WaveEffort {
    /// Number of independent rough surfaces per table row.
    pub realisations: u64,
    /// Random seed of the rough surfaces.
    pub seed: u64,
}

/// Correlation for one motion: by wave optics, by formula, and from the pattern lookup.
#[derive(Debug, Serialize)]
pub struct ComparedMotion {
    /// Results of wave optics and formula.
    #[serde(flatten)]
    pub row: MotionRow,
    /// Correlation of the intensities interpolated from the fields of two frames, at the lag δ and
    /// defocus phase φ. The displacement equals the formula by construction.
    pub gamma_texture: f64,
}

/// Content of `wave.json`.
#[derive(Debug, Serialize)]
pub struct WaveSummary {
    /// Results for each motion.
    pub motions: Vec<ComparedMotion>,
    /// Speckle grains on the sensor. For a scene, they are at the image of the patch.
    pub grains: Vec<GrainRow>,
    /// Centroid noise; empty for a patch of a scene.
    pub centroids: Vec<CentroidRow>,
    /// Spots; empty for a patch of a scene.
    pub spots: Vec<SpotRow>,
    /// Paths of the plots.
    #[serde(serialize_with = "printable::all_in_json")]
    pub pictures: Vec<PathBuf>,
}

/// Number of spot surfaces per row of motions, relative to line surfaces. A spot has one centroid,
/// whereas a line has one in each row.
const SPOTS_A_ROW: u64 = 4;

/// Diameter of the pupil of [`reference_grains`], mm: 50 mm at f/11.
const REFERENCE_PUPIL_MM: f64 = 50.0 / 11.0;

/// Width of the compared region of an image, in grains.
const REGION_GRAINS: f64 = 24.0;

/// Computes the reference motions and line widths by wave optics, together with the predictions of
/// the pattern lookup. Writes `wave.json`, `motion.svg` and `centroid.svg`.
pub fn wave_reference<'a>(
    effort: WaveEffort,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<WaveSummary> {
    let names = Names::of(["wave.json", "motion.svg", "centroid.svg"]);
    let out = out.into().claim(&[], &names)?.path;
    let sampling = WaveSampling {
        wavelength_mm: REFERENCE_WAVELENGTH_MM,
        region_grains: REGION_GRAINS,
        realisations: effort.realisations,
        seed: effort.seed,
    };
    let mut motions = Vec::new();
    for (i, case) in reference_cases().iter().enumerate() {
        motions.push(measured(case, i, &sampling, control, &|_| {})?);
        (control.progress)(i as u64 + 1);
    }
    let centroids = line_centroid_noise(&LineSetup {
        wavelength_mm: REFERENCE_WAVELENGTH_MM,
        distance: 300.0,
        pupil_diameter: 10.0,
        widths_grains: vec![0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0],
        realisations: effort.realisations,
        seed: effort.seed,
    })?;
    let mut spots = Vec::new();
    for setup in limit_setups(SPOTS_A_ROW * effort.realisations, effort.seed) {
        control.check()?;
        spots.push(spot_height_noise(&setup)?);
    }
    let grains = grain_lengths(
        &reference_grains(),
        REFERENCE_PUPIL_MM,
        REFERENCE_WAVELENGTH_MM,
        effort.seed,
    )?;
    let pictures = vec![out.join("motion.svg"), out.join("centroid.svg")];
    let textures = pattern_correlations(&motions, effort.seed)?;
    files::write_bytes(&pictures[0], motion_plot(&motions, &textures).as_bytes())?;
    let summary = WaveSummary {
        motions: compared(motions, &textures),
        grains,
        centroids,
        spots,
        pictures,
    };
    files::write_bytes(
        &summary.pictures[1],
        centroid_plot(&summary.centroids).as_bytes(),
    )?;
    files::write_json(&out.join("wave.json"), &summary)?;
    Ok(summary)
}

/// Computes the coherent image of the patch (`patch.png`), and the speckle change over one, two and
/// four steps of the scan (`motion.svg`). Writes all numbers to `wave.json`.
pub fn wave_patch<'a>(
    patch: &WavePatch,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<WaveSummary> {
    let names = Names::of(["wave.json", "motion.svg", "patch.png"]);
    let out = out.into().claim(&patch.scene.inputs, &names)?.path;
    let seed = patch.sampling.seed;
    let all: f64 = patch.terms.iter().sum();
    let done = AtomicU64::new(0);
    let added = |terms: usize| {
        let share = (done.fetch_add(terms as u64, Relaxed) as f64 / all).min(1.0);
        (control.progress)((share * PATCH_STEPS as f64) as u64);
    };
    let mut motions = Vec::new();
    for (i, case) in patch.cases.iter().enumerate() {
        motions.push(measured(case, i, &patch.sampling, control, &added)?);
    }
    control.check()?;
    let image = patch.image.take(&patch.scene, seed, &added)?;
    control.check()?;
    let scene = &patch.scene;
    let grains = grain_lengths(
        &grains_at(scene, &patch.image.view),
        scene.camera.lens.pupil_diameter(),
        scene.laser.beam.wavelength,
        seed,
    )?;
    let pictures = vec![out.join("patch.png"), out.join("motion.svg")];
    let textures = pattern_correlations(&motions, seed)?;
    files::write_bytes(&pictures[1], motion_plot(&motions, &textures).as_bytes())?;
    let summary = WaveSummary {
        motions: compared(motions, &textures),
        grains,
        centroids: Vec::new(),
        spots: Vec::new(),
        pictures,
    };
    let brightest = image.intensity.iter().copied().fold(0.0, f64::max);
    // Rows are in top-to-bottom order. The image is black if there is no light.
    let scale = 65535.0 / brightest.max(f64::MIN_POSITIVE);
    let width = image.grid.pixels;
    let counts: Vec<u16> = image
        .intensity
        .chunks(width)
        .rev()
        .flatten()
        .map(|i| (i * scale) as u16)
        .collect();
    let png = encode_for_eyes(&counts, width, u16::MAX);
    files::write_bytes(&summary.pictures[0], &png)?;
    files::write_json(&out.join("wave.json"), &summary)?;
    Ok(summary)
}

/// Returns the grains along columns and rows of the sensor at the image of the patch; empty if the
/// sensor does not see the patch.
fn grains_at(scene: &Scene, view: &SurfaceView) -> Vec<GrainCase> {
    let camera = &scene.camera;
    let Some(pixel) = camera.project(scene.head_from_camera.inverse().point(view.point)) else {
        return Vec::new();
    };
    let place = camera.sensor_point(pixel);
    let step = |to: DVec2| (camera.sensor_point(pixel + to) - place).normalize();
    let along = [("along a row", DVec2::X), ("along a column", DVec2::Y)];
    let case = |(name, to): (&str, DVec2)| GrainCase {
        name: name.into(),
        place,
        along: step(to),
    };
    along.map(case).into()
}

/// Returns the motion of the part in the head frame over `steps` steps of the scan.
fn steps_of_scan(scene: &Scene, view: &SurfaceView, frame: u32, steps: f64) -> RigidMotion {
    let after = scene.part_from_head_at(frame as f64 + steps);
    let moved = after.inverse() * scene.part_from_head(frame);
    RigidMotion {
        part: moved.point(view.point) - view.point,
        rotation: rotation_vector(&moved.rotation),
        ..RigidMotion::default()
    }
}

/// Computes one row of motions. Every row has independent surfaces.
fn measured(
    case: &MotionCase,
    row: usize,
    sampling: &WaveSampling,
    control: &RunControl,
    added: &(dyn Fn(usize) + Sync),
) -> Result<MotionRow> {
    control.check()?;
    let seed = sampling.seed.wrapping_add(row as u64);
    let sampling = WaveSampling { seed, ..*sampling };
    Ok(measure_motions_watched(std::slice::from_ref(case), &sampling, added)?.remove(0))
}

/// Estimates γ from the fields of frames before and after each motion. It is the correlation of 2¹⁹
/// samples of 14 patterns, separated by one grain, with a standard error of 0.003.
fn pattern_correlations(motions: &[MotionRow], seed: u64) -> Result<Vec<f64>> {
    let patterns = 0..14u64;
    let mut sums = vec![0.0; motions.len()];
    let side = 192;
    for pattern in patterns.clone() {
        let seed = RngKey::new(seed, Purpose::SpecklePattern).bits(pattern);
        let spec = field_spec(seed, Aperture::Circle);
        let fields = FrameFields::new(&spec, Coherence::FULL)?;
        let readings = |shift: f64, defocus: f64| -> Vec<f64> {
            let shift = DVec2::X * shift;
            let field = fields.field(&PupilPosition { shift, defocus });
            let place = |i: usize| DVec2::new((i % side) as f64, (i / side) as f64) * 2.65;
            let read = |i: usize| field.intensity(place(i)) as f64;
            (0..side * side).map(read).collect()
        };
        let start = readings(0.0, 0.0);
        for (sum, row) in sums.iter_mut().zip(motions) {
            let moved = readings(row.delta, row.defocus_phase);
            // Mean and variance of the ensemble are exactly 1.
            let products = start.iter().zip(&moved).map(|(a, b)| (a - 1.0) * (b - 1.0));
            *sum += products.sum::<f64>() / (side * side) as f64;
        }
    }
    Ok(sums
        .into_iter()
        .map(|sum| sum / patterns.end as f64)
        .collect())
}

fn compared(motions: Vec<MotionRow>, textures: &[f64]) -> Vec<ComparedMotion> {
    let compare = |(row, &gamma_texture)| ComparedMotion { row, gamma_texture };
    motions.into_iter().zip(textures).map(compare).collect()
}

/// Returns the number of motions of the reference table, for progress reports.
pub fn reference_motions() -> usize {
    reference_cases().len()
}

/// Returns the view of the surface at the intersection with the laser axis, in the head frame.
fn patch_view(scene: &Scene, frame: u32, control: &RunControl) -> Result<SurfaceView> {
    let (_, accel) = setup::hierarchy_watched(scene, control)?;
    let laser = scene.part_from_head(frame) * scene.head_from_laser;
    let ray = Ray {
        origin: laser.translation,
        direction: laser.rotation.z_axis,
        t_max: f64::INFINITY,
    };
    let hit = accel.closest(&[ray], |_, _| true)[0].ok_or_else(|| {
        Error::Usage(format!(
            "frame {frame}: the axis of the laser meets no surface there"
        ))
    })?;
    let head_from_part = scene.part_from_head(frame).inverse();
    Ok(SurfaceView {
        normal: head_from_part.vector(hit.normal),
        ..surface_view(scene, Some(head_from_part.point(hit.point)))
    })
}

/// Geometry of the coherent image of the laser light on the plane of a view.
struct CoherentLineImage {
    view: SurfaceView,
    grain: f64,
    /// Width of image and patch, mm.
    window: f64,
}

impl CoherentLineImage {
    fn new(scene: &Scene, view: &SurfaceView) -> CoherentLineImage {
        let length = (view.pupil_centre - view.point).length();
        let grain = scene.laser.beam.wavelength * length / view.pupil_diameter;
        let laser_from_head = scene.head_from_laser.inverse();
        let width = scene.laser.radius(laser_from_head.point(view.point));
        CoherentLineImage {
            view: *view,
            grain,
            // The window contains the light and eight grains for the wings of the point spread
            // function. It has a width of at least 40 grains.
            window: (4.0 * width + 8.0 * grain).max(40.0 * grain),
        }
    }

    /// Returns the number of terms of the sum over scatterers and pupil samples.
    fn terms(&self) -> f64 {
        let grains = self.window / self.grain;
        SCATTERERS_A_GRAIN * grains * grains * pupil_samples(grains)
    }

    fn take(&self, scene: &Scene, seed: u64, added: &(dyn Fn(usize) + Sync)) -> Result<WaveImage> {
        let view = &self.view;
        let ray = view.pupil_centre - view.point;
        let length = ray.length();
        let wavelength = scene.laser.beam.wavelength;
        let right = view.image_x - ray * (view.image_x.dot(ray) / ray.length_squared());
        let right = right.normalize();
        let up = (ray / length).cross(right);
        let pixels = (self.window / self.grain * 8.0 / 16.0).ceil() as usize * 16;
        let grid = ImageGrid {
            pixels,
            pixel_mm: self.window / pixels as f64,
            focus_distance: length,
        };
        let points = patch_filling_view(
            view.point,
            view.normal,
            [right, up],
            DVec2::splat(self.window),
            DVec2::splat(self.grain / SCATTERERS_A_GRAIN.sqrt()),
            2.0 * wavelength,
        )
        .points(RngKey::new(seed, Purpose::WaveScatterers));
        let laser_from_head = scene.head_from_laser.inverse();
        let irradiance = |p: DVec3| {
            let light = scene.laser.at(laser_from_head.point(p));
            light.map_or(0.0, |light| light.flux.length())
        };
        let scatterers = lit(&points, &view.source, view.point, irradiance);
        let pupil = WavePupil {
            centre: view.pupil_centre,
            right,
            up,
            diameter: view.pupil_diameter,
            aperture: scene.camera.lens.aperture,
        };
        let sampled = || added(scatterers.len());
        let field = pupil_field_watched(&scatterers, &pupil, wavelength, &grid, &sampled)?;
        Ok(intensity_at_focus(&field, &grid))
    }
}

/// Input of the wave-optics reference for a patch of a scene.
pub struct WavePatch {
    scene: Scene,
    cases: [MotionCase; 3],
    sampling: WaveSampling,
    image: CoherentLineImage,
    /// Number of terms for each case and for the image.
    terms: [f64; 4],
}

impl WavePatch {
    /// Returns the patch at the intersection of the laser axis with the surface in a frame.
    ///
    /// # Errors
    /// Returns an error if the scan has no such frame or there is no surface, and [`Error::Usage`]
    /// for a patch of more than [`MOST_TERMS`] terms.
    pub fn new(
        scene: &Scene,
        frame: u32,
        effort: WaveEffort,
        control: &RunControl,
    ) -> Result<WavePatch> {
        crate::run::check_frame(scene, frame)?;
        let view = patch_view(scene, frame, control)?;
        let cases = [1.0, 2.0, 4.0].map(|steps| MotionCase {
            name: format!("{steps} steps of the scan"),
            view,
            motion: steps_of_scan(scene, &view, frame, steps),
        });
        let sampling = WaveSampling {
            wavelength_mm: scene.laser.beam.wavelength,
            region_grains: REGION_GRAINS,
            realisations: effort.realisations,
            seed: effort.seed,
        };
        let image = CoherentLineImage::new(scene, &view);
        let mut terms = [0.0, 0.0, 0.0, image.terms()];
        for (terms, case) in terms.iter_mut().zip(&cases) {
            *terms = motion_terms(case, &sampling)?;
        }
        let all: f64 = terms.iter().sum();
        if all <= MOST_TERMS {
            return Ok(WavePatch {
                scene: scene.clone(),
                cases,
                sampling,
                image,
                terms,
            });
        }
        if !all.is_finite() {
            return Err(Error::Usage(format!(
                "the wave-optics reference of {}: the patch under the laser, the grains or the motion have no finite \
                 size, expected a camera some way off the patch and steps that it sees",
                printable::path(&scene.path)
            )));
        }
        let window_mm = image.window;
        let grains = window_mm / image.grain;
        Err(Error::Usage(format!(
            "the wave-optics reference of {} adds up {all:.1e} terms, at most {MOST_TERMS:.0e} \
             are taken (some {:.0} hours on one core): the laser's light with its surroundings \
             is {window_mm:.2} mm or {grains:.0} grains wide, motions take {:.1e} terms; take a \
             narrower beam, a smaller aperture, shorter steps or fewer realisations",
            scene.path.display(),
            MOST_TERMS * SECONDS_A_TERM / 3600.0,
            all - terms[3],
        )))
    }

    /// Returns the approximate computing time with `threads` threads, s.
    pub fn seconds(&self, threads: usize) -> f64 {
        self.terms.iter().sum::<f64>() * SECONDS_A_TERM / threads as f64
    }
}

/// Number of scatterers in the area of one grain of the line's image.
const SCATTERERS_A_GRAIN: f64 = 8.0;

/// Maximum number of terms of a patch. It corresponds to some hours on one core and an image below
/// one gigabyte.
pub const MOST_TERMS: f64 = 1e12;

/// Time per term on one core including transforms, s. Measured with `lasertrace wave
/// scenes/plane/scene.toml`.
const SECONDS_A_TERM: f64 = 6e-9;

/// Number of progress steps of `wave_patch`.
pub const PATCH_STEPS: u64 = 1000;
