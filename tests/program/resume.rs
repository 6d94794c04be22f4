//! A scan that is killed, fills its disk, is damaged or disturbed, and then resumed:
//! the bytes of an undisturbed run, or a refusal that says why.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{PLANE, assert_error, folder_with, scene};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

fn with_frames(frames: u32) -> String {
    let text = scene(PLANE);
    text.replace("frames = 3", &format!("frames = {frames}"))
        .replace("step_mm = 0.5", "step_mm = 0.01")
}

fn start(folder: &Path, more: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder)
        .args(["scan", "scene.toml", "-o", "out", "--quiet"])
        .args(more)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

#[track_caller]
fn finish(folder: &Path, more: &[&str]) {
    let output = start(folder, more).wait_with_output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{more:?}: {stderr}");
}

/// Every file below `folder`, by its path in it.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut left = vec![folder.to_owned()];
    while let Some(next) = left.pop() {
        for entry in fs::read_dir(&next).into_iter().flatten() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => left.push(path),
                false => {
                    let name = path.strip_prefix(folder).unwrap().to_str().unwrap();
                    // The lists of files that runs wrote are no results.
                    if !name.contains(".lasertrace/") {
                        found.insert(name.to_owned(), fs::read(&path).unwrap());
                    }
                }
            }
        }
    }
    found
}

/// The files of a complete run without the manifest, which holds timings, and how
/// many frames the manifest says were kept.
#[track_caller]
fn results(folder: &Path) -> (BTreeMap<String, Vec<u8>>, u64) {
    let mut found = files(&folder.join("out"));
    let manifest = found.remove("manifest.json").expect("a complete run");
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    // The report's last table holds the run's times.
    if let Some(report) = found.get_mut("report.html") {
        let text = String::from_utf8(std::mem::take(report)).unwrap();
        let (before, _) = text.split_once("<h2>The run</h2>").unwrap();
        *report = format!("{before}</html>\n").into_bytes();
    }
    (found, manifest["frames_resumed"].as_u64().unwrap())
}

#[track_caller]
fn assert_same(folder: &Path, expected: &BTreeMap<String, Vec<u8>>, what: &str) -> u64 {
    let (found, kept) = results(folder);
    let names: Vec<&String> = found
        .keys()
        .chain(expected.keys())
        .filter(|name| found.get(*name) != expected.get(*name))
        .collect();
    assert!(names.is_empty(), "{what}: differing {names:?}");
    kept
}

/// A complete run of a scene in a new folder.
fn complete(text: &str) -> (tempfile::TempDir, BTreeMap<String, Vec<u8>>) {
    let folder = folder_with(text);
    finish(folder.path(), &[]);
    let (expected, kept) = results(folder.path());
    assert_eq!(kept, 0);
    (folder, expected)
}

/// Knuth's MMIX generator: a number from 0 to 1.
fn drawn(state: &mut u64) -> f64 {
    *state = state
        .wrapping_mul(6_364_136_223_846_793_005)
        .wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / 2f64.powi(53)
}

/// Resumes a run and kills it: where `share` is below 0.1 within 50 ms of its
/// start, above 0.9 within 50 ms of its last frame, else when that share of the
/// frames it found missing are there. Whether it was still at work.
fn kill(folder: &Path, frames: usize, share: f64, moment: f64) -> bool {
    let images = folder.join("out/frames");
    let count = || fs::read_dir(&images).map_or(0, |entries| entries.count());
    let before = count();
    let of_rest = ((share - 0.1) / 0.8).min(1.0);
    let target = before + ((frames - before.min(frames)) as f64 * of_rest) as usize;
    let mut child = start(folder, &["--resume"]);
    while share >= 0.1 && count() < target && child.try_wait().unwrap().is_none() {
        sleep(Duration::from_millis(1));
    }
    if !(0.1..=0.9).contains(&share) {
        sleep(Duration::from_secs_f64(0.05 * moment));
    }
    let at_work = child.try_wait().unwrap().is_none();
    // SIGKILL. An error says that the run is over.
    let _ = child.kill();
    child.wait().unwrap();
    at_work
}

