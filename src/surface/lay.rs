//! The lay: the direction in which a tool left its grooves.

use crate::math::DVec3;

/// Where the grooves of a surface run, in the part's frame.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Lay {
    /// Along one direction, as milled or ground; unit vector.
    Along(DVec3),
    /// In circles about an axis, as turned.
    About {
        /// A point on the axis, mm.
        point: DVec3,
        /// Its direction; unit vector.
        axis: DVec3,
    },
}

impl Lay {
    /// Along the surface with this normal at `point`, of any length; zero where there is none.
    fn direction(&self, point: DVec3) -> DVec3 {
        match self {
            Lay::Along(direction) => *direction,
            Lay::About { point: on, axis } => axis.cross(point - *on),
        }
    }

    /// x, y, z: along the lay, across it, and the normal, unit vectors. Where the lay stands
    /// on the surface, or there is none, x is any direction along it.
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
