//! What `check` foretells of a scan against what the scan then takes. Alone in its program,
//! since the peak of memory is that of all threads.
// With the race's rivals the program counts allocations itself, and there is one
// allocator to a program.
#![cfg(not(feature = "race"))]

#[path = "common/program.rs"]
mod program;
#[path = "common/random.rs"]
mod random;

use lasertrace::run::{RunControl, ScanOptions, TraceMode, check, scan};
use lasertrace::scene::Scene;
use peak_alloc::PeakAlloc;
use program::{PLANE, folder_with, scene as text};
use random::Random;
use std::fs;
use std::path::Path;
use std::sync::atomic::AtomicBool;

#[global_allocator]
static ALLOCATED: PeakAlloc = PeakAlloc;

/// Bytes of all files below a folder.
fn size(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    entries
        .map(|path| match path.is_dir() {
            true => size(&path),
            false => path.metadata().unwrap().len(),
        })
        .sum()
}

/// Scans a scene and holds what was foretold against it: memory and disk within a factor
/// of two, which is what "about" promises. Time is not asserted.
fn hold(what: &str, scene: &str, files: &[(&str, String)]) {
    let folder = folder_with(scene);
    for (name, text) in files {
        fs::write(folder.path().join(name), text).unwrap();
    }
    let scene = Scene::load(&folder.path().join("scene.toml")).unwrap();
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &AtomicBool::new(false),
    };
    let forecast = check(&scene, &control).unwrap().forecast;
    assert!(forecast.fits() && forecast.seconds > 0.0);
    let options = ScanOptions {
        coverage: TraceMode::Footprint,
        frames: None,
        resume: false,
        geometry_only: false,
        strict: false,
        also: Vec::new(),
    };
    let out = folder.path().join("out");
    let before = ALLOCATED.current_usage();
    ALLOCATED.reset_peak_usage();
    let summary = scan(&scene, &options, &out, &control).unwrap();
    assert!(summary.points > 0);
    let memory = (ALLOCATED.peak_usage() - before) as u64;
    let disk = size(&out);
    println!(
        "{what}, {} frames of {} columns: {} points; memory {} foretold, {memory} taken; disk {} \
         foretold, {disk} taken",
        summary.frames, summary.columns, summary.points, forecast.memory_bytes, forecast.disk_bytes
    );
    for (foretold, taken) in [(forecast.memory_bytes, memory), (forecast.disk_bytes, disk)] {
        assert!(
            foretold <= 2 * taken && taken <= 2 * foretold,
            "{what}: {foretold} foretold, {taken} taken"
        );
    }
}

/// The scene of a part with a sensor of about this many pixels, the same field of view.
fn sensor(random: &mut Random, part: &str, most: [usize; 2]) -> String {
    let [columns, rows] = most.map(|most| most / 3 + random.choice(2 * most / 3));
    let pitch = 30.0 * 64.0 / columns as f64;
    text(part)
        .replace("[64, 48]", &format!("[{columns}, {rows}]"))
        .replace("pitch_um = 30", &format!("pitch_um = {pitch}"))
}

/// Planes all of which is seen, with pictures and without; then parts that are seen in
/// some of the frames, or in some of the columns, or both: balls, blocks with a step,
/// strips, and a path of several passes of which some miss the part. Alone in its program,
/// one after the other: the peak of memory is that of all threads.
#[test]
fn a_scan_takes_what_was_foretold() {
    let mut random = Random::new(183);
    for i in 0..4 {
        let write = format!("save_images = {}", i % 2 == 0);
        let scene = sensor(&mut random, PLANE, [1400, 1400])
            .replace("frames = 3", "frames = 12")
            .replace("step_mm = 0.5", "step_mm = 0.05")
            .replace("save_images = true", &write);
        hold("plane", &scene, &[]);
    }
    for _ in 0..3 {
        let radius = random.between(2.0, 6.0);
        let width = random.between(1.0, 12.0);
        let ball = format!("sphere = {{ radius_mm = {radius}, chordal_deviation_um = 5 }}");
        let strip = format!("plane = {{ size_mm = [{width}, {}] }}", 2.0 * radius);
        let block = format!("step_block = {{ size_mm = [9, {width}, 3], step_mm = 1.5 }}");
        for (what, part, z) in [
            ("ball", ball, -radius),
            ("strip", strip, 0.0),
            ("block", block, -3.0),
        ] {
            let way = random.between(10.0, 60.0);
            let frames = 100 + random.choice(900);
            let start = random.between(-0.8, -0.2) * way;
            let step = way / frames as f64;
            let scene = sensor(&mut random, &part, [600, 300])
                .replace(
                    "position_mm = [0, 0, 0]",
                    &format!("position_mm = [0, 0, {z}]"),
                )
                .replace("save_images = true", "save_images = false")
                .replace(
                    "start_mm = [0, -0.5, 0]",
                    &format!("start_mm = [0, {start}, 0]"),
                )
                .replace(
                    "frames = 3\nstep_mm = 0.5",
                    &format!("frames = {frames}\nstep_mm = {step}"),
                );
            hold(what, &scene, &[]);
        }
        let scene = sensor(&mut random, PLANE, [600, 300]);
        let (rest, _) = scene.split_once("[scan]").unwrap();
        let scene = format!("{rest}[scan]\nposes = \"path.csv\"\n")
            .replace("save_images = true", "save_images = false");
        let mut path = String::from("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n");
        for pass in 0..5 {
            let x = 8.0 * pass as f64 - random.between(0.0, 10.0);
            for i in 0..80 {
                path += &format!("{x},{},0,0,0,0\n", 0.25 * (i - 40) as f64);
            }
        }
        hold("passes", &scene, &[("path.csv", path)]);
    }
}
