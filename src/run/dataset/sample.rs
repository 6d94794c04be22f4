//! One sample of a data set: an image and its ground truth, as files.

use super::recipe::Recipe;
use crate::camera::CameraModel;
use crate::error::{Error, Place, Result};
use crate::frame::{Irradiance, LaserPlaneSampler};
use crate::math::{DVec3, Rigid};
use crate::report::formats::{npy, npy_header};
use crate::report::picture::encode_counts;
use crate::run::error_model::camera_from_laser;
use crate::run::recipe::Values;
use crate::run::simulation::Simulation;
use crate::scene::Scene;
use serde::Serialize;
use std::io::{self, Cursor, Write};
use toml::Value;
use zip::write::SimpleFileOptions;

/// Data that all samples of a set have in common.
pub struct Set<'a> {
    pub recipe: &'a Recipe,
    /// Parsed TOML of the scene.
    pub text: Value,
    pub base: Simulation,
}

/// Content of `NNNNNN.json` of a sample.
#[derive(Serialize)]
struct Described<'a> {
    sample: u64,
    frame: u32,
    seed: u64,
    values: &'a Values,
    /// Three rows of four: transform from the camera's frame to the part's frame, mm.
    part_from_camera: [[f64; 4]; 3],
    part_from_laser: [[f64; 4]; 3],
    camera: Intrinsics,
}

/// Projection of a point of the camera's frame, (X, Y, Z), to its pixel. The lens distorts (X/Z,
/// Y/Z) to (x′, y′). `matrix`·(x′, y′, 1) is the pixel in homogeneous coordinates.
#[derive(Serialize)]
struct Intrinsics {
    /// Columns and rows. The centre of the first pixel is at (0.5, 0.5).
    resolution_px: [u32; 2],
    /// Row by row, px: [[f, 0, c], [0, f, r], [0, 0, 1]] for a sensor without tilt.
    matrix: [[f64; 3]; 3],
    /// k1, k2, p1, p2, k3 of Brown and Conrady, in OpenCV's order.
    distortion: [f64; 5],
}

impl Intrinsics {
    /// Computes the intrinsics. The sensor point at u, v mm along its axes a and b, with the normal
    /// n, is d·z + u·a + v·b in the camera's frame, d behind the pupil. A ray λ·r intersects the
    /// sensor where λ = d·n_z/(n·r). It follows that u·(n·r) = d·(n_z·a − a_z·n)·r; v is analogous.
    fn of(camera: &CameraModel) -> Intrinsics {
        let axes = camera.sensor_axes();
        let n = axes.z_axis;
        let scale = camera.principal_distance / camera.pixel_pitch;
        let row = |axis: DVec3, centre: f64| (axis * n.z - n * axis.z) * scale + n * centre;
        let centre = camera.principal_point;
        let rows = [row(axes.x_axis, centre.x), row(axes.y_axis, centre.y), n];
        let lens = camera.distortion;
        let [k1, k2, k3] = lens.map_or([0.0; 3], |lens| lens.radial);
        let [p1, p2] = lens.map_or([0.0; 2], |lens| lens.tangential);
        Intrinsics {
            resolution_px: camera.resolution.to_array(),
            matrix: rows.map(|row| (row / n.z).to_array()),
            distortion: [k1, k2, p1, p2, k3],
        }
    }
}

impl Set<'_> {
    /// Returns the scene with these values. Errors: the scene cannot have them.
    pub fn scene(&self, values: &Values, seed: u64, sample: &str) -> Result<Scene> {
        let text = self.recipe.text_with(&self.text, values, seed)?;
        self.base
            .scene
            .reusing_part(text)
            .map_err(|error| match error {
                Error::Input(mut mistake) => {
                    mistake.file = self.recipe.written.path.clone();
                    mistake.place = Place::File;
                    mistake.found += &format!(" {sample}");
                    Error::Input(mistake)
                }
                other => other,
            })
    }

    /// Returns the files of a sample: extensions and contents. They depend only on recipe, scene
    /// and sample number.
    pub fn sample(&self, sample: u64) -> Result<Vec<(&'static str, Vec<u8>)>> {
        let (values, seed) = (self.recipe.draws.values(sample), self.recipe.seed(sample));
        let scene = self.scene(&values, seed, &format!("in sample {sample}"))?;
        let simulation = self.base.reusing_part(&scene)?;
        let frame = self.recipe.frame(sample, scene.scan.frames);
        let (pose, indirect) = (simulation.pose(frame), simulation.indirect(frame));
        let light = simulation.irradiance_with(&pose, &indirect);
        let image = simulation.counts(frame, &light);
        let shares = simulation.direct_and_indirect_with(&pose, &indirect);
        let (_, points) = simulation.measure_at(&pose, &image, || shares.clone());
        let view = simulation.view(frame);
        let described = Described {
            sample,
            frame,
            seed,
            values: &values,
            part_from_camera: rows(&view.part_from_camera),
            part_from_laser: rows(&view.part_from_laser),
            camera: Intrinsics::of(&scene.camera.model()),
        };
        let text = self.recipe.text_with(&self.text, &values, seed)?;
        // Writes to memory do not fail.
        let truth = truth(&simulation, frame, &light, &shares, |out| npy(out, &points))
            .map_err(Error::io("write the truth of", &self.recipe.written.path))?;
        Ok(vec![
            (
                "json",
                serde_json::to_vec(&described).expect("a sample is JSON"),
            ),
            ("npz", truth),
            (
                "png",
                encode_counts(&image, scene.camera.sensor.max_count()),
            ),
            ("toml", text.into_bytes()),
        ])
    }
}

