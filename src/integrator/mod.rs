//! Laser light on the part, seen by the camera: the irradiance image.

mod blocks;
mod direct;
mod footprint;
pub mod plan;
mod sight;
mod speckle;
mod truth;

pub use direct::{View, footprint_image, irradiance_image};
pub use plan::Plan;
pub use speckle::{Patterns, Slip, Speckle};
pub use truth::{Truth, truth_layers};
