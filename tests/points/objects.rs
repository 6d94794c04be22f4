//! Objects that are not inspected hide the part, and their points are not output.

use crate::control;
use crate::random::Random;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::inspect::features::PointErrors;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;

/// A cube of 1 mm above the origin.
const CUBE: &str = "v -0.5 -0.5 0\nv 0.5 -0.5 0\nv 0.5 0.5 0\nv -0.5 0.5 0\nv -0.5 -0.5 1\nv 0.5 -0.5 1\n\
                    v 0.5 0.5 1\nv -0.5 0.5 1\nf 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";

/// Returns the scene of a plane with further tables.
fn scene(folder: &Path, more: &str) -> Scene {
    scene_along(folder, [-2.0, 0.25, 17.0], more)
}

/// Returns the scene of a plane with the start and the step of its frames, mm, and their number.
fn scene_along(folder: &Path, [start, step, frames]: [f64; 3], more: &str) -> Scene {
    let text = include_str!("../../scenes/plane/scene.toml")
        .replace("rotation_deg = [8, 5, 0]", "rotation_deg = [0, 0, 0]")
        .replace(
            "start_mm = [0, -0.4, 0]",
            &format!("start_mm = [0, {start}, 0]"),
        )
        .replace("step_mm = 0.1", &format!("step_mm = {step}"))
        .replace("frames = 9", &format!("frames = {frames}"));
    Scene::parse(&(text + more), folder).unwrap()
}

fn points(scene: &Scene) -> Vec<CloudPoint> {
    let simulation = Simulation::geometry(scene).unwrap();
    simulation.scanned_points(&control()).unwrap()
}

/// A cube hides the part below it from the laser, and a strip behind it from the camera. Other
/// points are unchanged. The feature of the plane has no point of the cube. The positions are drawn
/// from a seed.
#[test]
fn points_on_an_object_are_not_output() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("cube.obj"), CUBE).unwrap();
    let feature =
        "[[feature]]\nname = \"plane\"\nkind = \"plane\"\npoint_mm = [0, 0, 0]\nform = true\n";
    let free = points(&scene(folder.path(), feature));
    for seed in 0..3 {
        let mut random = Random::new(seed);
        let [x, y] = [(); 2].map(|()| random.between(-1.0, 1.0));
        let sunk = random.between(0.2, 0.6);
        let object = format!(
            "[[object]]\nfile = \"cube.obj\"\nunit = \"mm\"\nreflectance = 0.4\n\
             position_mm = [{x}, {y}, {}]\n",
            -sunk
        );
        let with_object = scene(folder.path(), &format!("{object}{feature}"));
        let found = points(&with_object);
        // The camera sees the plane at 45° from −y. The line has a half width of 0.03 mm, and
        // columns and rows are 0.014 mm wide.
        let height = 1.0 - sunk;
        let hidden = |p: &CloudPoint, margin: f64| {
            let at = p.position;
            (at.x - x).abs() < 0.5 + margin
                && at.y > y - 0.5 - margin
                && at.y < y + 0.5 + height + margin
        };
        assert!(
            found
                .iter()
                .all(|p| p.position.z.abs() < 0.01 && !hidden(p, -0.1))
        );
        let kept = free.iter().filter(|p| !hidden(p, 0.1));
        let mut count = 0;
        for p in kept {
            let same = found
                .iter()
                .find(|q| (q.frame, q.column) == (p.frame, p.column));
            let same = same.unwrap_or_else(|| panic!("{seed}: {}", p.position));
            assert!(same.position.distance(p.position) < 1e-6, "{seed}");
            assert!((same.deviation - p.deviation).abs() < 1e-6, "{seed}");
            count += 1;
        }
        assert!(count > 1000 && count < free.len(), "{count}");
        let simulation = Simulation::geometry(&with_object).unwrap();
        let [plane] = simulation.features(&found).try_into().unwrap();
        assert_eq!(plane.problem, None);
        let form = plane
            .quantities
            .iter()
            .find(|q| q.name == "form_mm")
            .unwrap();
        assert!(form.measured < 0.01, "{form:?}");
    }
}

