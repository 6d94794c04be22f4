//! Accuracy versus speed of all model configurations, on frames of the scene.

use super::configurations::{Configuration, ConfigurationSet, TierFrame};
use super::external_render::ExternalRender;
use crate::error::{Error, Result, printable};
use crate::plan::display::to_text;
use crate::plan::rules::ModelConfig;
use crate::profile::{Calibration, Peak, PeakFinder};
use crate::report::accuracy_chart::{AccuracyChart, Mark};
use crate::report::chart::short;
use crate::run::height_errors::{HeightErrors, at_share};
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::pilot::spread_frames;
use crate::run::setup;
use crate::run::{RunControl, files};
use crate::scene::Scene;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

/// Extent of a chart.
#[derive(Debug, Clone, Copy)]
pub struct ChartEffort {
    /// Number of frames, uniformly distributed over the scan.
    pub frames: u32,
    /// Number of timings per frame and configuration; configurations alternate.
    pub rounds: u32,
}

/// Content of `chart.json`. Height errors are displacements of points in the laser plane that
/// correspond to differences of rows. Times are for one core.
#[derive(Debug, Serialize)]
pub struct Chart {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Numbers of the evaluated frames.
    pub frames: Vec<u32>,
    /// Number of timings per frame.
    pub rounds: u32,
    /// Tolerance of the scene, if it has one.
    pub tolerance_um: Option<f64>,
    /// Height error due to speckle only that at least 1 % of the points exceed, if it is larger
    /// than the tolerance, µm.
    pub speckle_limited_error_um: Option<f64>,
    /// Model configurations. The first is the reference model.
    pub rows: Vec<ChartRow>,
    /// Images of these frames by another program.
    pub beside: Option<ChartFigures>,
    /// Path of the chart.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
    /// Path of the JSON file.
    #[serde(serialize_with = "printable::in_json")]
    pub json: PathBuf,
}

/// Figures of a program's frames, for this or another program.
#[derive(Debug, Serialize)]
pub struct ChartFigures {
    /// Name in the chart.
    pub name: String,
    /// Lower quartile, median and upper quartile of the time over frames and rounds, ms.
    pub ms: [f64; 3],
    /// Speed relative to the reference model.
    pub speed_up: f64,
    /// Height errors relative to the reference model.
    pub error: HeightErrors,
    /// Height errors relative to geometry in f64. They show the measurement error instead of the
    /// simulation error. `None` for a point laser.
    pub scatter: Option<HeightErrors>,
    /// Median standard deviation of the lines, px.
    pub line_sigma_px: Option<f64>,
    /// Contrast of the light of columns along the lines; `None` if there are too few adjacent
    /// columns, or no images.
    pub contrast: Option<f64>,
}

/// One model configuration.
#[derive(Debug, Serialize)]
pub struct ChartRow {
    /// Times and errors.
    #[serde(flatten)]
    pub figures: ChartFigures,
    /// Modelled effects and their methods.
    pub plan: ModelConfig,
    /// Peak finder.
    pub finder: PeakFinder,
    /// Selection of the traced pixels.
    pub coverage: crate::run::TraceMode,
    /// Implementation of ray–mesh intersection.
    pub intersection: String,
    /// Frames per second at the median time.
    pub frames_per_s: f64,
    /// Number of pixel samples in a frame. Each is a ray, except on planes. `None` without images.
    pub samples: Option<f64>,
    /// Total time of a frame per million samples, ms.
    pub ms_per_million_samples: Option<f64>,
    /// Computed memory of the hierarchy during its build (in addition to the mesh), the speckle
    /// patterns, and the light and counts of a frame, MB.
    pub memory_mb: f64,
    /// True for a different speckle realisation. `error` is then the difference of two
    /// realisations.
    pub independent_speckle: bool,
    /// True if no other configuration is both faster and more accurate.
    pub pareto_optimal: bool,
    /// True for the configuration that runs of the scene use.
    pub chosen: bool,
}

/// Time above which a frame is only timed in the first round, ms.
const SLOW_MS: f64 = 500.0;

