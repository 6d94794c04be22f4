//! A whole scan: frames in parallel, then cloud, summary, report and, last of
//! all, the manifest that says the run is complete.

use super::{Control, Coverage, Simulation, files};
use crate::error::Result;
use crate::inspect::chart::short;
use crate::inspect::cloud::{self, CloudPoint};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::picture::{ParallelView, cloud_picture, encode_counts, encode_for_eyes};
use crate::inspect::report::{Report, SampleFrame};
use crate::math::DVec3;
use crate::profile::{Peak, find_peaks};
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct ScanSummary {
    pub scene: PathBuf,
    pub frames: u32,
    pub columns: u32,
    /// What found the triangles rays met.
    pub accel: String,
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
    version: &'static str,
    accel: &'a str,
    scene: &'a Path,
    scene_sha256: &'a str,
    seed: u64,
    frames: u32,
    coverage: Coverage,
    threads: usize,
    seconds_prepare: f64,
    seconds_frames: f64,
    seconds_report: f64,
}

/// Runs all frames and writes `cloud.ply`, `profiles/`, `summary.json`,
/// `report.html` and `manifest.json` to `out`, and `frames/` if the scene asks
/// for them. What an earlier run left there under these names goes first.
pub fn scan(
    scene: &Scene,
    coverage: Coverage,
    out: &Path,
    control: &Control,
) -> Result<ScanSummary> {
    let start = Instant::now();
    let (profiles, frames) = clear(scene, out)?;
    let simulation = coverage.simulation(scene)?;
    let prepared = Instant::now();

    let columns = scene.camera.sensor.resolution.x;
    let done = AtomicU64::new(0);
    let points: Vec<Vec<CloudPoint>> = (0..scene.scan.frames)
        .into_par_iter()
        .map(|frame| {
            control.check()?;
            let counts = simulation.counts(frame, &simulation.irradiance(frame));
            let (peaks, points) = simulation.measure(frame, &counts);
            let name = profiles.join(format!("profile-{frame:06}.csv"));
            write_profile(&name, &peaks, &points)?;
            if scene.write_frames {
                let name = frames.join(format!("frame-{frame:06}.png"));
                files::write_bytes(&name, &encode_counts(&counts, columns as usize))?;
            }
            (control.progress)(1 + done.fetch_add(1, Ordering::Relaxed));
            Ok(points)
        })
        .collect::<Result<_>>()?;
    let measured = Instant::now();

    let sample = sample_frame(&simulation, &points);
    let points = points.concat();
    let summary = ScanSummary {
        scene: scene.path.clone(),
        frames: scene.scan.frames,
        columns,
        accel: scene.accel.version(),
        measured_share: points.len() as f64 / (columns as f64 * scene.scan.frames as f64),
        deviation: DeviationStatistics::of(points.iter().map(|p| p.deviation)),
        cloud: out.join("cloud.ply"),
        report: out.join("report.html"),
        pictures: ["frame.png", "cloud.png"].map(|name| out.join(name)),
    };
    files::write_bytes(&summary.pictures[0], &sample.png)?;
    files::write(&summary.cloud, |file| cloud::write_ply(file, &points))?;
    let report = report(&simulation, &points, &summary, sample);
    files::write_bytes(&summary.pictures[1], &report.views[1].1)?;
    files::write_bytes(&summary.report, report.html().as_bytes())?;
    files::write_json(&out.join("summary.json"), &summary)?;
    let manifest = Manifest {
        program: env!("CARGO_PKG_NAME"),
        version: env!("CARGO_PKG_VERSION"),
        accel: &summary.accel,
        scene: &scene.path,
        scene_sha256: &scene.hash,
        seed: scene.seed,
        frames: scene.scan.frames,
        coverage,
        threads: rayon::current_num_threads(),
        seconds_prepare: (prepared - start).as_secs_f64(),
        seconds_frames: (measured - prepared).as_secs_f64(),
        seconds_report: measured.elapsed().as_secs_f64(),
    };
    files::write_json(&out.join("manifest.json"), &manifest)?;
    Ok(summary)
}

/// Makes the folders for profiles and frames, free of an earlier run's files. The
/// manifest goes first: from here on the run is not complete.
fn clear(scene: &Scene, out: &Path) -> Result<(PathBuf, PathBuf)> {
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
    files::remove_all(&profiles, "profile-")?;
    files::remove_all(&frames, "frame-")?;
    if scene.write_frames {
        files::create_folder(&frames)?;
    }
    Ok((profiles, frames))
}

/// One line a measured column: pixels, then the point in the part's frame.
fn write_profile(path: &Path, peaks: &[Peak], points: &[CloudPoint]) -> Result<()> {
    files::write(path, |out| {
        writeln!(
            out,
            "column,row_px,intensity_dn,x_mm,y_mm,z_mm,deviation_um"
        )?;
        // Points are in the order of their peaks, and a peak may have none.
        let mut points = points.iter().peekable();
        for peak in peaks {
            write!(out, "{},{:.5},{:.1}", peak.column, peak.row, peak.intensity)?;
            match points.next_if(|point| point.column == peak.column) {
                Some(point) => {
                    let [x, y, z] = point.position.to_array();
                    let deviation = point.deviation * 1e3;
                    writeln!(out, ",{x:.6},{y:.6},{z:.6},{deviation:.4}")?;
                }
                None => writeln!(out, ",,,,")?,
            }
        }
        Ok(())
    })
}

/// The frame with the greatest spread of depth: there is most to see.
fn sample_frame(simulation: &Simulation, points: &[Vec<CloudPoint>]) -> SampleFrame {
    let scene = simulation.scene;
    let up = scene
        .world_from_part
        .inverse()
        .vector(scene.head_from_laser.rotation.z_axis);
    let spread = |points: &Vec<CloudPoint>| {
        let n = points.len().max(1) as f64;
        let mean = points.iter().map(|p| p.position.dot(up)).sum::<f64>() / n;
        points
            .iter()
            .map(|p| (p.position.dot(up) - mean).powi(2))
            .sum::<f64>()
    };
    let shown = (0..points.len())
        .max_by(|&a, &b| spread(&points[a]).total_cmp(&spread(&points[b])))
        .unwrap_or(0) as u32;
    let sensor = &scene.camera.sensor;
    let counts = simulation.counts(shown, &simulation.irradiance(shown));
    let columns = sensor.resolution.x as usize;
    SampleFrame {
        number: shown,
        png: encode_for_eyes(&counts, columns, sensor.max_count()),
        width: sensor.resolution.x,
        height: sensor.resolution.y,
        line: find_peaks(&counts, columns)
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
) -> Report<'a> {
    let scene = simulation.scene;
    let deviations_um: Vec<f64> = points.iter().map(|p| p.deviation * 1e3).collect();
    let mut sizes: Vec<f64> = deviations_um.iter().map(|d| d.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    // 98 of 100 points within the colours; a nanometre where all is exact.
    let limit = sizes
        .get(sizes.len() * 98 / 100)
        .map_or(1.0, |&d| d.max(1e-3));
    let plan = &simulation.plan;
    Report {
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
                let png = cloud_picture(&simulation.accel, points, view, limit * 1e-3, 1000);
                (caption, png)
            })
            .collect(),
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
    }
}

/// The part as the laser sees it, and obliquely from the camera's side.
fn two_views(simulation: &Simulation) -> [(&'static str, ParallelView); 2] {
    let view = simulation.view(0);
    let (laser, camera) = (&view.part_from_laser, &view.part_from_camera);
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
    [
        ("along the laser beam", across(beam, right)),
        ("obliquely", across(oblique, right)),
    ]
}
