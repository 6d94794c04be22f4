//! A scan: frames are simulated in parallel and written to the journal. Cloud, summary and report
//! follow. The manifest is written last and marks a complete run.

use super::assessment::Assessment;
use super::cameras::Head;
use super::frames::{FrameContent, FrameRunner};
use super::journal::{Journal, RunKey};
use super::output_folder::{Claimed, Names, OutputFolder, remove_unfinished};
use super::report::ReportInput;
use super::resolved;
use super::setup;
use super::shards::{self, Shard};
use super::simulation::Simulation;
use super::summary::ScanSummary;
use super::warning_kind::Warning;
use super::warnings::{self, PreScanCheck};
use super::{RunControl, TraceMode, features, files, forecast, height_map, memory_estimate};
use crate::error::{Error, Result, printable};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::coverage::{ScanData, SensorPose, SurfaceCoverage, coverage};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::flags::count_flags;
use crate::inspect::tolerance::summarise_regions;
use crate::inspect::uncertainty::UncertaintyStatistics;
use crate::plan::rules::ModelConfig;
use crate::report::chart::short;
use crate::report::formats::{self, CloudFormat};
use crate::report::ply;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant, SystemTime};

/// Content of `manifest.json`: inputs, program version and timing of a run.
#[derive(Serialize)]
struct Manifest<'a> {
    program: &'static str,
    #[serde(serialize_with = "printable::in_json")]
    scene: &'a Path,
    #[serde(flatten)]
    key: &'a RunKey,
    /// Number of frames that an earlier run had finished.
    frames_resumed: u32,
    coverage: TraceMode,
    plan: &'a ModelConfig,
    threads: usize,
    /// End of the run, UTC.
    date: String,
    seconds_prepare: f64,
    seconds_frames: f64,
    seconds_report: f64,
}

/// Name of the profile file in the folder of a scan.
const PROFILES: &str = "profiles.npy";

/// Output of a scan in addition to its usual files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// Cloud in a format other than PLY.
    Cloud(CloudFormat),
    /// Height map: 16-bit images of height, position and intensity.
    HeightMap,
}

impl Export {
    /// All outputs in the order of the command line.
    pub const ALL: [Export; 4] = [
        Export::Cloud(CloudFormat::Csv),
        Export::Cloud(CloudFormat::E57),
        Export::Cloud(CloudFormat::Pcd),
        Export::HeightMap,
    ];

    /// Returns the name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Export::Cloud(format) => format.ending(),
            Export::HeightMap => "heightmap",
        }
    }

    /// Returns the names of the files.
    fn file_names(self) -> Vec<&'static str> {
        match self {
            Export::Cloud(format) => vec![format.file_name()],
            Export::HeightMap => height_map::FILES.to_vec(),
        }
    }
}

/// Options of a scan.
#[derive(Debug, Clone)]
pub struct ScanOptions {
    /// Trace mode.
    pub coverage: TraceMode,
    /// Half-open range of frames; `None` selects all.
    pub frames: Option<Range<u32>>,
    /// Whether frames that an earlier run finished are kept.
    pub resume: bool,
    /// Whether profiles are computed from laser rays and their visibility, without images.
    pub geometry_only: bool,
    /// Whether a scan that cannot give usable points is refused before it starts.
    pub strict: bool,
    /// Further outputs.
    pub also: Vec<Export>,
}

/// Simulates the frames and writes the results to `out`: `cloud.ply`, `profiles.npy`,
/// `summary.json`, `report.html`, `resolved-scene.toml`, `resolved-sensor.toml`, `frames.journal`,
/// `manifest.json`, and `frames/` if the scene requests it.
///
/// Files of an earlier run with these names are removed first. With `resume`, frames with a
/// complete record and image are kept. Other files are not changed ([`OutputFolder`]).
///
/// Memory does not grow with the number of frames during the simulation. The report reads all
/// points, about 100 bytes per point.
pub fn scan<'a>(
    scene: &Scene,
    options: &ScanOptions,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<ScanSummary> {
    match scene.cameras.is_empty() {
        true => {
            let frames = key(scene, options)?.frames.len() as u64;
            memory_estimate::require_scan(scene, frames, !options.geometry_only)?;
            let scan = scan_camera(scene, options, out.into(), control, None)?;
            Ok(scan.evaluated.summary)
        }
        false => scan_cameras(scene, options, out.into(), control),
    }
}

