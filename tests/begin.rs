//! From a mesh and a sensor to a first scan, with no number copied.

#![cfg(unix)]

mod program;

use program::{assert_error, run};
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
