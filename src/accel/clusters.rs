//! Query for the triangles that a convex volume may touch: boxes over groups of neighbouring
//! triangles, in a tree of width eight.
//!
//! Embree has no such query. Crates that have one (rstar, parry) need 50 to 100 bytes per triangle;
//! this module needs 11.

use super::TriangleId;
use crate::math::{Aabb, DVec3, Rigid};
use crate::mesh::Mesh;
use rayon::prelude::*;
use std::ops::ControlFlow;

/// Half-space of the points `p` with `normal·p + offset ≥ 0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfSpace {
    /// Unit normal, pointing inward.
    pub normal: DVec3,
    /// Distance of the plane from the origin along `-normal`, mm.
    pub offset: f64,
}

impl HalfSpace {
    /// Creates the half-space bounded by the plane through `point`, on the side to which `inward`
    /// (not zero) points.
    pub fn new(point: DVec3, inward: DVec3) -> HalfSpace {
        let normal = inward.normalize();
        HalfSpace {
            normal,
            offset: -normal.dot(point),
        }
    }

    /// Returns the signed distance from the plane, positive inside, mm.
    pub fn height(&self, p: DVec3) -> f64 {
        self.normal.dot(p) + self.offset
    }

    /// Transforms the half-space into a different frame.
    pub(super) fn seen_from(&self, pose: &Rigid) -> HalfSpace {
        HalfSpace {
            normal: pose.rotation.transpose() * self.normal,
            offset: self.height(pose.translation),
        }
    }

    /// Moves the plane outward by `margin`.
    pub fn widened(self, margin: f64) -> HalfSpace {
        HalfSpace {
            offset: self.offset + margin,
            ..self
        }
    }
}

/// Result of a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ClusterHit {
    /// Triangle. Bit i of `crossed` is unset if the triangle lies completely inside half-space i.
    Triangle {
        /// Triangle that was found.
        face: TriangleId,
        /// One bit per half-space, starting from the lowest.
        crossed: u32,
    },
    /// Several triangles that all lie in this ball.
    Ball {
        /// Center in the frame of the part, mm.
        center: DVec3,
        /// Radius, mm.
        radius: f64,
    },
}

/// Triangles per leaf: eight box tests cost about as much as processing one triangle.
const LEAF: usize = 4;
/// Boxes per node.
const FAN: usize = 8;
/// Largest diagonal, in units of `detail`, of a box reported as a ball within the volume. Such a
/// ball adds no unlit position, but may hide an edge of the part.
const BALL_DIAGONAL_FACTOR: f32 = 4.0;

/// Eight boxes in lanes, which are tested together; relative to the center of the mesh.
#[derive(Clone, Copy)]
struct ClusterNode {
    min: [[f32; FAN]; 3],
    max: [[f32; FAN]; 3],
}

/// Hierarchy of boxes over the triangles of a mesh.
pub struct TriangleClusters {
    /// All triangles along a space-filling curve.
    order: Vec<u32>,
    /// Levels of the tree. Box i of level 0 contains `LEAF` triangles of `order`. Box i of level k
    /// + 1 contains all boxes of node i of level k. The last level is one node.
    levels: Vec<Vec<ClusterNode>>,
    center: DVec3,
    /// Bound of the f32 rounding error of a box face, or of its height over a nearby plane, mm.
    rounding: f64,
}

/// Half-space in f32, relative to the center of the mesh.
struct PlaneF32 {
    normal: [f32; 3],
    offset: f32,
}

struct Query<F> {
    planes: Vec<PlaneF32>,
    rounding: f32,
    /// Diagonal below which a box is reported as one ball.
    detail: f32,
    found: F,
}

