//! A scan in shards: killed, run twice, damaged and missing, and merged: the bytes of an undivided scan, or an
//! error that says which shards are to run again.

#![cfg(unix)]

use crate::program::{PLANE, folder_with, scene};
use crate::random::Random;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;
use tempfile::TempDir;

const FRAMES: u32 = 45;

fn scene_text() -> String {
    let text = scene(PLANE);
    let text = text.replace("frames = 3", &format!("frames = {FRAMES}"));
    text.replace("step_mm = 0.5", "step_mm = 0.01")
}

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lasertrace"));
    command.current_dir(folder).arg("--quiet").args(arguments);
    for name in [
        "SLURM_ARRAY_TASK_ID",
        "JOB_COMPLETION_INDEX",
        "AWS_BATCH_JOB_ARRAY_INDEX",
    ] {
        command.env_remove(name);
    }
    command
}

/// Exit code, stdout and stderr.
fn run(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    said(command(folder, arguments))
}

fn said(mut command: Command) -> (i32, String, String) {
    let output = command.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    let code = output.status.code().unwrap();
    (code, text(output.stdout), text(output.stderr))
}

fn shard(folder: &Path, shard: &str) -> (i32, String, String) {
    run(
        folder,
        &["scan", "scene.toml", "-o", "out", "--shard", shard],
    )
}

/// The same, running, on one thread.
fn started(folder: &Path, shard: &str) -> Child {
    let arguments = ["scan", "scene.toml", "-o", "out", "--shard", shard];
    let mut command = command(folder, &arguments);
    command.args(["--threads", "1"]);
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().unwrap()
}

