//! Thin lens with optional distortion.

use super::Distortion;
use crate::math::Aperture;
use std::f64::consts::PI;

/// Distance from the entrance pupil of a telecentric lens to its position, mm. A chief ray at 100 mm
/// from the axis deviates from the axis by 1 µrad.
pub const TELECENTRIC_PUPIL_DISTANCE: f64 = 1e8;

/// Thin lens focused at one distance.
///
/// A telecentric lens has its entrance pupil at [`TELECENTRIC_PUPIL_DISTANCE`] behind its position.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lens {
    /// Focal length, mm.
    pub focal_length: f64,
    /// Focal length divided by pupil diameter.
    pub f_number: f64,
    /// Distance along the axis from the pupil to the plane in focus at the sensor's centre, mm. It
    /// exceeds the focal length.
    pub focus_distance: f64,
    /// Whether the lens is telecentric on the object side.
    pub telecentric: bool,
    /// Shape of the pupil; it determines the shape of the speckle.
    pub aperture: Aperture,
    /// Lens distortion; `None` for an ideal pinhole projection.
    pub distortion: Option<Distortion>,
}

impl Lens {
    /// Returns the distance along the axis from the pupil to the position of the lens, mm. It is 0
    /// for lenses that are not telecentric.
    pub fn position(&self) -> f64 {
        match self.telecentric {
            true => TELECENTRIC_PUPIL_DISTANCE,
            false => 0.0,
        }
    }

    /// Returns the numerical aperture on the object side on axis.
    pub fn numerical_aperture(&self) -> f64 {
        (self.pupil_diameter() / 2.0 / self.focus_distance)
            .atan()
            .sin()
    }

    /// Returns the pupil diameter D, mm.
    pub fn pupil_diameter(&self) -> f64 {
        self.focal_length / self.f_number
    }

    /// Returns the pupil area, mm².
    pub fn pupil_area(&self) -> f64 {
        let square = self.pupil_diameter().powi(2);
        match self.aperture {
            Aperture::Circle => PI / 4.0 * square,
            Aperture::Ellipse(ratio) => PI / 4.0 * square * ratio,
            Aperture::Square => square,
        }
    }

    /// Returns the image distance 1/(1/f − 1/z) of an object at distance `z`, mm. Returns `None` if
    /// `z` does not exceed the focal length.
    pub fn image_of(&self, z: f64) -> Option<f64> {
        (z > self.focal_length).then(|| self.focal_length * z / (z - self.focal_length))
    }

    /// Returns the distance from pupil to sensor along the axis, mm.
    pub fn image_distance(&self) -> f64 {
        self.image_of(self.focus_distance)
            .expect("a lens is focused beyond its focal length")
    }

    /// Returns the magnification |m| on axis for the plane in focus.
    pub fn magnification(&self) -> f64 {
        self.image_distance() / self.focus_distance
    }
}
