//! The program from outside: exit codes, messages, what goes to stdout and what
//! to stderr.

use crate::program::{PLANE, assert_error, folder_with, run, scene};
use serde_json::Value;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

#[test]
fn help_and_version_are_no_errors() {
    let here = Path::new(".");
    for arguments in [
        &["--help"][..],
        &["--version"],
        &["scan", "--help"],
        &["help", "check"],
    ] {
        let (code, stdout, stderr) = run(here, arguments);
        assert_eq!((code, stderr.as_str()), (0, ""), "{arguments:?}");
        assert!(!stdout.is_empty());
    }
    let (_, stdout, _) = run(here, &["--version"]);
    assert!(stdout.contains(env!("CARGO_PKG_VERSION")), "{stdout}");
    let (_, stdout, _) = run(here, &["--help"]);
    assert!(stdout.contains("Exit codes"), "{stdout}");
}

#[test]
fn a_wrong_command_line_is_a_usage_error() {
    let folder = folder_with(&scene(PLANE));
    for (arguments, word) in [
        (&[][..], "Usage"),
        (&["scna", "scene.toml"], "scna"),
        (&["check"], "<SCENE>"),
        (&["scan", "scene.toml"], "--output"),
        (&["check", "scene.toml", "--frobnicate"], "--frobnicate"),
        (&["check", "scene.toml", "--threads", "0"], "--threads"),
        (&["check", "scene.toml", "--threads", "-1"], "-1"),
        (&["check", "scene.toml", "--threads", "two"], "two"),
        (&["check", "scene.toml", "--seed", "-1"], "-1"),
        (&["render", "scene.toml", "-o", "x", "--frame", "-1"], "-1"),
        (
            &["render", "scene.toml", "-o", "x", "--frame", "3"],
            "frames 0 to 2",
        ),
    ] {
        assert_error(folder.path(), arguments, 64, &[word]);
    }
    assert!(
        !folder.path().join("x").exists(),
        "a refused frame left a folder"
    );
}

#[test]
fn an_absent_scene_is_an_input_output_error() {
    let folder = tempfile::tempdir().unwrap();
    for arguments in [&["check", "no.toml"][..], &["scan", "no.toml", "-o", "x"]] {
        assert_error(folder.path(), arguments, 74, &["cannot read no.toml"]);
    }
    assert_error(
        folder.path(),
        &["check", "."],
        65,
        &["found a folder", "TOML"],
    );
}

/// A pipe with no writer never ends: it must not be opened.
#[cfg(unix)]
#[test]
fn a_pipe_given_as_scene_or_mesh_does_not_hang() {
    let folder = folder_with(&scene("mesh = { file = \"pipe\", unit = \"mm\" }"));
    let made = std::process::Command::new("mkfifo")
        .arg(folder.path().join("pipe"))
        .status();
    assert!(made.unwrap().success());
    assert_error(
        folder.path(),
        &["check", "pipe"],
        65,
        &["pipe: found", "regular file"],
    );
    assert_error(
        folder.path(),
        &["check", "scene.toml"],
        65,
        &["scene.toml:6: part.mesh.file", "pipe is not a regular file"],
    );
}

#[test]
fn an_output_folder_that_cannot_be_is_an_input_output_error() {
    let folder = folder_with(&scene(PLANE));
    let path = folder.path();
    fs::write(path.join("file"), "mine").unwrap();
    for command in ["scan", "render"] {
        assert_error(path, &[command, "scene.toml", "-o", "file"], 74, &["file"]);
        assert_error(
            path,
            &[command, "scene.toml", "-o", "file/x"],
            74,
            &["file/x"],
        );
        // Not even root can make a folder there.
        assert_error(
            path,
            &[command, "scene.toml", "-o", "/proc/x"],
            74,
            &["/proc/x"],
        );
    }
    assert_eq!(fs::read(path.join("file")).unwrap(), b"mine");
    // A folder where a file is to be.
    fs::create_dir_all(path.join("out/cloud.ply")).unwrap();
    assert_error(
        path,
        &["scan", "scene.toml", "-o", "out", "--force"],
        74,
        &["out/cloud.ply"],
    );
    fs::create_dir_all(path.join("image/frame-000000.png")).unwrap();
    assert_error(
        path,
        &["render", "scene.toml", "-o", "image", "--force"],
        74,
        &["frame-000000.png"],
    );
}

/// One JSON object and nothing else.
#[track_caller]
fn json(folder: &Path, arguments: &[&str]) -> Value {
    let (code, stdout, stderr) = run(folder, arguments);
    assert_eq!((code, stderr.as_str()), (0, ""), "{arguments:?}");
    let value: Value = serde_json::from_str(&stdout).unwrap();
    assert!(value.is_object());
    value
}

