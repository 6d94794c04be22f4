//! Monte Carlo simulation of features over seeds (JCGM 101), compared with the first-order
//! propagation of the points' uncertainties.

use crate::error::{Error, Result, printable};
use crate::inspect::features::{FeatureResult, Quantity, is_magnitude};
use crate::math::rng::{Purpose, RngKey};
use crate::math::{chi_squared_quantile, normal_quantile};
use crate::profile::{Calibration, PARAMETERS, Parameters};
use crate::run::error_model::perfect_calibration;
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::simulation::Simulation;
use crate::run::{RunControl, files};
use crate::scene::Scene;
use nalgebra::{DMatrix, SymmetricEigen};
use serde::Serialize;
use std::path::PathBuf;

/// Content of `feature-uncertainty.json`.
#[derive(Debug, Serialize)]
pub struct FeatureMonteCarlo {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of scans. Each has independent speckle, noise, calibration errors and systematic
    /// errors.
    pub seeds: u64,
    /// Results for each quantity of each feature.
    pub values: Vec<ValueScatter>,
    /// Path of the table.
    #[serde(serialize_with = "printable::in_json")]
    pub table: PathBuf,
}

/// Scatter of a quantity over the seeds, in the unit at the end of its name.
#[derive(Debug, Clone, Serialize)]
pub struct ValueScatter {
    /// Name of the feature.
    pub feature: String,
    /// Name of the quantity.
    pub quantity: &'static str,
    /// Value of a scan without speckle, noise, calibration errors and systematic errors; `null` if
    /// it has none.
    pub reference: Option<f64>,
    /// Number of seeds with a value.
    pub seeds: usize,
    /// Mean over the seeds.
    pub mean: f64,
    /// Standard deviation over the seeds.
    pub standard_deviation: f64,
    /// First-order standard uncertainty, root mean square over the seeds.
    pub predicted: f64,
    /// Number of seeds whose interval measured ± U contains the reference.
    pub covered: usize,
    /// Agreement of standard deviation and prediction.
    ///
    /// False if their ratio is outside `expected_ratio`. For values that cannot be negative, only the
    /// upper limit applies.
    pub agrees: bool,
    /// Limits of the ratio of standard deviation and prediction. They contain 99.9 % of the ratios
    /// if the prediction is correct, from the χ² distribution for this number of seeds.
    pub expected_ratio: [f64; 2],
}

/// Probability that a correct prediction is reported as a disagreement.
const ALARM: f64 = 1e-3;

/// Names of the output files.
const FILES: [&str; 2] = ["feature-uncertainty.json", "feature-uncertainty.csv"];

/// Scans the scene with `seeds` consecutive seeds and compares the scatter of its features with
/// their stated uncertainties. Writes `feature-uncertainty.json` and `feature-uncertainty.csv`.
///
/// # Errors
/// Returns an error for a scene without features.
pub fn feature_monte_carlo<'a>(
    mut scene: Scene,
    seeds: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<FeatureMonteCarlo> {
    if scene.features.is_empty() {
        return Err(Error::Usage(format!(
            "{}: found no [[feature]], expected at least one",
            scene.path.display()
        )));
    }
    require_study(&scene)?;
    // Effects that cause scatter must be simulated, whatever the tolerance.
    scene.tolerance_um = None;
    let out = out.into().claim(&scene.inputs, &Names::of(FILES))?.path;
    let reference = features_of(&ideal(&scene)?, control)?;
    let base = Simulation::new(&scene)?;
    let mut scans = Vec::new();
    for k in 0..seeds {
        let seed = scene.seed.wrapping_add(k);
        let mut simulation = base.with_seed(seed)?;
        simulation.calibration = drawn(&scene, &base.calibration, seed);
        scans.push(features_of(&simulation, control)?);
        (control.progress)(k + 1);
    }
    let summary = FeatureMonteCarlo {
        scene: scene.path.clone(),
        seeds,
        values: scatter(&reference, &scans),
        table: out.join(FILES[1]),
    };
    files::write(&summary.table, |file| summary.write_csv(file))?;
    files::write_json(&out.join(FILES[0]), &summary)?;
    Ok(summary)
}

/// Returns the simulation without speckle, noise, calibration errors and systematic errors.
fn ideal(scene: &Scene) -> Result<Simulation> {
    let mut scene = scene.clone();
    scene.speckle = None;
    scene.camera.sensor.noise = None;
    scene.calibration = None;
    scene.systematic = Default::default();
    Simulation::new(&scene)
}

