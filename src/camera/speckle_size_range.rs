//! Speckle size over the relevant part of a sensor.

use crate::math::DVec2;
use glam::DMat2;
use serde::Serialize;
use std::fmt;

/// Range of speckle sizes over a set of sensor positions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SpeckleSizeRange {
    /// Smallest speckle size in any direction, pixels. Samples within a pixel must resolve it.
    pub speckle_size_px: f64,
    /// Largest speckle extent along the sensor's rows and along its columns, pixels. The extent
    /// along columns determines the centroid noise.
    pub speckle_extent_px: [f64; 2],
}

impl SpeckleSizeRange {
    /// Extent of an empty set of positions.
    pub const NONE: SpeckleSizeRange = SpeckleSizeRange {
        speckle_size_px: f64::INFINITY,
        speckle_extent_px: [0.0; 2],
    };

    /// Adds a position with `grains` G, the derivative of speckle coordinates with respect to
    /// column and row ([`Camera::grains_per_pixel`](super::Camera::grains_per_pixel)).
    ///
    /// The speckle extent along e is 1/|G·e|. The smallest is the reciprocal of the larger singular
    /// value of G.
    pub fn with(self, grains: DMat2) -> SpeckleSizeRange {
        let along = DVec2::new(grains.x_axis.length(), grains.y_axis.length());
        let (square, shear) = (along * along, grains.x_axis.dot(grains.y_axis));
        let spread = ((square.x - square.y) / 2.0).hypot(shear);
        let greatest = (square.element_sum() / 2.0 + spread).sqrt();
        let extent = along.recip().max(self.speckle_extent_px.into());
        SpeckleSizeRange {
            speckle_size_px: self.speckle_size_px.min(greatest.recip()),
            speckle_extent_px: extent.to_array(),
        }
    }
}

/// Prints one size if the speckle is isotropic and uniform to within 5 %.
impl fmt::Display for SpeckleSizeRange {
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

    /// Elliptical speckle with an axis ratio of 2, rotated by an angle. The smallest extent does
    /// not depend on the angle. The extents along the axes are chords through the centre of the
    /// ellipse.
    #[test]
    fn the_extent_of_turned_grains_is_that_of_an_ellipse() {
        for angle in [0.0, 0.3, 1.2] {
            let grains = DMat2::from_diagonal(DVec2::new(0.5, 0.25)) * DMat2::from_angle(angle);
            let found = SpeckleSizeRange::NONE.with(grains);
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