#[test]
fn json_is_one_object_on_stdout_and_stderr_stays_empty() {
    let folder = folder_with(&scene(PLANE));
    let path = folder.path();
    let check = json(path, &["check", "scene.toml", "--json"]);
    assert_eq!(check["mesh"]["triangles"], 2);
    assert_eq!(check["scene"]["seed"], 7);
    let render = json(
        path,
        &["--json", "render", "scene.toml", "--frame", "2", "-o", "r"],
    );
    assert_eq!(
        (&render["frame"], &render["png"]),
        (&2.into(), &"r/frame-000002.png".into())
    );
    assert!(path.join("r/frame-000002.exr").is_file());
    let scan = json(path, &["scan", "scene.toml", "--json", "-o", "s"]);
    assert!(
        scan["deviation"]["points"].as_u64().unwrap() > 100,
        "{scan}"
    );
    let file: Value =
        serde_json::from_slice(&fs::read(path.join("s/summary.json")).unwrap()).unwrap();
    assert_eq!(scan, file);
    let schema = json(path, &["schema", "--json"]);
    assert_eq!(schema["title"], "lasertrace scene");
}

/// Tests have no terminal on stderr, so a bar would show here.
#[test]
fn without_a_terminal_there_is_no_progress_and_the_text_names_the_files() {
    let folder = folder_with(&scene(PLANE));
    let (code, stdout, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "out"]);
    assert_eq!((code, stderr.as_str()), (0, ""));
    for name in ["out/report.html", "out/cloud.ply"] {
        assert!(stdout.contains(name), "{stdout}");
        assert!(folder.path().join(name).is_file());
    }
}

/// A scene whose sensor comes from a file and a data sheet, whose exposure is found, whose mesh, object and line profile
/// are in other folders, and whose seed is the command's.
#[test]
fn a_scan_of_the_resolved_scene_gives_the_same_cloud() {
    let root = env!("CARGO_MANIFEST_DIR");
    let text = "seed = 1\nspeckle = true\nsensor = \"sensors/sensor.toml\"\n\
         [part]\nmesh = { file = \"parts/part.obj\", unit = \"mm\" }\nreflectance = 0.5\n\
         [[object]]\nfile = \"parts/part.obj\"\nunit = \"mm\"\nreflectance = 0.5\nposition_mm = [12, 0, 1]\n\
         [laser]\nline = { fan_deg = 30 }\n\
         [scan]\nframes = 2\nstep_mm = 0.1\ndirection = [0, 1, 0]\n";
    let folder = folder_with(text);
    let path = folder.path();
    fs::create_dir(path.join("sensors")).unwrap();
    let sensor = fs::read_to_string(format!("{root}/sensors/generic-20mm-405nm.toml")).unwrap();
    let sensor = sensor + "\n[laser]\nline = { profile = { file = \"line.csv\" } }\n";
    fs::write(path.join("sensors/sensor.toml"), sensor).unwrap();
    let line = "angle_deg,power,width\n-15,1,1\n15,2,1\n";
    fs::write(path.join("sensors/line.csv"), line).unwrap();
    fs::create_dir(path.join("parts")).unwrap();
    let mesh = "v -8 -8 0\nv 8 -8 1\nv 8 8 0\nv -8 8 0\nf 1 2 3 4\n";
    fs::write(path.join("parts/part.obj"), mesh).unwrap();
    let scan = ["scan", "scene.toml", "--seed", "5", "-o", "out/first"];
    let summary = json(path, &[&scan[..], &["--json"]].concat());
    assert!(summary["points"].as_u64().unwrap() > 100, "{summary}");
    let valid = &summary["valid_fraction"];
    assert!((0.5..=1.0).contains(&valid.as_f64().unwrap()), "{valid}");
    let checked = json(path, &["check", "scene.toml", "--seed", "5", "--json"]);
    assert_eq!(summary["assessment"], checked["assessment"]);
    assert!(summary["assessment"]["light"]["valid"].as_f64().unwrap() > 0.5);
    let read = |name: &str| fs::read_to_string(path.join("out/first").join(name)).unwrap();
    for name in ["resolved-scene.toml", "resolved-sensor.toml"] {
        assert!(read("report.html").contains(&format!("href=\"{name}\"")));
    }
    let sensor = read("resolved-sensor.toml");
    assert!(
        sensor.contains("exposure_ms") && !sensor.contains("auto"),
        "{sensor}"
    );
    assert!(!sensor.contains("data_sheet"), "{sensor}");
    let again = ["scan", "out/first/resolved-scene.toml", "-o", "again"];
    assert_eq!(run(path, &again).0, 0);
    let profiles = |folder: &str| fs::read(path.join(folder).join("profiles.npy")).unwrap();
    assert!(profiles("out/first") == profiles("again"));
}