impl TriangleClusters {
    /// Creates the clusters of the triangles of one mesh, in the frame of the mesh.
    pub fn new(mesh: &Mesh) -> TriangleClusters {
        let bounds = mesh.bounds();
        let center = bounds.center();
        let order = along_curve(mesh, &bounds);
        let leaf = |i: usize| {
            let triangles = &order[(LEAF * i).min(order.len())..(LEAF * i + LEAF).min(order.len())];
            let corners = triangles.iter().flat_map(|&t| mesh.triangle(t as usize));
            Aabb::of(corners.map(|p| p - center))
        };
        let leaves = order.len().div_ceil(LEAF);
        let mut levels = vec![level(leaves, leaf)];
        while let below = levels.last().expect("there is a first")
            && below.len() > 1
        {
            let next = level(below.len(), |i| below[i].bounds());
            levels.push(next);
        }
        TriangleClusters {
            order,
            levels,
            center,
            // With u = 2⁻²⁵ of the half size: 3u for the coordinates and 3u for the normal. Close
            // to the plane, where the sums are below 6 half sizes, 36u for the six operations.
            rounding: (bounds.size() / 2.0).max_element() * 2f64.powi(-19),
        }
    }

    /// Reports every triangle that may touch the intersection of the half-spaces `volume` (at most
    /// 32), until `found` returns [`ControlFlow::Break`].
    ///
    /// Each triangle is reported at most once, in a fixed order. A group is reported as a ball if
    /// the diagonal of its box is below `detail` (mm), or below [`BALL_DIAGONAL_FACTOR`] times
    /// `detail` if the ball lies within the volume.
    pub fn touching_until(
        &self,
        volume: &[HalfSpace],
        detail: f64,
        found: impl FnMut(ClusterHit) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        assert!(volume.len() <= 32, "{} half-spaces", volume.len());
        let planes = volume.iter().map(|half| PlaneF32 {
            normal: half.normal.as_vec3().to_array(),
            offset: half.height(self.center) as f32,
        });
        let mut query = Query {
            planes: planes.collect(),
            rounding: self.rounding as f32,
            detail: detail as f32,
            found,
        };
        let all = u32::MAX.checked_shr(32 - volume.len() as u32).unwrap_or(0);
        self.visit(self.levels.len() - 1, 0, all, &mut query)
    }

    /// Tests the boxes of a node against the planes in `crossed`, the only planes that the node is
    /// not completely inside of.
    fn visit<F: FnMut(ClusterHit) -> ControlFlow<()>>(
        &self,
        level: usize,
        index: usize,
        crossed: u32,
        q: &mut Query<F>,
    ) -> ControlFlow<()> {
        let node = &self.levels[level][index];
        let below = match level {
            0 => self.order.len().div_ceil(LEAF),
            _ => self.levels[level - 1].len(),
        };
        let boxes = (below - FAN * index).min(FAN);
        let (touched, crossings, depths) = node.test(crossed, &q.planes, q.rounding);
        for lane in (0..boxes).filter(|lane| touched[*lane]) {
            let child = FAN * index + lane;
            let diagonal = node.diagonal(lane);
            let within = depths[lane] >= diagonal / 2.0;
            if diagonal <= q.detail || within && diagonal <= BALL_DIAGONAL_FACTOR * q.detail {
                let (center, radius) = (node.middle(lane), diagonal / 2.0);
                (q.found)(ClusterHit::Ball {
                    center: self.center + center,
                    radius: radius as f64 + self.rounding,
                })?;
            } else if level > 0 {
                self.visit(level - 1, child, crossings[lane], q)?;
            } else {
                let end = (LEAF * child + LEAF).min(self.order.len());
                for &index in &self.order[LEAF * child..end] {
                    (q.found)(ClusterHit::Triangle {
                        face: TriangleId::of_mesh(index),
                        crossed: crossings[lane],
                    })?;
                }
            }
        }
        ControlFlow::Continue(())
    }
}

