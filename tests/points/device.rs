//! Outputs as devices give them: height maps, and several lines per column.

use crate::{control, scan_options};
use lasertrace::Counts;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::DVec3;
use lasertrace::profile::{PeakSettings, find_lines};
use lasertrace::run::{Export, Simulation, scan as scan_to_folder};
use lasertrace::scene::Scene;
use serde_json::Value;
use std::path::Path;

/// A scan of a step, with points without a valid line at the step.
fn scene(step_mm: f64, tilt_deg: f64, measure: &str) -> Scene {
    let text = format!(
        "seed = 3
speckle = true
[part]
step_block = {{ size_mm = [20, 20, 3], step_mm = {step_mm} }}
position_mm = [0, 0, -3]
rotation_deg = [{tilt_deg}, 2, 3]
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = 40
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 3, profile = \"uniform\", direction = [1, 0, 0] }}
[camera]
focal_length_mm = 25
f_number = 8
focus_distance_mm = 150
resolution_px = [120, 160]
pixel_pitch_um = 8
position_mm = [0, -106, 106]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.1
bit_depth = 12
full_well_e = 30000
read_noise_e = 8
[scan]
direction = [0, 1, 0]
step_mm = 0.1
frames = 12
[measure]
{measure}"
    );
    Scene::parse(&text, Path::new("")).unwrap()
}

fn image(path: &Path) -> (usize, usize, Vec<u16>) {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!(info.bit_depth, png::BitDepth::Sixteen);
    let values = bytes
        .chunks_exact(2)
        .map(|b| u16::from_be_bytes([b[0], b[1]]));
    (info.width as usize, info.height as usize, values.collect())
}

/// Each pixel of the height map is the point of the cloud at its profile and column, within one
/// step of x and z. Pixels without a valid point are zero.
#[test]
fn a_height_map_read_back_is_the_cloud() {
    let cases = [
        (1.0, 0.0, ""),
        (0.5, 6.0, "average_frames = 3"),
        (0.8, -4.0, "best_fit_alignment = true"),
        (1.2, 3.0, "point_steps_um = [6, 3]"),
    ];
    for (step, tilt, measure) in cases {
        let scene = scene(step, tilt, measure);
        let folder = tempfile::tempdir().unwrap();
        let options = scan_options(Export::HeightMap);
        let summary = scan_to_folder(&scene, &options, folder.path(), &control()).unwrap();
        let sidecar = std::fs::read(folder.path().join("heightmap.json")).unwrap();
        let sidecar: Value = serde_json::from_slice(&sidecar).unwrap();
        let channel = |key: &str| {
            let of = &sidecar[key];
            let number = |name: &str| of[name].as_f64().unwrap();
            let file = folder.path().join(of["file"].as_str().unwrap());
            (image(&file), number("scale"), number("offset"))
        };
        let ((width, height, z), z_scale, z_offset) = channel("z_mm");
        let ((_, _, x), x_scale, x_offset) = channel("x_mm");
        let ((_, _, light), light_scale, light_offset) = channel("intensity_dn");
        assert_eq!(width, 120);
        let count = scene.measure.filters.average_frames;
        assert_eq!(height, 12 / count as usize);
        let (points, valid) = cloud(&scene, &summary);
        assert!(valid > 300, "{measure}: {valid}");
        let pixels = z.iter().filter(|&&count| count > 0).count();
        assert_eq!(pixels, valid, "{measure}");
        for point in points {
            let row = (point.frame / count) as usize;
            let at = row * width + point.column as usize;
            let [xp, zp] = [
                x_offset + x_scale * f64::from(x[at]),
                z_offset + z_scale * f64::from(z[at]),
            ];
            let pose = &sidecar["part_from_laser"][row];
            let local = [xp, 0.0, zp, 1.0];
            let found: Vec<f64> = (0..3)
                .map(|i| {
                    (0..4)
                        .map(|k| pose[i][k].as_f64().unwrap() * local[k])
                        .sum()
                })
                .collect();
            let error = DVec3::from_slice(&found) - point.position;
            // Rounding to the nearest count is half a step in x and in z.
            let most = 0.5 * x_scale.hypot(z_scale) + 1e-9;
            assert!(error.length() <= most, "{measure}: {error}, {most}");
            let dn = light_offset + light_scale * f64::from(light[at]);
            assert!((dn - point.intensity).abs() <= light_scale, "{measure}");
        }
    }
}

/// Returns the valid points of the scan as the program delivers them, and their number.
fn cloud(scene: &Scene, summary: &lasertrace::run::ScanSummary) -> (Vec<CloudPoint>, usize) {
    let simulation = Simulation::new(scene).unwrap();
    let frames = 0..scene.scan.frames;
    let mut points: Vec<CloudPoint> = frames
        .clone()
        .flat_map(|frame| simulation.profile(frame).1)
        .collect();
    simulation.apply_cross_frame_flags(frames, &mut points);
    let mut points = simulation.filtered_points(points);
    if let Some(fit) = &summary.alignment {
        for point in &mut points {
            point.position = fit.part_from_measured.point(point.position);
        }
    }
    points.retain(CloudPoint::is_valid);
    let valid = points.len();
    (points, valid)
}

/// Up to four lines of a column are found where they are, with width and height: reflections of a
/// glass plate at its two surfaces, twice. The rows of rounded Gaussian lines are exact to 0.02 px.
#[test]
fn four_lines_of_a_column_are_found() {
    for (spacing, width, first) in [(22.0, 1.5, 20.3), (31.4, 2.2, 15.8), (18.6, 1.2, 30.15)] {
        let heights = [900.0, 500.0, 300.0, 200.0, 150.0];
        let rows = 180;
        let center = |k: usize| first + spacing * k as f64;
        let count = |row: usize| {
            let of = |(k, height): (usize, &f64)| {
                let away = (row as f64 + 0.5 - center(k)) / width;
                height * (-0.5 * away * away).exp()
            };
            (20.0 + heights.iter().enumerate().map(of).sum::<f64>()).round() as u16
        };
        let counts = (0..30).flat_map(|_| (0..rows).map(count)).collect();
        let image = Counts::of_columns(counts, rows);
        let settings = PeakSettings::new(1023);
        for most in 1..=4 {
            let found = find_lines(&image, &settings, most);
            assert_eq!(found.len(), 30 * most, "{spacing}");
            for lines in found.chunks(most) {
                for (k, line) in lines.iter().enumerate() {
                    assert!((line.row - center(k)).abs() < 0.02, "{k}: {}", line.row);
                    assert!((line.sigma - width).abs() < 0.1, "{k}: {}", line.sigma);
                    let relative = line.height / heights[k];
                    assert!((0.9..1.1).contains(&relative), "{k}: {relative}");
                }
            }
        }
        // Only lines above the threshold count.
        let high = PeakSettings {
            threshold: Some(400.0),
            ..settings
        };
        assert_eq!(find_lines(&image, &high, 4).len(), 60);
    }
}