/// Returns the number of progress steps of [`chart`].
pub fn chart_steps(scene: &Scene, effort: ChartEffort) -> u64 {
    effort.frames.min(scene.scan.frames) as u64 * effort.rounds as u64
}

/// Times all configurations on some frames of the scene and computes their errors. Writes
/// `chart.svg` and `chart.json` to `out`. If `beside` is given, its frames are used instead of the
/// number of frames in `effort`. Returns an error if the images in `beside` do not match the scene,
/// if no frame contains a line, and for failed file operations.
pub fn chart<'a>(
    scene: &Scene,
    effort: ChartEffort,
    beside: Option<&ExternalRender>,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<Chart> {
    beside.map_or(Ok(()), |beside| beside.check(scene))?;
    require_study(scene)?;
    let mut inputs = scene.inputs.to_vec();
    inputs.extend(beside.iter().flat_map(|beside| beside.inputs.clone()));
    let names = Names::of(["chart.svg", "chart.json"]);
    let out = out.into().claim(&inputs, &names)?.path;
    let (scene, accel) = setup::hierarchy_watched(scene, control)?;
    let tiers = ConfigurationSet::all(&scene, accel)?;
    let frames = match beside {
        Some(beside) => beside.frames.iter().map(|frame| frame.frame).collect(),
        None => spread_frames(scene.scan.frames, effort.frames),
    };
    let one_core = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .map_err(|error| Error::Usage(format!("cannot start a thread: {error}")))?;
    let runs = one_core.install(|| runs(&tiers.list, &frames, effort.rounds, control))?;
    if runs[0].peaks.iter().all(Vec::is_empty) {
        let path = scene.path.display();
        return Err(Error::Usage(format!(
            "chart on {path}: frames {frames:?} hold no line to measure"
        )));
    }
    let measured = ChartReference::new(&tiers, &runs);
    let mut rows = rows(&tiers, &measured);
    mark_front(&mut rows);
    let accuracy = rows.iter().find_map(|row| row.plan.accuracy.as_ref());
    let chart = Chart {
        scene: scene.path.clone(),
        rounds: effort.rounds,
        tolerance_um: scene.tolerance_um,
        speckle_limited_error_um: accuracy.and_then(|a| a.speckle_limited_error_um),
        frames,
        rows,
        beside: beside.map(|beside| beside_figures(beside, &tiers, &measured)),
        picture: out.join("chart.svg"),
        json: out.join("chart.json"),
    };
    files::write_bytes(&chart.picture, chart.drawing().svg().as_bytes())?;
    files::write_json(&chart.json, &chart)?;
    Ok(chart)
}

/// Results of a configuration: times, and lines in each frame.
#[derive(Default)]
struct TierRun {
    ms: Vec<f64>,
    peaks: Vec<Vec<Peak>>,
    /// Total number of traced pixels.
    pixels: usize,
}

/// Runs the configurations in alternation, so other load of the machine affects them equally.
fn runs(
    tiers: &[Configuration],
    frames: &[u32],
    rounds: u32,
    control: &RunControl,
) -> Result<Vec<TierRun>> {
    let mut runs: Vec<TierRun> = tiers.iter().map(|_| TierRun::default()).collect();
    let mut done = 0;
    for round in 0..rounds {
        for &frame in frames {
            for (tier, run) in tiers.iter().zip(&mut runs) {
                control.check()?;
                if round == 0 || run.ms.iter().all(|&ms| ms < SLOW_MS) {
                    let start = Instant::now();
                    let TierFrame { peaks, pixels } = tier.frame(frame);
                    run.ms.push(start.elapsed().as_secs_f64() * 1e3);
                    if round == 0 {
                        run.peaks.push(peaks);
                        run.pixels += pixels;
                    }
                }
            }
            done += 1;
            (control.progress)(done);
        }
    }
    Ok(runs)
}

fn quartiles(values: &[f64]) -> [f64; 3] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    [0.25, 0.5, 0.75].map(|share| at_share(&sorted, share))
}

/// Lag at which columns are compared. It exceeds a speckle grain, and the surface changes little
/// over it.
const LAG_COLUMNS: u32 = 8;

