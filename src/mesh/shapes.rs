//! Meshes of analytic targets (mm).
//!
//! Vertices lie on the exact surface; between them the mesh deviates by at most `chord_mm`, the
//! sagitta. All meshes face outward, and all except the plane are closed.
//!
//! Errors name the wrong argument and its expected value; the caller knows the file and the key.

use std::f64::consts::PI;

use super::{MAX_COORDINATE_MM, Mesh};
use crate::math::{DVec2, DVec3};

/// Largest number of vertices of a shape: 2 GB with its acceleration structure.
const MOST_VERTICES: f64 = 4e6;

/// Argument that defines no valid shape.
#[derive(Debug, Clone, PartialEq)]
pub struct InvalidDimension {
    /// Name of the argument as in scene files, such as `radius_mm`.
    pub argument: &'static str,
    /// Description of the valid values.
    pub expected: String,
}

/// Creates a rectangle in the plane z = 0, centered at the origin, facing +z.
pub fn plane(size: DVec2) -> Result<Mesh, InvalidDimension> {
    positive("size_mm", size.x)?;
    positive("size_mm", size.y)?;
    let h = size / 2.0;
    let corners = [(-h.x, -h.y), (h.x, -h.y), (h.x, h.y), (-h.x, h.y)];
    Ok(Mesh {
        positions: corners.map(|(x, y)| DVec3::new(x, y, 0.0)).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    })
}

/// Creates a sphere about the origin: an octahedron with each face divided into n² triangles and
/// its vertices projected onto the sphere.
///
/// ```
/// use lasertrace::mesh::shapes;
///
/// let ball = shapes::sphere(5.0, 0.01)?;
/// // All vertices lie on the sphere, to rounding.
/// assert!(ball.positions.iter().all(|p| (p.length() - 5.0).abs() < 1e-14));
/// assert_eq!(shapes::sphere(0.0, 0.01).unwrap_err().argument, "radius_mm");
/// # Ok::<(), shapes::InvalidDimension>(())
/// ```
pub fn sphere(radius: f64, chord_mm: f64) -> Result<Mesh, InvalidDimension> {
    positive("radius_mm", radius)?;
    positive("chordal_deviation_um", chord_mm)?;
    // The largest triangles, at the face centers, have sides √2/n before and √6/n after projection
    // (the face is at 1/√3). Their circumradius is √2/n, so the sagitta is at most r/n². The test
    // below measures it.
    let n = (radius / chord_mm).sqrt().ceil().max(1.0);
    bounded(4.0 * n * n + 2.0)?;
    let n = n as i64;
    let mut corners = Vec::new();
    let mut triangles = Vec::new();
    for octant in 0..8 {
        let [x, y, z] = [1, 2, 4].map(|bit| if octant & bit == 0 { 1 } else { -1 });
        // Integers before normalization, so that faces agree on their common edges.
        let vertex = |i: i64, j: i64| {
            let grid = [x * i, y * j, z * (n - i - j)].map(|c| c as f64);
            DVec3::from_array(grid).normalize() * radius
        };
        let mut push = |mut t: [DVec3; 3]| {
            if x * y * z < 0 {
                t.swap(1, 2);
            }
            let first = corners.len() as u32;
            corners.extend(t);
            triangles.push([first, first + 1, first + 2]);
        };
        for i in 0..n {
            for j in 0..n - i {
                push([vertex(i, j), vertex(i + 1, j), vertex(i, j + 1)]);
                if j + 1 < n - i {
                    push([vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)]);
                }
            }
        }
    }
    Ok(Mesh::welded(&corners, &triangles))
}

