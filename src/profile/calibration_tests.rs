//! Tests of the derivatives against differences, and of the file format by a round trip.

use super::*;
use crate::math::rng::{Purpose, RngKey};
use glam::UVec2;
use std::path::Path;

fn calibration(distorted: bool) -> Calibration {
    let mut camera = CameraModel {
        resolution: UVec2::new(1280, 512),
        pixel_pitch: 0.0055,
        principal_distance: 27.7,
        principal_point: DVec2::new(652.0, 240.0),
        tilt: DVec2::new(0.2, -0.05),
        distortion: None,
    };
    if distorted {
        let reach = camera.reach().unwrap();
        let lens = Distortion::new([-0.2, 0.3, 0.1], [2e-3, -3e-3], reach);
        camera.distortion = Some(lens.unwrap());
    }
    let pose = Rigid::from_euler_xyz(DVec3::new(2.6, 0.1, 0.2), DVec3::new(1.0, -126.0, 233.0));
    let normal = DVec3::new(0.05, 0.86, 0.5).normalize();
    Calibration::perfect(camera, pose, DVec3::new(3.0, -2.0, 250.0), normal)
}

fn some_pixels() -> Vec<DVec2> {
    let key = RngKey::new(5, Purpose::SensorNoise);
    let share = |i: u64| DVec2::new(key.with(i).uniform(0), key.with(i).uniform(1));
    (0..20)
        .map(|i| share(i) * DVec2::new(1280.0, 512.0))
        .collect()
}

fn in_head(calibration: &Calibration, pixel: DVec2) -> DVec3 {
    let point = calibration.point_at(pixel).unwrap();
    calibration.head_from_camera.point(point)
}

/// The Jacobian agrees with central differences, with and without distortion.
///
/// The steps are h = 0.05 px for pixels and at most 4e-5 for parameters. The error of the
/// differences is h²/6 times the third derivative. For rotations this is of the order of the
/// distance, 250 mm, which gives 250·(4e-5)²/6 = 7e-8. Rounding adds 250·2e-16/4e-5 = 1e-9.
/// Coefficients of a lens without distortion have derivatives too.
#[test]
fn the_jacobian_is_that_of_the_point() {
    for distorted in [false, true] {
        let calibration = calibration(distorted);
        for pixel in some_pixels() {
            let jacobian = calibration.point_jacobian(pixel).unwrap();
            assert!((jacobian.point - in_head(&calibration, pixel)).length() < 1e-12);
            let close = |found: DVec3, expected: DVec3, name: &str| {
                let bound = 1e-6 * (1.0 + expected.length());
                assert!(
                    (found - expected).length() < bound,
                    "{name}: {found} {expected}"
                );
            };
            let h = 0.05;
            for (axis, expected) in DVec2::AXES.into_iter().zip(jacobian.by_pixel) {
                let at = |h: f64| in_head(&calibration, pixel + axis * h);
                close((at(h) - at(-h)) / (2.0 * h), expected, "pixel");
            }
            for (i, expected) in jacobian.by_parameters.into_iter().enumerate() {
                let h = 0.01 / expected.length().max(250.0);
                let at = |h: f64| {
                    let mut by = [0.0; PARAMETERS.len()];
                    by[i] = h;
                    in_head(&calibration.perturbed(&by), pixel)
                };
                close((at(h) - at(-h)) / (2.0 * h), expected, PARAMETERS[i]);
            }
        }
    }
}

/// `difference` recovers the change made by `perturbed`. The tolerance is the rounding of values up
/// to 250 (column and row: 1280).
#[test]
fn a_difference_is_what_a_calibration_was_changed_by() {
    let key = RngKey::new(6, Purpose::SensorNoise);
    for distorted in [false, true] {
        let calibration = calibration(distorted);
        let by: Parameters = std::array::from_fn(|i| {
            let small = 0.01 * (key.uniform(i as u64) - 0.5);
            if distorted || !(3..8).contains(&i) {
                small
            } else {
                0.0
            }
        });
        let found = calibration.difference(&calibration.perturbed(&by));
        for (i, name) in PARAMETERS.iter().enumerate() {
            assert!(
                (found[i] - by[i]).abs() < 1e-12,
                "{name}: {} {}",
                found[i],
                by[i]
            );
        }
    }
}

