//! What the program says in each case that a person can get wrong, as a page:
//! `docs/messages.md` is what this test writes.

use crate::program::{PLANE, folder_with, run, scene};
use std::fs;
use std::path::Path;

/// What is changed in the scene, and what the message must hold.
struct Case {
    what: &'static str,
    changes: &'static [(&'static str, &'static str)],
    words: &'static [&'static str],
}

const fn case(
    what: &'static str,
    changes: &'static [(&'static str, &'static str)],
    words: &'static [&'static str],
) -> Case {
    Case {
        what,
        changes,
        words,
    }
}

/// Mistakes in a scene file.
const MISTAKES: &[Case] = &[
    case(
        "a key is misspelt",
        &[("power_mw", "power_mv")],
        &["scene.toml:13: laser.power_mv", "did you mean power_mw?"],
    ),
    case(
        "a letter too many",
        &[("exposure_ms = 0.01", "exposure_mss = 0.01")],
        &["camera.exposure_mss", "did you mean exposure_ms?"],
    ),
    case(
        "a path with backslashes",
        &[(
            PLANE,
            "mesh = { file = \"C:\\parts\\x.stl\", unit = \"mm\" }",
        )],
        &["scene.toml:6: part.mesh", "write / between folders"],
    ),
    case(
        "a path with backslashes that are escapes",
        &[(PLANE, "mesh = { file = \"new\\table.stl\", unit = \"mm\" }")],
        &[
            "scene.toml:6: part.mesh.file",
            "a backslash does not separate folders",
            "write /",
        ],
    ),
    case(
        "a key is in the wrong table",
        &[("[laser]\n", "[laser]\nreflectance = 0.5\n")],
        &[
            "scene.toml:12: laser.reflectance",
            "reflectance belongs in [part]",
        ],
    ),
    case(
        "a table is misspelt",
        &[("[camera]", "[camra]")],
        &["scene.toml:21: camra", "did you mean camera?"],
    ),
    case(
        "a choice is misspelt",
        &[("\"uniform\"", "\"unifrom\"")],
        &[
            "scene.toml:19: laser.line.profile",
            "did you mean \"uniform\"?",
        ],
    ),
    case(
        "a key is missing",
        &[("exposure_ms = 0.01\n", "")],
        &["camera.exposure_ms is missing, expected exposure_ms = ... in [camera]"],
    ),
    case(
        "a key is given twice",
        &[("power_mw = 10", "power_mw = 10\npower_mw = 20")],
        &[
            "scene.toml:14: laser.power_mw",
            "each key once; the first is in line 13",
        ],
    ),
    case(
        "a table is given as a list of tables",
        &[("[laser]", "[[laser]]")],
        &["scene.toml:11: laser: found [[laser]], a list of tables, expected [laser]"],
    ),
    case(
        "a table is given as a list",
        &[("{ size_mm = [16, 16] }", "[[16, 16]]")],
        &["scene.toml:6: part.plane: found [[16, 16]], expected a table"],
    ),
    case(
        "a step is higher than its block",
        &[(PLANE, "step_block = { size_mm = [9, 9, 3], step_mm = 4 }")],
        &["part.step_block.step_mm: found 4, expected less than the block's height, 3 mm"],
    ),
    case(
        "a sphere has a negative radius",
        &[(
            PLANE,
            "sphere = { radius_mm = -3, chordal_deviation_um = 20 }",
        )],
        &["part.sphere.radius_mm: found -3, expected more than 0"],
    ),
    case(
        "a sphere is to be too fine",
        &[(
            PLANE,
            "sphere = { radius_mm = 900, chordal_deviation_um = 0.001 }",
        )],
        &["part.sphere.chordal_deviation_um: found 0.001, expected a larger chord"],
    ),
    case(
        "a number has a comma",
        &[("power_mw = 10", "power_mw = 10,5")],
        &["scene.toml:13: laser.power_mw", "which is not TOML"],
    ),
    case(
        "a number is text",
        &[("power_mw = 10", "power_mw = \"ten\"")],
        &["scene.toml:13: laser.power_mw: found \"ten\", expected a number"],
    ),
    case(
        "pixels differ on a sensor without noise",
        &[("read_noise_e = 10\n", "dsnu_e = 5\n")],
        &["camera.dsnu_e: found 5, expected read_noise_e too"],
    ),
    case(
        "pixels differ by more than they give",
        &[(
            "read_noise_e = 10\n",
            "read_noise_e = 10\nprnu_percent = 80\n",
        )],
        &["camera.prnu_percent: found 80, expected a number from 0 to 25"],
    ),
    case(
        "more rows are to be read than there are",
        &[("tilt_deg", "roi_rows = [40, 20]\ntilt_deg")],
        &[
            "camera.roi_rows: found [40, 20], expected the first row and their number, within the sensor's 48 rows",
        ],
    ),
    case(
        "squares of pixels do not fill the sensor",
        &[(
            "resolution_px = [64, 48]",
            "resolution_px = [64, 48]\nbinning = 3",
        )],
        &["camera.binning: found 3, expected a divisor of the 64 columns and 48 rows"],
    ),
    case(
        "sums of counts have too many bits",
        &[(
            "bit_depth = 10",
            "bit_depth = 14\nbinning = 4\nbinning_mode = \"digital\"",
        )],
        &["camera.binning: found 4, expected fewer pixels or bits: their sum has 18 bits"],
    ),
    case(
        "one of several exposures is given",
        &[("exposure_ms = 0.01", "hdr_exposures_ms = [0.01]")],
        &["camera.hdr_exposures_ms: found [0.01], expected 2 to 4 different exposures"],
    ),
    case(
        "several exposures and a single one are given",
        &[(
            "exposure_ms = 0.01",
            "exposure_ms = 0.01\nhdr_exposures_ms = [0.01, 0.1]",
        )],
        &["camera.hdr_exposures_ms: found [0.01, 0.1], expected hdr_exposures_ms alone"],
    ),
    case(
        "merged counts are too high",
        &[("exposure_ms = 0.01", "hdr_exposures_ms = [0.01, 10]")],
        &[
            "camera.hdr_exposures_ms: found [0.01, 10], expected a shortest exposure at which full scale stays below 65536",
        ],
    ),
    case(
        "a housing's corners are swapped",
        &[(
            "[part]\n",
            "housing_bounds_mm = [[5, 5, 9], [-5, -5, 1]]\n[part]\n",
        )],
        &[
            "housing_bounds_mm: found [[5, 5, 9], [-5, -5, 1]], expected a lower corner and an upper one",
        ],
    ),
    case(
        "a sphere is to be measured on a cap that says no radius",
        &[("[scan]\n", "[accept]\ncap_half_angle_deg = 5\n\n[scan]\n")],
        &["accept.cap_half_angle_deg: found 5, expected a number from 20 to 80"],
    ),
    case(
        "a limit is below zero",
        &[(
            "[scan]\n",
            "[accept]\nmpe_um = { flatness = -1 }\n\n[scan]\n",
        )],
        &[
            "accept.mpe_um.flatness",
            "found -1, expected a finite number > 0",
        ],
    ),
    case(
        "frames are given with a list of poses",
        &[("frames = 3", "frames = 3\nposes = \"path.csv\"")],
        &["scan.frames: found 3, expected no frames in addition to scan.poses"],
    ),
];

