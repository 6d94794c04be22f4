//! Numerical results of a scan.

use super::assessment::Assessment;
use super::warning_kind::Warning;
use crate::error::printable;
use crate::inspect::align::Alignment;
use crate::inspect::coverage::SurfaceCoverage;
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::features::{FeatureResult, MeanUncertainty};
use crate::inspect::tolerance::RegionVerdict;
use crate::inspect::uncertainty::UncertaintyStatistics;
use crate::mesh::Ignored;
use crate::plan::accuracy::Accuracy;
use crate::profile::Filters;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Content of `summary.json`.
#[derive(Debug, Serialize)]
pub struct ScanSummary {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of frames.
    pub frames: u32,
    /// Number of image columns.
    pub columns: u32,
    /// Fraction of all columns of all frames with a measured point.
    pub measured_fraction: f64,
    /// Number of measured points, including flagged ones.
    pub points: usize,
    /// Fraction of the points that are valid; `null` without points.
    pub valid_fraction: Option<f64>,
    /// Fraction of the points at which the lens blur is wider than two standard deviations of their
    /// line; `null` without points.
    pub defocused_fraction: Option<f64>,
    /// Deviation statistics of valid points
    /// ([`CloudPoint::is_valid`](crate::inspect::cloud::CloudPoint::is_valid)); `null` without
    /// valid points.
    pub deviation: Option<DeviationStatistics>,
    /// Deviation statistics of all points.
    pub deviation_including_flagged: Option<DeviationStatistics>,
    /// Uncertainty statistics; `null` if no point is free of flags.
    pub uncertainty: Option<UncertaintyStatistics>,
    /// Uncertainties of the mean deviation of 1, 100 and 10 000 points in the middle of the scan.
    pub means: Vec<MeanUncertainty>,
    /// Unused content of the mesh file.
    pub mesh_ignored: Vec<Ignored>,
    /// Filters that were applied to the profiles.
    pub filters: Filters,
    /// Number of points with each flag.
    pub flags: BTreeMap<&'static str, usize>,
    /// Tolerance results of each region; empty if the scene has no regions.
    pub tolerance: Vec<RegionVerdict>,
    /// Values, uncertainties and verdicts of the features; absent if the scene has no features.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub features: Vec<FeatureResult>,
    /// Alignment; `null` if the scene does not request it or too few points were measured.
    pub alignment: Option<Alignment>,
    /// Rung of the ladder for the scene's tolerance, with its accuracy; `null` without a tolerance.
    pub accuracy: Option<Accuracy>,
    /// Coverage of the part's surface; `null` for a part without area.
    pub coverage: Option<SurfaceCoverage>,
    /// Fractions of surface and light, and the path, as `check` predicts them before the scan.
    pub assessment: Assessment,
    /// Problems of the scan; empty without problems.
    pub warnings: Vec<Warning>,
    /// Path of the cloud.
    #[serde(serialize_with = "printable::in_json")]
    pub cloud: PathBuf,
    /// Path of the report.
    #[serde(serialize_with = "printable::in_json")]
    pub report: PathBuf,
    /// Images in the report: a frame, if images were simulated, and the cloud over the part.
    #[serde(serialize_with = "printable::all_in_json")]
    pub pictures: Vec<PathBuf>,
}
