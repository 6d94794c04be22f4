//! Which triangles a convex volume may touch: boxes over groups of neighbouring
//! triangles, in a tree eight wide. Embree has no query for this, and the crates
//! that have one (rstar, parry) keep 50 to 100 bytes a triangle; this keeps 11.

use super::Face;
use crate::math::{Aabb, DVec3, Rigid};
use crate::mesh::Mesh;
use rayon::prelude::*;

/// The points `p` with `normal·p + offset ≥ 0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfSpace {
    /// Unit, inward.
    pub normal: DVec3,
    /// Distance of the plane from the origin along `-normal`, mm.
    pub offset: f64,
}

impl HalfSpace {
    /// The side of the plane through `point` to which `inward` (not zero) shows.
    pub fn new(point: DVec3, inward: DVec3) -> HalfSpace {
        let normal = inward.normalize();
        HalfSpace {
            normal,
            offset: -normal.dot(point),
        }
    }

    /// Distance from the plane, positive inside, mm.
    pub fn height(&self, p: DVec3) -> f64 {
        self.normal.dot(p) + self.offset
    }

    /// The same in another frame.
    pub(super) fn seen_from(&self, pose: &Rigid) -> HalfSpace {
        HalfSpace {
            normal: pose.rotation.transpose() * self.normal,
            offset: self.height(pose.translation),
        }
    }

    /// With the plane moved outward by `margin`.
    pub fn widened(self, margin: f64) -> HalfSpace {
        HalfSpace {
            offset: self.offset + margin,
            ..self
        }
    }
}

/// What a query finds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Found {
    /// A triangle. Bit i of `crossed` is unset if all of it is inside half-space i.
    Triangle {
        /// Which one.
        face: Face,
        /// One bit a half-space, from the lowest.
        crossed: u32,
    },
    /// Several triangles at once: all lie in this ball.
    Ball {
        /// mm, in the part's frame.
        center: DVec3,
        /// mm.
        radius: f64,
    },
}

/// Triangles of a leaf: eight box tests cost about as much as handling one.
const LEAF: usize = 4;
/// Boxes of a node.
const FAN: usize = 8;
/// Largest diagonal of a box whose ball lies within the volume, in units of the detail: it
/// adds no place that is not lit, but may hide that a part ends there.
const WITHIN: f32 = 4.0;

/// Eight boxes side by side, so that they are tested in one go; relative to the
/// middle of the mesh.
#[derive(Clone, Copy)]
struct Node {
    min: [[f32; FAN]; 3],
    max: [[f32; FAN]; 3],
}

/// Boxes over the triangles of a mesh.
pub struct Clusters {
    /// All triangles along a space-filling curve.
    order: Vec<u32>,
    /// Box i of level 0 holds `LEAF` triangles of `order`, box i of level k + 1
    /// all boxes of node i of level k; the last level is one node.
    levels: Vec<Vec<Node>>,
    center: DVec3,
    /// By how much rounding to f32 may have moved a face of a box, or its height
    /// over a plane close to it, mm.
    rounding: f64,
}

/// A half-space as the boxes see it.
struct Plane {
    normal: [f32; 3],
    offset: f32,
}

struct Query<F> {
    planes: Vec<Plane>,
    rounding: f32,
    /// Boxes with a smaller diagonal are reported whole.
    detail: f32,
    found: F,
}

impl Clusters {
    /// Clusters of the triangles of one mesh, in its own frame.
    pub fn new(mesh: &Mesh) -> Clusters {
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
        Clusters {
            order,
            levels,
            center,
            // With u = 2⁻²⁵ of the half size: 3u for the coordinates, 3u for the
            // normal, and close to the plane, where the sums are below 6 half
            // sizes, 36u for the six operations.
            rounding: (bounds.size() / 2.0).max_element() * 2f64.powi(-19),
        }
    }

