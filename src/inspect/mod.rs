//! The measurement against the CAD: point cloud, deviation, report. The only
//! place where what was measured meets what is true.

pub mod accuracy_chart;
pub mod align;
pub mod chart;
pub mod cloud;
pub mod color;
pub mod continuity;
pub mod coverage;
pub mod deviation;
pub mod flags;
pub mod formats;
pub mod picture;
pub mod plot;
pub mod report;
pub mod setup;
pub mod uncertainty;
pub mod viewer;
