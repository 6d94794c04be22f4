//! A hierarchy without Embree: built and walked by `obvhs` in f32, its triangles
//! intersected in f64 on the mesh's own vertices. Boxes are padded by more than
//! f32 rounds, and the test of a triangle is watertight, so a ray at a shared edge
//! or vertex meets one of the triangles there.

use super::lanes::{Inside, Lanes};
use super::part_box::PartBox;
use super::refine::nearest_on_triangle;
use super::watertight::Sheared;
use super::{Face, Nearest, Ray, WIDTH};
use crate::math::DVec3;
use crate::math::rng::{Key, Purpose};
use crate::mesh::Mesh;
use glam::Vec3A;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::bvh2::{Bvh2, DEFAULT_MAX_STACK_DEPTH};
use obvhs::ray::RayHit;
use rayon::prelude::*;
use smallvec::SmallVec;
use std::sync::Arc;

/// Version of the crate; a test holds it against Cargo.lock.
pub const OBVHS: &str = "0.4.0";

pub struct Tree {
    mesh: Arc<Mesh>,
    bvh: Bvh2,
}

/// A ray as the boxes see it.
struct Walk {
    ray: obvhs::ray::Ray,
    /// Distance by which its origin was advanced, mm.
    advanced: f64,
}

impl Walk {
    /// Of ray `i`, if it meets the box.
    fn new(inside: &Inside, i: usize, part: &PartBox) -> Option<Walk> {
        let (advanced, length) = (inside.advanced[i], inside.length[i]);
        let vector = |v: &[[f32; WIDTH]; 3]| Vec3A::from(v.map(|lane| lane[i]));
        (length >= 0.0).then(|| Walk {
            ray: obvhs::ray::Ray::new(
                vector(&inside.origin),
                vector(&inside.direction),
                0.0,
                (length + part.resolution()) as f32,
            ),
            advanced,
        })
    }

    /// How far a ray has to look that is to meet nothing beyond `t`: rounding must
    /// not cut off a nearer hit.
    fn reach(&self, t: f64, part: &PartBox) -> f32 {
        (t - self.advanced + part.resolution()) as f32
    }
}

/// The tree over boxes around so many sets of points, those of each relative to the
/// middle of the part. A ray that meets a set in f64 meets its box in f32.
pub(super) fn tree_over<const N: usize>(
    count: usize,
    points: impl Fn(usize) -> [Vec3A; N] + Sync,
    part: &PartBox,
    parameters: BvhBuildParams,
) -> Bvh2 {
    // f32 meets the planes of a box to within 15 roundings (2⁻²⁴) of the half
    // size: one each of the plane and of the origin, two each, since they are of
    // the whole size, of difference, reciprocal and product, and seven for the
    // direction, which is kept 2⁻²³ off zero.
    // Each face has a little more of its own: from many boxes that are the same,
    // obvhs's builder makes a chain, in quadratic time.
    let padding = 2.0 * part.resolution();
    let key = Key::new(0, Purpose::BoxPadding);
    let boxes: Vec<Aabb> = (0..count)
        .into_par_iter()
        .map(|i| {
            let tight = Aabb::from_points(&points(i));
            let key = key.with(i as u64);
            let pad = |k: u64| (padding * (1.0 + key.uniform(k))) as f32;
            Aabb::new(
                tight.min - Vec3A::new(pad(0), pad(1), pad(2)),
                tight.max + Vec3A::new(pad(3), pad(4), pad(5)),
            )
        })
        .collect();
    build_bvh2(&boxes, parameters, &mut Default::default())
}

/// Bytes a triangle takes while the tree is built.
pub(super) const BUILD: u64 = 200;

impl Tree {
    pub(super) fn build(mesh: &Arc<Mesh>, part: &PartBox) -> Tree {
        let corners = |i| mesh.triangle(i).map(|p| (p - part.center).as_vec3a());
        let medium = BvhBuildParams::medium_build();
        let mut bvh = tree_over(mesh.triangles.len(), corners, part, medium);
        // A stack that is too short would drop nodes without a word.
        bvh.max_depth = (bvh.depth(0) + 1).max(DEFAULT_MAX_STACK_DEPTH);
        bvh.nodes.shrink_to_fit();
        Tree {
            mesh: mesh.clone(),
            bvh,
        }
    }