/// Scenes that give nothing, or nothing worth having.
const WORTHLESS: &[Case] = &[
    case(
        "the laser looks away",
        &[("direction = [0, 0, -1]", "direction = [0, 0, 1]")],
        &["The laser looks away from the part"],
    ),
    case(
        "the camera looks away",
        &[("look_at_mm = [0, 0, 0]", "look_at_mm = [0, -900, 900]")],
        &["The camera looks away from the laser's light"],
    ),
    case(
        "the path misses the part",
        &[("start_mm = [0, -0.5, 0]", "start_mm = [0, -30, 0]")],
        &["at a distance of 21.0 mm", "frame 2"],
    ),
    case(
        "the light misses the part",
        &[("position_mm = [0, 0, 0]", "position_mm = [50, 0, 0]")],
        &["its rays miss the part"],
    ),
    case(
        "the part is above the range",
        &[("position_mm = [0, 0, 0]", "position_mm = [0, 0, 30]")],
        &["the part's top is", "mm above the near end"],
    ),
    case(
        "the part is below the range",
        &[("position_mm = [0, 0, 0]", "position_mm = [0, 0, -30]")],
        &["mm below the far end"],
    ),
    case(
        "the camera looks to the side",
        &[
            ("fan_deg = 12", "fan_deg = 60"),
            ("look_at_mm = [0, 0, 0]", "look_at_mm = [40, 0, 0]"),
        ],
        &["to the side of what the camera sees"],
    ),
    case(
        "a file in millimetres is said to be in metres",
        &[(PLANE, "mesh = { file = \"part.obj\", unit = \"m\" }")],
        &["is probably wrong: try part.mesh.unit = \"mm\""],
    ),
    case(
        "a file in metres is said to be in millimetres",
        &[(PLANE, "mesh = { file = \"metres.obj\", unit = \"mm\" }")],
        &["is probably wrong: try part.mesh.unit = \"m\""],
    ),
    case(
        "the laser is inside the part",
        &[
            (
                PLANE,
                "step_block = { size_mm = [20, 20, 20], step_mm = 2 }",
            ),
            ("position_mm = [0, 0, 0]", "position_mm = [0, 0, 90]"),
        ],
        &["The laser is inside the part in frame 0"],
    ),
    case(
        "the laser goes through the part",
        &[
            (
                PLANE,
                "step_block = { size_mm = [20, 20, 20], step_mm = 2 }",
            ),
            ("position_mm = [0, 0, 0]", "position_mm = [0, 40, 90]"),
            ("step_mm = 0.5\n", "step_mm = 35\n"),
        ],
        &["The laser passes through the part's surface after frame 0"],
    ),
    case(
        "the line is too dark",
        &[("power_mw = 10", "power_mw = 0.0001")],
        &["gives too dark a line: at most", "needed to detect it"],
    ),
    case(
        "the sensor saturates everywhere",
        &[("power_mw = 10", "power_mw = 100000")],
        &[
            "saturates the sensor: up to",
            "Lower camera.exposure_ms or laser.power_mw",
        ],
    ),
    case(
        "the housing touches the part",
        &[(
            "[part]\n",
            "housing_bounds_mm = [[-5, -20, -1], [5, 20, 40]]\n[part]\n",
        )],
        &["The sensor's housing (housing_bounds_mm) touches the part, first in frame 0, near"],
    ),
    case(
        "the step is 0",
        &[("step_mm = 0.5", "step_mm = 0")],
        &["all 3 frames are taken at the same place"],
    ),
    case(
        "a metal groove reflects light many times, with too few paths",
        &[
            (PLANE, "mesh = { file = \"groove.obj\", unit = \"mm\" }"),
            (
                "reflectance = 0.5",
                "surface = { metal = { name = \"iron\", roughness = 0.3 } }",
            ),
        ],
        &[
            "Indirect light has the maximum number of paths",
            "model.max_bounces = 1",
        ],
    ),
];

