//! The measurement against the CAD: point cloud, deviation, report. The only
//! place where what was measured meets what is true.

pub mod align;
pub mod chart;
pub mod cloud;
pub mod coverage;
pub mod deviation;
pub mod picture;
pub mod plot;
pub mod report;
pub mod uncertainty;
