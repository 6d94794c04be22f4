//! What a run meets outside its scene: no mesh, another mesh, an output that is no
//! folder or may not be written.

#![cfg(unix)]

use crate::program::{PLANE, assert_error, folder_with, run, scene};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

const SCAN: [&str; 4] = ["scan", "scene.toml", "-o", "out"];

const MESH: &str = "mesh = { file = \"part.obj\", unit = \"mm\" }";

fn square(height: f64) -> String {
    format!("v -8 -8 0\nv 8 -8 0\nv 8 8 {height}\nv -8 8 0\nf 1 2 3 4\n")
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder)
        .into_iter()
        .flatten()
        .map(|e| e.unwrap().path());
    let files = entries.filter(|path| path.is_file());
    files
        .map(|path| (path.display().to_string(), fs::read(&path).unwrap()))
        .collect()
}

#[test]
fn a_mesh_that_is_gone_or_another_is_named_and_nothing_is_touched() {
    let folder = folder_with(&scene(MESH));
    let path = folder.path();
    assert_error(path, &SCAN, 65, &[":6: part.mesh.file", "none at part.obj"]);
    assert!(!path.join("out").exists());
    fs::write(path.join("part.obj"), square(0.0)).unwrap();
    let (code, _, stderr) = run(path, &SCAN);
    assert_eq!(code, 0, "{stderr}");
    let resume = [&SCAN[..], &["--resume"]].concat();
    let before = files(&path.join("out"));
    let untouched = || assert!(files(&path.join("out")) == before);

    fs::write(path.join("part.obj"), square(0.001)).unwrap();
    assert_error(
        path,
        &resume,
        64,
        &["the scene or a file it names has changed"],
    );
    untouched();
    fs::write(path.join("part.obj"), &square(0.0)[..30]).unwrap();
    assert_error(
        path,
        &resume,
        65,
        &["part.obj:4: found a vertex of 1 numbers"],
    );
    untouched();
    fs::remove_file(path.join("part.obj")).unwrap();
    assert_error(path, &resume, 65, &["part.mesh.file", "none at part.obj"]);
    untouched();
    fs::write(path.join("part.obj"), square(0.0)).unwrap();
    let (code, _, stderr) = run(path, &resume);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn an_output_that_cannot_be_written_is_an_error_of_the_file_system() {
    let folder = folder_with(&scene(PLANE));
    let path = folder.path();
    fs::write(path.join("out"), "a file").unwrap();
    assert_error(path, &SCAN, 74, &["out"]);
    assert_eq!(fs::read(path.join("out")).unwrap(), b"a file");
    let below = ["scan", "scene.toml", "-o", "out/below"];
    assert_error(path, &below, 74, &["out/below"]);

    fs::remove_file(path.join("out")).unwrap();
    fs::create_dir(path.join("out")).unwrap();
    fs::set_permissions(path.join("out"), fs::Permissions::from_mode(0o500)).unwrap();
    if fs::write(path.join("out/probe"), "").is_ok() {
        eprintln!("\n*** NOT TESTED: this user may write where no one may. ***\n");
        return;
    }
    assert_error(path, &SCAN, 74, &["out/", "Permission denied"]);
    let render = ["render", "scene.toml", "--frame", "0", "-o", "out"];
    assert_error(path, &render, 74, &["out/", "Permission denied"]);
}

/// Files that may grow to so many blocks of 512 bytes: at each limit another one is the
/// first that does not fit.
#[test]
fn a_file_that_may_not_grow_is_temporary_and_leaves_no_half_file() {
    let folder = folder_with(&scene(PLANE));
    let path = folder.path();
    let mut refused = BTreeSet::new();
    for blocks in [1, 4, 8, 16, 32, 64] {
        let out = path.join(format!("out-{blocks}"));
        let limited = format!("ulimit -f {blocks}; exec \"$0\" scan scene.toml -o out-{blocks}");
        let output = Command::new("sh")
            .args(["-c", &limited, env!("CARGO_BIN_EXE_lasertrace")])
            .current_dir(path)
            .output()
            .unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        if output.status.success() {
            continue;
        }
        assert_eq!(output.status.code(), Some(75), "{stderr}");
        let prefix = format!("lasertrace: cannot write out-{blocks}/");
        let name = stderr
            .strip_prefix(&prefix)
            .and_then(|rest| rest.split(':').next());
        let name = name.unwrap_or_else(|| panic!("{stderr}"));
        assert!(
            name == "frames.journal" || !out.join(name).exists(),
            "{name}"
        );
        assert!(!out.join("manifest.json").exists());
        assert!(!out.join(format!("{name}.part")).exists());
        refused.insert(name.to_owned());
    }
    assert!(refused.len() >= 2, "{refused:?}");
}
