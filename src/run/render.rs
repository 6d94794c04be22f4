//! Rendering of one frame with its ground truth, for inspection and machine learning.

use super::output_folder::{Names, OutputFolder};
use super::setup;
use super::{RunControl, TraceMode, files, memory_estimate};
use crate::error::{Result, printable};
use crate::profile::{Peak, find_lines};
use crate::report::picture::encode_counts;
use crate::scene::Scene;
use exr::prelude::FlatSamples;
use serde::Serialize;
use std::io::{self, Write};
use std::path::PathBuf;

/// Properties of a rendered frame and the paths of its files.
#[derive(Debug, Serialize)]
pub struct RenderSummary {
    /// Number of the frame.
    pub frame: u32,
    /// Intersection library and its version.
    pub accel: String,
    /// Path of the counts, 16 bits.
    #[serde(serialize_with = "printable::in_json")]
    pub png: PathBuf,
    /// Path of the irradiance and the truth layers.
    #[serde(serialize_with = "printable::in_json")]
    pub exr: PathBuf,
    /// Path of the lines of each column; `null` without them.
    #[serde(serialize_with = "printable::some_in_json")]
    pub lines: Option<PathBuf>,
    /// Highest count of the frame.
    pub max_count: u16,
    /// Mean count of the frame.
    pub mean_count: f64,
}

/// Writes `frame-KKKKKK.png` (16-bit counts) and `.exr` (irradiance in mW/mm² and the truth layers)
/// to `out`. With `lines`, also writes up to this number of lines of each column to
/// `frame-KKKKKK-lines.csv`.
pub fn render<'a>(
    scene: &Scene,
    (frame, lines): (u32, Option<usize>),
    coverage: TraceMode,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<RenderSummary> {
    super::check_frame(scene, frame)?;
    memory_estimate::require_render(scene)?;
    let image = format!("frame-{frame:06}");
    let names = [".png", ".exr", "-lines.csv"].map(|end| format!("{image}{end}"));
    let names = Names::of(names);
    let out = out.into().claim(&scene.inputs, &names)?.path;
    let simulation = setup::simulation(scene, coverage, control)?;
    control.check()?;
    let (pose, indirect) = (simulation.pose(frame), simulation.indirect(frame));
    let irradiance = simulation.irradiance_with(&pose, &indirect);
    let counts = simulation.counts(frame, &irradiance);
    let all = counts.by_column();
    let truth = simulation.truth(frame);
    control.check()?;
    let resolution = scene.camera.sensor.resolution;
    let png = out.join(format!("{image}.png"));
    let exr_path = png.with_extension("exr");
    files::write_bytes(
        &png,
        &encode_counts(&counts, scene.camera.sensor.max_count()),
    )?;
    let lines_path = match lines {
        None => None,
        Some(most) => {
            let settings = simulation.peak_settings();
            let found = find_lines(&counts, &settings, most);
            let found: Vec<Peak> = found.into_iter().map(|p| simulation.rounded(p)).collect();
            let path = out.join(format!("{image}-lines.csv"));
            files::write(&path, |file| write_lines(file, &found))?;
            Some(path)
        }
    };
    let component = |of: &[[f32; 3]], i: usize| FlatSamples::F32(of.iter().map(|v| v[i]).collect());
    let mut channels = vec![
        ("irradiance", FlatSamples::F32(irradiance.dense())),
        ("depth", FlatSamples::F32(truth.depth)),
        ("position.X", component(&truth.position, 0)),
        ("position.Y", component(&truth.position, 1)),
        ("position.Z", component(&truth.position, 2)),
        ("normal.X", component(&truth.normal, 0)),
        ("normal.Y", component(&truth.normal, 1)),
        ("normal.Z", component(&truth.normal, 2)),
        ("triangle", FlatSamples::U32(truth.triangle)),
    ];
    if simulation.plan.reflections.is_some() {
        let [direct, reflections] = simulation
            .direct_and_indirect_with(&pose, &indirect)
            .map(|share| share.dense());
        channels.push(("direct", FlatSamples::F32(direct)));
        channels.push(("reflections", FlatSamples::F32(reflections)));
    }
    if scene.copies.len() > 1 {
        channels.push(("instance", FlatSamples::U32(truth.copy)));
    }
    let size = (resolution.x as usize, resolution.y as usize);
    files::write_exr(&exr_path, size, channels)?;
    Ok(RenderSummary {
        frame,
        accel: scene.accel.version(),
        png,
        exr: exr_path,
        lines: lines_path,
        max_count: all.iter().copied().max().unwrap_or(0),
        mean_count: all.iter().map(|&c| c as f64).sum::<f64>() / all.len() as f64,
    })
}

/// Writes lines as CSV: position, width and heights in counts above the background.
fn write_lines(out: &mut dyn Write, lines: &[Peak]) -> io::Result<()> {
    writeln!(
        out,
        "column,row_px,line_sigma_px,height_dn,intensity_dn,noise_dn,flags"
    )?;
    for line in lines {
        writeln!(
            out,
            "{},{:.5},{:.4},{:.2},{:.1},{:.3},{}",
            line.column,
            line.row,
            line.sigma,
            line.height,
            line.intensity,
            line.noise,
            line.flags.bits()
        )?;
    }
    Ok(())
}
