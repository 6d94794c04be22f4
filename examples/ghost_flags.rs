//! How many reflections the flag GHOST finds, and how many good points it flags: corners, pockets, bores and ribs of
//! random size, turned at random, in three metals of random roughness.
//!
//!     cargo run --release --example ghost_flags -- development   # scenes that may be looked at
//!     cargo run --release --example ghost_flags -- held-out      # scenes that the rule was not made on
//!
//! Prints a table, and writes it with a chart of good points flagged over reflections found: of held-out scenes
//! `docs/ghosts.md` and `docs/ghosts.svg`, else both to `target/`. With `scenes`, the good points of the repository's
//! scenes that have the flag. Seeds after it replace those of the set.

use lasertrace::math::rng::{Key, Purpose};
use lasertrace::profile::Flags;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::fmt::Write;
use std::path::Path;

const SHAPES: [&str; 4] = ["corner", "pocket", "bore", "ribs"];
const METALS: [&str; 3] = ["aluminium", "iron", "titanium"];
const FRAMES: u32 = 3;
/// A point with less than this share of its light reflected once is a reflection.
const DIRECT: f64 = 0.5;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let set = arguments.next().unwrap_or_default();
    let named: Vec<u64> = arguments
        .map(|seed| seed.parse().expect("a seed"))
        .collect();
    let seeds = match (&*set, named.is_empty()) {
        (_, false) => named,
        ("development", _) => (1..=3).collect(),
        ("held-out", _) => (101..=103).collect(),
        ("scenes", _) => return scenes(),
        _ => panic!("expected development, held-out or scenes"),
    };
    let seeds_named = seeds
        .iter()
        .map(u64::to_string)
        .collect::<Vec<_>>()
        .join(", ");
    let mut page = format!(
        "# Reflections found by their flag, and good points flagged\n\n\
         Made by `cargo run --release --example ghost_flags -- {set}`, of seeds {seeds_named}. A reflection is a point with \
         less than half of its light reflected once.\n\n\
         ![Good points flagged over reflections found](ghosts.svg)\n\n\
         | {set} | points | reflections | found | good flagged | alone in their column, of reflections | of these found |\n\
         |---|---|---|---|---|---|---|\n"
    );
    print!("{page}");
    let mut row = |text: String| {
        println!("{text}");
        page += &(text + "\n");
    };
    let mut all = Tally::default();
    let mut marks = Vec::new();
    for shape in SHAPES {
        for metal in METALS {
            let mut tally = Tally::default();
            for &seed in &seeds {
                tally.add(&measured(shape, metal, seed));
            }
            row(format!("| {shape}, {metal} {tally}"));
            marks.push((format!("{shape}, {metal}"), tally.found(), tally.flagged()));
            all.add(&tally);
        }
    }
    row(format!("| **all** {all}"));
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(match &*set {
        "held-out" => "docs",
        _ => "target",
    });
    std::fs::write(folder.join("ghosts.md"), page).expect("a folder of the project");
    std::fs::write(folder.join("ghosts.svg"), chart(&set, &marks)).expect("the same");
}

/// Points by what they are, and which of them have the flag.
#[derive(Default)]
struct Tally {
    good: [u32; 2],
    ghosts: [u32; 2],
    /// Reflections that are the only line of their column.
    alone: [u32; 2],
}

impl Tally {
    fn add(&mut self, other: &Tally) {
        for i in 0..2 {
            self.good[i] += other.good[i];
            self.ghosts[i] += other.ghosts[i];
            self.alone[i] += other.alone[i];
        }
    }

    fn found(&self) -> f64 {
        share(self.ghosts)
    }

    fn flagged(&self) -> f64 {
        share(self.good)
    }
}

/// Of all, in %.
fn share([without, with]: [u32; 2]) -> f64 {
    match without + with {
        0 => 0.0,
        all => 100.0 * f64::from(with) / f64::from(all),
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let sum = |[a, b]: [u32; 2]| a + b;
        let (good, ghosts, alone) = (sum(self.good), sum(self.ghosts), sum(self.alone));
        let of_ghosts = share([ghosts - alone, alone]);
        write!(
            f,
            "| {} | {ghosts} | {:.0} % | {:.1} % | {of_ghosts:.0} % | {:.0} % |",
            good + ghosts,
            self.found(),
            self.flagged(),
            share(self.alone)
        )
    }
}

fn measured(shape: &str, metal: &str, seed: u64) -> Tally {
    let number = |name: &str, all: &[&str]| all.iter().position(|&n| n == name).unwrap_or(0) as u64;
    let key = Key::new(seed, Purpose::SensorNoise)
        .with(number(shape, &SHAPES))
        .with(number(metal, &METALS));
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("part.obj"), part(shape, key)).unwrap();
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
columns = [1, 0, 0]
exposure = \"auto\"
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
read_noise_e = 10

[scan]
direction = [0, 1, 0]
start_mm = [0, -2, 0]
step_mm = 2
frames = {FRAMES}
",
        between(1, 0.0, 360.0),
        between(2, 0.1, 0.4),
    );
    let scene = Scene::parse(&text, folder.path()).unwrap();
    tally(&Simulation::new(&scene).unwrap(), FRAMES)
}

