//! Mistakes that users make, each drawn from a seed, and the reason that `check` must give.

use lasertrace::math::rng::{Purpose, RngKey};
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

/// Poses of passes along y at each of `xs`.
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

/// Numbers of one variant.
struct Draw(RngKey);

impl Draw {
    fn between(&self, i: u64, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform(i)
    }

    fn sign(&self, i: u64) -> f64 {
        if self.0.bits(i).is_multiple_of(2) {
            1.0
        } else {
            -1.0
        }
    }
}

type Case = (&'static str, String, &'static [&'static str]);

/// Mistakes in the scene of the bracket, drawn from a seed.
pub fn mistakes(seed: u64) -> Vec<Mistake> {
    let draw = Draw(RngKey::new(seed, Purpose::Bootstrap));
    let base = bracket();
    let cases = of_the_part(&draw, &base).into_iter();
    let cases = cases.chain(of_the_sensor(&draw, &base));
    let cases = cases.chain(of_the_path(&draw, &base));
    let cases = cases.map(|(name, scene, expected)| Mistake {
        name,
        scene,
        files: Vec::new(),
        expected,
    });
    cases.chain(with_files(&base, &draw)).collect()
}

fn of_the_part(draw: &Draw, base: &str) -> Vec<Case> {
    let too_near: &[&str] = &["above-range", "sensor-inside-part", "sensor-through-part"];
    let unit = |unit: &str| changed(base, "unit = \"mm\"", &format!("unit = \"{unit}\""));
    let placed = |x: f64, y: f64, z: f64| {
        let to = format!("position_mm = [{x}, {y}, {z}]\nreflectance");
        changed(base, "reflectance", &to)
    };
    let x = draw.sign(0) * draw.between(1, 18.0, 45.0);
    let y = draw.sign(2) * draw.between(3, 8.0, 30.0);
    let far = draw.sign(6) * draw.between(7, 60.0, 900.0);
    vec![
        ("mesh in mm read as inches", unit("inch"), too_near),
        ("mesh in mm read as cm", unit("cm"), too_near),
        ("mesh in mm read as metres", unit("m"), &["unit-doubtful"]),
        (
            "part displaced along the line",
            placed(x, 0.0, 0.0),
            &["displaced-sideways"],
        ),
        (
            "part displaced along the path",
            placed(0.0, y, 0.0),
            &["displaced-along-path"],
        ),
        (
            "part too high",
            placed(0.0, 0.0, draw.between(4, 15.0, 60.0)),
            &["above-range"],
        ),
        (
            "part too low",
            placed(0.0, 0.0, -draw.between(5, 20.0, 60.0)),
            &["below-range"],
        ),
        (
            "part missing: placed elsewhere",
            placed(0.0, far, 0.0),
            &["light-misses-part", "light-beside-part"],
        ),
    ]
}

#[expect(clippy::too_many_lines, reason = "one mistake after the other")]
fn of_the_sensor(draw: &Draw, base: &str) -> Vec<Case> {
    let fine = changed(base, "[320, 128]", "[640, 256]");
    let fine = changed(&fine, "pixel_pitch_um = 22", "pixel_pitch_um = 11");
    let focus = |text: &str, to: String| changed(text, "focus_distance_mm = 252", &to);
    let tilt = draw.between(8, 10.3, 13.0);
    let tilt = format!("focus_distance_mm = 251.967\ntilt_deg = [{tilt}, 0]");
    let distance = 252.0 * (1.0 + draw.sign(9) * draw.between(10, 0.2, 0.4));
    let exposure = |times: f64| {
        let to = format!("exposure_ms = {}", 0.00375 * times);
        changed(base, "exposure_ms = 0.00375", &to)
    };
    let fan = format!("fan_deg = {}", draw.between(15, 0.3, 0.5));
    let beam = |to: &str| changed(base, "direction = [0, 0, -1]", &format!("direction = {to}"));
    let lean = draw.sign(16) * draw.between(17, 0.08, 0.4);
    let look = |y: f64, z: f64| {
        let to = format!("look_at_mm = [0, {y}, {z}]");
        changed(base, "look_at_mm = [0, 0, 15]", &to)
    };
    let rows = format!("[320, 128]\nroi_rows = [{}, 16]", draw.0.bits(20) % 30);
    vec![
        (
            "Scheimpflug tilt of the wrong sign",
            focus(&fine, tilt),
            &["out-of-focus"],
        ),
        (
            "lens focused elsewhere",
            focus(base, format!("focus_distance_mm = {distance}")),
            &["out-of-focus"],
        ),
        (
            "exposure too long",
            exposure(draw.between(13, 12.0, 100.0)),
            &["saturated"],
        ),
        (
            "exposure too short",
            exposure(1.0 / draw.between(14, 50.0, 500.0)),
            &["too-dark"],
        ),
        (
            "fan angle in radians",
            changed(base, "fan_deg = 24", &fan),
            &["saturated"],
        ),
        ("laser up", beam("[0, 0, 1]"), &["laser-looks-away"]),
        (
            "laser inclined",
            beam(&format!("[0, {lean}, -1]")),
            &[
                "displaced-along-path",
                "light-misses-part",
                "above-range",
                "below-range",
            ],
        ),
        (
            "camera looks too high",
            look(0.0, draw.between(18, 50.0, 90.0)),
            &["below-range"],
        ),
        (
            "camera looks away",
            look(-draw.between(19, 200.0, 900.0), 400.0),
            &["camera-looks-away"],
        ),
        (
            "rows read outside the part",
            changed(base, "[320, 128]", &rows),
            &["above-range", "below-range"],
        ),
    ]
}

fn of_the_path(draw: &Draw, base: &str) -> Vec<Case> {
    let many = (20e6 * draw.between(11, 0.5, 2.0)) as u64;
    let many = changed(base, "frames = 219", &format!("frames = {many}"));
    let rate = draw.between(12, 0.0005, 0.007);
    let slow = format!("frames = 219\nframe_rate_hz = {rate}");
    vec![
        ("20 million frames", many.clone(), &["mostly-outside-part"]),
        (
            "20 million steps of nanometres",
            changed(&many, "step_mm = 0.2", "step_mm = 0.000002"),
            &["steps-too-short"],
        ),
        (
            "frame rate in kHz read as Hz",
            changed(base, "frames = 219", &slow),
            &["long-path"],
        ),
        (
            "no step",
            changed(base, "step_mm = 0.2", "step_mm = 0"),
            &["no-motion"],
        ),
    ]
}

/// Mistakes in other files than the scene.
fn with_files(base: &str, draw: &Draw) -> Vec<Mistake> {
    let length = draw.between(30, 30.0, 400.0);
    let metres = (0..219).map(|i| (f64::from(i) / 218.0 - 0.5) * length * 1e-3);
    let (before, after) = base.split_once("mesh = {").unwrap();
    let (_, after) = after.split_once('}').unwrap();
    let plane =
        format!("{before}plane = {{ size_mm = [250, 40] }}\nposition_mm = [0, 0, 15]{after}");
    let apart = draw.between(31, 62.0, 90.0);
    let rows = (0..41).map(|i| f64::from(i) - 20.0);
    let size = [60.0, 40.0, 30.0].map(|mm| mm * 1e-3 * draw.between(32, 0.7, 1.3));
    let mesh = format!("{before}mesh = {{ file = \"part.obj\", unit = \"mm\" }}{after}");
    vec![
        Mistake {
            name: "robot path in metres",
            scene: with_poses(base),
            files: vec![("path.csv", passes(&[0.0], metres))],
            expected: &["steps-too-short"],
        },
        Mistake {
            name: "passes too far apart",
            scene: with_poses(&plane),
            files: vec![("path.csv", passes(&[-apart, 0.0, apart], rows))],
            expected: &["passes-too-far-apart"],
        },
        Mistake {
            name: "mesh in metres read as mm",
            scene: mesh,
            files: vec![("part.obj", box_obj(size))],
            expected: &["unit-doubtful"],
        },
    ]
}
