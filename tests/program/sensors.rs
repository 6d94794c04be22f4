//! Sensors in files of their own, written as data sheets: what was put in is what the sensor does.

#![cfg(unix)]

use crate::program::{folder_with, run};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::{CheckReport, RunControl, check};
use lasertrace::scene::Scene;
use quick_xml::events::Event;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

static STOP: AtomicBool = AtomicBool::new(false);

fn sensors() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors");
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|f| f.unwrap().path())
        .filter(|f| f.extension().is_some_and(|kind| kind == "toml"))
        .collect();
    files.sort();
    assert!(files.len() >= 4);
    files
}

/// A scene of a plane in the middle of a sensor's range.
fn scene_with(sensor: &str, more: &str) -> String {
    format!(
        "seed = 1\nspeckle = false\nsensor = {sensor:?}\n[part]\nplane = {{ size_mm = [900, 900] }}\nreflectance = 0.5\n\
         [scan]\nframes = 1\nstep_mm = 1\ndirection = [0, 1, 0]\n{more}"
    )
}

fn checked(scene: &Scene) -> CheckReport {
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        stop: &STOP,
    };
    check(scene, &control).unwrap()
}

/// Near and far field and the width of a pixel within 1 % of the sheet, the laser plane in focus to a tenth of a
/// pixel's blur, the range on the sensor, and the auto-exposed line at half of full scale.
#[test]
fn a_sensor_does_what_its_sheet_says() {
    for file in sensors() {
        let name = file.display();
        let sheet: toml::Table = fs::read_to_string(&file).unwrap().parse().unwrap();
        let given = |key: &str| {
            let value = &sheet["data_sheet"][key];
            value
                .as_float()
                .unwrap_or_else(|| value.as_integer().unwrap() as f64)
        };
        let scene = Scene::parse(&scene_with(file.to_str().unwrap(), ""), "".as_ref()).unwrap();
        let checked = checked(&scene);
        assert_eq!(checked.warnings, [], "{name}");
        let sensor = checked.sensor.unwrap();
        let near = given("stand_off_mm");
        let far = near + given("measuring_range_mm");
        let [first, last] = sensor.ends();
        assert!(first <= near && last >= far, "{name}: {first} {last}");
        // A field grows evenly with distance, so any two places give that at a third.
        let [a, b] = [sensor.places[0], sensor.places[8]];
        let at = |distance: f64, of: &dyn Fn(&lasertrace::run::SensorPlace) -> f64| {
            of(&a)
                + (of(&b) - of(&a)) * (distance - a.distance_mm) / (b.distance_mm - a.distance_mm)
        };
        for (distance, key) in [(near, "field_near_mm"), (far, "field_far_mm")] {
            let pixel = at(distance, &|p| p.um_per_px[0]) * given("points_per_profile") * 1e-3;
            assert!(
                (pixel / given(key) - 1.0).abs() < 0.01,
                "{name} {key}: {pixel}"
            );
            let found = sensor.field_at(distance).unwrap();
            assert!(
                (found / given(key) - 1.0).abs() < 0.01,
                "{name} {key}: {found}"
            );
        }
        assert!(
            sensor.places.iter().all(|place| place.blur_px < 0.1),
            "{name}"
        );
        assert!(
            (sensor.triangulation_deg - given("triangulation_deg")).abs() < 1.0,
            "{name}"
        );
        let light = sensor.light.unwrap();
        assert!(
            (light.bright / light.full_scale - 0.5).abs() < 0.01,
            "{name}: {light:?}"
        );
    }
}

/// What the scene says of laser and camera is laid over the sensor's, key by key, and over one of two keys for one thing.
#[test]
fn a_scene_lays_its_values_over_the_sensors() {
    let file = &sensors()[0];
    let file = file.to_str().unwrap();
    let more = "[laser]\npower_mw = 3\n[camera]\nexposure_ms = 0.25\n[data_sheet]\nf_number = 11\n";
    let scene = Scene::parse(&scene_with(file, more), "".as_ref()).unwrap();
    assert_eq!(scene.laser.beam.power_mw, 3.0);
    assert_eq!(scene.camera.sensor.exposure_ms, 0.25);
    assert_eq!(scene.camera.lens.f_number, 11.0);
    let plain = Scene::parse(&scene_with(file, ""), "".as_ref()).unwrap();
    assert_eq!(
        plain.camera.lens.focal_length,
        scene.camera.lens.focal_length
    );
}

