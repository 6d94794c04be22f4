//! Sensors in files of their own, written as data sheets: what was put in is what the sensor does.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{folder_with, run};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::{CheckReport, RunControl, check};
use lasertrace::scene::Scene;
use quick_xml::events::Event;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

static STOP: AtomicBool = AtomicBool::new(false);

/// The generic sensors.
fn sensors() -> Vec<PathBuf> {
    all_sensors(true)
}

/// The sensors of printed data sheets.
fn library() -> Vec<PathBuf> {
    all_sensors(false)
}

fn all_sensors(generic: bool) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors");
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|f| f.unwrap().path())
        .filter(|f| f.extension().is_some_and(|kind| kind == "toml"))
        .filter(|f| {
            let name = f.file_name().unwrap().to_string_lossy().into_owned();
            name.starts_with("generic-") == generic
        })
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
        notice: None,
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
            "field_far_mm = 118\nx_interval_um = 50",
            "sensor.toml:8: data_sheet.x_interval_um: found 50, expected at least",
        ),
        (
            "field_far_mm = 118",
            "field_far_mm = \"x\"",
            "sensor.toml:7: data_sheet.field_far_mm: found \"x\", expected a number",
        ),
        (
            "measuring_range_mm = 90\n",
            "x_interval_um = [1, 2, 3]\n",
            "data_sheet.x_interval_um: found [1, 2, 3], a list of 3, expected a number or a list of two numbers",
        ),
        (
            "f_number = 8",
            "f_numer = 8",
            "data_sheet.f_numer: found a key that [data_sheet] does not have",
        ),
        (
            "pixel_pitch_um",
            "[part]\npixel_pitch_um",
            "sensor.toml:13: part: found a key that a sensor does not have, expected data_sheet, laser, camera, housing_bounds_mm, field_of_view_mm, accept, systematic or measure",
        ),
        (
            "pixel_pitch_um = 5.5",
            "[camera]\nfocal_length_mm = 16",
            "sensor.toml:14: camera.focal_length_mm: found 16, expected no value in addition to [data_sheet], from which it follows as",
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
        "Derived sensor properties",
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
        let more = format!("[camera]\nexposure_ms = 0.1\nmax_full_frame_rate_hz = 50\n{camera}");
        Scene::parse(&scene_with(&file, &more), "".as_ref()).unwrap()
    };
    let [whole, piece] = ["", "roi_rows = [96, 64]"].map(scene);
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
        "housing_bounds_mm = [[-40, -80, 60], [40, 20, 230]]\n[part]",
    ));
    let (code, page, stderr) = run(folder.path(), &["check", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        page.contains("nearer than the measuring range") && page.contains("most in frame 0"),
        "{page}"
    );
    // At x = −40 the plane is 48 mm high, at −60 it is 71 mm: outside the housing.
    assert!(!page.contains("housing_bounds_mm"), "{page}");
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
            "Derived sensor properties",
            "measuring range",
            "follows from the data sheet",
            "ASSUMED",
        ] {
            assert!(page.contains(words), "{}: {words}: {page}", file.display());
        }
        assert!(!page.contains("warning:"), "{page}");
    }
}

/// Values of a sheet with a key each.
fn sheet_of(file: &Path) -> toml::Table {
    let text: toml::Table = fs::read_to_string(file).unwrap().parse().unwrap();
    text["data_sheet"].as_table().unwrap().clone()
}

fn float(value: &toml::Value) -> f64 {
    value
        .as_float()
        .unwrap_or_else(|| value.as_integer().unwrap() as f64)
}

/// Distances from the exit of the fields that a sheet prints, and their widths.
fn printed_fields(sheet: &toml::Table) -> Vec<(f64, f64)> {
    let given = |key: &str| sheet.get(key).map(float);
    let range = given("measuring_range_mm").unwrap();
    let near = given("stand_off_mm")
        .unwrap_or_else(|| given("reference_distance_mm").unwrap() - range / 2.0);
    [
        (near, "field_near_mm"),
        (near + range / 2.0, "field_reference_mm"),
        (near + range, "field_far_mm"),
    ]
    .into_iter()
    .filter_map(|(distance, key)| Some((distance, given(key)?)))
    .collect()
}

