//! Folders that commands write to: files that no run wrote are safe, inputs always; and what a run is given may
//! have any name, and must be a regular file.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{PLANE, assert_error, folder_with, run, scene};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

const MESH: &str = "v -8 -8 0\nv 8 -8 0\nv 8 8 0\nv -8 8 0\nf 1 2 3 4\n";
const RECIPE: &str = "scene = \"scene.toml\"\nsamples = 2\n";
const SWEEP: &str = "scene = \"scene.toml\"\n[grid]\n\"camera.f_number\" = [8, 11]\n";

/// Every file below `folder`, by its path in it; of a link where it leads.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut left = vec![folder.to_owned()];
    while let Some(next) = left.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().to_string_lossy();
            if let Ok(to) = fs::read_link(&path) {
                found.insert(name.into_owned(), to.into_os_string().into_encoded_bytes());
            } else if path.is_dir() {
                left.push(path);
            } else {
                found.insert(name.into_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// A number from 0 to `below` - 1, by Knuth's generator for 64 bits.
fn drawn(state: &mut u64, below: usize) -> usize {
    *state = state
        .wrapping_mul(6364136223846793005)
        .wrapping_add(1442695040888963407);
    ((*state >> 33) % below as u64) as usize
}

fn sensor() -> String {
    format!(
        "{}/sensors/generic-20mm-405nm.toml",
        env!("CARGO_MANIFEST_DIR")
    )
}

/// A scene, a sweep, a recipe, an image and rays.
fn folder_of_all() -> tempfile::TempDir {
    let folder = folder_with(&scene(PLANE));
    let write = |name: &str, text: &[u8]| fs::write(folder.path().join(name), text).unwrap();
    write("sweep.toml", SWEEP.as_bytes());
    write("set.toml", RECIPE.as_bytes());
    write("part.obj", MESH.as_bytes());
    write("rays.json", b"{\"rays\": [[0, 0, 5, 0, 0, -1]]}");
    folder
}

/// Commands that write a folder, without `-o`.
fn commands() -> Vec<Vec<String>> {
    let lines = [
        "scan scene.toml",
        "scan scene.toml --resume",
        "scan scene.toml --shard 0/2",
        "check scene.toml",
        "render scene.toml",
        "chart scene.toml --frames 1 --rounds 1",
        "calibrate scene.toml",
        "uncertainty scene.toml --seeds 2",
        "uncertainty scene.toml --seeds 2 --static",
        "uncertainty scene.toml --range",
        "sweep sweep.toml",
        "dataset set.toml",
        "speckle",
        "wave --realisations 2",
        "wave scene.toml --realisations 2",
        "peaks",
        "accept SENSOR --seeds 2",
        "emva SENSOR",
        "begin part.obj SENSOR",
    ];
    let words = |line: &str| line.replace("SENSOR", &sensor());
    let lines = lines.iter().map(|line| words(line));
    lines
        .map(|line| line.split(' ').map(str::to_owned).collect())
        .collect()
}

fn with<'a>(command: &'a [String], more: &[&'a str]) -> Vec<&'a str> {
    let words = command.iter().map(String::as_str);
    words.chain(more.iter().copied()).collect()
}

#[test]
fn no_command_writes_to_a_folder_of_others_unless_forced() {
    let folder = folder_of_all();
    let mut state = 1;
    for command in commands() {
        let out = folder.path().join("out");
        let _ = fs::remove_dir_all(&out);
        fs::create_dir_all(out.join("frames")).unwrap();
        let names = [
            "notes.txt",
            "report.html",
            "cloud.csv",
            "summary.json",
            "frames/frame-of-x.jpg",
            "frames/frame-000000.png",
            "index.json",
            "sensor.svg",
        ];
        let name = names[drawn(&mut state, names.len())];
        fs::write(out.join(name), "mine").unwrap();
        let before = files(folder.path());
        let top = name.split('/').next().unwrap();
        let words = [top, "not written by lasertrace", "--force"];
        assert_error(folder.path(), &with(&command, &["-o", "out"]), 64, &words);
        assert!(files(folder.path()) == before, "{command:?}");
    }
    println!("tried {} folders", commands().len());
}

/// With `--force` files of the names that are written are replaced, and no others.
#[test]
fn forced_runs_replace_only_files_of_their_own_names() {
    let folder = folder_of_all();
    let out = folder.path().join("out");
    fs::create_dir_all(out.join("frames")).unwrap();
    let replaced = ["report.html", "frames/frame-000001.png", "cloud.ply"];
    let others = [
        "frames/frame-of-x.jpg",
        "frames/frame-000003.png",
        "frames/frame-1.png",
        "cloud.csv",
        "cloud.ply.mine.part",
        "notes.txt",
    ];
    for name in replaced.iter().chain(&others) {
        fs::write(out.join(name), "mine").unwrap();
    }
    let scan = ["scan", "scene.toml", "-o", "out"];
    let (code, _, stderr) = run(folder.path(), &[&scan[..], &["--force"]].concat());
    assert_eq!(code, 0, "{stderr}");
    let found = files(&out);
    assert!(replaced.iter().all(|name| found[*name] != b"mine"));
    assert!(others.iter().all(|name| found[*name] == b"mine"));
    // From here on it is a folder of results.
    assert_eq!(run(folder.path(), &scan).0, 0);
    let more = [&scan[..], &["--also", "csv"]].concat();
    assert_error(folder.path(), &more, 64, &["cloud.csv", "--force"]);
    let found = files(&out);
    assert!(others.iter().all(|name| found[*name] == b"mine"));
}

#[test]
fn an_input_is_never_replaced() {
    let folder = folder_of_all();
    let path = folder.path();
    let poses = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n0,-0.5,0,0,0,0\n0,0,0,0,0,0\n0,0.5,0,0,0,0\n";
    let scan = "frames = 3\nstep_mm = 0.5\ndirection = [0, 1, 0]\nstart_mm = [0, -0.5, 0]\n";
    fs::write(path.join("cloud.csv"), poses).unwrap();
    fs::write(path.join("part.ply.obj"), MESH).unwrap();
    std::os::unix::fs::symlink("part.ply.obj", path.join("cloud.ply")).unwrap();
    fs::create_dir(path.join("sub")).unwrap();
    let meshes = ["cloud.ply", "./cloud.ply", "sub/../cloud.ply"];
    let cases = meshes.map(|mesh| (scene(&mesh_of(mesh)), "cloud.ply"));
    let by_poses = scene(PLANE).replace(scan, "poses = \"cloud.csv\"\n");
    assert!(by_poses.contains("cloud.csv"));
    for (text, name) in cases.into_iter().chain([(by_poses, "cloud.csv")]) {
        fs::write(path.join("scene.toml"), &text).unwrap();
        let before = files(path);
        for force in [&["--force"][..], &["--force", "--resume"]] {
            let arguments = ["scan", "scene.toml", "-o", ".", "--also", "csv"];
            let words = [name, "is an input"];
            assert_error(path, &[&arguments[..], force].concat(), 64, &words);
            assert!(files(path) == before, "{name}");
        }
    }
    // A result of an earlier run that has become an input: it is listed, and stays.
    fs::write(path.join("scene.toml"), scene(PLANE)).unwrap();
    assert_eq!(run(path, &["scan", "scene.toml", "-o", "out"]).0, 0);
    fs::write(path.join("out/cloud.ply"), MESH).unwrap();
    fs::write(path.join("scene.toml"), scene(&mesh_of("out/cloud.ply"))).unwrap();
    let before = files(path);
    for more in [&[][..], &["--force"]] {
        let arguments = [&["scan", "scene.toml", "-o", "out"], more].concat();
        assert_error(path, &arguments, 64, &["out/cloud.ply is an input"]);
        assert!(files(path) == before);
    }
}

fn mesh_of(name: &str) -> String {
    format!("mesh = {{ file = \"{name}\", unit = \"mm\" }}")
}

/// Into its own folder a command runs again as often as it likes, and other commands into the same; what an earlier
/// scan wrote and this one does not goes, what the user put there stays.
#[test]
fn results_are_replaced_by_later_runs() {
    let folder = folder_of_all();
    let path = folder.path();
    let out = path.join("out");
    let ran = |arguments: &[&str]| {
        let (code, _, stderr) = run(path, &[arguments, &["-o", "out"]].concat());
        assert_eq!(code, 0, "{arguments:?}: {stderr}");
    };
    ran(&["scan", "scene.toml", "--also", "csv"]);
    fs::write(out.join("notes.txt"), "mine").unwrap();
    fs::write(out.join("frames/frame-of-x.jpg"), "mine").unwrap();
    ran(&["scan", "scene.toml", "--also", "csv"]);
    ran(&["scan", "scene.toml", "--frames", "0..1"]);
    let found = files(&out);
    assert!(!found.contains_key("cloud.csv") && !found.contains_key("frames/frame-000001.png"));
    assert!(found.contains_key("frames/frame-000000.png"));
    ran(&["render", "scene.toml", "--frame", "2"]);
    ran(&["scan", "scene.toml"]);
    ran(&["scan", "scene.toml", "--resume"]);
    for _ in 0..2 {
        ran(&["check", "scene.toml"]);
        ran(&["sweep", "sweep.toml"]);
        ran(&["dataset", "set.toml"]);
        ran(&["scan", "scene.toml", "--shard", "0/1"]);
        ran(&["merge", "scene.toml"]);
    }
    let found = files(&out);
    for name in ["notes.txt", "frames/frame-of-x.jpg"] {
        assert_eq!(found[name], b"mine");
    }
    let parts = found.keys().filter(|name| name.ends_with(".part"));
    assert_eq!(parts.count(), 0);
}

/// A run that was killed at any moment runs again without `--force`, and leaves no unfinished file.
#[test]
fn killed_runs_go_on_in_their_folder_and_leave_no_unfinished_file() {
    let folder = folder_of_all();
    let path = folder.path();
    let many = scene(PLANE).replace("frames = 3", "frames = 400");
    fs::write(
        path.join("scene.toml"),
        many.replace("0.5, 0]\n", "0, 0]\n"),
    )
    .unwrap();
    let mut state = 7;
    for command in ["scan scene.toml", "scan scene.toml --shard 0/1"] {
        let words: Vec<&str> = command.split(' ').collect();
        for round in 0..4 {
            let out = format!("{}-{round}", words.len());
            let mut child = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
                .current_dir(path)
                .args(&words)
                .args(["-o", &out])
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            sleep(Duration::from_millis(drawn(&mut state, 300) as u64));
            // It may have come to its end.
            let _ = child.kill();
            child.wait().unwrap();
            let again = [&words[..], &["-o", &out]].concat();
            let (code, _, stderr) = run(path, &again);
            assert_eq!(code, 0, "{stderr}");
            let found = files(&path.join(&out));
            let parts: Vec<&String> = found
                .keys()
                .filter(|name| name.ends_with(".part"))
                .collect();
            assert!(parts.is_empty(), "{parts:?}");
        }
    }
    println!("tried 8 kills");
}

/// Runs commands with scene and output in a folder whose name is not UTF-8, with and without `--json`.
fn hold_in_folder_named(bytes: &[u8], commands: &[&str]) {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join(OsStr::from_bytes(bytes));
    fs::create_dir(&folder).unwrap();
    for (name, text) in files(folder_of_all().path()) {
        fs::write(folder.join(name), text).unwrap();
    }
    let lasertrace = |command: &str, more: &[&str]| {
        let word = |word: &str| match [".toml", ".obj", ".png"]
            .iter()
            .any(|end| word.ends_with(end))
        {
            true => folder.join(word).into_os_string(),
            false => word.into(),
        };
        let line = command.replace("SENSOR", &sensor());
        let output = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
            .args(line.split(' ').map(word))
            .args(more)
            .output()
            .unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let stdout = text(output.stdout);
        if more.contains(&"--json") {
            serde_json::from_str::<serde_json::Value>(&stdout).unwrap();
        }
        (output.status.code().unwrap(), text(output.stderr))
    };
    for json in [&[][..], &["--json"]] {
        for command in commands {
            let out = match command.split(' ').next().unwrap() {
                "merge" => "scan",
                name => name,
            };
            let out = folder.join(out);
            let line = format!("{command} -o out.toml");
            // The last word is joined to the folder, as all names of files are.
            fs::remove_file(folder.join("out.toml")).ok();
            fs::create_dir_all(&out).unwrap();
            std::os::unix::fs::symlink(&out, folder.join("out.toml")).unwrap();
            let (code, stderr) = lasertrace(&line, json);
            assert_eq!(code, 0, "{command}: {stderr}");
        }
    }
    fs::remove_file(folder.join("out.toml")).unwrap();
    // A scene names its files in UTF-8.
    let (code, stderr) = lasertrace("begin part.obj SENSOR -o begun.toml", &["--json"]);
    assert!(code == 64 && stderr.contains("UTF-8"), "{stderr}");
    fs::write(folder.join("scene.toml"), "seed = x").unwrap();
    let (code, stderr) = lasertrace("check scene.toml", &["--json"]);
    assert_eq!(code, 65, "{stderr}");
}

#[test]
fn paths_that_are_not_utf_8_are_as_good_as_others() {
    let commands = [
        "check scene.toml",
        "render scene.toml",
        "scan scene.toml",
        "scan scene.toml --resume",
        "scan scene.toml --shard 0/2",
        "scan scene.toml --shard 1/2",
        "merge scene.toml",
        "peaks --image scan/frames/frame-000000.png",
        "sweep sweep.toml",
        "sweep sweep.toml --merge",
        "dataset set.toml",
    ];
    let names = [&b"a\xc3\x28 b"[..], b"l\xe4ser", b"\xff"];
    for bytes in names.into_iter().take(extent(1, 3)) {
        hold_in_folder_named(bytes, &commands);
    }
}

/// The same of the commands that take longer.
#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn paths_that_are_not_utf_8_are_as_good_as_others_for_studies() {
    let commands = [
        "chart scene.toml --frames 1 --rounds 1",
        "calibrate scene.toml",
        "uncertainty scene.toml --seeds 2",
        "uncertainty scene.toml --seeds 2 --static",
        "uncertainty scene.toml --range",
        "uncertainty SENSOR",
        "speckle",
        "wave --realisations 2",
        "wave scene.toml --realisations 2",
        "peaks",
        "accept SENSOR --seeds 2",
        "emva SENSOR",
    ];
    hold_in_folder_named(b"l\xe4ser", &commands);
}

/// Pipes and devices end never, or when somebody likes; a file may be larger than all memory.
#[test]
fn inputs_are_regular_files_of_a_stated_size() {
    let folder = folder_of_all();
    let path = folder.path();
    let made = Command::new("mkfifo").arg(path.join("pipe")).status();
    assert!(made.unwrap().success());
    let large = fs::File::create(path.join("large")).unwrap();
    large.set_len(1 << 40).unwrap();
    std::os::unix::fs::symlink("/dev/zero", path.join("link")).unwrap();
    let sensor = sensor();
    let poses = "frames = 3\nstep_mm = 0.5\ndirection = [0, 1, 0]\nstart_mm = [0, -0.5, 0]\n";
    for (input, words) in [
        ("pipe", &["pipe", "not a regular file"][..]),
        ("/dev/zero", &["/dev/zero", "not a regular file"]),
        ("link", &["link", "not a regular file"]),
        ("large", &["large: found more than", "bytes"]),
        (".", &[".: found a folder"]),
    ] {
        for command in [
            &["check"][..],
            &["scan", "-o", "out"],
            &["sweep", "-o", "out"],
            &["dataset", "-o", "out"],
            &["emva", "-o", "out"],
            &["accept", "-o", "out"],
            &["uncertainty", "-o", "out"],
            &["peaks", "-o", "out", "--image"],
            &[
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--store",
                "store",
                "--token-file",
            ],
        ] {
            if input == "." && command[0] != "check" {
                continue;
            }
            let words = match words[1..].contains(&"not a regular file") {
                true => [words[0], "regular file"],
                false => [words[0], "found"],
            };
            assert_error(path, &[command, &[input]].concat(), 65, &words);
        }
        if input != "." {
            // Of a mesh memory alone limits the size.
            let code = if input == "large" { 75 } else { 65 };
            // It follows links before it names the file.
            let begin = ["begin", input, &sensor, "-o", "out"];
            assert_error(path, &begin, code, &[]);
            let text = scene(PLANE).replace(poses, &format!("poses = {input:?}\n"));
            fs::write(path.join("by-poses.toml"), text).unwrap();
            assert_error(path, &["check", "by-poses.toml"], 65, &[input]);
            let sweep = SWEEP.replace("scene.toml", input);
            fs::write(path.join("of-input.toml"), sweep).unwrap();
            assert_error(path, &["sweep", "of-input.toml", "-o", "out"], 65, &[input]);
        }
        assert!(!path.join("out").exists());
    }
}

/// A control group of 200 MB, removed at the end.
#[cfg(target_os = "linux")]
struct SmallGroup(std::path::PathBuf);

#[cfg(target_os = "linux")]
impl SmallGroup {
    fn new() -> Option<SmallGroup> {
        const BYTES: &str = "200000000";
        let name = format!("lasertrace-test-{}", std::process::id());
        [
            ("/sys/fs/cgroup", "memory.max"),
            ("/sys/fs/cgroup/memory", "memory.limit_in_bytes"),
        ]
        .into_iter()
        .find_map(|(top, limit)| {
            let group = Path::new(top).join(&name);
            fs::create_dir(&group).ok()?;
            let group = SmallGroup(group);
            let limited =
                group.0.join(limit).exists() && fs::write(group.0.join(limit), BYTES).is_ok();
            limited.then_some(group)
        })
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallGroup {
    fn drop(&mut self) {
        let _ = fs::remove_dir(&self.0);
    }
}

/// A frame of 2000 × 2000 pixels with its truth takes 108 bytes a pixel, 432 MB.
#[cfg(target_os = "linux")]
#[test]
fn what_does_not_fit_a_control_group_is_temporary() {
    let Some(group) = SmallGroup::new() else {
        eprintln!("\n*** NOT TESTED: no control group with a memory limit can be made here. ***\n");
        return;
    };
    for side in [2000, 3000, 4000] {
        let pixels = format!("resolution_px = [{side}, {side}]");
        let folder = folder_with(&scene(PLANE).replace("resolution_px = [64, 48]", &pixels));
        let line = "echo $$ > \"$1/cgroup.procs\" && exec \"$0\" render scene.toml -o out";
        let output = Command::new("sh")
            .args(["-c", line, env!("CARGO_BIN_EXE_lasertrace")])
            .arg(&group.0)
            .current_dir(folder.path())
            .output()
            .unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(75), "{stderr}");
        assert!(stderr.contains("of memory are free"), "{stderr}");
    }
}

/// Calls that a signal interrupts are made again: `strace` has every second one of a kind fail so.
#[cfg(target_os = "linux")]
#[test]
fn interrupted_calls_are_made_again() {
    let folder = folder_of_all();
    let probe = Command::new("strace").args(["-f", "true"]).output();
    if !probe.is_ok_and(|output| output.status.success()) {
        eprintln!("\n*** NOT TESTED: strace is not there, or may not trace. ***\n");
        return;
    }
    for (i, calls) in [
        "rename",
        "mkdir",
        "unlink",
        "?flock",
        "fsync,fdatasync",
        "?syncfs",
    ]
    .iter()
    .enumerate()
    {
        for command in [
            "scan scene.toml",
            "scan scene.toml --shard 0/1",
            "sweep sweep.toml",
            "dataset set.toml",
        ] {
            let inject = format!("inject={calls}:error=EINTR:when=1+2");
            let out = format!("out-{i}-{}", command.replace([' ', '/'], "-"));
            let output = Command::new("strace")
                .args([
                    "-f",
                    "-o",
                    "/dev/null",
                    "-e",
                    &inject,
                    env!("CARGO_BIN_EXE_lasertrace"),
                ])
                .args(command.split(' '))
                .args(["-o", &out])
                .current_dir(folder.path())
                .output()
                .unwrap();
            let stderr = String::from_utf8(output.stderr).unwrap();
            assert_eq!(
                output.status.code(),
                Some(0),
                "{calls}: {command}: {stderr}"
            );
        }
    }
}
