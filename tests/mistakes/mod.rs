//! Mistakes that users make, each drawn from a seed, and the reason that `check` must give.

use lasertrace::math::rng::{Key, Purpose};
use std::fmt::Write;

/// A scene with a mistake.
pub struct Mistake {
    pub name: &'static str,
    pub scene: String,
    /// Files that the scene names.
    pub files: Vec<(&'static str, String)>,
    /// Reasons of which one must be given.
    pub expected: &'static [&'static str],
}

/// The bracket of `scenes/bracket` under its sensor with pixels of four times the pitch, without speckle.
pub fn bracket() -> String {
    let root = env!("CARGO_MANIFEST_DIR");
    let text = std::fs::read_to_string(format!("{root}/scenes/bracket/scene.toml")).unwrap();
    let mesh = format!("file = \"{root}/scenes/bracket/bracket.stl\"");
    [
        ("file = \"bracket.stl\"", mesh.as_str()),
        ("speckle = true", "speckle = false"),
        ("[1280, 512]", "[320, 128]"),
        ("pixel_pitch_um = 5.5", "pixel_pitch_um = 22"),
        ("exposure_ms = 0.06", "exposure_ms = 0.00375"),
    ]
    .into_iter()
    .fold(text, |text, (from, to)| changed(&text, from, to))
}

/// `text` with one change, which must be one.
#[track_caller]
pub fn changed(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "{from}");
    text.replacen(from, to, 1)
}

/// `text` with another path.
pub fn with_poses(text: &str) -> String {
    let (before, _) = text.split_once("[scan]").unwrap();
    format!("{before}[scan]\nposes = \"path.csv\"\n")
}

/// Passes along y over x, each of these rows of y.
pub fn passes(xs: &[f64], ys: impl Iterator<Item = f64> + Clone) -> String {
    let mut csv = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n".to_owned();
    for x in xs {
        for y in ys.clone() {
            writeln!(csv, "{x},{y},0,0,0,0").unwrap();
        }
    }
    csv
}

/// A box without its underside, in units of its file.
fn box_obj([x, y, z]: [f64; 3]) -> String {
    let mut obj = String::new();
    for k in [0.0, z] {
        for (i, j) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
            writeln!(obj, "v {} {} {k}", i * x, j * y).unwrap();
        }
    }
    obj + "f 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
}

const TOO_NEAR: &[&str] = &["above-range", "sensor-inside-part", "sensor-through-part"];

