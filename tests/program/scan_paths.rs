//! Scan paths from outside: the same way said in several forms, the rotary scene's
//! number, motion in the exposure, and which files of poses are refused.

use crate::program::{PLANE, assert_error, folder_with, scene};
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::math::{DVec3, Rigid};
use lasertrace::plan::rules::EffectKind;
use lasertrace::run::{Simulation, scene_plan};
use lasertrace::scene::Scene;
use std::fs;
use std::path::Path;

fn load(folder: &Path) -> Scene {
    Scene::load(&folder.join("scene.toml")).unwrap()
}

/// The scene with other lines in place of `[scan]`'s.
fn with_scan(lines: &str) -> String {
    let text = scene(PLANE);
    let (before, _) = text.split_once("[scan]").unwrap();
    format!("{before}[scan]\n{lines}\n")
}

/// A turn about the part's own axis must leave every point where it is on the part:
/// 12 mm from that axis to within 1 µm, in all 36 frames.
#[test]
fn a_turned_part_on_a_rotary_table_is_round() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/rotary/scene.toml");
    let scene = Scene::load(&path).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let mut seen = [0; 36];
    for frame in 0..scene.scan.frames {
        let counts = simulation.image(frame);
        let points = simulation.measure(frame, &counts).1;
        assert_eq!(points.len(), 640, "frame {frame}");
        for point in points {
            let p = point.position;
            let radius = p.x.hypot(p.z);
            assert!((radius - 12.0).abs() < 1e-3, "frame {frame}: {radius}");
            let angle = p.z.atan2(p.x).to_degrees().rem_euclid(360.0);
            seen[(angle / 10.0) as usize % 36] += 1;
        }
    }
    // Frames 10° apart, give or take the 5° of the eccentricity: no third of the
    // turn is left out.
    for third in seen.chunks(12) {
        assert!(third.iter().sum::<i32>() > 10 * 640, "{seen:?}");
    }
}

fn assert_close(a: &Rigid, b: &Rigid, frame: u32) {
    let turned = (a.rotation - b.rotation).to_cols_array();
    assert!(
        turned.iter().all(|x| x.abs() < 1e-12) && a.translation.distance(b.translation) < 1e-12,
        "frame {frame}: {a:?} {b:?}"
    );
}

/// A straight way as such, with the part moving back, and as two lists of poses;
/// a rotary table as such and as a list.
#[test]
fn one_way_in_several_forms_is_one_way() {
    let list = |pose: &dyn Fn(f64) -> String, header: &str| {
        let lines: String = (0..5).map(|k| pose(k as f64) + "\n").collect();
        format!("{header}\n{lines}")
    };
    let euler = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg";
    let quaternion = "x_mm,y_mm,z_mm,qw,qx,qy,qz";
    let straight = list(&|k| format!("0,{},0,0,0,0", 0.5 * k), euler);
    let back = list(&|k| format!("0,{},0,1,0,0,0", -0.5 * k), quaternion);
    let table = list(
        &|k| {
            let half = (10.0 + 4.0 * k).to_radians() / 2.0;
            // Where a turn about x through z = −12 takes the origin.
            let (s, c) = (2.0 * half).sin_cos();
            let (y, z) = (-12.0 * s, 12.0 * c - 12.0);
            format!("0,{y:.15},{z:.15},{},{},0,0", half.cos(), half.sin())
        },
        quaternion,
    );
    let start = "start_mm = [0, -0.5, 0]";
    let forms = [
        vec![
            (format!("frames = 5\nstep_mm = 0.5\ndirection = [0, 1, 0]\n{start}"), ""),
            (format!("frames = 5\nstep_mm = -0.5\ndirection = [0, 1, 0]\nmoving_body = \"part\"\n{start}"), ""),
            (format!("poses = \"path.csv\"\n{start}"), &straight),
            (format!("poses = \"path.csv\"\nmoving_body = \"part\"\n{start}"), &back),
        ],
        vec![
            ("frames = 5\nmoving_body = \"part\"\nrotary = { axis_point_mm = [3, 0, -12], axis_direction = [2, 0, 0], step_deg = 4, start_deg = 10 }".into(), ""),
            ("poses = \"path.csv\"\nmoving_body = \"part\"".into(), &table),
        ],
    ];
    for forms in forms {
        let scenes = forms.iter().map(|(scan, csv)| {
            let folder = folder_with(&with_scan(scan));
            fs::write(folder.path().join("path.csv"), csv).unwrap();
            load(folder.path())
        });
        let scenes: Vec<Scene> = scenes.collect();
        for other in &scenes[1..] {
            assert_eq!(other.scan.frames, 5);
            assert_eq!(other.scan.turns(), scenes[0].scan.turns());
            for frame in 0..5 {
                assert_close(
                    &other.part_from_head(frame),
                    &scenes[0].part_from_head(frame),
                    frame,
                );
            }
        }
    }
}