fn undivided() -> TempDir {
    let folder = folder_with(&scene_text());
    let (code, _, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    folder
}

fn merge(folder: &Path) -> (i32, String, String) {
    run(folder, &["merge", "scene.toml", "-o", "out"])
}

/// The files below `out`, without what tells of the run and not of its frames: the manifest, the report's
/// last table, and the shards' own journals.
fn results(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let out = folder.join("out");
    let mut found = BTreeMap::new();
    for below in ["", "frames"] {
        for entry in fs::read_dir(out.join(below)).unwrap() {
            let path = entry.unwrap().path();
            if path.is_file() {
                let name = path.strip_prefix(&out).unwrap().to_str().unwrap();
                found.insert(name.to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found.remove("manifest.json").expect("a complete run");
    let report = found.get_mut("report.html").unwrap();
    let text = String::from_utf8(std::mem::take(report)).unwrap();
    let (before, _) = text.split_once("<h2>The run</h2>").unwrap();
    *report = before.as_bytes().to_vec();
    found
}

fn assert_same(folder: &Path, undivided: &Path, what: &str) {
    let (found, expected) = (results(folder), results(undivided));
    let names = found.keys().chain(expected.keys());
    let differing: Vec<&String> = names
        .filter(|name| found.get(*name) != expected.get(*name))
        .collect();
    assert!(differing.is_empty(), "{what}: {differing:?}");
}

#[test]
fn shards_give_the_bytes_of_an_undivided_scan() {
    let undivided = undivided();
    for of in [1, 3] {
        let folder = folder_with(&scene_text());
        for i in 0..of {
            let (code, said, stderr) = shard(folder.path(), &format!("{i}/{of}"));
            assert!(code == 0 && said.contains("lasertrace merge"), "{stderr}");
        }
        assert_eq!(merge(folder.path()).0, 0);
        assert_same(folder.path(), undivided.path(), &format!("{of} shards"));
    }
}

/// For random tolerances, all shards choose the rung of the undivided scan, on any number of threads.
/// The manifest states the rung in the plan and in the key.
#[test]
fn shards_of_a_scene_with_a_tolerance_use_one_rung() {
    let random = &mut Random::new(451);
    let mut rungs = BTreeSet::new();
    for range in [(1.0, 5.0), (20.0, 50.0), (300.0, 1000.0)] {
        let tolerance = random.scale(range.0, range.1);
        // Few frames have few pilot parts, which takes less time.
        let text = scene_text().replace(&format!("frames = {FRAMES}"), "frames = 6");
        let text = format!("{text}[accuracy]\nmax_height_error_um = {tolerance}\n");
        let [undivided, divided] = [(); 2].map(|()| folder_with(&text));
        let complete = |arguments: &[&str]| {
            let (code, _, stderr) = run(divided.path(), arguments);
            assert_eq!(code, 0, "{tolerance}: {stderr}");
        };
        let scan = ["scan", "scene.toml", "-o", "out"];
        assert_eq!(run(undivided.path(), &scan).0, 0);
        for (shard, threads) in [("0/2", "1"), ("1/2", "3")] {
            complete(&[&scan[..], &["--shard", shard, "--threads", threads]].concat());
        }
        complete(&["merge", "scene.toml", "-o", "out"]);
        assert_same(divided.path(), undivided.path(), &format!("{tolerance} µm"));
        let manifest = fs::read(divided.path().join("out/manifest.json")).unwrap();
        let manifest: Value = serde_json::from_slice(&manifest).unwrap();
        let rung = manifest["rung"].as_str().unwrap();
        assert_eq!(manifest["plan"]["accuracy"]["rung"], rung);
        rungs.insert(rung.to_owned());
    }
    assert!(rungs.len() > 1, "{rungs:?}");
}

#[test]
fn shards_killed_run_twice_damaged_and_lost_give_the_bytes_of_an_undivided_scan() {
    let undivided = undivided();
    let folder = folder_with(&scene_text());
    let out = folder.path().join("out");
    // 6 is killed while it works.
    let mut killed = started(folder.path(), "6/8");
    while !out.join("frames/frame-000006.png").exists() && killed.try_wait().unwrap().is_none() {
        sleep(Duration::from_millis(1));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    // 2 runs three times, twice at once.
    let both = [(); 2].map(|()| started(folder.path(), "2/8"));
    for mut one in both {
        assert!(one.wait().unwrap().success());
    }
    assert!(
        shard(folder.path(), "2/8")
            .1
            .contains("6 frames were there")
    );
    for i in [0, 1, 3, 4, 5] {
        assert_eq!(shard(folder.path(), &format!("{i}/8")).0, 0);
    }
    let journal = |i: u32| out.join(format!("shards/shard-{i}-of-8.journal"));
    let damage = |i: u32, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = fs::read(journal(i)).unwrap();
        change(&mut bytes);
        fs::write(journal(i), bytes).unwrap();
    };
    // On a machine that stopped the killer for long, 6 has come to its end.
    let _ = fs::remove_file(journal(6));
    // A bit of 4's journal turns, and 5's loses its end.
    damage(4, &|bytes| {
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
    });
    damage(5, &|bytes| bytes.truncate(bytes.len() - 1));
    fs::remove_file(journal(1)).unwrap();
    let (code, _, stderr) = merge(folder.path());
    assert_eq!(code, 65, "{stderr}");
    assert!(
        stderr.contains("5 of 8 shards missing or damaged"),
        "{stderr}"
    );
    assert!(stderr.trim_end().ends_with("--array=1,4-7"), "{stderr}");
    for i in [1, 4, 5, 6, 7] {
        let (code, _, stderr) = shard(folder.path(), &format!("{i}/8"));
        assert_eq!(code, 0, "{stderr}");
    }
    // Frames' files that are lost or damaged are made again.
    fs::remove_file(out.join("frames/frame-000009.png")).unwrap();
    fs::write(out.join("frames/frame-000010.png"), "no picture").unwrap();
    for what in ["merged", "merged again"] {
        let (code, _, stderr) = merge(folder.path());
        assert_eq!(code, 0, "{stderr}");
        assert_same(folder.path(), undivided.path(), what);
    }
}

/// Which shards are missing follows from the journals that are there, however many there are to be.
#[test]
fn missing_shards_of_millions_are_named() {
    for (shards, of, array) in [
        (&[0_u32][..], 20_000_000_u32, "1-19999999"),
        (&[7, 19_999_998], 20_000_000, "0-6,8-19999997,19999999"),
        (&[4_294_967_294], u32::MAX, "0-4294967293"),
    ] {
        let folder = folder_with(&scene_text());
        for i in shards {
            let (code, _, stderr) = shard(folder.path(), &format!("{i}/{of}"));
            assert_eq!(code, 0, "{stderr}");
        }
        // Names that no shard has do not count.
        for name in [
            "shard-1-of-3.journal.mine",
            "shard-x-of-2.journal",
            "5.journal",
        ] {
            fs::write(folder.path().join("out/shards").join(name), "mine").unwrap();
        }
        let (code, _, stderr) = merge(folder.path());
        assert_eq!(code, 65, "{stderr}");
        assert!(
            stderr.trim_end().ends_with(&format!("--array={array}")),
            "{stderr}"
        );
    }
}

#[test]
fn shards_of_other_runs_and_numbers_are_refused() {
    let folder = folder_with(&scene_text());
    for (number, words) in [
        ("8/8", "I below N"),
        ("0/0", "I below N"),
        ("3", "I/N"),
        ("1/x", "I/N"),
        ("auto/8", "SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX"),
    ] {
        let (code, _, stderr) = shard(folder.path(), number);
        assert!(code == 64 && stderr.contains(words), "{number}: {stderr}");
    }
    let with = |set: &[(&str, &str)], number: &str| {
        let arguments = ["scan", "scene.toml", "-o", "out", "--shard", number];
        let mut command = command(folder.path(), &arguments);
        command.envs(set.iter().copied());
        said(command)
    };
    let slurm = ("SLURM_ARRAY_TASK_ID", "1");
    let (code, _, stderr) = with(&[slurm, ("JOB_COMPLETION_INDEX", "1")], "auto/2");
    assert!(
        code == 64 && stderr.contains("and JOB_COMPLETION_INDEX"),
        "{stderr}"
    );
    let (code, _, stderr) = with(&[("SLURM_ARRAY_TASK_ID", "x")], "auto/2");
    assert!(
        code == 64 && stderr.contains("SLURM_ARRAY_TASK_ID=x"),
        "{stderr}"
    );
    let (code, said, stderr) = with(&[slurm], "auto/2");
    assert!(code == 0 && said.contains("shard 1 of 2"), "{stderr}");

    let (code, _, stderr) = merge(folder.path());
    assert!(code == 65 && stderr.contains("--array=0\n"), "{stderr}");
    // Of another seed, and of another division.
    let other = [
        "scan",
        "scene.toml",
        "-o",
        "out",
        "--shard",
        "1/2",
        "--seed",
        "9",
    ];
    let (code, _, stderr) = run(folder.path(), &other);
    assert!(code == 64 && stderr.contains("seed was"), "{stderr}");
    assert_eq!(shard(folder.path(), "0/3").0, 0);
    let (code, _, stderr) = merge(folder.path());
    assert!(
        code == 65 && stderr.contains("shards of 2 and of 3"),
        "{stderr}"
    );
    let empty = folder_with(&scene_text());
    let (code, _, stderr) = merge(empty.path());
    assert!(
        code == 65 && stderr.contains("no finished shard"),
        "{stderr}"
    );
}

/// What is not whole has no name that counts.
#[test]
fn a_full_disk_leaves_no_shard() {
    let folder = folder_with(&scene_text());
    let mut limited = Command::new("sh");
    let program = env!("CARGO_BIN_EXE_lasertrace");
    let line = format!("ulimit -f 8; exec {program} --quiet scan scene.toml -o out --shard 0/2");
    limited.current_dir(folder.path()).args(["-c", &line]);
    let (code, _, stderr) = said(limited);
    assert_eq!(code, 75, "{stderr}");
    assert_eq!(
        fs::read_dir(folder.path().join("out/shards"))
            .unwrap()
            .count(),
        0
    );
    assert_eq!(merge(folder.path()).0, 65);
}