/// Kills of runs at work at moments drawn over their whole way, in chains of four on
/// one folder; each chain is then resumed to its end.
#[test]
fn killed_at_any_moment_and_resumed_the_bytes_equal_an_undisturbed_run() {
    const FRAMES: u32 = 300;
    let wanted = extent(16, 48);
    let text = with_frames(FRAMES);
    let (_undisturbed, expected) = complete(&text);
    let mut state = 20_261_121;
    let (mut kills, mut kept) = (0, 0);
    for chain in 0.. {
        assert!(chain < wanted, "only {kills} kills met a run at work");
        if kills >= wanted {
            break;
        }
        let folder = folder_with(&text);
        for _ in 0..4 {
            let (share, moment) = (drawn(&mut state), drawn(&mut state));
            kills += kill(folder.path(), FRAMES as usize, share, moment) as u32;
            for (name, bytes) in files(&folder.path().join("out")) {
                let growing = ["frames.journal", "manifest.json"].contains(&&name[..]);
                let whole = growing || name.ends_with(".part") || expected[&name] == bytes;
                assert!(whole, "chain {chain}, {share:.3}: {name} is broken");
            }
        }
        finish(folder.path(), &["--resume"]);
        kept += assert_same(folder.path(), &expected, &format!("chain {chain}"));
    }
    println!("tried {kills} kills");
    assert!(kept > 0, "no frame was ever kept");
}

/// Each way to damage what a complete run left, and how many of the frames are kept.
#[test]
fn damaged_files_are_found_and_made_again() {
    let frames = extent(24, 40);
    let (folder, expected) = complete(&with_frames(frames));
    let all = u64::from(frames)..=u64::from(frames);
    // Half of the journal holds nearly half of the frames.
    let half = all.start() * 3 / 8..=all.start() * 5 / 8;
    let path = folder.path();
    let journal = expected["frames.journal"].len();
    let damage = |name: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = expected[name].clone();
        change(&mut bytes);
        fs::write(path.join("out").join(name), bytes).unwrap();
    };
    let again = |what: &str, kept: std::ops::RangeInclusive<u64>| {
        finish(path, &["--resume"]);
        let found = assert_same(path, &expected, what);
        assert!(kept.contains(&found), "{what}: {found} frames kept");
    };
    again("nothing", all.clone());
    for name in ["frames/frame-000017.png", "frames/frame-000003.png"] {
        damage(name, &|bytes| bytes[40] ^= 1);
        again("flipped", all.clone());
        damage(name, &|bytes| bytes.truncate(bytes.len() / 2));
        again("truncated", all.clone());
        fs::remove_file(path.join("out").join(name)).unwrap();
        again("missing", all.clone());
    }
    for name in [
        "cloud.ply",
        "profiles.npy",
        "report.html",
        "summary.json",
        "cloud.png",
    ] {
        damage(name, &|bytes| bytes.truncate(99));
        again(name, all.clone());
    }
    damage("frames.journal", &|bytes| bytes[journal / 2] ^= 16);
    again("journal flipped", half.clone());
    damage("frames.journal", &|bytes| bytes.truncate(journal / 2));
    again("journal truncated", half.clone());
    damage("frames.journal", &|bytes| bytes[60] ^= 1);
    again("header flipped", 0..=0);
    fs::remove_file(path.join("out/frames.journal")).unwrap();
    again("journal missing", 0..=0);
    fs::remove_dir_all(path.join("out/frames")).unwrap();
    again("frames missing", all.clone());
}

