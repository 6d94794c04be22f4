//! The measurement against the CAD: point cloud, deviation, alignment, coverage. The only
//! place where what was measured meets what is true.

pub mod acceptance;
pub mod align;
pub mod artefact;
pub mod bands;
pub mod cloud;
pub mod continuity;
pub mod coverage;
pub mod deviation;
pub mod flags;
pub mod sight_lines;
pub mod uncertainty;
