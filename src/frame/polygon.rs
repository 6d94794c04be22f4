//! Triangles clipped by planes.

use crate::accel::HalfSpace;
use crate::math::DVec3;

/// Maximum number of corners of a clipped triangle. A footprint clips by at most eleven planes and
/// a piece of it by two more. Each plane adds at most one corner.
pub(super) const MOST_CORNERS: usize = 16;

/// Convex polygon in space.
pub(crate) struct Polygon {
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

    /// Clips the polygon to the half-spaces whose bits in `crossed` are set.
    pub fn clip_to(&mut self, borders: &[HalfSpace], crossed: u32) {
        for (i, border) in borders.iter().enumerate() {
            if crossed >> i & 1 == 1 {
                self.clip(border);
            }
        }
    }

    /// Clips the polygon to the half-space (Sutherland & Hodgman 1974).
    pub fn clip(&mut self, half: &HalfSpace) {
        let mut heights = [0.0; MOST_CORNERS];
        for (height, &corner) in heights.iter_mut().zip(self.corners()) {
            *height = half.height(corner);
        }
        let Some(last) = heights[..self.count].last() else {
            return;
        };
        let (mut changes, mut before) = (0, *last < 0.0);
        for height in &heights[..self.count] {
            let outside = *height < 0.0;
            changes += u32::from(outside != before);
            before = outside;
        }
        match changes {
            0 if before => self.count = 0,
            2 => self.keep_inside(&heights),
            // All corners are on the plane within rounding. The polygon is kept unclipped, which
            // can only enlarge the footprint.
            _ => {}
        }
    }

    /// Keeps the side on which heights are not negative.
    fn keep_inside(&mut self, heights: &[f64; MOST_CORNERS]) {
        let mut inside = Polygon {
            corners: [DVec3::ZERO; MOST_CORNERS],
            count: 0,
        };
        let mut before = self.count - 1;
        for i in 0..self.count {
            let (from, to) = (heights[before], heights[i]);
            let (p, q) = (self.corners[before], self.corners[i]);
            if (from < 0.0) != (to < 0.0) {
                inside.push(p + (q - p) * (from / (from - to)));
            }
            if to >= 0.0 {
                inside.push(q);
            }
            before = i;
        }
        // Only the corners in use are copied, usually few of the sixteen.
        self.count = inside.count;
        self.corners[..inside.count].copy_from_slice(inside.corners());
    }

    pub fn push(&mut self, corner: DVec3) {
        self.corners[self.count] = corner;
        self.count += 1;
    }
}