    /// Reports every triangle that may touch all of `volume` (at most 32
    /// half-spaces), each at most once and in a fixed order. Groups whose box has
    /// a diagonal below `detail` (mm) are reported as a ball around them, and up to
    /// `WITHIN` times that if the ball lies within the volume.
    pub fn touching(&self, volume: &[HalfSpace], detail: f64, found: impl FnMut(Found)) {
        assert!(volume.len() <= 32, "{} half-spaces", volume.len());
        let planes = volume.iter().map(|half| Plane {
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
        self.visit(self.levels.len() - 1, 0, all, &mut query);
    }

    /// Tests the boxes of a node against the planes in `crossed`, the only ones
    /// that the node is not wholly inside of.
    fn visit<F: FnMut(Found)>(&self, level: usize, index: usize, crossed: u32, q: &mut Query<F>) {
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
            if diagonal <= q.detail || within && diagonal <= WITHIN * q.detail {
                let (center, radius) = (node.middle(lane), diagonal / 2.0);
                (q.found)(Found::Ball {
                    center: self.center + center,
                    radius: radius as f64 + self.rounding,
                });
            } else if level > 0 {
                self.visit(level - 1, child, crossings[lane], q);
            } else {
                let end = (LEAF * child + LEAF).min(self.order.len());
                for &index in &self.order[LEAF * child..end] {
                    (q.found)(Found::Triangle {
                        face: Face::of_mesh(index),
                        crossed: crossings[lane],
                    });
                }
            }
        }
    }
}

impl Node {
    /// Which boxes touch the insides of all these planes, which of them each crosses, and
    /// how deep it is inside, mm.
    fn test(
        &self,
        planes: u32,
        all: &[Plane],
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
        (Node::corner(&self.min, lane) + Node::corner(&self.max, lane)) / 2.0
    }

    fn diagonal(&self, lane: usize) -> f32 {
        (0..3)
            .map(|axis| (self.max[axis][lane] - self.min[axis][lane]).powi(2))
            .sum::<f32>()
            .sqrt()
    }

    /// Box around all boxes; those that hold nothing are empty and add nothing.
    fn bounds(&self) -> Aabb {
        (0..FAN).fold(Aabb::EMPTY, |all, lane| {
            let (min, max) = (Node::corner(&self.min, lane), Node::corner(&self.max, lane));
            Aabb::new(all.min.min(min), all.max.max(max))
        })
    }
}

/// The nodes over `count` boxes.
fn level(count: usize, bounds: impl Fn(usize) -> Aabb + Sync) -> Vec<Node> {
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
            Node {
                min: lanes(|b| b.min),
                max: lanes(|b| b.max),
            }
        })
        .collect()
}

/// All triangles, sorted by the place of their centroids along the Morton curve
/// through a grid of 1024³ cells: neighbours on it are neighbours in space.
fn along_curve(mesh: &Mesh, bounds: &Aabb) -> Vec<u32> {
    // A mesh that is flat along an axis: 0·∞ is NaN, which casts to cell 0.
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

/// The ten bits of `x`, two zeros between each and the next.
fn spread(x: u64) -> u64 {
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};
    use crate::mesh::shapes;

    fn random(key: Key, i: u64) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|j| key.with(i).uniform(j as u64) - 0.5))
    }

    /// Random slabs and wedges through a sphere far off the origin: every
    /// triangle that has a point inside all half-spaces is found, once, alone or
    /// in a ball; and what is called inside is.
    #[test]
    fn nothing_that_touches_is_missed_and_little_else_is_found() {
        let mut mesh = shapes::sphere(10.0, 0.02).unwrap();
        let middle = DVec3::new(5e3, -2e4, 77.0);
        for p in &mut mesh.positions {
            *p += middle;
        }
        let clusters = Clusters::new(&mesh);
        let key = Key::new(3, Purpose::SensorNoise);
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
                clusters.touching(&volume, detail, |what| match what {
                    Found::Triangle { face, crossed } => {
                        let index = face.triangle;
                        times[index as usize] += 1;
                        for (j, half) in volume.iter().enumerate() {
                            let inside =
                                mesh.triangle(index as usize).map(|p| half.height(p) >= 0.0);
                            assert!(crossed >> j & 1 == 1 || inside == [true; 3]);
                        }
                    }
                    Found::Ball { center, radius } => balls.push((center, radius)),
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
        // Boxes of four triangles of 0.8 mm are 1 to 2 mm wide, and those where
        // the curve leaps wider.
        assert!(found < near, "{found} {near}");
    }

    #[test]
    fn one_triangle_and_a_flat_mesh_are_no_trouble() {
        let mesh = shapes::plane(crate::math::DVec2::new(4.0, 2.0)).unwrap();
        let clusters = Clusters::new(&mesh);
        let mut count = 0;
        clusters.touching(&[], 0.0, |_| count += 1);
        assert_eq!(count, 2);
        let below = HalfSpace::new(DVec3::new(0.0, 0.0, -0.1), -DVec3::Z);
        clusters.touching(&[below], 0.0, |_| panic!("nothing is below"));
    }

    #[test]
    fn spread_bits_are_three_apart() {
        for bit in 0..10 {
            assert_eq!(spread(1 << bit), 1 << (3 * bit));
        }
        assert_eq!(spread(1023).count_ones(), 10);
    }
}