/// Mistakes in the scene of the bracket, drawn from a seed.
pub fn mistakes(seed: u64) -> Vec<Mistake> {
    let key = Key::new(seed, Purpose::Bootstrap);
    let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
    let sign = |i: u64| if key.bits(i) % 2 == 0 { 1.0 } else { -1.0 };
    let base = bracket();
    let placed = |x: f64, y: f64, z: f64| {
        let to = format!("position_mm = [{x}, {y}, {z}]\nreflectance");
        changed(&base, "reflectance", &to)
    };
    let other = |from: &str, to: String| changed(&base, from, &to);
    let unit = |unit: &str| other("unit = \"mm\"", format!("unit = \"{unit}\""));
    let mut all = Vec::new();
    let mut add = |name, scene: String, expected| {
        all.push(Mistake {
            name,
            scene,
            files: Vec::new(),
            expected,
        });
    };
    add("mesh in mm read as inches", unit("inch"), TOO_NEAR);
    add("mesh in mm read as cm", unit("cm"), TOO_NEAR);
    add("mesh in mm read as metres", unit("m"), &["unit-doubtful"]);
    let x = sign(0) * between(1, 18.0, 45.0);
    add("part displaced along the line", placed(x, 0.0, 0.0), &["displaced-sideways"]);
    let y = sign(2) * between(3, 8.0, 30.0);
    add("part displaced along the path", placed(0.0, y, 0.0), &["displaced-along-path"]);
    add("part too high", placed(0.0, 0.0, between(4, 15.0, 60.0)), &["above-range"]);
    add("part too low", placed(0.0, 0.0, -between(5, 20.0, 60.0)), &["below-range"]);
    add(
        "part missing: placed elsewhere",
        placed(0.0, sign(6) * between(7, 60.0, 900.0), 0.0),
        &["light-misses-part", "light-beside-part"],
    );
    let fine = changed(&base, "[320, 128]", "[640, 256]");
    let fine = changed(&fine, "pixel_pitch_um = 22", "pixel_pitch_um = 11");
    let tilt = format!(
        "focus_distance_mm = 251.967\ntilt_deg = [{}, 0]",
        between(8, 10.3, 13.0)
    );
    let tilted = changed(&fine, "focus_distance_mm = 252", &tilt);
    add("Scheimpflug tilt of the wrong sign", tilted, &["out-of-focus"]);
    let focus = 252.0 * (1.0 + sign(9) * between(10, 0.2, 0.4));
    let focus = format!("focus_distance_mm = {focus}");
    add("lens focused elsewhere", other("focus_distance_mm = 252", focus), &["out-of-focus"]);
    let many = (20e6 * between(11, 0.5, 2.0)) as u64;
    let many = format!("frames = {many}");
    add("20 million frames", other("frames = 219", many.clone()), &["mostly-outside-part"]);
    let many = changed(&other("frames = 219", many), "step_mm = 0.2", "step_mm = 0.000002");
    add("20 million steps of nanometres", many, &["steps-too-short"]);
    let slow = format!("frames = 219\nframe_rate_hz = {}", between(12, 0.0005, 0.007));
    add("frame rate in kHz read as Hz", other("frames = 219", slow), &["long-path"]);
    let exposure = |times: f64| {
        let to = format!("exposure_ms = {}", 0.00375 * times);
        other("exposure_ms = 0.00375", to)
    };
    add("exposure too long", exposure(between(13, 12.0, 100.0)), &["saturated"]);
    add("exposure too short", exposure(1.0 / between(14, 50.0, 500.0)), &["too-dark"]);
    let fan = format!("fan_deg = {}", between(15, 0.3, 0.5));
    add("fan angle in radians", other("fan_deg = 24", fan), &["saturated", "displaced-sideways"]);
    let up = other("direction = [0, 0, -1]", "direction = [0, 0, 1]".to_owned());
    add("laser up", up, &["laser-looks-away"]);
    let lean = format!("direction = [0, {}, -1]", sign(16) * between(17, 0.08, 0.4));
    add(
        "laser inclined",
        other("direction = [0, 0, -1]", lean),
        &["displaced-along-path", "light-misses-part", "above-range", "below-range"],
    );
    let look = format!("look_at_mm = [0, 0, {}]", between(18, 50.0, 90.0));
    add("camera looks too high", other("look_at_mm = [0, 0, 15]", look), &["below-range"]);
    let away = format!("look_at_mm = [0, {}, 400]", -between(19, 200.0, 900.0));
    add("camera looks away", other("look_at_mm = [0, 0, 15]", away), &["camera-looks-away"]);
    add("no step", other("step_mm = 0.2", "step_mm = 0".to_owned()), &["no-motion"]);
    let rows = format!("[320, 128]\nread_rows = [{}, 16]", key.bits(20) % 30);
    add("rows read beside the part", other("[320, 128]", rows), &["above-range", "below-range"]);
    with_files(&base, &between, all)
}

/// Those with files of their own.
fn with_files(
    base: &str,
    between: &impl Fn(u64, f64, f64) -> f64,
    mut all: Vec<Mistake>,
) -> Vec<Mistake> {
    let length = between(30, 30.0, 400.0);
    let ys = (0..219).map(|i| (f64::from(i) / 218.0 - 0.5) * length);
    all.push(Mistake {
        name: "robot path in metres",
        scene: with_poses(base),
        files: vec![("path.csv", passes(&[0.0], ys.clone().map(|y| y * 1e-3)))],
        expected: &["steps-too-short"],
    });
    let (before, after) = base.split_once("mesh = {").unwrap();
    let (_, after) = after.split_once('}').unwrap();
    let plane = format!("{before}plane = {{ size_mm = [250, 40] }}\nposition_mm = [0, 0, 15]{after}");
    let apart = between(31, 62.0, 90.0);
    let xs = [-1.0, 0.0, 1.0].map(|i| i * apart);
    all.push(Mistake {
        name: "passes too far apart",
        scene: with_poses(&plane),
        files: vec![("path.csv", passes(&xs, (0..41).map(|i| f64::from(i) - 20.0)))],
        expected: &["passes-too-far-apart"],
    });
    let size = [60.0, 40.0, 30.0].map(|mm| mm * 1e-3 * between(32, 0.7, 1.3));
    let mesh = format!("{before}mesh = {{ file = \"part.obj\", unit = \"mm\" }}{after}");
    all.push(Mistake {
        name: "mesh in metres read as mm",
        scene: mesh,
        files: vec![("part.obj", box_obj(size))],
        expected: &["unit-doubtful"],
    });
    all
}
