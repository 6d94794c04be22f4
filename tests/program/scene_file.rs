//! The scene file from outside: what is refused, in which words, and that what is
//! accepted does no harm.

use crate::effort::extent;
use crate::program::{PLANE, assert_error, folder_with, numbers, run, scene};
use std::fs;
use std::path::Path;

/// `check`s a scene and asserts exit code 65 and the words.
#[track_caller]
fn assert_refused(text: &str, words: &[&str]) {
    let folder = folder_with(text);
    assert_error(folder.path(), &["check", "scene.toml"], 65, words);
}

/// What is changed in the scene, into what, and what the message then holds.
const MISTAKES: &[(&str, &str, &str)] = &[
    (
        "reflectance = 0.5",
        "",
        ":5: part: found [part], expected reflectance = ... in [part], or a table [part.surface]",
    ),
    (
        "reflectance = 0.5",
        "surface = { metal = { name = \"steel\", roughness = 0.2 } }",
        ":7: part.surface.metal.name: found \"steel\", expected one of aluminium, copper, iron",
    ),
    (
        "reflectance = 0.5",
        "surface = { metal = { n = 1, k = 7, roughness = 0.2, roughness_v = 0.3 } }",
        "part.surface: found",
    ),
    (
        "reflectance = 0.5",
        "surface = { coated_diffuse = { index = 1.5, roughness = 0, reflectance = 0.5 } }",
        ":7: part.surface.coated_diffuse.roughness: found 0, expected a number from 1e-2 to 1e0",
    ),
    (
        "[scan]",
        "[accuracy]\nmax_height_error_um = -1\n[scan]",
        ": accuracy.max_height_error_um: found -1, expected a finite number > 0",
    ),
    (
        "[scan]",
        "[plan]\nsamples_per_side = 4\n[scan]",
        "plan has been renamed to model",
    ),
    (
        "[scan]",
        "[model]\ndefocus_model = \"mean\"\n[scan]",
        "\"mean\" has been renamed to \"incoherent\"",
    ),
    (
        "[scan]",
        "[model]\nsamples_per_side = 17\n[scan]",
        ": model.samples_per_side: found 17, expected from 1 to 16",
    ),
    (
        "reflectance = 0.5",
        "surface = { mirror = { reflectance = 2 } }",
        ":7: part.surface.mirror.reflectance: found 2, expected a number from 0 to 1",
    ),
    (
        "[scan]",
        "[model]\nmax_bounces = 65\n[scan]",
        ": model.max_bounces: found 65, expected from 1 to 64",
    ),
    (
        "m_squared = 1.1",
        "m_squared = 1.1\ncoherence_length_mm = 0",
        ": laser.coherence_length_mm: found 0, expected a finite number > 0",
    ),
    (
        "[scan]",
        "[model]\ngeometry_only = true\n[scan]",
        ": model.geometry_only: found true, expected false: it takes a line laser",
    ),
    (
        "seed = 7",
        "seed = 7 8",
        ":1: seed: found \"seed = 7 8\", which is not TOML",
    ),
    (
        "seed = 7",
        "seed = 7\nseed = 8",
        ":2: seed: found a second seed, expected each key once; the first is in line 1",
    ),
    (
        "seed = 7",
        "seed = -7",
        ":1: seed: found -7, expected a whole number, not negative",
    ),
    (
        "frames = 3",
        "frames = 4294967296",
        "scan.frames: found 4294967296, expected a whole number from 0 to 4294967295",
    ),
    (
        "speckle = false\n",
        "",
        "scene.toml: speckle is missing, expected speckle = ... above the first [table]",
    ),
    (
        "speckle = false",
        "speckle = 0",
        ":2: speckle: found 0, expected true or false",
    ),
    (
        "reflectance",
        "color",
        ":7: part.color: found a key that [part] does not have, expected mesh, plane, sphere",
    ),
    (
        PLANE,
        "plane = 7",
        ":6: part.plane: found 7, expected a table of keys",
    ),
    (
        PLANE,
        "",
        ":5: part: found [part], expected exactly one of mesh, plane, sphere",
    ),
    (
        PLANE,
        "mesh = { file = \"no.stl\", unit = \"mm\" }",
        ":6: part.mesh.file: found \"no.stl\", expected a mesh file",
    ),
    (
        PLANE,
        "mesh = { file = \"\", unit = \"mm\" }",
        ":6: part.mesh.file: found \"\", expected a mesh file",
    ),
    (
        PLANE,
        "mesh = { file = \"a\", unit = \"furlong\" }",
        ":6: part.mesh.unit: found \"furlong\", expected \"um\", \"mm\"",
    ),
    (
        PLANE,
        "mesh = { file = \"scene.toml\", unit = \"mm\" }",
        "scene.toml: found ",
    ),
    (
        PLANE,
        "mesh = { file = \"/\", unit = \"mm\" }",
        "part.mesh.file: found \"/\", expected a mesh file; / is not a regular file",
    ),
    (
        "[laser]",
        "[lasr]",
        ":11: lasr: found a key that a scene does not have, expected seed",
    ),
    (
        "power_mw = 10",
        "power_mw = \"ten\"",
        ":13: laser.power_mw: found \"ten\", expected a number",
    ),
    (
        "m_squared = 1.1",
        "m_squared = 0.9",
        ":16: laser.m_squared: found 0.9, expected a finite number >= 1",
    ),
    (
        "fan_deg = 12, ",
        "",
        ":19: laser.line.fan_deg is missing, expected fan_deg = ... in [laser.line]",
    ),
    (
        "\"uniform\"",
        "\"flat\"",
        ":19: laser.line.profile: found \"flat\", expected \"uniform\", \"gaussian\" or \"file\"",
    ),
    (
        "exposure_ms = 0.01\n",
        "",
        ":21: camera.exposure_ms is missing, expected exposure_ms = ... in [camera]",
    ),
    (
        "[64, 48]",
        "[64.5, 48]",
        ":25: camera.resolution_px: found [64.5, 48], expected a whole number",
    ),
    (
        "[64, 48]",
        "[64]",
        ":25: camera.resolution_px: found [64], a list of 1, expected a list of 2",
    ),
    (
        "[64, 48]",
        "[64, 48, 3]",
        ":25: camera.resolution_px: found [64, 48, 3], a list of 3, expected a list of 2",
    ),
    (
        "tilt_deg = [0, 0]",
        "tilt_deg = 0",
        ":30: camera.tilt_deg: found 0, expected a list",
    ),
    (
        "tilt_deg = [0, 0]",
        "tilt_deg = [0, 81]",
        ":30: camera.tilt_deg: found [0, 81], expected angles from -80 to 80",
    ),
    (
        "bit_depth = 10",
        "bit_depth = 7",
        ":34: camera.bit_depth: found 7, expected from 8 to 16",
    ),
    (
        "frames = 3",
        "frames = 0",
        ":40: scan.frames: found 0, expected at least 1",
    ),
];