    /// Calls `found` for each ray that meets the mesh, with its number, the triangle
    /// and the distance (mm). At the same distance the first triangle is met.
    pub(super) fn closest(
        &self,
        rays: &[Ray],
        lanes: &Lanes,
        part: &PartBox,
        mut found: impl FnMut(usize, u32, f64),
    ) {
        let inside = lanes.inside(part, None);
        for (i, ray) in rays.iter().enumerate() {
            let Some(walk) = Walk::new(&inside, i, part) else {
                continue;
            };
            let sheared = Sheared::new(ray);
            let mut best = (f64::INFINITY, u32::MAX);
            let test = |_: &obvhs::ray::Ray, place: usize| {
                let triangle = self.bvh.primitive_indices[place];
                match sheared.distance(self.mesh.triangle(triangle as usize)) {
                    Some(t) if (t, triangle) < best => {
                        best = (t, triangle);
                        walk.reach(t, part)
                    }
                    _ => f32::INFINITY,
                }
            };
            self.bvh.ray_traverse(walk.ray, &mut RayHit::none(), test);
            if best.1 != u32::MAX {
                found(i, best.1, best.0);
            }
        }
    }

    /// Whether each ray meets anything, as bits.
    pub(super) fn occluded(&self, rays: &[Ray], lanes: &Lanes, part: &PartBox) -> u16 {
        let inside = lanes.inside(part, None);
        let blocked = |i: usize, ray: &Ray| {
            let Some(walk) = Walk::new(&inside, i, part) else {
                return false;
            };
            let sheared = Sheared::new(ray);
            let test = |_: &obvhs::ray::Ray, place: usize| {
                let triangle = self.bvh.primitive_indices[place];
                match sheared.distance(self.mesh.triangle(triangle as usize)) {
                    // Anything within reach ends the walk.
                    Some(_) => 0.0,
                    None => f32::INFINITY,
                }
            };
            !self.bvh.ray_traverse_miss(walk.ray, test)
        };
        let bit = |(i, ray)| u16::from(blocked(i, ray)) << i;
        rays.iter().enumerate().map(bit).sum()
    }

    /// The point of the mesh nearest to `p`, which `best` is at most as near; of
    /// several, that of the first triangle.
    pub(super) fn nearest(&self, p: DVec3, part: &PartBox, mut best: Nearest) -> Nearest {
        let nodes = &self.bvh.nodes;
        let seen = p - part.center;
        let distance = |node: &Bvh2Node| {
            let (min, max) = (node.min.as_dvec3(), node.max.as_dvec3());
            seen.distance(seen.clamp(min, max))
        };
        // Only a mesh of a strange shape needs more.
        let mut stack: SmallVec<[(u32, f64); 96]> = SmallVec::new();
        stack.push((0, distance(&nodes[0])));
        while let Some((index, least)) = stack.pop() {
            // A padded box is nearer than what it holds by far more than f64 rounds.
            if least > best.distance {
                continue;
            }
            let node = &nodes[index as usize];
            let first = node.first_index;
            if !node.is_leaf() {
                let [a, b] =
                    [first, first + 1].map(|child| (child, distance(&nodes[child as usize])));
                let (near, far) = if b.1 < a.1 { (b, a) } else { (a, b) };
                stack.extend([far, near]);
                continue;
            }
            for place in first..first + node.prim_count {
                let triangle = self.bvh.primitive_indices[place as usize];
                let point = nearest_on_triangle(self.mesh.triangle(triangle as usize), p);
                let distance = point.distance(p);
                if (distance, triangle) < (best.distance, best.face.triangle) {
                    best = Nearest {
                        face: Face::of_mesh(triangle),
                        point,
                        distance,
                    };
                }
            }
        }
        best
    }
}