#[test]
fn speckle_on_a_rotary_table_changes_a_little_from_frame_to_frame() {
    // The demo's kind of sensor over a cylinder: what turns 0.02° shows nearly the
    // same grains, what turns 20° others.
    let part = "cylinder = { radius_mm = 8, length_mm = 20, chordal_deviation_um = 5 }";
    let text = with_scan(
        "frames = 2001\nmoving_body = \"part\"\nrotary = { axis_point_mm = [0, 0, -8], \
         axis_direction = [1, 0, 0], step_deg = 0.01 }",
    )
    .replace(PLANE, part)
    .replace(
        "position_mm = [0, 0, 0]\nrotation_deg = [0, 0, 0]",
        "position_mm = [0, 0, -8]\nrotation_deg = [0, 0, 90]",
    )
    .replace("speckle = false", "speckle = true");
    let folder = folder_with(&text);
    let scene = load(folder.path());
    let simulation = Simulation::new(&scene).unwrap();
    let images: Vec<Vec<f32>> = [0, 1, 1000, 1001, 2000]
        .map(|frame| simulation.irradiance(frame).dense())
        .into();
    let correlation = |a: &[f32], b: &[f32]| {
        let lit: Vec<(f64, f64)> = a
            .iter()
            .zip(b)
            .filter(|(a, b)| **a > 0.0 && **b > 0.0)
            .map(|(&a, &b)| (a as f64, b as f64))
            .collect();
        let n = lit.len() as f64;
        assert!(n > 100.0);
        let mean = lit
            .iter()
            .fold((0.0, 0.0), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
        let sum = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
            lit.iter().map(|p| f(p.0 - mean.0, p.1 - mean.1)).sum()
        };
        sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
    };
    let near = [
        correlation(&images[0], &images[1]),
        correlation(&images[2], &images[3]),
    ];
    let far = correlation(&images[0], &images[4]);
    eprintln!("neighbours {near:?}, 20° apart {far}");
    assert!(near[0] > 0.97 && near[1] > 0.97, "{near:?}");
    assert!(far < near[0] - 0.02, "{far}");
}

/// Variance of the light along each column, mean over the columns, px².
fn line_variance(image: &[f32], columns: usize) -> f64 {
    let mut sum = 0.0;
    let inside = columns / 4..3 * columns / 4;
    for column in inside.clone() {
        let (mut m, mut m1, mut m2) = (0.0, 0.0, 0.0);
        for (row, line) in image.chunks(columns).enumerate() {
            let (e, y) = (line[column] as f64, row as f64 + 0.5);
            (m, m1, m2) = (m + e, m1 + e * y, m2 + e * y * y);
        }
        sum += m2 / m - (m1 / m).powi(2);
    }
    sum / inside.len() as f64
}

