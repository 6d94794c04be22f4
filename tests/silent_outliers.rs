//! Whether points far off say so: over the scenes, those whose error is more than three
//! times their expanded uncertainty (2σ, 95 %) carry a flag. Three times the standard
//! one would be passed by 27 of 10 000 points of which nothing is wrong.

use lasertrace::batch::Simulation;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::scene::Scene;
use rayon::prelude::*;
use std::path::Path;

/// Points of a scene of the repository.
fn points(name: &str) -> Vec<CloudPoint> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    measured(&Scene::load(&root.join(name).join("scene.toml")).unwrap())
}

/// Points of 40 frames or so of a scene.
fn measured(scene: &Scene) -> Vec<CloudPoint> {
    let simulation = Simulation::new(scene).unwrap();
    let step = (scene.scan.frames / 40).max(1) as usize;
    let frames = (0..scene.scan.frames).into_par_iter().step_by(step);
    let measured = frames.flat_map_iter(|frame| {
        let light = simulation.irradiance(frame);
        simulation
            .measure(frame, &simulation.counts(frame, &light))
            .1
    });
    measured.collect()
}

/// Errors in expanded uncertainties.
fn excess(point: &CloudPoint) -> f64 {
    point.deviation.abs() / (2.0 * point.deviation_sigma)
}

/// Scenes on which nothing of the flags and uncertainties was found: other parts, lasers,
/// cameras and angles. Name, part and `[laser]` and `[camera]` keys that differ.
struct Unseen {
    name: &'static str,
    part: &'static str,
    wavelength_nm: f64,
    waist_um: f64,
    f_number: f64,
    /// Of the camera from the beam, degrees.
    angle: f64,
    exposure_ms: f64,
    frames: u32,
    step_mm: f64,
    /// Measured share of good points with a flag, with a little room.
    suspected: f64,
}

const UNSEEN: [Unseen; 4] = [
    // To its horizon and beyond, where the line grazes and ends. On the side away from the
    // camera it is narrower than 0.7 px and than 0.4 of what is expected: OUTSIDE and EDGE.
    Unseen {
        name: "a ball, blue light, f/5.6, 25°",
        part: "sphere = { radius_mm = 9, chord_um = 0.5 }\nposition_mm = [0, 0, -9]",
        wavelength_nm: 450.0,
        waist_um: 90.0,
        f_number: 5.6,
        angle: 25.0,
        exposure_ms: 0.05,
        frames: 41,
        step_mm: 0.4,
        suspected: 0.12,
    },
    // Steps across and along the line, with shadows of both. In the first runs its line was
    // as high as full scale, so that SATURATED was right of three in ten; it is kept
    // like that beside one of less exposure.
    Unseen {
        name: "a stepped block turned by 35°, over-exposed, 40°",
        part: "step_block = { size_mm = [14, 14, 6], step_mm = 2 }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 35]",
        wavelength_nm: 660.0,
        waist_um: 140.0,
        f_number: 8.0,
        angle: 40.0,
        exposure_ms: 0.2,
        frames: 41,
        step_mm: 0.4,
        suspected: 0.4,
    },
    Unseen {
        name: "a stepped block turned by 35°, 40°",
        part: "step_block = { size_mm = [14, 14, 6], step_mm = 2 }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 35]",
        wavelength_nm: 660.0,
        waist_um: 140.0,
        f_number: 8.0,
        angle: 40.0,
        exposure_ms: 0.08,
        frames: 41,
        step_mm: 0.4,
        suspected: 0.02,
    },
    // Fillet, ribs and holes from another side.
    Unseen {
        name: "the bracket turned by 140°, red, f/11, 30°",
        part: "mesh = { file = \"BRACKET\", unit = \"mm\" }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 140]",
        wavelength_nm: 640.0,
        waist_um: 120.0,
        f_number: 11.0,
        angle: 30.0,
        exposure_ms: 0.2,
        frames: 41,
        step_mm: 0.9,
        suspected: 0.02,
    },
];

