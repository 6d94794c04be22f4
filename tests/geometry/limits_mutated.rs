//! The harness of the fuzz targets on mutations of their seeds that are the same on
//! every run, for machines without a fuzzer: some thousands, or for so many seconds a
//! format as LASERTRACE_FUZZ_SECONDS says (`-- --nocapture` prints how many).

#[path = "../../fuzz/fuzz_targets/harness.rs"]
mod harness;

use crate::program;
use crate::random::Random;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

fn seeds(format: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    let entries = fs::read_dir(folder.join(format)).unwrap();
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|path| fs::read(path).unwrap()).collect()
}

/// Numbers as text that parsers stumble over.
const WORDS: [&str; 14] = [
    "0",
    "-1",
    "1e999",
    "nan",
    "-inf",
    "4294967296",
    "1e-320",
    "\n",
    " ",
    "#",
    "\\\n",
    "0x1p3",
    "99999999999999999999",
    "\u{feff}",
];

fn mutated(seeds: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
    let mut bytes = seeds[random.choice(seeds.len())].clone();
    for _ in 0..1 + random.choice(5) {
        let at = random.choice(bytes.len().max(1)).min(bytes.len());
        let end = (at + random.choice(40)).min(bytes.len());
        match random.choice(7) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.choice(8),
            1 if at < bytes.len() => bytes[at] = random.choice(256) as u8,
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(at..end)),
            4 => {
                let piece = bytes[at..end].to_vec();
                let times = 1 + random.choice(8);
                bytes.splice(at..at, piece.repeat(times));
            }
            5 => {
                let other = &seeds[random.choice(seeds.len())];
                let from = random.choice(other.len());
                let to = (from + random.choice(60)).min(other.len());
                bytes.splice(at..end, other[from..to].iter().copied());
            }
            _ => drop(bytes.splice(at..end.min(at + 3), WORDS[random.choice(14)].bytes())),
        }
    }
    bytes
}

fn run(format: &str, executions: u64, mut holds: impl FnMut(&[u8]) -> bool) {
    let seconds = std::env::var("LASERTRACE_FUZZ_SECONDS").ok();
    let limit = seconds.map(|s| Duration::from_secs(s.parse().unwrap()));
    let (start, seeds) = (Instant::now(), seeds(format));
    let mut random = Random::new(17);
    let (mut done, mut taken) = (0, 0);
    let goes_on = |done| match limit {
        Some(limit) => start.elapsed() < limit,
        None => done < executions,
    };
    while goes_on(done) {
        taken += u64::from(holds(&mutated(&seeds, &mut random)));
        done += 1;
    }
    println!("{format}: {done} mutations, {taken} of them taken");
    assert!(
        taken > 0 && taken < done,
        "{format}: {taken} of {done} taken"
    );
}

#[test]
fn mutated_meshes_are_meshes_or_refused() {
    for format in ["stl", "ply", "obj"] {
        run(format, 20_000, harness::is_mesh);
    }
}

/// Few mutations of a PNG keep its checksums.
#[test]
fn mutated_files_beside_a_scene_are_taken_or_refused() {
    run("poses", 20_000, harness::is_poses);
    run("calibration", 20_000, harness::is_calibration);
    run("png", 5_000, harness::is_image);
}

#[test]
fn mutated_files_of_earlier_runs_are_read_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("some.journal");
    run("journal", 4_000, |bytes| harness::is_journal(&path, bytes));
    run("shard", 4_000, |bytes| harness::is_shard(&path, bytes));
    run("manifest", 20_000, harness::is_manifest);
    run("npy", 20_000, harness::is_npy);
}

/// A mutated file where a command looks for it, and the exit codes that say that it was read or refused.
#[test]
fn mutated_files_end_commands_in_order() {
    let mut random = Random::new(18);
    let mut done = 0;
    for (format, file, mesh) in [
        ("stl", "part", true),
        ("ply", "part", true),
        ("obj", "part", true),
        ("scene", "scene.toml", false),
        ("journal", "out/frames.journal", false),
        ("shard", "out/shards/shard-0-of-1.journal", false),
        ("manifest", "out/.lasertrace/some.json", false),
    ] {
        let text = match mesh {
            true => program::scene("mesh = { file = \"part\", unit = \"mm\" }"),
            false => program::scene(program::PLANE),
        };
        let command: &[&str] = match format {
            "journal" => &["scan", "scene.toml", "-o", "out", "--resume", "--force"],
            "shard" => &["merge", "scene.toml", "-o", "out"],
            "manifest" => &["scan", "scene.toml", "-o", "out"],
            _ => &["check", "scene.toml"],
        };
        let seeds = seeds(format);
        for _ in 0..10 {
            let folder = program::folder_with(&text);
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, mutated(&seeds, &mut random)).unwrap();
            let (code, _, stderr) = program::run(folder.path(), command);
            let bytes = || fs::read(&path).map(|bytes| bytes.escape_ascii().to_string());
            assert!(
                matches!(code, 0 | 64 | 65 | 74),
                "{format}: {code} {stderr}\n{:?}",
                bytes()
            );
            assert!(!stderr.contains("panicked"), "{stderr}");
            done += 1;
        }
    }
    println!("tried {done} files through the command line");
}

#[test]
fn mutated_scenes_are_scenes_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    run("scene", 1_000, |bytes| harness::is_scene(&path, bytes));
}
