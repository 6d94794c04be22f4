//! Predicted uncertainties against what is true.

use lasertrace::batch::Simulation;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::profile::Flags;
use lasertrace::scene::Scene;

/// A line of σ ≈ 4 px on grains of 1.6 px, with shot and read noise: 12 grains
/// across the line.
fn scene(part: &str, [start, step]: [f64; 2], finder: &str, speckle: bool, waist_um: f64) -> Scene {
    let text = format!(
        r#"
seed = 1
speckle = {speckle}
[part]
{part}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = {waist_um}
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 5, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = 50
f_number = 8
focus_distance_mm = 150
resolution_px = [384, 320]
pixel_pitch_um = 5
position_mm = [0, -106.066017, 106.066017]
look_at_mm = [0, 0, 0]
columns = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
black_level_dn = 20
read_noise_e = 10
[scan]
direction = [0, 1, 0]
start_mm = [0, {start}, 0]
step_mm = {step}
frames = 36
[measure]
peak = "{finder}"
"#
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

const PLANE: &str = "plane = { size_mm = [24, 24] }\nrotation_deg = [8, 5, 0]";
const SPHERE: &str = "sphere = { radius_mm = 10, chord_um = 0.5 }\nposition_mm = [0, 0, -10]";

/// Points of all frames of `seeds` scans.
fn points(mut scene: Scene, seeds: u64) -> Vec<CloudPoint> {
    let mut points = Vec::new();
    for seed in 1..=seeds {
        scene.seed = seed;
        let simulation = Simulation::new(&scene).unwrap();
        for frame in 0..scene.scan.frames {
            let counts = simulation.counts(frame, &simulation.irradiance(frame));
            points.extend(simulation.measure(frame, &counts).1);
        }
    }
    points
}

#[test]
#[ignore]
fn explore() {
    for waist in [60.0, 80.0, 120.0, 200.0] {
        for (name, part, way) in [
            ("plane", PLANE, [-9.0, 0.5]),
            ("sphere", SPHERE, [-3.5, 0.2]),
        ] {
            for finder in [
                "centroid",
                "log-parabola",
                "gaussian-fit",
                "derivative-zero",
            ] {
                for speckle in [true, false] {
                    if finder != "centroid" && (name == "sphere" || waist != 120.0) {
                        continue;
                    }
                    let start = std::time::Instant::now();
                    let all = points(
                        scene(part, way, finder, speckle, waist),
                        if speckle { 2 } else { 1 },
                    );
                    let error = |p: &CloudPoint| match name {
                        "plane" => p.position.z,
                        _ => p.position.length() - 10.0,
                    };
                    for (what, good) in [("inside", true), ("unflagged but for OUTSIDE", false)] {
                        let kept: Vec<_> = all
                            .iter()
                            .filter(|p| match good {
                                true => p.flags.is_empty(),
                                false => p.flags.difference(Flags::OUTSIDE).is_empty(),
                            })
                            .collect();
                        let n = kept.len() as f64;
                        let z: Vec<f64> =
                            kept.iter().map(|p| error(p) / p.deviation_sigma).collect();
                        let mean = z.iter().sum::<f64>() / n;
                        let std = (z.iter().map(|z| z * z).sum::<f64>() / n).sqrt();
                        let kurt = z.iter().map(|z| z.powi(4)).sum::<f64>() / n / std.powi(4);
                        let covered = z.iter().filter(|z| z.abs() <= 1.96).count() as f64 / n;
                        let sigma = kept.iter().map(|p| p.deviation_sigma).sum::<f64>() / n * 1e3;
                        println!(
                            "w0 {waist} {name} {finder} speckle {speckle} {what}: {n} of {} cover {covered:.4} mean z {mean:.3} rms z {std:.3} kurtosis {kurt:.2} sigma {sigma:.3} um {:?}",
                            all.len(),
                            start.elapsed()
                        );
                    }
                }
            }
        }
    }
}
