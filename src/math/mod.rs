//! Frames, boxes, pupil shapes, stateless random numbers and quadrature.

mod aperture;
pub mod binomial;
pub mod frames;
mod normal;
pub mod quadrature;
pub mod rng;
mod sequence;

pub use aperture::Aperture;
pub use frames::Rigid;
pub(crate) use frames::rotation_vector;
pub use glam::{DMat2, DMat3, DVec2, DVec3};
pub use normal::{Z95, chi_squared_quantile, normal_quantile, students_quantile};
pub use sequence::Sequence;

/// Axis-aligned box, in the unit of its points. Empty if `min > max`.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Aabb {
    /// Smallest coordinates.
    pub min: DVec3,
    /// Largest coordinates.
    pub max: DVec3,
}

impl Aabb {
    /// Box without points: the result of [`Aabb::of`] for no points.
    pub const EMPTY: Aabb = Aabb {
        min: DVec3::INFINITY,
        max: DVec3::NEG_INFINITY,
    };

    /// Returns the smallest box that contains all points.
    pub fn of(points: impl IntoIterator<Item = DVec3>) -> Aabb {
        points
            .into_iter()
            .fold(Aabb::EMPTY, |b, p| Aabb::new(b.min.min(p), b.max.max(p)))
    }

    /// Returns the box of these smallest and largest coordinates.
    pub fn new(min: DVec3, max: DVec3) -> Aabb {
        Aabb { min, max }
    }

    /// Returns the smallest box that contains both boxes.
    pub fn with(&self, other: &Aabb) -> Aabb {
        Aabb::new(self.min.min(other.min), self.max.max(other.max))
    }

    /// Returns the smallest box that contains this box after transformation by `pose`.
    pub fn moved(&self, pose: &Rigid) -> Aabb {
        Aabb::of(self.corners().map(|corner| pose.point(corner)))
    }

    /// Returns the center of the box; NaN if it is empty.
    pub fn center(&self) -> DVec3 {
        (self.min + self.max) / 2.0
    }

    /// Returns the side lengths; negative if the box is empty.
    pub fn size(&self) -> DVec3 {
        self.max - self.min
    }

    /// Returns the eight corners, with x changing fastest.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|i| {
            DVec3::new(
                if i & 1 == 0 { self.min.x } else { self.max.x },
                if i & 2 == 0 { self.min.y } else { self.max.y },
                if i & 4 == 0 { self.min.z } else { self.max.z },
            )
        })
    }
}

/// Returns the median of sorted values, of which there is at least one. For an even number it is
/// the mean of the two central values, so both signs are treated equally.
pub(crate) fn median_of_sorted(sorted: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = sorted.len();
    let middle = sorted.skip((n - 1) / 2).take(2 - n % 2);
    middle.sum::<f64>() / (2 - n % 2) as f64
}

/// Returns sin(πr)/(πr), with value 1 at 0.
pub fn sinc(r: f64) -> f64 {
    let x = std::f64::consts::PI * r;
    if x.abs() < 1e-6 { 1.0 } else { x.sin() / x }
}
