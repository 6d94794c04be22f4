//! Accuracy against speed: every way of doing a frame, on the scene's own frames.

use super::beside::Beside;
use super::tiers::{Tier, TierFrame, Tiers};
use crate::error::{Error, Result, printable};
use crate::plan::rules::Plan;
use crate::plan::words::in_words;
use crate::profile::{Calibration, Peak, PeakFinder};
use crate::report::accuracy_chart::{AccuracyChart, Mark};
use crate::report::chart::short;
use crate::run::height_errors::{HeightErrors, at_share};
use crate::run::need::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::pilot::spread_frames;
use crate::run::ready;
use crate::run::{Control, files};
use crate::scene::Scene;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

/// What a chart takes.
#[derive(Debug, Clone, Copy)]
pub struct ChartEffort {
    /// Frames, spread over the scan.
    pub frames: u32,
    /// Times each is timed by each tier, in turn.
    pub rounds: u32,
}

/// `chart.json`. Heights are ways of points in the laser plane for what their rows
/// differ; times are of one core.
#[derive(Debug, Serialize)]
pub struct Chart {
    /// The scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Numbers of the frames that were done.
    pub frames: Vec<u32>,
    /// Times that each frame was done.
    pub rounds: u32,
    /// The scene's tolerance, if it states one.
    pub tolerance_um: Option<f64>,
    /// What speckle alone does to 1 of 100 points or more, if that is beyond the
    /// tolerance.
    pub speckle_limit_um: Option<f64>,
    /// The first is the full model, the others' truth.
    pub rows: Vec<ChartRow>,
    /// Another program's images of the same frames.
    pub beside: Option<ChartFigures>,
    /// Where the chart was written.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
    /// Where this was written.
    #[serde(serialize_with = "printable::in_json")]
    pub json: PathBuf,
}

/// What is measured of a program's frames, this one's or another's.
#[derive(Debug, Serialize)]
pub struct ChartFigures {
    /// What the chart calls it.
    pub name: String,
    /// Lower quartile, median and upper quartile over frames and rounds, ms.
    pub ms: [f64; 3],
    /// Times as fast as the full model.
    pub speed_up: f64,
    /// Against the full model.
    pub error: HeightErrors,
    /// Against geometry in f64: what it measures, rather than how well it simulates;
    /// `None` for a point laser.
    pub scatter: Option<HeightErrors>,
    /// Median standard deviation of the lines, px.
    pub line_sigma_px: Option<f64>,
    /// Contrast of the columns' light along the lines; `None` where too few are side by
    /// side, and without images.
    pub contrast: Option<f64>,
}

/// One way of doing the frames.
#[derive(Debug, Serialize)]
pub struct ChartRow {
    /// Its times and errors.
    #[serde(flatten)]
    pub figures: ChartFigures,
    /// Which effects are modelled, and how.
    pub plan: Plan,
    /// How the line's row is found.
    pub finder: PeakFinder,
    /// Which pixels are traced.
    pub coverage: crate::run::Coverage,
    /// What finds the triangles rays meet.
    pub intersection: String,
    /// Predicted by the plan for the scene's tolerance, ms.
    pub predicted_ms: Option<f64>,
    /// Frames per second at the median time.
    pub frames_per_s: f64,
    /// Samples of pixels in a frame: each a ray, but on planes. `None` without images.
    pub samples: Option<f64>,
    /// Of all that a frame takes, ms.
    pub ms_per_million_samples: Option<f64>,
    /// Hierarchy while it is built (on top of the mesh), patterns of speckle, and a frame's
    /// light and counts, MB: by arithmetic.
    pub memory_mb: f64,
    /// Speckle with other grains: `error` is then the difference of two draws.
    pub other_grains: bool,
    /// None is both faster and more accurate.
    pub on_front: bool,
    /// What the scene's runs use.
    pub chosen: bool,
}