/// What the points of the first frames are.
fn tally(simulation: &Simulation, frames: u32) -> Tally {
    let mut tally = Tally::default();
    for frame in 0..frames {
        let (_, _, points) = simulation.take(frame);
        for point in points {
            let flagged = usize::from(point.flags.contains(Flags::GHOST));
            if f64::from(point.direct) >= DIRECT {
                tally.good[flagged] += 1;
            } else {
                tally.ghosts[flagged] += 1;
                if !point.flags.contains(Flags::DOUBLE) {
                    tally.alone[flagged] += 1;
                }
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
        let every = scene.scan.frames.div_ceil(12).max(1) as usize;
        let (mut points, mut flagged) = (0, 0);
        for frame in (0..scene.scan.frames).step_by(every) {
            let (_, peaks, _) = simulation.take(frame);
            points += peaks.len();
            flagged += peaks
                .iter()
                .filter(|p| p.flags.contains(Flags::GHOST))
                .count();
        }
        println!(
            "| {name} | {points} | {flagged} ({:.2} %) |",
            100.0 * flagged as f64 / points.max(1) as f64
        );
    }
}

/// An OBJ of quadrilaterals.
#[derive(Default)]
struct Obj {
    text: String,
    vertices: usize,
}

impl Obj {
    fn face(&mut self, corners: &[[f64; 3]]) {
        for [x, y, z] in corners {
            let _ = writeln!(self.text, "v {x:.5} {y:.5} {z:.5}");
        }
        self.text += "f";
        for corner in 1..=corners.len() {
            let _ = write!(self.text, " {}", self.vertices + corner);
        }
        self.text += "\n";
        self.vertices += corners.len();
    }

    /// A floor from (x0, y0) to (x1, y1) at a height.
    fn level(&mut self, [x0, y0]: [f64; 2], [x1, y1]: [f64; 2], z: f64) {
        self.face(&[[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]);
    }

    /// An upright wall over a line, from one height to another.
    fn wall(&mut self, [x0, y0]: [f64; 2], [x1, y1]: [f64; 2], [low, high]: [f64; 2]) {
        self.face(&[[x0, y0, low], [x1, y1, low], [x1, y1, high], [x0, y0, high]]);
    }
}

/// A plate about z = 0 with what is named in it, of random size.
fn part(shape: &str, key: Key) -> String {
    const END: f64 = 20.0;
    let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
    let mut obj = Obj::default();
    let deep = -between(10, 2.0, 6.0);
    match shape {
        "corner" => {
            let at = between(11, -2.0, 2.0);
            obj.level([-END, -END], [at, END], 0.0);
            obj.wall([at, -END], [at, END], [deep, 0.0]);
            obj.level([at, -END], [END, END], deep);
        }
        "pocket" => {
            let (a, b) = (between(11, 3.0, 7.0), between(12, 3.0, 7.0));
            obj.level([-END, -END], [-a, END], 0.0);
            obj.level([a, -END], [END, END], 0.0);
            obj.level([-a, -END], [a, -b], 0.0);
            obj.level([-a, b], [a, END], 0.0);
            obj.level([-a, -b], [a, b], deep);
            let corners = [[-a, -b], [a, -b], [a, b], [-a, b]];
            for i in 0..4 {
                obj.wall(corners[i], corners[(i + 1) % 4], [deep, 0.0]);
            }
        }
        "bore" => {
            const SIDES: usize = 96;
            let radius = between(11, 3.0, 7.0);
            let at = |i: usize, by: f64| {
                let (sin, cos) = (i as f64 / SIDES as f64 * std::f64::consts::TAU).sin_cos();
                [by * cos, by * sin]
            };
            let floor: Vec<_> = (0..SIDES)
                .map(|i| at(i, radius))
                .map(|[x, y]| [x, y, deep])
                .collect();
            obj.face(&floor);
            for i in 0..SIDES {
                let (a, b) = (at(i, radius), at(i + 1, radius));
                let (c, d) = (at(i, END), at(i + 1, END));
                let up = |[x, y]: [f64; 2]| [x, y, 0.0];
                obj.wall(a, b, [deep, 0.0]);
                obj.face(&[up(a), up(c), up(d), up(b)]);
            }
        }
        _ => {
            let (wide, gap) = (between(11, 1.0, 3.0), between(12, 2.0, 5.0));
            let mut x = -END;
            while x < END {
                obj.level([x, -END], [x + gap, END], deep);
                obj.wall([x + gap, -END], [x + gap, END], [deep, 0.0]);
                obj.level([x + gap, -END], [x + gap + wide, END], 0.0);
                obj.wall([x + gap + wide, -END], [x + gap + wide, END], [deep, 0.0]);
                x += gap + wide;
            }
        }
    }
    obj.text
}

/// Good points flagged (%, up to 20) over reflections found (%).
fn chart(set: &str, marks: &[(String, f64, f64)]) -> String {
    let mut svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"560\" height=\"420\" font-family=\"sans-serif\" font-size=\"11\">\
                   <rect width=\"100%\" height=\"100%\" fill=\"white\"/>"
        .to_owned();
    let (x, y) = (
        |found: f64| 60.0 + 4.6 * found,
        |flagged: f64| 370.0 - 17.0 * flagged.min(20.0),
    );
    for tick in [0.0, 25.0, 50.0, 75.0, 100.0] {
        let (at, good) = (x(tick), tick / 5.0);
        let _ = write!(
            svg,
            "<text x=\"{at}\" y=\"386\" text-anchor=\"middle\">{tick}</text>\
                             <path d=\"M{at} 30V370M60 {0}H520\" stroke=\"#ddd\"/>\
                             <text x=\"54\" y=\"{0}\" text-anchor=\"end\">{good}</text>",
            y(good)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"290\" y=\"406\" text-anchor=\"middle\">reflections found, %</text>\
                         <text x=\"60\" y=\"20\">good points flagged, % ({set})</text>"
    );
    for (name, found, flagged) in marks {
        let _ = write!(
            svg,
            "<circle cx=\"{0:.1}\" cy=\"{1:.1}\" r=\"4\" fill=\"#2471a3\"/>\
                             <text x=\"{2:.1}\" y=\"{1:.1}\">{name}</text>",
            x(*found),
            y(*flagged),
            x(*found) + 6.0
        );
    }
    svg + "</svg>\n"
}
