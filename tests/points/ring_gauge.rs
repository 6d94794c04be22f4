//! Diameter of a ring gauge at several depths and angles, as in the verification of virtual line
//! scanners (Sensors 2021, 21, 6638).

use crate::control;
use lasertrace::math::DVec3;
use lasertrace::mesh::Mesh;
use lasertrace::mesh::deform::binary_stl;
use lasertrace::scene::Scene;
use lasertrace::study::{ValueScatter, feature_monte_carlo};
use std::fmt::Write;
use std::path::Path;

/// Radius of the bore, mm.
const RADIUS: f64 = 12.0;
/// Errors of sensor and stage, stated for this example.
const ERRORS: &str = "[systematic]
laser_pointing_urad = { standard_deviation = 10 }
camera_rotation_urad = { standard_deviation = 10 }
focal_length_percent = { standard_deviation = 0.01 }
residual_um = { standard_deviation = 2, correlation_x_mm = 10, correlation_z_mm = 10 }
[scan.systematic]
step_ppm = 50
straightness_um = { standard_deviation = 1, correlation_length_mm = 5 }
";

/// Returns 100° of a bore of 6 mm length around the z axis, centred in the direction of +y. Chords
/// deviate by at most 0.4 µm.
fn bore() -> Mesh {
    const ARCS: u32 = 110;
    let angle = |i: u32| (f64::from(i) / f64::from(ARCS) - 0.5) * 100f64.to_radians();
    let positions = (0..=ARCS).flat_map(|i| {
        let (sin, cos) = angle(i).sin_cos();
        [-3.0, 3.0].map(|z| DVec3::new(RADIUS * sin, RADIUS * cos, z))
    });
    let quads = (0..ARCS).map(|i| 2 * i);
    Mesh {
        positions: positions.collect(),
        // Normals point to the axis.
        triangles: quads
            .flat_map(|a| [[a, a + 2, a + 1], [a + 1, a + 2, a + 3]])
            .collect(),
    }
}

/// Returns the results for a bore whose middle is seen at an angle of incidence in the laser plane and
/// across it, degrees, at a height from the middle of the measuring range, mm.
fn diameter([height, in_plane, out_of_plane]: [f64; 3], seeds: u64) -> ValueScatter {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("bore.stl"), binary_stl(&bore())).unwrap();
    let sensor = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors/generic-50mm-405nm.toml");
    // The wall faces the beam after a rotation by -90° about x. The middle of the range is the origin of
    // the head.
    let about_x = (out_of_plane - 90.0f64).to_radians();
    let rotated =
        glam::DMat3::from_rotation_y(in_plane.to_radians()) * glam::DMat3::from_rotation_x(about_x);
    let wall = rotated * DVec3::Y * RADIUS;
    let [x, y, z] = (DVec3::Z * height - wall).to_array();
    let text = format!(
        "seed = 50
speckle = true
sensor = {sensor:?}
[part]
mesh = {{ file = \"bore.stl\", unit = \"mm\" }}
rotation_deg = [{}, {in_plane}, 0]
position_mm = [{x}, {y}, {z}]
reflectance = 0.3
[camera]
exposure = \"auto\"
[scan]
direction = [0, 1, 0]
start_mm = [0, -4, 0]
step_mm = 0.25
frames = 33
[[feature]]
name = \"bore\"
kind = \"cylinder\"
point_mm = [0, {RADIUS}, 0]
{ERRORS}",
        about_x.to_degrees()
    );
    let scene = Scene::parse(&text, folder.path()).unwrap();
    let out = folder.path().join("out");
    let found = feature_monte_carlo(scene, seeds, &*out, &control()).unwrap();
    let value = found
        .values
        .into_iter()
        .find(|v| v.quantity == "diameter_mm");
    value.unwrap()
}

/// Returns a row of the table. The scatter agrees with the stated uncertainty, and the bias is within
/// the expanded uncertainty.
fn row(at: [f64; 3], seeds: u64) -> String {
    let found = diameter(at, seeds);
    println!("{at:?}: {found:?}");
    assert_eq!(found.seeds as u64, seeds, "{at:?}");
    assert!(found.agrees, "{at:?}: {found:?}");
    let bias = found.mean - 2.0 * RADIUS;
    let error = found.standard_deviation / (seeds as f64).sqrt();
    assert!(
        bias.abs() < 2.0 * found.predicted + 3.0 * error,
        "{at:?}: {found:?}"
    );
    let mut row = String::new();
    let [height, in_plane, out_of_plane] = at;
    let _ = writeln!(
        row,
        "| {height} | {in_plane} | {out_of_plane} | {:.1} ± {:.1} | {:.1} | {:.1} | {} of {seeds} |",
        1e3 * bias,
        1e3 * error,
        1e3 * found.standard_deviation,
        1e3 * found.predicted,
        found.covered,
    );
    row
}

#[test]
fn a_bore_has_the_stated_scatter() {
    row([5.0, 15.0, 20.0], 6);
}

/// Writes docs/ring-gauge.md with `LASERTRACE_WRITE_PAGES=1`.
#[test]
#[ignore = "minutes; part of make verify"]
fn page_of_the_ring_gauge() {
    const SEEDS: u64 = 40;
    let mut page = format!(
        "# Ring gauge\n\n\
         Written by `make verify` with `cargo test --release --test points ring_gauge:: -- --ignored`.\n\n\
         The bore of a ring gauge of {} mm is scanned over an arc of 100° by the 50 mm sensor of this project. Its wall is seen \
         at several heights in the measuring range, and at several angles of incidence in the laser plane and across it. \
         These are the three parameters of the virtual line scanner of KU Leuven (Sensors 2021, 21, 6638). Each row has \
         {SEEDS} scans with other speckle, noise and systematic errors. The spread and the bias of that article depend on its scanner \
         and its machine, and are not part of this table.\n\n\
         ```toml\n{ERRORS}```\n\n\
         | height, mm | angle in the laser plane, ° | angle across it, ° | mean error of the diameter, µm | standard deviation, µm \
         | stated, µm | intervals ±U that contain the diameter of a scan without errors |\n|---|---|---|---|---|---|---|\n",
        2.0 * RADIUS
    );
    for at in [
        [0.0, 0.0, 0.0],
        [-14.0, 0.0, 0.0],
        [14.0, 0.0, 0.0],
        [0.0, 15.0, 0.0],
        [0.0, 30.0, 0.0],
        [0.0, 0.0, -20.0],
        [0.0, 0.0, 20.0],
        [0.0, 0.0, 35.0],
        [10.0, 20.0, 20.0],
    ] {
        page += &row(at, SEEDS);
    }
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/ring-gauge.md");
        std::fs::write(file, page).unwrap();
    }
}