/// What `accept` and `emva` refuse.
const REFUSED: &[(&str, Case)] = &[
    (
        "accept",
        case(
            "a sphere does not fit the volume",
            &[("[scan]\n", "[accept]\nsphere_diameter_mm = 30\n\n[scan]\n")],
            &["accept.sphere_diameter_mm: found 30, expected at most"],
        ),
    ),
    (
        "accept",
        case(
            "a ball bar does not fit the volume",
            &[("[scan]\n", "[accept]\nball_bar_length_mm = 30\n\n[scan]\n")],
            &["accept.ball_bar_length_mm: found 30, expected at most"],
        ),
    ),
    (
        "accept",
        case(
            "the spheres of a ball bar stand in each other",
            &[("[scan]\n", "[accept]\nball_bar_length_mm = 0.1\n\n[scan]\n")],
            &["accept.ball_bar_length_mm: found 0.1, expected at least"],
        ),
    ),
    (
        "accept",
        case(
            "a plate does not fit the volume",
            &[("[scan]\n", "[accept]\nplate_side_mm = 30\n\n[scan]\n")],
            &["accept.plate_side_mm: found 30, expected at most"],
        ),
    ),
    (
        "accept",
        case(
            "a plate is tilted out of the range",
            &[
                ("resolution_px = [64, 48]", "resolution_px = [64, 16]"),
                ("[scan]\n", "[accept]\nplate_tilt_deg = 60\n\n[scan]\n"),
            ],
            &["accept.plate_tilt_deg: found 60, expected at most"],
        ),
    ),
    (
        "accept",
        case(
            "a point laser has no profiles",
            &[("line = {", "# line = {")],
            &[
                "camera.look_at_mm",
                "a line laser whose light the camera sees",
            ],
        ),
    ),
    (
        "emva",
        case(
            "a sensor without noise",
            &[("read_noise_e = 10\n", "")],
            &["camera.read_noise_e is missing, expected a sensor with noise"],
        ),
    ),
];

