//! Comparison of rendered frames of a defocused line with wave optics.

use crate::error::Result;
use crate::frame::Blur;
use crate::math::{Aperture, DVec3};
use crate::run::Simulation;
use crate::scene::Scene;
use crate::speckle::theory::integrated_contrast;
use crate::wave::defocus::{
    DISTANCE, DefocusedLine, LASER, PUPIL, WAVELENGTH, line_images, line_images_moved, mean_line,
};
use crate::wave::line_statistics::{
    LineBlock, LineMotionStatistics, LineStatistics, MeanWithError, line_figures, moved_figures,
};
use rayon::prelude::*;

/// Focal length of the rendered camera, mm.
const FOCAL_LENGTH: f64 = 50.0;
/// Number of evaluated grains along a frame. The field of a frame repeats after 144 grains.
const FRAME_GRAINS: usize = 128;

/// Returns a scene with the geometry of the wave-optics simulation: a camera perpendicular to a
/// plane with a laser line, defocused as in `line`. The part moves by `way` (mm) between the first
/// and second frame.
fn scene(line: &DefocusedLine, blur: Blur, speckle: bool, seed: u64, way: DVec3) -> Result<Scene> {
    let focus = line.focus_distance();
    let image_distance = 1.0 / (1.0 / FOCAL_LENGTH - 1.0 / focus);
    let pixels = line.pixels_per_grain;
    let pitch = WAVELENGTH * image_distance / PUPIL / pixels as f64;
    let rows = 2 * (line.window().reach + 2 * pixels) + 1;
    let columns = (FRAME_GRAINS + 2 * edge(line)) * pixels;
    // Waist radius perpendicular to the beam, for light at oblique incidence.
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
aperture_shape = {aperture}
focus_distance_mm = {focus:?}
resolution_px = [{columns}, {rows}]
pixel_pitch_um = {:?}
position_mm = [0, 0, {DISTANCE:?}]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 16
full_well_e = 300000
[scan]
moving_body = "part"
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
    scene.methods.defocus_model = Some(blur);
    Ok(scene)
}

/// Returns the number of grains at each end of a frame that do not receive all the blurred light.
fn edge(line: &DefocusedLine) -> usize {
    (0.5 * line.blur.abs() * line.aperture.extent()).ceil() as usize + 8
}

/// Returns the evaluated columns of a frame.
fn block(line: &DefocusedLine, simulation: &Simulation, frame: u32) -> LineBlock {
    let irradiance = simulation.irradiance(frame);
    let (columns, rows) = (irradiance.columns(), irradiance.rows());
    let image = irradiance.dense();
    let edge = edge(line) * line.pixels_per_grain;
    let kept = (edge..columns - edge).flat_map(|x| (0..rows).map(move |y| (x, y)));
    LineBlock {
        rows,
        light: kept.map(|(x, y)| image[y * columns + x] as f64).collect(),
    }
}

/// Renders frames of independent speckle, each [`FRAME_GRAINS`] long.
fn rendered(line: &DefocusedLine, blur: Blur, frames: u64, seed: u64) -> Result<Vec<LineBlock>> {
    let one = |k| {
        let scene = scene(line, blur, true, seed.wrapping_add(k), DVec3::X)?;
        Ok(block(line, &Simulation::new(&scene)?, 0))
    };
    (0..frames).into_par_iter().map(one).collect()
}

/// Renders pairs of frames, before and after a displacement of the part by `way` (mm).
fn rendered_moved(
    line: &DefocusedLine,
    way: DVec3,
    frames: u64,
    seed: u64,
) -> Result<Vec<[LineBlock; 2]>> {
    let one = |k| {
        let scene = scene(line, Blur::Coherent, true, seed.wrapping_add(k), way)?;
        let simulation = Simulation::new(&scene)?;
        Ok([0, 1].map(|frame| block(line, &simulation, frame)))
    };
    (0..frames).into_par_iter().map(one).collect()
}

/// Returns the mean light in each row of a frame without speckle.
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

/// Extent of the simulation in grains along the line, which is approximately the number of
/// independent columns.
#[derive(Debug, Clone, Copy)]
pub struct LensEffort {
    /// Length simulated by wave optics.
    pub waves: f64,
    /// Length rendered with each method.
    pub rendered: f64,
    /// Random seed of all speckle.
    pub seed: u64,
}