/// Each sensor of the library resolves without a warning. Its fields agree with the sheet within 1 %.
/// A single printed interval of the points agrees at the reference position within the rounding of
/// the number of columns, if the points per profile are not printed; a pair agrees at both ends
/// within half a unit of the last digit.
#[test]
fn the_library_has_the_printed_fields() {
    assert!(library().len() >= 22);
    for file in library() {
        let name = file.display();
        let sheet = sheet_of(&file);
        let scene = Scene::parse(&scene_with(file.to_str().unwrap(), ""), "".as_ref())
            .unwrap_or_else(|error| panic!("{name}: {error}"));
        let checked = checked(&scene);
        let sensor = checked.sensor.unwrap();
        let fields = printed_fields(&sheet);
        let [near, far] = sensor.ends();
        assert!((near / fields[0].0 - 1.0).abs() < 1e-6, "{name}: {near}");
        assert!(
            (far / fields.last().unwrap().0 - 1.0).abs() < 1e-6,
            "{name}: {far}"
        );
        for (distance, width) in fields {
            // The ends are found to within rounding.
            let found = sensor.field_at(distance.clamp(near, far)).unwrap();
            assert!(
                (found / width - 1.0).abs() < 0.01,
                "{name} at {distance}: {found} for {width}"
            );
        }
        let columns = f64::from(scene.camera.sensor.resolution.x);
        let per_column = |i: usize| sensor.places[i].um_per_px[0];
        match sheet.get("x_interval_um") {
            Some(toml::Value::Array(ends)) => {
                for (i, printed) in [(0, &ends[0]), (8, &ends[1])] {
                    let off = (per_column(i) - float(printed)).abs();
                    assert!(off <= 0.5, "{name}: {} for {printed}", per_column(i));
                }
            }
            Some(printed) if !sheet.contains_key("points_per_profile") => {
                let off = (per_column(4) / float(printed) - 1.0).abs();
                // The middle of the nine positions is the reference position. The scale at the
                // centre of the line is that of the whole line to the accuracy of the field.
                assert!(off < 1.0 / columns + 1e-3, "{name}: {}", per_column(4));
            }
            _ => {}
        }
    }
}

/// No point is outside the printed fields: a plane that crosses the range, and is wider than every
/// field, gives points up to all sides.
#[test]
fn no_point_is_outside_the_printed_fields() {
    for name in ["keyence-lj-v7060k", "keyence-lj-x8030", "lmi-gocator-2330"] {
        let files = library();
        let file = files
            .iter()
            .find(|file| file.file_stem().unwrap() == name)
            .unwrap();
        let fields = printed_fields(&sheet_of(file));
        for (turn, seed) in [(0.0, 1), (35.0, 2), (-50.0, 3)] {
            let text = scene_with(file.to_str().unwrap(), "")
                .replace(
                    "reflectance",
                    &format!("rotation_deg = [0, {turn}, 0]\nreflectance"),
                )
                .replace("seed = 1", &format!("seed = {seed}"));
            let scene = Scene::parse(&text, "".as_ref()).unwrap();
            let simulation = lasertrace::Simulation::new(&scene).unwrap();
            let (_, _, points) = simulation.take(0);
            assert!(points.len() > 50, "{name} {turn}: {}", points.len());
            let exit = scene.head_from_laser.translation.z;
            let mut nearest = f64::INFINITY;
            for point in &points {
                let in_head = scene.part_from_head(0).inverse().point(point.position);
                let distance = exit - in_head.z;
                let width = fields.windows(2).find_map(|pair| {
                    let [(a, near), (b, far)] = [pair[0], pair[1]];
                    let inside = (a - 1e-9..=b + 1e-9).contains(&distance);
                    inside.then(|| near + (far - near) * (distance - a) / (b - a))
                });
                let width = width.unwrap_or_else(|| panic!("{name} {turn}: {distance}"));
                let left = width / 2.0 - in_head.x.abs();
                assert!(left > -1e-9, "{name} {turn}: {} at {distance}", in_head.x);
                let ends = [fields[0].0, fields.last().unwrap().0];
                let to_end = ends.map(|end| (distance - end).abs());
                nearest = nearest.min(left).min(to_end[0]).min(to_end[1]);
            }
            // The last column inside the field is less than two columns from its border.
            let columns = f64::from(scene.camera.sensor.resolution.x);
            assert!(
                nearest < 4.0 * fields[0].1 / columns,
                "{name} {turn}: {nearest}"
            );
        }
    }
}

/// Keys of a sheet drawn at random, with their values.
fn random_sheet(random: &mut crate::random::Random) -> Vec<(&'static str, String)> {
    let range = random.scale(2.0, 800.0);
    let near_end = range * random.scale(0.4, 6.0);
    let near = range * random.scale(0.3, 2.0);
    let mut keys = vec![
        ("measuring_range_mm", range.to_string()),
        ("field_near_mm", near.to_string()),
        (
            "field_far_mm",
            (near * random.between(0.6, 3.0)).to_string(),
        ),
    ];
    match random.choice(2) {
        0 => keys.push(("stand_off_mm", near_end.to_string())),
        _ => keys.push((
            "reference_distance_mm",
            (near_end + range / 2.0).to_string(),
        )),
    }
    let optional = [
        (
            "field_reference_mm",
            (near * random.between(0.8, 2.0)).to_string(),
        ),
        (
            "points_per_profile",
            (320 + random.choice(3000)).to_string(),
        ),
        (
            "x_interval_um",
            format!("{}", random.scale(2.0, 900.0).round()),
        ),
        (
            "z_resolution_um",
            format!("{:.1}", random.scale(0.5, 300.0)),
        ),
        ("triangulation_deg", random.between(8.0, 50.0).to_string()),
        ("baseline_mm", random.scale(10.0, 500.0).to_string()),
        ("rows", (200 + random.choice(1500)).to_string()),
        ("focal_length_mm", random.scale(4.0, 60.0).to_string()),
        ("pixel_pitch_um", random.between(2.0, 10.0).to_string()),
        ("laser_class", "\"3R\"".to_owned()),
    ];
    for key in optional {
        if random.choice(4) == 0 {
            keys.push(key);
        }
    }
    keys
}

