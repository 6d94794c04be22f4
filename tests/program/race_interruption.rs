//! A race of hierarchies that is asked to end while crates build that cannot be stopped.

#![cfg(all(unix, feature = "race"))]

use crate::effort::extent;
use lasertrace::mesh::shapes;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

/// A ball of so fine triangles as a binary STL of zero normals; says how many.
fn ball(path: &Path) -> usize {
    let mesh = shapes::sphere(5.0, 2e-5).unwrap();
    let mut bytes = vec![b' '; 80];
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for i in 0..mesh.triangles.len() {
        bytes.extend([0; 12]);
        for p in mesh.triangle(i) {
            bytes.extend(
                p.as_vec3()
                    .to_array()
                    .into_iter()
                    .flat_map(f32::to_le_bytes),
            );
        }
        bytes.extend([0; 2]);
    }
    std::fs::write(path, bytes).unwrap();
    mesh.triangles.len()
}

/// While the mesh is read, while its parts are built, and once the forecast is printed, so
/// while trees are built, brute force looks and rays are timed: exit code 75, a line that
/// says so, and no file. The race would take minutes.
#[test]
fn a_race_ends_when_it_is_asked_to() {
    let folder = tempfile::tempdir().unwrap();
    let triangles = ball(&folder.path().join("ball.stl"));
    assert!(triangles > 300_000, "{triangles}");
    let moments = [
        (false, 50),
        (true, 0),
        (true, 6000),
        (false, 700),
        (true, 1500),
    ];
    for (after_forecast, wait_ms) in moments.into_iter().take(extent(3, 5)) {
        let mut race = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
            .current_dir(folder.path())
            .args([
                "bench-bvh",
                "ball.stl",
                "--unit",
                "mm",
                "-o",
                "out",
                "--rounds",
                "99",
            ])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut stderr = BufReader::new(race.stderr.take().unwrap());
        let mut said = String::new();
        if after_forecast {
            stderr.read_line(&mut said).unwrap();
            assert!(said.contains("at most about"), "{said}");
        }
        sleep(Duration::from_millis(wait_ms));
        let id = race.id().to_string();
        assert!(
            Command::new("kill")
                .args(["-TERM", &id])
                .status()
                .unwrap()
                .success()
        );
        stderr.read_to_string(&mut said).unwrap();
        let code = race.wait().unwrap().code();
        assert_eq!(code, Some(75), "{after_forecast} {wait_ms}: {said}");
        assert!(said.contains("interrupted"), "{said}");
        let out = folder.path().join("out");
        assert!(!out.join("bench.json").exists() && !out.join("bench.svg").exists());
    }
}
