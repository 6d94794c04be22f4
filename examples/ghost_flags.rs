//! How many reflections the flag SUSPECTED_REFLECTION finds, and how many good points it flags: corners, pockets, bores and ribs of
//! random size, turned at random, in three metals of random roughness. Writes `ghosts.md` and `ghosts.svg` to a folder.
//!
//!     cargo run --release --example ghost_flags -- docs
//!     cargo run --release --example ghost_flags -- target development
//!
//! The first is of scenes that no rule was made on, the second of those that may be looked at. With `scenes` in place of a
//! folder, prints the good points of the repository's scenes that have the flag.

#[path = "../tests/common/plates.rs"]
mod plates;

use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::profile::Flags;
use lasertrace::report::ghosts_plot::{GhostsPoint, ghosts_plot};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use plates::{SHAPES, plate};
use std::fmt::Write;
use std::path::Path;

const METALS: [&str; 3] = ["aluminium", "iron", "titanium"];
const FRAMES: u32 = 32;
/// Share of the plan's paths that is followed.
const PATHS: f64 = 0.25;
/// A point with less than this share of its light reflected once is a reflection.
const DIRECT: f64 = 0.5;
/// Seed of scenes that may be looked at while a rule is made, and of those that are only counted.
const DEVELOPMENT: u64 = 1;
const HELD_OUT: u64 = 301;

fn main() {
    let folder = std::env::args().nth(1).expect("a folder to write to");
    if folder == "scenes" {
        return scenes();
    }
    let mut page = String::from(
        "# Reflections detected by the flag SUSPECTED_REFLECTION\n\n\
         This page is written by `cargo run --release --example ghost_flags -- docs`. The scenes are plates of bare metal with \
         a corner, a pocket, a bore or ribs, of random size, depth, roughness and orientation. They are scanned over 12 mm \
         with speckle and noise, and with a quarter of the planned paths. A reflection is a point with less than half of its \
         light direct, by ground truth. SUSPECTED_REFLECTION uses measured data only. A reflection is isolated if the image has no other \
         line in its column.\n\n\
         ![Detected reflections, flagged good points, and isolated reflections](ghosts.svg)\n",
    );
    let (set, seed) = match std::env::args().nth(2).as_deref() {
        None => ("Held-out", HELD_OUT),
        Some("development") => ("Development", DEVELOPMENT),
        Some(other) => panic!("expected development or nothing, not {other}"),
    };
    let _ = write!(
        page,
        "\n## {set} scenes\n\nThe seed is {seed}. \"Without any flag\" counts reflections that have neither SUSPECTED_REFLECTION nor another flag.\n\n\
         | scenes | points | reflections | of them detected | without any flag | good points flagged | isolated \
         reflections | of them detected |\n\
         |---|---|---|---|---|---|---|---|\n"
    );
    let (rows, points) = table(seed);
    page += &rows;
    write(&folder, "ghosts.md", &page);
    write(&folder, "ghosts.svg", &ghosts_plot(&points, set));
}

fn write(folder: &str, name: &str, text: &str) {
    std::fs::write(Path::new(folder).join(name), text).expect("a folder that can be written to");
}

/// A row for each shape and metal, and one for all.
fn table(seed: u64) -> (String, Vec<GhostsPoint>) {
    let (mut rows, mut points, mut all) = (String::new(), Vec::new(), Tally::default());
    for shape in SHAPES {
        for metal in METALS {
            let tally = measured(shape, metal, seed);
            eprintln!("{shape}, {metal} {tally}");
            let _ = writeln!(rows, "| {shape}, {metal} {tally}");
            points.push(tally.point(shape, metal));
            all.add(&tally);
        }
    }
    let _ = writeln!(rows, "| **all** {all}");
    (rows, points)
}

/// Points by what they are, and which of them have the flag.
#[derive(Default)]
struct Tally {
    good: [u32; 2],
    ghosts: [u32; 2],
    /// Reflections that are the only line of their column.
    alone: [u32; 2],
    /// Reflections that have a flag, and those that have none.
    unmarked: [u32; 2],
}

impl Tally {
    fn add(&mut self, other: &Tally) {
        for i in 0..2 {
            self.good[i] += other.good[i];
            self.ghosts[i] += other.ghosts[i];
            self.alone[i] += other.alone[i];
            self.unmarked[i] += other.unmarked[i];
        }
    }

    fn point(&self, shape: &'static str, metal: &'static str) -> GhostsPoint {
        GhostsPoint {
            shape,
            metal,
            found: share(self.ghosts),
            flagged: share(self.good),
            alone: share(self.of_all_ghosts()),
            alone_found: share(self.alone),
        }
    }

