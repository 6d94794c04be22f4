//! The harness of the fuzz targets on mutations of their seeds that are the same on
//! every run, for machines without a fuzzer: some thousands, or for so many seconds a
//! format as LASERTRACE_FUZZ_SECONDS says (`-- --nocapture` prints how many).

#[path = "../fuzz/fuzz_targets/harness.rs"]
mod harness;
mod random;

use random::Random;
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
fn mutated_scenes_are_scenes_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    run("scene", 1_000, |bytes| harness::is_scene(&path, bytes));
}
