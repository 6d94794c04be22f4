//! From a mesh and a sensor to a first scan, with no number copied.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{assert_error, run};
use std::fs;
use std::path::Path;

/// A closed box of 60 × 2 × 10 mm.
const BOX: &str = "v 0 0 0\nv 60 0 0\nv 60 2 0\nv 0 2 0\nv 0 0 10\nv 60 0 10\nv 60 2 10\nv 0 2 10\n\
                   f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";

/// Returns the summary of a scan of `first/scene.toml` without images.
fn scanned(folder: &Path) -> serde_json::Value {
    let scan = [
        "scan",
        "first/scene.toml",
        "--geometry-only",
        "--json",
        "-o",
        "out",
    ];
    let (code, json, stderr) = run(folder, &scan);
    assert_eq!(code, 0, "{stderr}");
    serde_json::from_str(&json).unwrap()
}

/// The near field of 18.2 mm, less a tenth, goes over 60 mm in four passes, and the range of 16 mm holds 10 mm. The top, 120 mm² of
/// 1480, is 0.081 of the surface; of it all is measured but for what ends of lines and of the path leave out, less than a tenth.
#[test]
fn three_commands_measure_the_top_of_a_part() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("part.obj"), BOX).unwrap();
    let sensor = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors/generic-20mm-405nm.toml");
    let begin = ["begin", "part.obj", sensor.to_str().unwrap(), "-o", "first"];
    let (code, text, stderr) = run(folder.path(), &begin);
    assert_eq!((code, stderr.as_str()), (0, ""), "{text}");
    assert!(text.contains("60.0000 × 2.0000 × 10.0000 mm"), "{text}");
    assert!(
        text.contains("4 × 1 passes across and along the range"),
        "{text}"
    );
    let (code, page, stderr) = run(folder.path(), &["check", "first/scene.toml"]);
    assert_eq!((code, stderr.as_str()), (0, ""));
    assert!(page.contains("No warnings"), "{page}");
    let json = scanned(folder.path());
    let measured = json["coverage"]["shares"][0][1].as_f64().unwrap();
    println!("measured {measured:.4} of the surface");
    assert!((0.073..0.085).contains(&measured), "{measured}");

    assert_error(
        folder.path(),
        &begin,
        64,
        &["first/scene.toml is there already"],
    );
    // An interrupted run leaves copies of its inputs and a path of another name.
    let first = folder.path().join("first");
    fs::rename(first.join("path.csv"), first.join("path.csv.part")).unwrap();
    fs::remove_file(first.join("scene.toml")).unwrap();
    let (code, _, stderr) = run(folder.path(), &begin);
    assert_eq!((code, stderr.as_str()), (0, ""));
    assert!(!first.join("path.csv.part").exists());
    // A changed copy is not replaced.
    fs::remove_file(first.join("scene.toml")).unwrap();
    fs::remove_file(first.join("path.csv")).unwrap();
    fs::write(first.join("sensor.toml"), "changed").unwrap();
    assert_error(
        folder.path(),
        &begin,
        64,
        &["first/sensor.toml is there already"],
    );
    let missing = ["begin", "part.obj", "none.toml", "-o", "second"];
    assert_error(folder.path(), &missing, 74, &["none.toml"]);
    let metres = [&begin[..4], &["metres", "--unit", "m"]].concat();
    let (code, text, _) = run(folder.path(), &metres);
    assert!(code == 0 && text.contains("60000.0000"), "{text}");
}

/// A closed box of these sizes, with its lowest corner at the origin.
fn box_of([x, y, z]: [f64; 3]) -> String {
    let mut obj = String::new();
    for z in [0.0, z] {
        for [x, y] in [[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]] {
            obj += &format!("v {x} {y} {z}\n");
        }
    }
    obj + "f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
}

fn sensor() -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors/generic-20mm-405nm.toml");
    file.to_str().unwrap().to_owned()
}

