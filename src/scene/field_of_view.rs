//! Measuring field: the polygon of the laser plane in which the sensor returns points.

use super::resolver::Resolver;
use crate::error::Result;
use crate::math::DVec3;

/// Measuring field, symmetric about the laser axis. Between two nodes its width changes linearly.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct FieldOfView {
    /// Increasing distances from the laser along the beam, and half widths there, mm.
    nodes: Vec<[f64; 2]>,
}

impl FieldOfView {
    /// Returns the near and the far end, mm from the laser along the beam.
    pub fn ends(&self) -> [f64; 2] {
        [self.nodes[0][0], self.nodes[self.nodes.len() - 1][0]]
    }

    /// Returns the distances of the nodes from the laser, mm.
    pub(crate) fn distances(&self) -> impl Iterator<Item = f64> {
        self.nodes.iter().map(|[distance, _]| *distance)
    }

    /// Returns half the width at a distance from the laser, mm; `None` outside the range.
    pub fn half_width(&self, distance: f64) -> Option<f64> {
        let after = self.nodes.partition_point(|[node, _]| *node < distance);
        let [to, half] = *self.nodes.get(after)?;
        if to == distance {
            return Some(half);
        }
        let [from, before] = self.nodes[after.checked_sub(1)?];
        Some(before + (half - before) * (distance - from) / (to - from))
    }

    /// Returns whether a point of the laser plane is in the field, in the laser's frame.
    pub fn contains(&self, point: DVec3) -> bool {
        let half = self.half_width(point.z);
        half.is_some_and(|half| point.x.abs() <= half)
    }
}

impl Resolver<'_> {
    pub(super) fn field_of_view(
        &self,
        nodes: Option<&Vec<[f64; 2]>>,
    ) -> Result<Option<FieldOfView>> {
        let Some(nodes) = nodes else {
            return Ok(None);
        };
        let key = "field_of_view_mm";
        let expected = "a list of two or more [distance, width], by increasing distance from the laser: [[90, 42], [130, 58]]";
        let positive = nodes.iter().flatten().all(|v| (1e-6..=1e9).contains(v));
        let increasing = nodes.windows(2).all(|pair| pair[0][0] < pair[1][0]);
        self.check(positive && increasing && nodes.len() >= 2, key, expected)?;
        let nodes = nodes
            .iter()
            .map(|[distance, width]| [*distance, width / 2.0]);
        Ok(Some(FieldOfView {
            nodes: nodes.collect(),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_field_is_the_polygon_of_its_nodes() {
        let field = FieldOfView {
            nodes: vec![[10.0, 4.0], [12.0, 7.0], [16.0, 3.0]],
        };
        for (distance, half) in [
            (9.9, None),
            (10.0, Some(4.0)),
            (11.0, Some(5.5)),
            (12.0, Some(7.0)),
            (14.0, Some(5.0)),
            (16.0, Some(3.0)),
            (16.1, None),
            (f64::NAN, None),
        ] {
            assert_eq!(field.half_width(distance), half, "{distance}");
        }
        assert!(field.contains(DVec3::new(-5.5, 9.0, 11.0)));
        assert!(!field.contains(DVec3::new(-5.6, 0.0, 11.0)));
        assert_eq!(field.ends(), [10.0, 16.0]);
    }
}
