//! Resolution in f64 of rays whose f32 result is ambiguous.
//!
//! Next to an edge, Embree may return the triangle on the other side of the edge, or a triangle
//! that the ray misses. If the ray misses the reported triangle in f64, all triangles nearby are
//! tested in f64 with a watertight test. If it misses all of them, tracing continues behind them.
//!
//! If rays hit a vertex to the last digit of f32, Embree, even in robust mode, loses one in some
//! hundreds or thousands. In a closed mesh such a ray continues inside the material and hits the
//! back of a triangle. Each ray that hits a back is therefore traced again with adjacent rays. A
//! mesh that is wound inward or open costs more where its backs are visible. Rays lost completely
//! on an open mesh are not recovered, since retracing every miss would double its cost.
//!
//! For a ray that starts inside the material, the sides are exchanged: it is traced again if it
//! hits a front, or nothing. Rays that start outside the box of the mesh do not start inside. For
//! other rays ([`super::Accel::closest_hits`]), an additional ray from the origin decides. Rays of
//! the simulator start outside the part.

use super::embree::EmbreeScene;
use super::packet_soa::RayPacketSoA;
use super::part_bounds::{Facing, PartBounds};
use super::refine::{RefinedHit, across, refine};
use super::watertight::Sheared;
use super::{Hit, Ray, WIDTH};
use smallvec::SmallVec;

/// Number of substitute rays per ray, at 120° around it. At a vertex, at least one of them hits a
/// triangle away from its corners and edges.
const PROBE_RAYS: usize = 3;

/// Largest number of positions at which a ray may miss the reported triangles. More than one is
/// needed only for a ray along several successive edges.
const MAX_NEAR_MISSES: usize = 16;

/// Ambiguous hit reported in f32.
#[derive(Clone, Copy)]
pub(super) struct AmbiguousHit {
    /// Index of the ray in its packet.
    pub ray: usize,
    pub triangle: u32,
    /// Distance, mm, in f64 if the plane of the triangle determines it.
    pub t: f64,
}

impl AmbiguousHit {
    /// Creates the record of a ray that should hit the part but hits nothing.
    pub fn of_nothing(number: usize, ray: &Ray) -> AmbiguousHit {
        AmbiguousHit {
            ray: number,
            triangle: u32::MAX,
            t: ray.t_max,
        }
    }
}

/// Ambiguous rays of a packet.
#[derive(Default)]
pub(super) struct AmbiguousHits {
    /// Rays that miss the reported triangle in f64.
    pub missed_in_f64: SmallVec<[AmbiguousHit; WIDTH]>,
    /// Rays that hit the side of the triangle that cannot be their first hit.
    pub ambiguous_backfaces: SmallVec<[AmbiguousHit; WIDTH]>,
}

impl AmbiguousHits {
    pub fn is_empty(&self) -> bool {
        self.missed_in_f64.is_empty() && self.ambiguous_backfaces.is_empty()
    }

    /// Calls `found` with the hit of each ambiguous ray, if any; the last call for a ray is final.
    /// The bits of `inside` select rays that start inside the mesh.
    #[cold]
    pub fn refine_hits(
        &mut self,
        tree: &EmbreeScene,
        part: &PartBounds,
        rays: &[Ray],
        inside: u16,
        mut found: impl FnMut(usize, Option<Hit>),
    ) {
        for doubt in self.missed_in_f64.drain(..) {
            let ray = doubt.ray;
            self.ambiguous_backfaces.retain(|other| other.ray != ray);
            let hit = next_hit_f64(tree, part, &rays[ray], doubt.triangle, doubt.t);
            found(ray, hit);
            let inside = inside >> ray & 1 == 1;
            match hit {
                None if inside => self
                    .ambiguous_backfaces
                    .push(AmbiguousHit::of_nothing(ray, &rays[ray])),
                Some(hit) if is_back(tree, &rays[ray], hit.face.triangle) != inside => {
                    let (triangle, t) = (hit.face.triangle, hit.t);
                    self.ambiguous_backfaces
                        .push(AmbiguousHit { ray, triangle, t });
                }
                _ => {}
            }
        }
        probe_lost_hit(
            tree,
            part,
            rays,
            inside,
            &self.ambiguous_backfaces,
            |ray, hit| found(ray, Some(hit)),
        );
    }
}

fn is_back(tree: &EmbreeScene, ray: &Ray, triangle: u32) -> bool {
    across(tree.mesh().triangle(triangle as usize)).dot(ray.direction) > 0.0
}

