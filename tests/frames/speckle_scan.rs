//! Speckle in images: tied to the surface while the head moves, of the right
//! grain and contrast.

use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;

/// A plane evenly lit by a wide beam, seen at 45°, under a head that moves by
/// `step` a frame.
fn scene(step: DVec3, tilt_deg: f64) -> Scene {
    let text = format!(
        r#"
seed = 3
speckle = true
[part]
plane = {{ size_mm = [10, 10] }}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = 4000
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
[camera]
focal_length_mm = 50
f_number = 16
focus_distance_mm = 150
resolution_px = [200, 160]
pixel_pitch_um = 5
position_mm = [0, -106.066017, 106.066017]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
tilt_deg = [{tilt_deg}, 0]
exposure_ms = 1
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
[scan]
direction = [{}, {}, {}]
step_mm = {}
frames = 3
"#,
        step.x,
        step.y,
        step.z,
        step.length()
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

const WIDTH: i64 = 200;
const HEIGHT: i64 = 160;

/// Correlation coefficient of `a` at (x, y) with `b` at (x, y) + shift.
fn correlation(a: &[f32], b: &[f32], shift: [i64; 2]) -> f64 {
    let margin = 12;
    let (mut n, mut sa, mut sb, mut saa, mut sbb, mut sab) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for y in margin..HEIGHT - margin {
        for x in margin..WIDTH - margin {
            let p = a[(y * WIDTH + x) as usize] as f64;
            let q = b[((y + shift[1]) * WIDTH + x + shift[0]) as usize] as f64;
            n += 1.0;
            sa += p;
            sb += q;
            saa += p * p;
            sbb += q * q;
            sab += p * q;
        }
    }
    let cov = sab - sa * sb / n;
    cov / ((saa - sa * sa / n) * (sbb - sb * sb / n)).sqrt()
}

/// The head's step is chosen so that a surface point moves by whole pixels; the
/// pattern must move with it, both ways and in both axes. The correlation left is
/// that of δ, a few hundredths of a pupil here, and of the perspective across the
/// image, a few hundredths of a pixel.
#[test]
fn grains_move_with_the_surface_that_bears_them() {
    for pixels in [[5.0, 4.0], [-6.0, 3.0], [0.0, -7.0]] {
        // Object mm a pixel: pitch/m along x, and foreshortened by 45° along y;
        // rows count downwards while the image of +y goes up.
        let pitch = 0.005 / 0.5;
        let step = DVec3::new(-pixels[0] * pitch, pixels[1] * pitch * 2f64.sqrt(), 0.0);
        let scene = scene(step, 0.0);
        let simulation = Simulation::new(&scene).unwrap();
        let camera = &scene.camera;
        let seen = |frame: u32| {
            let part_from_camera = simulation.view(frame).part_from_camera;
            camera
                .project(part_from_camera.inverse().point(DVec3::ZERO))
                .unwrap()
        };
        let moved = seen(1) - seen(0);
        let expected = DVec2::from(pixels);
        assert!((moved - expected).length() < 0.05, "{moved} {expected}");

        let (a, b) = (
            simulation.irradiance(0).dense(),
            simulation.irradiance(1).dense(),
        );
        let mut best = (f64::NEG_INFINITY, [0, 0]);
        for dy in -10..=10 {
            for dx in -10..=10 {
                let c = correlation(&a, &b, [dx, dy]);
                if c > best.0 {
                    best = (c, [dx, dy]);
                }
            }
        }
        assert_eq!(best.1, pixels.map(|p| p as i64), "{best:?}");
        assert!(best.0 > 0.9, "{best:?}");
    }
}

/// Contrast of the pixel-integrated pattern against the closed form of
/// physics (Goodman 2007, section 4.6): h = λN(1+m) = 15.84 µm, p = 5 µm, q = 0.316,
/// C = 0.963. The image holds about 200·160·q² ≈ 3000 speckles: the contrast
/// scatters by 1/√3000 · about 1 = 2 % from pattern to pattern; 5 σ over a fixed
/// seed. The mean is 1 to 5·C/√3000.
#[test]
fn the_image_has_the_contrast_of_integrated_speckle() {
    for tilt in [0.0, 12.0] {
        let scene = scene(DVec3::Y * 0.01, tilt);
        let with = Simulation::new(&scene).unwrap().irradiance(0).dense();
        let mut plain = scene;
        plain.speckle = None;
        let without = Simulation::new(&plain).unwrap().irradiance(0).dense();
        let ratios: Vec<f64> = with
            .iter()
            .zip(&without)
            .map(|(a, b)| *a as f64 / *b as f64)
            .collect();
        let n = ratios.len() as f64;
        let mean = ratios.iter().sum::<f64>() / n;
        let contrast = (ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / n).sqrt() / mean;
        assert!((mean - 1.0).abs() < 5.0 / 3000f64.sqrt(), "{tilt}: {mean}");
        assert!((contrast - 0.963).abs() < 0.1, "{tilt}: {contrast}");
    }
}

/// A plane 150 mm below a lens of 50 mm focused on 120 mm, lit from a point 100 mm
/// away; the head moves in plane by `step` mm a frame. With speckle or without.
fn out_of_focus_scene(step: f64, speckle: bool) -> Scene {
    let text = format!(
        r#"
seed = 5
speckle = {speckle}
[part]
plane = {{ size_mm = [20, 20] }}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = 10
waist_distance_mm = 0
position_mm = [0, 60, 80]
direction = [0, -0.6, -0.8]
[camera]
focal_length_mm = 50
f_number = 16
focus_distance_mm = 120
resolution_px = [200, 160]
pixel_pitch_um = 5
position_mm = [0, 0, 150]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 1
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
[scan]
start_mm = [-1, 0, 0]
direction = [1, 0, 0]
step_mm = {step}
frames = 60
"#
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

/// The head moves in plane by b. By A_p = b·(1 + L_o/L_s) the pattern moves by
/// m·(b + (1 − L_f/L_o)·(A_p − b)) = 0.714·(1 + 0.2·1.5)·b on the sensor: nine
/// pixels for the step chosen, where it would be six in focus. That is found from
/// frame to frame through strips of the pupil (one in 26 frames) coming and going,
/// with the correlation of δ = 0.04, γ = 0.90, less what perspective takes; a pixel
/// off, a quarter of a grain, it is 0.06 lower. Contrast: q = 0.28, C = 0.970, 2000
/// grains.
#[test]
fn out_of_focus_the_pattern_moves_by_the_formula_all_along_the_scan() {
    let (l_o, l_s, l_f, f) = (150.0, 100.0, 120.0, 50.0);
    let magnification = f / (l_f - f);
    let defocus = 1.0 - l_f / l_o;
    let pixels = 9;
    let step = 0.005 * pixels as f64 / (magnification * (1.0 + defocus * l_o / l_s));
    let scene = out_of_focus_scene(step, true);
    let with = Simulation::new(&scene).unwrap();
    assert!(with.plan.local_speckle_motion, "{:?}", with.plan.effects);
    let frames = [0, 1, 12, 13, 14, 25, 26, 27, 28];
    let images: Vec<Vec<f32>> = frames.iter().map(|&k| with.irradiance(k).dense()).collect();
    let plain = out_of_focus_scene(step, false);
    let plain = Simulation::new(&plain).unwrap().irradiance(0).dense();
    let speckle: Vec<Vec<f32>> = (images.iter())
        .map(|image| image.iter().zip(&plain).map(|(a, b)| a / b).collect())
        .collect();
    for (k, pair) in frames
        .windows(2)
        .enumerate()
        .filter(|(_, f)| f[1] == f[0] + 1)
    {
        let (a, b) = (&speckle[k], &speckle[k + 1]);
        let lags = (-12..=12).flat_map(|dx| (-3..=3).map(move |dy| [dx, dy]));
        let best = lags
            .map(|lag| (correlation(a, b, lag), lag))
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap();
        // The part moves to −x, towards lower columns.
        assert_eq!(best.1, [-pixels, 0], "{pair:?}: {best:?}");
        assert!(best.0 > 0.8, "{pair:?}: {best:?}");
        let n = a.len() as f64;
        let mean = a.iter().map(|v| *v as f64).sum::<f64>() / n;
        let square = a.iter().map(|v| (*v as f64 - mean).powi(2)).sum::<f64>() / n;
        let contrast = square.sqrt() / mean;
        assert!(
            (mean - 1.0).abs() < 5.0 / 2000f64.sqrt(),
            "{pair:?}: {mean}"
        );
        assert!((contrast - 0.97).abs() < 0.11, "{pair:?}: {contrast}");
    }
}
