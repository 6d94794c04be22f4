//! A scene made ready to run, its frames, and its files: many frames at once, nothing
//! half-written left behind.

mod check;
mod control;
mod dataset;
pub(crate) mod error_model;
pub(crate) mod files;
pub(crate) mod forecast;
mod frames;
pub(crate) mod height_errors;
mod journal;
pub(crate) mod measure;
pub(crate) mod methods;
mod need;
pub(crate) mod pilot;
pub(crate) mod planner;
pub(crate) mod ready;
mod reason;
mod reflections;
mod render;
mod report;
mod scan;
pub(crate) mod scan_speckle;
mod search;
mod sensor_drawing;
mod sensor_figures;
mod shards;
pub(crate) mod simulation;
mod summary;
pub(crate) mod surface_view;
mod survey;
mod warnings;

pub use check::{Checked, check, draw_sensor};
pub use control::{Control, Coverage};
pub(crate) use control::{check_frame, check_frames};
pub use dataset::{DatasetSummary, dataset, dataset_samples};
pub use forecast::Forecast;
pub use height_errors::HeightErrors;
pub use ready::scene_plan;
pub use reason::{Reason, Warning};
pub use render::{RenderSummary, render};
pub use scan::{ScanOptions, ShardSummary, merge, scan, scan_shard};
pub use sensor_figures::{Cuts, PeakCounts, SensorFigures, SensorPlace};
pub use shards::Shard;
pub use simulation::{Simulation, part_in_view};
pub use summary::ScanSummary;
pub use warnings::refuse;
