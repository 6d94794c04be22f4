//! A scan: frames in parallel, each into the journal, then cloud, summary, report and, last of
//! all, the manifest that says the run is complete.

use super::assessment::Assessment;
use super::frames::{FrameContent, Run};
use super::journal::{Journal, RunKey};
use super::output_folder::{Claimed, Names, OutputFolder, remove_unfinished};
use super::ready;
use super::report::Shown;
use super::resolved;
use super::shards::{self, Shard};
use super::simulation::Simulation;
use super::summary::ScanSummary;
use super::warnings::{self, Foreseen};
use super::{Control, Coverage, files, forecast, need};
use crate::error::{Error, Result, printable};
use crate::inspect::align::{Alignment, best_fit};
use crate::inspect::bands::sum_up;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::coverage::{HeadPose, Scanned, coverage};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::flags::count_flags;
use crate::inspect::uncertainty::UncertaintyStatistics;
use crate::math::DVec3;
use crate::plan::rules::Plan;
use crate::report::chart::short;
use crate::report::formats::{self, Format};
use crate::report::ply;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant, SystemTime};

/// `manifest.json`: what was run, with what, and how long it took.
#[derive(Serialize)]
struct Manifest<'a> {
    program: &'static str,
    #[serde(serialize_with = "printable::in_json")]
    scene: &'a Path,
    #[serde(flatten)]
    key: &'a RunKey,
    /// Frames that an earlier run had finished.
    frames_kept: u32,
    coverage: Coverage,
    plan: &'a Plan,
    threads: usize,
    /// When the run ended, UTC.
    date: String,
    seconds_prepare: f64,
    seconds_frames: f64,
    seconds_report: f64,
}

/// Name of the profiles' file in the folder of a scan.
const PROFILES: &str = "profiles.npy";

/// What of a scan to run, and how.
#[derive(Debug, Clone)]
pub struct ScanOptions {
    /// Which pixels are traced.
    pub coverage: Coverage,
    /// Half-open; `None`: all.
    pub frames: Option<Range<u32>>,
    /// Keep the frames that an earlier run finished.
    pub resume: bool,
    /// No images: profiles from laser rays and what the camera sees of them.
    pub geometry_only: bool,
    /// A scan that cannot give anything worth having is an error, before it starts.
    pub strict: bool,
    /// Forms of the cloud beside PLY.
    pub also: Vec<Format>,
}

/// Runs the frames and writes `cloud.ply`, `profiles.npy`, `summary.json`, `report.html`, `resolved-scene.toml`,
/// `resolved-sensor.toml`, `frames.journal` and `manifest.json` to `out`, and `frames/` if
/// the scene asks for them. Files that an earlier run wrote under these names are removed
/// first, but with `resume` not the frames whose record and image are complete. Other files
/// are not touched ([`OutputFolder`]).
///
/// While frames are taken, memory does not grow with their number; for the report
/// all points are read back, some 100 bytes each.
pub fn scan<'a>(
    scene: &Scene,
    options: &ScanOptions,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<ScanSummary> {
    let start = Instant::now();
    let key = key(scene, options)?;
    let frames = key.frames.clone();
    need::require_scan(scene, frames.len() as u64, !options.geometry_only)?;
    let strict = strict_simulation(scene, options, &frames, control)?;
    if !forecast::any_report_fits(scene, frames.len() as u64) {
        forecast::require_points(&simulation_of(scene, options, control)?, &frames, control)?;
    }
    let folder = out
        .into()
        .claim(&scene.inputs, &names(scene, options, &frames))?;
    let out = folder.path;
    let prepare = |kept| clear(scene, &folder, kept == 0);
    let (mut journal, kept) = Journal::open(out, &key, options.resume, prepare)?;
    let simulation = strict.map_or_else(|| simulation_of(scene, options, control), Ok)?;
    let prepared = Instant::now();

    let run = Run {
        simulation: &simulation,
        out,
        control,
        unfinished: files::PART,
        done: AtomicU64::new(u64::from(kept)),
    };
    run.repair(&mut journal)?;
    run.frames(frames.start + kept..frames.end, &mut journal)?;
    let measured = Instant::now();

    let summary = finish(
        &simulation,
        options,
        &frames,
        &mut journal,
        (out, control),
        run_table(&key, prepared - start, measured - prepared, kept),
    )?;
    journal.sync()?;
    if scene.write_frames {
        files::sync_all(out)?;
    }
    control.check()?;
    let manifest = Manifest {
        program: env!("CARGO_PKG_NAME"),
        scene: &scene.path,
        key: &key,
        frames_kept: kept,
        coverage: options.coverage,
        plan: &simulation.plan,
        threads: rayon::current_num_threads(),
        date: date(),
        seconds_prepare: (prepared - start).as_secs_f64(),
        seconds_frames: (measured - prepared).as_secs_f64(),
        seconds_report: measured.elapsed().as_secs_f64(),
    };
    files::write_json(&out.join("manifest.json"), &manifest)?;
    warnings::refuse(&summary.warnings, options.strict)?;
    Ok(summary)
}