/// Creates a cylinder about the y axis from y = −length/2 to length/2, with flat caps.
pub fn cylinder(radius: f64, length: f64, chord_mm: f64) -> Result<Mesh, InvalidDimension> {
    positive("radius_mm", radius)?;
    positive("length_mm", length)?;
    positive("chordal_deviation_um", chord_mm)?;
    // Sagitta of a side of a regular n-gon: r (1 − cos π/n) = 2 r sin²(π/2n).
    let half = (chord_mm / (2.0 * radius)).min(1.0).sqrt().asin();
    let n = (PI / (2.0 * half)).ceil().max(3.0);
    bounded(2.0 * n + 2.0)?;
    let n = n as u32;
    let mut positions = Vec::new();
    for k in 0..n {
        let (sin, cos) = (2.0 * PI * f64::from(k) / f64::from(n)).sin_cos();
        for y in [-length / 2.0, length / 2.0] {
            positions.push(DVec3::new(radius * cos, y, radius * sin));
        }
    }
    positions.extend([DVec3::Y * (-length / 2.0), DVec3::Y * (length / 2.0)]);
    let mut triangles = Vec::new();
    for k in 0..n {
        // Bottom and top vertices of this side and of the next: z to x is positive about y.
        let (b, t) = (2 * k, 2 * k + 1);
        let (b2, t2) = (2 * ((k + 1) % n), 2 * ((k + 1) % n) + 1);
        triangles.extend([[b, t, t2], [b, t2, b2], [2 * n, b, b2], [2 * n + 1, t2, t]]);
    }
    Ok(Mesh {
        positions,
        triangles,
    })
}

/// Creates a block on z = 0, centered in x and y. Its top is at z = `size.z` for x > 0, and lower
/// by `step_mm` for x < 0.
pub fn step_block(size: DVec3, step_mm: f64) -> Result<Mesh, InvalidDimension> {
    for extent in size.to_array() {
        positive("size_mm", extent)?;
    }
    positive("step_mm", step_mm)?;
    if step_mm >= size.z {
        return Err(InvalidDimension {
            argument: "step_mm",
            expected: format!("less than the block's height, {} mm", size.z),
        });
    }
    let (x, y, top, low) = (size.x / 2.0, size.y / 2.0, size.z, size.z - step_mm);
    // Outline as viewed from −y, counter-clockwise.
    let outline = [
        (-x, 0.0),
        (x, 0.0),
        (x, top),
        (0.0, top),
        (0.0, low),
        (-x, low),
    ];
    let end = [[0, 1, 4], [1, 2, 3], [1, 3, 4], [0, 4, 5]];
    let positions = [-y, y]
        .iter()
        .flat_map(|&y| outline.map(|(x, z)| DVec3::new(x, y, z)))
        .collect();
    let mut triangles = Vec::new();
    for [a, b, c] in end {
        triangles.extend([[a, b, c], [a + 6, c + 6, b + 6]]);
    }
    for i in 0..6 {
        let j = (i + 1) % 6;
        triangles.extend([[i, i + 6, j + 6], [i, j + 6, j]]);
    }
    Ok(Mesh {
        positions,
        triangles,
    })
}

fn positive(argument: &'static str, value_mm: f64) -> Result<(), InvalidDimension> {
    if value_mm > 0.0 && value_mm <= MAX_COORDINATE_MM {
        return Ok(());
    }
    Err(InvalidDimension {
        argument,
        expected: format!("more than 0 and at most {MAX_COORDINATE_MM:e} mm"),
    })
}

