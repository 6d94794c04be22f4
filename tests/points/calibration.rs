//! Calibrations: found again within their uncertainty, refused where views do not
//! determine them, and used for measuring whether right or wrong.

use crate::effort::extent;
use glam::UVec2;
use lasertrace::camera::{CameraModel, Distortion};
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::profile::{
    Calibration, Dot, LaserLineObservation, Observations, PARAMETERS, Parameters, adjust,
};
use lasertrace::run::{RunControl, Simulation};
use lasertrace::scene::Scene;
use lasertrace::study::calibrate;
use rand_distr::{Distribution, StandardNormal};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

fn sensor(tilt_deg: [f64; 2], distorts: bool) -> Calibration {
    let mut camera = CameraModel {
        resolution: UVec2::new(1280, 512),
        pixel_pitch: 0.0055,
        principal_distance: 27.7,
        principal_point: DVec2::new(652.0, 240.0),
        tilt: DVec2::from(tilt_deg.map(f64::to_radians)),
        distortion: None,
    };
    if distorts {
        let reach = camera.reach().unwrap();
        let lens = Distortion::new([-0.2, 0.3, 0.0], [1e-3, -2e-3], reach);
        camera.distortion = Some(lens.unwrap());
    }
    let eye = DVec3::new(2.0, -126.0, 233.0);
    let pose = Rigid::from_z_and_x(eye, DVec3::Z * 15.0 - eye, DVec3::X).unwrap();
    let laser = Rigid::from_euler_xyz(DVec3::new(0.01, -0.02, 0.03), DVec3::Z * 200.0);
    let camera_from_laser = pose.inverse() * laser;
    Calibration::perfect(
        camera,
        pose,
        camera_from_laser.translation,
        camera_from_laser.rotation.y_axis,
    )
}

const DOT_SIGMA: f64 = 0.02;
const LINE_SIGMA: f64 = 0.2;

/// Poses of a target: heights, and tilts about x and y in degrees.
const POSES: [[f64; 3]; 6] = [
    [0.0, 0.0, 0.0],
    [8.0, 20.0, 0.0],
    [16.0, 0.0, 20.0],
    [24.0, -20.0, 0.0],
    [32.0, 0.0, -20.0],
    [12.0, 15.0, 15.0],
];

/// Noisy views of a target in these poses.
fn views(truth: &Calibration, poses: &[[f64; 3]], key: RngKey) -> Observations {
    let mut random = key.counter_stream();
    let mut normal = move || -> f64 { StandardNormal.sample(&mut random) };
    let mut seen = Observations::default();
    let camera_from_head = truth.head_from_camera.inverse();
    let size = truth.camera.resolution.as_dvec2();
    for [height, x, y] in poses {
        let angles = DVec3::new(*x, *y, 0.0).map(f64::to_radians);
        let target = Rigid::from_euler_xyz(angles, DVec3::Z * *height);
        for i in 0..63 {
            let at = DVec3::new((i % 9) as f64 - 4.0, (i / 9) as f64 - 3.0, 0.0) * 7.0;
            let position = target.point(at);
            let pixel = truth.camera.project(camera_from_head.point(position));
            let inside = |p: &DVec2| p.cmpge(DVec2::ZERO).all() && p.cmple(size).all();
            let Some(pixel) = pixel.filter(inside) else {
                continue;
            };
            let noise = DVec2::new(normal(), normal()) * DOT_SIGMA;
            seen.dots.push(Dot {
                position,
                pixel: pixel + noise,
                sigma_px: DOT_SIGMA,
            });
        }
        // Along the line in which laser plane and target meet.
        let n = truth.head_from_camera.vector(truth.plane_normal);
        let on_plane = truth.head_from_camera.point(truth.plane_point);
        let along = n.cross(target.rotation.z_axis).normalize();
        let line = Rigid::translation(target.translation);
        let across = along.cross(n).normalize();
        let to_plane = n * n.dot(on_plane - line.translation);
        let foot = line.translation + to_plane;
        let down = target.rotation.z_axis.dot(target.translation - foot)
            / target.rotation.z_axis.dot(across);
        for i in -15..=15 {
            let point = foot + across * down + along * (i as f64 * 1.9);
            let pixel = truth.camera.project(camera_from_head.point(point)).unwrap();
            seen.line.push(LaserLineObservation {
                target_point: target.translation,
                target_normal: target.rotation.z_axis,
                pixel: pixel + DVec2::Y * (normal() * LINE_SIGMA),
            });
        }
    }
    seen
}

