//! Copies of one mesh, each at its pose, in a tree over their boxes. A copy is traced
//! in its own frame, so what f32 and f64 are good for there is what they are good for
//! in a part alone, however far the copies lie apart. (Embree's instances are not:
//! they are entered with f32 rays relative to one middle of all.)

use super::clusters::HalfSpace;
use super::lanes::Lanes;
use super::part_box::PartBox;
use super::rust_bvh::tree_over;
use super::{Ray, WIDTH};
use crate::math::{Aabb, DVec3, Rigid};
use multiversion::multiversion;
use obvhs::BvhBuildParams;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use smallvec::SmallVec;
use std::sync::Arc;
use wide::f32x8;

/// Bytes a copy takes while the tree is built, beside its pose: 201 measured.
pub(super) const BUILD: u64 = 220;

pub(super) struct Copies {
    /// part_from_copy.
    poses: Arc<[Rigid]>,
    /// With one copy a leaf.
    tree: Bvh2,
    part: PartBox,
    largest_translation: f64,
}

/// What is below a node of the tree.
enum Below {
    Copy(u32),
    Nodes([u32; 2]),
}

/// Of nodes still to be visited, only a strange tree keeps more.
type Stack<T> = SmallVec<[T; 64]>;

/// Up to 16 rays as boxes see them, relative to the middle of the part.
pub(super) struct Packet {
    origin: [[f32; WIDTH]; 3],
    inverse: [[f32; WIDTH]; 3],
    /// Distances by which origins were advanced, mm.
    advanced: [f64; WIDTH],
    /// How far from there each ray looks, mm; negative: not at all.
    reach: [f32; WIDTH],
    /// By how much a ray looks further than it is told to: rounding must not cut off
    /// a nearer hit.
    slack: f64,
}

impl Packet {
    fn new(rays: &[Ray], part: &PartBox) -> Packet {
        let inside = Lanes::new(rays).inside(part, None);
        let mut packet = Packet {
            origin: inside.origin,
            // Not NaN at a face that the ray runs along.
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

    /// A ray is to look no further than `t` mm from its origin.
    pub fn shorten(&mut self, ray: usize, t: f64) {
        let reach = (t - self.advanced[ray] + self.slack) as f32;
        self.reach[ray] = self.reach[ray].min(reach);
    }

    /// A ray is to look no further at all.
    pub fn end(&mut self, ray: usize) {
        self.reach[ray] = -1.0;
    }

    /// Which rays look as far as this, as bits.
    fn beyond(&self, distance: f32) -> u16 {
        let distance = f32x8::splat(distance);
        let far = |part| eight(&self.reach, part).simd_ge(distance).to_bitmask() as u16;
        far(0) | far(1) << 8
    }
}

/// Of each of two boxes, which rays of the packet meet it, as bits, and the least distance at which one enters it.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn meet_both(packet: &Packet, boxes: [&Bvh2Node; 2]) -> [(u16, f32); 2] {
    let mut both = [(0, 0.0); 2];
    for (node, met) in boxes.into_iter().zip(&mut both) {
        *met = meet(packet, node);
    }
    both
}

/// The same of one box. Distances by loops over all rays, which become the machine's vectors; the bits by
/// `wide`, since such a loop over them does not.
#[inline(always)]
fn meet(packet: &Packet, node: &Bvh2Node) -> (u16, f32) {
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
    // In three steps, not in a chain of eight.
    let [a, b, c, d, e, f, g, h] = least.to_array();
    (
        met,
        less(less(less(a, b), less(c, d)), less(less(e, f), less(g, h))),
    )
}

/// The first or the second eight rays. (Not by `map` or from a slice, which stay calls.)
#[inline(always)]
fn eight(rays: &[f32; WIDTH], part: usize) -> f32x8 {
    let mut lanes = [0.0; WIDTH / 2];
    lanes.copy_from_slice(&rays[8 * part..8 * part + 8]);
    f32x8::new(lanes)
}

impl Copies {
    /// `poses` (at least one) are part_from_copy; `mesh` is the mesh's box.
    pub fn new(poses: Arc<[Rigid]>, mesh: &Aabb) -> Copies {
        let bounds = poses.iter().map(|pose| mesh.moved(pose));
        let part = PartBox::new(bounds.fold(Aabb::EMPTY, |all, one| all.with(&one)));
        let corners = |i: usize| {
            let corners = mesh.corners().map(|corner| poses[i].point(corner));
            corners.map(|corner| (corner - part.center).as_vec3a())
        };
        let parameters = BvhBuildParams {
            max_prims_per_leaf: 1,
            ..BvhBuildParams::medium_build()
        };
        let tree = tree_over(poses.len(), corners, &part, parameters);
        let translations = poses
            .iter()
            .map(|pose| pose.translation.abs().max_element());
        Copies {
            largest_translation: translations.fold(0.0, f64::max),
            poses,
            tree,
            part,
        }
    }

    /// Of the poses, along an axis, mm.
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

    /// Calls `met` with each copy whose box some of up to 16 rays meet and which they
    /// are, as bits: near ones first, as far as boxes tell. What `met` says of rays
    /// that need look less far holds for the copies that follow.
    pub fn along(&self, rays: &[Ray], mut met: impl FnMut(u32, u16, &mut Packet)) {
        let mut packet = Packet::new(rays, &self.part);
        let mut stack = Stack::new();
        stack.push((0, u16::MAX, 0.0));
        while let Some((index, rays, least)) = stack.pop() {
            let rays = rays & packet.beyond(least);
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

    /// Calls `look` with each copy whose box is at most as far from `p` as what it
    /// last returned, `within` at first, mm: near ones first.
    pub fn around(&self, p: DVec3, mut within: f64, mut look: impl FnMut(u32) -> f64) {
        let seen = p - self.part.center;
        let mut stack = Stack::new();
        stack.push((0, 0.0));
        while let Some((index, least)) = stack.pop() {
            // A padded box is nearer than what it holds by far more than f64 rounds.
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

    /// Calls `found` with each copy whose box may touch all of `volume`.
    pub fn touching(&self, volume: &[HalfSpace], mut found: impl FnMut(u32)) {
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
                Below::Copy(copy) => found(copy),
                Below::Nodes(children) => stack.extend(children),
            }
        }
    }
}