/// Scan of one camera with its points.
struct CameraScan {
    simulation: Simulation,
    evaluated: EvaluatedScan,
}

/// Simulates the frames of a scene with one camera as [`scan`]. `same_part` is a simulation of another
/// camera, whose hierarchy is used.
fn scan_camera(
    scene: &Scene,
    options: &ScanOptions,
    out: OutputFolder,
    control: &RunControl,
    same_part: Option<&Simulation>,
) -> Result<CameraScan> {
    let key = key(scene, options)?;
    let start = Instant::now();
    let early = match same_part {
        Some(first) => Some(further_simulation(first, scene, options)?),
        None => early_simulation(scene, options, &key.frames, control)?,
    };
    let key = key.with_rung(early.as_ref());
    scan_from(scene, options, (out, control), (start, early), key)
}

/// Scans with each camera, in the folders `camera-1`, `camera-2` and so on, and writes the cloud of
/// all cameras to `out`. Errors also include a height map, which one camera has.
fn scan_cameras(
    scene: &Scene,
    options: &ScanOptions,
    out: OutputFolder,
    control: &RunControl,
) -> Result<ScanSummary> {
    let key = key(scene, options)?;
    if options.also.contains(&Export::HeightMap) {
        return Err(Error::Usage(format!(
            "a height map of {}: found {} cameras, expected one: select it with --camera N",
            printable::path(&scene.path),
            scene.cameras.len()
        )));
    }
    // The points of all cameras are in memory for the report.
    let images = (key.frames.len() * scene.cameras.len()) as u64;
    memory_estimate::require_scan(scene, images, !options.geometry_only)?;
    let folder = out.claim(&scene.inputs, &names(scene, options, &key.frames))?;
    remove_results(&folder)?;
    let start = Instant::now();
    let of_camera = ScanOptions {
        strict: false,
        also: Vec::new(),
        ..options.clone()
    };
    let mut scans: Vec<CameraScan> = Vec::new();
    for (i, camera) in scene.cameras.iter().enumerate() {
        let path = folder.path.join(format!("camera-{}", camera.camera_number));
        let out = OutputFolder {
            path: &path,
            force: out.force,
        };
        let before = i as u64 * key.frames.len() as u64;
        let progress = |done| (control.progress)(before + done);
        let control = RunControl {
            progress: &progress,
            ..*control
        };
        let part = scans.first().map(|scan| &scan.simulation);
        scans.push(scan_camera(camera, &of_camera, out, &control, part)?);
    }
    let taken = Instant::now();
    let evaluated = evaluate_cameras(scene, &scans, &key.frames, (folder.path, control))?;
    let first = &scans[0].simulation;
    let cameras = scans.iter().map(|scan| scan.simulation.scene.clone());
    let resolved = Scene {
        cameras: cameras.collect(),
        ..scene.clone()
    };
    let EvaluatedScan { summary, .. } = finish(
        (first, &resolved),
        options,
        &key.frames,
        evaluated,
        (folder.path, control),
        run_table(&key, Duration::ZERO, taken - start, 0),
    )?;
    control.check()?;
    let manifest = Manifest {
        program: env!("CARGO_PKG_NAME"),
        scene: &scene.path,
        key: &key,
        frames_resumed: 0,
        coverage: options.coverage,
        plan: &first.plan,
        threads: rayon::current_num_threads(),
        date: date(),
        seconds_prepare: 0.0,
        seconds_frames: (taken - start).as_secs_f64(),
        seconds_report: taken.elapsed().as_secs_f64(),
    };
    files::write_json(&folder.path.join("manifest.json"), &manifest)?;
    warnings::refuse(&summary.warnings, options.strict)?;
    Ok(summary)
}

