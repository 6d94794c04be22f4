//! The lit curve as a one-dimensional light source: nodes along the curve illuminate receivers.
//!
//! The nodes are first vertices of light paths at equal steps of probability along the fan, with
//! one random phase per frame. A receiver sums the unshadowed light of all nodes. It then tests the
//! visibility of a few nodes, which systematic resampling selects in proportion to their light.
//! Without occlusion, the estimate has no noise (many-light method: Walter et al. 2005; resampling:
//! Kitagawa 1996).
//!
//! The sum resolves the kernel between node and receiver only where the spacing of the nodes, as
//! seen from the receiver, is below the width of both lobes. Pixels resolve the kernel only where
//! their extent on the surface is below this width. [`LineSource::weight`] is a smooth partition of
//! unity over pairs of points: the nodes have the weight w, and random paths over the same two
//! points have the weight 1 − w. The sum of both is therefore unbiased.

use super::PoseView;
use super::laser_emitter::{FanImportance, LaserEmitter};
use super::random_walk::PathVertex;
use crate::accel::{Ray, WIDTH};
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3, Sequence};
use crate::surface::lanes::{self, LANES, Lanes, VectorLanes};
use crate::surface::{Lobe, Materials, Surface};
use multiversion::multiversion;
use smallvec::SmallVec;
use std::f64::consts::TAU;
use std::ops::{Mul, Sub};

/// Bins of the node density along the fan.
const BINS: usize = 256;
/// Rays per bin that measure the distance to the nearest surface.
const CLEARANCE_RAYS: u32 = 16;
/// Bins on either side over which the density is averaged.
const SMOOTHING: usize = 4;
/// Roughness α below which nodes are not used. The number of nodes is proportional to 1/α.
const NARROW: f64 = 0.08;
/// Roughness α below which nodes are not used for light with more than two bounces. Random walks from
/// receivers then have few but large contributions, which blocks of pixels repeat. Path tracing
/// samples them from both ends.
const NARROW_LATER: f64 = 0.15;
/// Roughness α above which the lobe does not limit the spacing. It is also used for diffuse lobes.
const WIDE: f64 = 0.5;
/// Number of nodes times the smallest roughness, and limits of the number.
///
/// With a spacing proportional to the distance d from a fold, from a beam radius (0.1 mm) to 40 mm
/// on two walls, n nodes have the spacing 12·d/n. The weight is 1 for a spacing of α·d, hence
/// n = 12/α for one fold. The curve of a slot crosses two folds.
const NODES_BY_ROUGHNESS: f64 = 24.0;
const NODES: [f64; 2] = [64.0, 256.0];
/// Values of α·d/h, with distance d, between which the weight of nodes increases from 0 to 1. The
/// step h is the node spacing or the extent of a pixel at the receiver, whichever is larger.
///
/// The lobe is approximately (1 + (x/2αd)²)⁻² along curve and receivers. The relative error of
/// equal steps h is below (1 + 4παd/h)·exp(−4παd/h) (Poisson summation): 0.013 for 0.5 and 5e-5 for
/// 1.
const RESOLVED: [f64; 2] = [0.5, 1.0];
/// Least cosine for the extent of a pixel on a surface. It limits the extent at grazing views.
const GRAZING: f64 = 0.1;
/// Shadow rays per receiver.
pub(super) const SHADOW_RAYS: usize = 8;

/// Lit curve of a view.
pub(super) struct LineSource<'a> {
    emitter: LaserEmitter<'a>,
    nodes: Vec<LineNode>,
    /// All nodes in their order. Each packet but the last of a material is full.
    packets: Vec<NodePacket<'a>>,
    /// Number of nodes, including those that miss the part.
    count: f64,
    /// Roughness of each material that limits the spacing; 0 for materials without nodes.
    roughness: Vec<f64>,
}

#[derive(Clone)]
struct LineNode {
    /// Position, part frame, mm.
    point: DVec3,
    /// End of shadow rays.
    start: DVec3,
}

/// Nodes of one material, with the values of each node as lanes.
struct NodePacket<'a> {
    surface: &'a Surface,
    roughness: f64,
    /// Positions, part frame, mm.
    point: [[f64; LANES]; 3],
    /// Rows of the rotation from the part frame to the local frame of the surface.
    local_from_part: [VectorLanes; 3],
    /// Local unit vectors towards the laser.
    from: VectorLanes,
    /// Power, mW; 0 for unused lanes.
    power: Lanes,
    /// Spacing of the nodes, mm.
    spacing: Lanes,
}