/// Nominal values off by more than any workshop would be.
fn nominal(truth: &Calibration, key: RngKey) -> Calibration {
    let off: Parameters = std::array::from_fn(|i| {
        let size = [
            0.2, 8.0, 8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5e-3, 5e-3, 5e-3, 0.5, 0.5, 0.5,
        ];
        let size = size
            .get(i)
            .copied()
            .unwrap_or(if i == 14 { 0.5 } else { 5e-3 });
        size * (2.0 * key.uniform(i as u64) - 1.0)
    });
    let mut nominal = truth.perturbed(&off);
    nominal.camera.distortion = truth
        .camera
        .distortion
        .map(|_| Distortion::new_unchecked([0.0; 3], [0.0; 2]));
    nominal
}

/// Bounds that χ² of n degrees of freedom leaves with a chance below 6e-7: five
/// standard deviations of its cube root, which is nearly normal (Wilson & Hilferty
/// 1931).
fn bounds(n: f64) -> std::ops::Range<f64> {
    let spread = 5.0 * (2.0 / (9.0 * n)).sqrt();
    let at = |z: f64| n * (1.0 - 2.0 / (9.0 * n) + z).max(0.0).powi(3);
    at(-spread)..at(spread)
}

/// Over all seeds: squared normalised errors of each parameter, of all together by
/// their covariance, and of a measured point by J·C·Jᵀ. Some 20 bounds a sensor, so
/// a false alarm has a chance of 4e-5. The row noise, estimated from 183 residuals,
/// would widen the sums by 1 %, far less than the bounds allow.
#[test]
fn errors_are_as_large_as_the_uncertainty_says() {
    for (tilt, distorts) in [([0.0, 0.0], false), ([0.0, 0.0], true), ([8.0, -3.0], true)] {
        let truth = sensor(tilt, distorts);
        let (mut single, mut all, mut points, mut free) = ([0.0; 17], 0.0, 0.0, 0);
        let seeds = extent(12, 40);
        for seed in 0..seeds {
            let key = RngKey::new(seed, Purpose::Calibration);
            let seen = views(&truth, &POSES, key);
            assert!(seen.dots.len() > 200 && seen.line.len() > 150);
            let found = adjust(&nominal(&truth, key.with(1)), &seen)
                .unwrap()
                .calibration;
            let (chi2, n) = found.chi_squared(&truth).unwrap();
            (all, free) = (all + chi2, n);
            let sigma = found.standard_uncertainties();
            for (i, d) in found.difference(&truth).into_iter().enumerate() {
                single[i] += if sigma[i] > 0.0 {
                    (d / sigma[i]).powi(2)
                } else {
                    d
                };
            }
            let pixel = DVec2::new(1100.0, 100.0);
            let jacobian = found.point_jacobian(pixel).unwrap();
            let there = truth.head_from_camera.point(truth.point_at(pixel).unwrap());
            let error = there - jacobian.point;
            let covariance = found.point_covariance(&jacobian);
            points += error.dot(covariance.inverse() * error);
        }
        let seeds = seeds as f64;
        assert_eq!(free, if distorts { 17 } else { 12 });
        assert!(bounds(seeds * free as f64).contains(&all), "{tilt:?} {all}");
        assert!(bounds(3.0 * seeds).contains(&points), "{tilt:?} {points}");
        for (i, &sum) in single.iter().enumerate() {
            match !distorts && (3..8).contains(&i) {
                true => assert_eq!(sum, 0.0),
                false => assert!(bounds(seeds).contains(&sum), "{} {sum}", PARAMETERS[i]),
            }
        }
    }
}

