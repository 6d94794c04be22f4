//! Hierarchy without Embree: built and traversed by `obvhs` in f32, with triangles intersected in
//! f64 on the vertices of the mesh.
//!
//! Boxes are padded by more than the f32 rounding error, and the triangle test is watertight. A ray
//! at a shared edge or vertex therefore hits one of the adjacent triangles.

use super::packet_soa::{ClippedPacket, RayPacketSoA};
use super::part_bounds::PartBounds;
use super::refine::nearest_on_triangle;
use super::watertight::Sheared;
use super::{Nearest, Ray, TriangleId, WIDTH};
use crate::math::DVec3;
use crate::math::rng::{Purpose, RngKey};
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

/// Version of the crate; a test compares it with Cargo.lock.
pub const OBVHS: &str = "0.4.0";

pub struct RustBvh {
    mesh: Arc<Mesh>,
    bvh: Bvh2,
}

/// Ray in f32 for box tests.
struct Walk {
    ray: obvhs::ray::Ray,
    /// Distance by which its origin was advanced, mm.
    advanced: f64,
}

impl Walk {
    /// Creates the traversal state of ray `i`, if it hits the box.
    fn new(inside: &ClippedPacket, i: usize, part: &PartBounds) -> Option<Walk> {
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

    /// Returns the search distance for hits up to `t`, with a margin so that rounding does not
    /// exclude a nearer hit.
    fn reach(&self, t: f64, part: &PartBounds) -> f32 {
        (t - self.advanced + part.resolution()) as f32
    }
}

/// Builds the tree over boxes around `count` sets of points, given relative to the center of the
/// part. A ray that hits a set in f64 hits its box in f32.
pub(super) fn tree_over<const N: usize>(
    count: usize,
    points: impl Fn(usize) -> [Vec3A; N] + Sync,
    part: &PartBounds,
    parameters: BvhBuildParams,
) -> Bvh2 {
    build_bvh2(
        &padded_boxes(count, points, part),
        parameters,
        &mut Default::default(),
    )
}

/// Adapts the boxes of a tree built by [`tree_over`] to changed points. The structure of the tree
/// stays, therefore it is slower to trace if the points moved far.
pub(super) fn refit<const N: usize>(
    tree: &mut Bvh2,
    count: usize,
    points: impl Fn(usize) -> [Vec3A; N] + Sync,
    part: &PartBounds,
) {
    let boxes = padded_boxes(count, points, part);
    for node in &mut tree.nodes {
        let first = node.first_index as usize;
        if node.is_leaf() {
            let inside = &tree.primitive_indices[first..first + node.prim_count as usize];
            let inside = inside.iter().map(|&i| boxes[i as usize]);
            if let Some(all) = inside.reduce(|a, b| a.union(&b)) {
                node.set_aabb(all);
            }
        }
    }
    tree.refit_all();
}

fn padded_boxes<const N: usize>(
    count: usize,
    points: impl Fn(usize) -> [Vec3A; N] + Sync,
    part: &PartBounds,
) -> Vec<Aabb> {
    // The f32 error of a plane intersection is at most 15 rounding errors (2⁻²⁴) of the half size.
    // The plane and the origin have one each. Difference, reciprocal and product have two each,
    // since they are of the full size. The direction has seven; it is at least 2⁻²³ from zero.
    //
    // A small random padding is added to each face: for many equal boxes, the builder of obvhs
    // creates a chain in quadratic time.
    let padding = 2.0 * part.resolution();
    let key = RngKey::new(0, Purpose::BoxPadding);
    (0..count)
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
        .collect()
}

/// Bytes per triangle while the tree is built.
pub(super) const BUILD: u64 = 200;

impl RustBvh {
    pub(super) fn build(mesh: &Arc<Mesh>, part: &PartBounds) -> RustBvh {
        let corners = |i| mesh.triangle(i).map(|p| (p - part.center).as_vec3a());
        let medium = BvhBuildParams::medium_build();
        let mut bvh = tree_over(mesh.triangles.len(), corners, part, medium);
        // A stack that is too short would drop nodes silently.
        bvh.max_depth = (bvh.depth(0) + 1).max(DEFAULT_MAX_STACK_DEPTH);
        bvh.nodes.shrink_to_fit();
        RustBvh {
            mesh: mesh.clone(),
            bvh,
        }
    }

    /// Adapts the hierarchy to moved vertices of the mesh.
    pub(super) fn refit(&mut self, mesh: &Arc<Mesh>, part: &PartBounds) {
        let corners = |i| mesh.triangle(i).map(|p| (p - part.center).as_vec3a());
        refit(&mut self.bvh, mesh.triangles.len(), corners, part);
        self.mesh = mesh.clone();
    }

    /// Calls `found` for each ray that hits the mesh, with its index, the triangle and the distance
    /// (mm). On equal distances the first triangle is reported.
    pub(super) fn closest(
        &self,
        rays: &[Ray],
        lanes: &RayPacketSoA,
        part: &PartBounds,
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

    /// Calls `visit` with every triangle that the ray may cross up to its `t_max`, in no particular
    /// order.
    pub(super) fn along(&self, ray: &Ray, part: &PartBounds, mut visit: impl FnMut(u32)) {
        let inside = RayPacketSoA::new(&[*ray]).inside(part, None);
        if let Some(walk) = Walk::new(&inside, 0, part) {
            let visit =
                |_: &obvhs::ray::Ray, place: usize| visit(self.bvh.primitive_indices[place]);
            self.bvh.ray_traverse_anyhit(walk.ray, visit);
        }
    }

    /// Returns, as bits, whether each ray hits anything.
    pub(super) fn occluded(&self, rays: &[Ray], lanes: &RayPacketSoA, part: &PartBounds) -> u16 {
        let inside = lanes.inside(part, None);
        let blocked = |i: usize, ray: &Ray| {
            let Some(walk) = Walk::new(&inside, i, part) else {
                return false;
            };
            let sheared = Sheared::new(ray);
            let test = |_: &obvhs::ray::Ray, place: usize| {
                let triangle = self.bvh.primitive_indices[place];
                match sheared.distance(self.mesh.triangle(triangle as usize)) {
                    // Any hit within the search distance ends the traversal.
                    Some(_) => 0.0,
                    None => f32::INFINITY,
                }
            };
            !self.bvh.ray_traverse_miss(walk.ray, test)
        };
        let bit = |(i, ray)| u16::from(blocked(i, ray)) << i;
        rays.iter().enumerate().map(bit).sum()
    }

    /// Returns the point of the mesh nearest to `p`, or `best` if no point is nearer. On equal
    /// distances the first triangle is returned.
    pub(super) fn nearest(&self, p: DVec3, part: &PartBounds, mut best: Nearest) -> Nearest {
        let nodes = &self.bvh.nodes;
        let seen = p - part.center;
        let distance = |node: &Bvh2Node| {
            let (min, max) = (node.min.as_dvec3(), node.max.as_dvec3());
            seen.distance(seen.clamp(min, max))
        };
        // Only a degenerate mesh needs more.
        let mut stack: SmallVec<[(u32, f64); 96]> = SmallVec::new();
        stack.push((0, distance(&nodes[0])));
        while let Some((index, least)) = stack.pop() {
            // A padded box is nearer than its content by much more than the f64 rounding error.
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
                        face: TriangleId::of_mesh(triangle),
                        point,
                        distance,
                    };
                }
            }
        }
        best
    }
}
