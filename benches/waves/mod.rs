//! A part of waves, a rib, a slot and a pocket, in as many triangles as wanted.

use lasertrace::scene::Scene;
use std::io::Write;
use std::path::Path;

/// A line 1.6 px in 1/e² half width over 85 % of the columns of a part of 90 × 60 mm.
const WAVES: &str = r#"
seed = 1
speckle = true

[part]
mesh = { file = "part.stl", unit = "mm" }
reflectance = 0.5

[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = 80
waist_distance_mm = 200
position_mm = [0, 0, 200]
direction = [0, 0, -1]
line = { fan_deg = 24, profile = "uniform", direction = [1, 0, 0] }

[camera]
focal_length_mm = 25
f_number = 8
focus_distance_mm = 252
resolution_px = [2048, 1088]
pixel_pitch_um = 5.5
position_mm = [0, -126, 218.2]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.15
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
black_level_dn = 8
read_noise_e = 10

[scan]
start_mm = [0, -25, 0]
direction = [0, 1, 0]
step_mm = 0.05
frames = 1000
"#;

/// Height (mm) of the part: waves, a rib, a slot and a pocket.
fn height(x: f64, y: f64) -> f64 {
    let mut z = 2.0 * (x / 7.0).sin() + (y / 5.0 + x / 11.0).sin();
    if (x - 20.0).abs() < 6.0 {
        z += 4.0;
    }
    if (x + 35.0).abs() < 1.0 {
        z += 6.0;
    }
    if (x + 20.0).hypot(y) < 7.0 {
        z -= 5.0;
    }
    z
}

/// The part in about so many triangles, as a binary STL.
fn write_waves(path: &Path, triangles: f64) -> std::io::Result<()> {
    let nx = (triangles / 2.0 * 1.5).sqrt() as usize;
    let ny = (triangles / 2.0 / nx as f64) as usize;
    let corner = |i: usize, j: usize| {
        let x = 90.0 * i as f64 / nx as f64 - 45.0;
        let y = 60.0 * j as f64 / ny as f64 - 30.0;
        [x as f32, y as f32, height(x, y) as f32]
    };
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    out.write_all(&[0; 80])?;
    out.write_all(&(2 * nx as u32 * ny as u32).to_le_bytes())?;
    for (i, j) in (0..ny).flat_map(|j| (0..nx).map(move |i| (i, j))) {
        let [a, b] = [corner(i, j), corner(i + 1, j)];
        let [c, d] = [corner(i + 1, j + 1), corner(i, j + 1)];
        for triangle in [[a, b, c], [a, c, d]] {
            let numbers = [[0.0, 0.0, 1.0], triangle[0], triangle[1], triangle[2]];
            for number in numbers.as_flattened() {
                out.write_all(&number.to_le_bytes())?;
            }
            out.write_all(&[0; 2])?;
        }
    }
    out.flush()
}

/// Waves, a rib, a slot and a pocket in about so many triangles.
pub fn waves(triangles: f64) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    let part = folder.path().join("part.stl");
    write_waves(&part, triangles).unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, WAVES).unwrap();
    Scene::load(&path).unwrap()
}