    /// Reflections that are not alone, and those that are.
    fn of_all_ghosts(&self) -> [u32; 2] {
        let alone = sum(self.alone);
        [sum(self.ghosts) - alone, alone]
    }
}

fn sum([without, with]: [u32; 2]) -> u32 {
    without + with
}

/// Of all, in %; `None` of none.
fn share(parts: [u32; 2]) -> Option<f64> {
    let all = sum(parts);
    (all > 0).then(|| 100.0 * f64::from(parts[1]) / f64::from(all))
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let percent =
            |parts| share(parts).map_or("–".to_owned(), |share| format!("{share:.1} %"));
        write!(
            f,
            "| {} | {} | {} | {} | {} | {} ({}) | {} |",
            sum(self.good) + sum(self.ghosts),
            sum(self.ghosts),
            percent(self.ghosts),
            percent(self.unmarked),
            percent(self.good),
            sum(self.alone),
            percent(self.of_all_ghosts()),
            percent(self.alone)
        )
    }
}

fn measured(shape: &str, metal: &str, seed: u64) -> Tally {
    let number = |name: &str, all: &[&str]| all.iter().position(|&n| n == name).unwrap_or(0) as u64;
    let key = RngKey::new(seed, Purpose::SensorNoise)
        .with(number(shape, &SHAPES))
        .with(number(metal, &METALS));
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("part.obj"), plate(shape, key, 1.0)).unwrap();
    let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
    let text = format!(
        "seed = {seed}
speckle = true

[part]
mesh = {{ file = \"part.obj\", unit = \"mm\" }}
rotation_deg = [0, 0, {:.2}]

[part.surface]
metal = {{ name = {metal:?}, roughness = {:.3} }}

[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = 100
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 7, profile = \"uniform\", direction = [1, 0, 0] }}

[camera]
focal_length_mm = 35
f_number = 8
focus_distance_mm = 150
resolution_px = [480, 400]
pixel_pitch_um = 12
position_mm = [0, -86, 122.9]
look_at_mm = [0, 0, -3]
column_axis = [1, 0, 0]
exposure = \"auto\"
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
read_noise_e = 10

[scan]
direction = [0, 1, 0]
start_mm = [0, -6, 0]
step_mm = 0.4
frames = {FRAMES}
",
        between(1, 0.0, 360.0),
        between(2, 0.1, 0.4),
    );
    let scene = Scene::parse(&text, folder.path()).unwrap();
    let mut simulation = Simulation::new(&scene).unwrap();
    let planned = simulation.plan.reflections;
    simulation.plan.reflections = planned.map(|paths| paths.scaled(PATHS));
    tally(&scanned(&simulation))
}

/// The points of a scan.
fn scanned(simulation: &Simulation) -> Vec<CloudPoint> {
    let frames = 0..simulation.scene.scan.frames;
    let mut points: Vec<CloudPoint> = (frames.clone())
        .flat_map(|frame| simulation.take(frame).2)
        .collect();
    simulation.apply_cross_frame_flags(frames, &mut points);
    points
}

/// What points are.
fn tally(points: &[CloudPoint]) -> Tally {
    let mut tally = Tally::default();
    for point in points {
        let flagged = usize::from(point.flags.contains(Flags::SUSPECTED_REFLECTION));
        if f64::from(point.direct_fraction) >= DIRECT {
            tally.good[flagged] += 1;
        } else {
            tally.ghosts[flagged] += 1;
            tally.unmarked[usize::from(point.is_valid())] += 1;
            if !point.flags.contains(Flags::MULTIPLE_PEAKS) {
                tally.alone[flagged] += 1;
            }
        }
    }
    tally
}

/// The repository's scenes, of which none has reflections that show.
fn scenes() {
    println!("| scene | points | good flagged |\n|---|---|---|");
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    for name in [
        "bracket",
        "accuracy",
        "plane",
        "step",
        "rotary",
        "limits/grazing",
    ] {
        let scene = Scene::load(&root.join(name).join("scene.toml")).unwrap();
        let simulation = Simulation::new(&scene).unwrap();
        let points = scanned(&simulation);
        let flagged = (points.iter())
            .filter(|point| point.flags.contains(Flags::SUSPECTED_REFLECTION))
            .count();
        println!(
            "| {name} | {} | {flagged} ({:.2} %) |",
            points.len(),
            100.0 * flagged as f64 / points.len().max(1) as f64
        );
    }
}
