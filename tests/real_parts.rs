//! Real parts in several formats and units: a sensor fitted to each part scans
//! across its middle, and the points must lie on the CAD surface and in the
//! columns in which the sensor sees the lit line.

use lasertrace::accel::{Accel, Ray, WIDTH};
use lasertrace::batch::{Control, scan};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::mesh;
use lasertrace::scene::Scene;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// File, unit, millimetres of the unit, and the rotation that lays the part down
/// before the laser with its most interesting side up.
const PARTS: &[(&str, &str, f64, [f64; 3])] = &[
    ("NIST_MBE_PMI_1_l0.1.stl", "mm", 1.0, [0.0, 0.0, 0.0]),
    ("NIST_MBE_PMI_3_l0.1.stl", "mm", 1.0, [0.0, 0.0, 0.0]),
    ("NIST_MBE_PMI_5_l1.stl", "mm", 1.0, [0.0, 0.0, 20.0]),
    ("abb6640_link_5.stl", "m", 1000.0, [0.0, 0.0, 0.0]),
    ("trimesh_ADIS16480.STL", "m", 1000.0, [90.0, 0.0, 0.0]),
    ("trimesh_octagonal_pocket.stl", "m", 1000.0, [0.0, 0.0, 0.0]),
    ("trimesh_featuretype.STL", "inch", 25.4, [0.0, 0.0, 90.0]),
    ("trimesh_cycloidal.ply", "inch", 25.4, [90.0, 0.0, 0.0]),
    ("trimesh_1002_tray_bottom.STL", "mm", 1.0, [90.0, 0.0, 0.0]),
    ("trimesh_plate_holes.STL", "mm", 1.0, [0.0, 0.0, 5.0]),
    ("sick_Hinge.ply", "mm", 1.0, [0.0, 0.0, 0.0]),
    ("gotti_gear.ply", "mm", 1.0, [0.0, 0.0, 0.0]),
    ("prius_hybrid_body.obj", "cm", 10.0, [0.0, 0.0, 0.0]),
    ("trimesh_unit_sphere.STL", "cm", 10.0, [0.0, 0.0, 0.0]),
];

const COLUMNS: usize = 320;
const ROWS: usize = 200;
const FRAMES: u32 = 3;
/// Between laser and camera, degrees.
const TRIANGULATION_DEG: f64 = 30.0;

/// A scene for a part and what the bounds below need to know of it.
struct Fitted {
    text: String,
    /// Edge of a pixel's image on the part's middle, mm.
    object_pixel: f64,
}

