//! All triangles that one ray crosses, each surface once.
//!
//! The corners are projected along the ray onto a plane and rounded there, once for all triangles
//! that share them. The signs of the edge functions of the rounded corners are exact. If the ray
//! passes exactly through an edge or a vertex, it is displaced by the infinitesimal offset (ε, ε²)
//! in that plane (Edelsbrunner & Mücke 1990, "Simulation of simplicity"). A displaced ray passes
//! through no edge and no vertex, therefore it crosses exactly one of the triangles of a surface
//! that continues there. On a closed mesh the number of crossings is always even for an infinite
//! line, and entering crossings balance leaving ones.
//!
//! The decision uses no tolerance. A triangle parallel to the ray is never crossed.

use super::Ray;
use super::watertight::Sheared;
use crate::math::DVec3;
use smallvec::SmallVec;
use std::collections::{HashMap, HashSet};

/// Crossing of a ray with one triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crossing {
    /// Distance along the ray, mm, from 0 to the end of the ray.
    pub t: f64,
    pub triangle: u32,
    /// True if the ray hits the side from which the corners appear counter-clockwise.
    pub entering: bool,
    /// Change of the distance with the offset of the ray, which orders crossings of one edge or
    /// vertex. It is zero for a crossing of the interior of a triangle.
    slope: [f64; 2],
}

impl Crossing {
    /// Orders crossings along the ray. Crossings at one edge or vertex have equal distances and are
    /// in the order of the displaced ray.
    pub fn order(&self, other: &Crossing) -> std::cmp::Ordering {
        let slope = |i: usize| self.slope[i].total_cmp(&other.slope[i]);
        let distance = self.t.total_cmp(&other.t);
        distance
            .then(slope(0))
            .then(slope(1))
            .then(self.triangle.cmp(&other.triangle))
    }
}

/// Triangle with an edge or a vertex exactly on the ray, or one that is seen edge-on.
struct Contact {
    corners: [DVec3; 3],
    /// Corners of the edge or the vertex on the ray, as indices; all three if seen edge-on.
    on: SmallVec<[usize; 3]>,
    /// Crossing, if the ray is displaced into the triangle. The distance is also set otherwise.
    crossing: Crossing,
    crossed: bool,
}

impl Contact {
    fn is_edge_on(&self) -> bool {
        self.on.len() == 3
    }

    /// Returns the positions of the corners, each once.
    fn distinct_corners(&self) -> SmallVec<[[u64; 3]; 3]> {
        let mut corners: SmallVec<[[u64; 3]; 3]> = self.corners.map(bits).into();
        corners.sort_unstable();
        corners.dedup();
        corners
    }
}

/// Collects the crossings of one ray.
pub(super) struct Crossings {
    sheared: Sheared,
    t_max: f64,
    found: Vec<Crossing>,
    contacts: Vec<Contact>,
}

impl Crossings {
    /// Prepares the collection for a ray with a direction of length 1.
    pub fn new(ray: &Ray) -> Crossings {
        Crossings {
            sheared: Sheared::new(ray),
            t_max: ray.t_max,
            found: Vec::new(),
            contacts: Vec::new(),
        }
    }

    /// Adds a triangle if the ray crosses it.
    pub fn add(&mut self, triangle: u32, corners: [DVec3; 3]) {
        let projected = corners.map(|p| flushed(self.sheared.apply(p)));
        let [a, b, c] = projected;
        let sides = [(b, c), (c, a), (a, b)];
        let signs = sides.map(|(from, to)| orientation(from, to));
        if signs.contains(&1) && signs.contains(&-1) {
            return;
        }
        let sum: i32 = signs.iter().sum();
        let crossing = |t: f64, slope| Crossing {
            t,
            triangle,
            entering: (sum > 0) == self.sheared.is_reversed(),
            slope,
        };
        if signs.iter().all(|&sign| sign != 0) {
            let t = interior_depth(projected);
            if t >= 0.0 && t <= self.t_max {
                self.found.push(crossing(t, [0.0; 2]));
            }
            return;
        }
        // The edge or vertex on the ray ends at the corners whose opposite edges are not on it.
        let on: SmallVec<[usize; 3]> = match sum {
            0 => (0..3).collect(),
            _ => (0..3).filter(|&k| signs[k] != 0).collect(),
        };
        if sum == 0 {
            let crossing = crossing(0.0, [0.0; 2]);
            self.contacts.push(Contact {
                corners,
                on,
                crossing,
                crossed: false,
            });
            return;
        }
        let t = match on[..] {
            [corner] => projected[corner].z,
            [from, to] => edge_depth(projected[from], projected[to]),
            _ => return,
        };
        if !(t >= 0.0 && t <= self.t_max) {
            return;
        }
        let displaced = std::array::from_fn::<_, 3, _>(|k| match signs[k] {
            0 => displaced_orientation(sides[k].0, sides[k].1),
            sign => sign,
        });
        let crossing = crossing(t, slope(projected));
        let crossed = displaced == [sum.signum(); 3];
        if crossed {
            self.found.push(crossing);
        }
        self.contacts.push(Contact {
            corners,
            on,
            crossing,
            crossed,
        });
    }

    /// Returns the crossings in the order of [`Crossing::order`].
    pub fn finish(mut self) -> Vec<Crossing> {
        self.add_borders();
        self.found.sort_unstable_by(Crossing::order);
        self.found
    }

