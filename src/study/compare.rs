//! Comparison of a simulated scan with a recorded height map.

use super::feature_uncertainty::scanned_points;
use super::patches::{NAMES, PatchStatistics, SIDE};
use super::recording::read_recording;
use crate::error::{Error, InputError, Place, Result, printable};
use crate::inspect::HeightMap;
use crate::report::compare_page::{ComparePage, Row};
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, Simulation, files};
use crate::scene::Scene;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Probability that any statistic of two equal surfaces and sensors is reported as different.
const FALSE_DIFFERENCE_PROBABILITY: f64 = 0.01;

/// Content of `compare.json`.
#[derive(Debug, Serialize)]
pub struct Comparison {
    /// Path of the recorded height map.
    #[serde(serialize_with = "printable::in_json")]
    pub recording: PathBuf,
    /// Measured and simulated height map.
    pub maps: [MapSummary; 2],
    /// Statistics of the flattest quarter of all patches.
    pub statistics: Vec<ComparedStatistic>,
    /// Probability that any difference exceeds its interval although sensor and surface are equal.
    pub level: f64,
    /// Path of the page.
    #[serde(serialize_with = "printable::in_json")]
    pub page: PathBuf,
}

/// Size and coverage of a height map.
#[derive(Debug, Serialize)]
pub struct MapSummary {
    /// Points per profile.
    pub columns: usize,
    /// Number of profiles.
    pub profiles: usize,
    /// Median distance of adjacent points of a profile, mm.
    pub x_step_mm: f64,
    /// Distance of adjacent profiles, mm.
    pub y_step_mm: f64,
    /// Fraction of points with a height.
    pub valid_fraction: f64,
    /// Number of patches that were evaluated.
    pub patches: usize,
}

/// Statistic of the measured and the simulated map.
#[derive(Debug, Serialize)]
pub struct ComparedStatistic {
    /// Name with unit.
    pub name: &'static str,
    /// Measured value and its 95 % interval.
    pub measured: [f64; 3],
    /// Simulated value and its 95 % interval.
    pub simulated: [f64; 3],
    /// Interval of the difference, simulated minus measured.
    pub difference: [f64; 2],
    /// True if the interval of the difference does not contain 0.
    pub differs: bool,
}

/// Simulates the scan of `scene`, compares its heights with a recording, and writes `compare.json`
/// and `compare.html`.
///
/// # Errors
/// Returns `Error::Input` if the recording is invalid or either height map has fewer than four flat
/// patches.
pub fn compare<'a>(
    scene: Scene,
    recording: &Path,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<Comparison> {
    let (path, measured) = read_recording(recording)?;
    let names = Names::of(["compare.json", "compare.html"]);
    let inputs = [recording.to_owned(), path.clone()];
    let out = out.into().claim(&inputs, &names)?.path;
    let of_measured = PatchStatistics::of(&measured, 1).map_err(|found| too_few(&path, found))?;
    let simulation = Simulation::new(&scene)?;
    let simulated = simulated_map(&simulation, control)?;
    let of_simulated =
        PatchStatistics::of(&simulated, 2).map_err(|found| too_few(&scene.path, found))?;
    let statistics = (0..NAMES.len()).map(|i| {
        let of = |statistics: &PatchStatistics| {
            let [low, high] = statistics.interval(i, 0.05);
            [statistics.medians[i], low, high]
        };
        let beyond = FALSE_DIFFERENCE_PROBABILITY / NAMES.len() as f64;
        let difference = of_measured.difference(&of_simulated, i, beyond);
        ComparedStatistic {
            name: NAMES[i],
            measured: of(&of_measured),
            simulated: of(&of_simulated),
            difference,
            differs: difference[0] > 0.0 || difference[1] < 0.0,
        }
    });
    let summary = |map: &HeightMap, statistics: &PatchStatistics| MapSummary {
        columns: map.columns,
        profiles: map.rows,
        x_step_mm: map.x_step,
        y_step_mm: map.y_step,
        valid_fraction: map.valid_fraction(),
        patches: statistics.patches,
    };
    let comparison = Comparison {
        recording: path,
        maps: [
            summary(&measured, &of_measured),
            summary(&simulated, &of_simulated),
        ],
        statistics: statistics.collect(),
        level: FALSE_DIFFERENCE_PROBABILITY,
        page: out.join("compare.html"),
    };
    let rows = comparison.statistics.iter().map(|s| Row {
        name: s.name,
        measured: s.measured,
        simulated: s.simulated,
        differs: s.differs,
    });
    let page = ComparePage {
        recording: printable::path(&comparison.recording).to_string(),
        level_percent: 100.0 * FALSE_DIFFERENCE_PROBABILITY,
        rows: rows.collect(),
        maps: [&measured, &simulated],
    };
    files::write_bytes(&comparison.page, page.html().as_bytes())?;
    files::write_json(&out.join("compare.json"), &comparison)?;
    Ok(comparison)
}

fn too_few(path: &Path, found: usize) -> Error {
    let found =
        format!("{found} areas of {SIDE} by {SIDE} points with at least 98 % of the heights");
    let expected = "four such areas or more";
    InputError::new(path, Place::File, found, expected).into()
}

/// Scans all frames and returns the distances of the valid points along the beam.
fn simulated_map(simulation: &Simulation, control: &RunControl) -> Result<HeightMap> {
    let scene = &simulation.scene;
    let points = scanned_points(simulation, control)?;
    let count = scene.measure.filters.average_frames;
    let columns = scene.camera.sensor.resolution.x as usize;
    let rows = scene.scan.frames.div_ceil(count) as usize;
    let mut heights = vec![f64::NAN; rows * columns];
    let mut steps = Vec::new();
    let mut previous: Option<(u32, u32, f64)> = None;
    for point in points.iter().filter(|point| point.is_valid()) {
        let pose = scene.part_from_head_at(f64::from(point.frame)) * scene.head_from_laser;
        let at = pose.inverse().point(point.position);
        heights[(point.frame / count) as usize * columns + point.column as usize] = -at.z;
        if let Some((frame, column, x)) = previous
            && (frame, column + 1) == (point.frame, point.column)
        {
            steps.push((at.x - x).abs());
        }
        previous = Some((point.frame, point.column, at.x));
    }
    let x_step = match steps.len() {
        0 => f64::NAN,
        n => *steps.select_nth_unstable_by(n / 2, f64::total_cmp).1,
    };
    let laser = |frame: u32| {
        (scene.part_from_head_at(f64::from(frame)) * scene.head_from_laser).translation
    };
    Ok(HeightMap {
        columns,
        rows,
        x_step,
        y_step: laser(0).distance(laser(count)),
        heights,
    })
}
