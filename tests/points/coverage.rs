//! Which area of the CAD a scan measured, and why not the rest, against areas
//! that can be counted by hand.

use lasertrace::inspect::coverage::{Fate, ScanData, SensorPose, SurfaceCoverage, coverage};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::PathBuf;

/// The coverage of a scene's scan from those points of it that are `kept`.
fn covered(scene: &Scene, kept: impl Fn(u32) -> bool) -> SurfaceCoverage {
    let simulation = Simulation::new(scene).unwrap();
    let frames = 0..scene.scan.frames;
    let points: Vec<_> = frames
        .clone()
        .flat_map(|frame| {
            let counts = simulation.image(frame);
            simulation.measure(frame, &counts).1
        })
        .filter(|point| kept(point.column))
        .collect();
    let poses: Vec<SensorPose> = frames
        .map(|frame| {
            let view = simulation.view(frame);
            SensorPose {
                part_from_laser: view.part_from_laser,
                part_from_camera: view.part_from_camera,
            }
        })
        .collect();
    coverage(&ScanData {
        objects: None,
        accel: &simulation.accel,
        laser: &scene.laser,
        camera: &scene.camera,
        first_frame: 0,
        poses: &poses,
        points: &points,
    })
    .unwrap()
}

fn share(coverage: &SurfaceCoverage, fate: Fate) -> f64 {
    coverage.shares.iter().find(|(f, _)| *f == fate).unwrap().1
}

fn scene(name: &str) -> Scene {
    Scene::load(&PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

/// The sheet moves over 0.8 mm and the sensor sees 640 columns of 10 µm: 5.12 mm²
/// of a plane across the beam. The tilts of 8° and 5° stretch it in y and x by
/// 1/cos, and turn depth into 0.4 % of width either way. A column at the border
/// and the samples' spread (518 samples of 40 000, evenly laid) are within 2 %.
#[test]
fn a_plane_is_covered_where_the_sheet_passed_it() {
    let plane = scene("scenes/plane/scene.toml");
    let all = covered(&plane, |_| true);
    let tilt = 8f64.to_radians().cos() * 5f64.to_radians().cos();
    let swept = 0.8 * 6.4 / tilt / 400.0;
    let measured = share(&all, Fate::Measured);
    assert!((measured / swept - 1.0).abs() < 0.02, "{measured} {swept}");
    assert_eq!(share(&all, Fate::WeakSignal), 0.0);
    let outside = share(&all, Fate::OutsideScan);
    assert!((measured + outside - 1.0).abs() < 1e-12);
    // 9 frames of 640 points.
    let density = 5760.0 / (measured * 400.0);
    assert!((all.points_per_mm2.unwrap() / density - 1.0).abs() < 1e-9);

    // What is lit and in view but not found is weak: half of it here.
    let half = covered(&plane, |column| column < 320);
    let weak = share(&half, Fate::WeakSignal);
    assert!((weak / swept - 0.5).abs() < 0.02, "{weak} {swept}");
    let both = share(&half, Fate::Measured) + weak;
    assert!((both - measured).abs() < 1e-12);
}

/// Under the same sensor the step's wall, 0.8 mm² of it under the sheet, is edge-on
/// to a camera that looks across it: hidden, not weak.
#[test]
fn the_wall_of_a_step_is_hidden_from_the_camera() {
    let all = covered(&scene("scenes/step/scene.toml"), |_| true);
    let area = |fate| share(&all, fate) * all.area_mm2;
    // 20 samples of 0.04 mm² lie on it, evenly.
    let wall = area(Fate::HiddenFromCamera);
    assert!((wall - 0.8).abs() < 0.1, "{wall}");
    assert!((area(Fate::Measured) - 5.12).abs() < 0.15, "{all:?}");
    assert_eq!(share(&all, Fate::WeakSignal), 0.0);
}
