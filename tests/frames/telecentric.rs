//! Telecentric lenses against closed forms of parallel projection.

use crate::random::Random;
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;

const MAGNIFICATION: f64 = 0.25;
const APERTURE: f64 = 0.02;
const PITCH_MM: f64 = 5e-3;

/// Returns a scene with the laser above and the camera 30° from it, both directed at the origin.
fn text(part: &str, camera: &str, more: &str) -> String {
    format!(
        "seed = 3
speckle = false
[part]
{part}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = 80
waist_distance_mm = 200
position_mm = [0, 0, 200]
direction = [0, 0, -1]
line = {{ fan_deg = 6, profile = \"uniform\", direction = [1, 0, 0] }}
[camera]
telecentric = {{ magnification = {MAGNIFICATION}, numerical_aperture = {APERTURE} }}
{camera}
resolution_px = [640, 600]
pixel_pitch_um = 5
position_mm = [0, -60, 103.92304845413264]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
[scan]
direction = [0, 1, 0]
step_mm = 0.5
frames = 3
{more}"
    )
}

fn scene(part: &str, camera: &str, more: &str) -> Scene {
    Scene::parse(&text(part, camera, more), "".as_ref()).unwrap()
}

const PLANE: &str = "plane = { size_mm = [40, 40] }";
const FOCUSED: &str = "focus_distance_mm = 120";

/// A point 20 mm from the axis in x and y at a depth of ±20 mm from the focus is displaced by the finite
/// distance of the pupil: √2 · 1000 px · 20 mm / 1e8 mm = 2.9e-4 px.
#[test]
fn points_are_projected_along_parallel_lines() {
    let scene = scene(PLANE, FOCUSED, "");
    let camera_from_head = scene.head_from_camera.inverse();
    let origin = camera_from_head.point(DVec3::ZERO);
    let mut random = Random::new(49);
    for _ in 0..200 {
        let [x, y, z] = [(); 3].map(|()| random.between(-20.0, 20.0));
        let pixel = scene.camera.project(origin + DVec3::new(x, y, z)).unwrap();
        let expected = DVec2::new(320.0, 300.0) + DVec2::new(x, y) * (MAGNIFICATION / PITCH_MM);
        assert!((pixel - expected).length() < 2.9e-4, "{pixel} {expected}");
    }
}

/// Blur diameter 2·tan(asin NA)·m·Δz on both sides of the focus, speckle size λ·m/(2·tan(asin NA)),
/// and solid angle π·tan²(asin NA)/m², each with a relative difference of at most Δz/1e8 mm.
#[test]
fn blur_speckle_and_light_follow_from_the_numerical_aperture() {
    let scene = scene(PLANE, FOCUSED, "");
    let camera = &scene.camera;
    let tan = APERTURE.asin().tan();
    let origin = scene.head_from_camera.inverse().point(DVec3::ZERO);
    let close = |found: f64, expected: f64| {
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
    };
    for depth in [-15.0, -2.0, 3.0, 20.0f64] {
        let blur = camera.defocus_blur(origin + DVec3::Z * depth).unwrap();
        close(blur, 2.0 * tan * MAGNIFICATION * depth.abs());
    }
    close(
        camera.speckle_size(660e-6),
        660e-6 * MAGNIFICATION / (2.0 * tan),
    );
    let solid_angle = camera.pupil_solid_angle(DVec2::new(320.0, 300.0));
    close(
        solid_angle,
        std::f64::consts::PI * (tan / MAGNIFICATION).powi(2),
    );
    close(camera.lens.numerical_aperture(), APERTURE);
}

/// Scheimpflug condition of parallel projection: the sensor is tilted by atan(m·tan 60°) for a laser
/// plane at 60° to the plane across the axis, and the complete plane is in focus.
#[test]
fn the_laser_plane_is_in_focus() {
    let scene = scene(PLANE, "focus = \"laser-plane\"", "");
    let tilt = scene.camera.tilt.x.abs();
    let expected = (MAGNIFICATION * 60f64.to_radians().tan()).atan();
    assert!((tilt - expected).abs() < 1e-6, "{tilt} {expected}");
    let camera_from_head = scene.head_from_camera.inverse();
    for (x, z) in [(0.0, 0.0), (5.0, 10.0), (-8.0, -10.0)] {
        let point = camera_from_head.point(DVec3::new(x, 0.0, z));
        let blur = scene.camera.defocus_blur(point).unwrap();
        assert!(blur < 1e-3 * PITCH_MM, "{blur} mm");
    }
}

/// Points of planes at three heights have errors below 2e-3 px of height, the error of a centroid of
/// rounded counts, and the distance of columns is the pitch over the magnification at all of them.
/// The line is in focus, sharp and without noise.
#[test]
fn heights_do_not_change_the_scale() {
    let row_mm = PITCH_MM / MAGNIFICATION / 30f64.to_radians().sin();
    for height in [-6.0, 0.0, 6.0] {
        let part = format!("{PLANE}\nposition_mm = [0, 0, {height}]");
        let scene = scene(&part, "focus = \"laser-plane\"", "");
        let simulation = Simulation::new(&scene).unwrap();
        let (_, points) = simulation.measure(1, &simulation.image(1));
        let valid: Vec<_> = points.iter().filter(|p| p.flags.is_empty()).collect();
        assert!(valid.len() > 500, "{height} mm: {} points", valid.len());
        for pair in valid.windows(2) {
            assert!(pair[0].deviation.abs() < 2e-3 * row_mm, "{height} mm");
            let columns = f64::from(pair[1].column - pair[0].column);
            let step = (pair[1].position.x - pair[0].position.x).abs() / columns;
            let expected = PITCH_MM / MAGNIFICATION;
            assert!((step / expected - 1.0).abs() < 1e-4, "{step} {expected}");
        }
    }
}

/// A rotation of the camera by φ about its position, at 120 mm from the origin, displaces a point on
/// the axis across it by φ·120 mm, and its height by 1/sin 30° of this displacement. A rotation about
/// the distant pupil would displace it by metres.
#[test]
fn systematic_errors_rotate_the_camera_about_its_position() {
    let errors = "[systematic]\ncamera_rotation_urad = { standard_deviation = 50 }\n\
                  [model]\ngeometry_only = true\n";
    let simulation = Simulation::geometry(&scene(PLANE, FOCUSED, errors)).unwrap();
    let (_, points) = simulation.profile(1);
    let middle = &points[points.len() / 2];
    let mean = simulation.mean_uncertainty(std::slice::from_ref(middle));
    let mean = mean.unwrap();
    let of_camera = mean.sources.iter().find(|s| s.name.contains("camera"));
    let found = of_camera.unwrap().standard_uncertainty;
    let expected = 50e-6 * 120e3 / 30f64.to_radians().sin();
    assert!(
        (found / expected - 1.0).abs() < 0.02,
        "{found} µm, {expected} µm"
    );
}

#[test]
fn contradictions_are_refused() {
    let good = text(PLANE, FOCUSED, "");
    for (more, key) in [
        ("focal_length_mm = 50\n", "camera.telecentric"),
        ("f_number = 8\n", "camera.telecentric"),
        (
            "distortion = { k1 = 0.1, k2 = 0, k3 = 0, p1 = 0, p2 = 0 }\n",
            "camera.distortion",
        ),
    ] {
        let text = good.replace("resolution_px", &format!("{more}resolution_px"));
        let error = Scene::parse(&text, "".as_ref()).err().unwrap().to_string();
        assert!(error.contains(key), "{error}");
    }
    for (from, to, key) in [
        (
            "magnification = 0.25",
            "magnification = -1",
            "camera.telecentric.magnification",
        ),
        (
            "aperture = 0.02",
            "aperture = 0.6",
            "camera.telecentric.numerical_aperture",
        ),
        (
            "look_at_mm = [0, 0, 0]",
            "look_at_mm = [0, -60, 0]",
            "camera.look_at_mm",
        ),
        ("telecentric = {", "# telecentric = {", "camera.f_number"),
    ] {
        let error = Scene::parse(&good.replace(from, to), "".as_ref());
        let error = error.err().unwrap().to_string();
        assert!(error.contains(key), "{key}: {error}");
    }
}