/// Simulates the frames as [`scan`]. `early` is the simulation of [`early_simulation`], whose
/// preparation began at `start`.
fn scan_from(
    scene: &Scene,
    options: &ScanOptions,
    (out, control): (OutputFolder, &RunControl),
    (start, early): (Instant, Option<Simulation>),
    key: RunKey,
) -> Result<CameraScan> {
    let frames = key.frames.clone();
    let fits = forecast::any_report_fits(scene, frames.len() as u64);
    let early = match early {
        None if !fits => Some(simulation_of(scene, options, control)?),
        early => early,
    };
    if let Some(simulation) = early.as_ref().filter(|_| !fits) {
        forecast::ensure_points_fit(simulation, &frames, control)?;
    }
    let folder = out.claim(&scene.inputs, &names(scene, options, &frames))?;
    let out = folder.path;
    let prepare = |kept| clear(scene, &folder, kept == 0);
    let (mut journal, kept) = Journal::open(out, &key, options.resume, prepare)?;
    let simulation = early.map_or_else(|| simulation_of(scene, options, control), Ok)?;
    let prepared = Instant::now();

    forecast::announce_long_scan(&simulation, frames.start + kept..frames.end, control)?;
    let run = FrameRunner {
        simulation: &simulation,
        out,
        control,
        unfinished: files::PART,
        done: AtomicU64::new(u64::from(kept)),
    };
    run.repair(&mut journal)?;
    run.frames(frames.start + kept..frames.end, &mut journal)?;
    let measured = Instant::now();

    let evaluated = evaluate(
        &simulation,
        &frames,
        points_of(&mut journal)?,
        (out, control),
    )?;
    let evaluated = finish(
        (&simulation, &simulation.scene),
        options,
        &frames,
        evaluated,
        (out, control),
        run_table(&key, prepared - start, measured - prepared, kept),
    )?;
    journal.sync()?;
    if scene.save_images {
        files::sync_all(out)?;
    }
    control.check()?;
    let manifest = Manifest {
        program: env!("CARGO_PKG_NAME"),
        scene: &scene.path,
        key: &key,
        frames_resumed: kept,
        coverage: options.coverage,
        plan: &simulation.plan,
        threads: rayon::current_num_threads(),
        date: date(),
        seconds_prepare: (prepared - start).as_secs_f64(),
        seconds_frames: (measured - prepared).as_secs_f64(),
        seconds_report: measured.elapsed().as_secs_f64(),
    };
    files::write_json(&out.join("manifest.json"), &manifest)?;
    warnings::refuse(&evaluated.summary.warnings, options.strict)?;
    Ok(CameraScan {
        simulation,
        evaluated,
    })
}

impl RunKey {
    /// Returns the key with the rung that a simulation chose.
    fn with_rung(self, simulation: Option<&Simulation>) -> RunKey {
        let accuracy = simulation.and_then(|simulation| simulation.plan.accuracy.as_ref());
        RunKey {
            rung: accuracy.map(|accuracy| accuracy.rung.to_owned()),
            ..self
        }
    }
}

/// Returns the inputs that determine the bytes of a scan, without the rung. Errors: frames outside
/// the scan; a request that geometric profiles cannot satisfy.
fn key(scene: &Scene, options: &ScanOptions) -> Result<RunKey> {
    let frames = options.frames.clone().unwrap_or(0..scene.scan.frames);
    super::check_frames(scene, &frames)?;
    check_averaged(scene, &frames)?;
    check_geometry(scene, options)?;
    Ok(RunKey {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        accel: scene.accel.version(),
        scene_sha256: scene.hash.clone(),
        seed: scene.seed,
        frames,
        geometry_only: options.geometry_only,
        rung: None,
    })
}

/// Summary of a shard of a scan.
#[derive(Debug, Clone, Serialize)]
pub struct ShardSummary {
    /// Index of the shard and number of shards.
    #[serde(flatten)]
    pub shard: Shard,
    /// Hash of scene, mesh, version and numerics. All shards of a scan have one value.
    pub job: String,
    /// Number of frames in the shard.
    pub frames: u32,
    /// Number of frames that this run simulated; 0 if an earlier run had finished the shard.
    pub frames_taken: u32,
}

/// Simulates the frames I, I + N, … of a scan for shard I of N, into a folder that all shards use.
/// Shards may run concurrently, on several machines, or repeatedly. [`merge`] combines them into
/// the result of [`scan`].
///
/// An interrupted shard starts from its beginning. Memory does not grow with the number of frames.
pub fn scan_shard<'a>(
    scene: &Scene,
    options: &ScanOptions,
    shard: Shard,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<ShardSummary> {
    let key = key(scene, options)?;
    let early = early_simulation(scene, options, &key.frames, control)?;
    let key = key.with_rung(early.as_ref());
    let simulation = early.map_or_else(|| simulation_of(scene, options, control), Ok)?;
    let names = shard_names(scene, shard.of, &key.frames);
    let folder = out.into().claim(&scene.inputs, &names)?;
    let out = folder.path;
    folder.remove("manifest.json")?;
    if scene.save_images {
        files::create_own_folder(&out.join("frames"))?;
    }
    forecast::announce_long_scan(&simulation, shard.frames(&key.frames), control)?;
    let unfinished = shards::unfinished();
    let run = FrameRunner {
        simulation: &simulation,
        out,
        control,
        unfinished: &unfinished,
        done: AtomicU64::new(0),
    };
    Ok(ShardSummary {
        shard,
        job: key.job(),
        frames: shard.frames(&key.frames).count() as u32,
        frames_taken: shards::take(&run, shard, &key)?,
    })
}

