//! What a scan gave, in numbers.

use super::assessment::Assessment;
use super::reason::Warning;
use crate::error::printable;
use crate::inspect::align::Alignment;
use crate::inspect::bands::RegionVerdict;
use crate::inspect::coverage::SurfaceCoverage;
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::uncertainty::UncertaintyStatistics;
use crate::mesh::Ignored;
use crate::plan::accuracy::Accuracy;
use crate::profile::Filters;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct ScanSummary {
    /// The scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of frames.
    pub frames: u32,
    /// Columns of an image.
    pub columns: u32,
    /// Share of all columns of all frames in which a point was measured.
    pub measured_share: f64,
    /// Number of measured points, flagged ones too.
    pub points: usize,
    /// Fraction of the points that are valid; `null` if there is none.
    pub valid_fraction: Option<f64>,
    /// Share of the points at which the lens's blur is wider than
    /// two standard deviations of their line; `null` if there is none.
    pub blurred_share: Option<f64>,
    /// Of valid points ([`CloudPoint::is_valid`](crate::inspect::cloud::CloudPoint::is_valid)); `null` if there is none.
    pub deviation: Option<DeviationStatistics>,
    /// Of all points.
    pub deviation_of_all: Option<DeviationStatistics>,
    /// `null` if no point is free of flags.
    pub uncertainty: Option<UncertaintyStatistics>,
    /// Content of the mesh's file that was not used.
    pub mesh_ignored: Vec<Ignored>,
    /// What was done to profiles before they became points.
    pub filters: Filters,
    /// Number of points with each flag.
    pub flags: BTreeMap<&'static str, usize>,
    /// How points lie in the tolerance bands of each region; empty if the scene has none.
    pub tolerance: Vec<RegionVerdict>,
    /// `null` if the scene does not ask for it or too few points were measured.
    pub alignment: Option<Alignment>,
    /// What was planned for the scene's tolerance, if it states one.
    pub accuracy: Option<Accuracy>,
    /// What became of the part's surface; `null` for a part without area.
    pub coverage: Option<SurfaceCoverage>,
    /// Fractions of surface and light, and the path, as `check` predicts them before the scan.
    pub assessment: Assessment,
    /// What spoils the scan; empty for a good one.
    pub warnings: Vec<Warning>,
    /// The cloud's file.
    #[serde(serialize_with = "printable::in_json")]
    pub cloud: PathBuf,
    /// The report's file.
    #[serde(serialize_with = "printable::in_json")]
    pub report: PathBuf,
    /// The frame shown in the report, if one was taken, and the cloud over the part.
    #[serde(serialize_with = "printable::all_in_json")]
    pub pictures: Vec<PathBuf>,
}
