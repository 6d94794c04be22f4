//! Sensors that nobody would build: every command ends, in order and with finite numbers, or says what is wrong; and
//! what takes long shows how far it is and stops when told. Sensors are drawn from a seed, the same on every run.

#![cfg(target_os = "linux")]

use crate::effort::extent;
use crate::program::{PLANE, folder_with, scene};
use crate::random::Random;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// A run that has not ended then hangs.
const HANGS: Duration = Duration::from_secs(60);

/// The scene with these keys' values.
fn with(values: &[(&str, String)]) -> String {
    let text = scene(PLANE).replace("save_images = true", "save_images = false");
    let lines = text.lines().map(|line| {
        let key = line.split(" = ").next().unwrap();
        let new = values.iter().find(|(name, _)| *name == key);
        new.map_or(line.to_owned(), |(_, value)| format!("{key} = {value}"))
    });
    lines.collect::<Vec<_>>().join("\n") + "\n"
}

/// The same with the camera (or, first, the laser) at this place.
fn placed(first: bool, [x, y, z]: [f64; 3]) -> String {
    let text = with(&[]);
    let old = match first {
        true => "position_mm = [0, 0, 100]",
        false => "position_mm = [0, -57.5, 99.6]",
    };
    assert!(text.contains(old));
    text.replace(old, &format!("position_mm = [{x:?}, {y:?}, {z:?}]"))
}

fn start(folder: &Path, arguments: &str) -> Child {
    Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .args(arguments.split(' '))
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn interrupt(child: &Child) {
    let kill = format!("kill -INT {}", child.id());
    let told = Command::new("sh").args(["-c", &kill]).status().unwrap();
    assert!(told.success());
}

/// Runs a command, and interrupts it after `patience`. Returns its exit code and stderr.
fn run(folder: &Path, arguments: &str, patience: Duration) -> (i32, String) {
    let mut child = start(folder, arguments);
    let begun = Instant::now();
    let mut told = false;
    while child.try_wait().unwrap().is_none() {
        if begun.elapsed() > patience + HANGS {
            let _ = child.kill();
            panic!("{arguments}: deaf");
        }
        if !told && begun.elapsed() > patience {
            interrupt(&child);
            told = true;
        }
        sleep(Duration::from_millis(5));
    }
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    let stdout = String::from_utf8(output.stdout).unwrap();
    let code = output.status.code();
    let code = code.unwrap_or_else(|| panic!("{arguments}: {}: {stderr}", output.status));
    for word in ["NaN", "inf ", "-inf"] {
        assert!(!stdout.contains(word), "{arguments}: {stdout}");
    }
    (code, stderr)
}

/// Every number in the files of an output folder is finite.
fn assert_finite(out: &Path, what: &str) {
    for entry in fs::read_dir(out).into_iter().flatten() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if path.is_dir() {
            continue;
        }
        let bytes = fs::read(&path).unwrap();
        if name.ends_with(".svg") || name.ends_with(".json") {
            let text = String::from_utf8(bytes).unwrap();
            assert!(
                !text.contains("NaN") && !text.contains("inf\""),
                "{what}: {name}"
            );
        } else if name == "profiles.npy" {
            let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
            for point in bytes[header..].chunks_exact(106) {
                // After frame and column, before the flags.
                let numbers: Vec<f64> = (point[8..104].chunks_exact(8))
                    .map(|number| f64::from_le_bytes(number.try_into().unwrap()))
                    .collect();
                assert!(numbers.iter().all(|x| x.is_finite()), "{what}: {numbers:?}");
                // u_position_mm, u_deviation_mm, repeatability_mm.
                assert!(
                    numbers[7..10].iter().all(|x| *x > 0.0),
                    "{what}: {numbers:?}"
                );
            }
        }
    }
}

/// Runs a command to its end, which must be a result or a refusal; the numbers that it wrote are finite.
fn ends(text: &str, arguments: &str, what: &str) -> (i32, String) {
    let folder = folder_with(text);
    let (code, stderr) = run(folder.path(), arguments, 5 * HANGS);
    assert!(matches!(code, 0 | 64 | 65), "{what}: {code}\n{stderr}");
    if code != 0 {
        assert!(
            !stderr.contains("NaN") && !folder.path().join("out/sheet.json").exists(),
            "{what}: {stderr}"
        );
    }
    assert_finite(&folder.path().join("out"), what);
    (code, stderr)
}

