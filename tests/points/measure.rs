//! The whole chain, from scene file to points, on shapes of known truth.

use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::PathBuf;

fn measured(scene: &str) -> Vec<CloudPoint> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(scene);
    let scene = Scene::load(&path).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    (0..scene.scan.frames)
        .flat_map(|frame| {
            let counts = simulation.image(frame);
            simulation.measure(frame, &counts).1
        })
        .collect()
}

/// Without speckle and noise every column has its point, and every point lies
/// within 1 µm of z = 0, the plane in the part's own frame.
#[test]
fn points_on_a_plane_lie_on_it() {
    let points = measured("scenes/plane/scene.toml");
    assert_eq!(points.len(), 9 * 640);
    for point in points {
        let z_um = point.position.z * 1e3;
        assert!(z_um.abs() < 1.0, "{point:?}");
        // The deviation is that distance, told by the nearest-point search.
        assert!((point.deviation * 1e3 - z_um).abs() < 1e-6, "{point:?}");
    }
}

/// Each half is measured at its own height: 9 and 10 mm in the part's frame.
#[test]
fn a_step_has_its_height() {
    let points = measured("scenes/step/scene.toml");
    for (side, height) in [(-1.0, 9.0), (1.0, 10.0)] {
        let on_side: Vec<f64> = points
            .iter()
            .filter(|p| p.position.x * side > 0.2)
            .map(|p| p.position.z)
            .collect();
        assert!(on_side.len() > 9 * 280, "{}", on_side.len());
        for z in on_side {
            assert!((z - height).abs() < 0.5e-3, "{side} {z}");
        }
    }
}
