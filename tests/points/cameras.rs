//! Heads with several cameras: the cloud of all cameras from the scans of each.

use crate::{control, scan_options};
use lasertrace::error::Error;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::run::{self, Export, ScanSummary, Simulation};
use lasertrace::scene::Scene;
use lasertrace::study::calibrate;
use std::collections::BTreeMap;
use std::path::Path;

/// A block of 1 mm height above the plane. It hides 1 mm of the plane from a camera at 45°.
const BLOCK: &str = "v -0.5 -0.5 -1\nv 0.5 -0.5 -1\nv 0.5 0.5 -1\nv -0.5 0.5 -1\nv -0.5 -0.5 1\nv 0.5 -0.5 1\n\
                     v 0.5 0.5 1\nv -0.5 0.5 1\nf 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
const COLUMNS: u32 = 640;

/// Returns the plane with a block. `cameras` are tables of the cameras, without their optics.
fn text(cameras: &[&str]) -> String {
    let scene = include_str!("../../scenes/plane/scene.toml")
        .replace("speckle = false", "speckle = true")
        .replace("rotation_deg = [8, 5, 0]", "rotation_deg = [0, 0, 0]")
        .replace("start_mm = [0, -0.4, 0]", "start_mm = [0, -1.4, 0]")
        .replace("step_mm = 0.1", "step_mm = 0.35");
    let start = scene.find("[camera]\n").unwrap();
    let end = scene.find("[scan]\n").unwrap();
    let optics = &scene[start + "[camera]\n".len()..end];
    let optics: String = (optics.lines())
        .filter(|line| !line.starts_with("position_mm"))
        .map(|line| format!("{line}\n"))
        .collect();
    let tables = cameras.iter().map(|camera| match cameras.len() {
        1 => format!("[camera]\n{camera}{optics}read_noise_e = 10\n"),
        _ => format!("[[camera]]\n{camera}{optics}read_noise_e = 10\n"),
    });
    let tables: String = tables.collect();
    let object = "[[object]]\nfile = \"block.obj\"\nunit = \"mm\"\nreflectance = 0.4\n[[feature]]\nname = \"plane\"\n\
         kind = \"plane\"\npoint_mm = [3, 3, 0]\n";
    format!("{}{tables}{}{object}", &scene[..start], &scene[end..])
}

const FRONT: &str = "position_mm = [0, -106.066017, 106.066017]\n";
const BACK: &str = "position_mm = [0, 106.066017, 106.066017]\n";
/// Errors of the laser and of the camera.
const SYSTEMATIC: &str = "[systematic]\nlaser_pointing_urad = { standard_deviation = 20 }\ncamera_rotation_urad = { standard_deviation = 20 }\n";

fn scan(scene: &Scene, out: &Path) -> ScanSummary {
    let options = scan_options(Export::ALL[0]);
    run::scan(scene, &options, out, &control()).unwrap()
}

/// Lines of a CSV cloud, the first of [`Export::ALL`], by frame and column of the camera, for columns from `first` on.
fn lines(out: &Path, first: u32) -> BTreeMap<(u32, u32), String> {
    let csv = std::fs::read_to_string(out.join("cloud.csv")).unwrap();
    let line = |line: &str| {
        let mut values: Vec<String> = line.split(',').map(str::to_owned).collect();
        let [frame, column] = [7, 8].map(|i| values[i].parse::<u32>().unwrap());
        let column = column.checked_sub(first).filter(|c| *c < COLUMNS)?;
        values[8] = column.to_string();
        Some(((frame, column), values.join(",")))
    };
    csv.lines().skip(1).filter_map(line).collect()
}

fn position(line: &str) -> [f64; 2] {
    let mut values = line.split(',');
    [(); 2].map(|()| values.next().unwrap().parse().unwrap())
}

