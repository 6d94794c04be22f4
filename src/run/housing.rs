//! Where the sensor's housing touches the part along the path.

use super::survey::spread;
use crate::accel::Accel;
use crate::math::{Aabb, DVec3};
use crate::scene::Scene;
use rayon::prelude::*;
use std::ops::Range;

/// Frames that are looked at, evenly spread over all.
const MOST_FRAMES: usize = 256;

/// The first place where the housing meets a triangle of the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Touch {
    pub frame: u32,
    /// In the part's frame, mm: the triangle's middle, or what of the housing is nearest to it.
    pub place: DVec3,
}

/// In these frames. `None`: the scene has no housing, or it touches nothing. What it touches between the frames that
/// are looked at is missed, and so is a part that is all within it but for its surface.
pub(crate) fn touch(scene: &Scene, accel: &Accel, frames: &Range<u32>) -> Option<Touch> {
    let housing = scene.housing?;
    let mesh = accel.mesh();
    let chosen = spread(frames.len(), MOST_FRAMES).map(|i| frames.start + i as u32);
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
        Some(Touch {
            frame,
            place: scene.part_from_head(frame).point(place),
        })
    })
}

/// Whether a triangle has a place in a box: no plane along an axis of the box, along the triangle, or along an edge of
/// each is between them (Akenine-Möller 2001).
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
    use crate::math::rng::{Key, Purpose};

    /// Against 60 × 60 places of each triangle: one of them in the box is a touch; and where the box grown by
    /// the distance between places, 1/60 of the longest edge, holds none, there is none.
    #[test]
    fn triangles_in_boxes_are_those_with_places_in_them() {
        let key = Key::new(1, Purpose::Bootstrap);
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
