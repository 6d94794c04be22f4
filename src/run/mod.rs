//! Execution of scenes: preparation, frames in parallel, and output files. No partial files remain
//! after a failure.

mod ambient_limit;
mod assessment;
mod cameras;
mod check;
#[cfg(feature = "cli")]
mod check_text;
mod control;
mod dataset;
pub(crate) mod error_model;
mod features;
pub(crate) mod files;
mod filtered_points;
pub(crate) mod forecast;
mod frames;
mod goal_path;
pub(crate) mod height_errors;
pub(crate) mod height_map;
mod housing;
mod init;
mod journal;
mod ladder;
mod light_survey;
mod lit_normal;
pub(crate) mod measure;
pub(crate) mod memory_estimate;
pub(crate) mod methods;
pub(crate) mod output_folder;
mod passes;
mod path_planner;
pub(crate) mod pilot;
pub(crate) mod planner;
#[cfg(feature = "service")]
mod preview;
#[cfg(feature = "service")]
mod rays;
pub(crate) mod recipe;
mod reflections;
mod render;
pub(crate) mod report;
mod resolved;
mod scan;
pub(crate) mod scan_speckle;
mod sensor_drawing;
pub(crate) mod sensor_figures;
mod set_cover;
pub(crate) mod setup;
mod shards;
pub(crate) mod simulation;
mod summary;
pub(crate) mod surface_view;
mod sweep;
pub(crate) mod systematic;
mod systematic_budget;
mod topography;
#[doc(hidden)]
pub mod untrusted;
mod warning_kind;
mod warnings;

pub use ambient_limit::AmbientLimit;
pub use assessment::{Assessment, LightFractions, Loss, PassGap, PathFigures, SurfaceFractions};
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
#[cfg(feature = "cli")]
pub use features::features_text;
pub use forecast::ResourceEstimate;
pub use goal_path::{PathGoal, PathPurpose, PathSummary};
pub use height_errors::HeightErrors;
pub use init::{InitialScene, Up, begin};
pub use light_survey::InField;
pub use output_folder::OutputFolder;
pub use path_planner::{HiddenSurface, TargetCoverage};
#[cfg(feature = "service")]
pub use rays::{RaysSummary, cast_rays};
pub use render::{RenderSummary, render};
pub use scan::{Export, ScanOptions, ShardSummary, merge, scan, scan_shard};
pub use sensor_figures::{PartSections, PeakCounts, SensorFigures, SensorPlace};
pub use setup::scene_plan;
pub use shards::Shard;
pub use simulation::{Simulation, part_in_view};
pub use summary::ScanSummary;
pub use sweep::{Plot, SweepSummary, sweep, sweep_merge, sweep_places};
pub use systematic_budget::{SystematicBudget, SystematicSource};
pub use warning_kind::{Warning, WarningKind};
pub use warnings::refuse;