#[test]
fn views_that_do_not_determine_the_sensor_are_refused() {
    let truth = sensor([0.0, 0.0], false);
    let key = RngKey::new(1, Purpose::Calibration);
    let start = nominal(&truth, key.with(1));
    let refused = |seen: &Observations| adjust(&start, seen).unwrap_err();
    // One pose, and many times the same.
    for poses in [&[POSES[0]; 1][..], &[POSES[1]; 5]] {
        let error = refused(&views(&truth, poses, key));
        assert!(error.contains("do not determine"), "{error}");
    }
    // The laser line in one pose only: the plane may turn about it.
    let all = views(&truth, &POSES, key);
    let mut one_line = all.clone();
    one_line.line.truncate(31);
    let error = refused(&one_line);
    assert!(error.contains("do not determine plane_tilt"), "{error}");
    for few in [0, 3] {
        let mut no_line = all.clone();
        no_line.line.truncate(few);
        assert!(refused(&no_line).contains("too few"));
    }
    assert!(refused(&Observations::default()).contains("too few"));
    // Dots that no camera there would see.
    let mut wild = all.clone();
    for dot in &mut wild.dots {
        dot.position.z += 1e4;
    }
    assert!(!refused(&wild).is_empty());
}

fn scene_with(folder: &Path, changes: &[(&str, &str)], more: &str) -> PathBuf {
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/plane/scene.toml");
    let mut text = std::fs::read_to_string(scene).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = folder.join("scene.toml");
    std::fs::write(&path, text + more).unwrap();
    path
}

const MEASURE: &str = "\n[measure]\ncalibration = \"c.json\"\n";
const DISTORTION: &str = "column_axis = [1, 0, 0]\ndistortion = { k1 = -20, p1 = 0.2 }\n";

fn points(scene: &Scene, calibration: Option<&Calibration>) -> Vec<CloudPoint> {
    let mut simulation = Simulation::new(scene).unwrap();
    if let Some(calibration) = calibration {
        simulation.calibration = calibration.clone();
    }
    let counts = simulation.counts(4, &simulation.irradiance(4));
    simulation.measure(4, &counts).1
}

/// A laser plane believed d = 10 µm further along its normal n than it is: each
/// point moves along its viewing ray v by d/(n·v). The correction of skew, below 1 µm, changes by
/// a relative d/D = 10⁻⁴ at the distance D of the camera, hence by less than 10⁻⁴·d, and nothing
/// else does beyond rounding. The camera looks at 45°, so that on axis it is d·√2 and the height is off by d; the field is 1° wide.
/// A true calibration, read from a file, changes nothing beyond rounding.
#[test]
fn a_shifted_laser_plane_shows_in_the_heights() {
    let folder = tempfile::tempdir().unwrap();
    let plain = Scene::load(&scene_with(folder.path(), &[], "")).unwrap();
    let truth = Simulation::new(&plain).unwrap().calibration;
    let right = points(&plain, None);
    for d in [0.0, 0.01] {
        let mut by = [0.0; PARAMETERS.len()];
        by[14] = d;
        let believed = serde_json::to_string(&truth.perturbed(&by)).unwrap();
        std::fs::write(folder.path().join("c.json"), believed).unwrap();
        let scene = Scene::load(&scene_with(folder.path(), &[], MEASURE)).unwrap();
        assert_ne!(scene.hash, plain.hash);
        let wrong = points(&scene, None);
        assert_eq!(wrong.len(), right.len());
        let head_from_camera = scene.head_from_camera;
        let n = head_from_camera.vector(truth.plane_normal);
        let head = scene.part_from_head(4);
        for (wrong, right) in wrong.iter().zip(&right) {
            let point = head.inverse().point(right.position);
            let ray = (point - head_from_camera.translation).normalize();
            let moved = head.inverse().point(wrong.position) - point;
            let expected = ray * (d / n.dot(ray));
            let off = (moved - expected).length();
            assert!(off < 1e-10 + 1e-4 * d, "{moved} {expected}: {off}");
            assert!((moved.z.abs() - d).abs() <= 0.05 * d + 1e-10, "{moved}");
        }
    }
}

