//! A hierarchy without Embree: built by `obvhs` in f32, traversed by 16 rays at
//! once, and its triangles intersected in f64 on the mesh's own vertices. Boxes
//! are padded by more than f32 rounds, and the test of a triangle is watertight,
//! so a ray at a shared edge or vertex meets one of the triangles there.

use super::hierarchy::PartBox;
use super::refine::nearest_on_triangle;
use super::{Nearest, Ray, WIDTH};
use crate::math::DVec3;
use crate::mesh::Mesh;
use glam::Vec3A;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::bvh2::node::Bvh2Node;
use rayon::prelude::*;
use smallvec::SmallVec;

/// Version of the crate that builds the tree; a test holds it against Cargo.lock.
pub const OBVHS: &str = "0.4.0";

/// Nodes still to visit, with the distance at which they begin. Only a mesh of a
/// strange shape makes a deeper tree than fits without an allocation.
type Stack<T> = SmallVec<[(u32, T); 96]>;

pub struct Tree {
    /// A node's children are neighbours; the first node is the root.
    nodes: Vec<Bvh2Node>,
    /// Triangles in the order of the leaves.
    order: Vec<u32>,
}

/// Up to 16 rays as boxes see them: in f32, from where they enter the part's box.
struct Packet {
    origin: [[f32; WIDTH]; 3],
    inverse: [[f32; WIDTH]; 3],
    /// How far each ray still looks; -1: not at all.
    reach: [f32; WIDTH],
    /// Distance by which each origin was advanced, mm.
    advanced: [f64; WIDTH],
}

impl Packet {
    fn new(rays: &[Ray], part: &PartBox) -> Packet {
        assert!(rays.len() <= WIDTH, "a packet holds {WIDTH} rays");
        let mut packet = Packet {
            origin: [[0.0; WIDTH]; 3],
            inverse: [[1.0; WIDTH]; 3],
            reach: [-1.0; WIDTH],
            advanced: [0.0; WIDTH],
        };
        for (i, ray) in rays.iter().enumerate() {
            let Some(inside) = part.inside(ray) else {
                continue;
            };
            let inverse = ray.direction.as_vec3().recip();
            for axis in 0..3 {
                packet.origin[axis][i] = inside.origin[axis];
                packet.inverse[axis][i] = inverse[axis];
            }
            packet.advanced[i] = inside.advanced;
            // Rounding the length must not cut off what lies at its end.
            packet.reach[i] = (inside.length + part.resolution()) as f32;
        }
        packet
    }

    /// Where each ray enters a box; infinity if it does not, within its reach. A
    /// ray in the plane of a face gives 0·∞ = NaN, which the comparisons, written
    /// so that each is one instruction, pass over or take for a miss: it is on the
    /// face of a padded box and meets nothing of what is inside.
    #[inline(always)]
    fn entries(&self, node: &Bvh2Node) -> [f32; WIDTH] {
        let (min, max) = (node.min.to_array(), node.max.to_array());
        let mut enter = [0.0f32; WIDTH];
        let mut leave = self.reach;
        for axis in 0..3 {
            let (origin, inverse) = (&self.origin[axis], &self.inverse[axis]);
            for lane in 0..WIDTH {
                let a = (min[axis] - origin[lane]) * inverse[lane];
                let b = (max[axis] - origin[lane]) * inverse[lane];
                let (first, last) = (if a < b { a } else { b }, if a > b { a } else { b });
                enter[lane] = if first > enter[lane] {
                    first
                } else {
                    enter[lane]
                };
                leave[lane] = if last < leave[lane] {
                    last
                } else {
                    leave[lane]
                };
            }
        }
        for lane in 0..WIDTH {
            enter[lane] = if enter[lane] <= leave[lane] {
                enter[lane]
            } else {
                f32::INFINITY
            };
        }
        enter
    }

    #[inline(always)]
    fn first_entry(&self, node: &Bvh2Node) -> f32 {
        let entries = self.entries(node);
        entries
            .iter()
            .fold(f32::INFINITY, |a, &b| if b < a { b } else { a })
    }

