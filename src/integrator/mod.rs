//! Laser light on the part, seen by the camera: the irradiance image.

pub mod accuracy;
mod bend;
mod cost;
mod cutoff;
mod defocus;
mod direct;
mod footprint;
mod geometric;
mod grain_extent;
pub mod height_error;
pub mod in_view;
mod irradiance;
mod lit;
mod pixels;
pub mod plan;
mod polygon;
mod reference;
mod samples;
mod sight;
mod speckle;
mod truth;
mod window;

pub use direct::{Sampling, View, footprint_image, irradiance_image, lit_columns, strip_image};
pub use geometric::{LinePoint, Sheet};
pub use grain_extent::GrainExtent;
pub use irradiance::Irradiance;
pub use plan::Plan;
pub use reference::{Reference, Strips};
pub use speckle::{Patterns, Speckle};
pub use truth::{Truth, truth_layers};