/// The points of each camera in the cloud of both equal those of a scan with this camera alone. The
/// strips behind the block are measured by one camera only, and each ray of the laser has one point.
/// The written scene gives equal bytes.
#[test]
fn two_cameras_equal_the_merged_scans_of_each() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::write(path.join("block.obj"), BLOCK).unwrap();
    let number = format!("number = 2\n{BACK}");
    let parse = |cameras: &[&str]| Scene::parse(&text(cameras), path).unwrap();
    let both = parse(&[FRONT, BACK]);
    let alone = [parse(&[FRONT]), parse(&[&number])];
    let summary = scan(&both, &path.join("both"));
    assert_eq!(summary.columns, 2 * COLUMNS);
    let singles = ["front", "back"].map(|name| path.join(name));
    let [a, b] = [0, 1].map(|i| scan(&alone[i], &singles[i]));
    let merged = [0, 1].map(|i| lines(&path.join("both"), i * COLUMNS));
    let single = singles.map(|out| lines(&out, 0));
    // Camera 1 is at -y and does not see the strip behind the block.
    let hidden = |line: &str, side: f64| {
        let [x, y] = position(line);
        x.abs() < 0.4 && (0.6..1.4).contains(&(side * y))
    };
    for (i, side) in [(0, -1.0), (1, 1.0)] {
        assert!(!merged[i].is_empty());
        for (key, line) in &merged[i] {
            assert_eq!(line, &single[i][key], "camera {i}, {key:?}");
        }
        let of_one =
            |lines: &BTreeMap<_, String>| lines.values().filter(|l| hidden(l, side)).count();
        // Two frames are over each strip, and half of a strip of 0.8 mm has 57 columns.
        assert!(of_one(&single[i]) > 100 && of_one(&single[1 - i]) == 0);
        assert_eq!(of_one(&merged[i]), of_one(&single[i]));
    }
    // Each ray has one point. The strips are 1 mm of 9 mm of the line in three of nine frames for each
    // camera, 7 % of all points. With a point of each camera per ray, the sum would be twice the larger
    // number. Independent noise decides which camera is used, so each has about half of the points.
    let [front, back] = [0, 1].map(|i| merged[i].len());
    let most = single[0].len().max(single[1].len());
    assert!(front + back < most + most / 5, "{front} + {back}, {most}");
    assert!(front.min(back) > most / 5, "{front} {back}");
    let covered = |out: &ScanSummary| out.coverage.as_ref().unwrap().shares[0].1;
    assert!(covered(&summary) > covered(&a).max(covered(&b)));
    assert_eq!(summary.features[0].problem, None);

    let written = Scene::load(&path.join("both/resolved-scene.toml")).unwrap();
    assert_eq!(written.cameras.len(), 2);
    scan(&written, &path.join("again"));
    let cloud = |name: &str| std::fs::read(path.join(name).join("cloud.csv")).unwrap();
    assert!(cloud("both") == cloud("again"));
}

/// Cameras at one position have different noise and speckle, one error of the laser and different errors
/// of the camera.
#[test]
fn cameras_have_errors_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("block.obj"), BLOCK).unwrap();
    let scene = Scene::parse(&(text(&[FRONT, FRONT]) + SYSTEMATIC), folder.path()).unwrap();
    let [a, b] = [0, 1].map(|i| Simulation::new(&scene.cameras[i]).unwrap());
    let names: Vec<&str> = (a.scene.systematic.errors.iter())
        .map(|error| error.name)
        .collect();
    println!("{names:?}");
    let mut equal = 0;
    for &name in &names {
        let same = a.systematic_values(name) == b.systematic_values(name);
        assert_eq!(same, name.contains("laser"), "{name}");
        equal += usize::from(same);
    }
    assert!(equal > 0 && equal < names.len());
    let [a, b] = [a, b].map(|simulation| simulation.take(0).2);
    let pairs = a.iter().zip(&b).filter(|(a, b)| a.column == b.column);
    assert!(pairs.clone().count() > 100);
    assert!(pairs.clone().all(|(a, b)| a.row != b.row));
}