/// Returns the contrast of the light along lines. It is the root of half the mean square difference
/// of valid peaks at the lag [`LAG_COLUMNS`], divided by their mean.
fn contrast(frames: &[Vec<Peak>]) -> Option<f64> {
    let (mut square, mut sum, mut pairs) = (0.0, 0.0, 0.0);
    for peaks in frames {
        let valid = peaks.iter().filter(|p| p.flags.is_valid());
        let light: BTreeMap<u32, f64> = valid.map(|p| (p.column, p.intensity)).collect();
        for (column, a) in &light {
            if let Some(b) = light.get(&(column + LAG_COLUMNS)) {
                square += 0.5 * (a - b).powi(2);
                sum += 0.5 * (a + b);
                pairs += 1.0;
            }
        }
    }
    (pairs >= 10.0 && sum > 0.0).then(|| f64::sqrt(square / pairs) / (sum / pairs))
}

/// Reference data for heights.
struct ChartReference<'a> {
    /// Runs; the reference model is first.
    runs: &'a [TierRun],
    calibration: &'a Calibration,
    /// Sign of the height change with rising row.
    sign: f64,
    geometry: Option<&'a TierRun>,
}

impl<'a> ChartReference<'a> {
    fn new(tiers: &'a ConfigurationSet, runs: &'a [TierRun]) -> ChartReference<'a> {
        let full = &tiers.list[0].simulation;
        let scene = &full.scene;
        let middle = scene.camera.sensor.resolution.as_dvec2() / 2.0;
        let up = -scene.head_from_laser.rotation.z_axis;
        let jacobian = full.calibration.point_jacobian(middle);
        let sign = jacobian.map(|jacobian| jacobian.by_pixel[1].dot(up).signum());
        let is_geometry = |tier: &Configuration| tier.simulation.plan.geometry_only;
        let geometry = tiers.list.iter().position(is_geometry);
        ChartReference {
            runs,
            calibration: &full.calibration,
            sign: sign.unwrap_or(1.0),
            geometry: geometry.map(|i| &runs[i]),
        }
    }

    fn against(&self, peaks: &[Vec<Peak>], truth: &TierRun) -> HeightErrors {
        let pairs = peaks.iter().cloned().zip(truth.peaks.iter().cloned());
        HeightErrors::of(&pairs.collect::<Vec<_>>(), self.calibration, self.sign)
    }

    fn figures(&self, name: &str, times: &[f64], peaks: &[Vec<Peak>]) -> ChartFigures {
        let ms = quartiles(times);
        let sigmas: Vec<f64> = peaks.iter().flatten().map(|p| p.sigma).collect();
        ChartFigures {
            name: name.to_owned(),
            ms,
            speed_up: quartiles(&self.runs[0].ms)[1] / ms[1],
            error: self.against(peaks, &self.runs[0]),
            scatter: self.geometry.map(|truth| self.against(peaks, truth)),
            line_sigma_px: (!sigmas.is_empty()).then(|| quartiles(&sigmas)[1]),
            contrast: contrast(peaks),
        }
    }
}

/// Applies the scene's finder to the images in `beside`.
fn beside_figures(
    beside: &ExternalRender,
    tiers: &ConfigurationSet,
    measured: &ChartReference,
) -> ChartFigures {
    let simulation = &tiers.list[0].simulation;
    let frames = beside.frames.iter();
    let peaks: Vec<_> = frames
        .map(|frame| simulation.peaks(&frame.image.counts).0)
        .collect();
    let times = beside.frames.iter().flat_map(|frame| &frame.ms);
    measured.figures(&beside.name, &times.copied().collect::<Vec<_>>(), &peaks)
}

