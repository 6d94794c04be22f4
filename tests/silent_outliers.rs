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

/// A scene that is none of the repository's: other parts, lasers, sensors and angles.
struct Other {
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
    sensor: &'static str,
    /// Greatest share of good points with a flag, and greatest number of points far off without
    /// one: five standard deviations above the mean of twelve seeds, for the second at least 2.
    suspected: f64,
    silent: usize,
}

const TEN_BITS: &str = "resolution_px = [800, 640]\npixel_pitch_um = 5\n\
    quantum_efficiency = 0.5\ngain_dn_per_e = 0.068\nbit_depth = 10\nfull_well_e = 15000\n\
    black_level_dn = 8\nread_noise_e = 12";
const TWELVE_BITS: &str = "resolution_px = [1024, 800]\npixel_pitch_um = 3.45\n\
    quantum_efficiency = 0.5\ngain_dn_per_e = 0.35\nbit_depth = 12\nfull_well_e = 11000\n\
    black_level_dn = 40\nread_noise_e = 4";
const LARGE_PIXELS: &str = "resolution_px = [640, 480]\npixel_pitch_um = 7\n\
    quantum_efficiency = 0.5\ngain_dn_per_e = 0.068\nbit_depth = 10\nfull_well_e = 15000\n\
    black_level_dn = 8\nread_noise_e = 15";

/// Scenes on which nothing of the flags and uncertainties was found when they were made; what
/// they showed was looked at since, and led to `profile::cut` and `profile::clipping`, and
/// that of the last three to what is said of points near a line's end.
const LOOKED_AT: [Other; 7] = [
    // To its horizon and beyond, where the line grazes and ends. On the side away from the
    // camera it is narrower than 0.4 of what is expected of a whole one: EDGE.
    Other {
        name: "a ball, blue light, f/5.6, 25°",
        part: "sphere = { radius_mm = 9, chord_um = 0.5 }\nposition_mm = [0, 0, -9]",
        wavelength_nm: 450.0,
        waist_um: 90.0,
        f_number: 5.6,
        angle: 25.0,
        exposure_ms: 0.05,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
        suspected: 0.061,
        silent: 2,
    },
    // Steps across and along the line, with shadows of both; twice, once with a line as high as
    // full scale.
    Other {
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
        sensor: TEN_BITS,
        suspected: 0.014,
        silent: 2,
    },
    Other {
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
        sensor: TEN_BITS,
        suspected: 0.0123,
        silent: 2,
    },
    // Fillet, ribs and holes from another side.
    Other {
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
        sensor: TEN_BITS,
        suspected: 0.0104,
        silent: 2,
    },
    // The side away from the camera grazes its view: lines narrower than 0.4 of what is
    // expected, EDGE.
    Other {
        name: "a cylinder askew, green, f/4, 45°, pixels of 3.45 µm",
        part: "cylinder = { radius_mm = 6, length_mm = 12, chord_um = 0.5 }\n\
               position_mm = [0, 0, -6]\nrotation_deg = [12, 0, 55]",
        wavelength_nm: 520.0,
        waist_um: 70.0,
        f_number: 4.0,
        angle: 45.0,
        exposure_ms: 0.017,
        frames: 41,
        step_mm: 0.35,
        sensor: TWELVE_BITS,
        suspected: 0.1191,
        silent: 2,
    },
    Other {
        name: "a tilted block of steps of 1 mm, violet, f/11, 28°, pixels of 7 µm",
        part: "step_block = { size_mm = [16, 16, 5], step_mm = 1 }\nposition_mm = [0, 0, -5]\n\
               rotation_deg = [8, -5, 110]",
        wavelength_nm: 405.0,
        waist_um: 90.0,
        f_number: 11.0,
        angle: 28.0,
        exposure_ms: 0.07,
        frames: 41,
        step_mm: 0.45,
        sensor: LARGE_PIXELS,
        suspected: 0.0151,
        silent: 2,
    },
    Other {
        name: "the bracket turned by 255°, near infrared, f/5.6, 38°",
        part: "mesh = { file = \"BRACKET\", unit = \"mm\" }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 255]",
        wavelength_nm: 785.0,
        waist_um: 130.0,
        f_number: 5.6,
        angle: 38.0,
        exposure_ms: 0.026,
        frames: 41,
        step_mm: 0.9,
        sensor: TEN_BITS,
        suspected: 0.0226,
        silent: 2,
    },
];

