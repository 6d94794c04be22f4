//! Sweeps: the same bytes for any number of threads, shards and kills; what a scene refuses is a row; figures are
//! those of a scan.

#![cfg(unix)]

use crate::program::{PLANE, assert_error, folder_with, run, scene};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;
use tempfile::TempDir;

/// Twelve places, of which three have a lens that there is not.
const SWEEP: &str = r#"scene = "scene.toml"
[grid]
"camera.f_number" = [6, 8, 11, -8]
"laser.power_mw" = { from = 5, to = 20, count = 3, scale = "log" }
"#;

fn sweep_folder(sweep: &str) -> TempDir {
    let folder = folder_with(&scene(PLANE).replace("speckle = false", "speckle = true"));
    fs::write(folder.path().join("sweep.toml"), sweep).unwrap();
    folder
}

fn swept(folder: &Path, more: &[&str]) -> (i32, String, String) {
    let arguments = ["--quiet", "sweep", "sweep.toml", "-o", "out"];
    run(folder, &[&arguments, more].concat())
}

fn results(folder: &Path) -> [Vec<u8>; 2] {
    ["sweep.csv", "sweep.svg"].map(|name| fs::read(folder.join("out").join(name)).unwrap())
}

/// The table's rows by column.
fn table(folder: &Path) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(folder.join("out/sweep.csv")).unwrap();
    reader.deserialize().map(|row| row.unwrap()).collect()
}

fn journals(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder.join("out/places")).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort_by_key(|path| fs::metadata(path).unwrap().len());
    paths
}