/// Combines the shards in a folder into the byte-identical result of the undivided scan. Checks
/// every record, simulates frames with damaged or lost images again, and writes cloud, report and
/// summary.
///
/// # Errors
/// As [`scan`]; and `Error::Input` with the shards that are missing or damaged.
pub fn merge<'a>(
    scene: &Scene,
    options: &ScanOptions,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<ScanSummary> {
    let (key, out) = (key(scene, options)?, out.into());
    memory_estimate::require_scan(scene, key.frames.len() as u64, !options.geometry_only)?;
    let start = Instant::now();
    let early = early_simulation(scene, options, &key.frames, control)?;
    let key = key.with_rung(early.as_ref());
    let whole = shards::all_whole(out.path, &key)?;
    let of = whole.len() as u32;
    let names = names(scene, options, &key.frames);
    let folder = out.claim(&scene.inputs, &names)?;
    shards::merge(out.path, &key, whole, || folder.remove("manifest.json"))?;
    let options = ScanOptions {
        resume: true,
        ..options.clone()
    };
    let range = key.frames.clone();
    let done = scan_from(scene, &options, (out, control), (start, early), key)?;
    // Removes unfinished files of killed runs.
    remove_unfinished(out.path, &shard_names(scene, of, &range))?;
    Ok(done.evaluated.summary)
}

fn simulation_of(scene: &Scene, options: &ScanOptions, control: &RunControl) -> Result<Simulation> {
    match options.geometry_only {
        true => {
            let (scene, accel) = setup::hierarchy_watched(scene, control)?;
            Simulation::geometry_only(&scene, accel)
        }
        false => setup::simulation(scene, options.coverage, control),
    }
}

/// Returns the simulation of a further camera, which uses the hierarchy of the first one.
fn further_simulation(
    first: &Simulation,
    scene: &Scene,
    options: &ScanOptions,
) -> Result<Simulation> {
    if !options.geometry_only {
        return first.reusing_part(scene);
    }
    let scene = setup::with_auto_exposure(scene, &first.accel);
    Simulation::geometry_only(&scene, first.accel.clone())
}

/// Returns the simulation if it is required before files of an earlier run are removed. A strict
/// scan is refused if it cannot give usable points, and the key of a scene with a tolerance has the
/// chosen rung.
fn early_simulation(
    scene: &Scene,
    options: &ScanOptions,
    frames: &Range<u32>,
    control: &RunControl,
) -> Result<Option<Simulation>> {
    if !options.strict && scene.tolerance_um.is_none() {
        return Ok(None);
    }
    let simulation = simulation_of(scene, options, control)?;
    if options.strict {
        let PreScanCheck { warnings, .. } = warnings::foreseen_of(&simulation, frames.clone());
        warnings::refuse(&warnings, true)?;
    }
    Ok(Some(simulation))
}

/// Names of the files that every scan writes. The manifest is removed first, because a run without
/// it is incomplete.
const FILES: [&str; 10] = [
    "manifest.json",
    "summary.json",
    "report.html",
    "cloud.ply",
    PROFILES,
    features::TABLE,
    resolved::SCENE,
    resolved::SENSOR,
    "frame.png",
    "cloud.png",
];

/// Returns the names of all files that a scan writes.
fn names(scene: &Scene, options: &ScanOptions, frames: &Range<u32>) -> Names {
    let also = options.also.iter().flat_map(|also| also.file_names());
    let files = FILES.into_iter().chain(["frames.journal"]).chain(also);
    with_images(Names::of(files), scene, frames)
}

/// Returns the names of all files that the shards of a scan write.
fn shard_names(scene: &Scene, of: u32, frames: &Range<u32>) -> Names {
    let after = format!("-of-{of}.journal");
    let journals = Names::default().and("shards/shard-", 1, &after, 0..of.into());
    with_images(journals, scene, frames)
}

