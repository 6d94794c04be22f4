//! Tests of crossings against exact integer arithmetic, where rays pass through vertices, along
//! edges and in the planes of triangles.

use super::*;
use crate::math::rng::{Purpose, RngKey};

type Corner = [i64; 3];

/// Returns the triangles that a ray along ±z crosses, by integers. The ray is displaced by 10⁻³ and
/// 10⁻⁶, which no line through points with coordinates up to 8 separates from an infinitesimal
/// displacement.
fn exact(triangles: &[[Corner; 3]], [x, y]: [i64; 2]) -> Vec<u32> {
    const SCALE: i64 = 1_000_000;
    let (x, y) = (x * SCALE + 1_000, y * SCALE + 1);
    let left = |from: Corner, to: Corner| {
        let (from, to) = (from.map(|c| c * SCALE), to.map(|c| c * SCALE));
        (from[0] - x) * (to[1] - y) - (from[1] - y) * (to[0] - x)
    };
    let crossed = |[a, b, c]: &[Corner; 3]| {
        let sides = [left(*a, *b), left(*b, *c), left(*c, *a)];
        sides.iter().all(|&side| side > 0) || sides.iter().all(|&side| side < 0)
    };
    let numbers = (0..).zip(triangles).filter(|(_, t)| crossed(t));
    numbers.map(|(number, _)| number).collect()
}

fn crossings(triangles: &[[Corner; 3]], ray: &Ray) -> Vec<Crossing> {
    let mut crossings = Crossings::new(ray);
    for (number, corners) in (0..).zip(triangles) {
        crossings.add(
            number,
            corners.map(|c| DVec3::from_array(c.map(|x| x as f64))),
        );
    }
    crossings.finish()
}

fn along_z([x, y]: [i64; 2], direction: f64) -> Ray {
    Ray {
        origin: DVec3::new(x as f64, y as f64, -20.0 * direction),
        direction: DVec3::Z * direction,
        t_max: f64::INFINITY,
    }
}

/// Tests random triangles with corners on a lattice of 5³ points, of which many are edge-on, without
/// area, equal, or joined at edges and vertices, and all rays through lattice points.
///
/// A crossing in addition to the exact ones is a border on the ray: it touches the triangle.
#[test]
fn crossings_of_lattice_triangles_are_exact() {
    let (mut found, mut borders) = (0, 0);
    for seed in 0..60 {
        let key = RngKey::new(seed, Purpose::RaceRays);
        let corner = |i: u64| std::array::from_fn(|k| (key.with(i).uniform(k as u64) * 5.0) as i64);
        let triangles: Vec<[Corner; 3]> = (0..40)
            .map(|i| [corner(3 * i), corner(3 * i + 1), corner(3 * i + 2)])
            .collect();
        for (x, y) in (0..25).map(|i| (i / 5, i % 5)) {
            let expected = exact(&triangles, [x, y]);
            for direction in [1.0, -1.0] {
                let crossings = crossings(&triangles, &along_z([x, y], direction));
                assert!(crossings.is_sorted_by(|a, b| a.t <= b.t));
                let mut numbers: Vec<u32> = crossings.iter().map(|c| c.triangle).collect();
                numbers.sort_unstable();
                let (exact, other): (Vec<u32>, Vec<u32>) = numbers
                    .into_iter()
                    .partition(|number| expected.contains(number));
                assert_eq!(exact, expected, "seed {seed}, ray {x} {y}");
                for number in &other {
                    let corners = triangles[*number as usize];
                    let left =
                        |a: Corner, b: Corner| (a[0] - x) * (b[1] - y) - (a[1] - y) * (b[0] - x);
                    let sides = [0, 1, 2].map(|k| left(corners[k], corners[(k + 1) % 3]));
                    let touches = sides.contains(&0)
                        && (sides.iter().all(|&s| s >= 0) || sides.iter().all(|&s| s <= 0));
                    assert!(touches && sides != [0; 3], "{corners:?} {x} {y}");
                }
                (found, borders) = (found + exact.len(), borders + other.len());
                for crossing in &crossings {
                    let [a, b, c] = triangles[crossing.triangle as usize];
                    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
                    assert_eq!(crossing.entering, (area > 0) == (direction < 0.0));
                }
            }
        }
    }
    assert!(found > 5_000 && borders > 5_000, "{found} {borders}");
}

/// Tests closed surfaces of cubes on a lattice, which have common vertices, edges and faces: every
/// ray through a lattice point enters and leaves alternately.
#[test]
fn rays_along_edges_and_faces_of_cubes_enter_and_leave_alternately() {
    let faces: [[usize; 4]; 6] = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    for seed in 0..200 {
        let key = RngKey::new(seed, Purpose::RaceRays);
        let mut triangles = Vec::new();
        for cell in (0..64).filter(|&i| key.uniform(i) < 0.3) {
            let low = [cell / 16, cell / 4 % 4, cell % 4].map(|c| c as i64);
            let corner = |i: usize| {
                [
                    low[0] + (i & 1) as i64,
                    low[1] + (i >> 1 & 1) as i64,
                    low[2] + (i >> 2) as i64,
                ]
            };
            for [a, b, c, d] in faces.map(|face| face.map(corner)) {
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        for (x, y) in (0..25).map(|i| (i / 5, i % 5)) {
            for direction in [1.0, -1.0] {
                let crossings = crossings(&triangles, &along_z([x, y], direction));
                // Where a cube touches the next one, the ray leaves and enters at one distance.
                let mut depth = 0;
                for group in crossings.chunk_by(|a, b| a.t == b.t) {
                    let step = |c: &Crossing| if c.entering { 1 } else { -1 };
                    depth += group.iter().map(step).sum::<i32>();
                    assert!((0..=1).contains(&depth), "seed {seed}, ray {x} {y}");
                }
                assert_eq!(depth, 0, "seed {seed}, ray {x} {y}");
            }
        }
    }
}

/// Tests an open square of two triangles: rays at its border, its corners and its diagonal have one
/// hit each.
#[test]
fn the_border_of_an_open_surface_is_hit_once() {
    let square = [
        [[0, 0, 1], [4, 0, 1], [4, 4, 1]],
        [[0, 0, 1], [4, 4, 1], [0, 4, 1]],
    ];
    for (x, y) in (0..49).map(|i| (i / 7 - 1, i % 7 - 1)) {
        for direction in [1.0, -1.0] {
            let inside = (0..=4).contains(&x) && (0..=4).contains(&y);
            let found = crossings(&square, &along_z([x, y], direction));
            assert_eq!(found.len(), usize::from(inside), "{x} {y}");
        }
    }
}

/// Tests that the sign of an edge function is right where products round to equal numbers, and where
/// they would underflow.
#[test]
fn orientations_are_exact() {
    let point = |x: f64, y: f64| DVec3::new(x, y, 0.0);
    let one = 1.0 + f64::EPSILON;
    // (1 + ε)(1 − ε) = 1 − ε² rounds to 1.
    assert_eq!(
        orientation(point(one, 1.0), point(1.0, 1.0 - f64::EPSILON)),
        -1
    );
    assert_eq!(
        orientation(point(1.0, 1.0 - f64::EPSILON), point(one, 1.0)),
        1
    );
    assert_eq!(orientation(point(3.0, 5.0), point(9.0, 15.0)), 0);
    let tiny = 5e-324;
    let [a, b] = [point(tiny, 1.0), point(-tiny, 1.0)].map(flushed);
    assert_eq!(orientation(a, b), 0);
}
