//! Refinement in f64, with the f64 vertices, of hits that Embree found in f32.

use super::{Hit, Ray, TriangleId};
use crate::math::DVec3;

/// Returns the unit normal of a triangle on the side to which `-direction` points, or `None` for a
/// triangle without area.
pub fn facing_normal(triangle: [DVec3; 3], direction: DVec3) -> Option<DVec3> {
    let normal = across(triangle).try_normalize()?;
    Some(if normal.dot(direction) > 0.0 {
        -normal
    } else {
        normal
    })
}

/// Returns a normal of a triangle, with length equal to twice its area.
#[inline(always)]
pub(super) fn across([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Largest differences between f32 and f64 results, mm.
#[derive(Debug, Clone, Copy)]
pub struct Tolerance {
    /// Largest difference along the ray. Beyond it, the ray is nearly parallel to the plane of the
    /// triangle, which then does not determine the distance. The distance found in f32 is kept.
    pub depth_mm: f64,
    /// Largest distance from the triangle. Beyond it there is no hit: robust mode can report one
    /// far from a sliver that the ray misses (RenderKit/embree#387).
    pub lateral_mm: f64,
}

/// Result in f64 for a hit reported in f32.
#[derive(Debug, Clone, Copy)]
pub enum RefinedHit {
    /// Hit on the triangle.
    Inside(Hit),
    /// Hit outside the triangle or nearly parallel to it, within the tolerance.
    Near(Hit),
    /// No hit, or a triangle without area.
    Miss,
}

impl RefinedHit {
    /// Returns the hit if there is one within the tolerance.
    pub fn hit(self) -> Option<Hit> {
        match self {
            RefinedHit::Inside(hit) | RefinedHit::Near(hit) => Some(hit),
            RefinedHit::Miss => None,
        }
    }
}

/// Intersection of a ray with the plane of a triangle.
pub(super) struct PlaneIntersection {
    /// True if the point is in the triangle, which has an area and is not nearly parallel to the
    /// ray.
    pub on: bool,
    /// Distance, mm: the reported distance if the plane does not determine it.
    pub t: f64,
    pub point: DVec3,
    /// Unit normal on the side of the ray origin; not finite for a triangle without area.
    pub normal: DVec3,
}

impl PlaneIntersection {
    pub fn hit(&self, triangle: u32) -> Hit {
        Hit {
            t: self.t,
            face: TriangleId::of_mesh(triangle),
            point: self.point,
            normal: self.normal,
        }
    }
}

/// Intersects a ray with the plane of `corners`, where the backend reported a hit at `t_found`,
/// with tolerance `along`. Has no branches, so that it can be vectorized over rays.
#[inline(always)]
pub(super) fn intersect_plane(
    origin: DVec3,
    direction: DVec3,
    corners: [DVec3; 3],
    t_found: f64,
    depth_mm: f64,
) -> PlaneIntersection {
    let across = across(corners);
    let per_length = across.length_recip();
    let towards = across.dot(direction);
    // Independent of the unit normal, so that both are computed in parallel.
    let t_plane = across.dot(corners[0] - origin) / towards;
    let on_plane = (t_plane - t_found).abs() <= depth_mm;
    let t = if on_plane { t_plane } else { t_found };
    let point = origin + direction * t;
    let side = if towards > 0.0 {
        -per_length
    } else {
        per_length
    };
    PlaneIntersection {
        on: on_plane & (per_length < f64::INFINITY) & within_edges(corners, across, point),
        t,
        point,
        normal: across * side,
    }
}

/// Returns the hit of `ray` on the plane of `corners`, the triangle that the backend reported at
/// `t_found`.
pub fn refine(
    ray: &Ray,
    triangle: u32,
    corners: [DVec3; 3],
    t_found: f64,
    tolerance: Tolerance,
) -> RefinedHit {
    let met = intersect_plane(
        ray.origin,
        ray.direction,
        corners,
        t_found,
        tolerance.depth_mm,
    );
    let hit = met.hit(triangle);
    if met.on {
        RefinedHit::Inside(hit)
    } else if met.normal.is_finite()
        && nearest_on_triangle(corners, hit.point).distance(hit.point) <= tolerance.lateral_mm
    {
        RefinedHit::Near(hit)
    } else {
        RefinedHit::Miss
    }
}

/// True if a point of the plane of a triangle lies in the triangle.
#[inline(always)]
fn within_edges([a, b, c]: [DVec3; 3], across: DVec3, p: DVec3) -> bool {
    let (pa, pb, pc) = (a - p, b - p, c - p);
    let left_of = |from: DVec3, to: DVec3| from.cross(to).dot(across) >= 0.0;
    left_of(pa, pb) & left_of(pb, pc) & left_of(pc, pa)
}

/// Returns the point of a triangle nearest to `p`, by the Voronoi region that contains `p` (Ericson
/// 2005, Real-Time Collision Detection, section 5.1.5).
pub fn nearest_on_triangle([a, b, c]: [DVec3; 3], p: DVec3) -> DVec3 {
    let (ab, ac) = (b - a, c - a);
    let (d1, d2) = (ab.dot(p - a), ac.dot(p - a));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let (d3, d4) = (ab.dot(p - b), ac.dot(p - b));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let (d5, d6) = (ab.dot(p - c), ac.dot(p - c));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vc = d1 * d4 - d3 * d2;
    // d1 = d3 if a and b coincide; the edge from a to c is used then.
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
        return a + ab * (d1 / (d1 - d3));
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let across = ab.cross(ac);
    let longest = ab.length_squared().max(ac.length_squared());
    if across.length_squared() <= (SLIVER * longest).powi(2) {
        return nearest_on_border([a, b, c], p);
    }
    // The expression a + ab·vb/sum + ac·vc/sum is less accurate, since sum is the squared area. In
    // a sliver with width 10⁻⁶ of its length, its error along the sliver would be 10⁻⁴ of the
    // length.
    p - across * (across.dot(p - a) / across.length_squared())
}

/// Ratio of height to longest side below which the plane of a triangle is too uncertain to be used.
/// The error of its normal is 2⁻⁵³ divided by this ratio.
const SLIVER: f64 = 1e-8;

/// Returns the nearest point of the three sides.
fn nearest_on_border([a, b, c]: [DVec3; 3], p: DVec3) -> DVec3 {
    let on_side = |from: DVec3, to: DVec3| {
        let side = to - from;
        // NaN for a side of zero length; clamp would propagate it.
        let along = side.dot(p - from) / side.length_squared();
        from + side * if along > 0.0 { along.min(1.0) } else { 0.0 }
    };
    let mut best = on_side(a, b);
    for other in [on_side(b, c), on_side(c, a)] {
        if other.distance_squared(p) < best.distance_squared(p) {
            best = other;
        }
    }
    best
}

/// Returns the weights u and v of the corners b and c for a point of the triangle, both ≥ 0 with u
/// + v ≤ 1. For a triangle without area they are the weights along its longest side.
pub(super) fn barycentric([a, b, c]: [DVec3; 3], p: DVec3) -> [f64; 2] {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let across = ab.cross(ac);
    let area = across.length_squared();
    let longest = (ab.length_squared()).max(ac.length_squared());
    let longest = longest.max((c - b).length_squared());
    let [u, v] = if area > (SLIVER * longest).powi(2) {
        [ap.cross(ac), ab.cross(ap)].map(|part| part.dot(across) / area)
    } else if longest == 0.0 {
        [0.0, 0.0]
    } else if longest == ab.length_squared() {
        [ap.dot(ab) / longest, 0.0]
    } else if longest == ac.length_squared() {
        [0.0, ap.dot(ac) / longest]
    } else {
        let v = ((p - b).dot(c - b) / longest).clamp(0.0, 1.0);
        [1.0 - v, v]
    };
    let u = u.clamp(0.0, 1.0);
    [u, v.clamp(0.0, 1.0 - u)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    const T: [DVec3; 3] = [
        DVec3::new(0.0, 0.0, 0.0),
        DVec3::new(3.0, 0.0, 0.0),
        DVec3::new(0.0, 2.0, 1.0),
    ];

    /// Tests the nearest point against a grid of 101 × 101 points of the triangle. It is at least
    /// as near, and its distance from the best grid point is at most the grid spacing.
    #[test]
    fn nearest_point_beats_a_dense_sampling_of_the_triangle() {
        let key = RngKey::new(5, Purpose::SensorNoise);
        for i in 0..300 {
            let p = DVec3::from_array(std::array::from_fn(|j| {
                key.with(i).uniform(j as u64) * 8.0 - 4.0
            }));
            let best = (0..=100)
                .flat_map(|i| (0..=100 - i).map(move |j| (i as f64 / 100.0, j as f64 / 100.0)))
                .map(|(u, v)| (T[0] + (T[1] - T[0]) * u + (T[2] - T[0]) * v).distance(p))
                .fold(f64::INFINITY, f64::min);
            let found = nearest_on_triangle(T, p).distance(p);
            assert!(
                found <= best + 1e-12 && best - found < 0.03,
                "{p}: {found} {best}"
            );
        }
    }

    /// Tests slivers down to zero width. The point found is as near as the best of a dense sampling
    /// of the sides and the center line, to the step of the sampling.
    #[test]
    fn the_nearest_point_of_a_sliver_is_on_it() {
        let key = RngKey::new(6, Purpose::SensorNoise);
        let random = |i: u64, half: f64| {
            DVec3::from_array(std::array::from_fn(|j| {
                (key.with(i).uniform(j as u64) * 2.0 - 1.0) * half
            }))
        };
        for width in [1e-3, 1e-6, 1e-8, 1e-10, 1e-14, 0.0] {
            for i in 0..500 {
                let tip = random(3 * i, 10.0);
                let corners = [DVec3::ZERO, tip, tip + random(3 * i + 1, 10.0 * width)];
                let p = random(3 * i + 2, 6.0);
                let found = nearest_on_triangle(corners, p);
                let along = (p.dot(tip) / tip.length_squared()).clamp(0.0, 1.0);
                // The sliver is within its width of its side from the origin to the tip.
                let bound = 10.0 * width * 3f64.sqrt() + 1e-6;
                assert!(
                    found.distance(p) <= (tip * along).distance(p) + bound,
                    "{width} {i}"
                );
                let on = (found.dot(tip) / tip.length_squared()).clamp(0.0, 1.0);
                assert!(found.distance(tip * on) <= bound, "{width} {i}: {found}");
            }
        }
    }

    /// Tests triangles without area, which occur in CAD meshes and have a distance too. The case is
    /// the segment from x = 0 to 2 along x, with the corners in every order.
    #[test]
    fn a_triangle_without_area_is_a_segment_or_a_point() {
        let segment = [0.0, 1.0, 2.0];
        for order in 0..27 {
            let corners = [order % 3, order / 3 % 3, order / 9].map(|i| DVec3::X * segment[i]);
            let (low, high) = corners
                .iter()
                .fold((2.0f64, 0.0f64), |(l, h), c| (l.min(c.x), h.max(c.x)));
            for i in -4..=12 {
                let p = DVec3::new(i as f64 / 4.0, 0.5, -0.25);
                let nearest = nearest_on_triangle(corners, p);
                let expected = DVec3::X * p.x.clamp(low, high);
                assert!(
                    nearest.distance(expected) < 1e-15,
                    "{corners:?} {p}: {nearest}"
                );
            }
        }
    }

    #[test]
    fn an_edge_on_triangle_keeps_the_f32_distance() {
        let ray = Ray {
            origin: DVec3::new(-1.0, 0.5, 0.25),
            direction: DVec3::X,
            t_max: 10.0,
        };
        let hit = refine(&ray, 4, T, 1.5, TOLERANCE).hit().unwrap();
        assert_eq!((hit.t, hit.face.triangle), (1.5, 4));
        assert!(hit.point.is_finite() && hit.normal.is_finite());
    }

    const TOLERANCE: Tolerance = Tolerance {
        depth_mm: 1e-3,
        lateral_mm: 1e-4,
    };

    /// A ray along x = 1 in direction −z hits the plane 2z = y. The edge x/3 + y/2 = 1 bounds the
    /// corner at y = 2; the ray passes it at y = 4/3.
    #[test]
    fn a_hit_beside_its_triangle_is_none_but_one_next_to_its_edge_stands() {
        for winding in [T, [T[0], T[2], T[1]]] {
            for (y, stands) in [(0.5, true), (1.3334, true), (1.34, false), (-1e-3, false)] {
                let ray = Ray {
                    origin: DVec3::new(1.0, y, 5.0),
                    direction: -DVec3::Z,
                    t_max: 10.0,
                };
                let hit = refine(&ray, 0, winding, 5.0 - y / 2.0 + 1e-6, TOLERANCE);
                assert_eq!(hit.hit().is_some(), stands, "{y}");
                assert_eq!(matches!(hit, RefinedHit::Inside(_)), y == 0.5, "{y}");
            }
        }
    }
}