/// Asserts that the key of a message, and the keys with values in it, are in the sheet.
fn assert_own_keys(sheet: &str, keys: &[(&str, String)], mistake: &lasertrace::InputError) {
    let key = mistake.key.clone().unwrap();
    let name = key
        .strip_prefix("data_sheet")
        .unwrap_or_else(|| panic!("{sheet}{mistake}"));
    let name = name.trim_start_matches('.');
    assert!(
        name.is_empty() || keys.iter().any(|(k, _)| *k == name),
        "{sheet}{mistake}"
    );
    // Keys with a value are in the sheet.
    for word in mistake
        .expected
        .split(" = ")
        .map(|t| t.rsplit(' ').next().unwrap())
    {
        let known = word.contains("_mm") || word.contains("_um") || word.contains("_deg");
        assert!(
            !known || keys.iter().any(|(k, _)| *k == word) || name.is_empty(),
            "{sheet}{mistake}"
        );
    }
}

/// Sheets drawn at random, with keys left out: a sensor with these fields, or a message whose key is
/// one of the sheet.
#[test]
fn random_sheets_build_or_name_their_own_keys() {
    let mut built = 0;
    for seed in [1, 2, 3] {
        let mut random = crate::random::Random::new(seed);
        for _ in 0..40 {
            let keys = random_sheet(&mut random);
            let sheet: String = keys.iter().map(|(k, v)| format!("{k} = {v}\n")).collect();
            let text =
                scene_with("x", &format!("[data_sheet]\n{sheet}")).replace("sensor = \"x\"\n", "");
            match Scene::parse(&text, "".as_ref()) {
                Ok(scene) => {
                    built += 1;
                    let sensor = checked(&scene).sensor.unwrap();
                    let table: toml::Table = sheet.parse().unwrap();
                    let [a, b] = sensor.ends();
                    for (distance, width) in printed_fields(&table) {
                        let found = sensor.field_at(distance.clamp(a, b)).unwrap();
                        assert!(
                            (found / width - 1.0).abs() < 0.01,
                            "{sheet}: {found} {width}"
                        );
                    }
                }
                Err(lasertrace::Error::Input(mistake)) => {
                    assert_own_keys(&sheet, &keys, &mistake);
                }
                Err(error) => panic!("{sheet}{error}"),
            }
        }
    }
    assert!(built > 40, "{built}");
}

/// `check` prints each quantity that a sheet does not contain, with an interval, and a given value
/// fixes it.
#[test]
fn check_prints_estimates_with_intervals() {
    let folder = tempfile::tempdir().unwrap();
    for file in library().iter().step_by(extent(16, 5)) {
        let text = fs::read_to_string(file).unwrap();
        let path = folder.path().join("sensor.toml");
        for (key, fixed) in [
            ("triangulation_deg", "31"),
            ("f_number", "4"),
            ("rows", "700"),
            ("pixel_pitch_um", "4.5"),
        ] {
            fs::write(&path, &text).unwrap();
            let estimated = |page: &str| {
                let line = page
                    .lines()
                    .find(|line| line.trim_start().starts_with(key) && line.contains(" to "));
                line.map(str::to_owned)
            };
            let (code, page, stderr) = run(folder.path(), &["check", "sensor.toml"]);
            assert_eq!(code, 0, "{stderr}");
            assert!(
                page.contains("Estimated, as the data sheet does not contain it"),
                "{page}"
            );
            let line = estimated(&page).unwrap_or_else(|| panic!("{key}: {page}"));
            assert!(line.contains(", from "), "{line}");
            fs::write(&path, format!("{text}{key} = {fixed}\n")).unwrap();
            let (code, page, stderr) = run(folder.path(), &["check", "sensor.toml"]);
            if code == 0 {
                assert_eq!(estimated(&page), None, "{page}");
            } else {
                assert!(stderr.contains("data_sheet.rows: found 700"), "{stderr}");
            }
        }
    }
}