fn with_images(names: Names, scene: &Scene, frames: &Range<u32>) -> Names {
    match scene.save_images {
        true => names.and(
            "frames/frame-",
            6,
            ".png",
            frames.start.into()..frames.end.into(),
        ),
        false => names,
    }
}

/// Removes the results of an earlier run.
fn remove_results(folder: &Claimed) -> Result<()> {
    let also = Export::ALL.into_iter().flat_map(Export::file_names);
    for name in FILES.into_iter().chain(also) {
        folder.remove(name)?;
    }
    Ok(())
}

/// Removes the files of an earlier run and creates the folder for frames. A new run also removes
/// the earlier frames.
fn clear(scene: &Scene, folder: &Claimed, anew: bool) -> Result<()> {
    remove_results(folder)?;
    if anew {
        folder.remove_in("frames")?;
    }
    if scene.save_images {
        files::create_own_folder(&folder.path.join("frames"))?;
    }
    Ok(())
}

/// Returns the points of all frames, and the fraction with wide lens blur.
fn points_of(journal: &mut Journal) -> Result<(Vec<CloudPoint>, Option<f64>)> {
    let (mut points, mut blurred) = (Vec::new(), 0);
    journal.each(|record| {
        points.extend(record.points);
        blurred += record.blurred;
        Ok(())
    })?;
    let share = defocused_fraction(blurred, points.len());
    Ok((points, share))
}

/// Results of a scan after its points are compared with the CAD surface.
struct EvaluatedScan {
    points: Vec<CloudPoint>,
    poses: Vec<SensorPose>,
    summary: ScanSummary,
}

/// Compares the points of all frames with the CAD surface and computes the summary.
fn evaluate(
    simulation: &Simulation,
    frames: &Range<u32>,
    (points, defocused_fraction): (Vec<CloudPoint>, Option<f64>),
    (out, control): (&Path, &RunControl),
) -> Result<EvaluatedScan> {
    let scene = &simulation.scene;
    let measured = points.len();
    let mut points = simulation.scan_points(frames, points, |frame| {
        control.check()?;
        Ok(FrameContent::of(simulation, frame).points)
    })?;
    let alignment = simulation.align(&mut points);
    control.check()?;
    let poses = frames.clone().map(|frame| simulation.head_pose(frame));
    let poses: Vec<SensorPose> = poses.collect();
    let coverage = coverage(&ScanData {
        accel: simulation.accel.nominal(),
        objects: scene.part_triangles.map(|part| (&*simulation.accel, part)),
        laser: &scene.laser,
        camera: &scene.camera,
        first_frame: frames.start,
        poses: &poses,
        points: &points,
    });
    control.check()?;
    let uncertainty =
        UncertaintyStatistics::of(&points, simulation.correlation_over_profiles(&points));
    let mut summary = ScanSummary {
        means: features::means(&points, simulation),
        uncertainty,
        ..summary(scene, frames, (&points, measured), out)
    };
    let PreScanCheck {
        assessment,
        warnings,
        ..
    } = warnings::foreseen_of(simulation, frames.clone());
    summary.assessment = assessment;
    summary.warnings = warnings::found(
        &points,
        frames.len(),
        &warnings,
        scene.warnings.lost_fraction,
    );
    summary.alignment = alignment;
    summary.tolerance = summarise_regions(&scene.bands, &points, coverage.as_ref());
    summary.features = simulation.features(&points);
    summary.accuracy = simulation.plan.accuracy.clone();
    summary.coverage = coverage;
    summary.defocused_fraction = defocused_fraction;
    Ok(EvaluatedScan {
        points,
        poses,
        summary,
    })
}

/// Returns the summary of a scan of these frames without writing files.
pub fn scan_summary(
    simulation: &Simulation,
    frames: &Range<u32>,
    control: &RunControl,
) -> Result<ScanSummary> {
    let contents = frames.clone().into_par_iter().map(|frame| {
        control.check()?;
        Ok(FrameContent::of(simulation, frame))
    });
    let mut all = Vec::new();
    let mut blurred = 0;
    for content in contents.collect::<Result<Vec<_>>>()? {
        all.extend(content.points);
        blurred += content.blurred;
    }
    let share = defocused_fraction(blurred, all.len());
    let judged = evaluate(simulation, frames, (all, share), (Path::new(""), control))?;
    Ok(judged.summary)
}

