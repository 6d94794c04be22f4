//! Laser light on the part, seen by the camera: the irradiance image.

mod direct;
pub mod plan;
mod truth;

pub use direct::{Speckle, View, irradiance_image};
pub use plan::Plan;
pub use truth::{Truth, truth_layers};
