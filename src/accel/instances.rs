//! Instances of one mesh, each with a pose, in a tree over their boxes.
//!
//! An instance is traced in its own frame. The accuracy of f32 and f64 is therefore equal to the
//! accuracy for a single part, for any distance between the instances. Embree's instances lack this
//! property: they are traversed with f32 rays relative to one common center.

use super::clusters::HalfSpace;
use super::packet_soa::RayPacketSoA;
use super::part_bounds::PartBounds;
use super::rust_bvh::{refit, tree_over};
use super::{Ray, WIDTH};
use crate::math::{Aabb, DVec3, Rigid};
use glam::Vec3A;
use multiversion::multiversion;
use obvhs::BvhBuildParams;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use smallvec::SmallVec;
use std::ops::ControlFlow;
use std::sync::Arc;
use wide::f32x8;

/// Bytes per instance while the tree is built, in addition to its pose: 201 measured.
pub(super) const BUILD: u64 = 220;

pub(super) struct InstanceBvh {
    /// Poses part_from_copy.
    poses: Arc<[Rigid]>,
    /// Tree with one instance per leaf.
    tree: Bvh2,
    part: PartBounds,
    largest_translation: f64,
    /// Value of [`cost`] when the tree was built.
    cost: f64,
}

/// Factor of the cost of the tree at which it is rebuilt after moves.
const SLOWER: f64 = 2.0;

/// Returns the expected number of nodes that a random ray through the tree visits: the sum of their
/// surface areas, relative to the root (Goldsmith & Salmon 1987).
fn cost(tree: &Bvh2) -> f64 {
    let area = |node: &Bvh2Node| f64::from(node.aabb().half_area());
    let all: f64 = tree.nodes.iter().map(area).sum();
    all / area(&tree.nodes[0])
}

fn bounds_of(poses: &[Rigid], mesh: &Aabb) -> PartBounds {
    let bounds = poses.iter().map(|pose| mesh.moved(pose));
    PartBounds::new(bounds.fold(Aabb::EMPTY, |all, one| all.with(&one)))
}

fn corners_of(pose: &Rigid, mesh: &Aabb, part: &PartBounds) -> [Vec3A; 8] {
    let corners = mesh.corners().map(|corner| pose.point(corner));
    corners.map(|corner| (corner - part.center).as_vec3a())
}

fn largest_translation(poses: &[Rigid]) -> f64 {
    let translations = poses
        .iter()
        .map(|pose| pose.translation.abs().max_element());
    translations.fold(0.0, f64::max)
}

/// Content of a node of the tree.
enum Below {
    Copy(u32),
    Nodes([u32; 2]),
}

/// Stack of nodes to be visited; it exceeds its inline size only for a degenerate tree.
type Stack<T> = SmallVec<[T; 64]>;

/// Up to 16 rays in f32 for box tests, relative to the center of the part.
pub(super) struct InstancePacket {
    origin: [[f32; WIDTH]; 3],
    inverse: [[f32; WIDTH]; 3],
    /// Distances by which the origins were advanced, mm.
    advanced: [f64; WIDTH],
    /// Search distance of each ray from its advanced origin, mm; negative if the ray is inactive.
    reach: [f32; WIDTH],
    /// Margin of the search distance, mm, so that rounding does not exclude a nearer hit.
    slack: f64,
}

impl InstancePacket {
    fn new(rays: &[Ray], part: &PartBounds) -> InstancePacket {
        let inside = RayPacketSoA::new(rays).inside(part, None);
        let mut packet = InstancePacket {
            origin: inside.origin,
            // Limited so that no NaN arises at a face parallel to the ray.
            inverse: (inside.direction)
                .map(|lane| lane.map(|d| 1.0 / d.abs().max(f32::EPSILON).copysign(d))),
            advanced: inside.advanced,
            reach: [-1.0; WIDTH],
            slack: part.resolution(),
        };
        for i in (0..rays.len()).filter(|&i| inside.length[i] >= 0.0) {
            packet.reach[i] = (inside.length[i] + packet.slack) as f32;
        }
        packet
    }