impl LensEffort {
    /// Returns the number of surfaces and the number of frames.
    fn blocks(&self, line: &DefocusedLine) -> [u64; 2] {
        let lengths = [line.columns_grains(), FRAME_GRAINS as f64];
        let blocks = [self.waves / lengths[0], self.rendered / lengths[1]];
        blocks.map(|n| n.ceil().max(2.0) as u64)
    }
}

/// Results for one line by wave optics, by blurring of the field, and by speckle texture times
/// blurred mean. Lengths are in pixels.
#[derive(Debug, Clone)]
pub struct LensRow {
    /// Line, pupil and defocus.
    pub line: DefocusedLine,
    /// Wave optics with exact path lengths.
    pub waves: LineStatistics,
    /// Rendering with [`Blur::Coherent`].
    pub coherent: LineStatistics,
    /// Rendering with [`Blur::Mean`].
    pub texture: LineStatistics,
    /// Largest deviation of the mean line from the incoherent sum of exact paths, relative to the
    /// peak of that sum. The first value is for the blurred mean without speckle, and the second
    /// for the mean of all coherent frames.
    pub mean_off: [f64; 2],
}

impl LensRow {
    /// Returns the ratio of centroid noise to its value from wave optics: coherent, then texture.
    pub fn noise_ratios(&self) -> [MeanWithError; 2] {
        [&self.coherent, &self.texture].map(|tier| tier.noise.ratio_to(&self.waves.noise))
    }

    /// Returns contrasts relative to the contrast of in-focus speckle integrated over pixels of
    /// this size. Rows are wave optics and coherent frames; columns are the centre of the line and
    /// its flanks.
    pub fn contrasts(&self) -> [[MeanWithError; 2]; 2] {
        let pixel = 1.0 / self.line.pixels_per_grain as f64;
        let of_pixel = MeanWithError {
            value: integrated_contrast(self.line.aperture, pixel),
            error: 0.0,
        };
        [&self.waves, &self.coherent].map(|figures| {
            [figures.contrast, figures.contrast_beside].map(|contrast| contrast.ratio_to(&of_pixel))
        })
    }
}

/// Computes one row of the comparison.
///
/// # Errors
/// Returns the errors of [`line_images`] and [`Simulation::new`].
pub fn lens_row(line: &DefocusedLine, effort: &LensEffort) -> Result<LensRow> {
    let window = line.window();
    let [surfaces, frames] = effort.blocks(line);
    let waves = line_figures(&line_images(line, surfaces, effort.seed)?, &window);
    let by = |blur| -> Result<LineStatistics> {
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
    // All rows are divided by one sum. Dividing each frame by its own sum would hide light that the
    // blur loses or adds.
    let of_frames: Vec<f64> = coherent.mean.iter().map(|row| row / light).collect();
    Ok(LensRow {
        line: *line,
        waves,
        coherent,
        texture,
        mean_off: [off(&in_window(&mean)), off(&of_frames)],
    })
}

/// Motion of the surface and its effect on the centroids of a line. Displacements are in pixels.
#[derive(Debug, Clone)]
pub struct LensMotion {
    /// Description of the motion.
    pub name: &'static str,
    /// Line, pupil and defocus.
    pub line: DefocusedLine,
    /// Wave optics with exact path lengths.
    pub waves: LineMotionStatistics,
    /// Rendering with [`Blur::Coherent`].
    pub coherent: LineMotionStatistics,
}

/// Computes the effect of three motions on a line. The first is by eighteen grains along the line.
/// The second is by half the line's standard deviation across it, within its plane. The third is
/// along the viewing ray, and displaces the laser line by the distance of the second.
///
/// # Errors
/// Returns the errors of [`lens_row`].
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

/// Returns all lines of the comparison: a circular pupil for all b/σ and σ/h, and some lines with a
/// square and an elliptic pupil.
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

/// Returns a line with pixels of 1/4 grain. Pixels are 1/8 grain for σ up to half a grain, to
/// resolve the line. They are 1/3 grain for a wide blur, because frames support blur radii up to
/// 128 pixels.
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
