//! Each warning on sensors and parts of random sizes: it is given where it is true, with
//! the right number, and such a scan does measure nothing worth having; sensors that see
//! their part give none.

use crate::generated::{FOCAL_MM, SEEDS, Sensor};
use crate::mistakes;
use crate::program;
use crate::program::{folder_with, run};
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::run::{CheckReport, RunControl, Simulation, WarningKind};
use lasertrace::scene::{Scene, Unit};
use std::fs;
use std::path::Path;
use std::sync::atomic::AtomicBool;

fn checked(folder: &Path) -> (Scene, CheckReport) {
    let scene = Scene::load(&folder.join("scene.toml")).unwrap_or_else(|e| panic!("{e}"));
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &AtomicBool::new(false),
    };
    let checked = lasertrace::run::check(&scene, &control).unwrap();
    (scene, checked)
}

fn points(scene: &Scene) -> Vec<CloudPoint> {
    let simulation = Simulation::new(scene).unwrap();
    let frame = |frame| {
        let counts = simulation.image(frame);
        simulation.measure(frame, &counts).1
    };
    (0..scene.scan.frames).flat_map(frame).collect()
}

/// The reasons of a scene in which no point is valid.
#[track_caller]
fn reasons_in(folder: &Path) -> Vec<WarningKind> {
    let (scene, checked) = checked(folder);
    let valid = points(&scene).iter().filter(|p| p.is_valid()).count();
    assert_eq!(valid, 0, "{:?}", checked.warnings);
    checked.warnings.into_iter().map(|w| w.reason).collect()
}

#[track_caller]
fn reasons(text: &str) -> Vec<WarningKind> {
    reasons_in(folder_with(text).path())
}

/// `text` with one change, which must be one.
#[track_caller]
fn changed(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "{from}");
    text.replacen(from, to, 1)
}

/// Millimetres that differ by what 40 halvings and f64 leave.
#[track_caller]
fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-6, "{found} {expected}");
}

#[test]
fn a_sensor_that_sees_its_part_gives_no_warning() {
    for seed in 100..124 {
        let sensor = Sensor::new(seed);
        let folder = folder_with(&sensor.scene(&sensor.part()));
        let (scene, checked) = checked(folder.path());
        assert_eq!(checked.warnings, [], "{seed}");
        let points = points(&scene);
        let valid = points.iter().filter(|p| p.is_valid()).count();
        assert!(
            2 * valid > points.len() && valid > 30,
            "{seed}: {valid} of {}",
            points.len()
        );
        let [near, far] = checked.sensor.unwrap().ends();
        let [top, bottom] = sensor.range();
        assert_near(near, sensor.distance - top);
        assert_near(far, sensor.distance - bottom);
    }
}

#[test]
fn a_part_above_or_below_the_range_is_said_to_be_by_how_much() {
    for sensor in SEEDS.map(Sensor::new) {
        let [top, bottom] = sensor.range();
        let off = 0.1 * sensor.distance;
        match reasons(&sensor.scene(&sensor.plane(0.0, top + off)))[..] {
            [
                WarningKind::AboveRange {
                    share,
                    by_mm,
                    range_mm,
                },
            ] => {
                assert_eq!(share, 1.0);
                assert_near(by_mm, off);
                assert_near(range_mm[0], sensor.distance - top);
            }
            ref other => panic!("{other:?}"),
        }
        match reasons(&sensor.scene(&sensor.plane(0.0, bottom - off)))[..] {
            [
                WarningKind::BelowRange {
                    share,
                    by_mm,
                    range_mm,
                },
            ] => {
                assert_eq!(share, 1.0);
                assert_near(by_mm, off);
                assert_near(range_mm[1], sensor.distance - bottom);
            }
            ref other => panic!("{other:?}"),
        }
    }
}

#[test]
fn laser_and_camera_that_look_away_are_named() {
    for sensor in SEEDS.map(Sensor::new) {
        let good = sensor.scene(&sensor.part());
        let up = changed(&good, "direction = [0, 0, -1]", "direction = [0, 0, 1]");
        assert_eq!(reasons(&up), [WarningKind::LaserLooksAway]);
        let away = changed(
            &good,
            "look_at_mm = [0, 0, 0]",
            "look_at_mm = [0, -900, 900]",
        );
        assert_eq!(reasons(&away), [WarningKind::CameraLooksAway]);
    }
}