/// Returns the true calibration with errors drawn from the covariance of `stated`.
fn drawn(scene: &Scene, stated: &Calibration, seed: u64) -> Calibration {
    let n = PARAMETERS.len();
    let scale = stated.standard_uncertainties();
    let correlation = DMatrix::from_fn(n, n, |i, j| {
        let product = scale[i] * scale[j];
        if product > 0.0 {
            stated.covariance[i][j] / product
        } else {
            0.0
        }
    });
    let eigen = SymmetricEigen::new(correlation);
    let key = RngKey::new(seed, Purpose::Bootstrap);
    let mut errors: Parameters = [0.0; PARAMETERS.len()];
    for (k, value) in eigen.eigenvalues.iter().enumerate() {
        let uniform = key.uniform(k as u64).clamp(1e-15, 1.0 - 1e-15);
        let size = value.max(0.0).sqrt() * normal_quantile(uniform);
        for (i, error) in errors.iter_mut().enumerate() {
            *error += scale[i] * eigen.eigenvectors[(i, k)] * size;
        }
    }
    Calibration {
        covariance: stated.covariance.clone(),
        ..perfect_calibration(scene).perturbed(&errors)
    }
}

/// Scans all frames and evaluates the features.
fn features_of(simulation: &Simulation, control: &RunControl) -> Result<Vec<FeatureResult>> {
    // The progress of the study is counted in scans.
    simulation.scanned_features(&RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: control.stop,
    })
}

fn scatter(reference: &[FeatureResult], scans: &[Vec<FeatureResult>]) -> Vec<ValueScatter> {
    let mut names: Vec<(usize, &'static str)> = Vec::new();
    for features in scans {
        for (i, feature) in features.iter().enumerate() {
            for quantity in &feature.quantities {
                if !names.contains(&(i, quantity.name)) {
                    names.push((i, quantity.name));
                }
            }
        }
    }
    names.sort_by_key(|&(i, _)| i);
    let of = |features: &[FeatureResult], i: usize, name: &str| {
        let mut quantities = features[i].quantities.iter();
        quantities.find(|q| q.name == name).cloned()
    };
    names
        .into_iter()
        .map(|(i, quantity)| {
            let values: Vec<_> = scans.iter().filter_map(|f| of(f, i, quantity)).collect();
            let reference = of(reference, i, quantity).map(|q| q.measured);
            let n = values.len() as f64;
            let mean = values.iter().map(|q| q.measured).sum::<f64>() / n;
            let squares: f64 = values.iter().map(|q| (q.measured - mean).powi(2)).sum();
            let deviation = (squares / (n - 1.0).max(1.0)).sqrt();
            let predicted = values.iter().map(|q| q.standard_uncertainty.powi(2));
            let predicted = (predicted.sum::<f64>() / n).sqrt();
            // (n − 1)·s²/u² has a χ² distribution with n − 1 degrees of freedom.
            let freedom = (n - 1.0).max(1.0);
            let limit = |u: f64| (chi_squared_quantile(u, freedom) / freedom).sqrt();
            let ratio = [limit(ALARM / 2.0), limit(1.0 - ALARM / 2.0)];
            let within = deviation <= predicted * ratio[1];
            let covers = |q: &&Quantity| {
                reference.is_some_and(|r| (q.measured - r).abs() <= q.expanded_uncertainty)
            };
            ValueScatter {
                feature: scans[0][i].name.clone(),
                quantity,
                reference,
                seeds: values.len(),
                mean,
                standard_deviation: deviation,
                predicted,
                covered: values.iter().filter(covers).count(),
                agrees: within && (is_magnitude(quantity) || deviation >= predicted * ratio[0]),
                expected_ratio: ratio,
            }
        })
        .collect()
}

impl FeatureMonteCarlo {
    fn write_csv(&self, out: &mut dyn std::io::Write) -> std::io::Result<()> {
        writeln!(
            out,
            "feature,quantity,reference,seeds,mean,standard_deviation,predicted,covered,agrees,\
             least_ratio,largest_ratio"
        )?;
        for v in &self.values {
            writeln!(
                out,
                "\"{}\",{},{},{},{},{},{},{},{},{},{}",
                v.feature.replace('"', "\"\""),
                v.quantity,
                v.reference.map_or(String::new(), |r| r.to_string()),
                v.seeds,
                v.mean,
                v.standard_deviation,
                v.predicted,
                v.covered,
                v.agrees,
                v.expected_ratio[0],
                v.expected_ratio[1]
            )?;
        }
        Ok(())
    }

    /// Returns one line per value.
    pub fn text(&self) -> String {
        let line = |v: &ValueScatter| {
            let [least, largest] = v.expected_ratio;
            let note = match v.agrees {
                true => String::new(),
                false => format!(
                    "; Monte Carlo and first-order propagation do not agree: ratio {:.2}, expected \
                     {least:.2} to {largest:.2}",
                    v.standard_deviation / v.predicted
                ),
            };
            format!(
                "{} {}: mean {:.5}, standard deviation {:.5}, predicted {:.5}, {} of {} intervals \
                 contain the reference{note}\n",
                v.feature,
                v.quantity,
                v.mean,
                v.standard_deviation,
                v.predicted,
                v.covered,
                v.seeds
            )
        };
        self.values.iter().map(line).collect()
    }
}