/// A line laser straight above the part's middle and a camera beside it, both as
/// far off as four times the part's size, so that the line spans the part and all
/// heights fall on the sensor. The waist is two pixels on the part (1/e²), wide
/// enough to be sampled and narrow enough not to smear edges.
fn fit(file: &Path, unit: &str, unit_mm: f64, rotation_deg: [f64; 3]) -> Fitted {
    let part = mesh::load(file, unit_mm).unwrap();
    let rotation = lasertrace::math::Rigid::from_euler_xyz(
        DVec3::from(rotation_deg).map(f64::to_radians),
        DVec3::ZERO,
    );
    let turned = part.positions.iter().map(|&p| rotation.point(p));
    let bounds = lasertrace::math::Aabb::of(turned);
    let (middle, size) = (bounds.center(), bounds.size());
    let (sin, cos) = TRIANGULATION_DEG.to_radians().sin_cos();
    let object_pixel = (1.1 * size.x / COLUMNS as f64).max(size.z * sin / (0.7 * ROWS as f64));
    let distance = 4.0 * size.max_element();
    let pitch = 5e-3;
    let magnification = pitch / object_pixel;
    let focal_length = distance * magnification / (1.0 + magnification);
    let half_line = 0.6 * size.x.max(COLUMNS as f64 * object_pixel);
    // A surface across the beam gives 30 000 electrons at the line's middle: its
    // radiance through the pupil, for 10 mW over line and waist at ρ = 0.5.
    let (f_number, waist) = (8.0, 2.0 * object_pixel);
    let irradiance = 10.0 / (2.0 * half_line * waist * (std::f64::consts::PI / 2.0).sqrt());
    let on_sensor =
        irradiance * 0.5 * cos / (4.0 * f_number * f_number * (1.0 + magnification).powi(2));
    let photon_mj = 1.986_445_86e-25 / 660e-9 * 1e3;
    let exposure_ms = 30_000.0 * photon_mj / (on_sensor * pitch * pitch * 1e-3 * 0.5);
    let [x, y, z] = (-middle).to_array();
    let [rx, ry, rz] = rotation_deg;
    let step = 0.3 * size.y / FRAMES as f64;
    let text = format!(
        r#"seed = 1
speckle = false
[part]
mesh = {{ file = {file:?}, unit = "{unit}" }}
reflectance = 0.5
position_mm = [{x}, {y}, {z}]
rotation_deg = [{rx}, {ry}, {rz}]
[laser]
wavelength_nm = 660
power_mw = 10
waist_radius_um = {waist_um}
waist_distance_mm = {distance}
position_mm = [0, 0, {distance}]
direction = [0, 0, -1]
line = {{ fan_deg = {fan}, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = {focal_length}
f_number = {f_number}
focus_distance_mm = {distance}
resolution_px = [{COLUMNS}, {ROWS}]
pixel_pitch_um = 5
position_mm = [0, {camera_y}, {camera_z}]
look_at_mm = [0, 0, 0]
columns = [1, 0, 0]
exposure_ms = {exposure_ms}
quantum_efficiency = 0.5
gain_dn_per_e = 1
bit_depth = 16
full_well_e = 65000
[scan]
start_mm = [0, {start}, 0]
direction = [0, 1, 0]
step_mm = {step}
frames = {FRAMES}
"#,
        waist_um = waist * 1e3,
        fan = 2.0 * (half_line / distance).atan().to_degrees(),
        camera_y = -distance * sin,
        camera_z = distance * cos,
        // Off the very middle: parts are symmetric, and a line along an edge of a
        // symmetric part is no fair sample of it.
        start = -step * (FRAMES as f64 / 2.0 - 0.37),
    );
    Fitted { text, object_pixel }
}

/// Columns in which the camera sees a point on the laser's side that the laser's
/// plane meets first, by one ray for each half of a pixel: closest hit from the
/// laser, then free sight from there to the camera.
fn lit_columns(scene: &Scene, accel: &Accel, frame: u32) -> BTreeSet<u32> {
    let part_from_laser = scene.part_from_head(frame) * scene.head_from_laser;
    let part_from_camera = scene.part_from_head(frame) * scene.head_from_camera;
    let (laser, eye) = (part_from_laser.translation, part_from_camera.translation);
    let half_fan = scene.laser.fan.as_ref().unwrap().angle / 2.0;
    let count = 4 * COLUMNS;
    let rays: Vec<Ray> = (0..count)
        .map(|i| {
            let angle = ((i as f64 + 0.5) / count as f64 * 2.0 - 1.0) * half_fan;
            Ray {
                origin: laser,
                direction: part_from_laser.vector(DVec3::new(angle.sin(), 0.0, angle.cos())),
                t_max: f64::INFINITY,
            }
        })
        .collect();
    let mut columns = BTreeSet::new();
    for packet in rays.chunks(WIDTH) {
        for hit in accel.closest(packet, |_, _| true).into_iter().flatten() {
            let start = hit.point + hit.normal * accel.resolution();
            let to_eye = Ray::between(start, eye).unwrap();
            if to_eye.direction.dot(hit.normal) <= 0.0 || accel.occluded(&[to_eye]) != 0 {
                continue;
            }
            let pixel = scene
                .camera
                .project(part_from_camera.inverse().point(hit.point));
            let on_sensor =
                |p: &DVec2| p.x >= 0.0 && p.y >= 0.0 && p.x < COLUMNS as f64 && p.y < ROWS as f64;
            columns.extend(pixel.filter(on_sensor).map(|p| p.x as u32));
        }
    }
    columns
}

/// Frame, column and deviation (mm) of each point of a cloud.
fn read_cloud(path: &Path) -> Vec<(u32, u32, f64)> {
    let bytes = fs::read(path).unwrap();
    let header = bytes
        .windows(11)
        .position(|w| w == b"end_header\n")
        .unwrap()
        + 11;
    let number = |record: &[u8], at: usize| -> [u8; 4] { record[at..at + 4].try_into().unwrap() };
    bytes[header..]
        .chunks_exact(40)
        .map(|record| {
            (
                u32::from_le_bytes(number(record, 32)),
                u32::from_le_bytes(number(record, 36)),
                f32::from_le_bytes(number(record, 24)) as f64,
            )
        })
        .collect()
}

struct Found {
    /// Share of the lit columns with a point.
    measured: f64,
    /// Share of the points in columns that are not lit.
    stray: f64,
    points: usize,
    /// Sizes of the deviations in object pixels over sin of the triangulation
    /// angle, ascending.
    deviations: Vec<f64>,
}

fn scan_part(file: &Path, unit: &str, unit_mm: f64, rotation_deg: [f64; 3]) -> Found {
    let fitted = fit(file, unit, unit_mm, rotation_deg);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    fs::write(&path, &fitted.text).unwrap();
    let scene = Scene::load(&path).unwrap();
    let control = Control {
        progress: &|_| {},
        stop: &AtomicBool::new(false),
    };
    scan(&scene, &folder.path().join("out"), &control).unwrap();
    let cloud = read_cloud(&folder.path().join("out/cloud.ply"));

    let accel = Accel::build(&scene.mesh, 1).unwrap();
    let (mut lit, mut measured) = (0, 0);
    for frame in 0..FRAMES {
        let columns = lit_columns(&scene, &accel, frame);
        lit += columns.len();
        let seen = cloud
            .iter()
            .filter(|p| p.0 == frame && columns.contains(&p.1));
        measured += seen.count();
    }
    let unit = fitted.object_pixel / TRIANGULATION_DEG.to_radians().sin();
    let mut deviations: Vec<f64> = cloud.iter().map(|p| p.2.abs() / unit).collect();
    deviations.sort_by(f64::total_cmp);
    Found {
        measured: measured as f64 / lit as f64,
        stray: 1.0 - measured as f64 / cloud.len() as f64,
        points: cloud.len(),
        deviations,
    }
}

fn meshes() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/meshes");
    if path.is_dir() {
        return Some(path.canonicalize().unwrap());
    }
    eprintln!(
        "\n*** NOT TESTED: {} is absent, so no real part was scanned. ***\n",
        path.display()
    );
    None
}

#[test]
fn points_of_real_parts_lie_on_the_cad_surface() {
    let Some(folder) = meshes() else { return };
    for (name, unit, unit_mm, rotation) in PARTS {
        let start = std::time::Instant::now();
        let f = scan_part(&folder.join(name), unit, *unit_mm, *rotation);
        let at = |share: f64| f.deviations[(share * (f.points - 1) as f64) as usize];
        println!(
            "{name:<32} points {:4} measured {:.3} stray {:.3} 50% {:.4} 90% {:.4} 95% {:.3} 98% {:.3} 99% {:.3} max {:.3}  {:.1?}",
            f.points,
            f.measured,
            f.stray,
            at(0.5),
            at(0.9),
            at(0.95),
            at(0.98),
            at(0.99),
            at(1.0),
            start.elapsed()
        );
    }
}