/// Over a plane tilted by 30° the head's way y raises the surface by y·tan 30°. n
/// poses evenly spread over a way of s pixels of the image add s²(n² − 1)/(12 n²) to
/// the line's variance.
#[test]
fn motion_in_the_exposure_widens_the_line_as_predicted() {
    let scan = |more: &str| {
        let text = with_scan(&format!(
            "frames = 3\nstep_mm = 4\ndirection = [0, 1, 0]\nstart_mm = [0, -4, 0]\n{more}"
        ));
        let text = text.replace("rotation_deg = [0, 0, 0]", "rotation_deg = [30, 0, 0]");
        folder_with(&text)
    };
    // 0.01 ms at 50 kHz: half of the step of 4 mm.
    let scene_of = |more: &str| load(scan(more).path());
    let (rest, one) = (scene_of(""), scene_of("frame_rate_hz = 50000"));
    let eight = scene_of("frame_rate_hz = 50000\nmotion_samples = 8");
    let image = |scene: &Scene| Simulation::new(scene).unwrap().irradiance(1).dense();
    let still = image(&rest);
    assert!(still == image(&one), "one pose is the frame's own");
    let smeared = image(&eight);
    // The same light, to the rounding of f32 and to where on the pixel it falls.
    let light = |image: &[f32]| image.iter().map(|&e| e as f64).sum::<f64>();
    assert!((light(&smeared) / light(&still) - 1.0).abs() < 0.01);

    let rows = |y: f64| {
        let height = DVec3::Z * y * 30f64.to_radians().tan();
        let camera = rest.head_from_camera.inverse();
        rest.camera.project(camera.point(height)).unwrap().y
    };
    let way = rows(1.0) - rows(-1.0);
    let added = line_variance(&smeared, 64) - line_variance(&still, 64);
    let expected = way * way * (1.0 - 1.0 / 64.0) / 12.0;
    // Perspective bends the way by some 2 % and the line's own width varies as much.
    assert!(
        way.abs() > 3.0 && (added / expected - 1.0).abs() < 0.05,
        "{way}: {added} {expected}"
    );

    let effect = |scene: &Scene| {
        let plan = scene_plan(scene).unwrap();
        let effect = plan
            .effects
            .iter()
            .find(|e| e.effect == EffectKind::ExposureMotion);
        effect.map(|e| (e.modelled, e.why.clone())).unwrap()
    };
    assert!(!effect(&rest).0 && effect(&rest).1.contains("no scan.frame_rate_hz"));
    assert!(
        !effect(&one).0 && effect(&one).1.contains("2000.00 µm"),
        "{:?}",
        effect(&one)
    );
    assert!(effect(&eight).0);
}

const ROTARY: &str =
    "rotary = { axis_point_mm = [0, 0, 0], axis_direction = [1, 0, 0], step_deg = 1 }";

/// The lines of `[scan]`, and what the message then holds.
const MISTAKES: &[(&str, &str)] = &[
    ("", "scan.direction is missing"),
    (
        "frames = 3\ndirection = [0, 1, 0]",
        "scan.step_mm is missing",
    ),
    (
        "step_mm = 1\ndirection = [0, 1, 0]",
        "scan.frames is missing",
    ),
    ("ROTARY", "scan.frames is missing"),
    (
        "frames = 3\nstep_mm = 1\nROTARY",
        ":41: scan.step_mm: found 1, expected no such key with",
    ),
    (
        "frames = 3\ndirection = [1, 0, 0]\nROTARY",
        ":41: scan.direction: found [1, 0, 0]",
    ),
    ("ROTARY\nposes = \"path.csv\"", ":39: scan: found"),
    (
        "poses = \"path.csv\"\nframes = 2",
        ":41: scan.frames: found 2, expected no frames in addition to scan.poses",
    ),
    (
        "poses = \"no.csv\"",
        ":40: scan.poses: found \"no.csv\", expected a CSV file",
    ),
    ("poses = \"/dev/null\"", ":40: scan.poses: found"),
    (
        "poses = \"path.csv\"",
        "path.csv:3: y_mm: found \"two\", expected a number within",
    ),
    (
        "frames = 3\nmoving_body = \"both\"\nROTARY",
        ":41: scan.moving_body: found \"both\", expected",
    ),
    (
        "frames = 3\nrotary = { axis_point_mm = [0, 0, 0], axis_direction = [0, 0, 0], step_deg = 1 }",
        ":41: scan.rotary.axis_direction: found [0, 0, 0]",
    ),
    (
        "frames = 3\nrotary = { axis_point_mm = [0, 0, 0], axis_direction = [0, 0, 1], step_deg = nan }",
        ":41: scan.rotary.step_deg: found nan",
    ),
    (
        "frames = 3\nrotary = { axis_point_mm = [0, 0, inf], axis_direction = [0, 0, 1], step_deg = 1 }",
        ":41: scan.rotary.axis_point_mm: found [0, 0, inf]",
    ),
    (
        "frames = 3\nframe_rate_hz = 100001\nROTARY",
        ":41: scan.frame_rate_hz: found 100001, expected at most one",
    ),
    (
        "frames = 3\nframe_rate_hz = 0\nROTARY",
        ":41: scan.frame_rate_hz: found 0, expected a finite",
    ),
    (
        "frames = 3\nmotion_samples = 2\nROTARY",
        ":41: scan.motion_samples: found 2, expected 1, or scan.frame_rate_hz",
    ),
    (
        "frames = 3\nmotion_samples = 0\nROTARY",
        ":41: scan.motion_samples: found 0, expected from 1",
    ),
];

