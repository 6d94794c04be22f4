//! Sensors and parts drawn at random.

use crate::random::Random;
use lasertrace::math::DVec3;
use std::f64::consts::PI;

pub const COLUMNS: f64 = 224.0;
pub const ROWS: f64 = 160.0;

/// A sensor in front of a surface at the origin.
pub struct Optics {
    /// Degrees between laser plane and optical axis.
    angle: f64,
    /// Of the camera from the origin, mm.
    distance: f64,
    /// Of the laser, mm.
    laser: f64,
    focal_length: f64,
    f_number: f64,
    pitch_um: f64,
    wavelength_nm: f64,
    pub waist_um: f64,
}

impl Optics {
    pub fn random(random: &mut Random) -> Optics {
        let distance = random.between(120.0, 300.0);
        let focal_length = random.between(12.0, 35.0);
        let pitch_um = random.between(3.45, 10.0);
        let wavelength_nm = [405.0, 450.0, 520.0, 660.0][random.choice(4)];
        let line_px = random.scale(1.2, 5.0);
        let object_px = pitch_um * (distance - focal_length) / focal_length;
        Optics {
            angle: random.between(18.0, 45.0),
            distance,
            laser: 200.0,
            focal_length,
            f_number: random.scale(4.0, 16.0),
            pitch_um,
            wavelength_nm,
            // Finer, a beam would spread by more than 5 mrad.
            waist_um: (line_px * object_px).max(wavelength_nm * 1e-3 / PI / 5e-3),
        }
    }

    /// As far off as four times a part of this size, its image as wide as the sensor and
    /// not too high for it.
    pub fn fitted(self, size: DVec3) -> Optics {
        let line_px = self.waist_um / self.object_px();
        let high = size.z * self.angle.to_radians().sin() / (0.7 * ROWS);
        let object_px = (1.1 * size.x / COLUMNS).max(high);
        let distance = 4.0 * size.max_element();
        let pitch = self.pitch_um * 1e-3;
        Optics {
            distance,
            laser: distance,
            focal_length: distance * pitch / (pitch + object_px),
            waist_um: line_px * object_px * 1e3,
            ..self
        }
    }

    /// Length of a pixel on a surface across the axis, µm.
    pub fn object_px(&self) -> f64 {
        self.pitch_um * (self.distance - self.focal_length) / self.focal_length
    }

    pub fn um_per_px(&self) -> f64 {
        self.object_px() / self.angle.to_radians().sin()
    }

    /// Exposure (ms) at which the line's middle on white paint across the beam has
    /// `electrons`; physics.md, 1 and 7: 10 mW in a fan of 20°, η = 0.5.
    pub fn exposure(&self, electrons: f64) -> f64 {
        let fan = 20f64.to_radians();
        let line = 10.0 / fan / self.laser * (2.0 / PI).sqrt() / (self.waist_um * 1e-3);
        let image = self.distance * self.focal_length / (self.distance - self.focal_length);
        let pupil = PI / 4.0 * (self.focal_length / self.f_number).powi(2);
        let irradiance = line / PI * pupil / image.powi(2);
        let photon_mj = 1.986e-13 / self.wavelength_nm;
        electrons * photon_mj / (irradiance * (self.pitch_um * 1e-3).powi(2) * 0.5) * 1e3
    }

    /// Laser and camera of a scene.
    pub fn tables(&self, exposure: &str, full_well: f64, noise: &str, patterns: u32) -> String {
        let (sin, cos) = self.angle.to_radians().sin_cos();
        let Optics {
            distance,
            laser,
            focal_length,
            f_number,
            pitch_um,
            wavelength_nm,
            waist_um,
            ..
        } = self;
        format!(
            r#"[laser]
wavelength_nm = {wavelength_nm}
power_mw = 10
waist_radius_um = {waist_um}
waist_distance_mm = {laser}
incoherent_modes = {patterns}
position_mm = [0, 0, {laser}]
direction = [0, 0, -1]
line = {{ fan_deg = 20, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = {focal_length}
f_number = {f_number}
focus_distance_mm = {distance}
resolution_px = [{COLUMNS}, {ROWS}]
pixel_pitch_um = {pitch_um}
position_mm = [0, {y}, {z}]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
{exposure}
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = {full_well}
black_level_dn = 8
{noise}
"#,
            y = -distance * sin,
            z = distance * cos,
        )
    }
}

/// What is in view: kinds of parts that generated scenes take in turn.
const KINDS: [&str; 7] = [
    "plane",
    "sphere",
    "cylinder",
    "step",
    "block",
    "bracket",
    "step, wide beam",
];

/// A part whose upper surface is about the origin; `size` is the field's, mm.
pub fn part(random: &mut Random, kind: &str, size: f64) -> String {
    let tilt = [0, 1].map(|_| random.between(-25.0, 25.0));
    let turn = random.between(0.0, 360.0);
    let pose = |depth: f64| {
        format!(
            "rotation_deg = [{}, {}, {turn}]\nposition_mm = [0, 0, {}]",
            tilt[0], tilt[1], -depth
        )
    };
    // From one whose silhouette is in view to one that fills it.
    let radius = size * random.scale(0.15, 2.0);
    let block = |random: &mut Random, width: f64, height: f64| {
        let step = height * random.between(0.1, 0.8);
        format!(
            "step_block = {{ size_mm = [{0}, {0}, {height}], step_mm = {step} }}\n{1}",
            size * width,
            pose(height - 0.5 * step)
        )
    };
    match kind {
        "plane" => format!(
            "plane = {{ size_mm = [{0}, {0}] }}\n{1}",
            1.6 * size,
            pose(0.0)
        ),
        "sphere" => format!(
            "sphere = {{ radius_mm = {radius}, chordal_deviation_um = 0.2 }}\nposition_mm = [0, 0, {}]",
            -radius
        ),
        "cylinder" => format!(
            "cylinder = {{ radius_mm = {radius}, length_mm = {} }}\n{}",
            1.2 * size,
            pose(radius)
        )
        .replace(" }", ", chordal_deviation_um = 0.2 }"),
        "step" | "step, wide beam" => {
            let height = random.between(0.05, 0.2);
            block(random, 1.3, height * size)
        }
        "block" => {
            let (width, height) = (random.between(0.2, 0.6), random.between(0.05, 0.3));
            block(random, width, height * size)
        }
        // Fillets, ribs, holes and a step.
        _ => format!(
            "mesh = {{ file = \"{}/scenes/bracket/bracket.stl\", unit = \"mm\" }}\n\
             position_mm = [{}, {}, -15]",
            env!("CARGO_MANIFEST_DIR"),
            random.between(-15.0, 15.0),
            random.between(-10.0, 10.0)
        ),
    }
}

pub fn kind(number: u64) -> &'static str {
    KINDS[number as usize % KINDS.len()]
}
