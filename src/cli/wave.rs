use super::{AccelArguments, ForceArguments, Output, STOP, say};
use crate::run::RunControl;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use crate::scene::Scene;
use crate::study::{ComparedMotion, WaveEffort, WavePatch, WaveSummary};
use crate::wave::correlation::MeanEstimate;
use crate::wave::grain::GrainRow;
use crate::wave::spot::SpotRow;
use indicatif::HumanDuration;
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

/// Estimated duration above which it is announced, s.
const WORTH_SAYING_S: f64 = 5.0;

#[derive(clap::Args)]
pub struct Arguments {
    /// Scene whose patch under the laser is simulated [default: the reference motions and line
    /// widths]
    scene: Option<PathBuf>,
    /// Frame of the scan, starting at 0
    #[arg(long, value_name = "K", default_value_t = 0, requires = "scene")]
    frame: u32,
    /// Number of independent rough surfaces per row, 2 or more; error bars scale as 1/√N
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u64).range(2..100_000))]
    realisations: u64,
    /// Seed of the surfaces
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    accel: AccelArguments,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let effort = WaveEffort {
        realisations: arguments.realisations,
        seed: arguments.seed,
    };
    let mut scene = arguments.scene.as_deref().map(Scene::load).transpose()?;
    if let Some(scene) = &mut scene {
        scene.accel = arguments.accel.accel.unwrap_or(scene.accel);
    }
    let control = |progress| RunControl {
        progress,
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let summary = match &scene {
        Some(scene) => {
            let patch = WavePatch::new(scene, arguments.frame, effort, &control(&|_| {}))?;
            let seconds = patch.seconds(rayon::current_num_threads());
            if seconds > WORTH_SAYING_S && !output.quiet {
                let seconds = Duration::from_secs(seconds as u64);
                say(&format!("takes about {}", HumanDuration(seconds)));
            }
            let bar = output.progress(study::PATCH_STEPS, "of a thousand parts");
            let progress = |done| bar.set_position(done);
            let summary = study::wave_patch(
                &patch,
                arguments.force.folder(&arguments.output),
                &control(&progress),
            );
            bar.finish_and_clear();
            summary
        }
        None => {
            let bar = output.progress(study::reference_motions() as u64, "motions");
            let progress = |done| bar.set_position(done);
            let summary = study::wave_reference(
                effort,
                arguments.force.folder(&arguments.output),
                &control(&progress),
            );
            bar.finish_and_clear();
            summary
        }
    }?;
    output.result(&summary, &text(&summary))
}

fn text(summary: &WaveSummary) -> String {
    let mut text = format!(
        "{:<34} {:>6} {:>6} {:>8} {:>21} {:>18} {:>24}\n",
        "motion",
        "δ",
        "γ law",
        "texture",
        "γ waves (95 %)",
        "moves, predicted",
        "waves, µm (95 %: ±)"
    );
    for ComparedMotion { row, gamma_texture } in &summary.motions {
        let gamma = row.waves.gamma;
        // Uncorrelated patterns have no measurable displacement.
        let measured = row.waves.displacement.map_or("–".into(), |[x, y]| {
            let half = |e: MeanEstimate| (e.high - e.low) / 2.0 * 1e3;
            format!(
                "{:>8.1} {:>8.1} (±{:.1}, ±{:.1})",
                x.value * 1e3,
                y.value * 1e3,
                half(x),
                half(y)
            )
        });
        let _ = writeln!(
            text,
            "{:<34} {:>6.3} {:>6.3} {gamma_texture:>8.3} {:>7.3} ({:.3}–{:.3}) {:>8.1} {:>8.1} {measured}",
            row.name,
            row.delta,
            row.gamma_defocused,
            gamma.value,
            gamma.low,
            gamma.high,
            row.displacement_um[0],
            row.displacement_um[1],
        );
    }
    text += &grains(&summary.grains);
    if !summary.centroids.is_empty() {
        let _ = writeln!(
            text,
            "\n{:>10} {:>10} {:>26}   centroid noise in grains, by line width w/h",
            "w/h", "law", "waves (95 %)"
        );
    }
    for row in &summary.centroids {
        let e = row.waves_bright;
        let _ = writeln!(
            text,
            "{:>10.2} {:>10.3} {:>10.3} ({:.3}–{:.3})",
            row.width, row.law, e.value, e.low, e.high
        );
    }
    text += &spots(&summary.spots);
    for picture in &summary.pictures {
        let _ = writeln!(text, "{}", path(picture));
    }
    text
}

/// Formats the table of speckle sizes on the sensor.
fn grains(rows: &[GrainRow]) -> String {
    let mut text = String::new();
    if !rows.is_empty() {
        let _ = writeln!(
            text,
            "\n{:<46} {:>8} {:>8} {:>24}   width of grains at half height, µm",
            "grains", "law", "waves", "patterns (95 %)"
        );
    }
    for row in rows {
        let e = row.texture_um;
        let _ = writeln!(
            text,
            "{:<46} {:>8.3} {:>8.3} {:>9.3} ({:.3}–{:.3})",
            row.name, row.law_um, row.waves_um, e.value, e.low, e.high
        );
    }
    text
}

/// Formats the table of height noise relative to the limit of a spot.
fn spots(rows: &[SpotRow]) -> String {
    let mut text = String::new();
    if rows.is_empty() {
        return text;
    }
    let _ = writeln!(
        text,
        "\n{:>8} {:>8} {:>8} {:>12} {:>10} {:>26}   height noise of a spot",
        "sin u", "θ", "λ, nm", "limit, µm", "expected", "waves/limit (95 %)"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "{:>8.3} {:>7.0}° {:>8.0} {:>12.3} {:>10.3} {:>10.3} ({:.3}–{:.3})",
            row.setup.sin_aperture,
            row.setup.triangulation.to_degrees(),
            row.setup.wavelength_mm * 1e6,
            row.speckle_limit_um,
            row.expected,
            row.ratio.value,
            row.ratio.low,
            row.ratio.high
        );
    }
    let squares: f64 = rows.iter().map(|row| row.ratio.value.powi(2)).sum();
    let all = (squares / rows.len() as f64).sqrt();
    text + &format!("{:>50} {all:>10.3}\n", "all rows")
}