#[test]
fn a_wrong_path_is_refused_with_file_line_key_found_and_expected() {
    for (scan, message) in MISTAKES {
        let folder = folder_with(&with_scan(&scan.replace("ROTARY", ROTARY)));
        let csv = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n1,2,3,0,0,0\n1,two,3,0,0,0\n";
        fs::write(folder.path().join("path.csv"), csv).unwrap();
        assert_error(
            folder.path(),
            &["check", "scene.toml"],
            65,
            &[message, "expected"],
        );
    }
}

/// Five poses of a robot drawn from a seed: fixed angles (x, y, z, degrees) and positions, mm.
fn robot_poses(seed: u64) -> Vec<([f64; 3], [f64; 3])> {
    let key = RngKey::new(seed, Purpose::SensorNoise);
    let number = |k: u64, i: u64, most: f64| most * (2.0 * key.with(k).uniform(i) - 1.0);
    (0..5)
        .map(|k| {
            let angles = [0, 1, 2].map(|i| number(k, i, 80.0));
            (angles, [3, 4, 5].map(|i| number(k, i, 900.0)))
        })
        .collect()
}

fn rigid((angles, position): ([f64; 3], [f64; 3])) -> Rigid {
    let angles = DVec3::from(angles).map(f64::to_radians);
    Rigid::from_euler_xyz(angles, position.into())
}

/// The unit quaternion x, y, z, w of fixed angles.
fn quaternion(angles: [f64; 3]) -> [f64; 4] {
    let [x, y, z] = angles.map(f64::to_radians);
    let turn = glam::DQuat::from_rotation_z(z)
        * glam::DQuat::from_rotation_y(y)
        * glam::DQuat::from_rotation_x(x);
    turn.to_array()
}

/// Lines of a file: names of columns, then the numbers of each pose.
fn table(
    separator: &str,
    header: &str,
    poses: &[([f64; 3], [f64; 3])],
    numbers: impl Fn(usize, [f64; 3], [f64; 3]) -> Vec<f64>,
) -> String {
    let line = |(k, &(angles, position)): (usize, &([f64; 3], [f64; 3]))| {
        let texts = numbers(k, angles, position)
            .into_iter()
            .map(|x| format!("{x:.15}"));
        texts.collect::<Vec<_>>().join(separator)
    };
    let lines: Vec<String> = poses.iter().enumerate().map(line).collect();
    format!("{header}\n{}\n", lines.join("\n"))
}