#[test]
fn a_wrong_scene_is_refused_with_file_line_key_found_and_expected() {
    for (from, to, message) in MISTAKES {
        let text = scene(PLANE);
        assert!(text.contains(from), "{from}");
        assert_refused(&text.replacen(from, to, 1), &[message, "expected"]);
    }
    assert_refused("{ \"seed\": 1 }", &["scene.toml:1", "not TOML"]);
    assert_refused("", &["scene.toml: seed is missing"]);
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("scene.toml"), b"seed = \xff").unwrap();
    assert_error(
        folder.path(),
        &["check", "scene.toml"],
        65,
        &["byte 7", "UTF-8"],
    );
}

const PARTS: [&str; 4] = [
    PLANE,
    "sphere = { radius_mm = 5, chordal_deviation_um = 20 }",
    "cylinder = { radius_mm = 5, length_mm = 12, chordal_deviation_um = 20 }",
    "step_block = { size_mm = [16, 16, 6], step_mm = 2 }",
];

#[test]
fn every_number_refuses_what_is_not_a_sensible_number() {
    let mut keys = 0;
    for (i, part) in PARTS.into_iter().enumerate() {
        let text = scene(part);
        for (key, at) in numbers(&text) {
            // The keys that all shapes share are tried once.
            let shape = part.split(' ').next().unwrap();
            if i > 0 && !key.starts_with(&format!("part.{shape}")) {
                continue;
            }
            keys += 1;
            for value in ["nan", "inf", "-inf", "-1e300", "\"7\"", "true"] {
                let mut text = text.clone();
                text.replace_range(at.clone(), value);
                assert_refused(
                    &text,
                    &["scene.toml:", &format!(": {key}: found"), "expected"],
                );
            }
        }
    }
    // seed 1, part 7, laser 15, camera 24, scan 8; shapes 2 + 2 + 3 + 4. A number
    // that `numbers` overlooked would go untested.
    assert_eq!(keys, 66);
}

/// Numbers as large or small as they come: refused or taken, but no panic, no
/// endless work.
#[test]
fn extreme_numbers_do_no_harm() {
    for part in PARTS {
        let text = scene(part);
        for (number, (_, at)) in numbers(&text).into_iter().enumerate() {
            if part != PLANE && at.start > text.find("[laser]").unwrap() {
                continue;
            }
            let values = ["1e300", "1e-300", "0", "-1", "1e12", "4294967295"];
            // The short form has every third value, in turn.
            let every = extent(3, 1);
            for value in values.into_iter().skip(number % every).step_by(every) {
                // For whole numbers, which shapes have none of: a cylinder as wide is of
                // millions of triangles, whose hierarchy takes a minute.
                if part != PLANE && value == "4294967295" {
                    continue;
                }
                let mut text = text.clone();
                text.replace_range(at.clone(), value);
                let folder = folder_with(&text);
                let (code, _, stderr) = run(folder.path(), &["check", "scene.toml", "--quiet"]);
                assert!(
                    [0, 65].contains(&code),
                    "exit code {code}\n{stderr}\n{text}"
                );
            }
        }
    }
}

/// Every file named `scene.toml` below `folder`.
fn scenes(folder: &Path, found: &mut Vec<std::path::PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            scenes(&path, found);
        } else if path.ends_with("scene.toml") {
            found.push(path);
        }
    }
}

#[test]
fn every_scene_of_the_project_loads() {
    let mut found = Vec::new();
    scenes(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes"),
        &mut found,
    );
    assert!(!found.is_empty());
    for path in found {
        let scene = lasertrace::scene::Scene::load(&path);
        assert!(scene.is_ok(), "{}", scene.err().unwrap());
    }
}
