//! Rays that slip between triangles. Of those that meet a vertex to the last digit of
//! f32, Embree, even robust, loses one in some hundreds or thousands. In a closed mesh
//! such a ray is then inside the material and meets the back of a triangle; of each that
//! meets a back it is asked again what stands beside it. So a mesh that is wound inward
//! or open costs more where its backs are seen. What an open mesh loses altogether is
//! not found: asking again for every ray that meets nothing would double their cost.

use super::embree::Tree;
use super::hierarchy::{PartBox, Side};
use super::refine::{Tolerance, refine};
use super::{Hit, Ray, WIDTH};

/// Rays that stand in for one, at 120° around it: at a vertex at least one of them
/// meets a triangle away from its corners and edges.
const AROUND: usize = 3;

/// The rays of a packet that met the back of a triangle.
#[derive(Default)]
pub(super) struct Backs {
    /// As bits.
    rays: u16,
    /// Distance to it, mm.
    t: [f64; WIDTH],
}

impl Backs {
    pub fn add(&mut self, ray: usize, t: f64) {
        self.rays |= 1 << ray;
        self.t[ray] = t;
    }
}

/// Calls `found` with the front, if there is one, that a ray has lost before it met a back.
/// A ray beside one counts for it only where the one itself meets the same plane
/// within [`PartBox::resolution`] of the triangle.
pub(super) fn seek(
    tree: &Tree,
    part: &PartBox,
    rays: &[Ray],
    backs: &Backs,
    mut found: impl FnMut(usize, Hit),
) {
    let aside = part.resolution() / 2.0;
    let mut doubtful = (0..rays.len())
        .filter(|i| backs.rays >> i & 1 == 1)
        .peekable();
    while doubtful.peek().is_some() {
        let mut beside = [rays[0]; WIDTH];
        let mut of = [0; WIDTH];
        let mut count = 0;
        for i in doubtful.by_ref().take(WIDTH / AROUND) {
            let (x, y) = rays[i].direction.any_orthonormal_pair();
            for (u, v) in [(1.0, 0.2), (-0.673, 0.766), (-0.327, -0.966)] {
                beside[count] = rays[i];
                beside[count].origin += (x * u + y * v) * aside;
                of[count] = i;
                count += 1;
            }
        }
        let mut best: [Option<Hit>; WIDTH] = [None; WIDTH];
        tree.closest(&beside[..count], part, |k, triangle, t, side| {
            let i = of[k];
            if side == Side::Back || t >= backs.t[i] {
                return;
            }
            let tolerance = Tolerance {
                along: part.refinement(),
                beside: part.resolution(),
            };
            let corners = tree.mesh().triangle(triangle as usize);
            if let Some(hit) = refine(&rays[i], triangle, corners, t, tolerance)
                && best[i].is_none_or(|best| (hit.t, triangle) < (best.t, best.face.triangle))
            {
                best[i] = Some(hit);
            }
        });
        for (i, hit) in best.into_iter().enumerate() {
            if let Some(hit) = hit {
                found(i, hit);
            }
        }
    }
}