/// What the bytes of a scan depend on. Errors: frames that the scene does not have; what geometry alone
/// cannot give.
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
    })
}

/// What a shard of a scan has done.
#[derive(Debug, Clone, Serialize)]
pub struct ShardSummary {
    /// Which of how many.
    #[serde(flatten)]
    pub shard: Shard,
    /// Of the scan's scene, mesh, version and numerics: all its shards have the same.
    pub job: String,
    /// That it has.
    pub frames: u32,
    /// That were taken now; none, if an earlier run had finished the shard.
    pub frames_taken: u32,
}

/// Takes the frames I, I + N, … of a scan for shard I of N, into a folder that all shards share; they
/// may run at once and on several machines, and one may run twice. [`merge`] makes of them what [`scan`] gives.
/// A shard that is stopped starts anew; memory does not grow with the number of frames.
pub fn scan_shard<'a>(
    scene: &Scene,
    options: &ScanOptions,
    shard: Shard,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<ShardSummary> {
    let key = key(scene, options)?;
    let strict = strict_simulation(scene, options, &key.frames, control)?;
    let simulation = strict.map_or_else(|| simulation_of(scene, options, control), Ok)?;
    let names = shard_names(scene, shard.of, &key.frames);
    let folder = out.into().claim(&scene.inputs, &names)?;
    let out = folder.path;
    folder.remove("manifest.json")?;
    if scene.write_frames {
        files::create_own_folder(&out.join("frames"))?;
    }
    let unfinished = shards::unfinished();
    let run = Run {
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

/// Makes of the shards in a folder what the undivided scan gives, to the byte: checks every record, takes
/// frames again whose images are damaged or lost, and writes cloud, report and summary.
///
/// # Errors
/// As [`scan`]; and `Error::Input` that names the shards that are missing or damaged.
pub fn merge<'a>(
    scene: &Scene,
    options: &ScanOptions,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<ScanSummary> {
    let (key, out) = (key(scene, options)?, out.into());
    let whole = shards::all_whole(out.path, &key)?;
    let of = whole.len() as u32;
    let names = names(scene, options, &key.frames);
    let folder = out.claim(&scene.inputs, &names)?;
    shards::merge(out.path, &key, whole, || folder.remove("manifest.json"))?;
    let options = ScanOptions {
        resume: true,
        ..options.clone()
    };
    let summary = scan(scene, &options, out, control)?;
    // Unfinished files of killed runs.
    remove_unfinished(out.path, &shard_names(scene, of, &key.frames))?;
    Ok(summary)
}

fn simulation_of(scene: &Scene, options: &ScanOptions, control: &Control) -> Result<Simulation> {
    match options.geometry_only {
        true => {
            let (scene, accel) = ready::hierarchy_watched(scene, control)?;
            Simulation::of_geometry(&scene, accel)
        }
        false => ready::simulation(scene, options.coverage, control),
    }
}

/// If the scan is strict, its simulation, unless that will give nothing worth having: this is refused while
/// what an earlier run left is still there.
fn strict_simulation(
    scene: &Scene,
    options: &ScanOptions,
    frames: &Range<u32>,
    control: &Control,
) -> Result<Option<Simulation>> {
    if !options.strict {
        return Ok(None);
    }
    let simulation = simulation_of(scene, options, control)?;
    let Foreseen { warnings, .. } = warnings::foreseen_of(&simulation, frames.clone());
    warnings::refuse(&warnings, true)?;
    Ok(Some(simulation))
}

/// Files that every scan writes. The manifest is removed first: without it a run is not complete.
const FILES: [&str; 9] = [
    "manifest.json",
    "summary.json",
    "report.html",
    "cloud.ply",
    PROFILES,
    resolved::SCENE,
    resolved::SENSOR,
    "frame.png",
    "cloud.png",
];

/// All files that a scan writes.
fn names(scene: &Scene, options: &ScanOptions, frames: &Range<u32>) -> Names {
    let also = options.also.iter().copied().map(Format::file_name);
    let files = FILES.into_iter().chain(["frames.journal"]).chain(also);
    with_images(Names::of(files), scene, frames)
}

/// All files that the shards of a scan write.
fn shard_names(scene: &Scene, of: u32, frames: &Range<u32>) -> Names {
    let after = format!("-of-{of}.journal");
    let journals = Names::default().and("shards/shard-", 1, &after, 0..of.into());
    with_images(journals, scene, frames)
}

fn with_images(names: Names, scene: &Scene, frames: &Range<u32>) -> Names {
    match scene.write_frames {
        true => names.and(
            "frames/frame-",
            6,
            ".png",
            frames.start.into()..frames.end.into(),
        ),
        false => names,
    }
}

/// Makes the folder for frames, free of an earlier run's files if this
/// one starts `anew`.
fn clear(scene: &Scene, folder: &Claimed, anew: bool) -> Result<()> {
    for name in FILES.into_iter().chain(Format::ALL.map(Format::file_name)) {
        folder.remove(name)?;
    }
    if anew {
        folder.remove_in("frames")?;
    }
    if scene.write_frames {
        files::create_own_folder(&folder.path.join("frames"))?;
    }
    Ok(())
}

/// The points of all frames, and the share of them that the lens would blur widely.
fn points_of(journal: &mut Journal) -> Result<(Vec<CloudPoint>, Option<f64>)> {
    let (mut points, mut blurred) = (Vec::new(), 0);
    journal.each(|record| {
        points.extend(record.points);
        blurred += record.blurred;
        Ok(())
    })?;
    let share = blurred_share(blurred, points.len());
    Ok((points, share))
}

/// What is known of a scan when its points have been compared with the CAD.
struct Judged {
    points: Vec<CloudPoint>,
    poses: Vec<HeadPose>,
    summary: ScanSummary,
}

/// Compares the points of all frames with the CAD, and sums up.
fn judge(
    simulation: &Simulation,
    frames: &Range<u32>,
    (mut points, blurred_share): (Vec<CloudPoint>, Option<f64>),
    (out, control): (&Path, &Control),
) -> Result<Judged> {
    let scene = &simulation.scene;
    simulation.compare_piece(frames, &mut points, |frame| {
        control.check()?;
        Ok(FrameContent::of(simulation, frame).points)
    })?;
    let measured = points.len();
    let mut points = simulation.delivered(points);
    let alignment = align(simulation, &mut points);
    control.check()?;
    let poses = frames.clone().map(|frame| simulation.head_pose(frame));
    let poses: Vec<HeadPose> = poses.collect();
    let coverage = coverage(&Scanned {
        accel: &simulation.accel,
        laser: &scene.laser,
        camera: &scene.camera,
        first_frame: frames.start,
        poses: &poses,
        points: &points,
    });
    control.check()?;
    let mut summary = summary(simulation, frames, (&points, measured), out);
    let Foreseen {
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
    summary.tolerance = sum_up(&scene.bands, &points, coverage.as_ref());
    summary.accuracy = simulation.plan.accuracy.clone();
    summary.coverage = coverage;
    summary.blurred_share = blurred_share;
    Ok(Judged {
        points,
        poses,
        summary,
    })
}

/// What a scan of these frames gives in numbers; no file is written.
pub fn summed_up(
    simulation: &Simulation,
    frames: &Range<u32>,
    control: &Control,
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
    let share = blurred_share(blurred, all.len());
    let judged = judge(simulation, frames, (all, share), (Path::new(""), control))?;
    Ok(judged.summary)
}

fn blurred_share(blurred: u32, points: usize) -> Option<f64> {
    (points > 0).then(|| f64::from(blurred) / points as f64)
}

/// From the points of all frames to cloud, pictures, report and summary.
fn finish(
    simulation: &Simulation,
    options: &ScanOptions,
    frames: &Range<u32>,
    journal: &mut Journal,
    (out, control): (&Path, &Control),
    run: Vec<(&'static str, String)>,
) -> Result<ScanSummary> {
    let Judged {
        points,
        poses,
        mut summary,
    } = judge(simulation, frames, points_of(journal)?, (out, control))?;
    let write_points = || -> Result<()> {
        files::write(&summary.cloud, |file| {
            ply::write_ply(file, &points, &simulation.scene.bands)
        })?;
        files::write(&out.join(PROFILES), |file| formats::npy(file, &points))?;
        for format in &options.also {
            control.check()?;
            files::write(&out.join(format.file_name()), |file| {
                format.write(file, &points)
            })?;
        }
        resolved::write(&simulation.scene, out)
    };
    let shown = Shown {
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
    Ok(summary)
}

/// Brings the cloud onto the CAD if the scene asks for it. Doubtful points move
/// along, but say nothing.
fn align(simulation: &Simulation, points: &mut [CloudPoint]) -> Option<Alignment> {
    if !simulation.scene.measure.align {
        return None;
    }
    let valid = points.iter().filter(|p| p.is_valid());
    let positions: Vec<DVec3> = valid.map(|p| p.position).collect();
    let fit = best_fit(&simulation.accel, &positions)?;
    points
        .par_iter_mut()
        .for_each(|point| *point = simulation.moved(point, &fit.part_from_measured));
    Some(fit)
}

/// `measured`: points before profiles were filtered.
fn summary(
    simulation: &Simulation,
    frames: &Range<u32>,
    (points, measured): (&[CloudPoint], usize),
    out: &Path,
) -> ScanSummary {
    let scene = &simulation.scene;
    let columns = scene.camera.sensor.resolution.x;
    let valid = points.iter().filter(|p| p.is_valid());
    let flags = count_flags(points).into_iter();
    ScanSummary {
        scene: scene.path.clone(),
        frames: frames.len() as u32,
        columns,
        measured_share: measured as f64 / (columns as f64 * frames.len() as f64),
        points: points.len(),
        valid_fraction: (!points.is_empty())
            .then(|| valid.clone().count() as f64 / points.len() as f64),
        blurred_share: None,
        deviation: DeviationStatistics::of(valid.map(|p| p.deviation)),
        deviation_of_all: DeviationStatistics::of(points.iter().map(|p| p.deviation)),
        uncertainty: UncertaintyStatistics::of(
            points,
            simulation.correlation_over_profiles(points),
        ),
        mesh_ignored: scene.mesh_ignored.to_vec(),
        filters: scene.measure.filters,
        flags: flags.map(|flag| (flag.name, flag.points)).collect(),
        tolerance: Vec::new(),
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

/// Profiles are averaged in groups of frames: a piece of a scan has whole ones.
fn check_averaged(scene: &Scene, frames: &Range<u32>) -> Result<()> {
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

/// What geometry alone cannot give.
fn check_geometry(scene: &Scene, options: &ScanOptions) -> Result<()> {
    let needs = match scene.laser.fan {
        _ if !options.geometry_only => return Ok(()),
        None => "a line laser (laser.line)",
        Some(_) if scene.write_frames => "a scene without write_frames, as there are none",
        Some(_) => return Ok(()),
    };
    let path = scene.path.display();
    Err(Error::Usage(format!(
        "geometry alone on {path}: expected {needs}"
    )))
}

/// Of now, in UTC.
fn date() -> String {
    humantime::format_rfc3339_seconds(SystemTime::now()).to_string()
}

/// What the report says of the run.
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
