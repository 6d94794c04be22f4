//! An assembly of copies of one mesh against its flattened twin, the vertices of every
//! copy moved in f64 into one mesh: images, profiles without an image, deviations,
//! coverage, under every backend. What it prints are figures of this machine.

use crate::flattened::flattened;
use crate::program;
use crate::program::{assert_error, folder_with, run};
use lasertrace::accel::Backend;
use lasertrace::frame::Blur;
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::shapes;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::fmt::Write;
use std::fs;
use std::path::Path;

fn pose(degrees: [f64; 3], place: [f64; 3]) -> Rigid {
    Rigid::from_euler_xyz(DVec3::from(degrees).map(f64::to_radians), place.into())
}

/// Brackets that stand in each other, one that shades and hides others from above, one
/// beside the field, one upside down.
fn poses() -> Vec<Rigid> {
    vec![
        pose([0.0, 0.0, 0.0], [-8.0, -14.0, 0.0]),
        pose([3.0, -4.0, 90.0], [12.0, 6.0, -1.0]),
        pose([0.0, 35.0, 200.0], [4.0, -3.0, -9.0]),
        pose([180.0, 0.0, 10.0], [-22.0, 16.0, 26.0]),
        pose([0.0, 0.0, 45.0], [90.0, 0.0, 0.0]),
    ]
}

/// The demo's sensor over the assembly, and over its twin.
fn scenes(backend: Backend) -> [Scene; 2] {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let [mut copies, mut flat] = [0, 1].map(|_| Scene::load(&path).unwrap());
    copies.copies = poses().into();
    flat.mesh = flattened(&flat.mesh, &poses()).into();
    copies.accel = backend;
    flat.accel = backend;
    // A lens would spread each difference over many pixels.
    [copies, flat].map(|mut scene| {
        scene.methods.defocus_model = Some(Blur::None);
        scene
    })
}

const FRAMES: [u32; 5] = [25, 70, 110, 150, 195];

/// Hits differ by rounding, 1e-13 mm of 0.1 mm of the beam's radius, which is below what
/// the sums in f32 round; those of a pixel whose light is a ten-thousandth of the
/// brightest by 1e-5 of itself. At edges f32 may meet another triangle in another frame:
/// within 2⁻¹⁸ of the half size, 1e-4 mm, of edges that cross the line in some 100 pixels
/// of 0.05 mm with 9 samples each, that is 2 samples a frame; and shadow rays start
/// 2⁻²⁰ of the half size off, which is another for the twin: as many again. More than 10
/// pixels in a frame would be a defect.
#[test]
fn images_are_those_of_the_flattened_mesh() {
    for &backend in Backend::ALL {
        let scenes = scenes(backend);
        let [copies, flat] = [0, 1].map(|i| Simulation::new(&scenes[i]).unwrap());
        let alone = Scene {
            copies: [poses()[0]].into(),
            methods: scenes[0].methods.clone(),
            ..Scene::load(&scenes[0].path).unwrap()
        };
        let alone = Simulation::new(&alone).unwrap();
        let (mut differing, mut lit, mut other) = (0, 0, 0);
        for frame in FRAMES {
            let images = [&copies, &flat, &alone].map(|s| s.irradiance(frame).dense());
            let brightest = images[1].iter().copied().fold(0.0, f32::max);
            let differ = |a: &f32, b: &f32| (a - b).abs() > 1e-5 * brightest;
            let pairs = images[0].iter().zip(&images[1]);
            let count = pairs.filter(|(a, b)| differ(a, b)).count();
            assert!(count <= 10, "{backend:?} {frame}: {count}");
            differing += count;
            lit += images[1].iter().filter(|&&e| e > 1e-3 * brightest).count();
            let pairs = images[0].iter().zip(&images[2]);
            other += pairs.filter(|(a, b)| differ(a, b)).count();
        }
        println!("{backend:?}: {differing} pixels of {lit} differ; {other} from one copy alone");
        assert!(lit > 20_000 && other > lit / 2, "{lit} {other}");
    }
}

/// What one copy sees of the laser, another shades: with the second above the first,
/// the first is dark where it was lit.
#[test]
fn a_copy_shades_another() {
    let [mut scene, _] = scenes(Backend::default());
    scene.mesh = shapes::plane([30.0, 30.0].into()).unwrap().into();
    scene.speckle = None;
    let low = pose([0.0; 3], [0.0, 0.0, 5.0]);
    // In the way of half of the light, and not of the camera, which looks 30° from the
    // front and does not see as high.
    let roof = pose([180.0, 0.0, 0.0], [15.0, 18.0, 60.0]);
    let light = |copies: Vec<Rigid>| {
        let mut scene = Scene {
            copies: copies.into(),
            methods: scene.methods.clone(),
            ..Scene::load(&scene.path).unwrap()
        };
        (scene.mesh, scene.speckle) = (shapes::plane([30.0, 30.0].into()).unwrap().into(), None);
        let simulation = Simulation::new(&scene).unwrap();
        let image = simulation.irradiance(130);
        let columns = (0..image.rows()).flat_map(|row| image.row(row));
        let lit: std::collections::BTreeSet<usize> = columns
            .filter(|(_, e)| *e > 0.0)
            .map(|(column, _)| column)
            .collect();
        lit.len()
    };
    let (open, shaded) = (light(vec![low]), light(vec![low, roof]));
    assert!(
        open > 300 && shaded < open * 6 / 10 && shaded > open / 5,
        "{open} {shaded}"
    );
}

