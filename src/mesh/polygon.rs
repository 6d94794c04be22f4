//! Triangulation of polygons with more than three corners, as OBJ and PLY allow.

use earcut::Earcut;

use crate::math::DVec3;

/// Largest number of corners of a polygon. Triangulation takes up to quadratic time, so the limit
/// bounds the cost of a hostile file. Faces of real parts have far fewer corners.
pub const MOST_CORNERS: usize = 10_000;

/// Triangulator for the polygons of one file, with reusable buffers.
pub struct Triangulator {
    /// Remaining budget, as a sum of squared corner counts. It starts at 2·10⁹: 2000 polygons of
    /// 1000 corners, or half a minute if every polygon intersects itself in the worst way.
    allowance: u64,
    earcut: Earcut<f64>,
    flat: Vec<[f64; 2]>,
    cut: Vec<u32>,
}

/// Error text for a file that exceeds the triangulation budget.
pub const TOO_MUCH: [&str; 2] = [
    "polygons with too many corners in all",
    "them cut to triangles by the program that wrote them",
];

impl Default for Triangulator {
    fn default() -> Triangulator {
        Triangulator {
            allowance: 2_000_000_000,
            earcut: Earcut::new(),
            flat: Vec::new(),
            cut: Vec::new(),
        }
    }
}

impl Triangulator {
    /// Appends the triangles of the polygon with these corners, with the winding of the polygon. It
    /// has at least 3 corners, which are indices into `positions`.
    ///
    /// The triangles of a planar polygon without self-intersection, convex or not, cover exactly
    /// its area. Each polygon edge remains an edge of one triangle, so neighbours still match along
    /// collinear corners. A polygon that intersects itself or has no area has no correct
    /// triangulation. It becomes a fan about its first corner, which preserves its border.
    ///
    /// Returns false, with nothing appended, if the file has exhausted its budget.
    #[must_use]
    pub fn triangulate(
        &mut self,
        positions: &[DVec3],
        corners: &[u32],
        triangles: &mut Vec<[u32; 3]>,
    ) -> bool {
        if let [a, b, c] = *corners {
            triangles.push([a, b, c]);
            return true;
        }
        let n = corners.len();
        let Some(left) = self.allowance.checked_sub((n * n) as u64) else {
            return false;
        };
        self.allowance = left;
        let start = triangles.len();
        if self.flatten(positions, corners) {
            self.earcut.earcut_slice(&self.flat, &[], &mut self.cut);
            let (ears, _) = self.cut.as_chunks::<3>();
            // Counter-clockwise in the plane of flatten() is the winding of the polygon. The earcut
            // crate does not guarantee a winding.
            let area: f64 = ears.iter().map(|t| self.doubled_area(t)).sum();
            let mut todo: Vec<[u32; 3]> = match area > 0.0 {
                true => ears.to_vec(),
                false => ears.iter().map(|&[a, b, c]| [c, b, a]).collect(),
            };
            restore_collinear(n as u32, &mut todo);
            // Accepted with fewer than n − 2 triangles as well. A correct area with a crack, which
            // the report counts, is better than a fan with a wrong area.
            if self.covers(&todo) {
                triangles.extend(todo.iter().map(|t| t.map(|i| corners[i as usize])));
            }
        }
        if triangles.len() == start {
            triangles.extend((1..n - 1).map(|i| [corners[0], corners[i], corners[i + 1]]));
        }
        true
    }

    /// Projects the polygon to the plane perpendicular to its area vector (Newell normal), where it
    /// is counter-clockwise. Returns false if it has no area.
    fn flatten(&mut self, positions: &[DVec3], corners: &[u32]) -> bool {
        // Relative to the first corner, so that an offset of the part causes no loss of precision.
        let origin = positions[corners[0] as usize];
        let at = |i: usize| positions[corners[i % corners.len()] as usize] - origin;
        let normal: DVec3 = (0..corners.len()).map(|i| at(i).cross(at(i + 1))).sum();
        let Some(normal) = normal.try_normalize() else {
            return false;
        };
        let (u, v) = normal.any_orthonormal_pair();
        self.flat.clear();
        self.flat
            .extend((0..corners.len()).map(|i| [at(i).dot(u), at(i).dot(v)]));
        // (u, v, normal) is right-handed in glam; a test below verifies this.
        true
    }

    fn doubled_area(&self, triangle: &[u32; 3]) -> f64 {
        let [a, b, c] = triangle.map(|i| self.flat[i as usize]);
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    }

    /// True if the absolute triangle areas add up to the area of the polygon. The tolerance of 1e-9
    /// is far above rounding errors and far below the area of a wrong triangle.
    fn covers(&self, triangles: &[[u32; 3]]) -> bool {
        let n = self.flat.len() as u32;
        let cut: f64 = triangles.iter().map(|t| self.doubled_area(t).abs()).sum();
        let fan: f64 = (1..n - 1).map(|i| self.doubled_area(&[0, i, i + 1])).sum();
        (cut - fan).abs() <= 1e-9 * cut
    }
}

