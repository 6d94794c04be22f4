//! Writes `scenes/bracket/bracket.stl`, the part of the demo scene: an L-bracket
//! of 60 × 40 × 30 mm with a fillet, two ribs, a machined step, counterbored
//! holes and chamfers.
//!
//! Run from the project's root. Part frame, mm: the plate lies on z = 0,
//! centred in x and y; the wall rises along the edge x = −30.
//!
//! ```text
//!     z = 30  ╭──┐          side view; the ribs are at y = ±13
//!             │  │
//!             │  │╲
//!             │  │  ╲  rib
//!             │  │    ╲
//!             │  ╰──────╲────┐ step
//!             │              └────────╮
//!      z = 0  ╰───────────────────────┘
//!         x = −30                     30
//! ```
//!
//! Every face is made from shared vertices, so the solid is watertight by
//! construction; `check` asserts it on the coordinates as written.

use std::collections::{BTreeSet, HashSet};
use std::f64::consts::{FRAC_PI_2, TAU};
use std::path::Path;

use glam::DVec3;

const HALF_LENGTH: f64 = 30.0;
const HALF_WIDTH: f64 = 20.0;
const HEIGHT: f64 = 30.0;
const PLATE: f64 = 6.0;
const WALL: f64 = 6.0;
const CHAMFER: f64 = 1.5;
const FILLET_RADIUS: f64 = 6.0;
/// Half a micrometre between an arc of 6 mm and its chords.
const FILLET_SEGMENTS: usize = 64;
/// The machined step: the plate is lower by this much beyond `STEP_X`.
const STEP: f64 = 1.5;
const STEP_X: f64 = 10.0;
const RIB_Y: f64 = 13.0;
const HALF_RIB: f64 = 2.0;
/// Where the ribs' slope meets the plate (x) and the wall (z).
const RIB_FOOT_X: f64 = 4.0;
const RIB_HEAD_Z: f64 = 25.0;
const HOLE_SEGMENTS: usize = 96;

const WALL_X: f64 = -HALF_LENGTH + WALL;
const FILLET_X: f64 = WALL_X + FILLET_RADIUS;
const FILLET_Z: f64 = PLATE + FILLET_RADIUS;
const LAND_Z: f64 = PLATE - STEP;

/// A point in a face's own plane.
type Point = [f64; 2];

/// Triangle soup under construction, counter-clockwise seen from outside.
#[derive(Default)]
struct Solid {
    triangles: Vec<[DVec3; 3]>,
}

/// A round hole: rings of (radius, height along the axis), from the end the
/// axis points to down to the other.
struct Bore {
    centre: Point,
    rings: Vec<(f64, f64)>,
}

impl Bore {
    fn ring(&self, radius: f64) -> Vec<Point> {
        (0..HOLE_SEGMENTS)
            .map(|i| (TAU * i as f64 / HOLE_SEGMENTS as f64).sin_cos())
            .map(|(sin, cos)| [self.centre[0] + radius * cos, self.centre[1] + radius * sin])
            .collect()
    }

    fn upper_ring(&self) -> Vec<Point> {
        self.ring(self.rings[0].0)
    }

    fn lower_ring(&self) -> Vec<Point> {
        self.ring(self.rings[self.rings.len() - 1].0)
    }
}

impl Solid {
    fn quad(&mut self, [a, b, c, d]: [DVec3; 4]) {
        self.triangles.extend([[a, b, c], [a, c, d]]);
    }

    /// Profile edge from `p` to `q` (x, z; counter-clockwise) swept along y.
    fn sweep(&mut self, p: Point, q: Point, [y0, y1]: [f64; 2]) {
        let at = |[x, z]: Point, y| DVec3::new(x, y, z);
        self.quad([at(p, y0), at(p, y1), at(q, y1), at(q, y0)]);
    }

    /// Flat face with an outline and holes; `place` puts its points in space.
    fn face(
        &mut self,
        outline: Vec<Point>,
        holes: &[Vec<Point>],
        outward: DVec3,
        place: impl Fn(Point) -> DVec3,
    ) {
        let mut points = outline;
        let mut hole_starts = Vec::new();
        for hole in holes {
            hole_starts.push(points.len());
            points.extend(hole);
        }
        let mut corners: Vec<usize> = Vec::new();
        earcut::Earcut::new().earcut_slice(&points, &hole_starts, &mut corners);
        earcut::refine(&mut corners, &points);
        for corner in corners.chunks_exact(3) {
            let [a, b, c] = [corner[0], corner[1], corner[2]].map(|i| place(points[i]));
            let along = (b - a).cross(c - a).dot(outward) > 0.0;
            self.triangles
                .push(if along { [a, b, c] } else { [a, c, b] });
        }
    }