#[test]
fn a_mistake_is_said_with_the_file_it_is_in() {
    let folder = folder_with(&scene_with("sensor.toml", ""));
    let path = folder.path();
    let good = fs::read_to_string(&sensors()[0]).unwrap();
    let said = |sensor: &str| {
        fs::write(path.join("sensor.toml"), sensor).unwrap();
        let (code, _, stderr) = run(path, &["check", "scene.toml"]);
        assert_eq!(code, 65, "{stderr}");
        stderr
    };
    for (change, to, words) in [
        (
            "field_far_mm = 118",
            "field_far_mm = 60",
            "sensor.toml:7: data_sheet.field_far_mm: found 60, expected more than field_near_mm = 82",
        ),
        (
            "field_far_mm = 118",
            "field_far_mm = \"x\"",
            "sensor.toml:7: data_sheet.field_far_mm: found \"x\", expected a number",
        ),
        (
            "field_far_mm = 118\n",
            "",
            "sensor.toml:3: data_sheet.field_far_mm is missing, expected field_far_mm = ... in [data_sheet]",
        ),
        (
            "f_number = 8",
            "f_numer = 8",
            "data_sheet.f_numer: found a key that [data_sheet] does not have",
        ),
        (
            "pixel_pitch_um",
            "[part]\npixel_pitch_um",
            "sensor.toml:13: part: found a key that a sensor does not have, expected data_sheet, laser, camera, housing_mm or accept",
        ),
        (
            "pixel_pitch_um = 5.5",
            "[camera]\nfocal_length_mm = 16",
            "sensor.toml:14: camera.focal_length_mm: found 16, expected nothing beside [data_sheet], from which it follows as",
        ),
        (
            "pixel_pitch_um = 5.5",
            "[camera]\nbit_depth = 3",
            "sensor.toml:14: camera.bit_depth: found 3, expected from 8 to 16",
        ),
        (
            "pixel_pitch_um = 5.5",
            "[camera]\nbit_depth = 8\nread_noise = 3",
            "sensor.toml:15: camera.read_noise: found a key that [camera] does not have",
        ),
    ] {
        assert!(good.contains(change));
        let said = said(&good.replace(change, to));
        assert!(said.contains(words), "{to}: {said}");
    }
    fs::remove_file(path.join("sensor.toml")).unwrap();
    let (code, _, stderr) = run(path, &["check", "scene.toml"]);
    assert!(
        code == 65
            && stderr.contains(
                "scene.toml:3: sensor: found \"sensor.toml\", expected the file of a sensor"
            ),
        "{stderr}"
    );
}