#[test]
fn light_that_misses_the_part_is_said_to_and_by_how_much() {
    for sensor in SEEDS.map(Sensor::new) {
        let d = sensor.distance;
        let plane = sensor.plane(0.0, 0.0);
        let beside = format!("start_mm = [0, {}, 0]", -0.5 * d);
        let beside = changed(&sensor.scene(&plane), "start_mm = [0, -0.5, 0]", &beside);
        match reasons(&beside)[..] {
            // Two steps of 0.5 mm towards the plane's edge.
            [WarningKind::LightMissesPart { frame: 2, by_mm }] => assert_near(by_mm, 0.4 * d - 1.0),
            ref other => panic!("{other:?}"),
        }
        // The fan's light ends at tan 6° of the distance.
        let aside = sensor.scene(&sensor.plane(0.5 * d, 0.0));
        assert_eq!(reasons(&aside), [WarningKind::LightBesidePart]);
    }
}

#[test]
fn light_beside_the_view_and_behind_the_part_is_told_apart() {
    for sensor in SEEDS.map(Sensor::new) {
        let d = sensor.distance;
        let wide = changed(
            &sensor.scene(&sensor.plane(0.0, 0.0)),
            "fan_deg = 12",
            "fan_deg = 60",
        );
        let look = format!("look_at_mm = [{}, 0, 0]", 0.4 * d);
        let aside = changed(&wide, "look_at_mm = [0, 0, 0]", &look);
        assert_eq!(reasons(&aside), [WarningKind::OutOfView]);
        // A plate, and between it and the camera a wall.
        let text = sensor.scene("mesh = { file = \"part.obj\", unit = \"mm\" }");
        let folder = folder_with(&text);
        let (far, wall, high) = (0.1 * d, -0.05 * d, 0.3 * d);
        let obj = format!(
            "v {n} {wall} 0\nv {far} {wall} 0\nv {far} {far} 0\nv {n} {far} 0\n\
             v {n} {wall} {high}\nv {far} {wall} {high}\nf 1 2 3 4\nf 2 1 5 6\n",
            n = -far
        );
        fs::write(folder.path().join("part.obj"), obj).unwrap();
        let hidden = [WarningKind::HiddenFromCamera { share: 1.0 }];
        assert_eq!(reasons_in(folder.path()), hidden);
    }
}

