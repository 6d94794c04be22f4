//! Rendered frames of a line out of focus, against waves.

use crate::error::Result;
use crate::frame::Blur;
use crate::math::{Aperture, DVec3};
use crate::run::Simulation;
use crate::scene::Scene;
use crate::speckle::theory::integrated_contrast;
use crate::wave::columns::{
    Block, LineFigures, Measured, MovedFigures, line_figures, moved_figures,
};
use crate::wave::defocus::{
    DISTANCE, DefocusedLine, LASER, PUPIL, WAVELENGTH, line_images, line_images_moved, mean_line,
};
use rayon::prelude::*;

/// Focal length of the rendered camera, mm.
const FOCAL_LENGTH: f64 = 50.0;
/// Columns that are measured of a frame, grains: a frame's field repeats after 144.
const FRAME_GRAINS: usize = 128;

/// A camera straight above a plane on which the laser draws a line, out of focus as `line` says, in the
/// same geometry as the waves'. The part moves by `way` (mm) from the first frame to the second.
fn scene(line: &DefocusedLine, blur: Blur, speckle: bool, seed: u64, way: DVec3) -> Result<Scene> {
    let focus = line.focus_distance();
    let image_distance = 1.0 / (1.0 / FOCAL_LENGTH - 1.0 / focus);
    let pixels = line.pixels_per_grain;
    let pitch = WAVELENGTH * image_distance / PUPIL / pixels as f64;
    let rows = 2 * (line.window().reach + 2 * pixels) + 1;
    let columns = (FRAME_GRAINS + 2 * edge(line)) * pixels;
    // Across the light that meets the plane at an angle.
    let waist = 2.0 * line.sigma * line.grain_mm() * LASER.z / LASER.length();
    let aperture = match line.aperture {
        Aperture::Circle => "\"circle\"".to_owned(),
        Aperture::Square => "\"square\"".to_owned(),
        Aperture::Ellipse(ratio) => format!("{{ ellipse = {ratio:?} }}"),
    };
    let vector = |v: DVec3| format!("[{:?}, {:?}, {:?}]", v.x, v.y, v.z);
    let text = format!(
        r#"
seed = {seed}
speckle = {speckle}
[part]
plane = {{ size_mm = [80, 80] }}
reflectance = 0.6
[laser]
wavelength_nm = {:?}
power_mw = 20
waist_radius_um = {:?}
waist_distance_mm = {:?}
position_mm = {}
direction = {}
line = {{ fan_deg = 20, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = {FOCAL_LENGTH:?}
f_number = {:?}
aperture = {aperture}
focus_distance_mm = {focus:?}
resolution_px = [{columns}, {rows}]
pixel_pitch_um = {:?}
position_mm = [0, 0, {DISTANCE:?}]
look_at_mm = [0, 0, 0]
columns = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 16
full_well_e = 300000
[scan]
moves = "part"
frames = 2
direction = {}
step_mm = {:?}
"#,
        WAVELENGTH * 1e6,
        waist * 1e3,
        LASER.length(),
        vector(LASER),
        vector(-LASER),
        FOCAL_LENGTH / PUPIL,
        pitch * 1e3,
        vector(way),
        way.length(),
    );
    let mut scene = Scene::parse(&text, "".as_ref())?;
    scene.methods.blur = Some(blur);
    Ok(scene)
}

/// Grains at each end of a frame's columns to which not all light is spread.
fn edge(line: &DefocusedLine) -> usize {
    (0.5 * line.blur.abs() * line.aperture.extent()).ceil() as usize + 8
}

/// The measured columns of a frame.
fn block(line: &DefocusedLine, simulation: &Simulation, frame: u32) -> Block {
    let irradiance = simulation.irradiance(frame);
    let (columns, rows) = (irradiance.columns(), irradiance.rows());
    let image = irradiance.dense();
    let edge = edge(line) * line.pixels_per_grain;
    let kept = (edge..columns - edge).flat_map(|x| (0..rows).map(move |y| (x, y)));
    Block {
        rows,
        light: kept.map(|(x, y)| image[y * columns + x] as f64).collect(),
    }
}

/// Frames of independent speckle, each of [`FRAME_GRAINS`].
fn rendered(line: &DefocusedLine, blur: Blur, frames: u64, seed: u64) -> Result<Vec<Block>> {
    let one = |k| {
        let scene = scene(line, blur, true, seed.wrapping_add(k), DVec3::X)?;
        Ok(block(line, &Simulation::new(&scene)?, 0))
    };
    (0..frames).into_par_iter().map(one).collect()
}

/// Frames before and after the part has moved by `way` (mm).
fn rendered_moved(
    line: &DefocusedLine,
    way: DVec3,
    frames: u64,
    seed: u64,
) -> Result<Vec<[Block; 2]>> {
    let one = |k| {
        let scene = scene(line, Blur::Coherent, true, seed.wrapping_add(k), way)?;
        let simulation = Simulation::new(&scene)?;
        Ok([0, 1].map(|frame| block(line, &simulation, frame)))
    };
    (0..frames).into_par_iter().map(one).collect()
}

/// Mean light of each row of a frame without speckle.
fn rendered_mean(line: &DefocusedLine) -> Result<Vec<f64>> {
    let scene = scene(line, Blur::Mean, false, 0, DVec3::X)?;
    let block = block(line, &Simulation::new(&scene)?, 0);
    let mut sum = vec![0.0; block.rows];
    let columns = block.light.len() / block.rows;
    for column in block.light.chunks_exact(block.rows) {
        (sum.iter_mut().zip(column)).for_each(|(sum, light)| *sum += light / columns as f64);
    }
    Ok(sum)
}

/// How much to simulate, in grains along the line, which is about the number of independent columns.
#[derive(Debug, Clone, Copy)]
pub struct LensEffort {
    /// By waves.
    pub waves: f64,
    /// By each way of rendering.
    pub rendered: f64,
    /// Of all speckle.
    pub seed: u64,
}

impl LensEffort {
    /// Surfaces and frames.
    fn blocks(&self, line: &DefocusedLine) -> [u64; 2] {
        let lengths = [line.columns_grains(), FRAME_GRAINS as f64];
        let blocks = [self.waves / lengths[0], self.rendered / lengths[1]];
        blocks.map(|n| n.ceil().max(2.0) as u64)
    }
}

/// One line by waves, by the field through the lens, and by texture times blurred mean. Lengths in pixels.
#[derive(Debug, Clone)]
pub struct LensRow {
    /// Line, pupil and defocus.
    pub line: DefocusedLine,
    /// Exact paths.
    pub waves: LineFigures,
    /// [`Blur::Coherent`].
    pub coherent: LineFigures,
    /// [`Blur::Mean`].
    pub texture: LineFigures,
    /// Largest difference of the mean line from the incoherent sum of exact paths, as a share of that
    /// line's peak: of the blurred mean, which has no speckle, and of the mean of all coherent frames.
    pub mean_off: [f64; 2],
}

impl LensRow {
    /// Centroid noise over that of waves: coherent, texture.
    pub fn noise_ratios(&self) -> [Measured; 2] {
        [&self.coherent, &self.texture].map(|tier| tier.noise.over(&self.waves.noise))
    }

    /// Contrasts over the contrast that pixels of this size leave of speckle in focus: of waves and of coherent
    /// frames, in the middle and beside it.
    pub fn contrasts(&self) -> [[Measured; 2]; 2] {
        let pixel = 1.0 / self.line.pixels_per_grain as f64;
        let of_pixel = Measured {
            value: integrated_contrast(self.line.aperture, pixel),
            error: 0.0,
        };
        [&self.waves, &self.coherent].map(|figures| {
            [figures.contrast, figures.contrast_beside].map(|contrast| contrast.over(&of_pixel))
        })
    }
}

/// One row of the comparison.
///
/// # Errors
/// As [`line_images`] and [`Simulation::new`].
pub fn lens_row(line: &DefocusedLine, effort: &LensEffort) -> Result<LensRow> {
    let window = line.window();
    let [surfaces, frames] = effort.blocks(line);
    let waves = line_figures(&line_images(line, surfaces, effort.seed)?, &window);
    let by = |blur| -> Result<LineFigures> {
        let blocks = rendered(line, blur, frames, effort.seed)?;
        Ok(line_figures(&blocks, &window))
    };
    let (coherent, texture) = (by(Blur::Coherent)?, by(Blur::Mean)?);
    let in_window = |rows: &[f64]| {
        let middle = rows.len() / 2;
        let rows = &rows[middle - window.reach..=middle + window.reach];
        let all: f64 = rows.iter().sum();
        rows.iter().map(|row| row / all).collect::<Vec<f64>>()
    };
    let exact = in_window(&mean_line(line)?);
    let peak = exact.iter().copied().fold(0.0, f64::max);
    let off = |rows: &[f64]| {
        let differences = exact.iter().zip(rows).map(|(a, b)| (a - b).abs() / peak);
        differences.fold(0.0, f64::max)
    };
    let mean = rendered_mean(line)?;
    let middle = mean.len() / 2;
    let light: f64 = mean[middle - window.reach..=middle + window.reach]
        .iter()
        .sum();
    // Not each by its own sum: light that the lens loses or makes is a difference, too.
    let of_frames: Vec<f64> = coherent.mean.iter().map(|row| row / light).collect();
    Ok(LensRow {
        line: *line,
        waves,
        coherent,
        texture,
        mean_off: [off(&in_window(&mean)), off(&of_frames)],
    })
}

/// A motion of the surface and what it does to a line's centroids. Ways in pixels.
#[derive(Debug, Clone)]
pub struct LensMotion {
    /// In words.
    pub name: &'static str,
    /// Line, pupil and defocus.
    pub line: DefocusedLine,
    /// Exact paths.
    pub waves: MovedFigures,
    /// [`Blur::Coherent`].
    pub coherent: MovedFigures,
}

/// What three motions do to a line: eighteen grains along it, half its standard deviation across it in its
/// plane, and along the viewing ray until the laser meets a place as far across.
///
/// # Errors
/// As [`lens_row`].
pub fn lens_motions(line: &DefocusedLine, effort: &LensEffort) -> Result<Vec<LensMotion>> {
    let window = line.window();
    let [surfaces, frames] = effort.blocks(line);
    let (grain, across) = (line.grain_mm(), 0.5 * line.sigma * line.grain_mm());
    let motions = [
        ("along the line", DVec3::X * 18.0 * grain),
        ("across the line", DVec3::Y * across),
        (
            "out of the plane",
            DVec3::Z * across * LASER.z / LASER.y.abs(),
        ),
    ];
    let furthest = 40 * line.pixels_per_grain;
    let row = |(name, way)| -> Result<LensMotion> {
        let waves = line_images_moved(line, way, surfaces, effort.seed)?;
        let coherent = rendered_moved(line, way, frames, effort.seed)?;
        Ok(LensMotion {
            name,
            line: *line,
            waves: moved_figures(&waves, &window, furthest),
            coherent: moved_figures(&coherent, &window, furthest),
        })
    };
    motions.into_iter().map(row).collect()
}

/// All lines of the comparison: the circle over b/σ and σ/h, and some of a square and an ellipse.
pub fn reference_lines() -> Vec<DefocusedLine> {
    let of = |aperture, sigmas: &[f64], blurs: &[f64]| {
        let pairs = sigmas
            .iter()
            .flat_map(|s| blurs.iter().map(move |b| (*s, *b)));
        let lines = pairs.map(|(sigma, over)| defocused_line(aperture, sigma, sigma * over));
        lines.collect::<Vec<_>>()
    };
    let all = [0.0, 1.0, 2.0, 4.0, 8.0];
    [
        of(Aperture::Circle, &[0.5, 1.0, 2.0, 4.0, 8.0], &all),
        of(Aperture::Square, &[1.0, 4.0], &[0.0, 2.0, 8.0]),
        of(Aperture::Ellipse(0.5), &[2.0, 4.0], &[0.0, 2.0, 8.0]),
    ]
    .concat()
}

/// A line in pixels of a quarter of a grain: an eighth where it is no wider than half a grain, so that
/// it has a shape; and a third where the blur is as wide as 128 pixels to each side, how far frames spread
/// light.
pub fn defocused_line(aperture: Aperture, sigma: f64, blur: f64) -> DefocusedLine {
    DefocusedLine {
        aperture,
        sigma,
        blur,
        pixels_per_grain: match (sigma <= 0.5, blur.abs() > 40.0) {
            (true, _) => 8,
            (false, false) => 4,
            (false, true) => 3,
        },
    }
}