    /// Walls and shoulders of a hole; `place` takes a point across the axis and
    /// the height along it (right-handed) to space.
    fn bore(&mut self, bore: &Bore, place: impl Fn(Point, f64) -> DVec3) {
        for pair in bore.rings.windows(2) {
            let [upper, lower] = [pair[0], pair[1]].map(|(radius, height)| {
                let ring = bore.ring(radius).into_iter();
                ring.map(|p| place(p, height)).collect::<Vec<_>>()
            });
            for i in 0..HOLE_SEGMENTS {
                let j = (i + 1) % HOLE_SEGMENTS;
                self.quad([upper[i], upper[j], lower[j], lower[i]]);
            }
        }
    }
}

fn rectangle([u0, u1]: [f64; 2], [v0, v1]: [f64; 2]) -> Vec<Point> {
    vec![[u0, v0], [u1, v0], [u1, v1], [u0, v1]]
}

/// Outline, in (t, y), of a face next to the fillet (at t = `near`), which the
/// ribs cover up to t = `rib_end`.
fn outline_between_ribs(near: f64, rib_end: f64, far: f64) -> Vec<Point> {
    let mut outline = vec![[far, -HALF_WIDTH], [far, HALF_WIDTH], [near, HALF_WIDTH]];
    for rib_y in [RIB_Y, -RIB_Y] {
        let [low, high] = rib_span(rib_y);
        outline.extend([[near, high], [rib_end, high], [rib_end, low], [near, low]]);
    }
    outline.push([near, -HALF_WIDTH]);
    outline
}

fn rib_span(rib_y: f64) -> [f64; 2] {
    [rib_y - HALF_RIB, rib_y + HALF_RIB]
}

/// From the plate up to the wall (x, z), both ends exact.
fn fillet() -> Vec<Point> {
    let inner = (1..FILLET_SEGMENTS).map(|i| {
        let (sin, cos) = (FRAC_PI_2 * i as f64 / FILLET_SEGMENTS as f64).sin_cos();
        [
            FILLET_X - FILLET_RADIUS * sin,
            FILLET_Z - FILLET_RADIUS * cos,
        ]
    });
    let mut points = vec![[FILLET_X, PLATE]];
    points.extend(inner);
    points.push([WALL_X, FILLET_Z]);
    points
}

/// Faces of constant profile over the whole width, and the two ends.
fn add_outside(solid: &mut Solid) {
    let heel = [[-HALF_LENGTH, CHAMFER], [-HALF_LENGTH + CHAMFER, 0.0]];
    let toe = [
        [HALF_LENGTH, 0.0],
        [HALF_LENGTH, LAND_Z - CHAMFER],
        [HALF_LENGTH - CHAMFER, LAND_Z],
    ];
    let riser = [[STEP_X, LAND_Z], [STEP_X, PLATE]];
    let top = [
        [WALL_X, HEIGHT],
        [-HALF_LENGTH + CHAMFER, HEIGHT],
        [-HALF_LENGTH, HEIGHT - CHAMFER],
    ];
    for chain in [&heel[..], &toe, &riser, &top] {
        for edge in chain.windows(2) {
            solid.sweep(edge[0], edge[1], [-HALF_WIDTH, HALF_WIDTH]);
        }
    }
    let profile = [&heel[..], &toe, &riser, &fillet(), &top].concat();
    for end in [DVec3::NEG_Y, DVec3::Y] {
        let y = end.y * HALF_WIDTH;
        solid.face(profile.clone(), &[], end, |[x, z]| DVec3::new(x, y, z));
    }
}

/// Plate: bottom, the two lands on top, and the holes through it.
fn add_plate(solid: &mut Solid) {
    let counterbored = [-12.0, 12.0].map(|y| Bore {
        centre: [20.0, y],
        rings: vec![
            (5.0, LAND_Z),
            (5.0, LAND_Z - 2.0),
            (2.75, LAND_Z - 2.0),
            (2.75, 0.0),
        ],
    });
    let plain = Bore {
        centre: [-4.0, 0.0],
        rings: vec![(5.0, PLATE), (5.0, 0.0)],
    };
    let width = [-HALF_WIDTH, HALF_WIDTH];
    let [first, second] = &counterbored;
    solid.face(
        rectangle([-HALF_LENGTH + CHAMFER, HALF_LENGTH], width),
        &[first, second, &plain].map(Bore::lower_ring),
        DVec3::NEG_Z,
        |[x, y]| DVec3::new(x, y, 0.0),
    );
    solid.face(
        rectangle([STEP_X, HALF_LENGTH - CHAMFER], width),
        &[first, second].map(Bore::upper_ring),
        DVec3::Z,
        |[x, y]| DVec3::new(x, y, LAND_Z),
    );
    solid.face(
        outline_between_ribs(FILLET_X, RIB_FOOT_X, STEP_X),
        &[plain.upper_ring()],
        DVec3::Z,
        |[x, y]| DVec3::new(x, y, PLATE),
    );
    for bore in [first, second, &plain] {
        solid.bore(bore, |[x, y], z| DVec3::new(x, y, z));
    }
}