    /// Limits the search of a ray to `t` mm from its origin.
    pub fn shorten(&mut self, ray: usize, t: f64) {
        let reach = (t - self.advanced[ray] + self.slack) as f32;
        self.reach[ray] = self.reach[ray].min(reach);
    }

    /// Deactivates a ray.
    pub fn end(&mut self, ray: usize) {
        self.reach[ray] = -1.0;
    }

    /// Returns, as bits, the rays whose search distance is at least `distance`.
    fn rays_reaching(&self, distance: f32) -> u16 {
        let distance = f32x8::splat(distance);
        let far = |part| eight(&self.reach, part).simd_ge(distance).to_bitmask() as u16;
        far(0) | far(1) << 8
    }
}

/// Returns, for each of two boxes, the bits of the rays that hit it and the smallest distance at
/// which a ray enters it.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn meet_both(packet: &InstancePacket, boxes: [&Bvh2Node; 2]) -> [(u16, f32); 2] {
    let mut both = [(0, 0.0); 2];
    for (node, met) in boxes.into_iter().zip(&mut both) {
        *met = intersect_box(packet, node);
    }
    both
}

/// Tests one box. Loops over all rays compute the distances, which the compiler vectorizes. The
/// bits use `wide`, because such a loop is not vectorized.
#[inline(always)]
fn intersect_box(packet: &InstancePacket, node: &Bvh2Node) -> (u16, f32) {
    let less = |a: f32, b: f32| if a < b { a } else { b };
    let more = |a: f32, b: f32| if a > b { a } else { b };
    let (mut enter, mut leave) = ([0.0; WIDTH], packet.reach);
    for axis in 0..3 {
        let (low, high) = (node.min[axis], node.max[axis]);
        for i in 0..WIDTH {
            let (origin, inverse) = (packet.origin[axis][i], packet.inverse[axis][i]);
            let (a, b) = ((low - origin) * inverse, (high - origin) * inverse);
            enter[i] = more(enter[i], less(a, b));
            leave[i] = less(leave[i], more(a, b));
        }
    }
    let mut met = 0;
    let mut least = f32x8::splat(f32::INFINITY);
    for part in 0..2 {
        let enter = eight(&enter, part);
        let inside = enter.simd_le(eight(&leave, part));
        met |= (inside.to_bitmask() as u16) << (8 * part);
        least = least.fast_min(inside.select(enter, f32x8::splat(f32::INFINITY)));
    }
    // Three steps instead of a chain of eight.
    let [a, b, c, d, e, f, g, h] = least.to_array();
    (
        met,
        less(less(less(a, b), less(c, d)), less(less(e, f), less(g, h))),
    )
}

/// Returns the first or the second eight rays. (Calls of `map` or a conversion from a slice would
/// not be inlined.)
#[inline(always)]
fn eight(rays: &[f32; WIDTH], part: usize) -> f32x8 {
    let mut lanes = [0.0; WIDTH / 2];
    lanes.copy_from_slice(&rays[8 * part..8 * part + 8]);
    f32x8::new(lanes)
}

impl InstanceBvh {
    /// Builds the tree. `poses` (at least one) are part_from_copy; `mesh` is the box of the mesh.
    pub fn new(poses: Arc<[Rigid]>, mesh: &Aabb) -> InstanceBvh {
        let part = bounds_of(&poses, mesh);
        let parameters = BvhBuildParams {
            max_prims_per_leaf: 1,
            ..BvhBuildParams::medium_build()
        };
        let corners = |i: usize| corners_of(&poses[i], mesh, &part);
        let tree = tree_over(poses.len(), corners, &part, parameters);
        InstanceBvh {
            largest_translation: largest_translation(&poses),
            cost: cost(&tree),
            poses,
            tree,
            part,
        }
    }

    /// Adapts the tree to changed poses of the same number, or to a changed box of the mesh. It is
    /// rebuilt if the instances moved so far that it would be slow to trace.
    pub fn update(&mut self, poses: Arc<[Rigid]>, mesh: &Aabb) {
        self.part = bounds_of(&poses, mesh);
        let corners = |i: usize| corners_of(&poses[i], mesh, &self.part);
        refit(&mut self.tree, poses.len(), corners, &self.part);
        if cost(&self.tree) > SLOWER * self.cost {
            *self = InstanceBvh::new(poses, mesh);
            return;
        }
        self.largest_translation = largest_translation(&poses);
        self.poses = poses;
    }