/// Receiver in the form that packets require.
struct LocalReceiver<'a> {
    surface: &'a Surface,
    roughness: f32,
    /// Extent of a pixel, mm.
    pixel: f32,
    point: DVec3,
    /// Rows of the rotation from the part frame to the local frame of the surface.
    local_from_part: [[f32; 3]; 3],
    /// Local directions in which the light leaves.
    towards: SmallVec<[[f32; 3]; 4]>,
}

/// Point of the part that the camera sees, or a later vertex of a camera path.
pub(super) struct LineReceiver {
    pub vertex: PathVertex,
    /// Directions in which the light leaves; the radiance is their mean.
    pub towards: SmallVec<[DVec3; 4]>,
}

/// Light from the curve at a receiver.
#[derive(Clone, Copy, Default)]
pub(super) struct LineLight {
    /// Radiance towards the camera, mW/mm²/sr.
    pub radiance: f64,
    /// Radiance without occlusion.
    pub unshadowed: f64,
    /// Distance from the laser over the node of each shadow ray to the receiver, mm; infinite if
    /// occluded.
    pub lengths: [f32; SHADOW_RAYS],
}

impl<'a> LineSource<'a> {
    /// Returns the lit curve; `None` if all lobes are too narrow.
    pub fn new(view: &'a PoseView<'a>, key: RngKey) -> Option<LineSource<'a>> {
        let kinds = view.surface.kinds().iter();
        let roughness: Vec<f64> = kinds
            .map(|kind| limiting_roughness(&kind.surface))
            .collect();
        let least = roughness.iter().copied().filter(|&alpha| alpha > 0.0);
        let least = least.fold(f64::INFINITY, f64::min);
        if least == f64::INFINITY {
            return None;
        }
        let count = match view.laser.fan {
            Some(_) => (NODES_BY_ROUGHNESS / least)
                .clamp(NODES[0], NODES[1])
                .round(),
            None => NODES[0],
        };
        let mut line = LineSource {
            emitter: LaserEmitter::new(view),
            nodes: Vec::new(),
            packets: Vec::new(),
            count,
            roughness,
        };
        if view.laser.fan.is_some() {
            line.emitter.starts = line.density();
        }
        line.place_nodes(key);
        Some(line)
    }

    /// Returns whether nodes are used for light with more than two bounces.
    pub fn has_later_bounces(&self) -> bool {
        let mut packets = self.packets.iter();
        packets.any(|packet| packet.roughness >= least_roughness(3))
    }

    /// Returns the number of nodes that hit the part, with unused lanes.
    pub fn nodes(&self) -> usize {
        self.nodes.len()
    }

    /// Returns the node density. Nodes have a spacing proportional to the distance of the nearest
    /// surface that they illuminate.
    fn density(&self) -> FanImportance {
        let view = self.emitter.view;
        let starts: Vec<DVec2> = (0..BINS)
            .map(|bin| DVec2::new((bin as f64 + 0.5) / BINS as f64, 0.5))
            .collect();
        let mut needs = Vec::with_capacity(BINS);
        for starts in starts.chunks(WIDTH) {
            for vertex in self.emitter.first_vertices(starts) {
                needs.push(vertex.map_or(0.0, |vertex| {
                    // The spacing of one node for the whole fan is the length of the curve.
                    let length = self.spacing_of(1.0, &vertex);
                    let seen = self.emitter.laser_from_part.point(vertex.point);
                    let radius = view.laser.radius(seen);
                    length / self.clearance(&vertex).max(radius)
                }));
            }
        }
        let smooth = |bin: usize| {
            let near = bin.saturating_sub(SMOOTHING)..(bin + SMOOTHING + 1).min(BINS);
            let count = near.len() as f64;
            needs[near].iter().sum::<f64>() / count
        };
        FanImportance::new(&(0..BINS).map(smooth).collect::<Vec<_>>())
    }

    /// Returns the distance from a vertex to the nearest surface in some directions, mm, at most
    /// the size of the part.
    fn clearance(&self, vertex: &PathVertex) -> f64 {
        let view = self.emitter.view;
        let bounds = view.accel.bounds();
        let (x, z) = (vertex.normal.any_orthonormal_vector(), vertex.normal);
        let y = z.cross(x);
        // Fixed directions, whose density is proportional to the cosine.
        let sequence = Sequence::new(RngKey::new(0, Purpose::PlanRays));
        let rays: SmallVec<[Ray; WIDTH]> = (0..CLEARANCE_RAYS)
            .map(|i| {
                let u = sequence.pair(i, 0);
                let (sin, cos) = (TAU * u.y).sin_cos();
                let flat = u.x.sqrt();
                Ray {
                    origin: vertex.start(view),
                    direction: (x * cos + y * sin) * flat + z * (1.0 - u.x).sqrt(),
                    t_max: f64::INFINITY,
                }
            })
            .collect();
        let hits = view.accel.closest(&rays, |_, _| true);
        let size = (bounds.max - bounds.min).length();
        hits.iter()
            .flatten()
            .fold(size, |least, hit| least.min(hit.t))
    }

    fn place_nodes(&mut self, key: RngKey) {
        let view = self.emitter.view;
        let count = self.count as usize;
        let start = |i: usize| {
            // Along the fan equal steps, across it multiples of the golden ratio.
            let along = (i as f64 + key.uniform(0)) / self.count;
            let across = (i as f64 * 0.618_033_988_749_895 + key.uniform(1)).fract();
            DVec2::new(along, across.max(f64::EPSILON))
        };
        let starts: Vec<DVec2> = (0..count).map(start).collect();
        let mut vertices = Vec::with_capacity(count);
        for starts in starts.chunks(WIDTH) {
            vertices.extend(self.emitter.first_vertices(starts).into_iter().flatten());
        }
        vertices.retain(|vertex| self.roughness_of(vertex) > 0.0);
        let number = |vertex: &PathVertex| view.surface.number(vertex.triangle);
        // Nodes of one material are consecutive.
        vertices.sort_by_key(number);
        for of_material in vertices.chunk_by(|a, b| number(a) == number(b)) {
            for some in of_material.chunks(LANES) {
                let packet = self.packet(some);
                self.packets.push(packet);
                let mut nodes: Vec<LineNode> = (some.iter())
                    .map(|vertex| LineNode {
                        point: vertex.point,
                        start: vertex.start(view),
                    })
                    .collect();
                let last = nodes.last().expect("a chunk is not empty").clone();
                // Unused lanes have no power.
                nodes.resize(LANES, last);
                self.nodes.extend(nodes);
            }
        }
    }

    /// Returns a packet of nodes of one material.
    fn packet(&self, vertices: &[PathVertex]) -> NodePacket<'a> {
        let surface = self.emitter.view.surface.of(vertices[0].triangle);
        let mut packet = NodePacket {
            surface,
            roughness: self.roughness_of(&vertices[0]),
            point: [[0.0; LANES]; 3],
            local_from_part: [[[0.0; LANES]; 3]; 3],
            from: [[0.0; LANES]; 3],
            power: [0.0; LANES],
            spacing: [1.0; LANES],
        };
        for k in 0..LANES {
            let vertex = &vertices[k.min(vertices.len() - 1)];
            let scatter = surface.scatter(vertex.point, vertex.normal, vertex.from);
            let rows = scatter.local_from_part();
            let from = rows * vertex.from;
            for axis in 0..3 {
                packet.point[axis][k] = vertex.point[axis];
                packet.from[axis][k] = from[axis] as f32;
                for column in 0..3 {
                    packet.local_from_part[axis][column][k] = rows.row(axis)[column] as f32;
                }
            }
            packet.spacing[k] = self.spacing(vertex) as f32;
            if k < vertices.len() {
                packet.power[k] = (vertex.beta / self.count) as f32;
            }
        }
        packet
    }

    fn roughness_of(&self, vertex: &PathVertex) -> f64 {
        self.roughness[self.emitter.view.surface.number(vertex.triangle)]
    }

    /// Returns the spacing of the nodes around the first vertex of a light path.
    fn spacing(&self, vertex: &PathVertex) -> f64 {
        let density = match self.emitter.view.laser.fan {
            None => 1.0,
            Some(_) => {
                let seen = self.emitter.laser_from_part.point(vertex.point);
                let at = self.emitter.view.laser.fan_quantile(seen);
                self.emitter.starts.density(at)
            }
        };
        self.spacing_of(density * self.count, vertex)
    }

    /// Returns the spacing for a number of nodes in the whole fan, mm. The spacing of a point
    /// laser's nodes is its beam radius.
    fn spacing_of(&self, nodes: f64, vertex: &PathVertex) -> f64 {
        let view = self.emitter.view;
        let seen = self.emitter.laser_from_part.point(vertex.point);
        let distance = view.laser.distance(seen);
        let radius = view.laser.radius(seen);
        let Some(fan) = &view.laser.fan else {
            return radius;
        };
        let angle = 1.0 / (nodes * fan.power_per_radian(seen.x.atan2(seen.z)));
        let tangent = vertex.normal.cross(view.part_from_laser.rotation.y_axis);
        let sine = tangent.normalize_or_zero().cross(vertex.from).length();
        // Nodes are also distributed over the width of the beam, with a standard deviation of half
        // its radius.
        (distance * angle / sine.max(0.01)).max(radius / 4.0)
    }

    /// Returns the weight, 0 to 1, of the nodes for paths with a number of bounces. The laser
    /// illuminates the part at `first`, and the light is then reflected at `second`.
    pub fn weight(&self, first: &PathVertex, second: &PathVertex, bounces: usize) -> f64 {
        let roughness = self.roughness_of(first).min(self.roughness_of(second));
        if roughness < least_roughness(bounces) {
            return 0.0;
        }
        let distance = first.point.distance(second.point);
        let [low, high] = RESOLVED;
        let step = self.spacing(first).max(self.pixel_extent(second));
        let x = (roughness * distance / step - low) / (high - low);
        smooth_step(x.clamp(0.0, 1.0))
    }

    /// Returns the largest extent of a pixel on the surface at a vertex, mm.
    fn pixel_extent(&self, vertex: &PathVertex) -> f64 {
        let view = self.emitter.view;
        let way = view.part_from_camera.translation - vertex.point;
        let depth = way.length();
        let cosine = way.dot(vertex.normal).abs() / depth;
        let angle = view.camera.sensor.pixel_pitch / view.camera.lens.image_distance();
        depth * angle / cosine.max(GRAZING)
    }

    /// Returns the light at a receiver, with at most [`SHADOW_RAYS`] shadow rays. `random` is a
    /// uniform number of the receiver, and `bounces` the number of bounces of the complete path.
    pub fn light(
        &self,
        receiver: &LineReceiver,
        bounces: usize,
        random: f64,
        shadow_rays: usize,
    ) -> LineLight {
        let mut light = LineLight::default();
        let at = &receiver.vertex;
        let roughness = self.roughness_of(at);
        let least = least_roughness(bounces);
        if roughness < least {
            return light;
        }
        let surface = self.emitter.view.surface.of(at.triangle);
        let rows = surface
            .scatter(at.point, at.normal, at.normal)
            .local_from_part();
        let narrow = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32];
        let local = LocalReceiver {
            surface,
            roughness: roughness as f32,
            pixel: self.pixel_extent(at) as f32,
            point: at.point,
            local_from_part: [0, 1, 2].map(|axis| narrow(rows.row(axis))),
            towards: receiver
                .towards
                .iter()
                .map(|&eye| narrow(rows * eye))
                .collect(),
        };
        let mut parts: SmallVec<[f32; NODES[1] as usize]> = SmallVec::new();
        let mut some = [0.0; LANES];
        for packet in &self.packets {
            match packet.roughness < least {
                true => some = [0.0; LANES],
                false => radiance(packet, &local, &mut some),
            }
            parts.extend_from_slice(&some);
        }
        light.unshadowed = parts.iter().map(|&part| f64::from(part)).sum();
        self.cast_shadows(at, &parts, (random, shadow_rays), &mut light);
        light
    }

    /// Tests the visibility of nodes selected by systematic resampling.
    fn cast_shadows(
        &self,
        at: &PathVertex,
        parts: &[f32],
        (random, shadow_rays): (f64, usize),
        light: &mut LineLight,
    ) {
        light.lengths = [f32::INFINITY; SHADOW_RAYS];
        let step = light.unshadowed / shadow_rays as f64;
        if step <= 0.0 {
            return;
        }
        let view = self.emitter.view;
        let start = at.start(view);
        let mut rays: SmallVec<[Ray; SHADOW_RAYS]> = SmallVec::new();
        let mut of: SmallVec<[usize; SHADOW_RAYS]> = SmallVec::new();
        let mut before = 0.0;
        for (node, &part) in self.nodes.iter().zip(parts) {
            before += f64::from(part);
            let selected = ((before / step - random).ceil().max(0.0) as usize).min(shadow_rays);
            if selected > of.len() {
                let Some(ray) = Ray::between(start, node.start) else {
                    continue;
                };
                let laser = view.part_from_laser.translation;
                let length = laser.distance(node.point) + node.point.distance(at.point);
                light.lengths[of.len()..selected].fill(length as f32);
                of.resize(selected, rays.len());
                rays.push(ray);
            }
        }
        let blocked = view.accel.occluded(&rays);
        let mut visible = 0;
        for (length, ray) in light.lengths.iter_mut().zip(&of) {
            match blocked >> ray & 1 == 0 {
                true => visible += 1,
                false => *length = f32::INFINITY,
            }
        }
        // Rounding may leave the last selection empty.
        light.radiance = light.unshadowed * f64::from(visible) / of.len().max(1) as f64;
    }
}