fn rows(tiers: &ConfigurationSet, measured: &ChartReference) -> Vec<ChartRow> {
    let row = |(i, (tier, run)): (usize, (&Configuration, &TierRun))| {
        let mut figures = measured.figures(&tier.name, &run.ms, &run.peaks);
        let ms = figures.ms[1];
        let plan = tier.simulation.plan.clone();
        let pixels = run.pixels as f64 / run.peaks.len() as f64;
        let samples = pixels * (plan.samples_per_side as f64).powi(2);
        let samples = (!plan.geometry_only).then_some(samples);
        figures.contrast = figures.contrast.filter(|_| !plan.geometry_only);
        ChartRow {
            figures,
            finder: tier.finder,
            coverage: tier.coverage,
            intersection: tier.accel.version(),
            frames_per_s: 1e3 / ms,
            samples,
            ms_per_million_samples: samples.filter(|&n| n > 0.0).map(|n| ms / n * 1e6),
            memory_mb: tier.memory(pixels as usize) as f64 / 1e6,
            independent_speckle: tier.independent_speckle,
            pareto_optimal: false,
            chosen: i == tiers.chosen,
            plan,
        }
    };
    let pairs = tiers.list.iter().zip(measured.runs);
    pairs.enumerate().map(row).collect()
}

/// Marks the configurations for which no other one is both faster and more accurate.
fn mark_front(rows: &mut [ChartRow]) {
    let places: Vec<Option<(f64, f64)>> = rows
        .iter()
        .map(|row| {
            Some((row.figures.ms[1], row.figures.error.percentile_99_um?))
                .filter(|_| !row.independent_speckle)
        })
        .collect();
    for (row, place) in rows.iter_mut().zip(&places) {
        row.pareto_optimal = place.is_some_and(|(ms, um)| {
            let better = |other: &&(f64, f64)| {
                other.0 <= ms && other.1 <= um && (other.0 < ms || other.1 < um)
            };
            places.iter().flatten().find(better).is_none()
        });
    }
}

/// Returns the chart mark of an external program. Only its times and line figures are known.
fn mark(figures: &ChartFigures) -> Mark {
    let error = &figures.error;
    Mark {
        name: figures.name.clone(),
        ms: figures.ms,
        speed_up: figures.speed_up,
        percentile_99_um: error.percentile_99_um,
        median_error_um: error.median_error_um,
        half_width_68_um: error.half_width_68_um,
        lost: error.lost,
        scatter_um: figures.scatter.as_ref().map(|s| s.half_width_68_um),
        sigma_px: figures.line_sigma_px,
        contrast: figures.contrast,
        ms_per_million: None,
        memory_mb: None,
        pareto_optimal: false,
        chosen: false,
        is_hollow: false,
        other: true,
    }
}

impl Chart {
    /// Returns a summary of the chart as text.
    pub fn headline(&self) -> String {
        let Some(row) = self.rows.iter().find(|row| row.chosen) else {
            return String::new();
        };
        let error = row.figures.error.percentile_99_um.map_or_else(
            || {
                format!(
                    "{} of 100 points are lost",
                    short(100.0 * row.figures.error.lost)
                )
            },
            |um| format!("99 of 100 heights are within {} µm of it", short(um)),
        );
        let speed_up = short(row.figures.speed_up);
        format!("The chosen plan runs {speed_up} times as fast as the full model; {error}")
    }

    fn drawing(&self) -> AccuracyChart {
        let own = |row: &ChartRow| Mark {
            ms_per_million: row.ms_per_million_samples,
            memory_mb: Some(row.memory_mb),
            pareto_optimal: row.pareto_optimal,
            chosen: row.chosen,
            is_hollow: row.independent_speckle,
            other: false,
            ..mark(&row.figures)
        };
        let beside = self.beside.as_ref().map(mark);
        let frames: Vec<String> = self.frames.iter().map(u32::to_string).collect();
        let mut lead = vec![format!(
            "{}: frames {}, one core, medians and quartiles of {} rounds in turn.",
            self.scene.display(),
            frames.join(", "),
            self.rounds
        )];
        if let Some(row) = self.rows.iter().find(|row| row.chosen) {
            lead.push(format!("Chosen: {}.", to_text(&row.plan)));
            let accuracy = row.plan.accuracy.as_ref();
            lead.extend(accuracy.map(|a| format!("{}.", a.statement)));
        }
        AccuracyChart {
            title: self.headline(),
            lead,
            tolerance_um: self.tolerance_um,
            speckle_limited_error_um: self.speckle_limited_error_um,
            marks: self.rows.iter().map(own).chain(beside).collect(),
        }
    }
}