    /// Returns the largest translation of the poses along an axis, mm.
    pub fn largest_translation(&self) -> f64 {
        self.largest_translation
    }

    pub fn bounds(&self) -> Aabb {
        self.part.bounds
    }

    pub fn poses(&self) -> &[Rigid] {
        &self.poses
    }

    fn below(&self, index: u32) -> Below {
        let node = &self.tree.nodes[index as usize];
        let first = node.first_index;
        match node.is_leaf() {
            true => Below::Copy(self.tree.primitive_indices[first as usize]),
            false => Below::Nodes([first, first + 1]),
        }
    }

    /// Calls `met` with each instance whose box is hit by some of up to 16 rays, and with the bits
    /// of these rays. Instances are approximately in order of distance. Rays shortened by `met`
    /// remain so for the following instances.
    pub fn along(&self, rays: &[Ray], mut met: impl FnMut(u32, u16, &mut InstancePacket)) {
        let mut packet = InstancePacket::new(rays, &self.part);
        let mut stack = Stack::new();
        stack.push((0, u16::MAX, 0.0));
        while let Some((index, rays, least)) = stack.pop() {
            let rays = rays & packet.rays_reaching(least);
            if rays == 0 {
                continue;
            }
            match self.below(index) {
                Below::Copy(copy) => met(copy, rays, &mut packet),
                Below::Nodes(children) => {
                    let boxes = children.map(|child| &self.tree.nodes[child as usize]);
                    let [a, b] = meet_both(&packet, boxes);
                    let [a, b] = [(children[0], a.0, a.1), (children[1], b.0, b.1)];
                    let (near, far) = if b.2 < a.2 { (b, a) } else { (a, b) };
                    stack.extend([far, near]);
                }
            }
        }
    }

    /// Calls `look` with each instance whose box is within the current search distance of `p`,
    /// nearest first. The search distance is `within` at first, then the last value returned by
    /// `look`, mm.
    pub fn around(&self, p: DVec3, mut within: f64, mut look: impl FnMut(u32) -> f64) {
        let seen = p - self.part.center;
        let mut stack = Stack::new();
        stack.push((0, 0.0));
        while let Some((index, least)) = stack.pop() {
            // A padded box is nearer than its content by much more than the f64 rounding error.
            if least > within {
                continue;
            }
            match self.below(index) {
                Below::Copy(copy) => within = look(copy),
                Below::Nodes(children) => {
                    let [a, b] = children.map(|child| {
                        let node = &self.tree.nodes[child as usize];
                        let (min, max) = (node.min.as_dvec3(), node.max.as_dvec3());
                        (child, seen.distance(seen.clamp(min, max)))
                    });
                    let (near, far) = if b.1 < a.1 { (b, a) } else { (a, b) };
                    stack.extend([far, near]);
                }
            }
        }
    }

    /// Calls `found` with each instance whose box may touch the intersection of the half-spaces
    /// `volume`, until `found` returns [`ControlFlow::Break`].
    pub fn touching_until(
        &self,
        volume: &[HalfSpace],
        mut found: impl FnMut(u32) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let touches = |index: u32| {
            let node = &self.tree.nodes[index as usize];
            let (min, max) = (node.min.as_dvec3(), node.max.as_dvec3());
            let (middle, half) = ((min + max) / 2.0 + self.part.center, (max - min) / 2.0);
            let mut planes = volume.iter();
            planes.all(|plane| plane.height(middle) + plane.normal.abs().dot(half) >= 0.0)
        };
        let mut stack = Stack::new();
        stack.push(0);
        while let Some(index) = stack.pop() {
            if !touches(index) {
                continue;
            }
            match self.below(index) {
                Below::Copy(copy) => found(copy)?,
                Below::Nodes(children) => stack.extend(children),
            }
        }
        ControlFlow::Continue(())
    }
}
