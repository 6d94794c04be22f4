//! What `check` foretells of a scan against what the scan then takes. Alone in its program,
//! since the peak of memory is that of all threads.
// With the race's rivals the program counts allocations itself, and there is one
// allocator to a program.
#![cfg(not(feature = "race"))]

mod program;
mod random;

use lasertrace::run::{Control, Coverage, ScanOptions, check, scan};
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

/// Four sensors of different sizes, two of them with pictures: memory and disk within a
/// factor of two, which is what "about" promises. Time is not asserted.
#[test]
fn a_scan_takes_what_was_foretold() {
    let mut random = Random::new(183);
    for i in 0..4 {
        let [columns, rows] = [(); 2].map(|()| 400 + random.choice(1000));
        let sensor = format!("resolution_px = [{columns}, {rows}]");
        // The same field of view.
        let pitch = format!("pixel_pitch_um = {}", 30.0 * 64.0 / columns as f64);
        let scene = text(PLANE)
            .replace("resolution_px = [64, 48]", &sensor)
            .replace("pixel_pitch_um = 30", &pitch)
            .replace("frames = 3", "frames = 12")
            .replace("step_mm = 0.5", "step_mm = 0.05")
            .replace(
                "write_frames = true",
                &format!("write_frames = {}", i % 2 == 0),
            );
        let folder = folder_with(&scene);
        let scene = Scene::load(&folder.path().join("scene.toml")).unwrap();
        let control = Control {
            progress: &|_| {},
            building: None,
            stop: &AtomicBool::new(false),
        };
        let told = check(&scene, &control).unwrap().forecast;
        assert!(told.fits() && told.seconds > 0.0);
        let options = ScanOptions {
            coverage: Coverage::Footprint,
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
        let taken = (ALLOCATED.peak_usage() - before) as u64;
        let disk = size(&out);
        println!(
            "{columns} × {rows}: memory {} foretold, {taken} taken; disk {}, {disk}; {:?}",
            told.memory_bytes, told.disk_bytes, told
        );
        for (told, taken) in [(told.memory_bytes, taken), (told.disk_bytes, disk)] {
            assert!(told <= 2 * taken && taken <= 2 * told, "{told} {taken}");
        }
    }
}