/// A camera that looks along or up the beam sees light far away, in the case of the issue without end.
#[test]
fn a_measuring_range_without_end_is_refused_or_measured() {
    let mut random = Random::new(11);
    let mut places = vec![[0.0, -57.5, 0.0]];
    places.extend((0..3).map(|_| {
        let beside = random.scale(1.0, 1e4);
        [0.0, -beside, random.between(-0.5, 0.5) * beside]
    }));
    for place in places {
        for command in [
            "uncertainty scene.toml --range -o out",
            "calibrate scene.toml -o out",
            "check scene.toml",
        ] {
            let what = format!("{command}: camera at {place:?}");
            ends(&placed(false, place), command, &what);
        }
    }
    println!("tried 12 runs");
}

#[test]
fn a_laser_far_away_is_refused_or_measured() {
    let mut random = Random::new(12);
    let mut distances = vec![1e6];
    distances.extend((0..3).map(|_| random.scale(1e4, 1e9)));
    for distance in distances {
        let what = format!("laser at {distance} mm");
        ends(
            &placed(true, [0.0, 0.0, distance]),
            "uncertainty scene.toml --range -o out",
            &what,
        );
    }
    println!("tried 4 runs");
}

/// Counts that show no light: too small a gain or well, a black level at the end of the scale, hardly any light. A point
/// then has neither a row nor an uncertainty, and is not there.
#[test]
fn points_that_no_image_shows_are_not_written() {
    let mut random = Random::new(13);
    let mut number = |low: f64, high: f64| format!("{:e}", random.scale(low, high));
    let mut cases = vec![("gain_dn_per_e", "1e-6".to_owned())];
    for _ in 0..3 {
        cases.push(("gain_dn_per_e", number(1e-12, 1e-3)));
        cases.push(("full_well_e", number(1e-3, 1e2)));
        cases.push(("black_level_dn", number(900.0, 1e6)));
        cases.push(("power_mw", number(1e-12, 1e-2)));
        cases.push(("exposure_ms", number(1e-9, 1e-4)));
        cases.push(("f_number", number(50.0, 1e4)));
        cases.push(("read_noise_e", number(1e2, 1e9)));
    }
    cases.push(("power_mw", "0".to_owned()));
    let mut refused = 0;
    for (key, value) in &cases {
        let what = format!("{key} = {value}");
        let text = with(&[(key, value.clone())]);
        for arguments in [
            "scan scene.toml --geometry-only -o out",
            "scan scene.toml -o out",
        ] {
            let (code, stderr) = ends(&text, arguments, &what);
            if code == 65 {
                refused += 1;
                assert!(stderr.contains("expected"), "{what}: {stderr}");
            }
        }
    }
    assert!(refused > 0 && refused < 2 * cases.len());
    println!("tried {} runs", 2 * cases.len());
}