/// What they warn of.
const DOUBTFUL: &[(&str, Case)] = &[
    (
        "accept",
        case(
            "few seeds and few profiles",
            &[(
                "[scan]\n",
                "[accept]\nprofiles = 3\nheight_steps = 2\nrepeats = 2\n\n[scan]\n",
            )],
            &["2 seeds are few", "P_F has no value for every seed"],
        ),
    ),
    (
        "emva",
        case(
            "noise that rounding hides",
            &[],
            &["Read noise is 0.20 counts: below 0.4 rounding hides it"],
        ),
    ),
    (
        "emva",
        case(
            "counts that are cut off at 0",
            &[
                ("gain_dn_per_e = 0.02", "gain_dn_per_e = 0.2"),
                ("black_level_dn = 8", "black_level_dn = 2"),
            ],
            &["The black level of 2 counts is less than four times the noise"],
        ),
    ),
];

/// A sensor as a data sheet has it.
const SHEET: &str = "[data_sheet]\nstand_off_mm = 160\nmeasuring_range_mm = 90\nfield_near_mm = 82\nfield_far_mm = 118\n\
                     points_per_profile = 1280\ntriangulation_deg = 25\n";

/// What contradicts in it: what is changed, to what, and what the message holds.
const CONTRADICTIONS: &[(&str, &str, &str, &str)] = &[
    (
        "the points do not cover the field",
        "triangulation_deg = 25",
        "triangulation_deg = 25\nx_interval_um = 50",
        "data_sheet.x_interval_um: found 50, expected at least 78.1250, with which points_per_profile = 1280 cover \
         field_near_mm = 82 and field_far_mm = 118",
    ),
    (
        "two ranges differ",
        "triangulation_deg = 25",
        "triangulation_deg = 25\nhalf_range_mm = 30",
        "data_sheet.half_range_mm: found 30, expected 45, which follows from measuring_range_mm",
    ),
    (
        "the range begins behind the laser's exit",
        "stand_off_mm = 160",
        "reference_distance_mm = 40",
        "data_sheet.reference_distance_mm: found 40, expected more than 45",
    ),
    (
        "angle and baseline do not go together",
        "triangulation_deg = 25",
        "triangulation_deg = 25\nbaseline_mm = 70",
        "data_sheet.baseline_mm: found 70, expected at least 95.59: with triangulation_deg = 25",
    ),
    (
        "the range does not fit the rows",
        "triangulation_deg = 25",
        "triangulation_deg = 25\nrows = 200",
        "data_sheet.rows: found 200, expected at least",
    ),
    (
        "the lens is too long for the field",
        "triangulation_deg = 25",
        "triangulation_deg = 25\nfocal_length_mm = 50\npixel_pitch_um = 5.5",
        "data_sheet.focal_length_mm: found 50, expected at most 15.8",
    ),
    (
        "neither stand-off nor range",
        "stand_off_mm = 160\nmeasuring_range_mm = 90\n",
        "",
        "data_sheet: found [data_sheet], expected the distance of the range: stand_off_mm",
    ),
    (
        "no width of the field",
        "field_near_mm = 82\nfield_far_mm = 118\n",
        "",
        "data_sheet: found [data_sheet], expected a width of the field",
    ),
    (
        "a length below zero",
        "stand_off_mm = 160",
        "stand_off_mm = -1",
        "data_sheet.stand_off_mm: found -1, expected a number from 1e-3 to 1e6",
    ),
    (
        "laser or camera contain a value that follows from the sheet",
        "triangulation_deg = 25",
        "triangulation_deg = 25\n[camera]\nfocal_length_mm = 16",
        "camera.focal_length_mm: found 16, expected no value in addition to [data_sheet], from which it follows as",
    ),
];

