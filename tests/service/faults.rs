//! What the service survives.

use super::client::{SQUARE, Served, assert_same, by_command, long_scene, square_scene};
use super::program::{PLANE, scene};
use serde_json::json;
use std::fs;
use std::io::{Cursor, Write};
use std::path::Path;
use std::process::Command;
use std::time::Duration;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

/// The process that does a job, from its lock.
fn process_of(store: &Path, id: &str) -> u32 {
    let lock = fs::read_to_string(store.join("jobs").join(id).join("lock")).unwrap();
    lock.trim().parse().unwrap()
}

fn kill(process: u32, signal: &str) {
    let killed = Command::new("kill")
        .args([signal, &process.to_string()])
        .status();
    assert!(killed.unwrap().success());
}

const SCAN: [&str; 4] = ["scan", "in/scene.toml", "-o", "out"];

#[test]
fn kill_9_of_the_service_loses_no_job_and_repeats_none() {
    let store = tempfile::tempdir().unwrap();
    let mut served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let text = long_scene(6000);
    let id = served.job("kind=scan", &text);
    let second = served.job("kind=frame", &square_scene());
    served.wait(&id, |job| job["progress"]["what"] == "frames");
    let process = process_of(store.path(), &id);
    served.kill();
    // The job goes on without it.
    assert!(Path::new(&format!("/proc/{process}")).exists());
    let mut served = Served::start(store.path(), &["--jobs", "1"]);
    assert_eq!(served.state(&id)["starts"], 1);
    // Its process too: the next service goes on with what is in the journal.
    served.wait(&id, |job| {
        job["progress"]["done"]
            .as_u64()
            .is_some_and(|done| done > 200)
    });
    served.kill();
    kill(process, "-9");
    let served = Served::start(store.path(), &["--jobs", "1"]);
    assert_eq!(served.done(&id)["starts"], 2);
    let results = served.results(&id);
    let manifest: serde_json::Value = serde_json::from_slice(&results["manifest.json"]).unwrap();
    assert!(
        manifest["frames_resumed"].as_u64() > Some(100),
        "{manifest}"
    );
    assert_same(results, by_command(&text, &SCAN));
    assert_eq!(served.done(&second)["starts"], 1);
}

#[test]
fn a_process_that_is_killed_goes_on_and_one_that_dies_each_time_fails() {
    dies_each_time("-9", "signal: 9");
}

/// A failed assertion of Embree ends a process so, and it is not for lack of memory.
#[test]
fn a_process_that_aborts_each_time_is_not_said_to_lack_memory() {
    dies_each_time("-ABRT", "signal: 6");
}

fn dies_each_time(signal: &str, how: &str) {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let id = served.job("kind=scan", &long_scene(100_000));
    for start in 1..=3 {
        let frames =
            |job: &serde_json::Value| job["starts"] == start && job["progress"]["what"] == "frames";
        let before = served.wait(&id, frames)["progress"]["done"]
            .as_u64()
            .unwrap();
        // A note from before the last death may still stand there.
        served.wait(&id, |job| {
            frames(job) && job["progress"]["done"].as_u64() > Some(before)
        });
        kill(process_of(store.path(), &id), signal);
        served.wait(&id, |job| {
            job["state"] != "running" || job["starts"] != start
        });
    }
    let job = served.end(&id);
    assert_eq!(
        (&job["state"], &job["exit_code"]),
        (&json!("failed"), &json!(70)),
        "{job}"
    );
    let message = job["message"].as_str().unwrap();
    assert!(
        message.contains(how) && !message.contains("memory"),
        "{job}"
    );
    served.done(&served.job("kind=frame", &square_scene()));
}