/// Rows of the same columns to a millionth of a pixel, where the same triangles were
/// met; at an end of a piece of line and where copies meet, one column in a hundred may
/// be left to either.
#[test]
fn profiles_without_an_image_are_those_of_the_flattened_mesh() {
    for &backend in Backend::ALL {
        let scenes = scenes(backend);
        let [copies, flat] = [0, 1].map(|i| Simulation::geometry(&scenes[i]).unwrap());
        for frame in FRAMES {
            let [a, b] = [&copies, &flat].map(|s| s.geometric(frame).0);
            let row = |column| b.iter().find(|p| p.column == column).map(|p| p.row);
            let close = |p: &&lasertrace::profile::Peak| {
                row(p.column).is_some_and(|row| (row - p.row).abs() < 1e-6)
            };
            let same = a.iter().filter(close).count();
            assert!(
                a.len() > 400 && a.len().abs_diff(b.len()) <= 6,
                "{} {}",
                a.len(),
                b.len()
            );
            assert!(
                same + same / 100 >= a.len().max(b.len()),
                "{same} of {}",
                a.len()
            );
        }
    }
}

/// Of the same image both say the same points (but for how wide they expect the line,
/// since their boxes differ), and the same deviations to as much and rounding: 1e-10 mm
/// is a thousand roundings of 100 mm.
#[test]
fn deviations_are_from_the_whole_assembly() {
    for &backend in Backend::ALL {
        let scenes = scenes(backend);
        let [copies, flat] = [0, 1].map(|i| Simulation::new(&scenes[i]).unwrap());
        let (mut points, mut apart) = (0, 0);
        for frame in FRAMES {
            let counts = flat.counts(frame, &flat.irradiance(frame));
            let [a, b] = [&copies, &flat].map(|s| s.measure(frame, &counts).1);
            assert_eq!(a.len(), b.len());
            for (a, b) in a.iter().zip(&b) {
                let moved = a.position.distance(b.position);
                let off = a.deviation.abs() - b.deviation.abs();
                assert!(off.abs() < moved + 1e-10, "{a:?} {b:?}");
                apart += usize::from(moved > 1e-4);
            }
            points += a.len();
        }
        assert!(
            points > 3_000 && apart < points / 100,
            "{apart} of {points}"
        );
    }
}

/// The part of `program::scene` as four small blocks on a plate's corners: one of them
/// turned, two that touch.
const BLOCKS: &str = "step_block = { size_mm = [4, 3, 2], step_mm = 0.5 }";
const COPIES: &str = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n\
    -4,0,-1,0,0,0\n0,0,-1,0,0,0\n4.5,0.5,-1,0,10,30\n3,-4,-2,0,0,90\n";

fn folder() -> tempfile::TempDir {
    let with_copies = |part: &str| program::scene(part).replace("save_images = true\n", "");
    let folder = folder_with(&with_copies(&format!(
        "{BLOCKS}\ninstances = \"copies.csv\""
    )));
    fs::write(folder.path().join("copies.csv"), COPIES).unwrap();
    let flat = with_copies("mesh = { file = \"flat.obj\", unit = \"mm\" }");
    fs::write(folder.path().join("flat.toml"), flat).unwrap();
    let scene = Scene::load(&folder.path().join("scene.toml")).unwrap();
    let mesh = flattened(&scene.mesh, &scene.copies);
    let mut obj = String::new();
    for p in &mesh.positions {
        writeln!(obj, "v {:?} {:?} {:?}", p.x, p.y, p.z).unwrap();
    }
    for [a, b, c] in &mesh.triangles {
        writeln!(obj, "f {} {} {}", a + 1, b + 1, c + 1).unwrap();
    }
    fs::write(folder.path().join("flat.obj"), obj).unwrap();
    folder
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap()
}

