//! Tolerances and methods that a scene names, from outside; and the chart.

use crate::program::{PLANE, folder_with, run, scene};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// What a run prints with --json.
fn json(folder: &Path, arguments: &[&str]) -> Value {
    let (code, stdout, stderr) = run(folder, arguments);
    assert_eq!(code, 0, "{stderr}");
    serde_json::from_str(&stdout).unwrap()
}

/// The scene of `program` without files of frames and with these tables.
fn with(tables: &str) -> String {
    let text = scene(PLANE).replace("save_images = true\n", "");
    text + tables
}

fn plan(tables: &str) -> Value {
    let folder = folder_with(&with(tables));
    json(folder.path(), &["check", "scene.toml", "--json"])["plan"].take()
}

#[test]
fn methods_named_in_the_scene_are_used() {
    let plain = plan("");
    assert!(plain["samples_per_side"] == 1 && plain["noise"] == true);
    assert!(plain["accuracy"].is_null() && plain["geometry_only"] == false);
    let named = plan(
        "[model]\nsamples_per_side = 5\npixel_sampling = \"per-sample\"\nnoise = false\nbeam_cutoff_radii = 1.75\n",
    );
    assert_eq!(named["samples_per_side"], 5);
    assert_eq!(named["sampling"], "per-sample");
    assert_eq!(named["noise"], false);
    assert_eq!(named["beam_cutoff_radii"], 1.75);
    let told = |effect: &str| {
        let effects = named["effects"].as_array().unwrap();
        let found = effects.iter().find(|e| e["effect"] == effect).unwrap();
        assert_eq!(found["why"], "named in [model]");
        found["method"].as_str().unwrap().to_owned()
    };
    assert!(told("pixel integration").contains("5 × 5 rays a pixel"));
    assert!(told("sensor noise").contains("rounded"));
    let speckled = |tables: &str| {
        let text = with(tables).replace("speckle = false", "speckle = true");
        let folder = folder_with(&text);
        json(folder.path(), &["check", "scene.toml", "--json"])["plan"].take()
    };
    let before = speckled("")["local_speckle_motion"].as_bool().unwrap();
    let otherwise = speckled(&format!("[model]\nlocal_speckle_motion = {}\n", !before));
    assert_eq!(otherwise["local_speckle_motion"], !before);
    // They hold beside a tolerance too, that alone would do with less.
    let both = plan(
        "[accuracy]\nmax_height_error_um = 1000\n[model]\nsamples_per_side = 5\nnoise = true\ngeometry_only = false\n",
    );
    assert_eq!(both["samples_per_side"], 5);
    assert!(both["noise"] == true && both["geometry_only"] == false);
    assert_eq!(both["accuracy"]["tolerance_um"], 1000.0);
}

