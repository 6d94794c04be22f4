//! Contact of the sensor's housing with the part along the path.

use super::light_survey::even_subset;
use crate::accel::Accel;
use crate::math::{Aabb, DVec3};
use crate::scene::Scene;
use rayon::prelude::*;
use std::ops::Range;

/// Maximum number of tested frames, uniformly distributed over all.
const MOST_FRAMES: usize = 256;

/// First intersection of the housing with a triangle of the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Collision {
    pub frame: u32,
    /// Centroid of the triangle, or its nearest point of the housing; in the part's frame, mm.
    pub place: DVec3,
}

/// Returns the first contact in these frames; `None` if the scene has no housing or there is no
/// contact. Contacts between tested frames are missed. A part whose surface does not intersect the
/// housing is missed, even if it encloses the housing.
pub(crate) fn first_collision(
    scene: &Scene,
    accel: &Accel,
    frames: &Range<u32>,
) -> Option<Collision> {
    let housing = scene.housing?;
    let mesh = accel.mesh();
    let chosen = even_subset(frames.len(), MOST_FRAMES).map(|i| frames.start + i as u32);
    let near = chosen.flat_map(|frame| {
        let head_from_part = scene.part_from_head(frame).inverse();
        accel
            .poses()
            .iter()
            .map(move |pose| (frame, head_from_part * *pose))
    });
    let mut near = near.filter(|(_, head_from_mesh)| {
        let part = mesh.bounds().moved(head_from_mesh);
        part.min.cmple(housing.max).all() && part.max.cmpge(housing.min).all()
    });
    near.find_map(|(frame, head_from_mesh)| {
        let corners = |i: usize| mesh.triangle(i).map(|corner| head_from_mesh.point(corner));
        let first = (0..mesh.triangles.len())
            .into_par_iter()
            .find_first(|&i| meets(&housing, corners(i)))?;
        let middle = corners(first).iter().sum::<DVec3>() / 3.0;
        let place = middle.clamp(housing.min, housing.max);
        Some(Collision {
            frame,
            place: scene.part_from_head(frame).point(place),
        })
    })
}

/// Returns whether a triangle and a box intersect. They are disjoint if a separating plane exists.
/// Its candidates are perpendicular to a box axis, parallel to the triangle, or parallel to an edge
/// of each (Akenine-Möller 2001).
fn meets(within: &Aabb, corners: [DVec3; 3]) -> bool {
    let (center, half) = (within.center(), within.size() / 2.0);
    let [a, b, c] = corners.map(|corner| corner - center);
    let apart = |axis: DVec3| {
        let reach = half.dot(axis.abs());
        let along = [a, b, c].map(|corner| corner.dot(axis));
        let least = along.iter().copied().fold(f64::INFINITY, f64::min);
        let most = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        least > reach || most < -reach
    };
    let edges = [b - a, c - b, a - c];
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let crossed = axes
        .iter()
        .flat_map(|&axis| edges.map(|edge| axis.cross(edge)));
    !axes
        .iter()
        .copied()
        .chain([edges[0].cross(edges[1])])
        .chain(crossed)
        .any(apart)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Compares the test with 60 × 60 points on each triangle. A point in the box implies contact.
    /// If the box extended by the point spacing, 1/60 of the longest edge, contains no point, there
    /// is no contact.
    #[test]
    fn triangles_in_boxes_are_those_with_places_in_them() {
        let key = RngKey::new(1, Purpose::Bootstrap);
        let of_box = Aabb::new(DVec3::new(-1.0, -0.5, -0.25), DVec3::new(1.0, 0.5, 0.25));
        let (mut touching, mut apart) = (0, 0);
        for i in 0..2000 {
            let value = |j: u64| 4.0 * key.uniform(9 * i + j) - 2.0;
            let corners = [0, 3, 6].map(|j| DVec3::new(value(j), value(j + 1), value(j + 2)));
            let [a, b, c] = corners;
            let edges = [b - a, c - b, a - c].map(DVec3::length);
            let step = DVec3::splat(edges.iter().copied().fold(0.0, f64::max) / 60.0);
            let holds = |grown: DVec3| {
                (0..=60).any(|i| {
                    (0..=60 - i).any(|j| {
                        let place =
                            a + (b - a) * (f64::from(i) / 60.0) + (c - a) * (f64::from(j) / 60.0);
                        place.cmpge(of_box.min - grown).all()
                            && place.cmple(of_box.max + grown).all()
                    })
                })
            };
            let found = meets(&of_box, corners);
            if holds(DVec3::ZERO) {
                assert!(found, "{corners:?}");
                touching += 1;
            } else if !holds(step) {
                assert!(!found, "{corners:?}");
                apart += 1;
            }
        }
        assert!(touching > 200 && apart > 200, "{touching} {apart}");
    }
}
