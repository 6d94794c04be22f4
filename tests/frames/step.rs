//! STEP files by the recipe of examples/step: a cylinder made for the test, whose triangles must lie within the
//! chord that was asked for.

use lasertrace::mesh;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;
use std::process::{Command, Output};

const RADIUS: f64 = 10.0;
/// A line of binary STL has 24 bits.
const ROUNDING: f64 = 30.0 * 1.2e-7;

fn recipe(arguments: [&str; 3], folder: &Path) -> Output {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/step/step.sh");
    Command::new(script)
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

#[test]
fn triangles_of_a_step_file_lie_within_the_chord() {
    let folder = tempfile::tempdir().unwrap();
    let make = "pload MODELING XDE\npcylinder c 10 30\nstepwrite a c part.stp\nexit\n";
    std::fs::write(folder.path().join("make.tcl"), make).unwrap();
    let mut draw = Command::new("occt-draw");
    let made = draw
        .args(["-b", "-f", "make.tcl"])
        .current_dir(folder.path())
        .output();
    if made.is_err() || !folder.path().join("part.stp").exists() {
        eprintln!(
            "\n*** NOT TESTED: there is no occt-draw, so no STEP file was converted \
             (apt-get install occt-draw libocct-draw-dev). ***\n"
        );
        return;
    }
    for chordal_deviation_um in [100.0, 5.0] {
        let output = recipe(
            ["part.stp", "part.stl", &chordal_deviation_um.to_string()],
            folder.path(),
        );
        assert!(output.status.success(), "{output:?}");
        let part = mesh::load(&folder.path().join("part.stl"), 1.0).unwrap();
        let radius = |p: lasertrace::math::DVec3| p.x.hypot(p.y);
        let mut deepest = 0.0f64;
        for i in 0..part.triangles.len() {
            let corners = part.triangle(i);
            let on_mantle = corners
                .iter()
                .all(|&p| (radius(p) - RADIUS).abs() < ROUNDING);
            let caps = corners[0].z == corners[1].z && corners[1].z == corners[2].z;
            assert!(on_mantle || caps, "{corners:?}");
            if !caps {
                let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
                deepest = deepest.max(RADIUS - radius(middle));
            }
        }
        assert_eq!(mesh::report(&part).boundary_edges, 0);
        let chord = chordal_deviation_um * 1e-3;
        // The mean of three corners, of which two are at one end of the chord, lies at 8/9 of its depth.
        assert!(
            deepest <= 8.0 / 9.0 * chord + ROUNDING,
            "{deepest} beyond {chord}"
        );
        assert!(deepest > 0.1 * chord, "{deepest}: finer than asked for");
    }
    for (arguments, code, words) in [
        (["none.stp", "a.stl", "5"], 66, "no such file"),
        (["part.stp", "a.stl", "0"], 64, "expected micrometres"),
        (["part.stl", "a.stl", "5"], 65, "no triangles"),
    ] {
        let output = recipe(arguments, folder.path());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(
            said.contains(words) && !folder.path().join("a.stl").exists(),
            "{said}"
        );
    }
}

/// Chords are arcs' sagittas c(1 − t²), t even from −1 to 1: the mean of their squares is 8c²/15.
#[test]
fn a_stated_chord_is_in_the_uncertainty_of_deviations() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    let with = text.replace(
        "unit = \"mm\" }",
        "unit = \"mm\", chordal_deviation_um = 50 }",
    );
    assert_ne!(text, with);
    let points = |text: &str| {
        let scene = Scene::parse(text, file.parent().unwrap()).unwrap();
        let simulation = Simulation::new(&scene).unwrap();
        simulation.measure(90, &simulation.image(90)).1
    };
    let (sharp, rough) = (points(&text), points(&with));
    assert!(sharp.len() > 100 && sharp.len() == rough.len());
    for (a, b) in sharp.iter().zip(&rough) {
        let expected = (a.u_deviation.powi(2) + 8.0 / 15.0 * 0.05f64.powi(2)).sqrt();
        assert!(
            (b.u_deviation - expected).abs() < 1e-12 * expected,
            "{a:?} {b:?}"
        );
        assert_eq!((a.position, a.u_position), (b.position, b.u_position));
    }
}
