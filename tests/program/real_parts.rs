//! Real parts from their CAD to a table of features with verdicts, without a number of the part.

#![cfg(unix)]

use assert_cmd::Command;
use std::fs;
use std::path::Path;

/// Meshes of `../shared/data/meshes`, their units, and the distance of the frames, µm.
const PARTS: [(&str, &str, &str); 5] = [
    ("trimesh_plate_holes.STL", "mm", "1000"),
    ("trimesh_octagonal_pocket.stl", "m", "1000"),
    ("trimesh_featuretype.STL", "inch", "1000"),
    ("trimesh_ADIS16480.STL", "m", "250"),
    ("NIST_MBE_PMI_5_l1.stl", "mm", "5000"),
];

/// The scanned part is the CAD, so no feature fails its tolerance of ±0.1 mm.
#[test]
#[ignore = "minutes; part of make verify"]
fn five_real_parts_have_verdicts() {
    let meshes = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/meshes");
    if !meshes.exists() {
        println!("NOT TESTED: {} is absent", meshes.display());
        return;
    }
    let sensor = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors/generic-100mm-660nm.toml");
    let sensor = sensor.to_str().unwrap();
    for (name, unit, spacing) in PARTS {
        let folder = tempfile::tempdir().unwrap();
        let mesh = meshes.join(name);
        let part = mesh.to_str().unwrap();
        let begin = [
            "begin",
            part,
            sensor,
            "--unit",
            unit,
            "--features",
            "-o",
            "first",
        ];
        for command in [
            &[&begin[..], &["--spacing", spacing]].concat()[..],
            &["check", "first/scene.toml"],
            &["scan", "first/scene.toml", "-o", "out"],
        ] {
            Command::new(env!("CARGO_BIN_EXE_lasertrace"))
                .current_dir(folder.path())
                .args(command)
                .assert()
                .success();
        }
        let table = fs::read_to_string(folder.path().join("out/features.csv")).unwrap();
        println!("{name}\n{table}");
        let mut conforming = 0;
        for line in table.lines().skip(1) {
            let values: Vec<&str> = line.split(',').collect();
            assert_ne!(values[10], "does not conform", "{name}: {line}");
            conforming += usize::from(values[10] == "conforms");
        }
        assert!(conforming >= 3, "{name}: {table}");
    }
}