/// Returns the least roughness for nodes with a number of bounces.
fn least_roughness(bounces: usize) -> f64 {
    match bounces {
        ..=2 => NARROW,
        _ => NARROW_LATER,
    }
}

/// Returns 3x² − 2x³, which increases smoothly from 0 at x = 0 to 1 at x = 1.
#[inline(always)]
fn smooth_step<T: Copy + From<f32> + Mul<Output = T> + Sub<Output = T>>(x: T) -> T {
    x * x * (T::from(3.0) - T::from(2.0) * x)
}

/// Computes the unshadowed radiance from each node of a packet, mW/mm²/sr.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn radiance(packet: &NodePacket, at: &LocalReceiver, out: &mut Lanes) {
    let mut way: VectorLanes = std::array::from_fn(|axis| {
        packet.point[axis].map(|of_node| (at.point[axis] - of_node) as f32)
    });
    let mut distance: Lanes = [0.0; LANES];
    for k in 0..LANES {
        let far2 = way[0][k] * way[0][k] + way[1][k] * way[1][k] + way[2][k] * way[2][k];
        distance[k] = far2.sqrt();
        let inverse = 1.0 / distance[k];
        for component in &mut way {
            component[k] *= inverse;
        }
    }
    let (mut leaving, mut arriving): (VectorLanes, VectorLanes) =
        ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
    for axis in 0..3 {
        let (of_node, of_receiver) = (&packet.local_from_part[axis], at.local_from_part[axis]);
        for k in 0..LANES {
            leaving[axis][k] =
                of_node[0][k] * way[0][k] + of_node[1][k] * way[1][k] + of_node[2][k] * way[2][k];
            arriving[axis][k] = -(of_receiver[0] * way[0][k]
                + of_receiver[1] * way[1][k]
                + of_receiver[2] * way[2][k]);
        }
    }
    let reflected = lanes::bsdf(packet.surface, &packet.from, &leaving);
    let mut seen = [0.0; LANES];
    for eye in &at.towards {
        let eye = eye.map(|component| [component; LANES]);
        let of_eye = lanes::bsdf(at.surface, &arriving, &eye);
        for k in 0..LANES {
            seen[k] += of_eye[k];
        }
    }
    let roughness = (packet.roughness as f32).min(at.roughness);
    let mean = 1.0 / at.towards.len() as f32;
    let [low, high] = RESOLVED.map(|ratio| ratio as f32);
    for k in 0..LANES {
        let step = packet.spacing[k].max(at.pixel);
        let x = (roughness * distance[k] / step - low) / (high - low);
        let weight = smooth_step(x.clamp(0.0, 1.0));
        let area = leaving[2][k] * arriving[2][k] / (distance[k] * distance[k]);
        let part = packet.power[k] * mean * reflected[k] * seen[k] * area * weight;
        // Also 0 for a node at the receiver.
        out[k] = if part > 0.0 && part < f32::MAX {
            part
        } else {
            0.0
        };
    }
}

/// Returns whether any of the materials can be illuminated by nodes.
pub fn lit_curve_applies(materials: &Materials) -> bool {
    let mut kinds = materials.kinds().iter();
    kinds.any(|kind| limiting_roughness(&kind.surface) > 0.0)
}

/// Returns the roughness of a surface that limits the spacing of nodes; 0 if the surface has mirrors
/// or lobes that are too narrow for nodes.
fn limiting_roughness(surface: &Surface) -> f64 {
    let Some(glossy) = surface.glossy() else {
        return WIDE;
    };
    let mut lobes = glossy.lobes.iter();
    if lobes.any(|(_, lobe)| matches!(lobe, Lobe::Mirror(_))) {
        return 0.0;
    }
    match glossy.min_roughness() {
        alpha if alpha < NARROW => 0.0,
        alpha => alpha.min(WIDE),
    }
}