/// Poses in the conventions of robots give the same path: units, order of the quaternion, A-B-C angles, times,
/// separators, comments, with a header or with names in the scene. Numbers are written with 15 decimals:
/// rounding of the quaternion turns by 1e-15, and moves nothing.
#[test]
fn the_conventions_of_robots_give_the_same_path() {
    for seed in 1..=3 {
        let poses = robot_poses(seed);
        let quaternions = |k: usize, angles, [x, y, z]: [f64; 3]| {
            let q = quaternion(angles);
            let position = [x / 1e3, y / 1e3, z / 1e3];
            [&[k as f64 * 0.1][..], &position, &q].concat()
        };
        let header = "time_s;x_m;y_m;z_m;qx;qy;qz;qw";
        let metres = table(";", header, &poses, quaternions);
        let names: Vec<String> = header.split(';').map(|name| format!("{name:?}")).collect();
        let columns = format!("poses_columns = [{}]\n", names.join(", "));
        let numbers = metres.split_once('\n').unwrap().1;
        let abc = table(
            "\t",
            "x_mm\ty_mm\tz_mm\ta_deg\tb_deg\tc_deg",
            &poses,
            |_, angles, [x, y, z]| {
                let [about_x, about_y, about_z] = angles;
                vec![x, y, z, about_z, about_y, about_x]
            },
        );
        let files = [
            ("semicolons", String::new(), metres.clone()),
            ("decimal commas", String::new(), metres.replace('.', ",")),
            (
                "comments",
                String::new(),
                format!(
                    "# robot 7\n\n# base\n{}",
                    metres.replace("\n-", "\n# here\n-")
                ),
            ),
            ("no header", columns.clone(), numbers.to_owned()),
            (
                "spaces",
                columns.clone(),
                format!("# timestamp tx ty tz\n{}", numbers.replace(';', "  ")),
            ),
            (
                "another header",
                columns.clone(),
                format!("t;X;Y;Z;i;j;k;w\n{numbers}"),
            ),
            ("A-B-C", String::new(), abc),
        ];
        for (kind, keys, text) in files {
            let folder = folder_with(&with_scan(&format!("poses = \"path.csv\"\n{keys}")));
            fs::write(folder.path().join("path.csv"), text).unwrap();
            let scene = load(folder.path());
            assert_eq!(scene.scan.frames, 5, "{kind}");
            for (frame, &pose) in (0..).zip(&poses) {
                let found = scene.scan.world_from_head(f64::from(frame));
                let expected = rigid(pose);
                let turned = (found.rotation - expected.rotation).to_cols_array();
                let turned = turned.iter().all(|x| x.abs() < 1e-13);
                let moved = found.translation.distance(expected.translation);
                assert!(
                    turned && moved < 1e-11,
                    "{kind}, seed {seed}, frame {frame}: {moved}"
                );
            }
        }
    }
}

/// Poses of the flange, each followed by the head's pose on it; and frames at times between those of poses.
#[test]
fn a_head_on_a_flange_and_frames_between_poses_are_where_they_belong() {
    for seed in 1..=3 {
        let poses = robot_poses(seed);
        let header = "time_ms,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg";
        let text = table(",", header, &poses, |k, a, p| {
            [&[k as f64 * 40.0][..], &p, &a].concat()
        });
        let scan = "poses = \"path.csv\"\nframe_times = \"times.txt\"\n\
                    hand_eye = { position_mm = [10, -20, 120], rotation_deg = [5, 0, -90] }";
        let folder = folder_with(&with_scan(scan));
        fs::write(folder.path().join("path.csv"), text).unwrap();
        let times = "# trigger\ntime_s\n0\n0.01\n0.04\n0.16\n";
        fs::write(folder.path().join("times.txt"), times).unwrap();
        let scene = load(folder.path());
        assert_eq!(scene.scan.frames, 4);
        let on_flange = rigid(([5.0, 0.0, -90.0], [10.0, -20.0, 120.0]));
        for (frame, pose) in [(0, poses[0]), (2, poses[1]), (3, poses[4])] {
            let expected = rigid(pose) * on_flange;
            assert_close(
                &scene.scan.world_from_head(f64::from(frame)),
                &expected,
                frame,
            );
        }
        // A quarter of the way, and of the turn, from the first flange to the second.
        let (a, b) = (rigid(poses[0]), rigid(poses[1]));
        let flange = scene.scan.world_from_head(1.0) * on_flange.inverse();
        assert!(
            flange
                .translation
                .distance(a.translation.lerp(b.translation, 0.25))
                < 1e-9
        );
        let angle = |from: &Rigid, to: &Rigid| {
            let turn = glam::DQuat::from_mat3(&(from.rotation.transpose() * to.rotation));
            2.0 * turn.w.abs().min(1.0).acos()
        };
        assert!((angle(&a, &flange) - 0.25 * angle(&a, &b)).abs() < 1e-7);
    }
}