impl Unseen {
    fn scene(&self) -> Scene {
        let (sin, cos) = self.angle.to_radians().sin_cos();
        let bracket = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/bracket.stl");
        let part = self.part.replace("BRACKET", bracket.to_str().unwrap());
        let text = format!(
            r#"seed = 11
speckle = true
[part]
{part}
reflectance = 0.6
[laser]
wavelength_nm = {wavelength}
power_mw = 10
waist_radius_um = {waist}
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 20, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = 25
f_number = {f_number}
focus_distance_mm = 180
resolution_px = [800, 640]
pixel_pitch_um = 5
position_mm = [0, {y}, {z}]
look_at_mm = [0, 0, -1]
columns = [1, 0, 0]
exposure_ms = {exposure}
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
black_level_dn = 8
read_noise_e = 12
[scan]
start_mm = [0, {start}, 0]
direction = [0, 1, 0]
step_mm = {step}
frames = {frames}
"#,
            wavelength = self.wavelength_nm,
            waist = self.waist_um,
            f_number = self.f_number,
            y = -180.0 * sin,
            z = 180.0 * cos,
            exposure = self.exposure_ms,
            // No frame falls on a face of the part.
            start = -0.5 * self.step_mm * (self.frames as f64 - 0.83),
            step = self.step_mm,
            frames = self.frames,
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.toml");
        std::fs::write(&path, text).unwrap();
        Scene::load(&path).unwrap()
    }
}

#[derive(Default)]
struct Tally {
    points: usize,
    /// Off by more than three times the expanded uncertainty, and without a flag.
    off: usize,
    silent: usize,
    /// Within the expanded uncertainty, and flagged all the same.
    good: usize,
    suspected: usize,
}

impl Tally {
    fn add(&mut self, points: &[CloudPoint]) {
        self.points += points.len();
        for point in points {
            let flagged = !point.flags.is_empty();
            if excess(point) > 3.0 {
                self.off += 1;
                self.silent += usize::from(!flagged);
            } else if excess(point) <= 1.0 {
                self.good += 1;
                self.suspected += usize::from(flagged);
            }
        }
    }

    fn print(&self, name: &str) {
        println!(
            "{name}: {} points, {} far off, {} of them silent; {} good, {} of them flagged",
            self.points, self.off, self.silent, self.good, self.suspected
        );
    }
}

/// The numbers are measured ones with a little room. What is far off without a flag is
/// counted against all points, since what is far off is a handful but where the sensor
/// itself cuts the line.
#[test]
fn outliers_carry_flags() {
    let mut all = Tally::default();
    for (name, suspected) in [
        ("bracket", 0.015),
        ("accuracy", 0.018),
        ("plane", 0.0),
        ("step", 0.005),
        ("rotary", 0.0),
        ("limits/far", 0.005),
        ("limits/border", 0.0),
        ("limits/edge", 0.0),
        // Its lines are longer than the sensor is high: all carry BORDER.
        ("limits/grazing", 1.0),
    ] {
        let points = points(name);
        assert!(!points.is_empty(), "{name}");
        let mut tally = Tally::default();
        tally.add(&points);
        tally.print(name);
        assert!(tally.silent as f64 <= 1e-4 * tally.points as f64, "{name}");
        assert!(
            tally.suspected as f64 <= suspected * tally.good as f64,
            "{name}"
        );
        all.add(&points);
    }
    all.print("all");
    assert!(all.off > 1000 && all.silent as f64 <= 0.01 * all.off as f64);
}

/// The same on scenes that were made after flags and uncertainties were found.
#[test]
fn outliers_of_unseen_scenes_carry_flags() {
    let mut all = Tally::default();
    for unseen in &UNSEEN {
        let points = measured(&unseen.scene());
        assert!(points.len() > 5000, "{}: {}", unseen.name, points.len());
        let mut tally = Tally::default();
        tally.add(&points);
        tally.print(unseen.name);
        assert!(
            tally.silent as f64 <= 5e-4 * points.len() as f64,
            "{}",
            unseen.name
        );
        let suspected = unseen.suspected * tally.good as f64;
        assert!(tally.suspected as f64 <= suspected, "{}", unseen.name);
        all.add(&points);
    }
    all.print("all unseen");
}