/// Next to the shadow of a cube, a point has the light of a part of the line. The cube is on the plane or
/// next to the laser, where the radius of the beam is 1 mm. Points that are open within the margin of
/// features are unchanged by the cube, unlike others. The positions are drawn from a seed.
///
/// Light beyond 4 standard deviations (two beam radii) shifts a centroid by 1.3e-4 of the standard
/// deviation of 0.015 mm. On the plane, the bound is five times that. Next to the laser, the shadow ends
/// exactly there. The bound is then one such shift, and a change of one count by rounding in the row that
/// light at 5 standard deviations reaches; its centre is up to half a pixel, 0.007 mm, further. The scene
/// has no noise.
#[test]
fn points_away_from_shadows_have_the_complete_line() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("cube.obj"), CUBE).unwrap();
    let images = |start: f64, more: &str| {
        let scene = scene_along(folder.path(), [start, 0.03, 24.0], more);
        let simulation = Simulation::new(&scene).unwrap();
        let points = (0..scene.scan.frames).flat_map(|frame| simulation.take(frame).2);
        (points.collect::<Vec<CloudPoint>>(), simulation)
    };
    for seed in 0..4 {
        let mut random = Random::new(seed);
        let [x, y] = [(); 2].map(|()| random.between(-1.0, 1.0));
        // The fan of 5° is 0.9 mm wide next to the laser, where the cube covers a half of it.
        let [x, z] = match seed % 2 {
            0 => [x, -0.5],
            _ => [0.5 + 0.1 * x, 139.5],
        };
        // Over the end of the shadow of the laser at y + 0.5, and of the camera at y + 1.
        let (free, _) = images(y + 0.4, "");
        let (found, simulation) = images(
            y + 0.4,
            &format!(
                "[[object]]\nfile = \"cube.obj\"\nunit = \"mm\"\nreflectance = 0.4\nposition_mm = [{x}, {y}, {z}]\n"
            ),
        );
        let (mut open, mut closed, mut of_count) = (Vec::new(), 0.0f64, 0.0f64);
        for p in found.iter().filter(|p| p.flags.is_empty()) {
            let same = |q: &&CloudPoint| (q.frame, q.column) == (p.frame, p.column);
            let Some(same) = free.iter().find(same) else {
                continue;
            };
            let change = (same.deviation - p.deviation).abs();
            match simulation.is_open(p, simulation.edge_margin(p)) {
                true => {
                    open.push(change);
                    of_count = of_count.max((5.0 * 0.015 + 0.007) / p.intensity);
                }
                false => closed = closed.max(change),
            }
        }
        let largest = open.iter().copied().fold(0.0, f64::max);
        println!(
            "{seed}: {} points: {largest}; others {closed}; a count {of_count}",
            open.len()
        );
        let bound = match seed % 2 {
            0 => 1e-5,
            _ => 1.3e-4 * 0.015 + of_count,
        };
        assert!(open.len() > 1000 && largest < bound && closed > 1e-4);
    }
}

/// Objects need a surface, and a part without instances.
#[test]
fn mistakes_of_objects_are_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("cube.obj"), CUBE).unwrap();
    let text = include_str!("../../scenes/plane/scene.toml");
    let object = "[[object]]\nfile = \"cube.obj\"\nunit = \"mm\"\n";
    for (more, words) in [
        (object.to_owned(), "object.0: found"),
        (
            format!("{object}reflectance = 1.5\n"),
            "object.0.reflectance: found 1.5",
        ),
        (
            format!(
                "{object}reflectance = 0.5\n[[object]]\nfile = \"none.stl\"\nreflectance = 0.5\n"
            ),
            "object.1.file: found",
        ),
        (
            format!("{object}reflectance = 0.5\nrotation_deg = [0, 400, 0]\n"),
            "object.0.rotation_deg",
        ),
    ] {
        let error = Scene::parse(&format!("{text}{more}"), folder.path())
            .err()
            .unwrap();
        assert!(error.to_string().contains(words), "{more}: {error}");
    }
}
