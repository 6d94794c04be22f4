//! Actual parts from nominal ones: stated defects of single faces.

use super::Mesh;
use super::face::{edges, nearest, normal, smooth_face, to_triangle};
use crate::math::DVec3;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::f64::consts::FRAC_PI_2;

/// Angle between neighbouring triangles above which a face ends, rad (30°).
const CREASE: f64 = 30.0 * std::f64::consts::PI / 180.0;
/// Edges in the radius of a dent, or along a warped face, per edge length after refinement.
const DIVISIONS: f64 = 32.0;
/// Refinement stops at this number of triangles.
const MOST_TRIANGLES: usize = 4_000_000;

/// Defect of the smooth face at a point of the surface, part frame, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Defect {
    /// Depression of `depth` at the point, with a smooth profile depth·cos²(πr/2R) up to the
    /// distance R = `radius`.
    Dent {
        /// Centre on the surface.
        at: DVec3,
        /// Radius R.
        radius: f64,
        /// Depth at the centre; negative for a bump.
        depth: f64,
    },
    /// Parabolic bend of the face along its longest direction: the ends are displaced by `amount`
    /// along the outward normal at the point, and the centre stays.
    Warp {
        /// Point of the face.
        at: DVec3,
        /// Displacement of the ends.
        amount: f64,
    },
    /// Translation of the face, such as the wall of a hole. Neighbouring faces stay connected to
    /// it.
    Shift {
        /// Point of the face.
        at: DVec3,
        /// Translation.
        by: DVec3,
    },
    /// Uniform loss of material: the face recedes along its inward normals by `depth`.
    Wear {
        /// Point of the face.
        at: DVec3,
        /// Depth.
        depth: f64,
    },
}

impl Defect {
    /// Returns the point of the face.
    pub fn at(&self) -> DVec3 {
        match *self {
            Defect::Dent { at, .. }
            | Defect::Warp { at, .. }
            | Defect::Shift { at, .. }
            | Defect::Wear { at, .. } => at,
        }
    }

    /// Returns the largest displacement of the surface, mm.
    pub fn amount(&self) -> f64 {
        match *self {
            Defect::Dent { depth, .. } | Defect::Wear { depth, .. } => depth.abs(),
            Defect::Warp { amount, .. } => amount.abs(),
            Defect::Shift { by, .. } => by.length(),
        }
    }

    /// Returns the mesh with the defect. The mesh must be wound outward.
    ///
    /// # Errors
    /// Returns a message if the point is farther than `reach` from the surface, or if refinement
    /// needs too many triangles.
    pub fn apply(&self, mesh: &Mesh, reach: f64) -> Result<Mesh, String> {
        let at = self.at();
        let (seed, distance) = nearest(mesh, at).ok_or("found a mesh without triangles")?;
        if distance > reach {
            return Err(format!(
                "({}, {}, {}) mm is {distance:.4} mm from the surface, expected a point within \
                 {reach:.4} mm of it",
                at.x, at.y, at.z
            ));
        }
        let at = to_triangle(at, mesh.triangle(seed as usize));
        let outward = normal(mesh, seed).ok_or("the triangle at the point has no area")?;
        let face = smooth_face(mesh, seed, CREASE);
        match *self {
            Defect::Dent { radius, .. } if radius <= 0.0 => {
                Err(format!("found a radius of {radius} mm, expected one > 0"))
            }
            Defect::Dent { radius, depth, .. } => {
                let affected = |corners| to_triangle(at, corners).distance(at) <= radius;
                let fine = radius / DIVISIONS;
                let refined = refine(mesh, &face, &affected, &|edge| edge.length() > fine)?;
                Ok(refined.displaced(|p| {
                    let r = (p.distance(at) / radius).min(1.0);
                    -outward * depth * (FRAC_PI_2 * r).cos().powi(2)
                }))
            }
            Defect::Warp { amount, .. } => {
                let (center, along, half) = longest(mesh, &face, outward);
                let fine = 2.0 * half / DIVISIONS;
                let refined = refine(mesh, &face, &|_| true, &|edge| along.dot(edge).abs() > fine)?;
                Ok(refined.displaced(|p| {
                    let t = along.dot(p - center) / half;
                    outward * amount * t * t
                }))
            }
            Defect::Shift { by, .. } => {
                let vertices = vertices(mesh, &face);
                let mesh = mesh.clone();
                Ok(RefinedFace { mesh, vertices }.displaced(|_| by))
            }
            Defect::Wear { depth, .. } => {
                let mut sums: BTreeMap<u32, DVec3> = BTreeMap::new();
                for &triangle in &face {
                    let [a, b, c] = mesh.triangle(triangle as usize);
                    for vertex in mesh.triangles[triangle as usize] {
                        *sums.entry(vertex).or_default() += (b - a).cross(c - a);
                    }
                }
                let mut worn = mesh.clone();
                for (vertex, sum) in sums {
                    worn.positions[vertex as usize] -= sum.normalize_or_zero() * depth;
                }
                Ok(worn)
            }
        }
    }
}

/// Mesh with the vertices of one face.
struct RefinedFace {
    mesh: Mesh,
    vertices: BTreeSet<u32>,
}