/// From the file on: the same points, deviations and coverage as of the flattened mesh.
#[test]
fn a_scan_of_an_assembly_is_that_of_the_flattened_mesh() {
    let folder = folder();
    let scan = |scene: &str| {
        let (code, out, error) = run(folder.path(), &["scan", scene, "-o", "out", "--json"]);
        assert_eq!(code, 0, "{error}");
        json(&out)
    };
    let (copies, flat) = (scan("scene.toml"), scan("flat.toml"));
    for key in ["points", "flags"] {
        assert_eq!(copies[key], flat[key], "{key}");
    }
    assert!(copies["points"].as_u64().unwrap() > 60, "{copies}");
    let number = |of: &serde_json::Value, path: &str| of.pointer(path).unwrap().as_f64().unwrap();
    for path in [
        "/deviation/mean_um",
        "/deviation/std_um",
        "/coverage/area_mm2",
    ] {
        let (a, b) = (number(&copies, path), number(&flat, path));
        assert!((a - b).abs() < 1e-6 * b.abs().max(1.0), "{path}: {a} {b}");
    }
    let shares = copies["coverage"]["shares"].as_array().unwrap().len();
    for i in 0..shares {
        // A place or two of 40 000 may fall to the other side of an edge.
        let path = format!("/coverage/shares/{i}/1");
        let (a, b) = (number(&copies, &path), number(&flat, &path));
        assert!((a - b).abs() < 1e-4, "{path}: {a} {b}");
    }
}

#[test]
fn check_and_render_tell_of_the_copies() {
    let folder = folder();
    for (scene, page, json) in [
        (
            "scene.toml",
            "\n  instances         4, together ",
            "\"copies\":4",
        ),
        ("flat.toml", "\n  triangles ", "\"copies\":1"),
    ] {
        let (code, out, error) = run(folder.path(), &["check", scene]);
        assert_eq!(code, 0, "{error}");
        assert!(out.contains(page), "{page}: {out}");
        assert_eq!(out.contains("together"), scene == "scene.toml", "{out}");
        let (_, out, _) = run(folder.path(), &["check", scene, "--json"]);
        assert!(out.contains(json), "{json}: {out}");
    }
    for (scene, layer) in [("scene.toml", true), ("flat.toml", false)] {
        let (code, _, error) = run(
            folder.path(),
            &["render", scene, "--frame", "1", "-o", "out"],
        );
        assert_eq!(code, 0, "{error}");
        let bytes = fs::read(folder.path().join("out/frame-000001.exr")).unwrap();
        // The list of channels: name, zero, type.
        assert_eq!(bytes.windows(9).any(|name| name == b"instance\0"), layer);
    }
}

#[test]
fn mistakes_in_the_copies_are_named() {
    let folder = folder();
    let copies = folder.path().join("copies.csv");
    let refused = |words: &str| assert_error(folder.path(), &["check", "scene.toml"], 65, &[words]);
    fs::write(&copies, COPIES.replace("4.5,0.5", "4.5,half")).unwrap();
    refused("copies.csv:4: y_mm: found \"half\", expected a number within 1e12 mm");
    fs::write(&copies, COPIES.lines().next().unwrap()).unwrap();
    refused("copies.csv: found 0 poses, expected from 1");
    fs::remove_file(&copies).unwrap();
    refused("scene.toml:6: part.instances: found \"copies.csv\", expected a CSV file of poses");
}

/// The hash in the manifest is of the copies too: a scan with others is not resumed.
#[test]
fn other_copies_are_another_scene() {
    let folder = folder();
    let hash = || Scene::load(&folder.path().join("scene.toml")).unwrap().hash;
    let before = hash();
    fs::write(
        folder.path().join("copies.csv"),
        COPIES.replace("4.5", "4.6"),
    )
    .unwrap();
    assert_ne!(hash(), before);
}

/// Over one step of the grid of `scenes/balls`: the number of its README, and deviations
/// that are distances to the nearest ball less its radius, but for the 0.2 µm between a
/// ball and the triangles inside it.
#[test]
fn the_scene_of_balls_gives_what_its_readme_says() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/balls/scene.toml");
    let scene = Scene::load(&path).unwrap();
    assert_eq!(scene.copies.len(), 1024);
    let simulation = Simulation::new(&scene).unwrap();
    let points = (200..225).flat_map(|frame| {
        let counts = simulation.image(frame);
        simulation.measure(frame, &counts).1
    });
    let points: Vec<_> = points.collect();
    for p in &points {
        let place = |x: f64| ((x + 7.75) * 2.0).round().clamp(0.0, 31.0) / 2.0 - 7.75;
        let middle = DVec3::new(place(p.position.x), place(p.position.y), 0.15);
        // Its sign is the camera's, which sees some from behind.
        let off = p.deviation.abs() - (p.position.distance(middle) - 0.15).abs();
        assert!(off.abs() < 2.2e-4, "{p:?}: {off}");
    }
    let valid = points.iter().filter(|p| p.is_valid());
    let valid: Vec<f64> = valid.map(|p| p.deviation * 1e3).collect();
    let n = valid.len() as f64;
    let mean = valid.iter().sum::<f64>() / n;
    let std = (valid.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / n).sqrt();
    println!("{n} valid points, mean {mean:.3} µm, standard deviation {std:.3} µm");
    assert!(
        n > 10_000.0 && mean.abs() < 1.5 && std < 4.0,
        "{n} {mean} {std}"
    );
}
