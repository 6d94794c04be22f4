//! The program, run from outside, and a scene that takes it milliseconds.

// Each test file uses what it needs of this.
#![allow(dead_code)]

use assert_cmd::Command;
use std::fs;
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

/// Exit code, stdout and stderr of one run in `folder`. A run that hangs fails.
pub fn run(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .current_dir(folder)
        .args(arguments)
        .timeout(Duration::from_secs(300))
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    let code = output
        .status
        .code()
        .unwrap_or_else(|| panic!("{arguments:?}: {}", output.status));
    (code, text(output.stdout), text(output.stderr))
}

pub fn folder_with(text: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("scene.toml"), text).unwrap();
    folder
}

/// Runs and asserts an error: its code, one line on stderr that holds all
/// `words`, nothing on stdout.
#[track_caller]
pub fn assert_error(folder: &Path, arguments: &[&str], code: i32, words: &[&str]) {
    let (found, stdout, stderr) = run(folder, arguments);
    assert_eq!(found, code, "{arguments:?}: {stderr}");
    assert_eq!(stdout, "", "{arguments:?}");
    for word in words {
        assert!(
            stderr.contains(word),
            "{arguments:?}: no {word:?} in {stderr}"
        );
    }
    // Usage errors show the usage below the message.
    assert!(
        code == 64 || stderr.lines().count() == 1,
        "{arguments:?}: {stderr}"
    );
}

/// The part of [`scene`] as it is unless a test wants another.
pub const PLANE: &str = "plane = { size_mm = [16, 16] }";

/// Text of a scene with every number of the format in it: a sensor of 64 × 48
/// pixels over a plane of 16 mm, three frames. `part` is a line of `[part]`.
pub fn scene(part: &str) -> String {
    format!(
        r#"seed = 7
speckle = false
save_images = true

[part]
{part}
reflectance = 0.5
position_mm = [0, 0, 0]
rotation_deg = [0, 0, 0]

[laser]
wavelength_nm = 660
power_mw = 10
waist_radius_um = 300
waist_distance_mm = 100
m_squared = 1.1
position_mm = [0, 0, 100]
direction = [0, 0, -1]
line = {{ fan_deg = 12, profile = "uniform", direction = [1, 0, 0] }}

[camera]
focal_length_mm = 16
f_number = 8
focus_distance_mm = 115
resolution_px = [64, 48]
pixel_pitch_um = 30
position_mm = [0, -57.5, 99.6]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
tilt_deg = [0, 0]
exposure_ms = 0.01
quantum_efficiency = 0.5
gain_dn_per_e = 0.02
bit_depth = 10
full_well_e = 50000
black_level_dn = 8
read_noise_e = 10

[scan]
frames = 3
step_mm = 0.5
direction = [0, 1, 0]
start_mm = [0, -0.5, 0]
"#
    )
}

/// Each number of the scene file, with the dotted key it belongs to.
pub fn numbers(text: &str) -> Vec<(String, std::ops::Range<usize>)> {
    let mut found = Vec::new();
    let mut table = String::new();
    let mut start = 0;
    for line in text.split_inclusive('\n') {
        if let Some(name) = line.trim_end().strip_prefix('[') {
            table = format!("{}.", name.trim_end_matches(']'));
        } else if let Some((name, value)) = line.split_once(" = ") {
            let mut key = format!("{table}{name}");
            let mut at = start + line.len() - value.len();
            for piece in value.split_inclusive([' ', ',', '[', ']', '{', '}', '\n']) {
                let word = piece.trim_end_matches([' ', ',', '[', ']', '{', '}', '\n']);
                if word.parse::<f64>().is_ok() {
                    found.push((key.clone(), at..at + word.len()));
                } else if word.starts_with(char::is_alphabetic) && value.starts_with('{') {
                    key = format!("{table}{name}.{word}");
                }
                at += piece.len();
            }
        }
        start += line.len();
    }
    found
}
