//! The profile from geometry alone against the full chain, and against a slow one
//! that sends a hundred times the rays.

use lasertrace::accel::Ray;
use lasertrace::frame::{IdealProfilePoint, LaserPlaneSampler, PoseView};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::PathBuf;

fn scene(name: &str) -> Scene {
    Scene::load(&PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

fn sheet(scene: &Scene) -> LaserPlaneSampler {
    let camera_from_laser = scene.head_from_camera.inverse() * scene.head_from_laser;
    LaserPlaneSampler::new(
        scene.laser.fan.as_ref().unwrap(),
        &scene.camera,
        &camera_from_laser,
    )
}

/// Without speckle and noise the full chain finds the line where geometry has
/// it: on a plane to the 1 µm (a tenth of a pixel) that tests/points/measure.rs allows
/// the chain, and geometry's own points lie on it to rounding.
#[test]
fn on_a_plane_geometry_and_the_full_chain_agree() {
    let scene = scene("scenes/plane/scene.toml");
    let simulation = Simulation::new(&scene).unwrap();
    let sheet = sheet(&scene);
    let calibration = &simulation.calibration;
    for frame in 0..scene.scan.frames {
        let view = simulation.view(frame);
        let line = sheet.profile(&view);
        let counts = simulation.image(frame);
        let (peaks, _) = simulation.measure(frame, &counts);
        assert_eq!(line.len(), 640);
        assert_eq!(peaks.len(), 640);
        for (point, peak) in line.iter().zip(&peaks) {
            assert_eq!(point.column, peak.column);
            assert!((point.row - peak.row).abs() < 0.1, "{point:?} {peak:?}");
            let exact = lasertrace::profile::Peak {
                row: point.row,
                ..*peak
            };
            let on_part = view
                .part_from_camera
                .point(calibration.point(&exact).unwrap());
            assert!(on_part.z.abs() < 1e-9, "{point:?} {on_part}");
        }
    }
}

/// All the line's points a camera sees, from rays a hundredth of a column apart:
/// column coordinate, row, triangle.
fn dense(view: &PoseView, sheet_rays: usize, half_fan: f64) -> Vec<(f64, f64, u32)> {
    let camera_from_part = view.part_from_camera.inverse();
    let eye = view.part_from_camera.translation;
    let rays = 100 * sheet_rays;
    (0..rays)
        .filter_map(|i| {
            let (x, z) = (half_fan * (2.0 * i as f64 / rays as f64 - 1.0)).sin_cos();
            let ray = Ray {
                origin: view.part_from_laser.translation,
                direction: view.part_from_laser.vector(DVec3::new(x, 0.0, z)),
                t_max: f64::INFINITY,
            };
            let hit = view.accel.closest(&[ray], |_, _| true)[0]?;
            let start = hit.point + hit.normal * view.accel.resolution();
            let sight = Ray::between(start, eye)?;
            if sight.direction.dot(hit.normal) <= 0.0 || view.accel.occluded(&[sight]) != 0 {
                return None;
            }
            let DVec2 { x, y } = view.camera.project(camera_from_part.point(hit.point))?;
            Some((x, y, hit.face.triangle))
        })
        .collect()
}

/// On the bracket, with its holes, step, ribs and shadows. Where dense rays see a
/// column's centre, the profile has it at the same row to a millionth of a pixel:
/// both lie on the triangle, and the row is taken along it. Where they do not, it
/// has none. One column may differ at each end of a piece of line: its centre may
/// lie between the piece's end and the profile's last ray on it.
#[test]
fn what_is_hidden_from_laser_or_camera_is_left_out() {
    let scene = scene("scenes/bracket/scene.toml");
    let simulation = Simulation::new(&scene).unwrap();
    let sheet = sheet(&scene);
    let half_fan = scene.laser.fan.unwrap().angle / 2.0;
    let (mut agreed, mut hidden, mut at_ends) = (0, 0, 0);
    for frame in [30, 50, 75, 110, 160, 200] {
        let view = simulation.view(frame);
        let line = sheet.profile(&view);
        let dense = dense(&view, sheet.rays(), half_fan);
        let mut profile: Vec<Option<IdealProfilePoint>> = vec![None; 1280];
        for point in &line {
            profile[point.column as usize] = Some(*point);
        }
        for (column, point) in profile.iter().enumerate() {
            let center = column as f64 + 0.5;
            // Neighbours that enclose the centre and lie on one surface. Over an
            // edge the row may be off by the bend of the line within 0.1 columns.
            let rows: Vec<(f64, f64)> = dense
                .windows(2)
                .filter(|d| (d[0].0 < center) != (d[1].0 < center))
                .filter(|d| d[0].2 == d[1].2 || (d[1].0 - d[0].0).abs() < 0.1)
                .map(|d| {
                    let slope = (d[1].1 - d[0].1) / (d[1].0 - d[0].0);
                    let row = d[0].1 + (center - d[0].0) * slope;
                    let tolerance = if d[0].2 == d[1].2 { 1e-6 } else { 0.1 };
                    (row, tolerance)
                })
                .collect();
            match point {
                None if rows.is_empty() => hidden += 1,
                Some(point) => {
                    let fits = |&(row, tolerance): &(f64, f64)| (row - point.row).abs() < tolerance;
                    assert!(rows.iter().any(fits), "frame {frame} {point:?} {rows:?}");
                    agreed += 1;
                }
                None => {
                    let beside = [profile[column - 1], profile[column + 1]];
                    let rows = beside.map(|p| p.map_or(f64::NAN, |p| p.row));
                    let joined = (rows[0] - rows[1]).abs() < 1.0;
                    assert!(!joined, "frame {frame} column {column} {rows:?}");
                    at_ends += 1;
                }
            }
        }
    }
    assert!(
        agreed > 5000 && hidden > 1000 && at_ends < 20,
        "{agreed} {hidden} {at_ends}"
    );
}