/// Wall: inner and outer face and the hole through it, along x.
fn add_wall(solid: &mut Solid) {
    let bore = Bore {
        centre: [0.0, 20.0],
        rings: vec![(4.5, WALL_X), (4.5, -HALF_LENGTH)],
    };
    let inner = outline_between_ribs(FILLET_Z, RIB_HEAD_Z, HEIGHT);
    solid.face(
        inner.into_iter().map(|[z, y]| [y, z]).collect(),
        &[bore.upper_ring()],
        DVec3::X,
        |[y, z]| DVec3::new(WALL_X, y, z),
    );
    solid.face(
        rectangle([-HALF_WIDTH, HALF_WIDTH], [CHAMFER, HEIGHT - CHAMFER]),
        &[bore.lower_ring()],
        DVec3::NEG_X,
        |[y, z]| DVec3::new(-HALF_LENGTH, y, z),
    );
    solid.bore(&bore, |[y, z], x| DVec3::new(x, y, z));
}

/// Fillet where no rib covers it, and the ribs.
fn add_fillet_and_ribs(solid: &mut Solid) {
    let (left, right) = (rib_span(-RIB_Y), rib_span(RIB_Y));
    let gaps = [
        [-HALF_WIDTH, left[0]],
        [left[1], right[0]],
        [right[1], HALF_WIDTH],
    ];
    for gap in gaps {
        for edge in fillet().windows(2) {
            solid.sweep(edge[0], edge[1], gap);
        }
    }
    let (foot, head) = ([RIB_FOOT_X, PLATE], [WALL_X, RIB_HEAD_Z]);
    // The side is a fan about the fillet's axis and the rest: triangles between
    // neighbouring points of the arc alone would be needles.
    let axis = [FILLET_X, FILLET_Z];
    let rest = vec![foot, [FILLET_X, PLATE], axis, [WALL_X, FILLET_Z], head];
    let fan = fillet()
        .windows(2)
        .map(|edge| vec![axis, edge[0], edge[1]])
        .collect::<Vec<_>>();
    for span in [left, right] {
        solid.sweep(foot, head, span);
        for (y, outward) in [(span[0], DVec3::NEG_Y), (span[1], DVec3::Y)] {
            for piece in fan.iter().chain([&rest]) {
                solid.face(piece.clone(), &[], outward, |[x, z]| DVec3::new(x, y, z));
            }
        }
    }
}

/// The bracket as written: coordinates rounded to f32.
fn bracket() -> Vec<[[f32; 3]; 3]> {
    let mut solid = Solid::default();
    add_outside(&mut solid);
    add_plate(&mut solid);
    add_wall(&mut solid);
    add_fillet_and_ribs(&mut solid);
    // Adding zero turns −0 into 0, so that equal coordinates have equal bits.
    let rounded = |v: DVec3| (v.as_vec3() + 0.0).to_array();
    let triangles: Vec<_> = solid.triangles.iter().map(|t| t.map(rounded)).collect();
    check(&triangles);
    triangles
}

/// Twice the area, along the outward normal.
fn area_vector(triangle: &[[f32; 3]; 3]) -> DVec3 {
    let [a, b, c] = triangle.map(|p| DVec3::from_array(p.map(f64::from)));
    (b - a).cross(c - a)
}

/// Asserts one closed, outward-wound solid with four holes through it and no
/// degenerate triangle.
fn check(triangles: &[[[f32; 3]; 3]]) {
    let mut edges = BTreeSet::new();
    let mut vertices = HashSet::new();
    let mut volume = 0.0;
    for triangle in triangles {
        let keys = triangle.map(|p| p.map(f32::to_bits));
        vertices.extend(keys);
        for i in 0..3 {
            let edge = (keys[i], keys[(i + 1) % 3]);
            assert!(edges.insert(edge), "edge used twice, in {triangle:?}");
        }
        assert!(area_vector(triangle).length() > 1e-3, "sliver {triangle:?}");
        volume += DVec3::from_array(triangle[0].map(f64::from)).dot(area_vector(triangle)) / 6.0;
    }
    let open = edges.iter().find(|&&(a, b)| !edges.contains(&(b, a)));
    assert_eq!(open, None, "edge without its opposite");
    assert!(volume > 0.0, "inside out: volume {volume} mm³");
    // V − E + F = 2 − 2 · 4 for one piece with four holes (Euler, Poincaré).
    let euler = vertices.len() as i64 - edges.len() as i64 / 2 + triangles.len() as i64;
    assert_eq!(euler, -6, "Euler characteristic");
}

fn binary_stl(triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
    let mut bytes = b"lasertrace demo bracket, mm".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        let normal = area_vector(triangle).normalize().as_vec3() + 0.0;
        for number in normal.to_array().iter().chain(triangle.as_flattened()) {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend([0, 0]);
    }
    bytes
}

fn main() -> std::io::Result<()> {
    let path = Path::new("scenes/bracket/bracket.stl");
    let triangles = bracket();
    let beside = path.with_extension("stl.part");
    std::fs::write(&beside, binary_stl(&triangles))?;
    std::fs::rename(&beside, path)?;
    println!("{}: {} triangles", path.display(), triangles.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_part_in_scenes_is_what_this_program_writes() {
        let written = include_bytes!("../scenes/bracket/bracket.stl");
        assert!(written[..] == binary_stl(&bracket())[..]);
    }
}
