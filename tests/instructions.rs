//! A scan with Embree held to AVX2 gives the bytes it gives with the widest instructions
//! the processor has.

#![cfg(all(feature = "embree", unix))]

use assert_cmd::Command;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Five frames of the demo's scan under this configuration of Embree, which it reads from
/// `.embree3` or `.embree4` in the user's folder: what the program says, and its files
/// but for the report and the manifest, which hold times.
fn scanned(configuration: &str) -> (String, BTreeMap<String, Vec<u8>>) {
    let folder = tempfile::tempdir().unwrap();
    for version in [3, 4] {
        let file = folder.path().join(format!(".embree{version}"));
        fs::write(file, configuration).unwrap();
    }
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let output = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder.path())
        .env("HOME", folder.path())
        .args(["scan", scene.to_str().unwrap(), "-o", "out", "--frames", "100..105"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let mut files = BTreeMap::new();
    for sub in ["out", "out/profiles"] {
        for entry in fs::read_dir(folder.path().join(sub)).unwrap() {
            let entry = entry.unwrap();
            let name = entry.file_name().into_string().unwrap();
            let has_times = ["report.html", "manifest.json"].contains(&name.as_str());
            if entry.path().is_file() && !has_times {
                files.insert(name, fs::read(entry.path()).unwrap());
            }
        }
    }
    let text = [output.stdout, output.stderr].concat();
    (String::from_utf8(text).unwrap(), files)
}

/// What Embree says of itself with `verbose` shows that the configuration was read.
#[test]
fn avx2_gives_the_bytes_of_the_widest_instructions() {
    let (_, own) = scanned("");
    assert!(own.contains_key("cloud.ply") && own.len() >= 5 + 4, "{:?}", own.keys());
    let (said, narrow) = scanned("verbose=1,isa=avx2");
    println!("{said}");
    assert!(said.contains("AVX2"), "{said}");
    for (name, bytes) in &own {
        assert!(narrow[name] == *bytes, "{name} differs");
    }
    assert_eq!(own.len(), narrow.len());
}
