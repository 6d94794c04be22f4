//! A scan: frames in parallel, each into the journal, then cloud, summary, report and, last of
//! all, the manifest that says the run is complete.

use super::frames::Run;
use super::journal::{Journal, RunKey};
use super::{Control, Coverage, Simulation, files};
use crate::accel;
use crate::error::Result;
use crate::inspect::chart::short;
use crate::inspect::cloud::{self, CloudPoint};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::picture::{ParallelView, cloud_picture, encode_for_eyes};
use crate::inspect::report::{Report, SampleFrame};
use crate::math::DVec3;
use crate::profile::find_peaks;
use crate::scene::Scene;
use serde::Serialize;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct ScanSummary {
    pub scene: PathBuf,
    pub frames: u32,
    pub columns: u32,
    /// Share of all columns of all frames in which a point was measured.
    pub measured_share: f64,
    /// `null` if nothing was measured.
    pub deviation: Option<DeviationStatistics>,
    pub cloud: PathBuf,
    pub report: PathBuf,
    /// The frame shown in the report, and the cloud over the part.
    pub pictures: [PathBuf; 2],
}

/// `manifest.json`: what was run, with what, and how long it took.
#[derive(Serialize)]
struct Manifest<'a> {
    program: &'static str,
    scene: &'a Path,
    #[serde(flatten)]
    key: &'a RunKey,
    /// Frames that an earlier run had finished.
    frames_kept: usize,
    coverage: Coverage,
    threads: usize,
    seconds_prepare: f64,
    seconds_frames: f64,
    seconds_report: f64,
}

/// What of a scan to run, and how.
#[derive(Debug, Clone)]
pub struct ScanOptions {
    pub coverage: Coverage,
    /// Half-open; `None`: all.
    pub frames: Option<Range<u32>>,
    /// Keep the frames that an earlier run finished.
    pub resume: bool,
}

/// Runs the frames and writes `cloud.ply`, `profiles/`, `summary.json`,
/// `report.html`, `frames.journal` and `manifest.json` to `out`, and `frames/` if
/// the scene asks for them. What an earlier run left there under these names goes
/// first, but with `resume` the frames whose record and files are whole.
///
/// While frames are taken, memory does not grow with their number; for the report
/// all points are read back, some 100 bytes each.
pub fn scan(
    scene: &Scene,
    options: &ScanOptions,
    out: &Path,
    control: &Control,
) -> Result<ScanSummary> {
    let start = Instant::now();
    let frames = options.frames.clone().unwrap_or(0..scene.scan.frames);
    super::check_frames(scene, &frames)?;
    let key = RunKey {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        embree: accel::embree::version(),
        scene_sha256: scene.hash.clone(),
        seed: scene.seed,
        frames: frames.clone(),
    };
    files::create_folder(out)?;
    let (mut journal, kept) = Journal::open(out, &key, options.resume)?;
    clear(scene, out, kept.is_empty())?;
    let simulation = options.coverage.simulation(scene)?;
    let prepared = Instant::now();

    let run = Run {
        simulation: &simulation,
        out,
        control,
        done: AtomicU64::new(kept.len() as u64),
    };
    run.repair(frames.start, &kept)?;
    run.frames(frames.start + kept.len() as u32..frames.end, &mut journal)?;
    let measured = Instant::now();

    let summary = finish(&simulation, &frames, &journal.points()?, out, control)?;
    journal.sync()?;
    control.check()?;
    let manifest = Manifest {
        program: env!("CARGO_PKG_NAME"),
        scene: &scene.path,
        key: &key,
        frames_kept: kept.len(),
        coverage: options.coverage,
        threads: rayon::current_num_threads(),
        seconds_prepare: (prepared - start).as_secs_f64(),
        seconds_frames: (measured - prepared).as_secs_f64(),
        seconds_report: measured.elapsed().as_secs_f64(),
    };
    files::write_json(&out.join("manifest.json"), &manifest)?;
    Ok(summary)
}

/// Makes the folders for profiles and frames, free of an earlier run's files if this
/// one starts `anew`. The manifest goes first: from here on the run is not complete.
fn clear(scene: &Scene, out: &Path, anew: bool) -> Result<()> {
    let (profiles, frames) = (out.join("profiles"), out.join("frames"));
    files::create_folder(&profiles)?;
    for name in [
        "manifest.json",
        "summary.json",
        "report.html",
        "cloud.ply",
        "frame.png",
        "cloud.png",
    ] {
        files::remove(&out.join(name))?;
    }
    if anew {
        files::remove_all(&profiles, "profile-")?;
        files::remove_all(&frames, "frame-")?;
    }
    if scene.write_frames {
        files::create_folder(&frames)?;
    }
    Ok(())
}

