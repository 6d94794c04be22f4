//! Comparison of a simulation with a recording: flat areas, a round part or a step of a height map,
//! or the image of a line.

use super::line_image::{self, line_statistics};
use super::patches::{self, SIDE, patch_statistics};
use super::recording::{RecordedImages, RecordedMap, RecordedPart, Recording};
use super::round::{self, Profile, RoundShape, round_statistics};
use super::sampled::{SampledStatistics, Statistic};
use super::step_edge::{self, step_statistics};
use crate::camera::Counts;
use crate::error::{InputError, Place, Result, printable};
use crate::inspect::HeightMap;
use crate::math::{DVec3, median_of_sorted};
use crate::profile::{PeakFinder, PeakSettings};
use crate::report::compare_page::{ComparePage, ComparedPicture, Row};
use crate::report::picture::encode_for_eyes;
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
    /// Path of the recorded height map, or of the first image.
    #[serde(serialize_with = "printable::in_json")]
    pub recording: PathBuf,
    /// Measured and simulated height map; `None` for images.
    pub maps: Option<[MapSummary; 2]>,
    /// Number of areas, profiles or columns of both that were evaluated.
    pub evaluated: [usize; 2],
    /// Statistics of both.
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
}

impl MapSummary {
    fn of(map: &HeightMap) -> MapSummary {
        MapSummary {
            columns: map.columns,
            profiles: map.rows,
            x_step_mm: map.x_step,
            y_step_mm: map.y_step,
            valid_fraction: map.valid_fraction(),
        }
    }
}

/// Statistic of the measurement and the simulation.
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
    /// Terms of sensor and surface that determine the statistic.
    pub terms: &'static str,
}

/// Statistics of both sides, and what the page shows of them.
struct Sides {
    definition: &'static str,
    names: &'static [Statistic],
    /// Measured and simulated.
    statistics: [SampledStatistics; 2],
    maps: Option<[MapSummary; 2]>,
    views: [ComparedPicture; 2],
}

/// Simulates `scene`, compares it with a recording, and writes `compare.json` and `compare.html`.
/// The scan is compared with a height map, and the middle frame with the image of a line.
///
/// # Errors
/// Returns `Error::Input` if the recording is invalid, or if recording or simulation contain too
/// few flat areas, profiles of the part or columns with a line.
pub fn compare<'a>(
    scene: Scene,
    recording: &Path,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<Comparison> {
    let found = Recording::read(recording)?;
    let names = Names::of(["compare.json", "compare.html"]);
    let inputs = [&[recording.to_owned()], found.paths()].concat();
    let out = out.into().claim(&inputs, &names)?.path;
    let simulation = Simulation::new(&scene)?;
    let sides = match &found {
        Recording::Images(images) => of_images(images, &simulation)?,
        Recording::Map(recorded) => of_maps(recorded, &simulation, control)?,
    };
    let [measured, simulated] = &sides.statistics;
    let statistics = sides.names.iter().enumerate().map(|(i, statistic)| {
        let of = |statistics: &SampledStatistics| {
            let [low, high] = statistics.interval(i, 0.05);
            [statistics.values[i], low, high]
        };
        let beyond = FALSE_DIFFERENCE_PROBABILITY / sides.names.len() as f64;
        let difference = measured.difference(simulated, i, beyond);
        ComparedStatistic {
            name: statistic.name,
            measured: of(measured),
            simulated: of(simulated),
            difference,
            differs: difference[0] > 0.0 || difference[1] < 0.0,
            terms: statistic.terms,
        }
    });
    let comparison = Comparison {
        recording: found.paths()[0].clone(),
        maps: sides.maps,
        evaluated: [measured.evaluated, simulated.evaluated],
        statistics: statistics.collect(),
        level: FALSE_DIFFERENCE_PROBABILITY,
        page: out.join("compare.html"),
    };
    let rows = comparison.statistics.iter().map(|s| Row {
        name: s.name,
        measured: s.measured,
        simulated: s.simulated,
        differs: s.differs,
        terms: s.terms,
    });
    let page = ComparePage {
        recording: printable::path(&comparison.recording).to_string(),
        definition: sides.definition,
        level_percent: 100.0 * FALSE_DIFFERENCE_PROBABILITY,
        rows: rows.collect(),
        views: sides.views,
    };
    files::write_bytes(&comparison.page, page.html().as_bytes())?;
    files::write_json(&out.join("compare.json"), &comparison)?;
    Ok(comparison)
}

/// Compares the image of the middle frame with the first recorded image.
fn of_images(recorded: &RecordedImages, simulation: &Simulation) -> Result<Sides> {
    let (path, image) = (&recorded.paths[0], &recorded.images[0]);
    let scene = &simulation.scene;
    let frame = simulation.image(scene.scan.frames / 2);
    let saturation = scene.camera.sensor.saturation_count();
    // Different seeds make the bootstrap samples of both sides independent.
    let statistics = |path: &Path, counts: &Counts, saturation: u16, seed: u64| {
        let settings = PeakSettings {
            finder: PeakFinder::Centroid,
            ..PeakSettings::new(saturation)
        };
        line_statistics(path, counts, &settings, seed)
    };
    let view = |counts: &Counts, saturation: u16| ComparedPicture::Image {
        png: encode_for_eyes(&counts.to_rows(), counts.columns(), saturation),
        size: [counts.columns(), counts.rows()],
    };
    Ok(Sides {
        definition: "Statistics of the highest line in each column of an image. A parabola is removed from the rows of \
                     blocks of 32 columns. Saturated pixels have the largest count of the sensor.",
        names: &line_image::STATISTICS,
        statistics: [
            statistics(path, &image.counts, image.saturation_dn, 1)?,
            statistics(&scene.path, &frame, saturation, 2)?,
        ],
        maps: None,
        views: [
            view(&image.counts, image.saturation_dn),
            view(&frame, saturation),
        ],
    })
}

