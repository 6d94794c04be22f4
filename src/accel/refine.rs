//! What Embree found in f32, computed again in f64 with the f64 vertices.

use super::{Face, Hit, Ray};
use crate::math::DVec3;

/// Unit normal of a triangle on the side towards which `-direction` points;
/// `None` for a triangle without area.
pub fn facing_normal(triangle: [DVec3; 3], direction: DVec3) -> Option<DVec3> {
    let normal = across(triangle).try_normalize()?;
    Some(if normal.dot(direction) > 0.0 {
        -normal
    } else {
        normal
    })
}

/// Normal to a triangle, twice its area long.
#[inline(always)]
pub(super) fn across([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// How far f64 lets f32 be off, mm.
#[derive(Debug, Clone, Copy)]
pub struct Tolerance {
    /// Along the ray. Beyond it the triangle is seen so nearly edge-on that its
    /// plane says nothing about the distance, and the distance found stands.
    pub along: f64,
    /// From the triangle. Beyond it there is no hit: robust mode can report one
    /// far from a sliver that the ray passes (RenderKit/embree#387).
    pub beside: f64,
}

/// What f64 says of a hit that f32 reports.
#[derive(Debug, Clone, Copy)]
pub enum Refined {
    /// The ray meets the triangle.
    On(Hit),
    /// The ray passes the triangle, or sees it edge-on, within the tolerance.
    Beside(Hit),
    /// There is no hit, or the triangle is without area.
    Off,
}

impl Refined {
    /// The hit if there is one within the tolerance.
    pub fn hit(self) -> Option<Hit> {
        match self {
            Refined::On(hit) | Refined::Beside(hit) => Some(hit),
            Refined::Off => None,
        }
    }
}

/// The place where a ray meets a triangle's plane.
pub(super) struct Meeting {
    /// It is in the triangle, which has an area and is not seen too nearly edge-on.
    pub on: bool,
    /// Distance, mm: where the plane does not tell it, that which was found.
    pub t: f64,
    pub point: DVec3,
    /// Unit normal on the side the ray comes from; not finite for a triangle without area.
    pub normal: DVec3,
}

impl Meeting {
    pub fn hit(&self, triangle: u32) -> Hit {
        Hit {
            t: self.t,
            face: Face::of_mesh(triangle),
            point: self.point,
            normal: self.normal,
        }
    }
}

/// Where a ray meets the plane of `corners`, which it is said to meet at `t_found`, within
/// `along`. Without a branch, so that vectors do it for several rays.
#[inline(always)]
pub(super) fn meet(
    origin: DVec3,
    direction: DVec3,
    corners: [DVec3; 3],
    t_found: f64,
    along: f64,
) -> Meeting {
    let across = across(corners);
    let per_length = across.length_recip();
    let towards = across.dot(direction);
    // Not from the unit normal, so that neither waits for the other.
    let t_plane = across.dot(corners[0] - origin) / towards;
    let on_plane = (t_plane - t_found).abs() <= along;
    let t = if on_plane { t_plane } else { t_found };
    let point = origin + direction * t;
    let side = if towards > 0.0 {
        -per_length
    } else {
        per_length
    };
    Meeting {
        on: on_plane & (per_length < f64::INFINITY) & within_edges(corners, across, point),
        t,
        point,
        normal: across * side,
    }
}

/// The hit of `ray` on the plane of `corners`, the triangle that intersection
/// reported at `t_found`.
pub fn refine(
    ray: &Ray,
    triangle: u32,
    corners: [DVec3; 3],
    t_found: f64,
    tolerance: Tolerance,
) -> Refined {
    let met = meet(ray.origin, ray.direction, corners, t_found, tolerance.along);
    let hit = met.hit(triangle);
    if met.on {
        Refined::On(hit)
    } else if met.normal.is_finite()
        && nearest_on_triangle(corners, hit.point).distance(hit.point) <= tolerance.beside
    {
        Refined::Beside(hit)
    } else {
        Refined::Off
    }
}

/// Whether a point of a triangle's plane lies in the triangle.
#[inline(always)]
fn within_edges([a, b, c]: [DVec3; 3], across: DVec3, p: DVec3) -> bool {
    let (pa, pb, pc) = (a - p, b - p, c - p);
    let left_of = |from: DVec3, to: DVec3| from.cross(to).dot(across) >= 0.0;
    left_of(pa, pb) & left_of(pb, pc) & left_of(pc, pa)
}

/// The point of a triangle nearest to `p` (Ericson 2005, Real-Time Collision
/// Detection, section 5.1.5), by the Voronoi region `p` lies in.
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
    // d1 = d3 if a and b are one point: the edge from a to c decides then.
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
    // Not a + ab·vb/sum + ac·vc/sum: in a sliver 10⁻⁶ as wide as long that is off
    // along it by 10⁻⁴ of its length, for the sum is the square of its area.
    p - across * (across.dot(p - a) / across.length_squared())
}

/// Height over longest side below which a triangle's plane is not known well enough to
/// stand on: its normal is off by 2⁻⁵³ over that.
const SLIVER: f64 = 1e-8;

/// The nearest point of the three sides.
fn nearest_on_border([a, b, c]: [DVec3; 3], p: DVec3) -> DVec3 {
    let on_side = |from: DVec3, to: DVec3| {
        let side = to - from;
        // NaN for a side of no length, which the clamp of NaN would keep.
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

/// The weights u and v of the corners b and c for a place on the triangle, both ≥ 0 and
/// u + v ≤ 1. Without an area they are those of its longest side.
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
    use crate::math::rng::{Key, Purpose};

    const T: [DVec3; 3] = [
        DVec3::new(0.0, 0.0, 0.0),
        DVec3::new(3.0, 0.0, 0.0),
        DVec3::new(0.0, 2.0, 1.0),
    ];

    /// The nearest point beats a grid of 101 × 101 points of the triangle, and
    /// lies no further from the best of them than the grid is coarse.
    #[test]
    fn nearest_point_beats_a_dense_sampling_of_the_triangle() {
        let key = Key::new(5, Purpose::SensorNoise);
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

    /// Slivers down to no width: the point found is as near as the best of a dense
    /// sampling of the sides and the middle line, to that sampling's step along it.
    #[test]
    fn the_nearest_point_of_a_sliver_is_on_it() {
        let key = Key::new(6, Purpose::SensorNoise);
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

    /// CAD meshes hold triangles without area; a distance to one is one all the
    /// same. The segment from x = 0 to 2 along x, corners in every order.
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
        along: 1e-3,
        beside: 1e-4,
    };

    /// A ray down x = 1 meets the plane 2z = y; the corner at y = 2 is cut by the
    /// edge x/3 + y/2 = 1, which it passes at y = 4/3.
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
                assert_eq!(matches!(hit, Refined::On(_)), y == 0.5, "{y}");
            }
        }
    }
}