    /// Adds the borders of open surfaces that are exactly on the ray, although the displaced ray
    /// passes them: a border is a part of the surface.
    ///
    /// At the outline of a closed surface nothing is added, because the ray then crosses it twice
    /// or not at all.
    fn add_borders(&mut self) {
        let missed = |contact: &Contact| !contact.crossed && !contact.is_edge_on();
        if !self.contacts.iter().any(missed) {
            return;
        }
        let mut at_corner: HashMap<[u64; 3], Vec<&Contact>> = HashMap::new();
        for contact in &self.contacts {
            for corner in contact.distinct_corners() {
                at_corner.entry(corner).or_default().push(contact);
            }
        }
        let mut done = HashSet::new();
        for contact in self.contacts.iter().filter(|contact| missed(contact)) {
            let on = contact.on.iter().map(|&k| bits(contact.corners[k]));
            let mut on: SmallVec<[[u64; 3]; 2]> = on.collect();
            on.sort_unstable();
            if !done.insert(on.clone()) {
                continue;
            }
            // All triangles with this edge or vertex are among the contacts.
            let around: SmallVec<[&Contact; 8]> = (at_corner[&on[0]].iter().copied())
                .filter(|other| {
                    on[1..]
                        .iter()
                        .all(|end| other.distinct_corners().contains(end))
                })
                .collect();
            let is_border = match on[..] {
                [corner] => {
                    let corners = around.iter().flat_map(|other| other.distinct_corners());
                    let mut ends: Vec<[u64; 3]> = corners.filter(|&end| end != corner).collect();
                    ends.sort_unstable();
                    ends.chunk_by(|a, b| a == b).any(|edge| edge.len() == 1)
                }
                _ => around.len() == 1,
            };
            if is_border && !around.iter().any(|other| other.crossed) {
                let whole = around.iter().filter(|other| !other.is_edge_on());
                let first = whole.min_by_key(|other| other.crossing.triangle);
                self.found.extend(first.map(|first| first.crossing));
            }
        }
    }
}

/// Returns the bit pattern of a position, with −0 converted to +0.
fn bits(position: DVec3) -> [u64; 3] {
    position.to_array().map(|c| (c + 0.0).to_bits())
}

/// Sets offsets that are too small for exact products to zero. The result depends on the point
/// only, therefore neighbours remain joined.
fn flushed(p: DVec3) -> DVec3 {
    // Products of larger offsets, and their rounding errors, are normal numbers.
    const SMALLEST_OFFSET: f64 = f64::from_bits((1023 - 450) << 52); // 2⁻⁴⁵⁰
    let flush = |x: f64| if x.abs() < SMALLEST_OFFSET { 0.0 } else { x };
    DVec3::new(flush(p.x), flush(p.y), p.z)
}

/// Returns the sign of the cross product of two projected points: positive if the ray is to the
/// left of the edge between them. The sign is exact.
fn orientation(from: DVec3, to: DVec3) -> i32 {
    let (left, right) = (from.x * to.y, from.y * to.x);
    // Rounding preserves the order, but may make different products equal.
    let difference = match left == right {
        true => from.x.mul_add(to.y, -left) - from.y.mul_add(to.x, -right),
        false => left - right,
    };
    sign(difference)
}

/// Returns the sign of the edge function of an edge through the ray, for the displaced ray; zero if
/// both ends coincide.
fn displaced_orientation(from: DVec3, to: DVec3) -> i32 {
    // (from − δ) × (to − δ) = δ × (from − to) with δ = (ε, ε²).
    match sign(from.y - to.y) {
        0 => sign(to.x - from.x),
        sign => sign,
    }
}

fn sign(x: f64) -> i32 {
    i32::from(x > 0.0) - i32::from(x < 0.0)
}

/// Returns the distance along the ray to a triangle that contains the ray in its interior.
fn interior_depth([a, b, c]: [DVec3; 3]) -> f64 {
    let cross = |p: DVec3, q: DVec3| p.x * q.y - p.y * q.x;
    let (u, v, w) = (cross(b, c), cross(c, a), cross(a, b));
    let t = (u * a.z + v * b.z + w * c.z) / (u + v + w);
    let (low, high) = (a.z.min(b.z).min(c.z), a.z.max(b.z).max(c.z));
    if t.is_finite() {
        return t.clamp(low, high);
    }
    // A triangle so narrow that all rounded edge functions are zero.
    let sides = [(a, b), (b, c), (c, a)];
    let extent = |(p, q): &(DVec3, DVec3)| (p.x - q.x).abs().max((p.y - q.y).abs());
    let longest = sides
        .into_iter()
        .max_by(|p, q| extent(p).total_cmp(&extent(q)));
    longest.map_or(low, |(p, q)| edge_depth(p, q))
}

/// Returns the distance along the ray to an edge through the ray. It does not depend on the order
/// of the ends, therefore both triangles of the edge have the same distance.
fn edge_depth(p: DVec3, q: DVec3) -> f64 {
    let coordinates = |p: DVec3| [p.x, p.y, p.z];
    let ordered = coordinates(p) <= coordinates(q);
    let (p, q) = if ordered { (p, q) } else { (q, p) };
    let step = q - p;
    let along = match step.x.abs() > step.y.abs() {
        true => -p.x / step.x,
        false => -p.y / step.y,
    };
    // NaN, if both ends coincide, becomes 0.
    let along = if along > 0.0 { along.min(1.0) } else { 0.0 };
    (p.z + along * step.z).clamp(p.z.min(q.z), p.z.max(q.z))
}

/// Returns the change of the distance of a triangle with the offset of the ray along x and y.
fn slope([a, b, c]: [DVec3; 3]) -> [f64; 2] {
    let normal = (b - a).cross(c - a);
    [normal.x, normal.y].map(|n| -n / normal.z)
}

#[cfg(test)]
#[path = "crossings_tests.rs"]
mod tests;