/// A millimetre's tolerance needs no image of a plane: a run without speckle and noise
/// finds its points on it. Where speckle leaves no point that sure, the plan says so with
/// the number, models it, and so do summary and manifest.
#[test]
fn a_tolerance_decides_what_is_modelled() {
    let folder = folder_with(&with("[accuracy]\nmax_height_error_um = 1000\n"));
    let summary = json(
        folder.path(),
        &["scan", "scene.toml", "-o", "out", "--json"],
    );
    assert_eq!(summary["accuracy"]["sufficient"], true);
    let manifest = fs::read(folder.path().join("out/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["plan"]["geometry_only"], true);
    assert_eq!(manifest["plan"]["accuracy"]["rung"], "geometry");
    assert_eq!(manifest["rung"], "geometry");
    assert!(summary["deviation"]["std_um"].as_f64().unwrap() < 1e-3);
    let report = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(report.contains("within") && report.contains("moves height by"));

    let speckled = with("[accuracy]\nmax_height_error_um = 0.01\n")
        .replace("speckle = false", "speckle = true");
    let folder = folder_with(&speckled);
    let plan = json(folder.path(), &["check", "scene.toml", "--json"])["plan"].take();
    let limit = plan["accuracy"]["speckle_limited_error_um"]
        .as_f64()
        .unwrap();
    assert!(limit > 1.0 && plan["speckle"] == "field", "{plan}");
    let (_, text, _) = run(folder.path(), &["check", "scene.toml"]);
    assert!(
        text.contains(&format!("moves 1 of 100 by more than {limit:.2} µm")),
        "{text}"
    );
}

/// Beside the part nothing says what may be left out.
#[test]
fn a_plan_that_sees_no_line_leaves_nothing_out() {
    let away =
        with("[accuracy]\nmax_height_error_um = 1000\n").replace("[0, -0.5, 0]", "[0, 50, 0]");
    let folder = folder_with(&away);
    let plan = json(folder.path(), &["check", "scene.toml", "--json"])["plan"].take();
    assert!(
        plan["geometry_only"] == false && plan["noise"] == true,
        "{plan}"
    );
    assert_eq!(plan["accuracy"]["sufficient"], false);
}

/// This program's own image, as if another had rendered it, errs as the chosen plan that made it does; and what
/// does not fit the scene is refused by its name.
#[test]
fn a_chart_takes_images_of_another_program() {
    let folder = folder_with(&with(""));
    let chart = |frames: &str| {
        let text = format!("{{\"name\": \"other\", \"frames\": {frames}}}");
        fs::write(folder.path().join("beside.json"), text).unwrap();
        let command = "chart scene.toml -o out --rounds 1 --json --beside beside.json";
        run(folder.path(), &command.split(' ').collect::<Vec<_>>())
    };
    let rendered = run(
        folder.path(),
        &["render", "scene.toml", "--frame", "1", "-o", "images"],
    );
    assert_eq!(rendered.0, 0, "{}", rendered.2);
    let image = "images/frame-000001.png";
    let whole = chart(&format!(
        "[{{\"frame\": 1, \"ms\": [3.0, 5.0, 4.0], \"image\": {image:?}}}]"
    ));
    let chart_of: Value = serde_json::from_str(&whole.1).unwrap();
    let rows = chart_of["rows"].as_array().unwrap();
    let chosen = rows.iter().find(|row| row["chosen"] == true).unwrap();
    let beside = &chart_of["beside"];
    assert_eq!(chart_of["frames"], serde_json::json!([1]));
    assert_eq!(beside["ms"][1], 4.0);
    assert!(chosen["error"]["points"].as_u64().unwrap() > 10);
    for key in ["error", "scatter", "line_sigma_px", "contrast"] {
        assert_eq!(beside[key], chosen[key], "{key}");
    }
    let svg = fs::read_to_string(folder.path().join("out/chart.svg")).unwrap();
    assert!(svg.contains(">other<"));
    for (frames, said) in [
        ("[]", "frames []"),
        (
            r#"[{"frame": 1, "ms": [], "image": "images/frame-000001.png"}]"#,
            "ms = []",
        ),
        (
            r#"[{"frame": 9999, "ms": [1], "image": "images/frame-000001.png"}]"#,
            "frames [9999]",
        ),
        (
            r#"[{"frame": 1, "ms": [1], "image": "beside.json"}]"#,
            "an image (PNG, JPEG",
        ),
        (
            r#"[{"frame": 1, "ms": [1], "image": "/dev/zero"}]"#,
            "not a regular file",
        ),
        (r#"[{"frame": 1}]"#, "missing field"),
    ] {
        let (code, text, _) = chart(frames);
        assert!(code == 65 && text.contains(said), "{frames}: {text}");
    }
}

/// The full model errs by nothing against itself; what is on the front no other beats;
/// one plan is chosen; and no fragment of a file is left.
#[test]
fn a_chart_compares_all_ways_with_the_full_model() {
    // A line so wide that the plan omits the blur of the lens: every pixel is traced once.
    let text = with("[accuracy]\nmax_height_error_um = 30\n")
        .replace("waist_radius_um = 300", "waist_radius_um = 900");
    let folder = folder_with(&text);
    let arguments = [
        "chart",
        "scene.toml",
        "-o",
        "out",
        "--frames",
        "1",
        "--rounds",
        "1",
        "--json",
    ];
    let chart = json(folder.path(), &arguments);
    let rows = chart["rows"].as_array().unwrap();
    assert!(rows.len() > 8, "{}", rows.len());
    assert_eq!(rows[0]["error"]["percentile_99_um"], 0.0);
    // It looks at every pixel.
    let side = rows[0]["plan"]["samples_per_side"].as_f64().unwrap();
    assert_eq!(rows[0]["samples"], 64.0 * 48.0 * side * side);
    let images = rows.iter().filter(|r| r["plan"]["geometry_only"] == false);
    for row in images {
        assert!(
            row["ms_per_million_samples"].as_f64().unwrap() > 0.0,
            "{row}"
        );
        assert!(
            row["contrast"].as_f64().unwrap() < 0.5 && row["memory_mb"].as_f64().unwrap() > 0.0
        );
    }
    assert_eq!(rows.iter().filter(|row| row["chosen"] == true).count(), 1);
    let place = |row: &Value| {
        Some((
            row["ms"][1].as_f64()?,
            row["error"]["percentile_99_um"].as_f64()?,
        ))
    };
    for row in rows.iter().filter(|row| row["pareto_optimal"] == true) {
        let (ms, um) = place(row).unwrap();
        let others = rows
            .iter()
            .filter(|other| other["independent_speckle"] == false);
        let better = others.filter_map(place).find(|o| o.0 < ms && o.1 < um);
        assert!(better.is_none(), "{row} {better:?}");
    }
    let mut names: Vec<String> = fs::read_dir(folder.path().join("out"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, [".lasertrace", "chart.json", "chart.svg"]);
    let svg = fs::read_to_string(folder.path().join("out/chart.svg")).unwrap();
    assert!(svg.contains("tolerance 30.0 µm") && !svg.contains("NaN") && !svg.contains("inf"));
}

/// Three sensors out of focus over leaning planes, drawn from a seed: the share of points
/// whose blur is wider than two standard deviations of their line, from the depth of each in
/// its profile by the equation of the thin lens, is what summary and plan say. The profiles'
/// digits leave the side of points open whose two widths differ by less than a thousandth;
/// the plan looks at all three frames, but not at points that a flag makes doubtful.
#[test]
fn the_share_of_points_out_of_focus_is_that_of_their_depths() {
    use lasertrace::math::rng::{Purpose, RngKey};
    use lasertrace::math::{DMat3, DVec3};
    let mut partly = 0;
    for i in 0..3 {
        let key = RngKey::new(31, Purpose::SensorNoise).with(i);
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
        let lean = between(0, 20.0, 28.0).to_radians();
        let (focus, f_number) = (between(1, 113.0, 118.0), between(2, 1.4, 2.2));
        let text = with(
            "[accuracy]\nmax_height_error_um = 50\n\
             [model]\nnoise = false\ngeometry_only = false\ndefocus_model = \"none\"\nsamples_per_side = 4\npixel_sampling = \"planar\"\n",
        )
        .replace("rotation_deg = [0, 0, 0]", &format!("rotation_deg = [0, {}, 0]", lean.to_degrees()))
        .replace("focus_distance_mm = 115", &format!("focus_distance_mm = {focus}"))
        .replace("waist_radius_um = 300", "waist_radius_um = 150")
        .replace("f_number = 8", &format!("f_number = {f_number}"));
        let folder = folder_with(&text);
        let summary = json(
            folder.path(),
            &["scan", "scene.toml", "-o", "out", "--also", "csv", "--json"],
        );
        let plan = json(folder.path(), &["check", "scene.toml", "--json"])["plan"].take();
        let eye = DVec3::new(0.0, -57.5, 99.6);
        let behind = 1.0 / (1.0 / 16.0 - 1.0 / focus);
        let (mut points, mut blurred, mut open, mut doubtful) = (0.0, 0.0, 0.0, 0.0);
        let cloud = fs::read_to_string(folder.path().join("out/cloud.csv")).unwrap();
        for line in cloud.lines().skip(1) {
            let numbers = line.split(',').map(|cell| cell.parse::<f64>().unwrap());
            let cells: Vec<f64> = numbers.collect();
            let place = DVec3::new(cells[0], cells[1], cells[2]);
            let head = DVec3::Y * (-0.5 + 0.5 * cells[7]);
            let from_eye = DMat3::from_rotation_y(lean) * place - eye - head;
            let image = 1.0 / (1.0 / 16.0 - 1.0 / from_eye.dot(-eye.normalize()));
            let blur = 16.0 / f_number * (behind / image - 1.0).abs() / 0.03;
            let ratio = blur / (2.0 * cells[11]);
            points += 1.0;
            blurred += f64::from(u8::from(ratio > 1.0));
            open += f64::from(u8::from((ratio - 1.0).abs() < 1e-3));
            doubtful += f64::from(u8::from(cells[9] != 0.0));
        }
        let found = summary["defocused_fraction"].as_f64().unwrap();
        assert!(points > 60.0, "{points}");
        assert!(
            (found * points - blurred).abs() <= open + 1e-9,
            "{found} {blurred} of {points}"
        );
        let planned = plan["defocused_fraction"].as_f64().unwrap();
        assert!(
            (planned - found).abs() * points <= doubtful + open + 1e-9,
            "{planned} {found} {doubtful}"
        );
        partly += u32::from(blurred > 0.0 && blurred < points);
        let report = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
        assert!(report.contains("wider than two standard deviations of their line"));
    }
    assert!(partly > 0, "no scene has points of both kinds");
}