#[test]
fn what_changed_since_is_named_and_nothing_is_touched() {
    let text = with_frames(6).replace("step_mm = 0.01\ndirection = [0, 1, 0]\n", "");
    let text = text.replace("frames = 6\n", "poses = \"path.csv\"\n");
    let folder = folder_with(&text);
    let path = folder.path();
    let poses = |y: f64| {
        let line = |k: i32| format!("0,{},0,0,0,{k}\n", y + 0.01 * k as f64);
        let lines: String = (0..6).map(line).collect();
        fs::write(
            path.join("path.csv"),
            format!("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n{lines}"),
        )
        .unwrap();
    };
    poses(0.0);
    finish(path, &[]);
    let before = files(&path.join("out"));
    let refused = |more: &[&str], words: &str| {
        let arguments = [&["scan", "scene.toml", "-o", "out", "--resume"], more].concat();
        let again = "without --resume the scan starts anew";
        assert_error(path, &arguments, 64, &["out/frames.journal", words, again]);
        assert!(
            files(&path.join("out")) == before,
            "{words}: a refusal changed files"
        );
    };
    refused(&["--seed", "8"], "seed was 7 and is 8");
    refused(&["--frames", "0..4"], "frames was 0..6 and is 0..4");
    fs::write(path.join("scene.toml"), text.replace("0.5", "0.51")).unwrap();
    refused(&[], "the scene or a file it names has changed");
    fs::write(path.join("scene.toml"), &text).unwrap();
    poses(0.001);
    refused(&[], "the scene or a file it names has changed");
    poses(0.0);
    finish(path, &["--resume"]);
    assert_eq!(results(path).1, 6);
    // Threads and coverage change no byte, so they may change.
    let (expected, _) = results(path);
    finish(path, &["--resume", "--exhaustive", "--threads", "1"]);
    assert_eq!(assert_same(path, &expected, "other threads"), 6);
    fs::write(path.join("scene.toml"), text.replace("0.5", "0.51")).unwrap();
    finish(path, &[]);
    assert_eq!(results(path).1, 0, "without --resume the scan starts anew");
}

/// The frames of a scan taken in pieces have the files they have in the whole, and their points
/// the flags, which neighbouring frames set at the horizons of a ball.
#[test]
fn pieces_equal_the_whole() {
    let plane = with_frames(9).replace("speckle = false", "speckle = true");
    // Frames further apart than the beam is wide.
    let ball = plane
        .replace(
            PLANE,
            "sphere = { radius_mm = 3, chordal_deviation_um = 5 }",
        )
        .replace("step_mm = 0.01", "step_mm = 0.65")
        .replace("start_mm = [0, -0.5, 0]", "start_mm = [0, -3, 0]");
    assert_pieces_equal_the_whole(&plane);
    assert_pieces_equal_the_whole(&ball);
}

fn assert_pieces_equal_the_whole(text: &str) {
    let (_whole, expected) = complete(text);
    // Without their colours, whose scale is that of a whole cloud.
    let vertices = |ply: &[u8]| {
        let end = b"end_header\n";
        let at = ply.windows(end.len()).position(|w| w == end).unwrap();
        let records = ply[at + end.len()..].chunks_exact(79);
        let plain = |record: &[u8]| [&record[..36], &record[39..]].concat();
        records.flat_map(plain).collect::<Vec<u8>>()
    };
    let mut cloud = Vec::new();
    let mut frames = 0;
    for piece in ["0..1", "1..6", "6..9"] {
        let folder = folder_with(text);
        finish(folder.path(), &["--frames", piece]);
        let (found, _) = results(folder.path());
        for (name, bytes) in &found {
            if name.contains('/') {
                assert!(expected[name] == *bytes, "{piece}: {name}");
                frames += 1;
            }
        }
        cloud.extend(vertices(&found["cloud.ply"]));
    }
    assert_eq!(frames, 9);
    assert!(cloud == vertices(&expected["cloud.ply"]));
    let folder = folder_with(text);
    for (wrong, words) in [
        ("3..3", "A < B"),
        ("4..10", "at most 9"),
        ("5..4", "A < B"),
        ("5", "10..20"),
        ("-1..4", "'-1'"),
        ("1..x", "10..20"),
    ] {
        let arguments = ["scan", "scene.toml", "-o", "out", "--frames", wrong];
        assert_error(folder.path(), &arguments, 64, &[words]);
    }
    assert!(!folder.path().join("out").exists());
}

