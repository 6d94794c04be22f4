//! Monte Carlo over seeds: the scatter of a frame's lines beside what is predicted.

use crate::error::{Result, printable};
use crate::inspect::uncertainty::ColumnUncertainty;
use crate::math::DVec2;
use crate::profile::{Calibration, Peak};
use crate::report::chart::short;
use crate::report::uncertainty_plot::uncertainty_plot;
use crate::run::need::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::simulation::Simulation;
use crate::run::{Control, check_frame, files};
use crate::scene::Scene;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// `uncertainty.json`.
#[derive(Debug, Serialize)]
pub struct MonteCarlo {
    /// The scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of the frame.
    pub frame: u32,
    /// Times the frame was taken, each with its own noise and speckle.
    pub seeds: u64,
    /// Whether nothing moved: speckle stayed, and only noise was drawn anew. Errors are then from each column's mean.
    pub fixed_speckle: bool,
    /// Peaks in the domain of the prediction, of all that were found.
    pub points: usize,
    /// Peaks in all.
    pub found: usize,
    /// Share of the 95 % intervals that hold the truth; `null` without points.
    pub coverage: Option<f64>,
    /// Root mean square of error over predicted uncertainty.
    pub error_over_predicted: Option<f64>,
    /// One for each column with a line.
    pub columns: Vec<ColumnUncertainty>,
    /// Where the picture was written.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Error of a row and its predicted uncertainty, px.
#[derive(Debug, Clone, Copy)]
struct Draw {
    error: f64,
    predicted: f64,
}

impl Draw {
    fn is_covered(&self) -> bool {
        self.error.abs() <= 1.96 * self.predicted
    }
}

/// Files that are written.
const FILES: [&str; 2] = ["uncertainty.json", "uncertainty.svg"];

/// Runs a frame with `seeds` seeds from the scene's own on, and writes
/// `uncertainty.json` and `uncertainty.svg`. The truth of a column is the row of the
/// same frame without speckle and noise, by the same finder.
pub fn monte_carlo<'a>(
    mut scene: Scene,
    frame: u32,
    seeds: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<MonteCarlo> {
    check_frame(&scene, frame)?;
    require_study(&scene)?;
    // What is scattered must not be left out.
    scene.tolerance_um = None;
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
                errors[column].push(Draw { error, predicted });
            }
        }
        (control.progress)(k + 1);
    }
    let rows = || errors.iter().zip(&truth);
    let all: Vec<Draw> = errors.iter().flatten().copied().collect();
    let of = |(errors, truth): (&Vec<Draw>, &Option<Peak>)| {
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

/// `taken`: frame, times, peaks in all.
fn summary(
    scene: &Scene,
    (frame, seeds, found): (u32, u64, usize),
    fixed_speckle: bool,
    all: &[Draw],
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
        error_over_predicted: mean(squares.sum()).map(f64::sqrt),
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

/// The same of noise alone, for nothing moves: the truth of a column is the mean of its rows, whose own uncertainty is
/// taken off.
pub fn repeatability<'a>(
    mut scene: Scene,
    frame: u32,
    seeds: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
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
        // Each as the noise of another frame.
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
        // The mean holds a part of each error.
        let whole = (n / (n - 1.0)).sqrt();
        let error = |(peak, predicted): &(Peak, f64)| Draw {
            error: (peak.row - mean) * whole,
            predicted: *predicted,
        };
        let truth = Peak {
            row: mean,
            ..drawn.first()?.0
        };
        (drawn.len() > 1).then(|| (drawn.iter().map(error).collect::<Vec<Draw>>(), truth))
    };
    let drawn: Vec<(Vec<Draw>, Peak)> = by_column.iter().filter_map(of).collect();
    let all: Vec<Draw> = drawn
        .iter()
        .flat_map(|(errors, _)| errors)
        .copied()
        .collect();
    let of =
        |(errors, truth): &(Vec<Draw>, Peak)| of_column(errors, truth, &simulation.calibration);
    let columns_found = drawn.iter().filter_map(of).collect();
    let taken = (frame, seeds, found);
    written(
        summary(&scene, taken, true, &all, columns_found, out),
        columns,
        out,
    )
}

/// The unflagged peaks, by column, of a frame without speckle and noise.
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

/// `None` with fewer than two seeds.
fn of_column(
    errors: &[Draw],
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
    /// What the picture says in words.
    pub fn headline(&self) -> [String; 2] {
        let (Some(coverage), Some(ratio)) = (self.coverage, self.error_over_predicted) else {
            let why = "no peak lies in the domain of the prediction (flag OUTSIDE)";
            return [format!("Nothing to compare: {why}"), String::new()];
        };
        let (kind, seeds) = match self.fixed_speckle {
            true => (
                "the same place again, nothing moved",
                "images of the same speckle",
            ),
            false => ("from place to place", "seeds of speckle and noise"),
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
