//! Scenes that are none of the repository's: other parts, lasers, sensors and angles.

use crate::random::Random;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::borrow::Cow;
use std::path::Path;

/// Part, laser, sensor and scan of a scene.
pub struct Other {
    pub name: Cow<'static, str>,
    part: Cow<'static, str>,
    wavelength_nm: f64,
    waist_um: f64,
    f_number: f64,
    /// Of the camera from the beam, degrees.
    angle: f64,
    exposure_ms: f64,
    frames: u32,
    step_mm: f64,
    sensor: &'static str,
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

/// Scenes on which the rules for flags and uncertainties were tried.
pub static LOOKED_AT: [Other; 10] = [
    // Away from the camera the line is narrow, and at its horizon it ends.
    Other {
        name: Cow::Borrowed("a ball, blue light, f/5.6, 25°"),
        part: Cow::Borrowed(
            "sphere = { radius_mm = 9, chordal_deviation_um = 0.5 }\nposition_mm = [0, 0, -9]",
        ),
        wavelength_nm: 450.0,
        waist_um: 90.0,
        f_number: 5.6,
        angle: 25.0,
        exposure_ms: 0.05,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
    },
    // Steps across and along the line, with shadows of both; twice, once with a line as high as
    // full scale.
    Other {
        name: Cow::Borrowed("a stepped block turned by 35°, over-exposed, 40°"),
        part: Cow::Borrowed(
            "step_block = { size_mm = [14, 14, 6], step_mm = 2 }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 35]",
        ),
        wavelength_nm: 660.0,
        waist_um: 140.0,
        f_number: 8.0,
        angle: 40.0,
        exposure_ms: 0.2,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
    },
    Other {
        name: Cow::Borrowed("a stepped block turned by 35°, 40°"),
        part: Cow::Borrowed(
            "step_block = { size_mm = [14, 14, 6], step_mm = 2 }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 35]",
        ),
        wavelength_nm: 660.0,
        waist_um: 140.0,
        f_number: 8.0,
        angle: 40.0,
        exposure_ms: 0.08,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
    },
    // Fillet, ribs and holes from another side.
    Other {
        name: Cow::Borrowed("the bracket turned by 140°, red, f/11, 30°"),
        part: Cow::Borrowed(
            "mesh = { file = \"BRACKET\", unit = \"mm\" }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 140]",
        ),
        wavelength_nm: 640.0,
        waist_um: 120.0,
        f_number: 11.0,
        angle: 30.0,
        exposure_ms: 0.2,
        frames: 41,
        step_mm: 0.9,
        sensor: TEN_BITS,
    },
    // Away from the camera the line is narrow, and at its horizon it ends.
    Other {
        name: Cow::Borrowed("a cylinder askew, green, f/4, 45°, pixels of 3.45 µm"),
        part: Cow::Borrowed(
            "cylinder = { radius_mm = 6, length_mm = 12, chordal_deviation_um = 0.5 }\n\
               position_mm = [0, 0, -6]\nrotation_deg = [12, 0, 55]",
        ),
        wavelength_nm: 520.0,
        waist_um: 70.0,
        f_number: 4.0,
        angle: 45.0,
        exposure_ms: 0.017,
        frames: 41,
        step_mm: 0.35,
        sensor: TWELVE_BITS,
    },
    Other {
        name: Cow::Borrowed("a tilted block of steps of 1 mm, violet, f/11, 28°, pixels of 7 µm"),
        part: Cow::Borrowed(
            "step_block = { size_mm = [16, 16, 5], step_mm = 1 }\nposition_mm = [0, 0, -5]\n\
               rotation_deg = [8, -5, 110]",
        ),
        wavelength_nm: 405.0,
        waist_um: 90.0,
        f_number: 11.0,
        angle: 28.0,
        exposure_ms: 0.07,
        frames: 41,
        step_mm: 0.45,
        sensor: LARGE_PIXELS,
    },
    Other {
        name: Cow::Borrowed("the bracket turned by 255°, near infrared, f/5.6, 38°"),
        part: Cow::Borrowed(
            "mesh = { file = \"BRACKET\", unit = \"mm\" }\nposition_mm = [0, 0, -6]\n\
               rotation_deg = [0, 0, 255]",
        ),
        wavelength_nm: 785.0,
        waist_um: 130.0,
        f_number: 5.6,
        angle: 38.0,
        exposure_ms: 0.026,
        frames: 41,
        step_mm: 0.9,
        sensor: TEN_BITS,
    },
    Other {
        name: Cow::Borrowed("a ball of 5 mm, red, f/8, 35°, pixels of 3.45 µm"),
        part: Cow::Borrowed(
            "sphere = { radius_mm = 5, chordal_deviation_um = 0.3 }\nposition_mm = [0.4, 0, -5]",
        ),
        wavelength_nm: 633.0,
        waist_um: 100.0,
        f_number: 8.0,
        angle: 35.0,
        exposure_ms: 0.06,
        frames: 41,
        step_mm: 0.22,
        sensor: TWELVE_BITS,
    },
    // Its risers lean, and the line runs down them wider than anywhere: WIDE, UNCERTAINTY_NOT_VALID.
    Other {
        name: Cow::Borrowed("a block of steps of 3 mm, tilted, green, f/5.6, 33°"),
        part: Cow::Borrowed(
            "step_block = { size_mm = [15, 15, 8], step_mm = 3 }\nposition_mm = [0, 0, -7]\n\
               rotation_deg = [-6, 10, 62]",
        ),
        wavelength_nm: 532.0,
        waist_um: 80.0,
        f_number: 5.6,
        angle: 33.0,
        exposure_ms: 0.035,
        frames: 41,
        step_mm: 0.4,
        sensor: TEN_BITS,
    },
    // The first frames graze its horizon, which cuts the beam over a hundred columns.
    Other {
        name: Cow::Borrowed("a cylinder along the line, near infrared, f/11, 30°, pixels of 7 µm"),
        part: Cow::Borrowed(
            "cylinder = { radius_mm = 8, length_mm = 14, chordal_deviation_um = 0.4 }\n\
               position_mm = [0, 0, -8]\nrotation_deg = [4, 90, 10]",
        ),
        wavelength_nm: 808.0,
        waist_um: 150.0,
        f_number: 11.0,
        angle: 30.0,
        exposure_ms: 0.1,
        frames: 41,
        step_mm: 0.35,
        sensor: LARGE_PIXELS,
    },
];

impl Other {
    pub fn scene(&self) -> Scene {
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
column_axis = [1, 0, 0]
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

/// A ball, a cylinder or a stepped block, in turn, at any pose before a laser, lens and sensor at
/// random, lit so that half of the lines are higher than a third of full scale.
pub fn drawn(seed: u64) -> (String, Scene) {
    let mut random = Random::new(seed);
    let (size, other) = (random.between(4.0, 9.0), random.between(5.0, 14.0));
    let step = random.between(0.5, 3.0);
    let kind = ["ball", "cylinder", "block"][seed as usize % 3];
    let shape = match kind {
        "ball" => format!("sphere = {{ radius_mm = {size}, chordal_deviation_um = 0.4 }}"),
        "cylinder" => {
            format!(
                "cylinder = {{ radius_mm = {size}, length_mm = {other}, chordal_deviation_um = 0.4 }}"
            )
        }
        _ => format!("step_block = {{ size_mm = [{other}, 12, {size}], step_mm = {step} }}"),
    };
    let turn = random.vector(180.0);
    let part = |z: f64| {
        format!(
            "{shape}\nposition_mm = [0, 0, {z}]\nrotation_deg = [{}, {}, {}]",
            turn.x, turn.y, turn.z
        )
    };
    let mut other = Other {
        name: format!("{kind} {seed}").into(),
        part: part(0.0).into(),
        wavelength_nm: [405.0, 450.0, 520.0, 660.0, 785.0][random.choice(5)],
        waist_um: random.between(70.0, 150.0),
        f_number: random.between(4.0, 11.0),
        angle: random.between(25.0, 45.0),
        exposure_ms: 0.01,
        frames: 41,
        step_mm: 0.1,
        sensor: [TEN_BITS, TWELVE_BITS, LARGE_PIXELS][random.choice(3)],
    };
    // Its top at the middle of the range, and the scan from one side of it to the other.
    let bounds = other.scene().bounds();
    other.part = part(-bounds.max.z).into();
    other.step_mm = bounds.size().y / 40.0;
    let mut scene = other.scene();
    for _ in 0..3 {
        let simulation = Simulation::new(&scene).unwrap();
        let counts = simulation.counts(20, &simulation.irradiance(20));
        let mut heights: Vec<f64> = simulation
            .peaks(&counts)
            .0
            .iter()
            .map(|p| p.height)
            .collect();
        heights.sort_by(f64::total_cmp);
        let middle = heights.get(heights.len() / 2).copied().unwrap_or(1.0);
        let full = f64::from(scene.camera.sensor.saturation_count());
        let factor = full / 3.0 / middle;
        drop(simulation);
        scene.camera.sensor.exposure_ms *= factor.clamp(0.1, 30.0);
    }
    (other.name.into_owned(), scene)
}
