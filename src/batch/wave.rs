//! The wave-optics reference: its own table of motions and line widths, and one
//! patch of a scene.

use super::simulation::Simulation;
use super::surface_view::surface_view;
use super::{Control, files};
use crate::accel::Ray;
use crate::error::{Error, Result};
use crate::inspect::picture::encode_for_eyes;
use crate::math::rng::{Key, Purpose};
use crate::math::{DVec2, DVec3};
use crate::scene::Scene;
use crate::speckle::anchor::rotation_vector;
use crate::speckle::frame_field::{FrameFields, PupilPlace, field_spec};
use crate::speckle::lookup::Coherence;
use crate::speckle::motion::{Motion, SurfaceView};
use crate::speckle::pattern::Aperture;
use crate::speckle::wave::{ImageGrid, Pupil, WaveImage, intensity_at_focus, pupil_field};
use crate::speckle::wave_cases::{REFERENCE_WAVELENGTH_MM, reference_cases};
use crate::speckle::wave_centroid::{CentroidRow, LineSetup, line_centroid_noise};
use crate::speckle::wave_grain::{GrainCase, GrainRow, grain_lengths, reference_grains};
use crate::speckle::wave_motion::{MotionCase, MotionRow, WaveSampling, measure_motions};
use crate::speckle::wave_patch::{lit, patch_filling_view};
use crate::speckle::wave_plot::{centroid_plot, motion_plot};
use crate::speckle::wave_spot::{SpotRow, limit_setups, spot_height_noise};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// How much to simulate.
#[derive(Debug, Clone, Copy)]
pub struct WaveEffort {
    /// Independent rough surfaces a row.
    pub realisations: u64,
    pub seed: u64,
}

/// One motion: by waves, by formula, and as the pattern lookup shows it.
#[derive(Debug, Serialize)]
pub struct ComparedMotion {
    #[serde(flatten)]
    pub row: MotionRow,
    /// Correlation of intensities read from the fields of two frames, δ and φ apart;
    /// the displacement is the formula's by construction.
    pub gamma_texture: f64,
}

/// `wave.json`.
#[derive(Debug, Serialize)]
pub struct WaveSummary {
    pub motions: Vec<ComparedMotion>,
    /// Grains on the sensor; of a scene where it sees the patch.
    pub grains: Vec<GrainRow>,
    /// Empty for a scene's patch.
    pub centroids: Vec<CentroidRow>,
    /// Empty for a scene's patch.
    pub spots: Vec<SpotRow>,
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
pub fn wave_reference(effort: WaveEffort, out: &Path, control: &Control) -> Result<WaveSummary> {
    files::create_folder(out)?;
    let sampling = WaveSampling {
        wavelength_mm: REFERENCE_WAVELENGTH_MM,
        region_grains: REGION_GRAINS,
        realisations: effort.realisations,
        seed: effort.seed,
    };
    let motions = measured(&reference_cases(), &sampling, control)?;
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

/// The patch on which the laser's axis falls in a frame: its coherent image,
/// `patch.png`, and what one, two and four steps of the scan do to its speckle,
/// `motion.svg`; all numbers in `wave.json`.
pub fn wave_patch(
    scene: &Scene,
    frame: u32,
    effort: WaveEffort,
    out: &Path,
    control: &Control,
) -> Result<WaveSummary> {
    super::check_frame(scene, frame)?;
    files::create_folder(out)?;
    let view = patch_view(scene, frame)?;
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
    let motions = measured(&cases, &sampling, control)?;
    let grains = grain_lengths(
        &grains_at(scene, &view),
        scene.camera.lens.pupil_diameter(),
        scene.laser.beam.wavelength,
        effort.seed,
    )?;
    let image = line_image(scene, &view, effort.seed)?;
    let pictures = vec![out.join("patch.png"), out.join("motion.svg")];
    let textures = textures(&motions, effort.seed)?;
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

fn measured(
    cases: &[MotionCase],
    sampling: &WaveSampling,
    control: &Control,
) -> Result<Vec<MotionRow>> {
    let mut rows = Vec::new();
    for (i, case) in cases.iter().enumerate() {
        control.check()?;
        // One by one for the progress; every row keeps its own surfaces.
        let seed = sampling.seed.wrapping_add(i as u64);
        let sampling = WaveSampling { seed, ..*sampling };
        rows.extend(measure_motions(std::slice::from_ref(case), &sampling)?);
        (control.progress)(i as u64 + 1);
    }
    Ok(rows)
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
fn patch_view(scene: &Scene, frame: u32) -> Result<SurfaceView> {
    let simulation = Simulation::new(scene)?;
    let laser = simulation.view(frame).part_from_laser;
    let ray = Ray {
        origin: laser.translation,
        direction: laser.rotation.z_axis,
        t_max: f64::INFINITY,
    };
    let hit = simulation.accel.closest(&[ray], |_, _| true)[0].ok_or_else(|| {
        Error::Usage(format!(
            "--frame {frame}: the axis of the laser meets no surface there"
        ))
    })?;
    let head_from_part = scene.part_from_head(frame).inverse();
    Ok(SurfaceView {
        normal: head_from_part.vector(hit.normal),
        ..surface_view(scene, Some(head_from_part.point(hit.point)))
    })
}

/// Coherent image of the laser's light on the plane of `view`.
fn line_image(scene: &Scene, view: &SurfaceView, seed: u64) -> Result<WaveImage> {
    let ray = view.pupil_centre - view.point;
    let length = ray.length();
    let wavelength = scene.laser.beam.wavelength;
    let grain = wavelength * length / view.pupil_diameter;
    let right = (view.image_x - ray * (view.image_x.dot(ray) / ray.length_squared())).normalize();
    let up = (ray / length).cross(right);
    let laser_from_head = scene.head_from_laser.inverse();
    let width = scene
        .laser
        .beam
        .radius(laser_from_head.point(view.point).length());
    // The light and eight grains of the lens's wings, in a window of 40 at least.
    let window = (4.0 * width + 8.0 * grain).max(40.0 * grain);
    let pixels = (window / grain * 8.0 / 16.0).ceil() as usize * 16;
    let grid = ImageGrid {
        pixels,
        pixel_mm: window / pixels as f64,
        focus_distance: length,
    };
    let points = patch_filling_view(
        view.point,
        view.normal,
        [right, up],
        DVec2::splat(window),
        DVec2::splat(grain / 8f64.sqrt()),
        2.0 * wavelength,
    )
    .points(Key::new(seed, Purpose::WaveScatterers));
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
    };
    let field = pupil_field(&scatterers, &pupil, wavelength, &grid)?;
    Ok(intensity_at_focus(&field, &grid))
}