/// Through a lens that moves the ends of the line by 1.4 rows (p₁r²·b, r = 0.021),
/// 10 µm each on the part, the plane is measured as well as without (1 µm, see tests/points/measure.rs) by a calibration that knows of it, and
/// wrongly by one that does not.
#[test]
fn distortion_is_undone_by_a_calibration_that_knows_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene_with(
        folder.path(),
        &[("column_axis = [1, 0, 0]\n", DISTORTION)],
        "",
    );
    let scene = Scene::load(&path).unwrap();
    let found = points(&scene, None);
    assert!(found.len() > 600, "{}", found.len());
    let worst =
        |points: &[CloudPoint]| points.iter().map(|p| p.deviation.abs()).fold(0.0, f64::max);
    assert!(worst(&found) < 1e-3, "{}", worst(&found));
    let plain = Scene::load(&scene_with(folder.path(), &[], "")).unwrap();
    let ignorant = Simulation::new(&plain).unwrap().calibration;
    let wrong = points(&scene, Some(&ignorant));
    assert!(worst(&wrong) > 5e-3, "{}", worst(&wrong));
}

#[test]
fn mistakes_about_calibrations_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |changes: &[(&str, &str)], more: &str| {
        let error = Scene::load(&scene_with(folder.path(), changes, more))
            .err()
            .unwrap();
        (error.exit_code(), error.to_string())
    };
    let (code, error) = refused(&[], MEASURE);
    assert!(
        code == 65 && error.contains("measure.calibration: found \"c.json\""),
        "{error}"
    );
    let plain = Scene::load(&scene_with(folder.path(), &[], "")).unwrap();
    let truth = Simulation::new(&plain).unwrap().calibration;
    let text = serde_json::to_string_pretty(&truth).unwrap();
    std::fs::write(folder.path().join("c.json"), text).unwrap();
    let (_, error) = refused(&[("[640, 300]", "[640, 200]")], MEASURE);
    assert!(error.contains("a sensor of 640 × 200 pixels"), "{error}");
    std::fs::write(folder.path().join("c.json"), "{}").unwrap();
    let (code, error) = refused(&[], MEASURE);
    assert!(code == 65 && error.contains("c.json:1"), "{error}");
    let folds = DISTORTION.replace("-20", "-2000");
    let (_, error) = refused(&[("column_axis = [1, 0, 0]\n", &folds)], "");
    assert!(
        error.contains(": camera.distortion: found") && error.contains("fold"),
        "{error}"
    );
    let (_, error) = refused(
        &[("column_axis = [1, 0, 0]\n", &folds.replace("k1", "k4"))],
        "",
    );
    assert!(
        error.contains("camera.distortion.k4: found a key that [camera.distortion] does not have"),
        "{error}"
    );
}

/// The whole way, laser line rendered and its peaks found, for a noisy sensor with
/// a distorting lens and speckle-free light: one draw of χ² with 17 degrees of
/// freedom, and the points it measures. The file it writes is the one it found.
#[test]
fn a_rendered_calibration_is_right_within_its_uncertainty() {
    let folder = tempfile::tempdir().unwrap();
    let noisy = (
        "full_well_e = 20000",
        "full_well_e = 20000\nread_noise_e = 12",
    );
    let changes = [("column_axis = [1, 0, 0]\n", DISTORTION), noisy];
    let scene = Scene::load(&scene_with(folder.path(), &changes, "")).unwrap();
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &AtomicBool::new(false),
    };
    let out = folder.path().join("out");
    let summary = calibrate(scene, &out, &control).unwrap();
    assert_eq!(summary.parameters.len(), 17);
    assert!(
        bounds(17.0).contains(&summary.chi_squared),
        "{}",
        summary.chi_squared
    );
    assert!(summary.point_error_um < 4.0 * summary.point_uncertainty_um);
    let bytes = std::fs::read(&summary.calibration).unwrap();
    let read = Calibration::parse(&summary.calibration, &bytes).unwrap();
    let difference = summary.estimates.difference(&read);
    assert!(difference.iter().all(|d| d.abs() < 1e-9), "{difference:?}");
    assert!(out.join("summary.json").exists() && out.join("residuals.svg").exists());
}