impl RefinedFace {
    /// Returns the mesh with the vertices of the face displaced.
    fn displaced(mut self, by: impl Fn(DVec3) -> DVec3) -> Mesh {
        for &vertex in &self.vertices {
            let position = &mut self.mesh.positions[vertex as usize];
            *position += by(*position);
        }
        self.mesh
    }
}

fn vertices(mesh: &Mesh, triangles: &[u32]) -> BTreeSet<u32> {
    let corners = triangles.iter().map(|&i| mesh.triangles[i as usize]);
    corners.flatten().collect()
}

/// Returns the centre of the longest extent of a face perpendicular to `normal`, the direction of
/// this extent, and half of its length. Directions are compared in steps of 1°.
fn longest(mesh: &Mesh, face: &[u32], normal: DVec3) -> (DVec3, DVec3, f64) {
    let points: Vec<DVec3> = vertices(mesh, face)
        .into_iter()
        .map(|vertex| mesh.positions[vertex as usize])
        .collect();
    let u = normal.any_orthonormal_vector();
    let v = normal.cross(u);
    let extent = |direction: DVec3| {
        let along = points.iter().map(|p| direction.dot(*p));
        along.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| {
            [low.min(x), high.max(x)]
        })
    };
    let length = |direction: DVec3| {
        let [low, high] = extent(direction);
        high - low
    };
    // The shortest extent of a rectangle is along its shorter side, so the bend is parallel to the
    // other side.
    let directions = (0..180).map(|degree| {
        let (sin, cos) = f64::from(degree).to_radians().sin_cos();
        u * cos + v * sin
    });
    let narrow = directions.min_by(|a, b| length(*a).total_cmp(&length(*b)));
    let along = normal.cross(narrow.unwrap_or(u));
    let ([low, high], center) = (extent(along), points.iter().sum::<DVec3>());
    let center = center / points.len() as f64;
    let middle = center + along * ((low + high) / 2.0 - along.dot(center));
    (middle, along, (high - low) / 2.0)
}

/// Splits the edges of the affected triangles of a face until none of them is `long`. Triangles
/// next to a split edge are split too, so a closed mesh stays closed.
fn refine(
    mesh: &Mesh,
    face: &[u32],
    affected: &dyn Fn([DVec3; 3]) -> bool,
    long: &dyn Fn(DVec3) -> bool,
) -> Result<RefinedFace, String> {
    let mut positions = mesh.positions.clone();
    let face: HashSet<u32> = face.iter().copied().collect();
    let triangles = mesh.triangles.iter().enumerate();
    let mut triangles: Vec<([u32; 3], bool)> = triangles
        .map(|(i, &triangle)| (triangle, face.contains(&(i as u32))))
        .collect();
    loop {
        let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
        for &(triangle, _) in triangles.iter().filter(|(_, of_face)| *of_face) {
            if !affected(triangle.map(|vertex| positions[vertex as usize])) {
                continue;
            }
            for edge in edges(&triangle) {
                let [a, b] = edge.map(|vertex| positions[vertex as usize]);
                if long(b - a) && !middles.contains_key(&edge) {
                    middles.insert(edge, positions.len() as u32);
                    positions.push((a + b) / 2.0);
                }
            }
        }
        if middles.is_empty() {
            break;
        }
        let split = triangles.iter().flat_map(|&(triangle, of_face)| {
            let middle = edges(&triangle).map(|edge| middles.get(&edge).copied());
            let pieces = pieces(triangle, middle);
            pieces.into_iter().map(move |piece| (piece, of_face))
        });
        triangles = split.collect();
        if triangles.len() > MOST_TRIANGLES {
            return Err(format!(
                "found more than {MOST_TRIANGLES} triangles after refinement, expected a larger \
                 radius"
            ));
        }
    }
    let vertices = triangles.iter().filter(|(_, of_face)| *of_face);
    let vertices = vertices.flat_map(|(triangle, _)| *triangle).collect();
    let triangles = triangles.into_iter().map(|(triangle, _)| triangle);
    Ok(RefinedFace {
        mesh: Mesh {
            positions,
            triangles: triangles.collect(),
        },
        vertices,
    })
}

/// Returns the pieces of a triangle whose edges ab, bc and ca have these midpoints.
fn pieces([a, b, c]: [u32; 3], middles: [Option<u32>; 3]) -> Vec<[u32; 3]> {
    match middles {
        [None, None, None] => vec![[a, b, c]],
        [Some(p), None, None] => vec![[a, p, c], [p, b, c]],
        [Some(p), Some(q), None] => vec![[p, b, q], [a, p, q], [a, q, c]],
        [Some(p), Some(q), Some(r)] => vec![[a, p, r], [p, b, q], [r, q, c], [p, q, r]],
        [first, second, third] => pieces([b, c, a], [second, third, first]),
    }
}

/// Returns the bytes of a binary STL file, in millimetres. Coordinates are rounded to f32.
pub fn binary_stl(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for i in 0..mesh.triangles.len() {
        let corners = mesh.triangle(i);
        let normal = normal(mesh, i as u32).unwrap_or_default();
        for p in [normal].iter().chain(&corners) {
            // Adding zero turns −0 into 0, so equal coordinates have equal bytes.
            let numbers = p.as_vec3() + 0.0;
            bytes.extend(numbers.to_array().iter().flat_map(|x| x.to_le_bytes()));
        }
        bytes.extend([0, 0]);
    }
    bytes
}