impl ClusterNode {
    /// Returns, per box, whether it touches the inside of all planes, the planes that it crosses,
    /// and its depth inside, mm.
    fn test(
        &self,
        planes: u32,
        all: &[PlaneF32],
        rounding: f32,
    ) -> ([bool; FAN], [u32; FAN], [f32; FAN]) {
        let mut touched = [true; FAN];
        let mut crossings = [0u32; FAN];
        let mut depths = [f32::INFINITY; FAN];
        let mut left = planes;
        while left != 0 {
            let i = left.trailing_zeros();
            left &= left - 1;
            let plane = &all[i as usize];
            let (mut highest, mut lowest) = ([plane.offset; FAN], [plane.offset; FAN]);
            for axis in 0..3 {
                let n = plane.normal[axis];
                let (mut top, mut bottom) = (&self.max[axis], &self.min[axis]);
                if n < 0.0 {
                    std::mem::swap(&mut top, &mut bottom);
                }
                for lane in 0..FAN {
                    highest[lane] += n * top[lane];
                    lowest[lane] += n * bottom[lane];
                }
            }
            for lane in 0..FAN {
                touched[lane] &= highest[lane] >= -rounding;
                crossings[lane] |= u32::from(lowest[lane] < rounding) << i;
                depths[lane] = depths[lane].min(lowest[lane]);
            }
        }
        (touched, crossings, depths)
    }

    fn corner(of: &[[f32; FAN]; 3], lane: usize) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|axis| of[axis][lane] as f64))
    }

    fn middle(&self, lane: usize) -> DVec3 {
        (ClusterNode::corner(&self.min, lane) + ClusterNode::corner(&self.max, lane)) / 2.0
    }

    fn diagonal(&self, lane: usize) -> f32 {
        (0..3)
            .map(|axis| (self.max[axis][lane] - self.min[axis][lane]).powi(2))
            .sum::<f32>()
            .sqrt()
    }

    /// Returns the box around all boxes; unused boxes are empty and have no effect.
    fn bounds(&self) -> Aabb {
        (0..FAN).fold(Aabb::EMPTY, |all, lane| {
            let (min, max) = (
                ClusterNode::corner(&self.min, lane),
                ClusterNode::corner(&self.max, lane),
            );
            Aabb::new(all.min.min(min), all.max.max(max))
        })
    }
}

/// Creates the nodes over `count` boxes.
fn level(count: usize, bounds: impl Fn(usize) -> Aabb + Sync) -> Vec<ClusterNode> {
    (0..count.div_ceil(FAN))
        .into_par_iter()
        .map(|node| {
            let boxes: [Aabb; FAN] = std::array::from_fn(|lane| match FAN * node + lane {
                i if i < count => bounds(i),
                _ => Aabb::EMPTY,
            });
            let lanes = |of: fn(&Aabb) -> DVec3| {
                std::array::from_fn(|axis| {
                    std::array::from_fn(|lane| of(&boxes[lane])[axis] as f32)
                })
            };
            ClusterNode {
                min: lanes(|b| b.min),
                max: lanes(|b| b.max),
            }
        })
        .collect()
}

/// Returns all triangles, sorted by their centroids along the Morton curve through a grid of 1024³
/// cells. Neighbours on the curve are neighbours in space.
fn along_curve(mesh: &Mesh, bounds: &Aabb) -> Vec<u32> {
    // For a mesh that is flat along an axis, 0·∞ is NaN, which casts to cell 0.
    let cells = DVec3::splat(1024.0) / bounds.size();
    let mut keys: Vec<u64> = (0..mesh.triangles.len())
        .into_par_iter()
        .map(|i| {
            let [a, b, c] = mesh.triangle(i);
            let cell = ((a + b + c) / 3.0 - bounds.min) * cells;
            let [x, y, z] = cell.to_array().map(|c| spread((c as u64).min(1023)));
            (x | y << 1 | z << 2) << 32 | i as u64
        })
        .collect();
    keys.par_sort_unstable();
    keys.into_par_iter().map(|key| key as u32).collect()
}