#[test]
fn another_seed_shows_in_manifest_and_noise_and_the_hash_stays_the_file_s() {
    let folder = folder_with(&scene(PLANE));
    let path = folder.path();
    let manifest = |out: &str, more: &[&str]| -> (Value, Vec<u8>) {
        let arguments = [&["scan", "scene.toml", "-o", out], more].concat();
        assert_eq!(run(path, &arguments).0, 0);
        let read = |name: &str| fs::read(path.join(out).join(name)).unwrap();
        let manifest = serde_json::from_slice(&read("manifest.json")).unwrap();
        (manifest, read("frames/frame-000000.png"))
    };
    let (own, frame) = manifest("a", &[]);
    let (same, same_frame) = manifest("b", &["--seed", "7"]);
    let (other, other_frame) = manifest("c", &["--seed", "18446744073709551615"]);
    assert_eq!(
        (&own["seed"], &same["seed"], &other["seed"]),
        (&7.into(), &7.into(), &u64::MAX.into())
    );
    assert_eq!(own["scene_sha256"], other["scene_sha256"]);
    assert!(frame == same_frame && frame != other_frame);
}

/// A result that is lost is no success.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_behind_stdout_is_temporary() {
    let full = fs::File::options().write(true).open("/dev/full").unwrap();
    let status = std::process::Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .arg("schema")
        .stdout(full)
        .stderr(std::process::Stdio::null())
        .status();
    assert_eq!(
        status.unwrap().code(),
        Some(75),
        "a result that is lost is no success"
    );
}

/// A disk of 64 KiB, unmounted at the end.
#[cfg(target_os = "linux")]
struct SmallDisk(TempDir);

#[cfg(target_os = "linux")]
impl SmallDisk {
    fn mount() -> Option<SmallDisk> {
        let folder = tempfile::tempdir().unwrap();
        let output = std::process::Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=64k", "lasertrace-test"])
            .arg(folder.path())
            .output();
        output
            .is_ok_and(|o| o.status.success())
            .then_some(SmallDisk(folder))
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount")
            .arg(self.0.path())
            .status();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_of_64_kib_fills_up_and_what_is_there_is_whole() {
    let Some(disk) = SmallDisk::mount() else {
        eprintln!("\n*** NOT TESTED: no tmpfs could be mounted, so no disk was filled. ***\n");
        return;
    };
    let folder = folder_with(&scene(PLANE).replace("frames = 3", "frames = 60"));
    let path = folder.path();
    assert_eq!(run(path, &["scan", "scene.toml", "-o", "whole"]).0, 0);
    let out = disk.0.path().join("out");
    let arguments = ["scan", "scene.toml", "-o", out.to_str().unwrap()];
    assert_error(path, &arguments, 75, &["cannot write", "No space left"]);
    assert!(!out.join("manifest.json").exists());
    let images: Vec<_> = fs::read_dir(out.join("frames")).unwrap().collect();
    assert!(!images.is_empty());
    for image in images {
        let name = image.unwrap().file_name();
        let whole = fs::read(path.join("whole/frames").join(&name)).unwrap();
        let found = fs::read(out.join("frames").join(&name)).unwrap();
        assert_eq!(found, whole, "{name:?}");
    }
}

#[test]
fn the_schemas_in_the_project_are_those_the_program_prints() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (file, command) in [
        ("scenes/scene.schema.json", &["schema"][..]),
        ("sensors/sensor.schema.json", &["schema", "--sensor"]),
    ] {
        let kept = fs::read_to_string(root.join(file)).unwrap_or_default();
        let (code, printed, _) = run(root, command);
        assert_eq!(code, 0);
        assert!(
            kept == printed,
            "the format has changed: run\n  cargo run -- {} > {file}",
            command.join(" ")
        );
    }
}

/// A line of 200 counts in row 12 of each column, found by each finder; the same
/// image on its side; and files that are no image.
#[test]
fn a_line_is_found_in_an_image_of_the_users() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let shape = |y: u32| [20, 90, 200, 90, 20][y as usize];
    let line = image::GrayImage::from_fn(40, 30, |_, y| {
        image::Luma([if (10..15).contains(&y) {
            shape(y - 10)
        } else {
            3
        }])
    });
    line.save(path.join("line.png")).unwrap();
    image::imageops::rotate90(&line)
        .save(path.join("side.png"))
        .unwrap();
    for (file, along, row) in [
        ("line.png", "columns", "12.5"),
        ("side.png", "rows", "17.5"),
    ] {
        let arguments = ["peaks", "--image", file, "--line-along", along, "-o", "out"];
        let (code, _, stderr) = run(path, &arguments);
        assert_eq!((code, stderr.as_str()), (0, ""));
        let table = fs::read_to_string(path.join("out/line.csv")).unwrap();
        let rows: Vec<&str> = table.lines().skip(1).collect();
        assert_eq!(rows.len(), 4 * 40, "{table}");
        for line in rows {
            let found = line.split(',').nth(2).unwrap();
            assert!(found.starts_with(row), "{along}: {line}");
        }
    }
    fs::write(path.join("text.png"), "no image").unwrap();
    for (file, code, word) in [
        ("text.png", 65, "expected an image"),
        (".", 65, "found a folder"),
        ("no.png", 74, "cannot read no.png"),
    ] {
        assert_error(path, &["peaks", "--image", file, "-o", "x"], code, &[word]);
    }
    let rows = ["peaks", "--line-along", "rows", "-o", "x"];
    assert_error(path, &rows, 64, &["--image"]);
    assert!(!path.join("x").exists());
}