/// The page of `check` and its drawing, and the schema for editors.
#[test]
fn check_shows_the_sensor() {
    let file = &sensors()[1];
    let folder = folder_with(&scene_with(file.to_str().unwrap(), ""));
    let (code, said, stderr) = run(folder.path(), &["check", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    for words in [
        "The sensor on a page",
        "stand-off",
        "ASSUMED",
        "The whole laser plane is in focus",
    ] {
        assert!(said.contains(words), "{said}");
    }
    let svg = fs::read_to_string(folder.path().join("out/sensor.svg")).unwrap();
    assert!(svg.contains("</svg>") && !svg.contains("NaN"));
    let mut reader = quick_xml::Reader::from_str(&svg);
    loop {
        match reader.read_event().unwrap() {
            Event::Start(tag) | Event::Empty(tag) => {
                // An attribute given twice is an error.
                for attribute in tag.attributes() {
                    attribute.unwrap();
                }
            }
            Event::Eof => break,
            _ => {}
        }
    }
    let (_, schema, _) = run(folder.path(), &["schema", "--sensor"]);
    let schema: serde_json::Value = serde_json::from_str(&schema).unwrap();
    assert_eq!(schema["title"], "lasertrace sensor");
}

/// A region of interest shows what the whole sensor shows in its rows, and is read as much faster.
#[test]
fn a_region_of_interest_is_a_piece_of_the_whole_sensor() {
    let file = sensors()[0].to_str().unwrap().to_owned();
    let scene = |camera: &str| {
        let more = format!("[camera]\nexposure_ms = 0.1\nfull_frame_rate_hz = 50\n{camera}");
        Scene::parse(&scene_with(&file, &more), "".as_ref()).unwrap()
    };
    let [whole, piece] = ["", "read_rows = [96, 64]"].map(scene);
    let camera_from_head = whole.head_from_camera.inverse();
    for place in [
        DVec3::ZERO,
        DVec3::new(20.0, 3.0, -30.0),
        DVec3::new(-9.0, 0.0, 30.0),
    ] {
        let place = camera_from_head.point(place);
        let [a, b] = [&whole, &piece].map(|scene| scene.camera.project(place).unwrap());
        assert!((a - b - DVec2::Y * 96.0).length() < 1e-9, "{a} {b}");
    }
    let [all, some] =
        [&whole, &piece].map(|scene| checked(scene).sensor.unwrap().profiles_per_second);
    let rows = f64::from(whole.camera.sensor.resolution.y);
    assert!((all - 50.0).abs() < 1e-9, "{all}");
    assert!((some - 50.0 * rows / 64.0).abs() < 1e-9, "{some}");
    let binned = scene("binning = 2");
    let per_pixel = |scene: &Scene| checked(scene).sensor.unwrap().places[4].um_per_px[0];
    // A field is the same, of half the columns, to the second order of the step that derivatives take.
    assert!((per_pixel(&binned) / per_pixel(&whole) - 2.0).abs() < 1e-6);
}

/// A plane that is turned by 50° about y through the middle of the range leaves it at both ends of the line: of even rays over the fan
/// those that meet it outside the range. Of 129 rays one at each end may be rounded otherwise.
#[test]
fn check_says_what_of_the_part_leaves_the_field() {
    let file = sensors()[0].to_str().unwrap().to_owned();
    let turned =
        scene_with(&file, "").replace("reflectance", "rotation_deg = [0, 50, 0]\nreflectance");
    let scene = Scene::parse(&turned, "".as_ref()).unwrap();
    let figures = checked(&scene).sensor.unwrap();
    let found = figures.in_field.unwrap();
    let [near, far] = figures.ends();
    let exit = scene.head_from_laser.translation.z;
    let half = scene.laser.fan.as_ref().unwrap().angle / 2.0;
    let rays = (0..129).map(|i| half * (f64::from(i) + 0.5 - 64.5) / 64.5);
    // x = d·tan φ, and the plane is at z = exit − d = −x·tan 50° (turned towards +x it goes down).
    let depths: Vec<f64> = rays
        .map(|angle| exit / (1.0 - angle.tan() * 50f64.to_radians().tan()))
        .collect();
    let share = |of: &dyn Fn(f64) -> bool| depths.iter().filter(|d| of(**d)).count() as f64 / 129.0;
    let expected = [share(&|d| d < near), share(&|d| d > far)];
    for (found, expected) in [found.nearer, found.beyond].into_iter().zip(expected) {
        assert!(
            expected > 0.01 && (found - expected).abs() < 1.01 / 129.0,
            "{found} {expected}"
        );
    }
    let (frame, most) = found.worst.unwrap();
    let all = found.nearer + found.beyond + found.beside;
    assert!(frame == 0 && (most - all).abs() < 1e-9, "{found:?}");
    // The fan is as wide as the near field asks for, so that of a level plane some light lies beside the field.
    let level = Scene::parse(&scene_with(&file, ""), "".as_ref()).unwrap();
    let level = checked(&level).sensor.unwrap().in_field.unwrap();
    assert_eq!((level.nearer, level.beyond), (0.0, 0.0));

    let folder = folder_with(&turned.replace(
        "[part]",
        "housing_mm = [[-40, -80, 60], [40, 20, 230]]\n[part]",
    ));
    let (code, page, stderr) = run(folder.path(), &["check", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        page.contains("nearer than the measuring range") && page.contains("most in frame 0"),
        "{page}"
    );
    // At x = −40 the plane is 48 mm high, at −60 it is 71 mm: beside the housing.
    assert!(!page.contains("housing_mm"), "{page}");
    let svg = fs::read_to_string(folder.path().join("out/sensor.svg")).unwrap();
    assert!(svg.contains(">housing<"), "{svg}");
}

/// `check` of each sensor's file prints what follows from it.
#[test]
fn check_of_a_sensor_prints_what_follows() {
    for file in sensors() {
        let folder = tempfile::tempdir().unwrap();
        let (code, page, stderr) = run(folder.path(), &["check", file.to_str().unwrap()]);
        assert_eq!((code, stderr.as_str()), (0, ""), "{page}");
        for words in [
            "The file is a sensor's",
            "The sensor on a page",
            "measuring range",
            "follows from the data sheet",
            "ASSUMED",
        ] {
            assert!(page.contains(words), "{}: {words}: {page}", file.display());
        }
        assert!(!page.contains("warning:"), "{page}");
    }
}
