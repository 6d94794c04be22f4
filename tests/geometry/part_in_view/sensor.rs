//! A sensor drawn at random, and scenes of it over parts of quadrilaterals.

use crate::random::Random;
use lasertrace::math::{DVec2, DVec3};
use lasertrace::scene::Scene;
use std::f64::consts::PI;
use std::fmt::Write;
use std::fs;
use tempfile::TempDir;

pub const COLUMNS: f64 = 320.0;
pub const ROWS: f64 = 160.0;
pub const PITCH: f64 = 0.03;

/// A sensor drawn at random: laser `standoff` above z = 0, looking down; camera aside,
/// looking at the same place.
pub struct Sensor {
    pub standoff: f64,
    /// Width of its view at z = 0, mm.
    pub width: f64,
    pub camera: DVec3,
    pub wavelength_nm: f64,
    pub waist: f64,
    pub k1: f64,
}

/// Corners of quadrilaterals.
pub type Quads = Vec<[DVec3; 4]>;

impl Sensor {
    pub fn random(random: &mut Random) -> Sensor {
        let standoff = random.scale(80.0, 300.0);
        let width = standoff * random.between(0.2, 0.3);
        let angle = random.between(20.0, 40.0).to_radians();
        Sensor {
            standoff,
            width,
            camera: DVec3::new(0.0, -standoff * angle.tan(), 0.0),
            wavelength_nm: random.between(405.0, 660.0),
            waist: width / COLUMNS * random.between(1.5, 3.0),
            k1: 0.0,
        }
    }

    pub fn distance(&self) -> f64 {
        (self.camera + DVec3::Z * self.standoff).length()
    }

    pub fn focal_length(&self) -> f64 {
        let magnification = COLUMNS * PITCH / self.width;
        self.distance() * magnification / (1.0 + magnification)
    }

    /// Where `p` (head's frame, laser at the origin, z up) is imaged, pixels.
    pub fn image(&self, p: DVec3) -> DVec2 {
        let axis = (-DVec3::Z * self.standoff - self.camera).normalize();
        let down = axis.cross(DVec3::X);
        let (f, distance) = (self.focal_length(), self.distance());
        let scale = f * distance / (distance - f) / PITCH;
        let off = p - self.camera;
        let seen = DVec2::new(off.x, off.dot(down)) / off.dot(axis);
        DVec2::new(COLUMNS, ROWS) / 2.0 + seen * scale
    }

    pub fn sees(&self, p: DVec3) -> bool {
        let pixel = self.image(p);
        (0.0..=COLUMNS).contains(&pixel.x) && (0.0..=ROWS).contains(&pixel.y)
    }

    /// The beam's 1/e² radius across the sheet (Siegman 1986).
    pub fn radius(&self, rho: f64) -> f64 {
        let rayleigh = PI * self.waist * self.waist / (self.wavelength_nm * 1e-6);
        self.waist * ((rho - self.standoff) / rayleigh).hypot(1.0)
    }

    pub fn scene(&self, part: &str, scan: &str) -> String {
        let Sensor {
            standoff,
            camera,
            wavelength_nm,
            k1,
            ..
        } = *self;
        let (waist_um, distance) = (self.waist * 1e3, self.distance());
        let focal_length = self.focal_length();
        format!(
            r#"seed = 1
speckle = false
[part]
{part}
reflectance = 0.5
position_mm = [0, 0, 0]
[laser]
wavelength_nm = {wavelength_nm}
power_mw = 5
waist_radius_um = {waist_um}
waist_distance_mm = {standoff}
position_mm = [0, 0, 0]
direction = [0, 0, -1]
line = {{ fan_deg = 60, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = {focal_length}
f_number = 8
focus_distance_mm = {distance}
resolution_px = [{COLUMNS}, {ROWS}]
pixel_pitch_um = 30
position_mm = [0, {camera}, 0]
look_at_mm = [0, 0, -{standoff}]
column_axis = [1, 0, 0]
distortion = {{ k1 = {k1} }}
exposure_ms = 0.01
quantum_efficiency = 0.5
gain_dn_per_e = 0.02
bit_depth = 10
full_well_e = 50000
black_level_dn = 8
read_noise_e = 10
[scan]
{scan}
"#,
            camera = camera.y,
        )
    }

    pub fn load_in(&self, folder: TempDir, part: &str, scan: &str) -> (TempDir, Scene) {
        let path = folder.path().join("scene.toml");
        fs::write(&path, self.scene(part, scan)).unwrap();
        let scene = Scene::load(&path).unwrap();
        (folder, scene)
    }

    pub fn load_quads(&self, quads: &Quads, scan: &str) -> (TempDir, Scene) {
        let folder = tempfile::tempdir().unwrap();
        write_quads(&folder, quads);
        self.load_in(folder, MESH, scan)
    }

    /// Frames a tenth of a millimetre apart, about y = 0.
    pub fn few_frames(&self) -> String {
        let z = self.standoff;
        format!("frames = 3\nstep_mm = 0.1\ndirection = [0, 1, 0]\nstart_mm = [0, -0.1, {z}]")
    }

    /// A patch in the middle of the measuring range that fills the view along the line.
    pub fn patch(&self) -> [DVec3; 4] {
        let (x, y) = (self.width, 0.2 * self.width);
        rectangle([-x, x], [-y, y], 0.0)
    }
}

pub const MESH: &str = "mesh = { file = \"part.obj\", unit = \"mm\" }";

pub fn write_quads(folder: &TempDir, quads: &Quads) {
    let mut text = String::new();
    for p in quads.iter().flatten() {
        writeln!(text, "v {} {} {}", p.x, p.y, p.z).unwrap();
    }
    for i in (1..).step_by(4).take(quads.len()) {
        writeln!(text, "f {i} {} {} {}", i + 1, i + 2, i + 3).unwrap();
    }
    fs::write(folder.path().join("part.obj"), text).unwrap();
}

pub fn rectangle(x: [f64; 2], y: [f64; 2], z: f64) -> [DVec3; 4] {
    [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(i, j)| DVec3::new(x[i], y[j], z))
}