/// The message of a sheet that contradicts.
fn contradiction((what, from, to, words): &(&str, &str, &str, &str)) -> String {
    assert!(SHEET.contains(from), "{what}");
    let folder = folder_with(
        "seed = 1\nspeckle = false\nsensor = \"sensor.toml\"\n[part]\nplane = { size_mm = [9, 9] }\nreflectance = 0.5\n\
         [scan]\nframes = 1\nstep_mm = 1\ndirection = [0, 1, 0]\n",
    );
    fs::write(folder.path().join("sensor.toml"), SHEET.replace(from, to)).unwrap();
    let (code, stdout, stderr) = run(folder.path(), &["check", "scene.toml"]);
    assert_eq!((code, stdout.as_str()), (65, ""), "{what}: {stderr}");
    let message = stderr.trim_end().trim_start_matches("lasertrace: ");
    assert!(message.contains(words), "{what}: {message}");
    message.to_owned()
}

/// A groove of 90° along y.
const GROOVE: &str = "v -8 -8 8\nv -8 8 8\nv 0 -8 0\nv 0 8 0\nv 8 -8 8\nv 8 8 8\n\
                      f 1 3 4\nf 1 4 2\nf 3 5 6\nf 3 6 4\n";

/// A square of 16 units and one of 0.016.
const SQUARE: &str = "v -8 -8 0\nv 8 -8 0\nv 8 8 0\nv -8 8 0\nf 1 2 3 4\n";

fn folder_of(case: &Case) -> tempfile::TempDir {
    let mut text = scene(PLANE);
    for (from, to) in case.changes {
        assert!(text.contains(from), "{}: {from}", case.what);
        text = text.replacen(from, to, 1);
    }
    let folder = folder_with(&text);
    fs::write(folder.path().join("part.obj"), SQUARE).unwrap();
    fs::write(folder.path().join("groove.obj"), GROOVE).unwrap();
    let small = SQUARE.replace('8', "0.008");
    fs::write(folder.path().join("metres.obj"), small).unwrap();
    folder
}

#[track_caller]
fn assert_says(case: &Case, message: &str) {
    for word in case.words {
        assert!(
            message.contains(word),
            "{}: no {word:?} in {message}",
            case.what
        );
    }
}

/// The message of a mistake: one line on stderr, exit code 65; and with `--json` the same
/// on stdout.
fn mistake(case: &Case) -> String {
    let folder = folder_of(case);
    let (code, stdout, stderr) = run(folder.path(), &["check", "scene.toml"]);
    assert_eq!((code, stdout.as_str()), (65, ""), "{}", case.what);
    let message = stderr
        .trim_end()
        .trim_start_matches("lasertrace: ")
        .to_owned();
    assert_says(case, &message);
    let (code, stdout, again) = run(folder.path(), &["check", "scene.toml", "--json"]);
    assert_eq!((code, again), (65, stderr));
    let json: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    let error = &json["error"];
    assert_eq!(error["message"], message);
    assert_eq!(
        (&error["exit_code"], &error["file"]),
        (&65.into(), &"scene.toml".into())
    );
    assert!(
        error["line"].is_u64() && error["key"].is_string(),
        "{error}"
    );
    message
}

