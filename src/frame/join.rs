//! How paths from the laser and from the camera are joined, and what each way of finding a path counts.
//!
//! A path of k reflections is found in up to k + 1 ways: with its first i points from the laser and the others from the
//! camera. Each counts by the square of its density over the sum of all squares (the power heuristic, Veach &
//! Guibas 1995), so that none counts much where another does better.

use super::walk::Vertex;
use crate::math::DVec3;
use smallvec::SmallVec;

/// A point of a whole path.
#[derive(Clone, Copy)]
struct Point {
    /// How likely it is met from the laser, 1/mm².
    light: f64,
    /// From the camera.
    camera: f64,
    /// Whether nothing can be joined to it.
    mirrored: bool,
}

/// The points of a path from the laser's side on; `sampled` times as many paths from the laser as from the camera's pixel
/// are joined to the pupil.
pub(super) struct Path {
    points: SmallVec<[Point; 8]>,
    /// Paths from the laser.
    from_laser: f64,
}

impl Path {
    /// `light` from the laser on, `camera` from the camera on, whose ends see each other; densities at these ends,
    /// and at those before them, are not yet known from the other side (`None`: there is no such end).
    pub fn new(
        light: &[Vertex],
        camera: &[Vertex],
        from_laser: f64,
        // Of the last two of `light`, from the camera, and of `camera`, from the laser.
        [end_of_light, end_of_camera]: [[f64; 2]; 2],
    ) -> Path {
        let mut points = SmallVec::new();
        let other = |ends: [f64; 2], left: usize, backward: f64| match left {
            0 => ends[0],
            1 => ends[1],
            _ => backward,
        };
        for (i, vertex) in light.iter().enumerate() {
            let left = light.len() - 1 - i;
            points.push(Point {
                light: vertex.forward,
                camera: other(end_of_light, left, vertex.backward),
                mirrored: vertex.mirrored && left > 0,
            });
        }
        for (i, vertex) in camera.iter().enumerate().rev() {
            let left = camera.len() - 1 - i;
            points.push(Point {
                light: other(end_of_camera, left, vertex.backward),
                camera: vertex.forward,
                mirrored: vertex.mirrored && left > 0,
            });
        }
        Path { points, from_laser }
    }

    /// What it counts if its first `i` points come from the laser.
    pub fn weight(&self, i: usize) -> f64 {
        let k = self.points.len();
        let possible = |i: usize| {
            let joined = |j: usize| !self.points[j - 1].mirrored;
            match i {
                0 => joined(1),
                _ if i == k => joined(k),
                _ => joined(i) && joined(i + 1),
            }
        };
        // Times that the point is met from the laser for each that it is from the camera.
        let ratio = |j: usize| {
            let point = &self.points[j - 1];
            let paths = if j == k { self.from_laser } else { 1.0 };
            paths * point.light / point.camera
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

/// Unit vector from one point to another.
pub(super) fn towards(from: DVec3, to: DVec3) -> DVec3 {
    (to - from).normalize_or_zero()
}