    #[inline(always)]
    fn furthest(&self) -> f32 {
        self.reach
            .iter()
            .fold(-1.0, |a, &b| if b > a { b } else { a })
    }
}

/// A ray made ready for triangles: the axis it runs along most becomes z, and a
/// shear makes it that axis (Woop, Benthin & Wald 2013, "Watertight ray/triangle
/// intersection").
#[derive(Clone, Copy, Default)]
struct Sheared {
    origin: DVec3,
    axes: [usize; 3],
    shear: DVec3,
    t_max: f64,
}

impl Sheared {
    fn new(ray: &Ray) -> Sheared {
        let size = ray.direction.abs();
        let z = match size.x > size.y {
            true if size.x > size.z => 0,
            false if size.y > size.z => 1,
            _ => 2,
        };
        let (x, y) = ((z + 1) % 3, (z + 2) % 3);
        let d = ray.direction;
        Sheared {
            origin: ray.origin,
            axes: [x, y, z],
            shear: DVec3::new(d[x], d[y], 1.0) / d[z],
            t_max: ray.t_max,
        }
    }

    #[inline(always)]
    fn apply(&self, p: DVec3) -> DVec3 {
        let p = (p - self.origin).to_array();
        let [x, y, z] = self.axes.map(|axis| p[axis]);
        let s = self.shear;
        DVec3::new(x - s.x * z, y - s.y * z, s.z * z)
    }

    /// Distance to a triangle. Each corner is rounded once, for all triangles that
    /// share it, and the sign of an edge function of rounded corners is never
    /// wrong, only zero at times, which counts as inside. So no ray slips between
    /// neighbours.
    #[inline(always)]
    fn distance(&self, corners: [DVec3; 3]) -> Option<f64> {
        let [a, b, c] = corners.map(|p| self.apply(p));
        let u = c.x * b.y - c.y * b.x;
        let v = a.x * c.y - a.y * c.x;
        let w = b.x * a.y - b.y * a.x;
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let t = (u * a.z + v * b.z + w * c.z) / (u + v + w);
        // False for NaN: a triangle seen exactly edge-on.
        (t >= 0.0 && t <= self.t_max).then_some(t)
    }
}

impl Tree {
    pub(super) fn build(mesh: &Mesh, part: &PartBox) -> Tree {
        // The planes of a box are met where f32 says to within ten roundings of the
        // half size: one of the plane, one of the origin, and one each, of at most
        // the whole size, of difference, direction, reciprocal and product.
        let padding = Vec3A::splat(part.resolution() as f32);
        let boxes: Vec<Aabb> = (0..mesh.triangles.len())
            .into_par_iter()
            .map(|i| {
                let corners = mesh.triangle(i).map(|p| (p - part.center).as_vec3a());
                let tight = Aabb::from_points(&corners);
                Aabb::new(tight.min - padding, tight.max + padding)
            })
            .collect();
        let tree = build_bvh2(
            &boxes,
            BvhBuildParams::medium_build(),
            &mut Default::default(),
        );
        let (mut nodes, order) = (tree.nodes, tree.primitive_indices);
        nodes.shrink_to_fit();
        Tree { nodes, order }
    }

