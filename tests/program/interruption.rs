//! A scan that is killed, stopped or run on other threads: no file that looks
//! whole is broken, and running again gives the bytes of an undisturbed run.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{PLANE, folder_with, scene};
use lasertrace::run::{RunControl, ScanOptions, TraceMode};
use lasertrace::scene::Scene;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

fn scan(folder: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lasertrace"));
    command
        .current_dir(folder)
        .args(["scan", "scene.toml", "-o", "out", "--quiet"])
        .args(more)
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    command
}

fn many_frames(frames: u32) -> String {
    let text = scene(PLANE);
    text.replace("frames = 3", &format!("frames = {frames}"))
        .replace("step_mm = 0.5", "step_mm = 0.01")
}

/// Every file below `folder`, by its path in it.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut left = vec![folder.to_owned()];
    while let Some(next) = left.pop() {
        let Ok(entries) = fs::read_dir(&next) else {
            continue;
        };
        for entry in entries {
            let path = entry.unwrap().path();
            if path.is_dir() {
                left.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_str().unwrap();
                found.insert(name.to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// The files of a complete run but for the manifest, which holds timings.
fn results(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = files(out);
    let manifest = found
        .remove("manifest.json")
        .expect("a complete run has a manifest");
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    assert!(manifest["scene_sha256"].is_string());
    // The lists of files that the runs wrote.
    found.retain(|name, _| !name.starts_with(".lasertrace/"));
    cut_times(&mut found);
    found
}

/// Takes the report's last table away, which holds the run's times.
fn cut_times(files: &mut BTreeMap<String, Vec<u8>>) {
    if let Some(report) = files.get_mut("report.html") {
        assert!(is_whole("report.html", report));
        let text = String::from_utf8(std::mem::take(report)).unwrap();
        let (before, _) = text.split_once("<h2>The run</h2>").unwrap();
        *report = format!("{before}</html>\n").into_bytes();
    }
}

/// Names of the files that differ or are in one only.
fn differing(a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>) -> Vec<String> {
    let names = a.keys().chain(b.keys());
    names
        .filter(|name| a.get(*name) != b.get(*name))
        .cloned()
        .collect()
}

/// Whether a file's own format says it is all there.
fn is_whole(name: &str, bytes: &[u8]) -> bool {
    let text = || String::from_utf8_lossy(bytes);
    match name.rsplit('.').next().unwrap() {
        "json" => serde_json::from_slice::<serde_json::Value>(bytes).is_ok(),
        "png" => image::load_from_memory(bytes).is_ok(),
        "html" => text().trim_end().ends_with("</html>"),
        "npy" => {
            let header = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
            let text = String::from_utf8_lossy(&bytes[10..header]).into_owned();
            let points = text.split("'shape': (").nth(1).unwrap();
            let points: usize = points.split(',').next().unwrap().parse().unwrap();
            bytes.len() - header == points * 106
        }
        "ply" => {
            let text = text();
            let vertices = text.split("element vertex ").nth(1).unwrap();
            let vertices: usize = vertices.lines().next().unwrap().parse().unwrap();
            let header = bytes
                .windows(11)
                .position(|w| w == b"end_header\n")
                .unwrap()
                + 11;
            // Three doubles, seven floats, three bytes of colour, three integers.
            bytes.len() - header == vertices * 79
        }
        "toml" => toml::from_str::<toml::Table>(&text()).is_ok(),
        // Its own checksums state how much of it is valid: tests/program/resume.rs.
        "journal" => true,
        other => panic!("{name}: what is a whole .{other} file?"),
    }
}

/// Kills a run after `delay` and says how many files it had written.
fn kill_after(delay: Duration, folder: &Path) -> usize {
    let mut child = scan(folder, &[]).spawn().unwrap();
    sleep(delay);
    // SIGKILL. An error says that the run was over.
    let _ = child.kill();
    child.wait().unwrap();
    files(&folder.join("out")).len()
}

/// The moments are shares of the time an undisturbed run takes, so that they fall
/// into the run on any machine; which they were, the failure says.
#[test]
fn killed_at_any_moment_nothing_looks_whole_that_is_not_and_a_new_run_completes() {
    let text = many_frames(extent(200, 400));
    let undisturbed = folder_with(&text);
    let start = Instant::now();
    assert!(scan(undisturbed.path(), &[]).status().unwrap().success());
    let whole_run = start.elapsed();
    let expected = results(&undisturbed.path().join("out"));
    assert_eq!(
        expected.len(),
        extent(200, 400) + 9,
        "frames, profiles, cloud, summary, report, journal, 2 pictures, resolved scene and sensor"
    );
    for (name, bytes) in &expected {
        assert!(is_whole(name, bytes), "{name}");
    }

    let folder = folder_with(&text);
    let out = folder.path().join("out");
    let mut state = 20_240_607u64;
    let mut counts = Vec::new();
    let in_the_midst = |counts: &[usize]| {
        let midst = |n: &&usize| (1..expected.len()).contains(*n);
        counts.iter().filter(midst).count()
    };
    // Six or twelve kills, and more where a run goes faster or slower than the first and
    // fewer than four or eight fall into it.
    let kills = extent(6, 12);
    for kill in 0..5 * kills {
        if kill >= kills && in_the_midst(&counts) >= kills * 2 / 3 {
            break;
        }
        // Knuth's MMIX generator; one kill in each equal part of the run.
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        let part = (kill % kills) as f64 + (state >> 11) as f64 / 2f64.powi(53);
        let share = part / kills as f64;
        counts.push(kill_after(whole_run.mul_f64(share), folder.path()));
        let mut left = files(&out);
        let complete = left.remove("manifest.json").is_some();
        let unfinished = |name: &str| name.ends_with(".part") || name == "frames.journal";
        left.retain(|name, _| !unfinished(name) && !name.starts_with(".lasertrace/"));
        cut_times(&mut left);
        for (name, bytes) in &left {
            assert!(
                expected.get(name) == Some(bytes),
                "after {share:.3} of the run {name} is broken"
            );
        }
        assert!(
            !complete || left.len() == expected.len() - 1,
            "{share:.3}: a manifest, but not all files"
        );
    }
    println!("tried {} kills", counts.len());
    assert!(
        in_the_midst(&counts) >= kills * 2 / 3,
        "too few kills fell into the run: {counts:?}"
    );

    assert!(scan(folder.path(), &[]).status().unwrap().success());
    assert_eq!(
        differing(&results(&out), &expected),
        [""; 0],
        "after a run to the end"
    );
}

fn signal(child: &Child, name: &str) {
    // The shell's own: a small system has no kill program.
    let kill = format!("kill {name} {}", child.id());
    assert!(
        Command::new("sh")
            .args(["-c", &kill])
            .status()
            .unwrap()
            .success()
    );
}

/// Starts a run far too long to end, waits for its first profile, sends the signal
/// and waits for the end, a minute at most.
fn interrupt(folder: &Path, name: &str) -> Output {
    let mut child = scan(folder, &[]).spawn().unwrap();
    let start = Instant::now();
    while !folder.join("out/frames/frame-000000.png").exists() {
        assert!(
            start.elapsed() < Duration::from_secs(60),
            "no profile after a minute"
        );
        sleep(Duration::from_millis(5));
    }
    signal(&child, name);
    while child.try_wait().unwrap().is_none() {
        if start.elapsed() > Duration::from_secs(60) {
            let _ = child.kill();
            panic!("{name} did not stop the run");
        }
        sleep(Duration::from_millis(5));
    }
    child.wait_with_output().unwrap()
}

#[test]
fn interrupted_or_terminated_it_says_how_to_go_on() {
    for name in ["-INT", "-TERM"] {
        let folder = folder_with(&many_frames(1_000_000));
        let output = interrupt(folder.path(), name);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(75), "{name}: {stderr}");
        assert!(
            stderr.contains("run the same command with --resume to go on"),
            "{name}: {stderr}"
        );
        let left = files(&folder.path().join("out"));
        assert!(
            left.keys().all(|name| !name.ends_with(".part")),
            "a stop is orderly"
        );
        assert!(!left.contains_key("manifest.json"));
        assert!(left.iter().all(|(name, bytes)| is_whole(name, bytes)));
    }
}

#[test]
fn one_thread_and_four_write_the_same_bytes() {
    // Speckle and noise too must not depend on who computes them.
    let text = many_frames(12).replace("speckle = false", "speckle = true");
    let run = |threads: &str| {
        let folder = folder_with(&text);
        assert!(
            scan(folder.path(), &["--threads", threads])
                .status()
                .unwrap()
                .success()
        );
        results(&folder.path().join("out"))
    };
    let one = run("1");
    assert!(one.len() > 12);
    for threads in ["2", "4"] {
        assert_eq!(
            differing(&run(threads), &one),
            [""; 0],
            "{threads} threads against one"
        );
    }
}

#[test]
fn a_shorter_scan_leaves_nothing_of_a_longer_one_behind() {
    let folder = folder_with(&many_frames(9));
    assert!(scan(folder.path(), &[]).status().unwrap().success());
    let shorter = many_frames(4).replace("save_images = true", "save_images = false");
    fs::write(folder.path().join("scene.toml"), &shorter).unwrap();
    assert!(scan(folder.path(), &[]).status().unwrap().success());
    let fresh = folder_with(&shorter);
    assert!(scan(fresh.path(), &[]).status().unwrap().success());
    let results = |folder: &Path| results(&folder.join("out"));
    assert_eq!(
        differing(&results(folder.path()), &results(fresh.path())),
        [""; 0]
    );
}

/// A stop that comes with the last frame falls into the report: it ends there, in
/// order, and no frame is lost.
#[test]
fn a_stop_in_the_report_is_heard() {
    let folder = folder_with(&many_frames(5));
    let scene = Scene::load(&folder.path().join("scene.toml")).unwrap();
    let out = folder.path().join("out");
    let run = |last: u64, resume| {
        let stop = AtomicBool::new(false);
        let control = RunControl {
            progress: &|done| stop.store(done == last, Ordering::Relaxed),
            setup_progress: None,
            notice: None,
            stop: &stop,
        };
        let options = ScanOptions {
            strict: false,
            coverage: TraceMode::Footprint,
            frames: None,
            resume,
            geometry_only: false,
            also: Vec::new(),
        };
        lasertrace::run::scan(&scene, &options, &out, &control).map(|summary| summary.frames)
    };
    assert_eq!(run(5, false).unwrap_err().exit_code(), 75);
    assert!(!out.join("manifest.json").exists() && !out.join("report.html").exists());
    assert_eq!(run(u64::MAX, true).unwrap(), 5);
    let manifest = fs::read(out.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["frames_resumed"], 5);
}