/// An image of `render` states the bits of its counts, so the line of an overexposed sensor is flagged, and
/// of a well exposed one is not.
#[test]
fn the_saturation_of_a_rendered_image_is_known() {
    for (bits, exposure_ms, flagged) in [
        (10, 0.002, false),
        (12, 0.005, false),
        (10, 1.0, true),
        (12, 1.0, true),
    ] {
        let text = scene(PLANE).replace("bit_depth = 10", &format!("bit_depth = {bits}"));
        let text = text.replace(
            "exposure_ms = 0.01",
            &format!("exposure_ms = {exposure_ms}"),
        );
        let text = text.replace("full_well_e = 50000", "full_well_e = 500000");
        let folder = folder_with(&text);
        let render = ["render", "scene.toml", "--frame", "1", "-o", "out"];
        assert_eq!(run(folder.path(), &render).0, 0);
        let peaks = ["peaks", "--image", "out/frame-000001.png", "-o", "line"];
        assert_eq!(run(folder.path(), &peaks).0, 0);
        let line = fs::read(folder.path().join("line/line.json")).unwrap();
        let line: serde_json::Value = serde_json::from_slice(&line).unwrap();
        assert_eq!(line["saturation_dn"], (1 << bits) - 1);
        let finder = &line["finders"][0];
        assert!(finder["points"].as_u64().unwrap() > 50, "{finder}");
        let table = fs::read_to_string(folder.path().join("line/line.csv")).unwrap();
        let saturated = table
            .lines()
            .filter(|line| line.contains("SATURATED"))
            .count();
        assert_eq!(
            saturated > 4 * 40,
            flagged,
            "{bits} bits, {exposure_ms} ms: {saturated}"
        );
        assert_eq!(
            saturated > 0,
            flagged,
            "{bits} bits, {exposure_ms} ms: {saturated}"
        );
    }
}

/// A choice that is none is refused by name.
#[test]
fn a_wrong_peak_finder_is_named() {
    let text = scene(PLANE) + "[measure]\npeak_estimator = \"parabola\"\n";
    let folder = folder_with(&text);
    let words = ["parabola", "log-parabola"];
    assert_error(folder.path(), &["check", "scene.toml"], 65, &words);
}

/// Who closes the pipe has read enough: no error, and the files are whole.
#[test]
fn a_closed_pipe_is_no_error() {
    let folder = folder_with(&scene(PLANE));
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder.path())
        .args(["scan", "scene.toml", "-o", "out"])
        .stdout(writer)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(output.stderr, b"");
    assert!(folder.path().join("out/manifest.json").exists());
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let status = std::process::Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .args(["check", "no.toml"])
        .stderr(writer)
        .status();
    assert_eq!(status.unwrap().code(), Some(74), "stderr closed");
    let (code, ..) = run(folder.path(), &["check", "scene.toml"]);
    assert_eq!(code, 0);
}

/// Made from the definition of the command line, so that they name every command.
#[test]
fn version_manual_and_completions_name_what_they_should() {
    let folder = folder_with("");
    let print = |arguments: &[&str]| {
        let (code, text, _) = run(folder.path(), arguments);
        assert_eq!(code, 0, "{arguments:?}");
        text
    };
    let version = print(&["--version"]);
    assert!(version.contains(env!("CARGO_PKG_VERSION")), "{version}");
    assert!(version.contains("Embree ") || version.contains("obvhs "));
    for shell in ["bash", "zsh", "fish"] {
        let completions = print(&["completions", shell]);
        assert!(completions.contains("scan") && completions.contains("geometry-only"));
    }
    assert!(print(&["man"]).contains(".TH lasertrace"));
    assert!(print(&["man", "scan"]).contains("resume"));
    assert_error(folder.path(), &["man", "scam"], 64, &["scam"]);
}