/// Restores the collinear corners that ear clipping omits, by splitting the triangle on whose edge
/// they lie. An edge i→j with no used corner between i and j becomes i→i+1→j.
fn restore_collinear(n: u32, triangles: &mut Vec<[u32; 3]>) {
    let mut used = vec![false; n as usize];
    triangles
        .as_flattened()
        .iter()
        .for_each(|&i| used[i as usize] = true);
    let mut t = 0;
    while t < triangles.len() {
        let split = (0..3).find_map(|e| {
            let [i, j, k] = [0, 1, 2].map(|c| triangles[t][(e + c) % 3]);
            let mid = (i + 1) % n;
            let mut between = (1..).map(|s| (i + s) % n).take_while(|&c| c != j);
            (mid != j && between.all(|c| !used[c as usize])).then_some((i, mid, j, k))
        });
        match split {
            Some((i, mid, j, k)) => {
                used[mid as usize] = true;
                triangles[t] = [i, mid, k];
                triangles.push([mid, j, k]);
            }
            None => t += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn triangulate(
        points: &[[f64; 2]],
        lift: impl Fn(f64, f64) -> DVec3,
    ) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let positions: Vec<_> = points.iter().map(|p| lift(p[0], p[1])).collect();
        let corners: Vec<u32> = (0..points.len() as u32).collect();
        let mut triangles = Vec::new();
        assert!(Triangulator::default().triangulate(&positions, &corners, &mut triangles));
        (positions, triangles)
    }

    /// Returns the sum of triangle areas signed along `normal`, and the sum of absolute areas.
    fn areas((positions, triangles): &(Vec<DVec3>, Vec<[u32; 3]>), normal: DVec3) -> (f64, f64) {
        triangles.iter().fold((0.0, 0.0), |(signed, size), t| {
            let [a, b, c] = t.map(|i| positions[i as usize]);
            let area = (b - a).cross(c - a) / 2.0;
            (signed + area.dot(normal), size + area.length())
        })
    }

    /// True if every polygon edge is in exactly one triangle and every other edge in two.
    fn border_kept(n: u32, triangles: &[[u32; 3]]) -> bool {
        let edges: Vec<_> = (triangles.iter())
            .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
            .collect();
        edges
            .iter()
            .all(|&(a, b)| edges.contains(&(b, a)) != (b == (a + 1) % n))
            && triangles.len() == n as usize - 2
    }

    #[test]
    fn a_concave_polygon_is_cut_without_overlap_in_any_plane_and_sense() {
        // A "U" of area 5.
        let u = [
            [0., 0.],
            [3., 0.],
            [3., 2.],
            [2., 2.],
            [2., 1.],
            [1., 1.],
            [1., 2.],
            [0., 2.],
        ];
        let backwards: Vec<_> = u.iter().rev().copied().collect();
        for lift in [
            |x, y| DVec3::new(x, y, 0.0),
            |x, y| DVec3::new(y, 0.0, x),
            |x: f64, y: f64| DVec3::new(450_000.0 + x, 5_200_000.0 + y, 0.0),
        ] {
            let normal = (lift(1., 0.) - lift(0., 0.)).cross(lift(0., 1.) - lift(0., 0.));
            for (points, sign) in [(u.as_slice(), 1.0), (&backwards, -1.0)] {
                let result = triangulate(points, lift);
                let (signed, size) = areas(&result, normal);
                assert!((signed - sign * 5.0).abs() < 1e-8 && (size - 5.0).abs() < 1e-8);
                assert!(border_kept(8, &result.1));
            }
        }
    }

    #[test]
    fn collinear_corners_stay_on_the_border() {
        let square = [
            [0., 0.],
            [1., 0.],
            [2., 0.],
            [3., 0.],
            [3., 3.],
            [1., 3.],
            [0., 3.],
            [0., 2.],
            [0., 1.],
        ];
        let result = triangulate(&square, |x, y| DVec3::new(x, y, 1.0));
        let (signed, size) = areas(&result, DVec3::Z);
        assert!((signed - 9.0).abs() < 1e-12 && (size - 9.0).abs() < 1e-12);
        assert!(border_kept(9, &result.1));
    }

    #[test]
    fn work_is_rationed() {
        let mut cutter = Triangulator {
            allowance: 40,
            ..Triangulator::default()
        };
        let mut cut =
            |corners: &[u32]| cutter.triangulate(&[DVec3::ZERO; 5], corners, &mut Vec::new());
        assert_eq!(
            [cut(&[0, 1, 2, 3, 4]), cut(&[0, 1, 2, 3, 4])],
            [true, false]
        );
        assert!(cut(&[0, 1, 2]));
    }

    #[test]
    fn polygons_without_a_right_cut_become_fans() {
        let bow = [[0., 0.], [2., 2.], [2., 0.], [0., 1.]];
        assert_eq!(
            triangulate(&bow, |x, y| DVec3::new(x, y, 0.0)).1,
            [[0, 1, 2], [0, 2, 3]]
        );
        assert_eq!(
            triangulate(&bow, |_, _| DVec3::ONE).1,
            [[0, 1, 2], [0, 2, 3]]
        );
    }

    proptest! {
        /// Tests a comb with random teeth, many of them flush with their neighbours: concave, with
        /// collinear runs, like the outline of a machined part.
        #[test]
        fn orthogonal_outlines_are_cut_exactly(heights in prop::collection::vec(1u8..4, 1..24), tilt in -3.0..3.0f64) {
            let mut points = vec![[heights.len() as f64, 0.0], ];
            for (i, &h) in heights.iter().enumerate().rev() {
                points.push([i as f64 + 1.0, f64::from(h)]);
                points.push([i as f64, f64::from(h)]);
            }
            points.push([0.0, 0.0]);
            points.dedup();
            let (s, c) = tilt.sin_cos();
            let result = triangulate(&points, |x, y| DVec3::new(x * c, y, x * s));
            let area: f64 = heights.iter().map(|&h| f64::from(h)).sum();
            let normal = DVec3::new(c, 0.0, s).cross(DVec3::Y);
            let (signed, size) = areas(&result, normal);
            prop_assert!((signed - area).abs() < 1e-9 && (size - area).abs() < 1e-9);
            prop_assert!(border_kept(points.len() as u32, &result.1));
        }
    }
}
