//! Lists of one line: one pose of the head, one copy of the part.

use crate::program::{PLANE, folder_with, run, scene};
use crate::random::Random;
use lasertrace::math::DVec3;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::fs;
use std::path::Path;

const HEADER: &str = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n";

/// Points of the first frame, in the part's frame.
fn points(path: &Path) -> Vec<DVec3> {
    let scene = Scene::load(&path.join("scene.toml")).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let counts = simulation.counts(0, &simulation.irradiance(0));
    let (_, points) = simulation.measure(0, &counts);
    points.iter().map(|point| point.position).collect()
}

/// A list of one pose gives what a straight path of one frame from there gives, to
/// the rounding of coordinates of some 100 mm, and every command takes it.
#[test]
fn one_pose_is_one_frame() {
    let mut random = Random::new(181);
    for _ in 0..4 {
        let [x, y, z] = random.vector(1.5).to_array();
        let speckle = |text: String| text.replace("speckle = false", "speckle = true");
        let straight = scene(PLANE).replace("frames = 3", "frames = 1").replace(
            "start_mm = [0, -0.5, 0]",
            &format!("start_mm = [{x}, {y}, {z}]"),
        );
        let listed = scene(PLANE).replace(
            "frames = 3\nstep_mm = 0.5\ndirection = [0, 1, 0]\nstart_mm = [0, -0.5, 0]\n",
            "poses = \"path.csv\"\n",
        );
        let expected = points(folder_with(&straight).path());
        let folder = folder_with(&listed);
        fs::write(
            folder.path().join("path.csv"),
            format!("{HEADER}{x},{y},{z},0,0,0\n"),
        )
        .unwrap();
        let found = points(folder.path());
        assert!(!expected.is_empty());
        assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(&expected) {
            assert!(a.distance(*b) < 1e-11, "{a} {b}");
        }
        // With speckle the way to the next frame is asked for.
        fs::write(folder.path().join("scene.toml"), speckle(listed)).unwrap();
        for command in [
            &["check", "scene.toml"][..],
            &["render", "scene.toml", "-o", "out"],
            &["scan", "scene.toml", "-o", "out"],
            &["scan", "scene.toml", "-o", "out", "--geometry-only"],
        ] {
            let geometry = command.len() > 4;
            let write = format!("save_images = {}", !geometry);
            let text = fs::read_to_string(folder.path().join("scene.toml")).unwrap();
            let text = text.replace("save_images = true", &write);
            fs::write(folder.path().join("scene.toml"), text).unwrap();
            let (code, _, stderr) = run(folder.path(), command);
            assert_eq!(code, 0, "{command:?}: {stderr}");
        }
    }
}

/// One copy at a place gives what the part at that place gives.
#[test]
fn one_copy_is_one_part() {
    let mut random = Random::new(182);
    for _ in 0..4 {
        let [x, y, z] = random.vector(1.5).to_array();
        let copy = scene(PLANE).replace("[part]", "[part]\ninstances = \"copies.csv\"");
        let moved = scene(PLANE).replace(
            "position_mm = [0, 0, 0]\nrotation",
            &format!("position_mm = [{x}, {y}, {z}]\nrotation"),
        );
        let folder = folder_with(&copy);
        let line = format!("{HEADER}{x},{y},{z},0,0,0\n");
        fs::write(folder.path().join("copies.csv"), line).unwrap();
        let found = points(folder.path());
        let expected = points(folder_with(&moved).path());
        assert!(!expected.is_empty());
        assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(&expected) {
            // The light's sums round otherwise; a count may fall to the other side.
            assert!((*a - DVec3::new(x, y, z)).distance(*b) < 0.01, "{a} {b}");
        }
        for command in [
            &["check", "scene.toml"][..],
            &["scan", "scene.toml", "-o", "out"],
        ] {
            let (code, _, stderr) = run(folder.path(), command);
            assert_eq!(code, 0, "{command:?}: {stderr}");
        }
    }
}
