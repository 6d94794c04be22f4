//! Plates with a corner, a pocket, a bore or ribs, of random size.

use lasertrace::math::rng::RngKey;
use std::fmt::Write;

pub const SHAPES: [&str; 4] = ["corner", "pocket", "bore", "ribs"];

/// An OBJ of quadrilaterals.
struct Obj {
    text: String,
    vertices: usize,
    /// Times the size.
    scale: f64,
}

impl Obj {
    fn face(&mut self, corners: &[[f64; 3]]) {
        for [x, y, z] in corners.iter().map(|corner| corner.map(|c| c * self.scale)) {
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

/// A plate of 40 mm, times `scale`, its top at z = 0, with what is named in it.
pub fn plate(shape: &str, key: RngKey, scale: f64) -> String {
    const END: f64 = 20.0;
    let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
    let mut obj = Obj {
        text: String::new(),
        vertices: 0,
        scale,
    };
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
