//! How large speckle grains are over the part of a sensor that matters.

use crate::math::DVec2;
use glam::DMat2;
use serde::Serialize;
use std::fmt;

/// Of the speckle grains at some places of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GrainExtent {
    /// Minimal speckle size in the direction in which it is smallest, pixels: what samples a
    /// pixel must resolve.
    pub speckle_size_px: f64,
    /// At most, along the sensor's rows and along its columns, pixels: the latter scatters
    /// centroids.
    pub speckle_extent_px: [f64; 2],
}

impl GrainExtent {
    /// Of no place.
    pub const NONE: GrainExtent = GrainExtent {
        speckle_size_px: f64::INFINITY,
        speckle_extent_px: [0.0; 2],
    };

    /// With those of a place, of which there are so many by column and by row
    /// ([`Camera::grains_per_pixel`](super::Camera::grains_per_pixel)). A grain along
    /// e is 1/|G·e| long; the smallest is one over the greater singular value of G.
    pub fn with(self, grains: DMat2) -> GrainExtent {
        let along = DVec2::new(grains.x_axis.length(), grains.y_axis.length());
        let (square, shear) = (along * along, grains.x_axis.dot(grains.y_axis));
        let spread = ((square.x - square.y) / 2.0).hypot(shear);
        let greatest = (square.element_sum() / 2.0 + spread).sqrt();
        let extent = along.recip().max(self.speckle_extent_px.into());
        GrainExtent {
            speckle_size_px: self.speckle_size_px.min(greatest.recip()),
            speckle_extent_px: extent.to_array(),
        }
    }
}

/// One size where grains are round and alike, to a twentieth.
impl fmt::Display for GrainExtent {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let least = self.speckle_size_px;
        let [columns, rows] = self.speckle_extent_px;
        match columns.max(rows) < 1.05 * least {
            true => write!(f, "{rows:.2} px"),
            false => write!(
                f,
                "{least:.2} px where smallest, up to {columns:.2} columns wide and {rows:.2} rows \
                 high, as the sensor's tilt and the field make it"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grain turned by an angle and stretched two to one: its smallest extent is found
    /// whatever the angle, those along the axes are chords of the ellipse through the middle.
    #[test]
    fn the_extent_of_turned_grains_is_that_of_an_ellipse() {
        for angle in [0.0, 0.3, 1.2] {
            let grains = DMat2::from_diagonal(DVec2::new(0.5, 0.25)) * DMat2::from_angle(angle);
            let found = GrainExtent::NONE.with(grains);
            assert!(
                (found.speckle_size_px - 2.0).abs() < 1e-12,
                "{angle}: {found:?}"
            );
            let chord = |turn: f64| (turn.cos() / 2.0).hypot(turn.sin() / 4.0).recip();
            let expected = DVec2::new(chord(angle), chord(angle + std::f64::consts::FRAC_PI_2));
            assert!(
                (DVec2::from(found.speckle_extent_px) - expected).length() < 1e-12,
                "{angle}: {found:?}"
            );
        }
    }
}