/// Values of a sensor, each far from what is built.
fn hostile(random: &mut Random) -> (String, Vec<(&'static str, String)>) {
    let mut values = Vec::new();
    for _ in 0..1 + random.choice(3) {
        let f = random.scale(0.1, 1e4);
        let (key, value) = match random.choice(12) {
            0 => ("f_number", format!("{:e}", random.scale(0.1, 1e4))),
            1 => {
                values.push((
                    "focus_distance_mm",
                    format!("{:e}", f * (1.0 + random.scale(1e-3, 1e3))),
                ));
                ("focal_length_mm", format!("{f:e}"))
            }
            2 => ("gain_dn_per_e", format!("{:e}", random.scale(1e-9, 1e9))),
            3 => {
                let [columns, rows] = [(); 2].map(|()| random.scale(1.0, 4096.0) as u32);
                ("resolution_px", format!("[{columns}, {rows}]"))
            }
            4 => ("pixel_pitch_um", format!("{:e}", random.scale(1e-2, 1e4))),
            5 => (
                "tilt_deg",
                format!(
                    "[{:?}, {:?}]",
                    random.between(-80.0, 80.0),
                    random.between(-80.0, 80.0)
                ),
            ),
            6 => ("full_well_e", format!("{:e}", random.scale(1.0, 1e9))),
            7 => ("exposure_ms", format!("{:e}", random.scale(1e-9, 1e6))),
            8 => ("waist_radius_um", format!("{:e}", random.scale(1.0, 1e6))),
            9 => (
                "waist_distance_mm",
                format!("{:e}", -random.scale(1e-3, 1e6)),
            ),
            10 => (
                "look_at_mm",
                format!(
                    "[0, {:?}, {:?}]",
                    random.between(-100.0, 100.0),
                    random.between(-1e3, 99.0)
                ),
            ),
            _ => ("read_noise_e", format!("{:e}", random.scale(1e-6, 1e9))),
        };
        values.push((key, value));
    }
    let text = with(&values);
    let speckle = ["speckle = false", "speckle = true"][random.choice(2)];
    (text.replace("speckle = false", speckle), values)
}

/// Each of these commands on each sensor ends by itself within 8 s, or in order after SIGINT.
#[test]
fn hostile_sensors_end_every_command_in_order() {
    let mut random = Random::new(14);
    let mut runs = 0;
    for _ in 0..extent(1, 8) {
        let (text, values) = hostile(&mut random);
        for arguments in [
            "uncertainty scene.toml --range -o out",
            "uncertainty scene.toml --static --seeds 4 -o out",
            "uncertainty scene.toml --seeds 4 -o out",
            "calibrate scene.toml -o out",
            "accept scene.toml --seeds 2 -o out",
            "wave scene.toml --realisations 2 -o out",
            "chart scene.toml --frames 1 --rounds 1 -o out",
            "emva scene.toml -o out",
            "render scene.toml --frame 0 -o out",
        ] {
            let folder = folder_with(&text);
            let (code, stderr) = run(folder.path(), arguments, Duration::from_secs(8));
            let what = format!("{arguments}: {values:?}: {code}\n{stderr}");
            assert!(matches!(code, 0 | 64 | 65 | 75), "{what}");
            assert!(!stderr.contains("NaN"), "{what}");
            let out = folder.path().join("out");
            assert_finite(&out, &what);
            if code == 75 {
                // What says that the run is whole comes last.
                for name in [
                    "sheet",
                    "uncertainty",
                    "summary",
                    "accept",
                    "wave",
                    "chart",
                    "emva",
                ] {
                    assert!(!out.join(format!("{name}.json")).exists(), "{what}");
                }
                let mut parts = fs::read_dir(&out).into_iter().flatten();
                let is_part = |name: &str| name.ends_with(".part");
                let part = parts
                    .find(|file| is_part(&file.as_ref().unwrap().file_name().to_string_lossy()));
                assert!(part.is_none(), "{what}: {part:?}");
            }
            runs += 1;
        }
    }
    println!("tried {runs} runs");
}

/// Without a terminal, lines on stderr show how far a long run is, and SIGINT ends it.
#[test]
fn a_long_run_shows_how_far_it_is_and_stops() {
    let folder = folder_with(&with(&[]));
    let commands = [
        ("accept scene.toml --seeds 99999 -o accept", "profiles"),
        ("wave --realisations 9999 -o wave", "motions"),
    ];
    let mut running = Vec::new();
    for (arguments, of) in commands {
        let mut child = start(folder.path(), arguments);
        let stderr = BufReader::new(child.stderr.take().unwrap());
        running.push((arguments, of, child, stderr));
    }
    for (arguments, of, mut child, stderr) in running {
        let begun = Instant::now();
        let line = (stderr.lines().map(Result::unwrap)).find(|line| line.contains(of));
        let line = line.unwrap_or_else(|| panic!("{arguments}: no progress"));
        assert!(line.contains(" of "), "{line}");
        assert!(begun.elapsed() < 2 * HANGS, "{arguments}");
        interrupt(&child);
        let told = Instant::now();
        while child.try_wait().unwrap().is_none() {
            assert!(told.elapsed() < HANGS, "{arguments}: deaf");
            sleep(Duration::from_millis(10));
        }
        assert_eq!(child.wait().unwrap().code(), Some(75), "{arguments}");
    }
}
