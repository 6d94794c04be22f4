//! Scenes of sensors and parts of random sizes.

// Each test file uses what it needs of this.
#![allow(dead_code)]

use lasertrace::math::rng::{Purpose, RngKey};

/// A sensor: laser straight above the origin, camera aside, both looking at it.
pub struct Sensor {
    /// Of laser and camera from the origin, mm.
    pub distance: f64,
    /// Between laser beam and optical axis, rad.
    pub angle: f64,
    pub pitch_um: f64,
    pub shape: u64,
}

pub const SEEDS: [u64; 3] = [11, 12, 13];
pub const FOCAL_MM: f64 = 16.0;
pub const ROWS: f64 = 64.0;

impl Sensor {
    pub fn new(seed: u64) -> Sensor {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
        Sensor {
            distance: between(0, 80.0, 200.0),
            angle: between(1, 20.0, 45.0).to_radians(),
            pitch_um: between(2, 20.0, 30.0),
            shape: key.bits(3) % 3,
        }
    }

    /// A part that fills about the field, its top at z = 0.
    pub fn part(&self) -> String {
        let d = self.distance;
        match self.shape {
            0 => format!("plane = {{ size_mm = [{0}, {0}] }}", 0.2 * d),
            1 => format!(
                "sphere = {{ radius_mm = {}, chordal_deviation_um = 5 }}\nposition_mm = [0, 0, {}]",
                0.03 * d,
                -0.03 * d
            ),
            _ => format!(
                "step_block = {{ size_mm = [{0}, {0}, {1}], step_mm = {2} }}\n\
                 position_mm = [0, 0, {3}]",
                0.12 * d,
                0.06 * d,
                0.02 * d,
                -0.06 * d
            ),
        }
    }

    /// A plane of a fifth of the distance at height `z`, the middle at `x`.
    pub fn plane(&self, x: f64, z: f64) -> String {
        let size = 0.2 * self.distance;
        format!("plane = {{ size_mm = [{size}, {size}] }}\nposition_mm = [{x}, 0, {z}]")
    }

    pub fn scene(&self, part: &str) -> String {
        let d = self.distance;
        let (y, z) = (-d * self.angle.sin(), d * self.angle.cos());
        // As much light on a pixel from every distance.
        let exposure = 0.01 * (d / 100.0).powi(2) * (30.0 / self.pitch_um).powi(2);
        format!(
            "seed = 1\nspeckle = false\n\n[part]\n{part}\nreflectance = 0.5\n\n\
             [laser]\nwavelength_nm = 660\npower_mw = 10\nwaist_radius_um = {}\n\
             waist_distance_mm = {d}\nposition_mm = [0, 0, {d}]\ndirection = [0, 0, -1]\n\
             line = {{ fan_deg = 12, profile = \"uniform\", direction = [1, 0, 0] }}\n\n\
             [camera]\nfocal_length_mm = {FOCAL_MM}\nf_number = 8\nfocus_distance_mm = {d}\n\
             resolution_px = [96, {ROWS}]\npixel_pitch_um = {}\nposition_mm = [0, {y}, {z}]\n\
             look_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\nexposure_ms = {exposure}\n\
             quantum_efficiency = 0.5\ngain_dn_per_e = 0.02\nbit_depth = 10\n\
             full_well_e = 50000\nblack_level_dn = 8\nread_noise_e = 10\n\n\
             [scan]\nframes = 3\nstep_mm = 0.5\ndirection = [0, 1, 0]\nstart_mm = [0, -0.5, 0]\n",
            3.0 * d,
            self.pitch_um
        )
    }

    /// Heights at which the measuring range begins and ends: where the rays of the
    /// sensor's first and last row, α off the axis, cross the laser's plane.
    pub fn range(&self) -> [f64; 2] {
        let d = self.distance;
        let image = FOCAL_MM * d / (d - FOCAL_MM);
        let alpha = (0.5 * ROWS * self.pitch_um * 1e-3 / image).atan();
        [alpha, -alpha]
            .map(|alpha| d * self.angle.cos() - d * self.angle.sin() / (self.angle + alpha).tan())
    }
}
