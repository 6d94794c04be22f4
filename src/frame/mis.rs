//! Connects light paths and camera paths, and computes the weight of each sampling strategy.
//!
//! A path of k bounces is sampled by up to k + 1 strategies: its first i vertices are on the light
//! path and the others on the camera path. The weight of a strategy is its squared density over the
//! sum of all squared densities (power heuristic, Veach & Guibas 1995). A strategy therefore has a
//! small weight where another has a much higher density.

use super::random_walk::PathVertex;
use crate::math::DVec3;
use smallvec::SmallVec;

/// Vertex of a complete path.
#[derive(Clone, Copy)]
struct MisVertex {
    /// Area density of sampling the vertex from the laser, mm⁻².
    pdf_from_light: f64,
    /// Area density of sampling the vertex from the camera, mm⁻².
    pdf_from_camera: f64,
    /// True if the path continues by specular reflection here, so that nothing can be connected.
    is_delta: bool,
}

/// Vertices of a complete path, ordered from the laser.
pub(super) struct FullPath {
    points: SmallVec<[MisVertex; 8]>,
    /// Number of light paths, each of which is connected to the pupil.
    from_laser: f64,
}

impl FullPath {
    /// Builds the path from `light` (ordered from the laser) and `camera` (ordered from the
    /// camera). The last vertices of the two are mutually visible. The densities of these vertices,
    /// and of their predecessors, for sampling from the opposite side are passed separately.
    pub fn new(
        pdf_from_light: &[PathVertex],
        pdf_from_camera: &[PathVertex],
        from_laser: f64,
        // Densities of the last two vertices of `light` from the camera, and of `camera` from the
        // laser.
        [end_of_light, end_of_camera]: [[f64; 2]; 2],
    ) -> FullPath {
        let mut points = SmallVec::new();
        let other = |ends: [f64; 2], left: usize, backward: f64| match left {
            0 => ends[0],
            1 => ends[1],
            _ => backward,
        };
        for (i, vertex) in pdf_from_light.iter().enumerate() {
            let left = pdf_from_light.len() - 1 - i;
            points.push(MisVertex {
                pdf_from_light: vertex.pdf_fwd,
                pdf_from_camera: other(end_of_light, left, vertex.pdf_rev),
                is_delta: vertex.is_delta && left > 0,
            });
        }
        for (i, vertex) in pdf_from_camera.iter().enumerate().rev() {
            let left = pdf_from_camera.len() - 1 - i;
            points.push(MisVertex {
                pdf_from_light: other(end_of_camera, left, vertex.pdf_rev),
                pdf_from_camera: vertex.pdf_fwd,
                is_delta: vertex.is_delta && left > 0,
            });
        }
        FullPath { points, from_laser }
    }

    /// Returns the weight of the strategy whose first `i` vertices are on the light path.
    pub fn mis_weight(&self, i: usize) -> f64 {
        let k = self.points.len();
        let possible = |i: usize| {
            let joined = |j: usize| !self.points[j - 1].is_delta;
            match i {
                0 => joined(1),
                _ if i == k => joined(k),
                _ => joined(i) && joined(i + 1),
            }
        };
        // Ratio of the sampling density from the laser to the density from the camera.
        let ratio = |j: usize| {
            let point = &self.points[j - 1];
            let paths = if j == k { self.from_laser } else { 1.0 };
            paths * point.pdf_from_light / point.pdf_from_camera
        };
        let mut sum = 1.0;
        let mut r = 1.0;
        for j in (1..=i).rev() {
            r /= ratio(j);
            if possible(j - 1) {
                sum += r * r;
            }
        }
        r = 1.0;
        for j in i + 1..=k {
            r *= ratio(j);
            if possible(j) {
                sum += r * r;
            }
        }
        1.0 / sum
    }
}

/// Returns the unit vector from one point to another.
pub(super) fn towards(from: DVec3, to: DVec3) -> DVec3 {
    (to - from).normalize_or_zero()
}
