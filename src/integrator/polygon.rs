//! Triangles cut by planes.

use crate::accel::HalfSpace;
use crate::math::DVec3;

/// Most corners of a triangle cut by the at most ten planes of a footprint and the
/// two of a piece of it: each adds one.
pub(super) const MOST_CORNERS: usize = 16;

/// A convex polygon in space.
pub(super) struct Polygon {
    pub corners: [DVec3; MOST_CORNERS],
    pub count: usize,
}

impl Polygon {
    pub fn new(triangle: [DVec3; 3]) -> Polygon {
        let mut corners = [DVec3::ZERO; MOST_CORNERS];
        corners[..3].copy_from_slice(&triangle);
        Polygon { corners, count: 3 }
    }

    pub fn corners(&self) -> &[DVec3] {
        &self.corners[..self.count]
    }

    /// Keeps what is in the half-space (Sutherland & Hodgman 1974).
    pub fn cut(&mut self, half: &HalfSpace) {
        let mut heights = [0.0; MOST_CORNERS];
        for (height, &corner) in heights.iter_mut().zip(self.corners()) {
            *height = half.height(corner);
        }
        let outside = |i: usize| heights[i % self.count] < 0.0;
        let changes = (0..self.count).filter(|&i| outside(i) != outside(i + 1));
        match changes.count() {
            0 if self.count == 0 || !outside(0) => return,
            0 | 2 => {}
            // All on the plane but for rounding: left whole, it is seen no less.
            _ => return,
        }
        let all = std::mem::replace(self, Polygon { count: 0, ..*self });
        let mut before = all.count.wrapping_sub(1);
        for i in 0..all.count {
            let (from, to) = (heights[before], heights[i]);
            let (p, q) = (all.corners[before], all.corners[i]);
            if (from < 0.0) != (to < 0.0) {
                self.push(p + (q - p) * (from / (from - to)));
            }
            if to >= 0.0 {
                self.push(q);
            }
            before = i;
        }
    }

    pub fn push(&mut self, corner: DVec3) {
        self.corners[self.count] = corner;
        self.count += 1;
    }
}
