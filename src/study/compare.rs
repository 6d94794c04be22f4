//! Comparison of a simulated scan with a recorded height map.

use super::patches::{NAMES, PatchStatistics, SIDE};
use super::recording::read_recording;
use crate::error::{Error, InputError, Place, Result, printable};
use crate::inspect::HeightMap;
use crate::math::median_of_sorted;
use crate::report::compare_page::{ComparePage, Row};
use crate::run::height_map::HeightGrid;
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
    // Different seeds make the bootstrap samples of the maps independent.
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

/// Scans all frames. Returns the heights of the valid points along the beam.
fn simulated_map(simulation: &Simulation, control: &RunControl) -> Result<HeightMap> {
    let points = simulation.scanned_points(control)?;
    let frames = 0..simulation.scene.scan.frames;
    let grid = HeightGrid::of(simulation, &frames, &points, None);
    let rows = grid.part_from_laser.len();
    let mut heights = vec![f64::NAN; rows * grid.columns];
    for point in &grid.points {
        heights[point.row * grid.columns + point.column] = -point.z;
    }
    let pairs = grid.points.windows(2);
    let adjacent = pairs.filter(|p| (p[0].row, p[0].column + 1) == (p[1].row, p[1].column));
    let mut steps: Vec<f64> = adjacent.map(|p| (p[1].x - p[0].x).abs()).collect();
    steps.sort_by(f64::total_cmp);
    let laser = |profile: usize| Some(grid.part_from_laser.get(profile)?.translation);
    let y_step = laser(0).zip(laser(1)).map(|(a, b)| a.distance(b));
    Ok(HeightMap {
        columns: grid.columns,
        rows,
        x_step: match steps.is_empty() {
            true => 0.0,
            false => median_of_sorted(steps.into_iter()),
        },
        y_step: y_step.unwrap_or(0.0),
        heights,
    })
}