/// From the points of all frames to cloud, pictures, report and summary.
fn finish(
    simulation: &Simulation,
    frames: &Range<u32>,
    points: &[Vec<CloudPoint>],
    out: &Path,
    control: &Control,
) -> Result<ScanSummary> {
    let scene = simulation.scene;
    let sample = sample_frame(simulation, frames.start, points);
    control.check()?;
    let points = points.concat();
    let columns = scene.camera.sensor.resolution.x;
    let summary = ScanSummary {
        scene: scene.path.clone(),
        frames: frames.len() as u32,
        columns,
        measured_share: points.len() as f64 / (columns as f64 * frames.len() as f64),
        deviation: DeviationStatistics::of(points.iter().map(|p| p.deviation)),
        cloud: out.join("cloud.ply"),
        report: out.join("report.html"),
        pictures: ["frame.png", "cloud.png"].map(|name| out.join(name)),
    };
    files::write_bytes(&summary.pictures[0], &sample.png)?;
    files::write(&summary.cloud, |file| cloud::write_ply(file, &points))?;
    control.check()?;
    let report = report(simulation, &points, &summary, sample, control)?;
    files::write_bytes(&summary.pictures[1], &report.views[1].1)?;
    files::write_bytes(&summary.report, report.html().as_bytes())?;
    files::write_json(&out.join("summary.json"), &summary)?;
    Ok(summary)
}

/// The frame with the greatest spread of depth: there is most to see.
fn sample_frame(simulation: &Simulation, first: u32, points: &[Vec<CloudPoint>]) -> SampleFrame {
    let scene = simulation.scene;
    let spread = |i: usize| {
        let points = &points[i];
        let part_from_head = scene.part_from_head(first + i as u32);
        let up = part_from_head.vector(scene.head_from_laser.rotation.z_axis);
        let n = points.len().max(1) as f64;
        let mean = points.iter().map(|p| p.position.dot(up)).sum::<f64>() / n;
        points
            .iter()
            .map(|p| (p.position.dot(up) - mean).powi(2))
            .sum::<f64>()
    };
    let shown = (0..points.len())
        .map(|i| (i, spread(i)))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map_or(first, |(i, _)| first + i as u32);
    let sensor = &scene.camera.sensor;
    let counts = simulation.counts(shown, &simulation.irradiance(shown));
    let columns = sensor.resolution.x as usize;
    SampleFrame {
        number: shown,
        png: encode_for_eyes(&counts, columns, sensor.max_count()),
        width: sensor.resolution.x,
        height: sensor.resolution.y,
        line: find_peaks(&counts, columns, &simulation.peak_settings())
            .iter()
            .map(|p| (p.column as f64 + 0.5, p.row))
            .collect(),
    }
}

fn report<'a>(
    simulation: &'a Simulation,
    points: &[CloudPoint],
    summary: &ScanSummary,
    frame: SampleFrame,
    control: &Control,
) -> Result<Report<'a>> {
    let scene = simulation.scene;
    let deviations_um: Vec<f64> = points.iter().map(|p| p.deviation * 1e3).collect();
    let mut sizes: Vec<f64> = deviations_um.iter().map(|d| d.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    // 98 of 100 points within the colours; a nanometre where all is exact.
    let limit = sizes
        .get(sizes.len() * 98 / 100)
        .map_or(1.0, |&d| d.max(1e-3));
    let plan = &simulation.plan;
    Ok(Report {
        title: "Laser-triangulation scan",
        facts: vec![
            ("scene", scene.path.display().to_string()),
            ("part", format!("{} triangles", scene.mesh.triangles.len())),
            (
                "frames",
                format!("{} (frame {} shown below)", summary.frames, frame.number),
            ),
            (
                "columns with a point",
                format!("{} of 100", short(summary.measured_share * 100.0)),
            ),
            (
                "1 px along the beam",
                format!("{} µm", short(1e3 / plan.px_per_mm)),
            ),
            (
                "speckle size",
                format!("{} px", short(plan.speckle_size_px)),
            ),
        ],
        frame: Some(frame),
        views: two_views(simulation)
            .into_iter()
            .map(|(caption, view)| {
                control.check()?;
                let png = cloud_picture(&simulation.accel, points, view, limit * 1e-3, 1000);
                Ok((caption, png))
            })
            .collect::<Result<_>>()?,
        color_limit_um: limit,
        deviations_um,
        statistics: summary.deviation.clone(),
        plan: plan
            .effects
            .iter()
            .map(|e| {
                let modelled = if e.modelled { "yes" } else { "no" };
                [
                    e.effect.into(),
                    modelled.into(),
                    e.method.clone(),
                    e.why.clone(),
                ]
            })
            .collect(),
    })
}

/// The part as the laser sees it in the middle of the path, and obliquely from the
/// camera's side at its start: two sides of a part that turns.
fn two_views(simulation: &Simulation) -> [(&'static str, ParallelView); 2] {
    let scan = &simulation.scene.scan;
    let middle = simulation.view(scan.frames / 2).part_from_laser.rotation;
    let start = simulation.view(0);
    let (laser, camera) = (&start.part_from_laser, &start.part_from_camera);
    let right = laser.rotation.x_axis;
    let beam = laser.rotation.z_axis;
    // Between the camera's way of looking and the line itself, so that walls show.
    let oblique = (camera.rotation.z_axis - 0.6 * right + 0.3 * beam).normalize();
    let across = |into: DVec3, hint: DVec3| {
        let right = (hint - into * hint.dot(into)).normalize();
        ParallelView {
            right,
            down: into.cross(right),
        }
    };
    let captions = match scan.turns() {
        true => [
            "along the laser beam in the middle frame",
            "obliquely, as in the first frame",
        ],
        false => ["along the laser beam", "obliquely"],
    };
    let views = [across(middle.z_axis, middle.x_axis), across(oblique, right)];
    [(captions[0], views[0]), (captions[1], views[1])]
}
