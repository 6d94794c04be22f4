//! The sign of a deviation against closed forms and against the winding number.

use crate::random::Random;
use lasertrace::accel::{Accel, facing_normal};
use lasertrace::inspect::deviation::signed_distance;
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::{Mesh, Orientation, Pseudonormals, report, shapes};
use std::f64::consts::{PI, TAU};

/// Largest distance between a mesh and the shape it stands for, mm.
const CHORD: f64 = 1e-3;

/// A mesh and the signed distance from the shape it stands for.
struct Shape {
    name: &'static str,
    mesh: Mesh,
    distance: Box<dyn Fn(DVec3) -> f64>,
}

/// About z, closed and facing outward.
fn torus(large: f64, small: f64) -> Mesh {
    // The sagitta of a side of a regular n-gon is r·(π/n)²/2; two of them add up.
    let steps = |radius: f64| (PI * (radius / CHORD).sqrt()).ceil() as u32;
    let (round, across) = (steps(large + small), steps(small));
    let position = |i: u32| {
        let [u, v] =
            [(i / across, round), (i % across, across)].map(|(k, n)| k as f64 * TAU / n as f64);
        let ring = large + small * v.cos();
        DVec3::new(ring * u.cos(), ring * u.sin(), small * v.sin())
    };
    let number = |i: u32, j: u32| (i % round) * across + j % across;
    let two = |i: u32| {
        let (i, j) = (i / across, i % across);
        let [a, b] = [number(i, j), number(i + 1, j)];
        let [c, d] = [number(i + 1, j + 1), number(i, j + 1)];
        [[a, b, c], [a, c, d]]
    };
    Mesh {
        positions: (0..round * across).map(position).collect(),
        triangles: (0..round * across).flat_map(two).collect(),
    }
}

/// Distance from a box about the origin, of these half sizes; outside it.
fn from_box(p: DVec3, half: DVec3) -> f64 {
    (p.abs() - half).max(DVec3::ZERO).length()
}

/// Of a stepped block (`shapes::step_block`), from within to the nearest face, where the notch
/// above the lower half is one.
fn from_block(p: DVec3, size: DVec3, low: f64) -> f64 {
    let DVec3 { x, y, z: top } = size / DVec3::new(2.0, 2.0, 1.0);
    let notch = p.x.max(0.0).hypot((low - p.z).max(0.0));
    let faces = [x - p.x.abs(), y - p.y.abs(), p.z, top - p.z, notch];
    let depth = faces.into_iter().fold(f64::INFINITY, f64::min);
    if depth > 0.0 {
        return -depth;
    }
    let lower = from_box(p - DVec3::Z * low / 2.0, DVec3::new(x, y, low / 2.0));
    let middle = DVec3::new(x, 0.0, top) / 2.0;
    lower.min(from_box(p - middle, DVec3::new(x / 2.0, y, top / 2.0)))
}

fn shapes_of(random: &mut Random) -> [Shape; 4] {
    let [radius, r, x, y, z] = [(); 5].map(|()| random.between(4.0, 9.0));
    let (length, low) = (random.between(5.0, 20.0), random.between(0.2, 0.8) * z);
    let (large, small) = (random.between(6.0, 9.0), random.between(1.0, 3.0));
    let size = DVec3::new(x, y, z);
    [
        Shape {
            name: "sphere",
            mesh: shapes::sphere(radius, CHORD).unwrap(),
            distance: Box::new(move |p| p.length() - radius),
        },
        Shape {
            name: "cylinder",
            mesh: shapes::cylinder(r, length, CHORD).unwrap(),
            distance: Box::new(move |p| {
                let side = p.with_y(0.0).length() - r;
                let end = p.y.abs() - length / 2.0;
                side.max(end).min(0.0) + side.max(0.0).hypot(end.max(0.0))
            }),
        },
        Shape {
            name: "block",
            mesh: shapes::step_block(size, z - low).unwrap(),
            distance: Box::new(move |p| from_block(p, size, low)),
        },
        Shape {
            name: "torus",
            mesh: torus(large, small),
            distance: Box::new(move |p| (p.with_z(0.0).length() - large).hypot(p.z) - small),
        },
    ]
}

fn inside_out(mesh: &Mesh) -> Mesh {
    let mut mesh = mesh.clone();
    mesh.triangles.iter_mut().for_each(|t| t.swap(0, 1));
    mesh
}