fn bounded(vertices: f64) -> Result<(), InvalidDimension> {
    if vertices <= MOST_VERTICES {
        return Ok(());
    }
    Err(InvalidDimension {
        argument: "chordal_deviation_um",
        expected: format!(
            "a larger chord: with this one the shape has {vertices:.1e} vertices, and at most \
             {MOST_VERTICES:e} are made"
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{Orientation, report};

    /// Checks that the mesh is closed, outward and without defects. Its volume must lie between
    /// `least` and the exact `volume`, as the chordal deviation explains.
    fn assert_sound(mesh: &Mesh, volume: f64, least: f64) {
        let report = report(mesh);
        assert_eq!(report.orientation, Orientation::Outward, "{report}");
        assert_eq!(
            (report.non_manifold_edges, report.winding_conflicts),
            (0, 0)
        );
        assert_eq!(
            (report.degenerate_triangles, report.duplicate_triangles),
            (0, 0)
        );
        let found = report.volume_mm3;
        assert!(
            least <= found && found <= volume * (1.0 + 1e-12),
            "{least} {found} {volume}"
        );
        for i in 0..mesh.triangles.len() {
            let [a, b, c] = mesh.triangle(i);
            assert!((b - a).cross(c - a).length() > 0.0);
        }
    }

    #[test]
    fn the_plane_faces_up() {
        let mesh = plane(DVec2::new(3.0, 2.0)).unwrap();
        for i in 0..mesh.triangles.len() {
            let [a, b, c] = mesh.triangle(i);
            assert_eq!((b - a).cross(c - a), DVec3::Z * 6.0);
        }
        assert_eq!(mesh.bounds().size(), DVec3::new(3.0, 2.0, 0.0));
        assert_eq!(report(&mesh).boundary_edges, 4);
    }

    #[test]
    fn the_sphere_keeps_its_chord() {
        for (r, chord) in [(1.0, 2.0), (1.0, 0.4), (10.0, 0.05), (3.0, 1e-3)] {
            let mesh = sphere(r, chord).unwrap();
            let inner = r - chord;
            assert_sound(
                &mesh,
                4.0 / 3.0 * PI * r.powi(3),
                4.0 / 3.0 * PI * inner.max(0.0).powi(3),
            );
            for p in &mesh.positions {
                assert!((p.length() - r).abs() < 1e-14 * r);
            }
            // The radius minus the distance of a triangle plane from the center is the sagitta.
            // Every triangle contains the foot of the perpendicular from the center, or lies
            // farther out.
            let sagitta = (0..mesh.triangles.len())
                .map(|i| {
                    let [a, b, c] = mesh.triangle(i);
                    r - a.dot((b - a).cross(c - a).normalize())
                })
                .fold(0.0, f64::max);
            assert!(sagitta <= chord, "{sagitta} > {chord}");
            assert!(
                chord > 0.1 * r || sagitta > chord / 2.0,
                "{sagitta} wastes {chord}"
            );
        }
    }

    #[test]
    fn the_cylinder_keeps_its_chord() {
        for (r, l, chord) in [(5.0, 20.0, 0.01), (0.3, 100.0, 1.0), (40.0, 1.0, 1e-4)] {
            let mesh = cylinder(r, l, chord).unwrap();
            let inner = (r - chord).max(0.0);
            assert_sound(&mesh, PI * r * r * l, PI * inner * inner * l);
            let n = (mesh.positions.len() - 2) / 2;
            assert!(r * (1.0 - (PI / n as f64).cos()) <= chord * (1.0 + 1e-9) || n == 3);
            assert_eq!(mesh.bounds().size().y, l);
            for p in &mesh.positions[..2 * n] {
                assert!((p.x.hypot(p.z) - r).abs() < 1e-14 * r);
            }
        }
    }

    #[test]
    fn the_step_is_low_on_the_left() {
        let mesh = step_block(DVec3::new(40.0, 20.0, 10.0), 2.5).unwrap();
        assert_sound(
            &mesh,
            40.0 * 20.0 * 8.75,
            40.0 * 20.0 * 8.75 * (1.0 - 1e-12),
        );
        for p in &mesh.positions {
            let tops: &[f64] = if p.x < 0.0 {
                &[0.0, 7.5]
            } else {
                &[0.0, 7.5, 10.0]
            };
            assert!(tops.contains(&p.z), "{p}");
        }
    }

    #[test]
    fn impossible_sizes_are_refused() {
        let assert_refused = |shape: Result<Mesh, InvalidDimension>, argument, words: &str| {
            let wrong = shape.unwrap_err();
            assert_eq!(wrong.argument, argument);
            assert!(wrong.expected.contains(words), "{}", wrong.expected);
        };
        let larger = "a larger chord";
        assert_refused(sphere(1.0, 1e-9), "chordal_deviation_um", larger);
        assert_refused(
            sphere(1e12, f64::MIN_POSITIVE),
            "chordal_deviation_um",
            larger,
        );
        assert_refused(cylinder(1.0, 1.0, 1e-300), "chordal_deviation_um", larger);
        assert_refused(cylinder(-1.0, 1.0, 0.1), "radius_mm", "more than 0");
        assert_refused(cylinder(1.0, 0.0, 0.1), "length_mm", "more than 0");
        assert_refused(plane(DVec2::new(f64::NAN, 1.0)), "size_mm", "more than 0");
        assert_refused(step_block(DVec3::ONE, 1.0), "step_mm", "height, 1 mm");
        assert_refused(step_block(DVec3::ONE, 0.0), "step_mm", "more than 0");
    }
}
