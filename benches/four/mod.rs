//! The four scenes on which frames are timed: waves of a million triangles, the demo's
//! bracket, a thousand balls, and a machined part of two million triangles.

use lasertrace::mesh::Mesh;
use lasertrace::scene::Scene;
use std::collections::HashMap;
use std::path::Path;

/// A scene, and the frame of it that is timed.
pub struct Timed {
    pub name: &'static str,
    pub scene: Scene,
    pub frame: u32,
}

/// The scenes there are: the machined part is not in the project.
pub fn four() -> Vec<Timed> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = |folder: &str| {
        let path = root.join("scenes").join(folder).join("scene.toml");
        std::fs::read_to_string(path).unwrap()
    };
    let balls = text("balls").replace("speckle = false", "speckle = true");
    let mut scenes = vec![
        Timed {
            name: "waves",
            scene: crate::waves::waves(1e6),
            frame: 480,
        },
        Timed {
            name: "bracket",
            scene: load(&text("bracket"), &root.join("scenes/bracket/bracket.stl")),
            frame: 50,
        },
        Timed {
            name: "balls",
            scene: load(&balls, &root.join("scenes/balls/balls.csv")),
            frame: 206,
        },
    ];
    let part = root.join("../shared/data/meshes/NIST_MBE_PMI_5_l0.1.stl");
    if !part.is_file() {
        eprintln!(
            "NOT TIMED: the machined part, {} is not there",
            part.display()
        );
        return scenes;
    }
    let mut scene = load(MACHINED, &part);
    for _ in 0..3 {
        scene.mesh = divided(&scene.mesh).into();
    }
    scenes.push(Timed {
        name: "machined",
        scene,
        frame: 100,
    });
    scenes
}

/// A scene of this text beside a copy of the one file that it names.
fn load(text: &str, file: &Path) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::copy(file, folder.path().join(file.file_name().unwrap())).unwrap();
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

/// Each triangle in four, by the middles of its sides.
fn divided(mesh: &Mesh) -> Mesh {
    let mut positions = mesh.positions.clone();
    let mut middles = HashMap::new();
    let mut middle = |a: u32, b: u32| {
        *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
            positions.push((positions[a as usize] + positions[b as usize]) / 2.0);
            positions.len() as u32 - 1
        })
    };
    let mut triangles = Vec::with_capacity(4 * mesh.triangles.len());
    for &[a, b, c] in &mesh.triangles {
        let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
        triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    Mesh {
        positions,
        triangles,
    }
}

/// A sensor of 300 mm above a part of half a metre.
const MACHINED: &str = r#"
seed = 1
speckle = true

[part]
mesh = { file = "NIST_MBE_PMI_5_l0.1.stl", unit = "mm" }
reflectance = 0.5

[laser]
wavelength_nm = 660
power_mw = 40
waist_radius_um = 200
waist_distance_mm = 600
position_mm = [0, 0, 900]
direction = [0, 0, -1]
line = { fan_deg = 28, profile = "uniform", direction = [1, 0, 0] }

[camera]
focal_length_mm = 25
f_number = 8
focus_distance_mm = 700
resolution_px = [2048, 1088]
pixel_pitch_um = 5.5
position_mm = [0, -400, 880]
look_at_mm = [0, 0, 310]
column_axis = [1, 0, 0]
exposure_ms = 0.4
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
black_level_dn = 8
read_noise_e = 10

[scan]
start_mm = [0, -100, 0]
direction = [0, 1, 0]
step_mm = 1
frames = 200
"#;