/// Compares the heights of a scan with a height map.
fn of_maps(recorded: &RecordedMap, simulation: &Simulation, control: &RunControl) -> Result<Sides> {
    // The recording is evaluated before the simulation, which takes far longer.
    let measured = evaluated(recorded.part, &recorded.map, || recorded.profiles(), 1).map_err(
        |(found, expected)| InputError::new(&recorded.path, Place::File, found, expected),
    )?;
    let scan = Scan::of(simulation, control)?;
    let path = &simulation.scene.path;
    let simulated = evaluated(recorded.part, &scan.map, || scan.profiles.clone(), 2)
        .map_err(|(found, expected)| InputError::new(path, Place::File, found, expected))?;
    let (definition, names): (_, &[Statistic]) = match recorded.part {
        None | Some(RecordedPart::Plane) => (
            "Statistics are medians over the flattest quarter of all areas of 48 by 48 points. A plane is removed for the \
             first one, a parabola from each profile for the others.",
            &patches::STATISTICS,
        ),
        Some(RecordedPart::Cylinder) => (
            "A circle is fitted to each profile. Radius and slope at the ends are medians, the missing fraction refers to \
             the diameter, and the common part is the mean residual of each column.",
            &round::STATISTICS,
        ),
        Some(RecordedPart::Sphere) => (
            "A sphere is fitted to each of 16 interleaved parts of the profiles. Radius and slope at the ends are medians, \
             the missing fraction refers to the chords, and the common part is the mean residual of each column.",
            &round::STATISTICS,
        ),
        Some(RecordedPart::Step) => (
            "Two parallel planes and an edge with the shape of an integrated normal distribution are fitted to each of \
             16 blocks of profiles. The statistics are medians.",
            &step_edge::STATISTICS,
        ),
    };
    let view = |map: &HeightMap| ComparedPicture::Profile(middle_profile(map));
    Ok(Sides {
        definition,
        names,
        statistics: [measured, simulated],
        maps: Some([MapSummary::of(&recorded.map), MapSummary::of(&scan.map)]),
        views: [view(&recorded.map), view(&scan.map)],
    })
}

fn middle_profile(map: &HeightMap) -> Vec<f64> {
    let first = map.rows / 2 * map.columns;
    map.heights[first..first + map.columns].to_vec()
}

/// Computes the statistics of a map of the part. The error contains the found and the expected
/// content.
fn evaluated(
    part: Option<RecordedPart>,
    map: &HeightMap,
    profiles: impl Fn() -> Vec<Profile>,
    seed: u64,
) -> std::result::Result<SampledStatistics, (String, String)> {
    let too_few = |name: &'static str, least: usize| {
        move |found: usize| {
            let found = format!("{found} profiles with 20 or more points on {name}");
            (found, format!("{least} such profiles or more"))
        }
    };
    match part {
        None | Some(RecordedPart::Plane) => patch_statistics(map, seed).map_err(|found| {
            let found = format!(
                "{found} areas of {SIDE} by {SIDE} points with at least 98 % of the heights"
            );
            (found, "four such areas or more".to_owned())
        }),
        Some(RecordedPart::Cylinder) => round_statistics(RoundShape::Cylinder, profiles(), seed)
            .map_err(too_few("a cylinder", round::MIN_PROFILES)),
        Some(RecordedPart::Sphere) => round_statistics(RoundShape::Sphere, profiles(), seed)
            .map_err(too_few("a sphere", round::MIN_PROFILES)),
        Some(RecordedPart::Step) => step_statistics(&profiles(), seed)
            .map_err(too_few("both sides of a step", step_edge::MIN_PROFILES)),
    }
}

/// Heights of a simulated scan.
struct Scan {
    map: HeightMap,
    /// Points of all profiles: x along the line, y along the motion, z against the beam.
    profiles: Vec<Profile>,
}

impl Scan {
    /// Scans all frames. Uses the valid points.
    fn of(simulation: &Simulation, control: &RunControl) -> Result<Scan> {
        let points = simulation.scanned_points(control)?;
        let frames = 0..simulation.scene.scan.frames;
        let grid = HeightGrid::of(simulation, &frames, &points, None);
        let laser = |profile: usize| Some(grid.part_from_laser.get(profile)?.translation);
        let y_step = laser(0).zip(laser(1)).map_or(0.0, |(a, b)| a.distance(b));
        let rows = grid.part_from_laser.len();
        let mut heights = vec![f64::NAN; rows * grid.columns];
        let mut profiles: Vec<Profile> = vec![Vec::new(); rows];
        for point in &grid.points {
            heights[point.row * grid.columns + point.column] = -point.z;
            let position = DVec3::new(point.x, point.row as f64 * y_step, -point.z);
            profiles[point.row].push((point.column as i64, position));
        }
        for profile in &mut profiles {
            profile.sort_by_key(|&(column, _)| column);
        }
        let pairs = profiles.iter().flat_map(|profile| profile.windows(2));
        let adjacent = pairs.filter(|p| p[0].0 + 1 == p[1].0);
        let mut steps: Vec<f64> = adjacent.map(|p| (p[1].1.x - p[0].1.x).abs()).collect();
        steps.sort_by(f64::total_cmp);
        let map = HeightMap {
            columns: grid.columns,
            rows,
            x_step: match steps.is_empty() {
                true => 0.0,
                false => median_of_sorted(steps.into_iter()),
            },
            y_step,
            heights,
        };
        Ok(Scan { map, profiles })
    }
}