#[test]
fn a_second_run_into_the_folder_of_another_is_refused() {
    let folder = folder_with(&with_frames(1_000_000));
    let path = folder.path();
    let mut first = start(path, &[]);
    let begin = Instant::now();
    while !path.join("out/frames/frame-000000.png").exists() {
        assert!(begin.elapsed() < Duration::from_secs(60), "no frame");
        sleep(Duration::from_millis(5));
    }
    for more in [&[][..], &["--resume"]] {
        let arguments = [&["scan", "scene.toml", "-o", "out"], more].concat();
        assert_error(path, &arguments, 75, &["another run is writing to out"]);
    }
    assert!(first.try_wait().unwrap().is_none(), "the first run goes on");
    first.kill().unwrap();
    first.wait().unwrap();
    // The lock died with its owner.
    fs::write(path.join("scene.toml"), with_frames(3)).unwrap();
    finish(path, &[]);
}

/// Something mounted on a temporary folder, unmounted at the end.
#[cfg(target_os = "linux")]
struct Disk(tempfile::TempDir);

#[cfg(target_os = "linux")]
impl Disk {
    /// `None`, said loudly, where nothing can be mounted.
    fn mount(options: &str) -> Option<Disk> {
        let disk = Disk(tempfile::tempdir().unwrap());
        if disk.command("mount", &["-t", "tmpfs", "-o", options, "lasertrace-test"]) {
            return Some(disk);
        }
        eprintln!("\n*** NOT TESTED: no tmpfs could be mounted with {options}. ***\n");
        None
    }

    fn command(&self, program: &str, arguments: &[&str]) -> bool {
        let output = Command::new(program)
            .args(arguments)
            .arg(self.0.path())
            .output();
        output.is_ok_and(|o| o.status.success())
    }
}

#[cfg(target_os = "linux")]
impl Drop for Disk {
    fn drop(&mut self) {
        self.command("umount", &[]);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_made_larger_is_resumed_to_the_same_bytes() {
    let Some(disk) = Disk::mount("size=192k") else {
        return;
    };
    let text = with_frames(60);
    let (_whole, expected) = complete(&text);
    let path = disk.0.path();
    fs::write(path.join("scene.toml"), &text).unwrap();
    let arguments = ["scan", "scene.toml", "-o", "out", "--resume"];
    for _ in 0..2 {
        assert_error(path, &arguments, 75, &["cannot write", "No space left"]);
        assert!(!path.join("out/manifest.json").exists());
    }
    assert!(disk.command("mount", &["-o", "remount,size=64m"]));
    finish(path, &["--resume"]);
    let kept = assert_same(path, &expected, "after the full disk");
    assert!(kept > 0, "no frame was kept");

    assert!(disk.command("mount", &["-o", "remount,ro"]));
    assert_error(path, &arguments, 74, &["out/frames.journal", "Read-only"]);
    assert!(disk.command("mount", &["-o", "remount,rw"]));
    assert_same(path, &expected, "after the read-only disk");
}

/// The list of the files to write is the first file to grow.
#[cfg(unix)]
#[test]
fn a_list_of_files_that_cannot_be_written_is_an_error() {
    let folder = folder_with(&with_frames(3));
    let limited = "ulimit -f 0; exec \"$0\" scan scene.toml -o out";
    let output = std::process::Command::new("sh")
        .args(["-c", limited, env!("CARGO_BIN_EXE_lasertrace")])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(75), "{stderr}");
    assert!(stderr.contains("cannot write out/.lasertrace/"), "{stderr}");
}
