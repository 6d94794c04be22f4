//! Thin lens, perhaps a distorting one.

use super::Distortion;
use crate::math::Aperture;
use std::f64::consts::PI;

/// A thin lens, focused at one distance, and the tilted sensor behind it.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Lens {
    /// mm.
    pub focal_length: f64,
    /// Focal length over pupil diameter.
    pub f_number: f64,
    /// Distance along the axis of the plane in focus at the sensor's centre, mm;
    /// greater than the focal length.
    pub focus_distance: f64,
    /// Shape of the pupil; speckle grains take it on.
    pub aperture: Aperture,
    /// `None`: the lens is a pinhole's projection.
    pub distortion: Option<Distortion>,
}

impl Lens {
    /// Pupil diameter D, mm.
    pub fn pupil_diameter(&self) -> f64 {
        self.focal_length / self.f_number
    }

    /// mm².
    pub fn pupil_area(&self) -> f64 {
        let square = self.pupil_diameter().powi(2);
        match self.aperture {
            Aperture::Circle => PI / 4.0 * square,
            Aperture::Ellipse(ratio) => PI / 4.0 * square * ratio,
            Aperture::Square => square,
        }
    }

    /// Where an object at distance `z` is imaged, 1/(1/f - 1/z), mm; `None` if it
    /// is not beyond the focal length.
    pub fn image_of(&self, z: f64) -> Option<f64> {
        (z > self.focal_length).then(|| self.focal_length * z / (z - self.focal_length))
    }

    /// Distance from pupil to sensor along the axis, mm.
    pub fn image_distance(&self) -> f64 {
        self.image_of(self.focus_distance)
            .expect("a lens is focused beyond its focal length")
    }

    /// |m| on axis in the plane of focus.
    pub fn magnification(&self) -> f64 {
        self.image_distance() / self.focus_distance
    }
}
