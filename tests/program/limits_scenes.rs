//! Scenes at the limits of what a sensor can measure, `scenes/limits`: each gives the
//! number its README says, and no output of any holds a number that is none.

use crate::program::run;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::profile::Flags;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::fs;
use std::path::{Path, PathBuf};

fn path(scene: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("scenes")
        .join(scene)
}

fn measured(scene: &str) -> Vec<CloudPoint> {
    let scene = Scene::load(&path(scene).join("scene.toml")).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let frame = |frame| {
        let irradiance = simulation.irradiance(frame);
        assert!(
            irradiance
                .dense()
                .iter()
                .all(|e| e.is_finite() && *e >= 0.0)
        );
        simulation
            .measure(frame, &simulation.counts(frame, &irradiance))
            .1
    };
    let points: Vec<CloudPoint> = (0..scene.scan.frames).flat_map(frame).collect();
    for p in &points {
        let numbers = [p.deviation, p.u_position, p.u_deviation, p.intensity];
        assert!(
            p.position.is_finite() && numbers.iter().all(|x| x.is_finite()),
            "{p:?}"
        );
    }
    points
}

/// So many points, all with the flag; the greatest |deviation| of one, µm.
fn all_flagged(scene: &str, flag: Flags, count: usize) -> f64 {
    let points = measured(scene);
    let flagged = points.iter().filter(|p| p.flags.contains(flag)).count();
    let deviations = points.iter().map(|p| p.deviation.abs() * 1e3);
    let worst = deviations.fold(0.0, f64::max);
    println!(
        "{scene}: {} points, {flagged} flagged, {worst:.3} µm",
        points.len()
    );
    assert_eq!((points.len(), flagged), (count, count), "{scene}");
    worst
}

/// 10⁶ part sizes from the origin a step of 1 mm is one to within 1 µm.
#[test]
fn far() {
    let points = measured("limits/far");
    let heights = |side: f64| {
        let on_side = points.iter().filter(|p| p.position.x * side > 0.2);
        on_side.map(|p| p.position.z).collect::<Vec<f64>>()
    };
    let (low, high) = (heights(-1.0), heights(1.0));
    assert!(
        low.len() > 800 && high.len() > 800,
        "{} {}",
        low.len(),
        high.len()
    );
    let off = low
        .iter()
        .map(|z| z - 9.0)
        .chain(high.iter().map(|z| z - 10.0));
    let off = off.fold(0.0, |worst: f64, z| worst.max(z.abs() * 1e3));
    println!("far: {off:.3} µm");
    assert!(off < 0.5, "{off} µm");
}

#[test]
fn saturated() {
    let worst = all_flagged("limits/saturated", Flags::SATURATED, 3 * 640);
    assert!(worst < 7.0, "{worst} µm");
}

/// Of a line whose middle is on the sensor at least half is seen; the centroid of half a Gaussian is
/// √(2/π) = 0.8 σ off its middle. The line's σ is 15 µm of the beam and with pixels of 10 µm and grains of
/// 1.6 px some 20 µm.
#[test]
fn border() {
    let worst = all_flagged("limits/border", Flags::IMAGE_BORDER, 3 * 640);
    assert!((1.0..16.0).contains(&worst), "{worst} µm");
}

/// The centroid of the light on the strip is 19 µm off the middle of the beam, which at
/// 45° is as much of height; a pixel is 10 µm.
#[test]
fn edge() {
    let worst = all_flagged("limits/edge", Flags::DISCONTINUITY, 640);
    assert!((15.0..30.0).contains(&worst), "{worst} µm");
}

/// The line is 30 to 40 px wide (σ), and its middle where it should be. What is stated is
/// what it would be off if half the beam's radius were missing on one side: 15 µm at the
/// waist, 18 µm 2.9 mm beyond, and 4 % more on a wall 2° from the sheet.
#[test]
fn grazing() {
    let points = measured("limits/grazing");
    assert_eq!(points.len(), 3 * 640);
    for p in points {
        assert!(p.flags.is_empty(), "{p:?}");
        assert!(p.deviation.abs() < 2e-3, "{p:?}");
        let stated = 1e3 * p.u_deviation;
        assert!((15.0..19.0).contains(&stated), "{stated} µm");
    }
}

#[test]
fn without_light_or_sight_there_are_no_points() {
    for scene in ["limits/dark", "limits/inside", "limits/behind"] {
        assert_eq!(measured(scene), [], "{scene}");
    }
    let points = measured("limits/one-pixel");
    println!("one pixel: {} points", points.len());
    assert_eq!(points, []);
}

/// Little-endian numbers of a PLY's vertices are finite.
fn assert_finite_ply(bytes: &[u8]) {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    for vertex in bytes[at..].chunks_exact(79) {
        let doubles = vertex[..24].as_chunks::<8>().0;
        assert!(doubles.iter().all(|b| f64::from_le_bytes(*b).is_finite()));
        // Normal; deviation and what follows it; three bytes of colour lie between.
        let floats = [&vertex[24..36], &vertex[39..67]].map(|part| part.as_chunks::<4>().0);
        let mut floats = floats.into_iter().flatten();
        assert!(floats.all(|b| f32::from_le_bytes(*b).is_finite()));
    }
}

/// Every scene there, by the program: no number of an output is NaN or infinite.
#[test]
fn no_output_holds_a_number_that_is_none() {
    let mut scenes = 0;
    for entry in fs::read_dir(path("limits")).unwrap() {
        let scene = entry.unwrap().path();
        if !scene.is_dir() {
            continue;
        }
        scenes += 1;
        let folder = tempfile::tempdir().unwrap();
        let name = scene.join("scene.toml");
        let name = name.to_str().unwrap();
        for command in ["scan", "check"] {
            let arguments = [command, name, "--quiet", "-o", "out", "--also", "csv"];
            let some = if command == "scan" { 7 } else { 3 };
            let (code, stdout, stderr) = run(folder.path(), &arguments[..some]);
            assert_eq!(code, 0, "{name}: {stderr}");
            assert!(!stdout.contains("NaN"), "{name}: {stdout}");
        }
        let out = folder.path().join("out");
        assert_finite_ply(&fs::read(out.join("cloud.ply")).unwrap());
        let texts = ["summary.json", "cloud.csv", "manifest.json"];
        for text in texts {
            let text = fs::read_to_string(out.join(text)).unwrap().to_lowercase();
            let mut words = text.split(|c: char| !c.is_alphanumeric());
            assert!(
                !words.any(|w| ["nan", "inf", "infinity"].contains(&w)),
                "{name}"
            );
        }
        let report = fs::read_to_string(out.join("report.html")).unwrap();
        assert!(
            !report.contains(">NaN") && !report.contains(">inf"),
            "{name}"
        );
    }
    assert_eq!(scenes, 9);
}