fn defocused_fraction(blurred: u32, points: usize) -> Option<f64> {
    (points > 0).then(|| f64::from(blurred) / points as f64)
}

/// Returns the points of all cameras with their summary. The assessment before the scan is of the
/// first camera, and the warnings are of all cameras.
fn evaluate_cameras(
    scene: &Scene,
    scans: &[CameraScan],
    frames: &Range<u32>,
    (out, control): (&Path, &RunControl),
) -> Result<EvaluatedScan> {
    let head = Head::of(scans.iter().map(|scan| &scan.simulation));
    let first = &scans[0].simulation;
    let of_cameras: Vec<&[CloudPoint]> = scans.iter().map(|scan| &*scan.evaluated.points).collect();
    let mut points = head.merged(&of_cameras, frames);
    control.check()?;
    let alignment = match scene.measure.align {
        true => first.fit_to_cad(&mut points),
        false => None,
    };
    let valid = points.iter().filter(|point| point.is_valid()).count();
    let coverages = scans
        .iter()
        .map(|scan| scan.evaluated.summary.coverage.as_ref());
    let coverages = coverages.collect::<Option<Vec<_>>>();
    let coverage = coverages.and_then(|all| SurfaceCoverage::of_cameras(&all, valid));
    let typical = head.of_one_camera(&points);
    let correlation = typical.0.correlation_over_profiles(&typical.1);
    let summaries = || scans.iter().map(|scan| &scan.evaluated.summary);
    let measured = points.len();
    let mut summary = ScanSummary {
        means: features::means(&points, &head),
        uncertainty: UncertaintyStatistics::of(&points, correlation),
        ..summary(scene, frames, (&points, measured), out)
    };
    summary.columns = head.columns();
    summary.measured_fraction =
        measured as f64 / (f64::from(summary.columns) * frames.len() as f64);
    summary.assessment = scans[0].evaluated.summary.assessment.clone();
    let all = scans.iter().flat_map(|scan| {
        let number = scan.simulation.scene.camera_number;
        let warnings = scan.evaluated.summary.warnings.iter();
        warnings.map(move |warning| Warning {
            message: format!("camera {number}: {}", warning.message),
            ..warning.clone()
        })
    });
    summary.warnings = all.collect();
    summary.alignment = alignment;
    summary.tolerance = summarise_regions(&scene.bands, &points, coverage.as_ref());
    summary.features = first.features_with(&points, &head);
    summary.accuracy = first.plan.accuracy.clone();
    summary.coverage = coverage;
    let blurred = summaries().map(|s| s.defocused_fraction.unwrap_or(0.0) * s.points as f64);
    let total: usize = summaries().map(|s| s.points).sum();
    summary.defocused_fraction = (total > 0).then(|| blurred.sum::<f64>() / total as f64);
    Ok(EvaluatedScan {
        points,
        poses: scans[0].evaluated.poses.clone(),
        summary,
    })
}

