//! Monte Carlo simulation over seeds: standard deviation of the line position in a frame, compared
//! with the predicted uncertainty.

use crate::error::{Result, printable};
use crate::inspect::uncertainty::ColumnUncertainty;
use crate::math::DVec2;
use crate::profile::{Calibration, Peak};
use crate::report::chart::short;
use crate::report::uncertainty_plot::uncertainty_plot;
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::simulation::Simulation;
use crate::run::{RunControl, check_frame, files};
use crate::scene::Scene;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Content of `uncertainty.json`.
#[derive(Debug, Serialize)]
pub struct MonteCarlo {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Frame number.
    pub frame: u32,
    /// Number of simulated images of the frame, each with independent noise and speckle.
    pub seeds: u64,
    /// True if speckle is constant and only noise is independent. Errors are then relative to the
    /// mean of each column.
    pub fixed_speckle: bool,
    /// Number of peaks in the domain of validity of the prediction.
    pub points: usize,
    /// Total number of peaks.
    pub found: usize,
    /// Fraction of the 95 % intervals that contain the true value; `null` without points.
    pub coverage: Option<f64>,
    /// Root mean square of the ratio of error to predicted uncertainty.
    pub normalised_error_rms: Option<f64>,
    /// Results for each column with a line.
    pub columns: Vec<ColumnUncertainty>,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Error of a row and its predicted uncertainty, px.
#[derive(Debug, Clone, Copy)]
struct TrialResult {
    error: f64,
    predicted: f64,
}

impl TrialResult {
    fn is_covered(&self) -> bool {
        self.error.abs() <= 1.96 * self.predicted
    }
}

/// Names of the output files.
const FILES: [&str; 2] = ["uncertainty.json", "uncertainty.svg"];

/// Simulates a frame with `seeds` consecutive seeds, starting at the scene's seed. Writes
/// `uncertainty.json` and `uncertainty.svg`. The true value of a column is the row found by the
/// peak finder in the frame without speckle and noise.
pub fn monte_carlo<'a>(
    mut scene: Scene,
    frame: u32,
    seeds: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<MonteCarlo> {
    check_frame(&scene, frame)?;
    require_study(&scene)?;
    // Effects that cause scatter must be simulated, whatever the tolerance.
    scene.tolerance_um = None;
    // The study is about rows of one frame, whose stated uncertainty has no systematic errors.
    scene.systematic = Default::default();
    let out = out.into().claim(&scene.inputs, &Names::of(FILES))?.path;
    let (truth, calibration) = ideal_peaks(&mut scene, frame)?;
    let columns = scene.camera.sensor.resolution.x;
    let mut errors = vec![Vec::new(); columns as usize];
    let (first, mut found) = (scene.seed, 0);
    for k in 0..seeds {
        control.check()?;
        scene.seed = first.wrapping_add(k);
        let simulation = Simulation::new(&scene)?;
        let counts = simulation.image(frame);
        let (peaks, stated) = simulation.peaks(&counts);
        found += peaks.len();
        for (peak, stated) in peaks.iter().zip(stated) {
            let column = peak.column as usize;
            if let (true, Some(truth)) = (peak.flags.is_empty(), &truth[column]) {
                let error = peak.row - truth.row;
                let predicted = stated.sigma;
                errors[column].push(TrialResult { error, predicted });
            }
        }
        (control.progress)(k + 1);
    }
    let rows = || errors.iter().zip(&truth);
    let all: Vec<TrialResult> = errors.iter().flatten().copied().collect();
    let of = |(errors, truth): (&Vec<TrialResult>, &Option<Peak>)| {
        of_column(errors, truth.as_ref()?, &calibration)
    };
    let columns_found = rows().filter_map(of).collect();
    let taken = (frame, seeds, found);
    written(
        summary(&scene, taken, false, &all, columns_found, out),
        columns,
        out,
    )
}

/// Builds the summary. The tuple contains the frame, the number of seeds, and the total number of
/// peaks.
fn summary(
    scene: &Scene,
    (frame, seeds, found): (u32, u64, usize),
    fixed_speckle: bool,
    all: &[TrialResult],
    columns: Vec<ColumnUncertainty>,
    out: &Path,
) -> MonteCarlo {
    let mean = |sum: f64| (!all.is_empty()).then(|| sum / all.len() as f64);
    let squares = all.iter().map(|e| (e.error / e.predicted).powi(2));
    MonteCarlo {
        scene: scene.path.clone(),
        frame,
        seeds,
        fixed_speckle,
        points: all.len(),
        found,
        coverage: mean(all.iter().filter(|e| e.is_covered()).count() as f64),
        normalised_error_rms: mean(squares.sum()).map(f64::sqrt),
        columns,
        picture: out.join("uncertainty.svg"),
    }
}

fn written(summary: MonteCarlo, columns: u32, out: &Path) -> Result<MonteCarlo> {
    let svg = uncertainty_plot(
        &summary.columns,
        columns,
        summary.headline().each_ref().map(|l| &l[..]),
    );
    files::write_bytes(&summary.picture, svg.as_bytes())?;
    files::write_json(&out.join("uncertainty.json"), &summary)?;
    Ok(summary)
}

/// Simulates a frame as [`monte_carlo`] does, with noise only and without motion. The true value of
/// a column is the mean of its rows. The uncertainty of the mean is corrected for.
pub fn repeatability<'a>(
    mut scene: Scene,
    frame: u32,
    seeds: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<MonteCarlo> {
    check_frame(&scene, frame)?;
    require_study(&scene)?;
    scene.tolerance_um = None;
    let out = out.into().claim(&scene.inputs, &Names::of(FILES))?.path;
    let simulation = Simulation::new(&scene)?;
    let light = simulation.irradiance(frame);
    let columns = scene.camera.sensor.resolution.x;
    let mut by_column: Vec<Vec<(Peak, f64)>> = vec![Vec::new(); columns as usize];
    let mut found = 0;
    for k in 0..seeds {
        control.check()?;
        // Each repetition uses the noise of a different frame number.
        let (peaks, stated) = simulation.peaks(&simulation.counts_near_light(k as u32, &light));
        found += peaks.len();
        for (peak, stated) in peaks.into_iter().zip(stated) {
            if peak.flags.is_empty() {
                by_column[peak.column as usize].push((peak, stated.noise));
            }
        }
        (control.progress)(k + 1);
    }
    let of = |drawn: &Vec<(Peak, f64)>| {
        let n = drawn.len() as f64;
        let mean = drawn.iter().map(|(peak, _)| peak.row).sum::<f64>() / n;
        // The mean contains a fraction of each error, which reduces deviations by √((n − 1)/n).
        let whole = (n / (n - 1.0)).sqrt();
        let error = |(peak, predicted): &(Peak, f64)| TrialResult {
            error: (peak.row - mean) * whole,
            predicted: *predicted,
        };
        let truth = Peak {
            row: mean,
            ..drawn.first()?.0
        };
        (drawn.len() > 1).then(|| (drawn.iter().map(error).collect::<Vec<TrialResult>>(), truth))
    };
    let drawn: Vec<(Vec<TrialResult>, Peak)> = by_column.iter().filter_map(of).collect();
    let all: Vec<TrialResult> = drawn
        .iter()
        .flat_map(|(errors, _)| errors)
        .copied()
        .collect();
    let of = |(errors, truth): &(Vec<TrialResult>, Peak)| {
        of_column(errors, truth, &simulation.calibration)
    };
    let columns_found = drawn.iter().filter_map(of).collect();
    let taken = (frame, seeds, found);
    written(
        summary(&scene, taken, true, &all, columns_found, out),
        columns,
        out,
    )
}

/// Returns the peaks without a flag, by column, of a frame without speckle and noise.
fn ideal_peaks(scene: &mut Scene, frame: u32) -> Result<(Vec<Option<Peak>>, Calibration)> {
    let speckle = scene.speckle.take();
    let noise = scene.camera.sensor.noise.take();
    let simulation = Simulation::new(scene)?;
    let counts = simulation.image(frame);
    let mut by_column = vec![None; scene.camera.sensor.resolution.x as usize];
    for peak in simulation.peaks(&counts).0 {
        by_column[peak.column as usize] = peak.flags.is_empty().then_some(peak);
    }
    let calibration = simulation.calibration.clone();
    drop(simulation);
    scene.speckle = speckle;
    scene.camera.sensor.noise = noise;
    Ok((by_column, calibration))
}

/// Returns the result of a column; `None` with fewer than two seeds.
fn of_column(
    errors: &[TrialResult],
    truth: &Peak,
    calibration: &Calibration,
) -> Option<ColumnUncertainty> {
    let place = DVec2::new(truth.column as f64 + 0.5, truth.row);
    let n = errors.len() as f64;
    if n < 2.0 {
        return None;
    }
    let bias = errors.iter().map(|e| e.error).sum::<f64>() / n;
    let squares: f64 = errors.iter().map(|e| (e.error - bias).powi(2)).sum();
    let predicted: f64 = errors.iter().map(|e| e.predicted.powi(2)).sum();
    Some(ColumnUncertainty {
        column: truth.column,
        true_row_px: truth.row,
        seeds: errors.len(),
        predicted_px: (predicted / n).sqrt(),
        monte_carlo_px: (squares / (n - 1.0)).sqrt(),
        bias_px: bias,
        covered: errors.iter().filter(|e| e.is_covered()).count(),
        um_per_px: calibration.point_jacobian(place)?.by_pixel[1].length() * 1e3,
    })
}

impl MonteCarlo {
    /// Returns a summary of the plot as text.
    pub fn headline(&self) -> [String; 2] {
        let (Some(coverage), Some(ratio)) = (self.coverage, self.normalised_error_rms) else {
            let why = "no peak lies in the domain of the prediction (flag UNCERTAINTY_NOT_VALID)";
            return [format!("Nothing to compare: {why}"), String::new()];
        };
        let (kind, seeds) = match self.fixed_speckle {
            true => (
                "repeated at one position, static",
                "images of the same speckle",
            ),
            false => ("over positions", "seeds of speckle and noise"),
        };
        [
            format!(
                "{} of 100 intervals of 95 % hold the truth {kind}; errors are {} times as large as \
                 predicted",
                short(coverage * 100.0),
                short(ratio)
            ),
            format!(
                "Frame {}, {} {seeds}, {} peaks, {} % of those found; the \
                 others are flagged and not counted.",
                self.frame,
                self.seeds,
                self.points,
                short(100.0 * self.points as f64 / self.found as f64)
            ),
        ]
    }
}