/// The folder names no file outside it, and works at another position.
#[test]
fn the_folder_can_be_moved() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    fs::create_dir(path.join("cad")).unwrap();
    fs::write(path.join("cad/part with blank.obj"), BOX).unwrap();
    let begin = ["begin", "cad/part with blank.obj", &sensor(), "-o", "first"];
    let (code, text, stderr) = run(path, &begin);
    assert_eq!(code, 0, "{text}{stderr}");
    let moved = tempfile::tempdir().unwrap();
    fs::rename(path.join("first"), moved.path().join("other")).unwrap();
    fs::remove_dir_all(path.join("cad")).unwrap();
    for file in ["scene.toml", "path.csv"] {
        let text = fs::read_to_string(moved.path().join("other").join(file)).unwrap();
        assert!(!text.contains(path.to_str().unwrap()), "{text}");
        assert!(!text.contains(env!("CARGO_MANIFEST_DIR")), "{text}");
    }
    let (code, page, stderr) = run(moved.path(), &["check", "other/scene.toml"]);
    assert_eq!((code, stderr.as_str()), (0, ""), "{page}");
    // Each of three boxes is turned so that the chosen axis of its file points up.
    for (up, size) in [
        ("x", [3.0, 2.0, 5.0]),
        ("-y", [4.0, 6.0, 3.0]),
        ("-z", [5.0, 3.0, 4.0]),
    ] {
        let file = format!("box{up}.obj");
        fs::write(path.join(&file), box_of(size)).unwrap();
        let arguments = [
            "begin",
            &file,
            &sensor(),
            "--up",
            up,
            "-o",
            &format!("out{up}"),
            "--json",
        ];
        let (code, text, stderr) = run(path, &arguments);
        assert_eq!(code, 0, "{stderr}");
        let begun: serde_json::Value = serde_json::from_str(&text).unwrap();
        let axis = ["x", "y", "z"]
            .iter()
            .position(|a| up.ends_with(a))
            .unwrap();
        let height = begun["size_mm"][2].as_f64().unwrap();
        assert!((height - size[axis]).abs() < 1e-6, "{up}: {text}");
        assert_eq!(begun["warnings"].as_array().unwrap().len(), 0, "{text}");
    }
}

/// Passes lie closer than the field is wide; a part higher than the range and a part in another unit are warned of.
#[test]
fn parts_that_do_not_fit_are_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let begun = |name: &str, size: [f64; 3]| {
        let file = format!("{name}.obj");
        fs::write(folder.path().join(&file), box_of(size)).unwrap();
        let arguments = ["begin", &file, &sensor(), "-o", name, "--json"];
        let (code, text, stderr) = run(folder.path(), &arguments);
        assert_eq!(code, 0, "{stderr}");
        let begun: serde_json::Value = serde_json::from_str(&text).unwrap();
        let warnings = begun["warnings"].as_array().unwrap().clone();
        let reasons: Vec<String> = warnings
            .iter()
            .map(|warning| warning["reason"].as_str().unwrap().to_owned())
            .collect();
        (begun, reasons, text)
    };
    // The range of 16 mm, less a tenth, takes 14.4 mm.
    for (name, height) in [("a", 20.0), ("b", 33.0), ("c", 14.0)] {
        let (begun, reasons, text) = begun(name, [30.0, 8.0, height]);
        let layers = (height / 14.4_f64).ceil();
        assert_eq!(begun["passes"][1].as_f64().unwrap(), layers, "{text}");
        let warned = reasons.iter().any(|reason| reason == "deeper-than-range");
        assert_eq!(warned, layers > 1.0, "{text}");
        let apart = reasons
            .iter()
            .any(|reason| reason == "passes-too-far-apart");
        assert!(!apart, "{text}");
    }
    for (name, scale) in [("d", 1e-3), ("e", 5e-4)] {
        let (_, reasons, text) = begun(name, [60.0 * scale, 40.0 * scale, 10.0 * scale]);
        assert!(
            reasons.iter().any(|reason| reason == "unit-doubtful"),
            "{text}"
        );
        assert!(text.contains("try part.mesh.unit = \\\"m\\\""), "{text}");
    }
    // A STEP file.
    fs::write(folder.path().join("part.stp"), "ISO-10303-21;\nHEADER;\n").unwrap();
    let step = ["begin", "part.stp", &sensor(), "-o", "step"];
    assert_error(
        folder.path(),
        &step,
        65,
        &["a STEP file", "examples/step/step.sh"],
    );
}

