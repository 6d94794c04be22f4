//! Execution of scenes: preparation, frames in parallel, and output files. No partial files remain
//! after a failure.

mod assessment;
mod begin;
mod check;
#[cfg(feature = "cli")]
mod check_text;
mod control;
mod dataset;
mod delivered;
#[cfg(feature = "service")]
mod draft;
pub(crate) mod error_model;
pub(crate) mod files;
pub(crate) mod forecast;
mod frames;
pub(crate) mod height_errors;
mod housing;
mod journal;
mod lit_normal;
pub(crate) mod measure;
pub(crate) mod methods;
pub(crate) mod need;
pub(crate) mod output_folder;
mod passes;
pub(crate) mod pilot;
pub(crate) mod planner;
#[cfg(feature = "service")]
mod rays;
pub(crate) mod ready;
mod reason;
mod recipe;
mod reflections;
mod render;
pub(crate) mod report;
mod resolved;
mod scan;
pub(crate) mod scan_speckle;
mod search;
mod sensor_drawing;
pub(crate) mod sensor_figures;
mod shards;
pub(crate) mod simulation;
mod summary;
pub(crate) mod surface_view;
mod survey;
mod sweep;
#[doc(hidden)]
pub mod untrusted;
mod warnings;

pub use assessment::{Assessment, LightFractions, Loss, PassGap, PathFigures, SurfaceFractions};
pub use begin::{InitialScene, Up, begin};
#[cfg(feature = "cli")]
pub use check::check_sensor;
pub use check::{CheckReport, check, draw_sensor};
#[cfg(feature = "service")]
pub(crate) use check::{check_ready, drawing};
#[cfg(feature = "cli")]
pub use check_text::{check_text, sensor_text, warning_lines};
pub use control::{RunControl, TraceMode};
pub(crate) use control::{check_frame, check_frames};
pub use dataset::{DatasetSummary, dataset, dataset_samples};
pub use forecast::ResourceEstimate;
pub use height_errors::HeightErrors;
pub use output_folder::OutputFolder;
#[cfg(feature = "service")]
pub use rays::{RaysSummary, cast_rays};
pub use ready::scene_plan;
pub use reason::{Warning, WarningKind};
pub use render::{RenderSummary, render};
pub use scan::{ScanOptions, ShardSummary, merge, scan, scan_shard};
pub use sensor_figures::{PartSections, PeakCounts, SensorFigures, SensorPlace};
pub use shards::Shard;
pub use simulation::{Simulation, part_in_view};
pub use summary::ScanSummary;
pub use survey::InField;
pub use sweep::{Plot, SweepSummary, sweep, sweep_merge, sweep_places};
pub use warnings::refuse;