#[test]
fn threads_shards_kills_and_damage_change_no_byte() {
    let whole = sweep_folder(SWEEP);
    let (code, said, stderr) = swept(whole.path(), &["--threads", "1"]);
    assert!(
        code == 0 && said.contains("12 runs, 12 of them simulated now, 3 refused"),
        "{said}{stderr}"
    );
    let expected = results(whole.path());

    let folder = sweep_folder(SWEEP);
    let out = folder.path().join("out");
    // One is killed when it has a place or more.
    let mut killed = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder.path())
        .args([
            "--quiet",
            "sweep",
            "sweep.toml",
            "-o",
            "out",
            "--threads",
            "1",
        ])
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let some = || {
        let entries = fs::read_dir(out.join("places")).into_iter().flatten();
        let mut lengths = entries.map(|entry| entry.unwrap().metadata().unwrap().len());
        lengths.any(|length| length > 500)
    };
    while !some() && killed.try_wait().unwrap().is_none() {
        sleep(Duration::from_millis(1));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    for shard in ["1/3", "0/3", "1/3"] {
        let (code, said, stderr) = swept(folder.path(), &["--shard", shard, "--threads", "2"]);
        assert_eq!(code, 0, "{stderr}");
        assert!(
            said.contains("--merge") || out.join("sweep.csv").exists(),
            "{said}"
        );
    }
    let (code, _, stderr) = swept(folder.path(), &["--shard", "2/3"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(results(folder.path()) == expected);
    // A bit of one journal turns and another loses its end.
    let paths = journals(folder.path());
    let last = paths.last().unwrap();
    let mut bytes = fs::read(last).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(last, bytes).unwrap();
    let first = paths.iter().rev().nth(1).unwrap();
    let bytes = fs::read(first).unwrap();
    fs::write(first, &bytes[..bytes.len() - 1]).unwrap();
    let (code, _, stderr) = swept(folder.path(), &["--merge"]);
    assert!(
        code == 65 && stderr.contains("of 12 runs missing"),
        "{stderr}"
    );
    let (_, said, _) = swept(folder.path(), &[]);
    assert!(!said.contains(" 0 of them simulated now"), "{said}");
    assert!(results(folder.path()) == expected);
    // Nothing is left to do, and the table is written again.
    fs::remove_file(out.join("sweep.csv")).unwrap();
    let (code, said, _) = swept(folder.path(), &["--merge"]);
    assert!(
        code == 0 && said.contains("0 of them simulated now"),
        "{said}"
    );
    assert!(results(folder.path()) == expected);
}

#[test]
fn missing_shards_are_named_and_other_sweeps_refused() {
    let folder = sweep_folder(SWEEP);
    for shard in ["1/8", "6/8"] {
        let (code, said, stderr) = swept(folder.path(), &["--shard", shard]);
        assert!(code == 0 && said.contains("--merge"), "{stderr}");
    }
    let (code, _, stderr) = swept(folder.path(), &["--merge"]);
    assert!(
        code == 65 && stderr.contains("9 of 12 runs missing"),
        "{stderr}"
    );
    assert!(stderr.contains("shards of 8"), "{stderr}");
    assert!(stderr.trim_end().ends_with("--array=0,2-5,7"), "{stderr}");
    assert!(!folder.path().join("out/sweep.csv").exists());
    let both = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder.path())
        .args(["sweep", "sweep.toml", "-o", "out", "--shard", "auto/8"])
        .envs([("SLURM_ARRAY_TASK_ID", "1"), ("JOB_COMPLETION_INDEX", "1")])
        .output()
        .unwrap();
    assert_eq!(both.status.code(), Some(64));
    fs::write(folder.path().join("sweep.toml"), SWEEP.replace("20", "21")).unwrap();
    let (code, _, stderr) = swept(folder.path(), &[]);
    assert!(
        code == 64 && stderr.contains("is of another run"),
        "{stderr}"
    );
}

/// Every figure of a place is that of a scan of the scene with the place's values, to the bit.
#[test]
fn figures_are_those_of_a_scan() {
    let folder = sweep_folder(SWEEP);
    let plots = [
        "--plot",
        "points:laser.power_mw",
        "--plot",
        "deviation.std_um:points",
    ];
    let (code, _, stderr) = swept(folder.path(), &plots);
    assert_eq!(code, 0, "{stderr}");
    let rows = table(folder.path());
    assert_eq!(rows.len(), 12);
    let row = &rows[5];
    assert_eq!(
        [&row["camera.f_number"], &row["laser.power_mw"]],
        ["8", "20"]
    );
    let text = fs::read_to_string(folder.path().join("scene.toml")).unwrap();
    fs::write(
        folder.path().join("one.toml"),
        text.replace("power_mw = 10", "power_mw = 20"),
    )
    .unwrap();
    let (code, _, stderr) = run(folder.path(), &["scan", "one.toml", "-o", "one"]);
    assert_eq!(code, 0, "{stderr}");
    let summary = fs::read(folder.path().join("one/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
    for (column, pointer) in [
        ("points", "/points"),
        ("deviation.std_um", "/deviation/std_um"),
        (
            "deviation.percentiles_um.99",
            "/deviation/percentiles_um/6/1",
        ),
        (
            "uncertainty.median_sigma_um",
            "/uncertainty/median_sigma_um",
        ),
        ("coverage.shares.measured", "/coverage/shares/0/1"),
        ("flags.discontinuity", "/flags/discontinuity"),
    ] {
        let expected = summary.pointer(pointer).unwrap().as_f64().unwrap();
        assert_eq!(row[column].parse::<f64>().unwrap(), expected, "{column}");
    }
    for row in &rows[9..] {
        assert_eq!(row["result"], "error");
        assert_eq!(
            row["message"],
            "camera.f_number: found -8, expected a finite number > 0"
        );
        assert_eq!(row["points"], "");
    }
    let (code, _, stderr) = swept(folder.path(), &["--plot", "point:laser.power_mw"]);
    assert!(
        code == 64 && stderr.contains("no point to plot"),
        "{stderr}"
    );
}

/// The part changes too: the area of a plane is the product of its sides.
#[test]
fn parts_lists_and_draws_are_swept() {
    let text = r#"scene = "scene.toml"
frames = "1..2"
samples = 2
seed = 3
[grid]
"part.plane.size_mm" = [[16, 16], [8, 4], [-1, 4]]
[[cases]]
"camera.f_number" = 8
"laser.power_mw" = 10
[[cases]]
"camera.f_number" = 16
"laser.power_mw" = 20
[sample]
"part.position_mm" = { from = [-1, -1, -0.1], to = [1, 1, 0.1] }
"#;
    let folder = sweep_folder(text);
    let (code, said, stderr) = swept(folder.path(), &[]);
    assert!(code == 0 && said.contains("12 runs"), "{stderr}");
    let rows = table(folder.path());
    for (k, row) in rows.iter().enumerate() {
        assert_eq!(row["run"], k.to_string());
        let lens = ["8", "16"][k / 2 % 2];
        assert_eq!(row["camera.f_number"], lens);
        // The same draws for all that they go with.
        assert_eq!(row["part.position_mm"], rows[k % 2]["part.position_mm"]);
        match k / 4 {
            2 => assert!(
                row["message"].contains("part.plane.size_mm"),
                "{}",
                row["message"]
            ),
            size => {
                let area: f64 = row["coverage.area_mm2"].parse().unwrap();
                assert!((area - [256.0, 32.0][size]).abs() < 1e-9, "{area}");
                assert_eq!(row["frames"], "1");
            }
        }
    }
    assert_ne!(rows[0]["part.position_mm"], rows[1]["part.position_mm"]);
    // A sweep of nothing that works is an error, and its table says why.
    let none = "scene = \"scene.toml\"\n[grid]\n\"camera.fnumber\" = [1, 2]\n";
    fs::write(folder.path().join("none.toml"), none).unwrap();
    let arguments = ["sweep", "none.toml", "-o", "none"];
    let words = [
        "all of them refused",
        "camera.fnumber",
        "did you mean f_number?",
    ];
    assert_error(folder.path(), &arguments, 65, &words);
    assert!(folder.path().join("none/sweep.csv").exists());
}

#[test]
fn a_wrong_sweep_is_refused_with_line_key_found_and_expected() {
    let folder = sweep_folder("");
    for (lines, words) in [
        ("", "sweep.toml: grid: found nothing to vary"),
        (
            "[grid]\nx = 3",
            "sweep.toml:3: x: found 3, expected a list of values",
        ),
        (
            "[grid]\nx = []",
            "sweep.toml:3: x: found [], expected a list",
        ),
        (
            "[grid]\nx = { from = 3, to = 1, count = 2 }",
            "expected from below to",
        ),
        (
            "[grid]\nx = { from = 0, to = 1, count = 2, scale = \"log\" }",
            "above 0 for scale",
        ),
        (
            "[grid]\nx = { from = 0, to = 1, step = 2 }",
            "expected a list of values",
        ),
        (
            "[grid]\nx = [1]\n[sample]\nx = { choice = [1] }",
            "samples: found none",
        ),
        (
            "samples = 3\n[grid]\nx = [1]",
            "samples: found samples without [sample]",
        ),
        (
            "samples = 3\n[grid]\nx = [1]\n[sample]\nx = { choice = [1] }",
            "x: found it twice",
        ),
        (
            "[[cases]]\na = 1\n[[cases]]\nb = 1",
            "sweep.toml:4: cases: found other keys",
        ),
        (
            "frames = \"3\"\n[grid]\nx = [1]",
            "sweep.toml:2: frames: found \"3\", expected two frame numbers",
        ),
        (
            "samples = 9000000\n[sample]\nx = { choice = [1] }",
            "found 9000000 runs, expected from 1 to 1e6 runs",
        ),
        (
            "[gird]\nx = [1]",
            "sweep.toml:2: found unknown field `gird`",
        ),
    ] {
        fs::write(
            folder.path().join("sweep.toml"),
            format!("scene = \"scene.toml\"\n{lines}\n"),
        )
        .unwrap();
        assert_error(
            folder.path(),
            &["sweep", "sweep.toml", "-o", "out"],
            65,
            &[words],
        );
    }
    assert!(!folder.path().join("out").exists());
}

/// The expanded uncertainty of a feature is a column of a sweep, for any key of the scene. Its values
/// are those of scans.
#[test]
fn the_uncertainty_of_a_feature_is_a_column() {
    let sweep = "scene = \"scene.toml\"\n[grid]\n\"camera.f_number\" = [6, 9]\n\"scan.step_mm\" = [0.3, 0.5]\n";
    let folder = sweep_folder(sweep);
    let file = folder.path().join("scene.toml");
    let features = "[[feature]]\nname = \"face\"\nkind = \"plane\"\npoint_mm = [0, 0, 0]\n\
                    tolerance = { offset_mm = [-0.01, 0.01] }\n";
    let text = fs::read_to_string(&file).unwrap() + features;
    fs::write(&file, text).unwrap();
    let (code, _, stderr) = swept(folder.path(), &[]);
    assert_eq!(code, 0, "{stderr}");
    let column = "features.face.quantities.offset_mm.expanded_uncertainty";
    let rows = table(folder.path());
    let u = |row: &BTreeMap<String, String>| row[column].parse::<f64>().unwrap();
    assert_eq!(rows.len(), 4);
    for row in &rows {
        assert!(u(row) > 0.0, "{row:?}");
        let text = fs::read_to_string(&file).unwrap();
        let f_number = format!("f_number = {}\n", row["camera.f_number"]);
        let text = text.replace("f_number = 8\n", &f_number);
        let step = format!("step_mm = {}\n", row["scan.step_mm"]);
        fs::write(
            folder.path().join("one.toml"),
            text.replace("step_mm = 0.5\n", &step),
        )
        .unwrap();
        let scan = ["scan", "one.toml", "--json", "--force", "-o", "one"];
        let (code, json, stderr) = run(folder.path(), &scan);
        assert_eq!(code, 0, "{stderr}");
        let summary: serde_json::Value = serde_json::from_str(&json).unwrap();
        let q = &summary["features"][0]["quantities"][0];
        assert_eq!(q["expanded_uncertainty"].as_f64(), Some(u(row)), "{row:?}");
    }
}