/// Each camera measures with its own calibration, as in a scene of this camera alone. The written scene
/// has the calibrations.
#[test]
fn each_camera_has_its_calibration() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::write(path.join("block.obj"), BLOCK).unwrap();
    let with = |cameras: &[&str], calibration: &str| {
        format!("{}[measure]\ncalibration = {calibration}\n", text(cameras))
    };
    let parse = |text: &str| Scene::parse(text, path);
    let numbered = format!("number = 2\n{BACK}");
    let alone = [FRONT, &numbered];
    for (name, camera) in ["one", "two"].iter().zip(alone) {
        let scene = parse(&text(&[camera])).unwrap();
        calibrate(scene, &path.join(name), &control()).unwrap();
    }
    let list = "[\"one/calibration.json\", \"two/calibration.json\"]";
    let both = parse(&with(&[FRONT, BACK], list)).unwrap();
    for (i, name) in ["one", "two"].iter().enumerate() {
        let own = format!("\"{name}/calibration.json\"");
        let own = parse(&with(&[alone[i]], &own)).unwrap();
        let of = |scene: &Scene| Simulation::new(scene).unwrap().take(4).2;
        let (of_list, own, exact) = (
            of(&both.cameras[i]),
            of(&own),
            of(&parse(&text(&[alone[i]])).unwrap()),
        );
        let positions =
            |points: &[CloudPoint]| points.iter().map(|p| p.position).collect::<Vec<_>>();
        assert!(own.len() > 100 && positions(&of_list) == positions(&own));
        assert!(positions(&own) != positions(&exact));
    }
    scan(&both, &path.join("both"));
    let written = Scene::load(&path.join("both/resolved-scene.toml")).unwrap();
    for (camera, same) in both.cameras.iter().zip(written.cameras.iter()) {
        let [a, b] = [camera, same].map(|scene| Simulation::new(scene).unwrap().take(4).2);
        let positions = a.iter().map(|p| p.position);
        assert!(positions.eq(b.iter().map(|p| p.position)));
    }

    let message = |text: &str| parse(text).map(drop).unwrap_err().to_string();
    for (cameras, calibration, expected) in [
        (
            vec![FRONT, BACK],
            "\"one/calibration.json\"",
            "a list of 2 files, one per camera",
        ),
        (
            vec![FRONT, BACK],
            "[\"one/calibration.json\"]",
            "a list of 2 files, one per camera",
        ),
        (vec![FRONT], list, "one file"),
    ] {
        let found = message(&with(&cameras, calibration));
        assert!(found.contains(expected), "{found}");
    }
}

#[test]
fn mistakes_with_cameras_are_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("block.obj"), BLOCK).unwrap();
    let parse = |text: &str| Scene::parse(text, folder.path());
    let message = |text: &str| parse(text).map(drop).unwrap_err().to_string();
    let equal = format!("number = 1\n{BACK}");
    let found = message(&text(&[FRONT, &equal]));
    assert!(found.contains("camera.number: found 1"), "{found}");
    let zero = message(&text(&[&format!("number = 0\n{FRONT}")]));
    assert!(zero.contains("a whole number from 1 to 64"), "{zero}");
    let wrong = text(&[FRONT, BACK]).replacen("f_number = 8", "f_number = 0", 2);
    let wrong = wrong.replacen("f_number = 0", "f_number = 8", 1);
    let found = message(&wrong);
    // The message has the line of the second camera.
    let line = 1 + wrong[..wrong.rfind("f_number = 0").unwrap()]
        .matches('\n')
        .count();
    assert!(
        found.contains(&format!(":{line}: camera.f_number")),
        "{found}"
    );
    let both = parse(&text(&[FRONT, BACK])).unwrap();
    let Err(Error::Usage(found)) = Simulation::new(&both) else {
        panic!("a simulation has one camera");
    };
    assert!(found.contains("found 2 cameras, expected one"), "{found}");
    let third = both.of_camera_number(3).map(drop).unwrap_err().to_string();
    assert!(
        third.contains("found camera 3, expected one of 1, 2"),
        "{third}"
    );
}
