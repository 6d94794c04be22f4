//! From a mesh and a sensor to a first scan, with no number copied.

#![cfg(unix)]

use crate::program::{assert_error, run};
use std::fs;
use std::path::Path;

/// A closed box of 60 × 2 × 10 mm.
const BOX: &str = "v 0 0 0\nv 60 0 0\nv 60 2 0\nv 0 2 0\nv 0 0 10\nv 60 0 10\nv 60 2 10\nv 0 2 10\n\
                   f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";

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
        text.contains("4 × 1 passes, side by side and one below the other"),
        "{text}"
    );
    let (code, page, stderr) = run(folder.path(), &["check", "first/scene.toml"]);
    assert_eq!((code, stderr.as_str()), (0, ""));
    assert!(page.contains("No warnings"), "{page}");
    let scan = [
        "scan",
        "first/scene.toml",
        "--geometry-only",
        "--json",
        "-o",
        "out",
    ];
    let (code, json, stderr) = run(folder.path(), &scan);
    assert_eq!(code, 0, "{stderr}");
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    let measured = json["coverage"]["shares"][0][1].as_f64().unwrap();
    println!("measured {measured:.4} of the surface");
    assert!((0.073..0.085).contains(&measured), "{measured}");

    assert_error(
        folder.path(),
        &begin,
        64,
        &["first/scene.toml is there already"],
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
