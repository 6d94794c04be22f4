//! Lay of a surface: the direction of its machining grooves.

use crate::math::DVec3;

/// Direction of the grooves in the part frame.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Lay {
    /// Grooves along one direction, as milled or ground; unit vector.
    Along(DVec3),
    /// Circular grooves about an axis, as turned.
    About {
        /// Point on the axis, mm.
        point: DVec3,
        /// Direction of the axis; unit vector.
        axis: DVec3,
    },
}

impl Lay {
    /// Returns the direction of the lay at `point`, not normalised; zero if undefined.
    fn direction(&self, point: DVec3) -> DVec3 {
        match self {
            Lay::Along(direction) => *direction,
            Lay::About { point: on, axis } => axis.cross(point - *on),
        }
    }

    /// Returns the unit vectors x, y, z: along the lay, across it, and the normal. If the lay is
    /// undefined or perpendicular to the surface, x is an arbitrary tangent.
    pub fn frame(lay: Option<&Lay>, point: DVec3, normal: DVec3) -> [DVec3; 3] {
        let direction = lay.map_or(DVec3::ZERO, |lay| lay.direction(point));
        let along = direction - normal * normal.dot(direction);
        let x = match along.length() > 1e-9 * direction.length() {
            true => along.normalize(),
            false => normal.any_orthonormal_vector(),
        };
        [x, normal.cross(x), normal]
    }
}
