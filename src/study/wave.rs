//! The wave-optics reference: its own table of motions and line widths, and one
//! patch of a scene.

use crate::accel::Ray;
use crate::error::{Error, Result, printable};
use crate::math::Aperture;
use crate::math::rng::{Key, Purpose};
use crate::math::{DVec2, DVec3};
use crate::report::picture::encode_for_eyes;
use crate::report::wave_plot::{centroid_plot, motion_plot};
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::ready;
use crate::run::surface_view::surface_view;
use crate::run::{Control, files};
use crate::scene::Scene;
use crate::speckle::anchor::rotation_vector;
use crate::speckle::frame_field::{FrameFields, PupilPlace, field_spec};
use crate::speckle::lookup::Coherence;
use crate::speckle::motion::{Motion, SurfaceView};
use crate::wave::cases::{REFERENCE_WAVELENGTH_MM, reference_cases};
use crate::wave::centroid::{CentroidRow, LineSetup, line_centroid_noise};
use crate::wave::grain::{GrainCase, GrainRow, grain_lengths, reference_grains};
use crate::wave::image::{
    ImageGrid, Pupil, WaveImage, intensity_at_focus, pupil_field_watched, pupil_samples,
};
use crate::wave::motion::{
    MotionCase, MotionRow, WaveSampling, measure_motions_watched, motion_terms,
};
use crate::wave::patch::{lit, patch_filling_view};
use crate::wave::spot::{SpotRow, limit_setups, spot_height_noise};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// How much to simulate.
#[derive(Debug, Clone, Copy)]
pub struct WaveEffort {
    /// Independent rough surfaces a row.
    pub realisations: u64,
    /// Of the rough surfaces.
    pub seed: u64,
}

/// One motion: by waves, by formula, and as the pattern lookup shows it.
#[derive(Debug, Serialize)]
pub struct ComparedMotion {
    /// Waves and formula.
    #[serde(flatten)]
    pub row: MotionRow,
    /// Correlation of intensities read from the fields of two frames, δ and φ apart;
    /// the displacement is the formula's by construction.
    pub gamma_texture: f64,
}

/// `wave.json`.
#[derive(Debug, Serialize)]
pub struct WaveSummary {
    /// One for each motion.
    pub motions: Vec<ComparedMotion>,
    /// Grains on the sensor; of a scene where it sees the patch.
    pub grains: Vec<GrainRow>,
    /// Empty for a scene's patch.
    pub centroids: Vec<CentroidRow>,
    /// Empty for a scene's patch.
    pub spots: Vec<SpotRow>,
    /// Where the pictures were written.
    #[serde(serialize_with = "printable::all_in_json")]
    pub pictures: Vec<PathBuf>,
}

/// Surfaces of a spot for each of a row of motions: a spot has one centroid, a line
/// one in each row.
const SPOTS_A_ROW: u64 = 4;

/// Diameter of the pupil of [`reference_grains`], mm: 50 mm at f/11.
const REFERENCE_PUPIL_MM: f64 = 50.0 / 11.0;

/// Width of the compared region of an image, grains.
const REGION_GRAINS: f64 = 24.0;

/// The reference motions and line widths, measured by waves beside what the
/// pattern lookup predicts: `wave.json`, `motion.svg` and `centroid.svg`.
pub fn wave_reference<'a>(
    effort: WaveEffort,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
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
    let textures = textures(&motions, effort.seed)?;
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

/// The patch's coherent image, `patch.png`, and what one, two and four steps of the scan
/// do to its speckle, `motion.svg`; all numbers in `wave.json`.
pub fn wave_patch<'a>(
    patch: &WavePatch,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
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
    let textures = textures(&motions, seed)?;
    files::write_bytes(&pictures[1], motion_plot(&motions, &textures).as_bytes())?;
    let summary = WaveSummary {
        motions: compared(motions, &textures),
        grains,
        centroids: Vec::new(),
        spots: Vec::new(),
        pictures,
    };
    let brightest = image.intensity.iter().copied().fold(0.0, f64::max);
    // Rows from top to bottom; a black picture where there is no light.
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

/// Along columns and rows of the sensor where it sees the patch; nothing if it does not.
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

/// The part's motion in the head's frame over some steps of the scan.
fn steps_of_scan(scene: &Scene, view: &SurfaceView, frame: u32, steps: f64) -> Motion {
    let after = scene.part_from_head_at(frame as f64 + steps);
    let moved = after.inverse() * scene.part_from_head(frame);
    Motion {
        part: moved.point(view.point) - view.point,
        rotation: rotation_vector(&moved.rotation),
        ..Motion::default()
    }
}