/// Separates the ten bits of `x` by two zeros each.
fn spread(x: u64) -> u64 {
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use crate::mesh::shapes;

    fn random(key: RngKey, i: u64) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|j| key.with(i).uniform(j as u64) - 0.5))
    }

    fn touching(
        clusters: &TriangleClusters,
        volume: &[HalfSpace],
        detail: f64,
        mut found: impl FnMut(ClusterHit),
    ) {
        let search = clusters.touching_until(volume, detail, |hit| {
            found(hit);
            ControlFlow::Continue(())
        });
        assert!(search.is_continue());
    }

    /// Tests random slabs and wedges through a sphere far from the origin. Every triangle with a
    /// point inside all half-spaces is found once, individually or in a ball. Triangles reported as
    /// inside are inside.
    #[test]
    fn nothing_that_touches_is_missed_and_little_else_is_found() {
        let mut mesh = shapes::sphere(10.0, 0.02).unwrap();
        let middle = DVec3::new(5e3, -2e4, 77.0);
        for p in &mut mesh.positions {
            *p += middle;
        }
        let clusters = TriangleClusters::new(&mesh);
        let key = RngKey::new(3, Purpose::SensorNoise);
        let (mut found, mut near) = (0, 0);
        for i in 0..200 {
            let n = random(key, 3 * i);
            let at = middle + 16.0 * random(key, 3 * i + 1);
            let volume = [
                HalfSpace::new(at, n).widened(0.1),
                HalfSpace::new(at, -n).widened(0.1),
                HalfSpace::new(at, random(key, 3 * i + 2)),
            ];
            for detail in [0.0, 0.7] {
                let mut times = vec![0; mesh.triangles.len()];
                let mut balls = Vec::new();
                touching(&clusters, &volume, detail, |what| match what {
                    ClusterHit::Triangle { face, crossed } => {
                        let index = face.triangle;
                        times[index as usize] += 1;
                        for (j, half) in volume.iter().enumerate() {
                            let inside =
                                mesh.triangle(index as usize).map(|p| half.height(p) >= 0.0);
                            assert!(crossed >> j & 1 == 1 || inside == [true; 3]);
                        }
                    }
                    ClusterHit::Ball { center, radius } => balls.push((center, radius)),
                });
                for (t, &times) in times.iter().enumerate() {
                    let corners = mesh.triangle(t);
                    let centroid = corners.iter().sum::<DVec3>() / 3.0;
                    let touches = corners
                        .iter()
                        .chain([&centroid])
                        .any(|&p| volume.iter().all(|half| half.height(p) >= 0.0));
                    let in_ball = |&(center, radius): &(DVec3, f64)| {
                        corners.iter().all(|p| p.distance(center) <= radius)
                    };
                    assert!(times <= 1);
                    assert!(
                        !touches || times == 1 || balls.iter().any(in_ball),
                        "{i} {t}"
                    );
                    near += usize::from(volume.iter().all(|half| half.height(centroid) >= -2.0));
                }
                found += times.iter().sum::<usize>();
            }
        }
        // Boxes of four triangles of 0.8 mm are 1 to 2 mm wide, and wider at jumps of the curve.
        assert!(found < near, "{found} {near}");
    }

    #[test]
    fn one_triangle_and_a_flat_mesh_are_no_trouble() {
        let mesh = shapes::plane(crate::math::DVec2::new(4.0, 2.0)).unwrap();
        let clusters = TriangleClusters::new(&mesh);
        let mut count = 0;
        touching(&clusters, &[], 0.0, |_| count += 1);
        assert_eq!(count, 2);
        let below = HalfSpace::new(DVec3::new(0.0, 0.0, -0.1), -DVec3::Z);
        touching(&clusters, &[below], 0.0, |_| panic!("nothing is below"));
    }

    #[test]
    fn spread_bits_are_three_apart() {
        for bit in 0..10 {
            assert_eq!(spread(1 << bit), 1 << (3 * bit));
        }
        assert_eq!(spread(1023).count_ones(), 10);
    }
}