/// A 3MF whose model is two gigabytes of blanks.
fn bomb() -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default();
    let rels = "<Relationships xmlns=\"http://schemas.openxmlformats.org/package/2006/relationships\">\
        <Relationship Target=\"/3D/3dmodel.model\" Id=\"r\" \
        Type=\"http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel\"/></Relationships>";
    zip.start_file("_rels/.rels", options).unwrap();
    zip.write_all(rels.as_bytes()).unwrap();
    zip.start_file("3D/3dmodel.model", options).unwrap();
    let blanks = vec![b' '; 1 << 20];
    for _ in 0..2048 {
        zip.write_all(&blanks).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

#[test]
fn hostile_jobs_end_within_their_limits_and_take_nothing_else_down() {
    let store = tempfile::tempdir().unwrap();
    let limits = [
        "--jobs",
        "2",
        "--job-memory-mb",
        "2000",
        "--job-seconds",
        "5",
    ];
    let served = Served::start(store.path(), &limits);
    served.put(SQUARE.as_bytes());
    let bomb = bomb();
    assert!(bomb.len() < 4 << 20, "{}", bomb.len());
    let bomb = served.put(&bomb);
    let bomb = served.job(
        "kind=scan",
        &scene(&format!("mesh = {{ file = \"{bomb}\" }}")),
    );
    // 4294967295 triangles, and none of them there.
    let mut lies = vec![0; 84];
    lies[80..].copy_from_slice(&[0xff; 4]);
    let lies = served.put(&lies);
    let lies = served.job(
        "kind=scan",
        &scene(&format!("mesh = {{ file = \"{lies}\", unit = \"mm\" }}")),
    );
    let large = scene(PLANE).replace("resolution_px = [64, 48]", "resolution_px = [65535, 65535]");
    let large = served.job("kind=frame", &large);
    // Too long for its time, not for its memory: each of its frames sees the part, by 256 rays a pixel.
    let endless = long_scene(40_000).replace("step_mm = 0.01", "step_mm = 0.0001")
        + "[model]\npixel_sampling = \"per-sample\"\nsamples_per_side = 16\n";
    let endless = served.job("kind=scan", &endless);
    let good = served.job("kind=frame", &square_scene());
    for (id, code, word) in [
        (&bomb, 75, "of memory are free"),
        (&lies, 65, ""),
        (&large, 75, "65535 × 65535 pixels"),
    ] {
        let job = served.end(id);
        assert_eq!(
            (&job["state"], &job["exit_code"]),
            (&json!("failed"), &json!(code)),
            "{job}"
        );
        assert!(job["message"].as_str().unwrap().contains(word), "{job}");
    }
    let job = served.end(&endless);
    assert_eq!(
        (&job["state"], &job["exit_code"]),
        (&json!("failed"), &json!(75)),
        "{job}"
    );
    assert!(
        job["message"].as_str().unwrap().contains("longer than"),
        "{job}"
    );
    served.done(&good);
    assert_eq!(served.get("/healthz").status, 200);
    assert_eq!(served.metric("lasertrace_processes_died_total"), 0.0);
    drop(served);
    let served = Served::start(store.path(), &["--job-file-mb", "1"]);
    let job = served.end(&served.job("kind=scan", &long_scene(100_000)));
    assert_eq!(
        (&job["state"], &job["exit_code"]),
        (&json!("failed"), &json!(75)),
        "{job}"
    );
    assert!(
        job["message"].as_str().unwrap().contains("File too large"),
        "{job}"
    );
}

/// A disk of its own for a test; taken away at its end.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn new(size: &str) -> Option<SmallDisk> {
        let folder = tempfile::tempdir().unwrap();
        let mut mount = Command::new("mount");
        mount
            .args(["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"])
            .arg(folder.path());
        let mounted = mount.output().is_ok_and(|output| output.status.success());
        mounted.then_some(SmallDisk(folder))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount")
            .args(["-l"])
            .arg(self.0.path())
            .status();
    }
}