/// Returns the ground truth of a frame as a file for NumPy's `load`.
fn truth(
    simulation: &Simulation,
    frame: u32,
    light: &Irradiance,
    shares: &[Irradiance; 2],
    points: impl FnOnce(&mut Vec<u8>) -> io::Result<()>,
) -> io::Result<Vec<u8>> {
    let scene = &simulation.scene;
    let [columns, rows] = scene
        .camera
        .sensor
        .resolution
        .to_array()
        .map(|n| n as usize);
    let layers = simulation.truth(frame);
    let mut depth = Vec::new();
    npy_header(&mut depth, "'<f4'", &[rows, columns])?;
    depth.extend(layers.depth.iter().flat_map(|z| z.to_le_bytes()));
    let mut normal = Vec::new();
    npy_header(&mut normal, "'<f4'", &[rows, columns, 3])?;
    normal.extend(layers.normal.iter().flatten().flat_map(|x| x.to_le_bytes()));
    let mut line = Vec::new();
    let found = scene.laser.fan.as_ref().map_or(Vec::new(), |fan| {
        let sheet = LaserPlaneSampler::new(fan, &scene.camera, &camera_from_laser(scene));
        sheet.profile(&simulation.view(frame))
    });
    let fields = "[('column', '<u4'), ('row_px', '<f8')]";
    npy_header(&mut line, fields, &[found.len()])?;
    for point in found {
        line.extend(point.column.to_le_bytes());
        line.extend(point.row.to_le_bytes());
    }
    let mut mask = Vec::new();
    npy_header(&mut mask, "'|u1'", &[rows, columns])?;
    mask.extend(line_mask(scene, &shares[0]));
    let mut noise_free = Vec::new();
    npy_header(&mut noise_free, "'<u2'", &[rows, columns])?;
    let counts = simulation.counts_without_noise(light).to_rows();
    noise_free.extend(counts.into_iter().flat_map(u16::to_le_bytes));
    let mut measured = Vec::new();
    points(&mut measured)?;
    let mut files = vec![
        ("depth.npy", depth),
        ("line.npy", line),
        ("mask.npy", mask),
        ("noise_free.npy", noise_free),
        ("normal.npy", normal),
        ("points.npy", measured),
    ];
    if simulation.plan.reflections.is_some() {
        let mut direct = Vec::new();
        npy_header(&mut direct, "'<f4'", &[rows, columns])?;
        let share = direct_share(shares);
        direct.extend(share.flat_map(f32::to_le_bytes));
        files.push(("direct.npy", direct));
    }

    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    // The fastest level is used, because depth compresses little better at higher levels. The time
    // is fixed for reproducible bytes.
    let options = SimpleFileOptions::default()
        .compression_level(Some(1))
        .last_modified_time(zip::DateTime::default());
    for (name, content) in files {
        archive.start_file(name, options)?;
        archive.write_all(&content)?;
    }
    Ok(archive.finish()?.into_inner())
}

/// Returns 1 for the pixels of the line and 0 for all others, row by row. On the line, the direct
/// light without speckle is at least one count. It is also at least 1/e² of the column maximum,
/// which is the edge of a laser beam.
fn line_mask(scene: &Scene, direct: &Irradiance) -> Vec<u8> {
    let sensor = &scene.camera.sensor;
    let electrons = sensor.electrons_per_irradiance(scene.laser.beam.wavelength);
    let count = (1.0 / (electrons * sensor.gain_dn_per_e)) as f32;
    let columns = direct.columns();
    let light = direct.dense();
    let mut least = vec![0.0f32; columns];
    for row in light.chunks_exact(columns) {
        for (least, &light) in least.iter_mut().zip(row) {
            *least = least.max(light);
        }
    }
    let edge = (-2.0f32).exp();
    for least in &mut least {
        *least = (*least * edge).max(count);
    }
    let row = |row: &[f32]| -> Vec<u8> {
        let lit = row.iter().zip(&least).map(|(light, least)| light >= least);
        lit.map(u8::from).collect()
    };
    light.chunks_exact(columns).flat_map(row).collect()
}

/// Returns the fraction of direct light in every pixel, from [direct, indirect] irradiance; 1 for
/// dark pixels.
fn direct_share(shares: &[Irradiance; 2]) -> impl Iterator<Item = f32> + use<> {
    let [direct, more] = shares.each_ref().map(Irradiance::dense);
    direct.into_iter().zip(more).map(|(direct, more)| {
        let all = direct + more;
        if all > 0.0 { direct / all } else { 1.0 }
    })
}

fn rows(pose: &Rigid) -> [[f64; 4]; 3] {
    let (turn, t) = (pose.rotation, pose.translation.to_array());
    [0, 1, 2].map(|i| {
        let [x, y, z] = turn.row(i).to_array();
        [x, y, z, t[i]]
    })
}