/// Features of the bracket: the step between two planes, its hole, and a plane that faces down.
const BRACKET_FEATURES: &str = "[[feature]]
name = \"top\"
kind = \"plane\"
point_mm = [4, 8, 6]
[[feature]]
name = \"land\"
kind = \"plane\"
point_mm = [14, 0, 4.5]
tolerance = { offset_mm = [-0.05, 0.05] }
[[feature]]
name = \"step\"
kind = \"step-height\"
between = [\"land\", \"top\"]
tolerance = { height_mm = [-0.05, 0.05] }
";

/// A planned path measures the features, with poses in the frame of the part. Features that face
/// away from the sensor are named with the reason.
#[test]
fn a_path_is_planned_for_features() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let bracket = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/bracket.stl");
    fs::copy(bracket, path.join("bracket.stl")).unwrap();
    let plan = |features: &str, more: &[&str], out: &str| {
        fs::write(path.join("features.toml"), features).unwrap();
        let sensor = sensor();
        let begin = ["begin", "bracket.stl", &sensor, "--unit", "mm", "--json"];
        let goal = ["--features", "features.toml", "-o", out];
        run(path, &[&begin[..], &goal, more].concat())
    };
    let (code, json, stderr) = plan(BRACKET_FEATURES, &["--spacing", "250"], "first");
    assert_eq!(code, 0, "{stderr}");
    let begun: serde_json::Value = serde_json::from_str(&json).unwrap();
    let found = &begun["path"]["features"];
    assert_eq!(found.as_array().unwrap().len(), 3);
    for feature in found.as_array().unwrap() {
        assert!(feature["problem"].is_null(), "{feature}");
        let q = &feature["quantities"][0];
        assert!(q["smallest_tolerance"].as_f64().unwrap() < 0.1, "{feature}");
    }
    for target in begun["path"]["targets"].as_array().unwrap() {
        let [measured, area] = ["measured_mm2", "area_mm2"].map(|k| target[k].as_f64().unwrap());
        let hidden = target["hidden"].as_array().unwrap().iter();
        let hidden: f64 = hidden.map(|h| h["area_mm2"].as_f64().unwrap()).sum();
        // 95 % of the surface that is not hidden, within one of 400 samples.
        assert!(
            measured >= (0.95 - 1.0 / 400.0) * (area - hidden),
            "{target}"
        );
    }
    // A scan measures the features with the predicted number of points and uncertainty.
    let scanned = scanned(path);
    let of_scan = scanned["features"].as_array().unwrap();
    for (scanned, begun) in of_scan.iter().zip(found.as_array().unwrap()) {
        assert_eq!(scanned["name"], begun["name"]);
        assert_eq!(scanned["points"], begun["points"]);
        let u = |of: &serde_json::Value| {
            of["quantities"][0]["expanded_uncertainty"]
                .as_f64()
                .unwrap()
        };
        // A scan without images states the noise of its rows differently.
        assert!(
            (u(scanned) / u(begun) - 1.0).abs() < 0.01,
            "{scanned} {begun}"
        );
    }
    // The head moves along straight lines with the stated spacing.
    let poses = fs::read_to_string(path.join("first/path.csv")).unwrap();
    assert!(poses.starts_with("x_mm,y_mm,z_mm,qw,qx,qy,qz\n"), "{poses}");
    assert_eq!(
        poses.lines().count() - 1,
        begun["frames"].as_u64().unwrap() as usize
    );

    let down = "[[feature]]\nname = \"bottom\"\nkind = \"plane\"\npoint_mm = [4, 8, 0]\n";
    let (code, _, stderr) = plan(down, &[], "second");
    assert_eq!(code, 64, "{stderr}");
    assert!(
        stderr.contains("hidden from the laser within the limits of the head"),
        "{stderr}"
    );
    let (code, json, stderr) = plan(down, &["--max-tilt", "180", "--spacing", "500"], "third");
    assert_eq!(code, 0, "{stderr}{json}");
}

