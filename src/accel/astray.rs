//! Rays that f32 leaves in doubt, settled in f64.
//!
//! Next to an edge Embree may take the triangle on its other side, or one that the ray
//! passes. A ray that in f64 passes the triangle it was said to meet is therefore held
//! against all triangles there, by a test in f64 that lets none slip between neighbours;
//! if it meets none of them, it goes on behind them.
//!
//! Of rays that meet a vertex to the last digit of f32, Embree, even robust, loses one
//! in some hundreds or thousands. In a closed mesh such a ray is then inside the material
//! and meets the back of a triangle; of each that meets a back it is asked again what
//! stands beside it. So a mesh that is wound inward or open costs more where its backs
//! are seen. What an open mesh loses altogether is not found: asking again for every ray
//! that meets nothing would double their cost.
//!
//! Of a ray that starts inside the material the same is true with the sides exchanged: it is
//! asked again if it meets a front, or nothing. Rays that start outside the mesh's box do not
//! start inside; of others ([`super::Accel::closest_hits`]; those of the simulator start
//! outside the part) one more ray from their origin tells.

use super::embree::Tree;
use super::lanes::Lanes;
use super::part_box::{PartBox, Side};
use super::refine::{Refined, across, refine};
use super::watertight::Sheared;
use super::{Hit, Ray, WIDTH};
use smallvec::SmallVec;

/// Rays that stand in for one, at 120° around it: at a vertex at least one of them
/// meets a triangle away from its corners and edges.
const AROUND: usize = 3;

/// Places at which a ray may pass triangles it was said to meet. (One is not enough only
/// where it runs along many edges in turn.)
const PASSED: usize = 16;

/// A hit that f32 reports.
#[derive(Clone, Copy)]
pub(super) struct Doubt {
    /// Number in its packet.
    pub ray: usize,
    pub triangle: u32,
    /// Distance, mm, in f64 where the triangle tells it.
    pub t: f64,
}

impl Doubt {
    /// That of a ray which meets nothing and should.
    pub fn of_nothing(number: usize, ray: &Ray) -> Doubt {
        Doubt {
            ray: number,
            triangle: u32::MAX,
            t: ray.t_max,
        }
    }
}

/// The rays of a packet in doubt.
#[derive(Default)]
pub(super) struct Doubts {
    /// Those that in f64 pass the triangle.
    pub passed: SmallVec<[Doubt; WIDTH]>,
    /// Those that meet the side of it which cannot be the first they meet.
    pub astray: SmallVec<[Doubt; WIDTH]>,
}

impl Doubts {
    pub fn is_empty(&self) -> bool {
        self.passed.is_empty() && self.astray.is_empty()
    }

    /// Calls `found` with what each ray in doubt meets, if anything: last of a ray with
    /// what holds. `inside`, as bits: those that start inside the mesh.
    #[cold]
    pub fn settle(
        &mut self,
        tree: &Tree,
        part: &PartBox,
        rays: &[Ray],
        inside: u16,
        mut found: impl FnMut(usize, Option<Hit>),
    ) {
        for doubt in self.passed.drain(..) {
            let ray = doubt.ray;
            self.astray.retain(|other| other.ray != ray);
            let hit = beyond(tree, part, &rays[ray], doubt.triangle, doubt.t);
            found(ray, hit);
            let inside = inside >> ray & 1 == 1;
            match hit {
                None if inside => self.astray.push(Doubt::of_nothing(ray, &rays[ray])),
                Some(hit) if is_back(tree, &rays[ray], hit.face.triangle) != inside => {
                    let (triangle, t) = (hit.face.triangle, hit.t);
                    self.astray.push(Doubt { ray, triangle, t });
                }
                _ => {}
            }
        }
        seek(tree, part, rays, inside, &self.astray, |ray, hit| {
            found(ray, Some(hit))
        });
    }
}

fn is_back(tree: &Tree, ray: &Ray, triangle: u32) -> bool {
    across(tree.mesh().triangle(triangle as usize)).dot(ray.direction) > 0.0
}

/// What a ray meets in f64 that seems to meet `triangle` at `t`: there, or else behind.
fn beyond(tree: &Tree, part: &PartBox, ray: &Ray, mut triangle: u32, mut t: f64) -> Option<Hit> {
    for _ in 0..PASSED {
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
            &Lanes::new(&[onward]),
            1,
            part,
            |_, triangle, further, _| {
                next = Some((triangle, passed + further));
            },
        );
        (triangle, t) = next?;
        let corners = tree.mesh().triangle(triangle as usize);
        match refine(ray, triangle, corners, t, part.tolerance()) {
            Refined::On(hit) => return Some(hit),
            Refined::Beside(hit) => t = hit.t,
            Refined::Off => {}
        }
    }
    None
}

/// The nearest of the triangles within [`PartBox::overshoot`] of a ray at `t` that the
/// ray meets in f64, as far as that or at `triangle`. At the same distance the first.
fn near(tree: &Tree, part: &PartBox, ray: &Ray, triangle: u32, t: f64) -> Option<Hit> {
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

/// Calls `found` with what a ray has lost before what it seems to meet, if there is
/// something: a front, or of one that starts inside a back.
/// A ray beside one counts for it only where the one itself meets the same plane
/// within [`PartBox::resolution`] of the triangle. Of such triangles one that the ray meets
/// in f64 is taken; if there is none, of fronts, a gap in the mesh that f32 does not see, the
/// first.
fn seek(
    tree: &Tree,
    part: &PartBox,
    rays: &[Ray],
    inside: u16,
    astray: &[Doubt],
    mut found: impl FnMut(usize, Hit),
) {
    let aside = part.resolution() / 2.0;
    let first = |a: &Hit, b: &Hit| a.t.total_cmp(&b.t).then(a.face.cmp(&b.face));
    for astray in astray.chunks(WIDTH / AROUND) {
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
        let is_inside = |doubt: &Doubt| inside >> doubt.ray & 1 == 1;
        let mut lost = [None; WIDTH];
        // Lanes beyond the last ray are not traced.
        let traced = (u16::MAX as u32 >> (WIDTH - count)) as u16;
        tree.closest(
            &Lanes::new(&beside[..count]),
            traced,
            part,
            |k, triangle, t, side| {
                let doubt = &astray[k / AROUND];
                // At a sharp edge f32 may take the back for the nearer.
                if (side == Side::Back) == is_inside(doubt) && t < doubt.t + part.resolution() {
                    let corners = tree.mesh().triangle(triangle as usize);
                    let tolerance = part.final_tolerance();
                    lost[k] = refine(&rays[doubt.ray], triangle, corners, t, tolerance).hit();
                }
            },
        );
        for (doubt, lost) in astray.iter().zip(lost.chunks(AROUND)) {
            let ray = &rays[doubt.ray];
            let lost = || lost.iter().flatten();
            let exact = lost()
                .filter_map(|lost| near(tree, part, ray, lost.face.triangle, lost.t))
                .filter(|hit| is_back(tree, ray, hit.face.triangle) == is_inside(doubt))
                .min_by(first);
            // Whether a ray starts inside may be wrong on the surface itself.
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
#[path = "astray_tests.rs"]
mod tests;
