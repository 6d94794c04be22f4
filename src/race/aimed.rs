//! Rays aimed, to f32 precision, at edges and vertices where they must hit the mesh. All adjacent
//! triangles face the ray by more than 6° (a sine of 0.1), and none of their edges is open.

use super::laps::CHUNK;
use super::racers::BenchBackend;
use super::rays::flat;
use crate::accel::Ray;
use crate::accel::embree_race::{FlatHit, FlatRay};
use crate::math::DVec3;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::Mesh;
use serde::Serialize;
use std::time::Instant;

pub struct Aimed {
    pub rays: Vec<FlatRay>,
    /// Distance from every ray origin to its target, mm.
    targets: Vec<f64>,
    /// Distance of the ray origins from their targets: the diagonal of the mesh, mm.
    distance: f64,
}

pub struct AimedRays {
    pub edges: Aimed,
    pub vertices: Aimed,
}

impl Aimed {
    /// Counts the rays that hit nothing, or hit more than `tolerance` behind their target, and the
    /// rays that were traced before `end`.
    pub fn missed_by(&self, racer: &dyn BenchBackend, tolerance: f64, end: Instant) -> MissCount {
        let mut asked = MissCount::default();
        let chunks = self.rays.chunks(CHUNK).zip(self.targets.chunks(CHUNK));
        for (rays, targets) in chunks.take_while(|_| Instant::now() < end) {
            let mut hits = vec![FlatHit::NONE; rays.len()];
            racer.closest(rays, false, &mut hits);
            let missed = |(hit, target): &(&FlatHit, &f64)| hit.t as f64 > *target + tolerance;
            asked.missed += hits.iter().zip(targets).filter(missed).count();
            asked.rays += rays.len();
        }
        asked
    }
}

/// Result for rays that must hit the mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MissCount {
    pub rays: usize,
    pub missed: usize,
}

/// Triangles around every vertex, in one list.
struct Fans {
    /// Index of the first triangle of every vertex.
    start: Vec<usize>,
    triangles: Vec<u32>,
}

impl Fans {
    fn new(mesh: &Mesh) -> Fans {
        let mut start = vec![0; mesh.positions.len() + 1];
        for &v in mesh.triangles.as_flattened() {
            start[v as usize + 1] += 1;
        }
        for v in 1..start.len() {
            start[v] += start[v - 1];
        }
        let mut next = start.clone();
        let mut triangles = vec![0; 3 * mesh.triangles.len()];
        for (i, corners) in mesh.triangles.iter().enumerate() {
            for &v in corners {
                triangles[next[v as usize]] = i as u32;
                next[v as usize] += 1;
            }
        }
        Fans { start, triangles }
    }

    fn of(&self, v: u32) -> &[u32] {
        &self.triangles[self.start[v as usize]..self.start[v as usize + 1]]
    }

    /// Returns the triangles at the edge from `a` to `b`.
    fn at_edge(&self, mesh: &Mesh, a: u32, b: u32) -> Vec<u32> {
        let has_b = |&&t: &&u32| mesh.triangles[t as usize].contains(&b);
        self.of(a).iter().filter(has_b).copied().collect()
    }

    /// Whether every edge at `v` has two triangles.
    fn is_closed(&self, mesh: &Mesh, v: u32) -> bool {
        let corners = self.of(v).iter().flat_map(|&t| mesh.triangles[t as usize]);
        corners
            .filter(|&w| w != v)
            .all(|w| self.at_edge(mesh, v, w).len() == 2)
    }
}

/// Maximum number of triangles at a vertex that is a target. Testing whether its edges are closed
/// takes quadratic time in this number.
const MOST_AROUND: usize = 64;

/// Returns up to `count` rays at edges and up to `count` rays at vertices. A mesh with few suitable
/// edges or vertices gives fewer.
pub fn rays(mesh: &Mesh, count: usize) -> AimedRays {
    let fans = Fans::new(mesh);
    let key = RngKey::new(2, Purpose::RaceRays);
    let distance = mesh.bounds().size().length();
    let empty = || Aimed {
        distance,
        rays: Vec::new(),
        targets: Vec::new(),
    };
    let mut aimed = AimedRays {
        edges: empty(),
        vertices: empty(),
    };
    for i in 0..count as u64 {
        let key = key.with(i);
        let triangle = (key.uniform(0) * mesh.triangles.len() as f64) as usize;
        let [a, b, _] = mesh.triangles[triangle];
        let ends = [a, b].map(|v| mesh.positions[v as usize]);
        if fans.of(a).len() > MOST_AROUND {
            continue;
        }
        let beside = fans.at_edge(mesh, a, b);
        if beside.len() == 2 {
            let target = ends[0].lerp(ends[1], key.uniform(1));
            aim(mesh, &beside, target, key.with(1), &mut aimed.edges);
        }
        if fans.is_closed(mesh, a) {
            aim(mesh, fans.of(a), ends[0], key.with(2), &mut aimed.vertices);
        }
    }
    aimed
}

/// Adds a ray to `target` from a random position on the side of the first triangle's normal, if all
/// `triangles` face it.
fn aim(mesh: &Mesh, triangles: &[u32], target: DVec3, key: RngKey, into: &mut Aimed) {
    let normal = |t: u32| {
        let [a, b, c] = mesh.triangle(t as usize);
        (b - a).cross(c - a).try_normalize()
    };
    let Some(up) = normal(triangles[0]) else {
        return;
    };
    let random = DVec3::from_array(std::array::from_fn(|k| 2.0 * key.uniform(k as u64) - 1.0));
    let eye = (target + (up + 0.8 * random).normalize() * into.distance)
        .as_vec3()
        .as_dvec3();
    let Some(ray) = Ray::between(eye, target) else {
        return;
    };
    let faces = |&t: &u32| normal(t).is_some_and(|n| n.dot(ray.direction) < -0.1);
    // In a mesh with inward winding, no triangle faces an outside viewpoint. The origin is
    // therefore on the side that the triangle faces.
    if triangles.iter().all(faces) {
        into.targets.push(ray.t_max);
        into.rays.push(flat(&Ray {
            t_max: f64::INFINITY,
            ..ray
        }));
    }
}