/// Keys of `[scan]`, the file of poses, that of times, and what the message then holds.
const CONVENTIONS: &[(&str, &str, &str, &str)] = &[
    (
        "",
        "x_m,y_mm,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "",
        "path.csv:1: found \"x_m,y_mm,z_m,qx,qy,qz,qw\" (x_m and y_mm, of two units), expected the header",
    ),
    (
        "",
        "x_m,y_m,z_m,rx_deg,ry_deg,qw\n0,0,0,0,0,1\n",
        "",
        "(two kinds of rotation)",
    ),
    (
        "",
        "x_m,y_m,z_m,qx,qy,qz\n0,0,0,0,0,1\n",
        "",
        "(3 of 4 parts of a quaternion)",
    ),
    (
        "",
        "x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "",
        "(the unknown column \"x\")",
    ),
    (
        "",
        "0;0;0;0;0;0;1\n",
        "",
        "path.csv:1: found \"0,0,0,0,0,0,1\", expected the header",
    ),
    (
        "poses_columns = [\"x_m\", \"y_m\", \"z_m\", \"qx\", \"qy\", \"qz\", \"qw\"]",
        "x_mm,y_mm,z_mm,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "",
        "path.csv:1: found the header \"x_mm,y_mm,z_mm,qx,qy,qz,qw\", expected x_m,y_m,z_m,qx,qy,qz,qw, as \
         scan.poses_columns states",
    ),
    (
        "poses_columns = [\"x_m\", \"y_m\"]",
        "0,0\n",
        "",
        "scan.poses_columns: found [\"x_m\", \"y_m\"], expected x_mm,y_mm,z_mm or x_m,y_m,z_m;",
    ),
    (
        "poses_columns = [\"x_m\", \"y_m\", \"z_m\", \"a_deg\", \"b_deg\", \"c_deg\"]",
        "# no header\n0 0 1 0 361 0\n",
        "",
        "path.csv:2: b_deg: found \"361\", expected an angle",
    ),
    (
        "",
        "time_s,x_m,y_m,z_m,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n# late\n1,0,0,0,0,0,0,1\n",
        "",
        "path.csv:4: time: found 1 s, expected a time after 1 s",
    ),
    (
        "frame_times = \"times.txt\"",
        "x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "time_s\n0\n",
        "scan.frame_times: found \"times.txt\", expected a file of poses with a column time_s or time_ms",
    ),
    (
        "frame_times = \"times.txt\"",
        "time_s,x_m,y_m,z_m,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,1\n",
        "time_ms\n1500\n2500\n",
        "times.txt: found 2.5 s, expected times from 1 s to 2 s, as in",
    ),
    (
        "frame_times = \"times.txt\"",
        "time_s,x_m,y_m,z_m,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,1\n",
        "1.5\n",
        "times.txt:1: found \"1.5\", expected the header time_s or time_ms",
    ),
    (
        "moving_body = \"part\"\nhand_eye = { position_mm = [0, 0, 1] }",
        "x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "",
        "scan.hand_eye: found",
    ),
    (
        "start_mm = [0, 0, 1]\nhand_eye = { position_mm = [0, 0, 1] }",
        "x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,1\n",
        "",
        "expected no hand-eye transform with scan.start_mm",
    ),
];

#[test]
fn a_wrong_convention_of_poses_is_reported() {
    for (keys, poses, times, message) in CONVENTIONS {
        let folder = folder_with(&with_scan(&format!("poses = \"path.csv\"\n{keys}")));
        fs::write(folder.path().join("path.csv"), poses).unwrap();
        fs::write(folder.path().join("times.txt"), times).unwrap();
        assert_error(folder.path(), &["check", "scene.toml"], 65, &[message]);
    }
    let keys =
        "frames = 3\nhand_eye = { position_mm = [0, 0, 1] }\nROTARY".replace("ROTARY", ROTARY);
    let folder = folder_with(&with_scan(&keys));
    let message =
        "scan.hand_eye: found { position_mm = [0, 0, 1] }, expected none without scan.poses";
    assert_error(folder.path(), &["check", "scene.toml"], 65, &[message]);
}