/// A scene is asked for, and another file of this program's is given, or the other way round.
#[test]
fn a_file_of_another_kind_is_named() {
    let folder = folder_with(&scene(PLANE));
    let sweep = "scene = \"scene.toml\"\n[grid]\n\"camera.f_number\" = [8, 11]\n";
    fs::write(folder.path().join("sweep.toml"), sweep).unwrap();
    let recipe = "scene = \"scene.toml\"\nsamples = 2\n";
    fs::write(folder.path().join("set.toml"), recipe).unwrap();
    let sensors = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors");
    let sensor = |name: &str| sensors.join(name).to_str().unwrap().to_owned();
    let [sheet, other] = ["generic-20mm-405nm.toml", "generic-400mm-660nm.toml"].map(sensor);
    let parts = "[laser]\nwavelength_nm = 660\n[camera]\nf_number = 8\n";
    fs::write(folder.path().join("parts.toml"), parts).unwrap();
    let cases = [
        (
            &["scan", "render", "chart"][..],
            sheet.as_str(),
            "a sensor's file",
            "lasertrace begin",
        ),
        (&["scan"], &other, "a sensor's file", "lasertrace begin"),
        (
            &["scan"],
            "parts.toml",
            "a sensor's file",
            "lasertrace begin",
        ),
        (
            &["scan", "render", "calibrate"],
            "sweep.toml",
            "a sweep",
            "lasertrace sweep",
        ),
        (
            &["scan", "merge"],
            "set.toml",
            "a data set's recipe",
            "lasertrace dataset",
        ),
        (&["sweep", "dataset"], "scene.toml", "a scene", "scene = "),
        (&["sweep", "dataset"], &sheet, "a sensor's file", "scene = "),
    ];
    for (commands, file, kind, remedy) in cases {
        for command in commands {
            let (code, _, stderr) = run(folder.path(), &[command, file, "-o", "out"]);
            assert_eq!(code, 65, "{command} {file}: {stderr}");
            let found = format!("found {kind}, expected");
            assert!(
                stderr.contains(&found) && stderr.contains(remedy),
                "{command} {file}: {stderr}"
            );
        }
    }
    // In the other files of this program too.
    fs::write(
        folder.path().join("sweep.toml"),
        sweep.replace("scene.toml", "a\\scene.toml"),
    )
    .unwrap();
    let (code, _, stderr) = run(folder.path(), &["sweep", "sweep.toml", "-o", "out"]);
    assert_eq!(code, 65, "{stderr}");
    assert!(stderr.contains("write / between folders"), "{stderr}");
}

/// The warnings of a scene: lines of the page, exit code 0; with `--strict` an error before anything is written.
fn warnings(case: &Case) -> Vec<String> {
    let folder = folder_of(case);
    let (code, page, stderr) = run(folder.path(), &["check", "scene.toml"]);
    assert_eq!((code, stderr.as_str()), (0, ""), "{}", case.what);
    let lines = page
        .lines()
        .filter_map(|line| line.strip_prefix("warning: "));
    let warnings: Vec<String> = lines.map(str::to_owned).collect();
    assert_says(case, &warnings.join("\n"));
    for command in [&["check"][..], &["scan", "-o", "out"]] {
        let arguments = [command, &["scene.toml", "--strict"]].concat();
        let (code, stdout, stderr) = run(folder.path(), &arguments);
        assert_eq!((code, stdout.as_str()), (65, ""), "{}", case.what);
        let said = |warning: &String| stderr.contains(warning.as_str());
        assert!(warnings.iter().all(said), "{stderr}");
    }
    assert!(!folder.path().join("out").exists(), "{}", case.what);
    warnings
}

fn arguments(command: &str) -> Vec<&str> {
    let seeds: &[&str] = match command {
        "accept" => &["--seeds", "2"],
        _ => &[],
    };
    [&[command, "scene.toml", "-o", "out"], seeds].concat()
}

/// The message of what `accept` or `emva` refuses; nothing is written.
fn refused(command: &str, case: &Case) -> String {
    let folder = folder_of(case);
    let (code, stdout, stderr) = run(folder.path(), &arguments(command));
    assert_eq!((code, stdout.as_str()), (65, ""), "{}: {stderr}", case.what);
    assert!(!folder.path().join("out").exists(), "{}", case.what);
    let message = stderr.trim_end().trim_start_matches("lasertrace: ");
    assert_says(case, message);
    message.to_owned()
}

/// The warnings of `accept` or `emva`, which write all the same.
fn doubtful(command: &str, case: &Case) -> String {
    let folder = folder_of(case);
    let (code, page, stderr) = run(folder.path(), &arguments(command));
    assert_eq!((code, stderr.as_str()), (0, ""), "{}", case.what);
    let lines = page
        .lines()
        .filter_map(|line| line.strip_prefix("warning: "));
    let warnings = lines.collect::<Vec<_>>().join("<br>");
    assert_says(case, &warnings);
    warnings
}