/// Writes cloud, images, report and summary from the points of all frames. The pictures of frames are
/// from `simulation`, and the resolved scene is that of `scene`.
fn finish(
    (simulation, scene): (&Simulation, &Scene),
    options: &ScanOptions,
    frames: &Range<u32>,
    evaluated: EvaluatedScan,
    (out, control): (&Path, &RunControl),
    run: Vec<(&'static str, String)>,
) -> Result<EvaluatedScan> {
    let EvaluatedScan {
        points,
        poses,
        mut summary,
    } = evaluated;
    let write_points = || -> Result<()> {
        files::write(&summary.cloud, |file| {
            ply::write_ply(file, &points, &scene.bands)
        })?;
        files::write(&out.join(PROFILES), |file| formats::npy(file, &points))?;
        if !summary.features.is_empty() {
            files::write(&out.join(features::TABLE), |file| {
                features::write_csv(file, &summary.features)
            })?;
        }
        for also in &options.also {
            control.check()?;
            match also {
                Export::Cloud(format) => files::write(&out.join(format.file_name()), |file| {
                    format.write(file, &points)
                })?,
                Export::HeightMap => {
                    height_map::write(simulation, frames, &points, summary.alignment.as_ref(), out)?
                }
            }
        }
        resolved::write(scene, out)
    };
    let shown = ReportInput {
        simulation,
        points: &points,
        frames: frames.clone(),
        poses: &poses,
        images: !simulation.plan.geometry_only,
        summary: &summary,
        run,
    };
    let (written, report) = rayon::join(write_points, || shown.report(control));
    written?;
    let report = report?;
    let frame = report.frames.first().map(|frame| &frame.png);
    let cloud = report.maps.first().and_then(|map| map.views.get(1));
    let cloud = cloud.map(|(_, png)| png);
    for (name, png) in [("frame.png", frame), ("cloud.png", cloud)] {
        if let Some(png) = png {
            let path = out.join(name);
            files::write_bytes(&path, png)?;
            summary.pictures.push(path);
        }
    }
    files::write_bytes(&summary.report, report.html().as_bytes())?;
    files::write_json(&out.join("summary.json"), &summary)?;
    Ok(EvaluatedScan {
        points,
        poses,
        summary,
    })
}

/// Returns the statistics of the points in a summary. `measured` is the number of points before
/// filtering.
fn summary(
    scene: &Scene,
    frames: &Range<u32>,
    (points, measured): (&[CloudPoint], usize),
    out: &Path,
) -> ScanSummary {
    let columns = scene.camera.sensor.resolution.x;
    let valid = points.iter().filter(|p| p.is_valid());
    let flags = count_flags(points).into_iter();
    ScanSummary {
        scene: scene.path.clone(),
        frames: frames.len() as u32,
        columns,
        measured_fraction: measured as f64 / (columns as f64 * frames.len() as f64),
        points: points.len(),
        valid_fraction: (!points.is_empty())
            .then(|| valid.clone().count() as f64 / points.len() as f64),
        defocused_fraction: None,
        deviation: DeviationStatistics::of(valid.map(|p| p.deviation)),
        deviation_including_flagged: DeviationStatistics::of(points.iter().map(|p| p.deviation)),
        uncertainty: None,
        means: Vec::new(),
        mesh_ignored: scene.mesh_ignored.to_vec(),
        filters: scene.measure.filters,
        flags: flags.map(|flag| (flag.name, flag.points)).collect(),
        tolerance: Vec::new(),
        features: Vec::new(),
        alignment: None,
        accuracy: None,
        coverage: None,
        assessment: Assessment::default(),
        warnings: Vec::new(),
        cloud: out.join("cloud.ply"),
        report: out.join("report.html"),
        pictures: Vec::new(),
    }
}

/// Refuses a piece of a scan with incomplete groups of averaged frames.
pub(super) fn check_averaged(scene: &Scene, frames: &Range<u32>) -> Result<()> {
    let count = scene.measure.filters.average_frames;
    let starts = |frame: u32| frame.is_multiple_of(count) || frame == scene.scan.frames;
    match starts(frames.start) && starts(frames.end) {
        true => Ok(()),
        false => Err(Error::Usage(format!(
            "frames {}..{} of {}: expected them to begin and end at multiples of {count}, as \
             measure.average_frames makes one profile of {count} frames",
            frames.start,
            frames.end,
            scene.path.display()
        ))),
    }
}

/// Refuses requests that geometric profiles cannot satisfy.
fn check_geometry(scene: &Scene, options: &ScanOptions) -> Result<()> {
    let needs = match scene.laser.fan {
        _ if !options.geometry_only => return Ok(()),
        None => "a line laser (laser.line)",
        Some(_) if scene.save_images => "a scene without save_images, as there are none",
        Some(_) => return Ok(()),
    };
    let path = scene.path.display();
    Err(Error::Usage(format!(
        "geometry alone on {path}: expected {needs}"
    )))
}

/// Returns the current time in UTC.
fn date() -> String {
    humantime::format_rfc3339_seconds(SystemTime::now()).to_string()
}

/// Returns the table of run data for the report.
fn run_table(
    key: &RunKey,
    preparing: Duration,
    taking: Duration,
    kept: u32,
) -> Vec<(&'static str, String)> {
    let rate = (key.frames.len() as u32 - kept) as f64 / taking.as_secs_f64();
    let seconds = |duration: Duration| format!("{} s", short(duration.as_secs_f64()));
    vec![
        ("date", date()),
        ("lasertrace", key.version.clone()),
        ("intersection", key.accel.clone()),
        ("scene", format!("SHA-256 {}", key.scene_sha256)),
        ("seed", key.seed.to_string()),
        ("threads", rayon::current_num_threads().to_string()),
        ("preparing", seconds(preparing)),
        (
            "frames",
            format!("{}, {} frames a second", seconds(taking), short(rate)),
        ),
    ]
}
