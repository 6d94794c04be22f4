//! Presentation of results: report page, plots, images and point cloud formats.

pub mod accept_page;
pub mod accept_plot;
pub mod accuracy_chart;
pub(crate) mod axes;
pub mod chart;
pub mod color;
pub mod feature_plot;
pub mod formats;
pub mod ghosts_plot;
pub mod lens_plot;
pub mod limits_plot;
#[cfg(feature = "service")]
pub mod live;
pub mod page;
pub mod picture;
pub mod ply;
#[cfg(feature = "race")]
pub mod race_plot;
pub mod residual_picture;
pub mod setup;
pub mod sheet_plot;
pub(crate) mod svg;
pub mod sweep_plot;
pub mod uncertainty_plot;
pub mod viewer;
pub mod wave_plot;