/// A round trip through the file preserves a covariance of full rank and one with exact parameters.
/// The tolerance is the rounding of σ·σ·ρ and of angles.
#[test]
fn a_calibration_comes_back_from_its_file() {
    for distorted in [false, true] {
        let mut written = calibration(distorted);
        for i in 0..PARAMETERS.len() {
            for j in 0..PARAMETERS.len() {
                let known = |i: usize| !distorted && (3..8).contains(&i);
                let rho = if i == j { 1.0 } else { 0.3 };
                if !known(i) && !known(j) {
                    written.covariance[i][j] = 1e-6 * rho * ((i + 1) * (j + 1)) as f64;
                }
            }
        }
        let text = serde_json::to_string_pretty(&written).unwrap();
        let read = Calibration::parse(Path::new("c.json"), text.as_bytes()).unwrap();
        let difference = written.difference(&read);
        assert!(difference.iter().all(|d| d.abs() < 1e-12), "{difference:?}");
        assert_eq!(read.camera.resolution, written.camera.resolution);
        for (a, b) in read
            .covariance
            .iter()
            .flatten()
            .zip(written.covariance.iter().flatten())
        {
            assert!((a - b).abs() <= 1e-15 * a.abs(), "{a} {b}");
        }
    }
}

#[test]
fn mistakes_in_the_file_are_named() {
    let text = serde_json::to_string_pretty(&calibration(true)).unwrap();
    for (from, to, message) in [
        ("\"k1\": -0.2", "\"k1\": -90", "camera.distortion: found"),
        (
            "\"k1\": -0.2",
            "\"q\": 0",
            "camera.distortion.q: found unknown",
        ),
        (
            "27.7",
            "-27.7",
            "camera.principal_distance_mm: found -27.7, expected a finite",
        ),
        (
            "27.7",
            "\"a\"",
            "camera.principal_distance_mm: found invalid type",
        ),
        (
            "27.7",
            "1e999",
            "camera.principal_distance_mm: found number out of range",
        ),
        ("\"normal\"", "\"norm\"", "laser_plane.norm: found unknown"),
        ("652.0", "1e300", "camera.principal_point_px: found"),
        ("{\n  \"camera\"", "[\n \"camera\"", "c.json:"),
    ] {
        assert!(text.contains(from), "{text}");
        let wrong = text.replacen(from, to, 1);
        let error = Calibration::parse(Path::new("c.json"), wrong.as_bytes()).unwrap_err();
        assert!(error.to_string().contains(message), "{to}: {error}");
    }
    let uncertain = text.replacen(
        "\"laser_plane\"",
        r#""uncertainty": { "parameters": ["k1", "k2"], "standard": [1, 1],
           "correlation": [[1, 2], [2, 1]] }, "laser_plane""#,
        1,
    );
    for (from, to, message) in [
        ("a", "a", "uncertainty.correlation: found"),
        (
            "[[1, 2], [2, 1]]",
            "[[1, 0.5]]",
            "uncertainty.correlation: found",
        ),
        ("[1, 1]", "[1]", "uncertainty.standard: found"),
        ("[1, 1]", "[1, -1]", "uncertainty.standard: found"),
        ("\"k2\"]", "\"k9\"]", "uncertainty.parameters: found \"k9\""),
        ("\"k2\"]", "\"k1\"]", "uncertainty.parameters: found \"k1\""),
    ] {
        assert!(uncertain.contains(from), "{uncertain}");
        let wrong = uncertain.replacen(from, to, 1);
        let error = Calibration::parse(Path::new("c.json"), wrong.as_bytes()).unwrap_err();
        assert!(error.to_string().contains(message), "{to}: {error}");
    }
}