#[test]
fn too_little_and_too_much_light_is_foreseen() {
    for sensor in SEEDS.map(Sensor::new) {
        let good = sensor.scene(&sensor.plane(0.0, 0.0));
        let dark = changed(&good, "power_mw = 10", "power_mw = 0.0005");
        match reasons(&dark)[..] {
            [
                WarningKind::TooDark {
                    share,
                    counts,
                    least_counts,
                },
            ] => {
                assert_eq!(share, 1.0);
                // The brightest pixel without noise and of a sharp line: the forecast omits diffraction.
                let silent = changed(&good, "read_noise_e = 10", "");
                let silent = silent + "\n[model]\ndefocus_model = \"none\"\n";
                let (scene, _) = checked(folder_with(&silent).path());
                let simulation = Simulation::new(&scene).unwrap();
                let image = simulation.counts(1, &simulation.irradiance(1)).to_rows();
                let brightest = f64::from(*image.iter().max().unwrap()) - 8.0;
                let expected = brightest * 0.0005 / 10.0;
                // The line may lie half a pixel off its middle, where a Gaussian of σ px
                // has exp(-1/8σ²) of its height; 1 % for rounding and quadrature.
                let d = sensor.distance;
                let sigma = 1.5 * d / sensor.pitch_um * FOCAL_MM / (d - FOCAL_MM);
                let least = counts * (-0.125 / (sigma * sigma)).exp();
                let bounds = 0.99 * least..1.01 * counts;
                assert!(bounds.contains(&expected), "{bounds:?} {expected}");
                // Ten times the noise of 10 electrons and of rounding, 0.35 counts.
                assert!(counts < least_counts && least_counts < 4.0);
            }
            ref other => panic!("{other:?}"),
        }
        let bright = changed(&good, "power_mw = 10", "power_mw = 100000");
        match reasons(&bright)[..] {
            [WarningKind::Saturated { share, times }] => {
                assert_eq!(share, 1.0);
                // Dimmed as the message asks, the scan gives no warning.
                let power = format!("power_mw = {}", 1e5 / times);
                let dimmed = changed(&good, "power_mw = 10", &power);
                assert_eq!(checked(folder_with(&dimmed).path()).1.warnings, []);
                assert!(times > 100.0, "{times}");
            }
            ref other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_part_in_another_unit_is_suspected_and_the_unit_named() {
    for sensor in SEEDS.map(Sensor::new) {
        let size = 0.1 * sensor.distance;
        for (scale, unit, likely) in [
            (1.0, Unit::Metre, Unit::Millimetre),
            (1e-3, Unit::Millimetre, Unit::Metre),
        ] {
            let mesh = format!("mesh = {{ file = \"part.obj\", unit = \"{unit}\" }}");
            let folder = folder_with(&sensor.scene(&mesh));
            let [low, high] = [-0.5 * size * scale, 0.5 * size * scale];
            let obj = format!(
                "v {low} {low} 0\nv {high} {low} 0\nv {high} {high} 0\nv {low} {high} 0\n\
                 f 1 2 3 4\n"
            );
            fs::write(folder.path().join("part.obj"), obj).unwrap();
            let (_, checked) = checked(folder.path());
            let suspected = checked.warnings.iter().any(|warning| {
                let part_mm = size * scale * unit.mm();
                matches!(warning.reason, WarningKind::UnitDoubtful { part_mm: p, unit: u, likely: l, .. }
                    if (p - part_mm).abs() < 1e-6 * p && u == unit && l == Some(likely))
            });
            assert!(suspected, "{:?}", checked.warnings);
        }
    }
}

#[test]
fn a_sensor_in_the_part_or_on_its_way_through_is_named() {
    for sensor in SEEDS.map(Sensor::new) {
        let d = sensor.distance;
        let block = |y: f64| {
            let size = 0.2 * d;
            format!(
                "step_block = {{ size_mm = [{size}, {size}, {size}], step_mm = 1 }}\n\
                 position_mm = [0, {y}, {}]",
                0.9 * d
            )
        };
        let inside = WarningKind::SensorInsidePart {
            body: "laser",
            frame: 0,
        };
        let (_, found) = checked(folder_with(&sensor.scene(&block(0.0))).path());
        assert_eq!(found.warnings[0].reason, inside);
        // Ahead of the laser, from 0.4 d on; steps of 0.15 d.
        let through = changed(
            &sensor.scene(&block(0.5 * d)),
            "frames = 3\nstep_mm = 0.5",
            &format!("frames = 9\nstep_mm = {}", 0.15 * d),
        );
        let (_, found) = checked(folder_with(&through).path());
        let frame = ((0.4 * d + 0.5) / (0.15 * d)).floor() as u32;
        let laser = WarningKind::SensorThroughPart {
            body: "laser",
            frame,
        };
        assert!(
            found.warnings.iter().any(|w| w.reason == laser),
            "{:?}",
            found.warnings
        );
    }
}

#[test]
fn a_path_without_motion_is_named_and_a_single_frame_is_none() {
    for sensor in SEEDS.map(Sensor::new) {
        let still = changed(
            &sensor.scene(&sensor.part()),
            "step_mm = 0.5",
            "step_mm = 0",
        );
        let (_, found) = checked(folder_with(&still).path());
        let reasons: Vec<&WarningKind> = found.warnings.iter().map(|w| &w.reason).collect();
        assert_eq!(reasons, [&WarningKind::NoMotion { frames: 3 }]);
        let one = changed(&still, "frames = 3", "frames = 1");
        assert_eq!(checked(folder_with(&one).path()).1.warnings, []);
    }
}

/// What is said before is said after: by the program, in summary and report.
#[test]
fn check_scan_report_and_summary_say_the_same() {
    let sensor = Sensor::new(SEEDS[0]);
    let above = sensor.plane(0.0, sensor.range()[0] + 12.0);
    let folder = folder_with(&sensor.scene(&above));
    let (_, checked) = checked(folder.path());
    let message = checked.warnings[0].message.as_str();
    assert!(
        message.contains("the part's top is 12.0 mm above the near end"),
        "{message}"
    );
    let path = folder.path();
    let (code, page, _) = run(path, &["check", "scene.toml"]);
    assert_eq!(code, 0);
    assert!(page.contains(&format!("warning: {message}")), "{page}");
    let (code, text, _) = run(path, &["scan", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0);
    let nothing = "Nothing was measured: no laser line was found in any of 3 frames.";
    assert!(
        text.starts_with(&format!("warning: {nothing}\nwarning: {message}\n")),
        "{text}"
    );
    let summary = fs::read_to_string(path.join("out/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["warnings"][0]["reason"], "nothing-measured");
    assert_eq!(summary["warnings"][1]["reason"], "above-range");
    assert_eq!(summary["warnings"][1]["message"], message);
    let report = fs::read_to_string(path.join("out/report.html")).unwrap();
    let escaped = format!("{nothing} {message}").replace('\'', "&#39;");
    assert!(report.contains(&format!("<p class=\"lead\">{escaped}</p>")));
    for legend in [
        "Deviation from the CAD surface",
        "Standard uncertainty of the deviation",
        "greatest spread of depth",
        "most flags",
    ] {
        assert!(!report.contains(legend), "{legend}");
    }
    // Made an error, before anything is written and after.
    for arguments in [
        &["check", "scene.toml", "--strict"][..],
        &["scan", "scene.toml", "--strict", "-o", "strict"],
    ] {
        let (code, stdout, stderr) = run(path, arguments);
        assert_eq!((code, stdout.as_str()), (65, ""), "{stderr}");
        assert!(stderr.contains(message), "{stderr}");
    }
    assert!(!path.join("strict").exists());
}

/// Reasons and messages of the warnings of a scene in a folder.
fn warned(folder: &Path) -> Vec<(String, String)> {
    let (_, checked) = checked(folder);
    let warnings = checked.warnings.into_iter();
    let named = warnings.map(|warning| {
        let reason = serde_json::to_value(&warning.reason).unwrap();
        (
            reason["reason"].as_str().unwrap().to_owned(),
            warning.message,
        )
    });
    named.collect()
}

/// More than twenty mistakes that users make, three variants of each: `check` names each of them. Prints a table of
/// the mistakes with its output (`--nocapture`).
#[track_caller]
fn each_mistake_is_named(seed: u64) {
    let mistakes = mistakes::mistakes(seed);
    assert!(mistakes.len() > 20);
    let mut table = format!("\n| mistake (seed {seed}) | output of check |\n|---|---|\n");
    let mut silent = Vec::new();
    for mistake in mistakes {
        let folder = folder_with(&mistake.scene);
        for (name, text) in &mistake.files {
            fs::write(folder.path().join(name), text).unwrap();
        }
        let found = warned(folder.path());
        if !found
            .iter()
            .any(|(reason, _)| mistake.expected.contains(&&**reason))
        {
            silent.push((mistake.name, mistake.expected, found.clone()));
        }
        let messages: Vec<String> = found.into_iter().map(|(_, message)| message).collect();
        table += &format!("| {} | {} |\n", mistake.name, messages.join("<br>"));
    }
    println!("{table}");
    assert!(silent.is_empty(), "{silent:#?}");
}

#[test]
fn mistakes_of_users_are_named_1() {
    each_mistake_is_named(1);
}

#[test]
fn mistakes_of_users_are_named_2() {
    each_mistake_is_named(2);
}

#[test]
fn mistakes_of_users_are_named_3() {
    each_mistake_is_named(3);
}

#[track_caller]
fn assert_sound(name: &str, scene: &Scene) {
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &AtomicBool::new(false),
    };
    let checked = lasertrace::run::check(scene, &control).unwrap();
    assert_eq!(checked.warnings, [], "{name}: {:?}", checked.assessment);
    let measured = checked.assessment.surface.map_or(0.0, |s| s.measured);
    let valid = checked.assessment.light.map_or(0.0, |light| light.valid);
    println!("| {name} | no warning | {measured:.3} | {valid:.3} |");
}

const SOUND: &str = "\n| sound scene | output of check | fraction of the measurable surface | fraction of the light |\n|---|---|---|---|";

/// Scenes of the repository. The tolerance of the accuracy scene selects methods, which takes minutes, and has no part
/// in the warnings.
#[test]
fn sound_scenes_of_the_repository_give_no_warning() {
    println!("{SOUND}");
    for name in ["accuracy", "balls", "bracket", "plane", "rotary", "step"] {
        let file = format!("{}/scenes/{name}/scene.toml", env!("CARGO_MANIFEST_DIR"));
        let mut scene = Scene::load(Path::new(&file)).unwrap();
        scene.tolerance_um = None;
        assert_sound(name, &scene);
    }
}

/// Four more: passes that overlap by a tenth, forth and back, over a plate wider than the field; two layers of a
/// stepped part higher than the range; a path that begins and ends outside the part and is narrower than the part;
/// and the tilted sensor of a data sheet over a ball.
#[test]
fn sound_scenes_of_other_kinds_give_no_warning() {
    println!("{SOUND}");
    let base = mistakes::bracket();
    let (before, after) = base.split_once("mesh = {").unwrap();
    let (_, after) = after.split_once('}').unwrap();
    let part = |part: &str| format!("{before}{part}{after}");
    let load = |text: &str, path: Option<String>| {
        let folder = folder_with(text);
        if let Some(path) = path {
            fs::write(folder.path().join("path.csv"), path).unwrap();
        }
        Scene::load(&folder.path().join("scene.toml")).unwrap()
    };
    let plate = part("plane = { size_mm = [200, 40] }\nposition_mm = [0, 0, 15]");
    let mut rows = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n".to_owned();
    for (i, x) in [-72.0, -24.0, 24.0, 72.0].into_iter().enumerate() {
        for j in -21..=21 {
            let y = if i.is_multiple_of(2) { j } else { -j };
            rows += &format!("{x},{y},0,0,0,0\n");
        }
    }
    assert_sound(
        "overlapping passes",
        &load(&mistakes::with_poses(&plate), Some(rows)),
    );

    let block = "step_block = { size_mm = [40, 30, 40], step_mm = 40 }"
        .replace("step_mm = 40", "step_mm = 38");
    let stepped = part(&format!("{block}\nposition_mm = [0, 0, -5]"));
    let mut rows = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n".to_owned();
    for z in [18.0, -20.0] {
        for j in -16..=16 {
            rows += &format!("0,{j},{z},0,0,0\n");
        }
    }
    assert_sound("layers", &load(&mistakes::with_poses(&stepped), Some(rows)));

    let strip = part("plane = { size_mm = [150, 30] }\nposition_mm = [0, 0, 15]");
    assert_sound("strip", &load(&strip, None));

    let sensor = format!(
        "{}/sensors/generic-50mm-405nm.toml",
        env!("CARGO_MANIFEST_DIR")
    );
    let ball = format!(
        "seed = 1\nspeckle = true\nsensor = \"{sensor}\"\n[part]\nsphere = {{ radius_mm = 12, chordal_deviation_um = 20 }}\n\
         reflectance = 0.5\n[scan]\nframes = 101\nstep_mm = 0.25\ndirection = [0, 1, 0]\nstart_mm = [0, -12.5, 0]\n"
    );
    assert_sound("ball", &load(&ball, None));
}

/// What a mesh's file has and its reader leaves out: a line of the part for each in `check`, a list in `--json` and
/// in `summary.json`, and a warning for what may change the shape.
#[test]
fn content_of_the_mesh_file_that_is_not_read_is_listed() {
    let square = "v -8 -8 0\nv 8 -8 0\nv 8 8 0\nv -8 8 0\nf 1 2 3 4\n";
    for (more, shapes, others) in [
        ("", &[][..], &[][..]),
        ("l 1 2\n", &[], &["lines: \"l\", first on line 6"]),
        (
            "surf 0 1 0 1 1 2 3 4\nbent 3\nbent 4\nl 1 2\n",
            &[
                "free-form surfaces: \"surf\", first on line 6",
                "an unknown statement: \"bent\", first on line 7 (2 times)",
            ],
            &["lines: \"l\", first on line 9"],
        ),
    ] {
        let text = program::scene("mesh = { file = \"part.obj\", unit = \"mm\" }");
        let folder = folder_with(&text);
        fs::write(folder.path().join("part.obj"), format!("{square}{more}")).unwrap();
        let (_, page, _) = run(folder.path(), &["check", "scene.toml"]);
        let warning = "warning: The part may have another shape";
        assert_eq!(page.contains(warning), !shapes.is_empty(), "{page}");
        for name in shapes.iter().chain(others) {
            assert!(
                page.contains(&format!("not read          {name}")),
                "{page}"
            );
        }
        let (_, json, _) = run(folder.path(), &["check", "scene.toml", "--json"]);
        let json: serde_json::Value = serde_json::from_str(&json).unwrap();
        let (code, _, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "out"]);
        assert_eq!(code, 0, "{stderr}");
        let summary = fs::read(folder.path().join("out/summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
        for list in [&json["scene"]["mesh_ignored"], &summary["mesh_ignored"]] {
            let list = list.as_array().unwrap();
            assert_eq!(list.len(), shapes.len() + others.len(), "{list:?}");
            for (ignored, name) in list.iter().zip(shapes.iter().chain(others)) {
                assert!(
                    name.starts_with(ignored["name"].as_str().unwrap()),
                    "{name}"
                );
                assert_eq!(ignored["changes_shape"], shapes.contains(name));
            }
        }
        for warnings in [&json["warnings"], &summary["warnings"]] {
            let reasons = warnings.as_array().unwrap().iter().map(|w| &w["reason"]);
            let incomplete = reasons
                .filter(|reason| *reason == "mesh-incomplete")
                .count();
            assert_eq!(incomplete, usize::from(!shapes.is_empty()));
        }
    }
}