/// Scenes that were made after the last of these rules was thought of; what they showed changed
/// nothing but their own bounds.
const UNSEEN: [Other; 3] = [
    Other {
        name: "a ball of 5 mm, red, f/8, 35°, pixels of 3.45 µm",
        part: "sphere = { radius_mm = 5, chord_um = 0.3 }\nposition_mm = [0.4, 0, -5]",
        wavelength_nm: 633.0,
        waist_um: 100.0,
        f_number: 8.0,
        angle: 35.0,
        exposure_ms: 0.06,
        frames: 41,
        step_mm: 0.22,
        sensor: TWELVE_BITS,
        suspected: 0.0887,
        silent: 2,
    },
    // Its risers lean, and the line runs down them wider than anywhere: WIDE, OUTSIDE.
    Other {
        name: "a block of steps of 3 mm, tilted, green, f/5.6, 33°",
        part: "step_block = { size_mm = [15, 15, 8], step_mm = 3 }\nposition_mm = [0, 0, -7]\n\
               rotation_deg = [-6, 10, 62]",
        wavelength_nm: 532.0,
        waist_um: 80.0,
        f_number: 5.6,
        angle: 33.0,
        exposure_ms: 0.035,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
        suspected: 0.1774,
        silent: 10,
    },
    // The first frames graze its horizon, which cuts the beam over a hundred columns.
    Other {
        name: "a cylinder along the line, near infrared, f/11, 30°, pixels of 7 µm",
        part: "cylinder = { radius_mm = 8, length_mm = 14, chord_um = 0.4 }\n\
               position_mm = [0, 0, -8]\nrotation_deg = [4, 90, 10]",
        wavelength_nm: 808.0,
        waist_um: 150.0,
        f_number: 11.0,
        angle: 30.0,
        exposure_ms: 0.1,
        frames: 41,
        step_mm: 0.35,
        sensor: LARGE_PIXELS,
        suspected: 0.0058,
        silent: 68,
    },
];

impl Other {
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
{sensor}
position_mm = [0, {y}, {z}]
look_at_mm = [0, 0, -1]
columns = [1, 0, 0]
exposure_ms = {exposure}
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
            sensor = self.sensor,
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
    /// Without a flag, and of these within their 95 % interval.
    sound: usize,
    held: usize,
}

impl Tally {
    fn add(&mut self, points: &[CloudPoint]) {
        self.points += points.len();
        for point in points {
            let flagged = !point.flags.is_empty();
            self.sound += usize::from(!flagged);
            self.held += usize::from(!flagged && 2.0 * excess(point) <= 1.96);
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
            "{name}: {} points, {} far off, {} of them silent; {} good, {} of them flagged; \
             intervals hold {:.3}",
            self.points,
            self.off,
            self.silent,
            self.good,
            self.suspected,
            self.coverage()
        );
    }

    /// Share of the 95 % intervals of points without a flag that hold the truth.
    fn coverage(&self) -> f64 {
        self.held as f64 / self.sound as f64
    }
}

/// The numbers are measured ones with a little room. What is far off without a flag is
/// counted against all points, since what is far off is a handful but where the sensor
/// itself cuts the line.
#[test]
fn outliers_carry_flags() {
    let mut all = Tally::default();
    for (name, suspected) in [
        ("bracket", 0.008),
        ("accuracy", 0.008),
        ("plane", 0.0),
        ("step", 0.0),
        ("rotary", 0.0),
        ("limits/far", 0.0),
        ("limits/border", 0.0),
        ("limits/edge", 0.0),
        ("limits/grazing", 0.0),
    ] {
        let points = points(name);
        assert!(!points.is_empty(), "{name}");
        let mut tally = Tally::default();
        tally.add(&points);
        tally.print(name);
        assert!(tally.silent as f64 <= 5e-5 * tally.points as f64, "{name}");
        assert!(
            tally.suspected as f64 <= suspected * tally.good as f64,
            "{name}"
        );
        all.add(&points);
    }
    all.print("all");
    assert!(all.off > 1000 && all.silent as f64 <= 0.01 * all.off as f64);
    assert!(all.suspected as f64 <= 0.01 * all.good as f64);
}

/// By the bounds of each scene; 95 % intervals of points without a flag hold 93 to 97 %.
fn outliers_of_others(others: &[Other]) {
    let mut all = Tally::default();
    for other in others {
        let points = measured(&other.scene());
        assert!(points.len() > 5000, "{}: {}", other.name, points.len());
        let mut tally = Tally::default();
        tally.add(&points);
        tally.print(other.name);
        assert!(tally.silent <= other.silent, "{}", other.name);
        let suspected = other.suspected * tally.good as f64;
        assert!(tally.suspected as f64 <= suspected, "{}", other.name);
        assert!((0.93..=0.97).contains(&tally.coverage()), "{}", other.name);
        all.add(&points);
    }
    all.print("all");
}

#[test]
fn outliers_of_scenes_that_were_looked_at_carry_flags() {
    outliers_of_others(&LOOKED_AT);
}

#[test]
fn outliers_of_unseen_scenes_carry_flags() {
    outliers_of_others(&UNSEEN);
}