/// A frame that takes longer is done in the first round only, ms.
const SLOW_MS: f64 = 500.0;

/// Steps that [`chart`] tells of.
pub fn chart_steps(scene: &Scene, effort: ChartEffort) -> u64 {
    effort.frames.min(scene.scan.frames) as u64 * effort.rounds as u64
}

/// Times all tiers on some of the scene's frames and measures their errors; writes
/// `chart.svg` and `chart.json` to `out`. With frames of another program, those are the frames taken, whatever
/// `effort` says. Errors: these do not fit the scene; no line in any frame; files.
pub fn chart<'a>(
    scene: &Scene,
    effort: ChartEffort,
    beside: Option<&Beside>,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<Chart> {
    beside.map_or(Ok(()), |beside| beside.check(scene))?;
    require_study(scene)?;
    let mut inputs = scene.inputs.to_vec();
    inputs.extend(beside.iter().flat_map(|beside| beside.inputs.clone()));
    let names = Names::of(["chart.svg", "chart.json"]);
    let out = out.into().claim(&inputs, &names)?.path;
    let (scene, accel) = ready::hierarchy_watched(scene, control)?;
    let tiers = Tiers::all(&scene, accel)?;
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
    let measured = Measured::new(&tiers, &runs);
    let mut rows = rows(&tiers, &measured);
    mark_front(&mut rows);
    let accuracy = rows.iter().find_map(|row| row.plan.accuracy.as_ref());
    let chart = Chart {
        scene: scene.path.clone(),
        rounds: effort.rounds,
        tolerance_um: scene.tolerance_um,
        speckle_limit_um: accuracy.and_then(|a| a.speckle_limit_um),
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

/// What a tier did: its times, and the lines it found in each frame.
#[derive(Default)]
struct Run {
    ms: Vec<f64>,
    peaks: Vec<Vec<Peak>>,
    /// Pixels looked at in all frames.
    pixels: usize,
}

/// Tiers take turns, so that what else the machine does meets them alike.
fn runs(tiers: &[Tier], frames: &[u32], rounds: u32, control: &Control) -> Result<Vec<Run>> {
    let mut runs: Vec<Run> = tiers.iter().map(|_| Run::default()).collect();
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

/// How far apart columns are compared: more than a grain, and little surface.
const APART: u32 = 8;

/// Contrast of the light of columns along lines: root of half the mean square difference
/// of valid peaks [`APART`], over their mean.
fn contrast(frames: &[Vec<Peak>]) -> Option<f64> {
    let (mut square, mut sum, mut pairs) = (0.0, 0.0, 0.0);
    for peaks in frames {
        let valid = peaks.iter().filter(|p| p.flags.is_valid());
        let light: BTreeMap<u32, f64> = valid.map(|p| (p.column, p.intensity)).collect();
        for (column, a) in &light {
            if let Some(b) = light.get(&(column + APART)) {
                square += 0.5 * (a - b).powi(2);
                sum += 0.5 * (a + b);
                pairs += 1.0;
            }
        }
    }
    (pairs >= 10.0 && sum > 0.0).then(|| f64::sqrt(square / pairs) / (sum / pairs))
}

/// What heights are held against.
struct Measured<'a> {
    /// The full model first.
    runs: &'a [Run],
    calibration: &'a Calibration,
    /// Of a height for a row.
    sign: f64,
    geometry: Option<&'a Run>,
}

impl<'a> Measured<'a> {
    fn new(tiers: &'a Tiers, runs: &'a [Run]) -> Measured<'a> {
        let full = &tiers.list[0].simulation;
        let scene = &full.scene;
        let middle = scene.camera.sensor.resolution.as_dvec2() / 2.0;
        let up = -scene.head_from_laser.rotation.z_axis;
        let jacobian = full.calibration.point_jacobian(middle);
        let sign = jacobian.map(|jacobian| jacobian.by_pixel[1].dot(up).signum());
        let is_geometry = |tier: &Tier| tier.simulation.plan.geometry_only;
        let geometry = tiers.list.iter().position(is_geometry);
        Measured {
            runs,
            calibration: &full.calibration,
            sign: sign.unwrap_or(1.0),
            geometry: geometry.map(|i| &runs[i]),
        }
    }

    fn against(&self, peaks: &[Vec<Peak>], truth: &Run) -> HeightErrors {
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

/// The scene's finder on another program's images.
fn beside_figures(beside: &Beside, tiers: &Tiers, measured: &Measured) -> ChartFigures {
    let simulation = &tiers.list[0].simulation;
    let frames = beside.frames.iter();
    let peaks: Vec<_> = frames
        .map(|frame| simulation.peaks(&frame.image.counts).0)
        .collect();
    let times = beside.frames.iter().flat_map(|frame| &frame.ms);
    measured.figures(&beside.name, &times.copied().collect::<Vec<_>>(), &peaks)
}

fn rows(tiers: &Tiers, measured: &Measured) -> Vec<ChartRow> {
    let row = |(i, (tier, run)): (usize, (&Tier, &Run))| {
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
            predicted_ms: plan.accuracy.as_ref().map(|a| a.cost_ms),
            frames_per_s: 1e3 / ms,
            samples,
            ms_per_million_samples: samples.filter(|&n| n > 0.0).map(|n| ms / n * 1e6),
            memory_mb: tier.memory(pixels as usize) as f64 / 1e6,
            other_grains: tier.other_grains,
            on_front: false,
            chosen: i == tiers.chosen,
            plan,
        }
    };
    let pairs = tiers.list.iter().zip(measured.runs);
    pairs.enumerate().map(row).collect()
}

/// Marks those that no other is both faster and more accurate than.
fn mark_front(rows: &mut [ChartRow]) {
    let places: Vec<Option<(f64, f64)>> = rows
        .iter()
        .map(|row| {
            Some((row.figures.ms[1], row.figures.error.within_um?)).filter(|_| !row.other_grains)
        })
        .collect();
    for (row, place) in rows.iter_mut().zip(&places) {
        row.on_front = place.is_some_and(|(ms, um)| {
            let better = |other: &&(f64, f64)| {
                other.0 <= ms && other.1 <= um && (other.0 < ms || other.1 < um)
            };
            places.iter().flatten().find(better).is_none()
        });
    }
}

/// Of another program, of which no more is known than its times and what its lines are.
fn mark(figures: &ChartFigures) -> Mark {
    let error = &figures.error;
    Mark {
        name: figures.name.clone(),
        ms: figures.ms,
        speed_up: figures.speed_up,
        within_um: error.within_um,
        bias_um: error.bias_um,
        noise_um: error.noise_um,
        lost: error.lost,
        scatter_um: figures.scatter.as_ref().map(|s| s.noise_um),
        sigma_px: figures.line_sigma_px,
        contrast: figures.contrast,
        ms_per_million: None,
        memory_mb: None,
        on_front: false,
        chosen: false,
        hollow: false,
        other: true,
    }
}

impl Chart {
    /// What the chart says in words.
    pub fn headline(&self) -> String {
        let Some(row) = self.rows.iter().find(|row| row.chosen) else {
            return String::new();
        };
        let error = row.figures.error.within_um.map_or_else(
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
            on_front: row.on_front,
            chosen: row.chosen,
            hollow: row.other_grains,
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
            lead.push(format!("Chosen: {}.", in_words(&row.plan)));
            let accuracy = row.plan.accuracy.as_ref();
            lead.extend(accuracy.map(|a| format!("The plan says: {}.", a.statement)));
        }
        AccuracyChart {
            title: self.headline(),
            lead,
            tolerance_um: self.tolerance_um,
            limit_um: self.speckle_limit_um,
            marks: self.rows.iter().map(own).chain(beside).collect(),
        }
    }
}