/// Returns the f64 hit of a ray that apparently hits `triangle` at `t`: there, or behind it.
fn next_hit_f64(
    tree: &EmbreeScene,
    part: &PartBounds,
    ray: &Ray,
    mut triangle: u32,
    mut t: f64,
) -> Option<Hit> {
    for _ in 0..MAX_NEAR_MISSES {
        let met = near(tree, part, ray, triangle, t);
        if met.is_some() {
            return met;
        }
        let passed = t + part.overshoot();
        let onward = Ray {
            origin: ray.origin + ray.direction * passed,
            t_max: ray.t_max - passed,
            ..*ray
        };
        let mut next = None;
        tree.closest(
            &RayPacketSoA::new(&[onward]),
            1,
            part,
            |_, triangle, further, _| {
                next = Some((triangle, passed + further));
            },
        );
        (triangle, t) = next?;
        let corners = tree.mesh().triangle(triangle as usize);
        match refine(ray, triangle, corners, t, part.tolerance()) {
            RefinedHit::Inside(hit) => return Some(hit),
            RefinedHit::Near(hit) => t = hit.t,
            RefinedHit::Miss => {}
        }
    }
    None
}

/// Returns the nearest f64 hit among the triangles within [`PartBounds::overshoot`] of the ray at
/// `t`.
///
/// Hits up to this distance behind `t`, or on `triangle`, are accepted. On equal distances the
/// first triangle is returned.
fn near(tree: &EmbreeScene, part: &PartBounds, ray: &Ray, triangle: u32, t: f64) -> Option<Hit> {
    let sheared = Sheared::new(ray);
    let reach = t + part.overshoot();
    let mut best = None;
    let mut least = (f64::INFINITY, u32::MAX);
    let place = ray.origin + ray.direction * t;
    tree.around(place, part, part.overshoot(), |other| {
        let corners = tree.mesh().triangle(other as usize);
        if let Some(t) = sheared.distance(corners)
            && (t <= reach || other == triangle)
            && (t, other) < least
            && let Some(hit) = refine(ray, other, corners, t, part.final_tolerance()).hit()
        {
            (best, least) = (Some(hit), (t, other));
        }
        None
    });
    best
}

/// Calls `found` with a lost hit before the apparent hit of a ray, if there is one: a front, or a
/// back for a ray that starts inside.
///
/// The hit of a substitute ray counts only if the original ray hits the same plane within
/// [`PartBounds::resolution`] of the triangle. Triangles that the ray hits in f64 take precedence.
/// If none exists, the mesh has a gap that f32 does not resolve, and the first front is used.
fn probe_lost_hit(
    tree: &EmbreeScene,
    part: &PartBounds,
    rays: &[Ray],
    inside: u16,
    ambiguous_backfaces: &[AmbiguousHit],
    mut found: impl FnMut(usize, Hit),
) {
    let aside = part.resolution() / 2.0;
    let first = |a: &Hit, b: &Hit| a.t.total_cmp(&b.t).then(a.face.cmp(&b.face));
    for astray in ambiguous_backfaces.chunks(WIDTH / PROBE_RAYS) {
        let mut beside = [rays[0]; WIDTH];
        let mut count = 0;
        for doubt in astray {
            let ray = rays[doubt.ray];
            let (x, y) = ray.direction.any_orthonormal_pair();
            for (u, v) in [(1.0, 0.2), (-0.673, 0.766), (-0.327, -0.966)] {
                beside[count] = ray;
                beside[count].origin += (x * u + y * v) * aside;
                count += 1;
            }
        }
        let is_inside = |doubt: &AmbiguousHit| inside >> doubt.ray & 1 == 1;
        let mut lost = [None; WIDTH];
        // Lanes beyond the last ray are not traced.
        let traced = (u16::MAX as u32 >> (WIDTH - count)) as u16;
        tree.closest(
            &RayPacketSoA::new(&beside[..count]),
            traced,
            part,
            |k, triangle, t, side| {
                let doubt = &astray[k / PROBE_RAYS];
                // At a sharp edge, f32 may consider the back nearer.
                if (side == Facing::Back) == is_inside(doubt) && t < doubt.t + part.resolution() {
                    let corners = tree.mesh().triangle(triangle as usize);
                    let tolerance = part.final_tolerance();
                    lost[k] = refine(&rays[doubt.ray], triangle, corners, t, tolerance).hit();
                }
            },
        );
        for (doubt, lost) in astray.iter().zip(lost.chunks(PROBE_RAYS)) {
            let ray = &rays[doubt.ray];
            let lost = || lost.iter().flatten();
            let exact = lost()
                .filter_map(|lost| near(tree, part, ray, lost.face.triangle, lost.t))
                .filter(|hit| is_back(tree, ray, hit.face.triangle) == is_inside(doubt))
                .min_by(first);
            // The classification as inside may be wrong for origins on the surface.
            let before = || {
                let fronts = lost().filter(|_| !is_inside(doubt));
                fronts.filter(|front| front.t < doubt.t).copied()
            };
            if let Some(hit) = exact.or_else(|| before().min_by(first)) {
                found(doubt.ray, hit);
            }
        }
    }
}

#[cfg(test)]
#[path = "edge_repair_tests.rs"]
mod tests;