fn row(what: &str, message: &str) -> String {
    format!("| {what} | {} |\n", message.replace('|', "\\|"))
}

#[test]
fn every_case_gives_the_message_that_the_page_of_messages_says() {
    let mut page = String::from(
        "# Messages\n\nThis page is written by the test `tests/program/messages.rs`, which checks \
         each message. In each case, the scene of `tests/common/program.rs` has one mistake.\n\n\
         ## Mistakes in a scene file\n\nEach mistake gives one line on stderr and exit code 65. \
         `--json` gives an object on stdout: `error.message`, `file`, `line`, `key`, `found`, \
         `expected`, `hint`.\n\n| case | message |\n|---|---|\n",
    );
    for case in MISTAKES {
        page += &row(case.what, &mistake(case));
    }
    page += "\n## Data sheets that contradict\n\nMessages about sensor files name both values. The sheet of \
             `tests/program/messages.rs` has one change in each case.\n\n| case | message |\n|---|---|\n";
    for case in CONTRADICTIONS {
        page += &row(case.0, &contradiction(case));
    }
    page += "\n## Scenes without useful results\n\n`check` and `scan` print these warnings, and the \
             report and `summary.json` (`warnings`) contain them. With `--strict`, the exit code \
             is 65.\n\n| case | message |\n|---|---|\n";
    for case in WORTHLESS {
        page += &row(case.what, &warnings(case).join("<br>"));
    }
    page += "\n## Acceptance tests and image sets\n\n`accept` and `emva` refuse these files with one line on stderr and exit \
             code 65, and write nothing.\n\n| command | case | message |\n|---|---|---|\n";
    for (command, case) in REFUSED {
        page += &row(
            &format!("`{command}` | {}", case.what),
            &refused(command, case),
        );
    }
    page += "\nThese warnings are printed, and are written to `accept.json` and `emva.json` (`warnings`).\n\n\
             | command | case | message |\n|---|---|---|\n";
    for (command, case) in DOUBTFUL {
        page += &row(
            &format!("`{command}` | {}", case.what),
            &doubtful(command, case),
        );
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let kept = fs::read_to_string(root.join("docs/messages.md")).unwrap_or_default();
    let written = Path::new(env!("CARGO_TARGET_TMPDIR")).join("messages.md");
    fs::write(&written, &page).unwrap();
    assert!(
        kept == page,
        "messages have changed; look at them, then\n  cp {} docs/messages.md",
        written.display()
    );
}

/// A good scene's page: no warning, the numbers a person looks for, none in JSON or with
/// all digits of a double.
#[test]
fn check_prints_a_page_to_read_and_json_only_if_asked() {
    let folder = folder_with(&scene(
        "sphere = { radius_mm = 4, chordal_deviation_um = 20 }",
    ));
    let (code, page, _) = run(folder.path(), &["check", "scene.toml"]);
    assert_eq!(code, 0);
    for words in [
        "No warnings: the sensor measures the part on this path.",
        "measuring range",
        "height per pixel",
        "the sensor moves 0.500 mm from frame to frame, 1.00 mm in all",
        "The whole scan, about",
        "closed, normals outward",
    ] {
        assert!(page.contains(words), "no {words:?} in\n{page}");
    }
    assert!(!page.contains(['{', '}']), "{page}");
    let long = |word: &str| word.chars().filter(char::is_ascii_digit).count() > 9;
    assert!(!page.split_whitespace().any(long), "{page}");
    let (_, json, _) = run(folder.path(), &["check", "scene.toml", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["warnings"], serde_json::json!([]));
    assert!(json["sensor"]["places"][0]["distance_mm"].is_f64());
}

/// A mistake on the command line is an object too.
#[test]
fn a_wrong_command_line_is_said_in_json_too() {
    let folder = folder_with(&scene(PLANE));
    let (code, stdout, stderr) = run(folder.path(), &["chek", "scene.toml", "--json"]);
    assert_eq!(code, 64);
    let json: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(json["error"]["exit_code"], 64);
    let message = json["error"]["message"].as_str().unwrap();
    assert!(
        stderr.contains(message) && message.contains("chek"),
        "{message}"
    );
}