#[test]
fn a_full_disk_is_said_and_the_job_goes_on_when_there_is_room() {
    let Some(disk) = SmallDisk::new("200m") else {
        eprintln!("SKIPPED, a full disk is NOT tested: this user may not mount a tmpfs");
        return;
    };
    let served = Served::start(&disk.0.path().join("store"), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    // Leaves room for the service's own files, and not for a scan of so many frames.
    let free = served.metric("lasertrace_store_free_bytes") as usize;
    let filler = disk.0.path().join("filler");
    fs::write(&filler, vec![1; free.saturating_sub(1 << 20)]).unwrap();
    let text = long_scene(2000);
    let id = served.job("kind=scan", &text);
    let job = served.wait(&id, |job| {
        job["state"] == "queued" && job["message"].is_string()
    });
    let message = job["message"].as_str().unwrap();
    // The command says it, or found no room even for that.
    let said = ["No space left on device", "the disk is full"];
    assert!(
        said.iter().any(|words| message.contains(words)),
        "{message}"
    );
    assert_eq!(served.get("/readyz").status, 503);
    let large = vec![7; 4 << 20];
    let path = format!("/v1/files/{}", super::client::digits(&large));
    let answer = served.ask("PUT", &path, &[], &large);
    assert_eq!(answer.status, 507, "{answer:?}");
    assert_eq!(served.get("/healthz").status, 200);
    fs::remove_file(&filler).unwrap();
    let job = served.done(&id);
    assert!(job["starts"].as_u64() >= Some(2), "{job}");
    assert_same(served.results(&id), by_command(&text, &SCAN));
    assert_eq!(served.get("/readyz").status, 200);
}

/// Fills a disk to its last byte.
fn fill(disk: &Path) {
    let mut file = fs::File::create(disk.join("filler")).unwrap();
    for size in [1 << 20, 1 << 12, 1] {
        let bytes = vec![1; size];
        while file.write_all(&bytes).is_ok() {}
    }
}

#[test]
fn a_full_disk_is_cleared_by_one_deletion_and_a_restart() {
    let Some(disk) = SmallDisk::new("60m") else {
        eprintln!("SKIPPED, a full disk is NOT tested: this user may not mount a tmpfs");
        return;
    };
    let store = disk.0.path().join("store");
    let mut served = Served::start(&store, &["--jobs", "1"]);
    let name = served.put(SQUARE.as_bytes());
    let kept = served.job("kind=frame", &square_scene());
    let expected = served.done(&kept);
    // Bodies of 3 MB each, which the table holds.
    let ray = "[0.0, 0.0, 10.0, 0.0, 0.0, -1.0],".repeat(90_000);
    let rays = format!("{{\"rays\": [{}]}}", ray.trim_end_matches(','));
    let query = format!("kind=rays&mesh={name}&unit=mm");
    let large: Vec<String> = (0..2).map(|_| served.job(&query, &rays)).collect();
    for id in &large {
        served.end(id);
    }
    fill(disk.0.path());
    served.kill();
    fill(disk.0.path());
    let served = Served::start(&store, &["--jobs", "1"]);
    assert_eq!(served.get("/healthz").status, 200);
    let deleted = served.ask("DELETE", &format!("/v1/jobs/{}", large[0]), &[], b"");
    assert_eq!(deleted.status, 204, "{deleted:?}");
    drop(served);
    let served = Served::start(&store, &["--jobs", "1"]);
    assert_eq!(served.get(&format!("/v1/jobs/{}", large[0])).status, 404);
    assert_eq!(served.state(&large[1])["id"], large[1].as_str());
    assert_eq!(served.state(&kept), expected);
    served.done(&served.job("kind=frame", &square_scene()));
    // The table's file shrinks with its contents.
    let deleted = served.ask("DELETE", &format!("/v1/jobs/{}", large[1]), &[], b"");
    assert_eq!(deleted.status, 204, "{deleted:?}");
    let left = fs::metadata(store.join("jobs.db")).unwrap().len();
    assert!(left < rays.len() as u64, "{left} bytes");
}

#[test]
fn a_service_that_is_told_to_stop_leaves_its_jobs_to_the_next() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let text = long_scene(3000);
    let id = served.job("kind=scan", &text);
    served.wait(&id, |job| job["progress"]["what"] == "frames");
    let process = process_of(store.path(), &id);
    drop(served);
    // Its processes end with it, after at most two seconds.
    std::thread::sleep(Duration::from_secs(3));
    let running = fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
    assert!(!running.contains("job"), "{running:?}");
    let served = Served::start(store.path(), &["--jobs", "1"]);
    assert_eq!(served.done(&id)["starts"], 2);
    assert_same(served.results(&id), by_command(&text, &SCAN));
}