/// A point at random on a triangle of a mesh, and the triangle.
fn on_surface(mesh: &Mesh, random: &mut Random) -> (DVec3, [DVec3; 3]) {
    let corners = mesh.triangle(random.choice(mesh.triangles.len()));
    let [a, b, c] = corners;
    let (u, v) = (random.between(0.0, 1.0), random.between(0.0, 1.0));
    let (u, v) = if u + v > 1.0 {
        (1.0 - u, 1.0 - v)
    } else {
        (u, v)
    };
    (a + (b - a) * u + (c - a) * v, corners)
}

/// Whether the eye sees the other side of the surface than the one the point is on, so that the
/// sign by the eye is wrong.
fn eye_errs(accel: &Accel, p: DVec3, eye: DVec3, outside: bool) -> bool {
    let nearest = accel.nearest(p, None);
    let seen = facing_normal(accel.corners(nearest.face), nearest.point - eye).unwrap();
    (seen.dot(p - nearest.point) < 0.0) == outside
}

/// Of points near what an eye sees edge-on, on either side of shapes of random size and pose,
/// among copies of them, wound outward and inward: the distance is the closed form's, its sign
/// included, to what the mesh departs from the shape; where the distance is less than that, there
/// is no sign to be right.
#[test]
fn the_sign_is_that_of_the_closed_form_beyond_silhouettes_too() {
    for seed in 1..=3 {
        let mut random = Random::new(seed);
        for Shape {
            name,
            mesh,
            distance,
        } in shapes_of(&mut random)
        {
            let apart = 2.0 * mesh.bounds().size().length();
            let poses: Vec<Rigid> = (0..3)
                .map(|i| {
                    let turn = random.vector(PI);
                    Rigid::from_euler_xyz(turn, DVec3::X * apart * i as f64 + random.vector(1.0))
                })
                .collect();
            for mesh in [&mesh, &inside_out(&mesh)] {
                let accel = Accel::build(&mesh.clone().into(), 1)
                    .unwrap()
                    .with_copies(poses.clone())
                    .unwrap();
                let (mut tried, mut errs) = (0, 0);
                while tried < 2000 {
                    let pose = &poses[random.choice(3)];
                    let (q, [a, b, c]) = on_surface(mesh, &mut random);
                    let normal = (b - a).cross(c - a).normalize();
                    // Where the surface is seen at less than 3°.
                    let across = random
                        .direction()
                        .reject_from_normalized(normal)
                        .normalize();
                    let view = across + normal * random.between(-0.05, 0.05);
                    let p = q + random.direction() * random.scale(2.0 * CHORD, 0.2);
                    let expected = distance(p);
                    if expected.abs() < 2.0 * CHORD {
                        continue;
                    }
                    tried += 1;
                    let eye = pose.point(q + view * 150.0);
                    let p = pose.point(p);
                    let (found, _) = signed_distance(&accel, p, eye, &mut None);
                    assert!(
                        (found - expected).abs() <= CHORD,
                        "{name} {seed}: {found} {expected}"
                    );
                    errs += usize::from(eye_errs(&accel, p, eye, expected > 0.0));
                }
                // Else the points would not be those the eye errs about.
                assert!(errs > tried / 20, "{name} {seed}: {errs}");
            }
        }
    }
}

/// Solid angle over 4π under which a closed mesh is seen from a point (van Oosterom and Strackee
/// 1983): 1 inside, 0 outside.
fn winding_number(mesh: &Mesh, p: DVec3) -> f64 {
    let angle = |i| {
        let [a, b, c] = mesh.triangle(i).map(|corner| corner - p);
        let [la, lb, lc] = [a, b, c].map(DVec3::length);
        let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * a.dot(b.cross(c)).atan2(below)
    };
    (0..mesh.triangles.len()).map(angle).sum::<f64>() / (2.0 * TAU)
}