/// Without a file, the faces of the part are the features. Four commands lead from the CAD to their
/// table, without a number of the part.
#[test]
fn faces_of_a_part_are_features() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    for (seed, size) in [[9.0, 7.0, 5.0], [14.0, 5.0, 3.0], [6.0, 6.0, 8.0]]
        .into_iter()
        .take(extent(1, 3))
        .enumerate()
    {
        fs::write(path.join("part.obj"), box_of(size)).unwrap();
        let [first, out] = ["first", "out"].map(|name| format!("{name}{seed}"));
        let sensor = sensor();
        let begin = [
            "begin",
            "part.obj",
            &sensor,
            "--features",
            "--tolerance",
            "0.1",
        ];
        let more = ["--spacing", "400", "-o", &first];
        let (code, text, stderr) = run(path, &[&begin[..], &more].concat());
        assert_eq!(code, 0, "{stderr}");
        assert!(
            text.contains("plane 1: ") && text.contains("can be proven"),
            "{text}"
        );
        let scene = format!("{first}/scene.toml");
        let (code, _, stderr) = run(path, &["scan", &scene, "--geometry-only", "-o", &out]);
        assert_eq!(code, 0, "{stderr}");
        let table = fs::read_to_string(path.join(out).join("features.csv")).unwrap();
        // The top is measured, and the bottom has a sentence.
        assert!(
            table.contains("plane,offset_mm") && table.contains(",conforms,"),
            "{table}"
        );
        assert!(table.contains("usable points on the"), "{table}");
        let planes: std::collections::BTreeSet<_> = table
            .lines()
            .skip(1)
            .map(|line| line.split(',').next())
            .collect();
        assert_eq!(planes.len(), 6, "{table}");
    }
}

/// Mistakes in the file of features are reported with its name and line.
#[test]
fn mistakes_in_a_file_of_features_have_its_lines() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    fs::write(path.join("part.obj"), BOX).unwrap();
    let top = "[[feature]]\nname = \"top\"\nkind = \"plane\"\npoint_mm = [30, 1, 10]\n";
    for (features, words) in [
        (
            format!("{top}tolerance = {{ diameter_mm = [-1, 1] }}\n"),
            "features.toml:5: feature.0.tolerance.diameter_mm: found [-1, 1], expected one of offset_mm",
        ),
        (
            format!("{top}margin_mm = -1\n"),
            "features.toml:5: feature.0.margin_mm",
        ),
        (
            format!("seed = 3\n{top}"),
            "features.toml: found the key seed, expected [[feature]] tables only",
        ),
        (top.replace("plane\"", "plane"), "features.toml:3"),
        (format!("{top}{top}"), "features.toml:6: feature.1.name"),
        (
            format!("{top}pont_mm = 1\n"),
            "features.toml:5: feature.0.pont_mm: found a key that [[feature]] does not have",
        ),
    ] {
        fs::write(path.join("features.toml"), &features).unwrap();
        let arguments = [
            "begin",
            "part.obj",
            &sensor(),
            "--features",
            "features.toml",
            "-o",
            "out",
        ];
        let (code, _, stderr) = run(path, &arguments);
        assert_eq!(code, 65, "{features}: {stderr}");
        assert!(stderr.contains(words), "{features}: {stderr}");
    }
}

/// A path over the complete surface, with the distance of frames that the user names.
#[test]
fn a_path_is_planned_over_the_surface() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    fs::write(path.join("part.obj"), box_of([9.0, 7.0, 5.0])).unwrap();
    let sensor = sensor();
    let begin = [
        "begin",
        "part.obj",
        &sensor,
        "--tolerance",
        "0.05",
        "--spacing",
        "500",
    ];
    let limits = ["--max-tilt", "90", "--json", "-o", "out"];
    let (code, json, stderr) = run(path, &[&begin[..], &limits].concat());
    assert_eq!(code, 0, "{stderr}");
    let begun: serde_json::Value = serde_json::from_str(&json).unwrap();
    let target = &begun["path"]["targets"][0];
    let [measured, area] = ["measured_mm2", "area_mm2"].map(|k| target[k].as_f64().unwrap());
    // The top and the four sides are 223 of 286 mm².
    assert!(measured / area > 0.95 * 223.0 / 286.0 - 0.01, "{target}");
    assert!(
        begun["path"]["sufficient_fraction"].as_f64().unwrap() > 0.9,
        "{begun}"
    );
    let (code, text, stderr) = run(path, &["check", "out/scene.toml"]);
    assert_eq!(code, 0, "{text}{stderr}");
}
