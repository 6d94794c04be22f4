//! Comparison of the measurement with the CAD surface: point cloud, deviation, alignment and
//! coverage. Only this module uses both measured and true values.

pub mod acceptance;
pub mod align;
pub mod artefact;
pub mod cloud;
pub mod continuity;
pub mod coverage;
pub mod deviation;
pub mod features;
pub mod flags;
pub mod height_map;
pub mod line_of_sight;
pub mod tolerance;
pub mod uncertainty;

pub use height_map::HeightMap;