    /// Calls `hit(lane, distance, triangle)` for triangles that rays meet within
    /// their reach and takes from it the reach that is left.
    #[inline(always)]
    fn traverse(
        &self,
        rays: &[Ray],
        packet: &mut Packet,
        mesh: &Mesh,
        mut hit: impl FnMut(usize, f64, u32) -> f32,
    ) {
        let mut sheared = [Sheared::default(); WIDTH];
        for (sheared, ray) in sheared.iter_mut().zip(rays) {
            *sheared = Sheared::new(ray);
        }
        let mut stack = Stack::new();
        stack.push((0, packet.first_entry(&self.nodes[0])));
        let mut furthest = packet.furthest();
        while let Some((index, entry)) = stack.pop() {
            // Also when nothing is entered: infinity.
            if entry > furthest {
                continue;
            }
            let node = &self.nodes[index as usize];
            let first = node.first_index;
            if !node.is_leaf() {
                let [a, b] = [first, first + 1]
                    .map(|child| (child, packet.first_entry(&self.nodes[child as usize])));
                let (near, far) = if b.1 < a.1 { (b, a) } else { (a, b) };
                if far.1 < f32::INFINITY {
                    stack.push(far);
                }
                if near.1 < f32::INFINITY {
                    stack.push(near);
                }
                continue;
            }
            let entries = packet.entries(node);
            for &triangle in &self.order[first as usize..(first + node.prim_count) as usize] {
                let corners = mesh.triangle(triangle as usize);
                for lane in 0..rays.len() {
                    if entries[lane] < f32::INFINITY
                        && let Some(t) = sheared[lane].distance(corners)
                    {
                        packet.reach[lane] = hit(lane, t, triangle);
                    }
                }
            }
            furthest = packet.furthest();
        }
    }

    /// Calls `found` for each ray that meets the mesh, with its number, the triangle
    /// and the distance (mm). At the same distance the first triangle is met.
    pub(super) fn closest(
        &self,
        rays: &[Ray],
        mesh: &Mesh,
        part: &PartBox,
        mut found: impl FnMut(usize, u32, f64),
    ) {
        let mut packet = Packet::new(rays, part);
        let mut best = [(f64::INFINITY, u32::MAX); WIDTH];
        let advanced = packet.advanced;
        let slack = part.resolution();
        pulp::Arch::new().dispatch(
            #[inline(always)]
            || {
                self.traverse(rays, &mut packet, mesh, |lane, t, triangle| {
                    if (t, triangle) < best[lane] {
                        best[lane] = (t, triangle);
                    }
                    (best[lane].0 - advanced[lane] + slack) as f32
                })
            },
        );
        for (lane, (t, triangle)) in best.into_iter().enumerate() {
            if triangle != u32::MAX {
                found(lane, triangle, t);
            }
        }
    }

    /// Whether each ray meets anything, as bits.
    pub(super) fn occluded(&self, rays: &[Ray], mesh: &Mesh, part: &PartBox) -> u16 {
        let mut packet = Packet::new(rays, part);
        let mut bits = 0;
        pulp::Arch::new().dispatch(
            #[inline(always)]
            || {
                self.traverse(rays, &mut packet, mesh, |lane, _, _| {
                    bits |= 1 << lane;
                    -1.0
                })
            },
        );
        bits
    }

    /// The point of the mesh nearest to `p`; of several, that of the first triangle.
    pub(super) fn nearest(&self, p: DVec3, mesh: &Mesh, part: &PartBox) -> Nearest {
        let seen = p - part.center;
        let distance = |node: &Bvh2Node| {
            let (min, max) = (node.min.as_dvec3(), node.max.as_dvec3());
            seen.distance(seen.clamp(min, max))
        };
        let mut best = Nearest {
            triangle: u32::MAX,
            point: p,
            distance: f64::INFINITY,
        };
        let mut stack = Stack::new();
        stack.push((0, distance(&self.nodes[0])));
        while let Some((index, least)) = stack.pop() {
            // A padded box is nearer than what it holds by far more than f64 rounds.
            if least > best.distance {
                continue;
            }
            let node = &self.nodes[index as usize];
            let first = node.first_index;
            if !node.is_leaf() {
                let [a, b] =
                    [first, first + 1].map(|child| (child, distance(&self.nodes[child as usize])));
                let (near, far) = if b.1 < a.1 { (b, a) } else { (a, b) };
                stack.extend([far, near]);
                continue;
            }
            for &triangle in &self.order[first as usize..(first + node.prim_count) as usize] {
                let point = nearest_on_triangle(mesh.triangle(triangle as usize), p);
                let distance = point.distance(p);
                if (distance, triangle) < (best.distance, best.triangle) {
                    best = Nearest {
                        triangle,
                        point,
                        distance,
                    };
                }
            }
        }
        best
    }
}