/// An octahedron whose triangles are divided in four and their corners then moved to and from the
/// middle: spikes and hollows, edges of a few degrees among them.
fn spiky(random: &mut Random) -> Mesh {
    let mut positions: Vec<DVec3> = [DVec3::X, DVec3::Y, DVec3::Z]
        .into_iter()
        .flat_map(|v| [v, -v])
        .collect();
    let mut triangles = Vec::new();
    let mut middle = |a: u32, b: u32| {
        let sum = positions[a as usize] + positions[b as usize];
        let found = positions.iter().position(|p| *p == sum);
        found.unwrap_or_else(|| {
            positions.push(sum);
            positions.len() - 1
        }) as u32
    };
    for (x, y, z) in (0..8).map(|i| (i & 1, 2 + (i >> 1 & 1), 4 + (i >> 2 & 1))) {
        let (a, b, c) = if (x + y + z) % 2 == 0 {
            (x, y, z)
        } else {
            (x, z, y)
        };
        let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
        triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    for p in &mut positions {
        *p = p.normalize() * random.scale(0.2, 5.0);
    }
    Mesh {
        positions,
        triangles,
    }
}

/// Points off the corners, edges and faces of spiky parts, whose nearest triangle's own normal
/// would often tell the wrong side.
#[test]
fn the_sign_at_sharp_edges_and_corners_is_that_of_the_winding_number() {
    let mut random = Random::new(5);
    let mut misled = 0;
    for part in 0..30 {
        let mesh = spiky(&mut random);
        assert_eq!(report(&mesh).orientation, Orientation::Outward, "{part}");
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        for _ in 0..300 {
            let (q, [a, b, _]) = on_surface(&mesh, &mut random);
            let q = [q, a, (a + b) / 2.0][random.choice(3)];
            let p = q + random.direction() * random.scale(1e-4, 1.0);
            let inside = winding_number(&mesh, p) > 0.5;
            let (found, _) = signed_distance(&accel, p, random.vector(50.0), &mut None);
            assert_eq!(found < 0.0, inside, "{part}: {p} {found}");
            let nearest = accel.nearest(p, None);
            let [a, b, c] = accel.corners(nearest.face);
            let below = (b - a).cross(c - a).dot(p - nearest.point) < 0.0;
            misled += usize::from(below != inside);
        }
    }
    assert!(misled > 100, "{misled}");
}

/// What has no inside has no way out of it, by the same rule as the mesh report's; the sign is
/// then the eye's. A side split by triangles without area leads on to what is beyond them.
#[test]
fn a_shell_is_what_the_mesh_report_calls_closed_and_facing_one_way() {
    let block = shapes::step_block(DVec3::new(4.0, 2.0, 3.0), 1.0).unwrap();
    let changed = |change: &dyn Fn(&mut Mesh)| {
        let mut mesh = block.clone();
        change(&mut mesh);
        mesh
    };
    // The side from corner `b` to `c` of one triangle, split in the middle by a triangle
    // without area.
    let split = changed(&|mesh| {
        let [a, b, c] = mesh.triangles[0];
        let middle = (mesh.positions[b as usize] + mesh.positions[c as usize]) / 2.0;
        let m = mesh.positions.len() as u32;
        mesh.positions.push(middle);
        mesh.triangles[0] = [a, b, m];
        mesh.triangles.extend([[a, m, c], [b, c, m]]);
    });
    for (mesh, closed) in [
        (block.clone(), true),
        (inside_out(&block), true),
        (split.clone(), true),
        (changed(&|mesh| mesh.triangles.push([7, 7, 3])), true),
        (changed(&|mesh| mesh.triangles.truncate(19)), false),
        (changed(&|mesh| mesh.triangles[5].swap(0, 1)), false),
        (
            changed(&|mesh| mesh.triangles.extend(inside_out(mesh).triangles)),
            false,
        ),
    ] {
        let facing = report(&mesh).orientation;
        let one_way = matches!(facing, Orientation::Outward | Orientation::Inward);
        assert_eq!(
            (Pseudonormals::of(&mesh).is_some(), one_way),
            (closed, closed),
            "{facing:?}"
        );
    }
    let accel = Accel::build(&split.clone().into(), 1).unwrap();
    let [_, b, c] = block.triangle(0);
    let middle = block.bounds().center().with_z(1.0);
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let q = b + (c - b) * share;
        for (by, outside) in [(0.01, false), (-0.01, true)] {
            let p = q + (middle - q) * by;
            let (found, _) = signed_distance(&accel, p, middle, &mut None);
            assert_eq!(found > 0.0, outside, "{share} {found}");
        }
    }
}