/// A row of motions; every row has surfaces of its own.
fn measured(
    case: &MotionCase,
    row: usize,
    sampling: &WaveSampling,
    control: &Control,
    added: &(dyn Fn(usize) + Sync),
) -> Result<MotionRow> {
    control.check()?;
    let seed = sampling.seed.wrapping_add(row as u64);
    let sampling = WaveSampling { seed, ..*sampling };
    Ok(measure_motions_watched(std::slice::from_ref(case), &sampling, added)?.remove(0))
}

/// γ as the fields of a scan's frames show it before and after each motion: the
/// correlation of 2¹⁹ readings, a grain apart, of 14 patterns: to 0.003.
fn textures(motions: &[MotionRow], seed: u64) -> Result<Vec<f64>> {
    let patterns = 0..14u64;
    let mut sums = vec![0.0; motions.len()];
    let side = 192;
    for pattern in patterns.clone() {
        let seed = Key::new(seed, Purpose::SpecklePattern).bits(pattern);
        let spec = field_spec(seed, Aperture::Circle);
        let fields = FrameFields::new(&spec, Coherence::FULL)?;
        let readings = |shift: f64, defocus: f64| -> Vec<f64> {
            let shift = DVec2::X * shift;
            let field = fields.field(&PupilPlace { shift, defocus });
            let place = |i: usize| DVec2::new((i % side) as f64, (i / side) as f64) * 2.65;
            let read = |i: usize| field.intensity(place(i)) as f64;
            (0..side * side).map(read).collect()
        };
        let start = readings(0.0, 0.0);
        for (sum, row) in sums.iter_mut().zip(motions) {
            let moved = readings(row.delta, row.defocus_phase);
            // Mean 1 and variance 1, exactly, over the ensemble.
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

/// Motions of the reference table: what its progress counts.
pub fn reference_motions() -> usize {
    reference_cases().len()
}

/// The scene's view of the surface on which the laser's axis falls, in the head's
/// frame.
fn patch_view(scene: &Scene, frame: u32, control: &Control) -> Result<SurfaceView> {
    let (_, accel) = ready::hierarchy_watched(scene, control)?;
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

/// The coherent image of the laser's light on the plane of a view, to be taken.
struct LineImage {
    view: SurfaceView,
    grain: f64,
    /// Width of image and patch, mm.
    window: f64,
}

impl LineImage {
    fn new(scene: &Scene, view: &SurfaceView) -> LineImage {
        let length = (view.pupil_centre - view.point).length();
        let grain = scene.laser.beam.wavelength * length / view.pupil_diameter;
        let laser_from_head = scene.head_from_laser.inverse();
        let from_laser = laser_from_head.point(view.point).length();
        let width = scene.laser.beam.radius(from_laser);
        LineImage {
            view: *view,
            grain,
            // The light and eight grains of the lens's wings, in a window of 40 at least.
            window: (4.0 * width + 8.0 * grain).max(40.0 * grain),
        }
    }

    /// Terms of its sum over scatterers and pupil.
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
        .points(Key::new(seed, Purpose::WaveScatterers));
        let laser_from_head = scene.head_from_laser.inverse();
        let irradiance = |p: DVec3| {
            let light = scene.laser.at(laser_from_head.point(p));
            light.map_or(0.0, |light| light.flux.length())
        };
        let scatterers = lit(&points, &view.source, view.point, irradiance);
        let pupil = Pupil {
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

/// What a patch of a scene asks of the wave-optics reference.
pub struct WavePatch {
    scene: Scene,
    cases: [MotionCase; 3],
    sampling: WaveSampling,
    image: LineImage,
    /// Of each case and of the image.
    terms: [f64; 4],
}

impl WavePatch {
    /// The patch on which the laser's axis falls in a frame.
    ///
    /// # Errors
    /// A frame that the scan does not have; no surface there; [`Error::Usage`] for a
    /// patch of more than [`MOST_TERMS`] terms.
    pub fn new(
        scene: &Scene,
        frame: u32,
        effort: WaveEffort,
        control: &Control,
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
        let image = LineImage::new(scene, &view);
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

    /// What its computation takes on so many threads, about.
    pub fn seconds(&self, threads: usize) -> f64 {
        self.terms.iter().sum::<f64>() * SECONDS_A_TERM / threads as f64
    }
}

/// Scatterers in the area of a grain of the line's image.
const SCATTERERS_A_GRAIN: f64 = 8.0;

/// Most terms of a patch: some hours on one core, and an image that fits in a gigabyte.
pub const MOST_TERMS: f64 = 1e12;

/// Time of a term on one core, transforms included: `lasertrace wave scenes/plane/scene.toml`.
const SECONDS_A_TERM: f64 = 6e-9;

/// Steps in which `wave_patch` tells its progress.
pub const PATCH_STEPS: u64 = 1000;
