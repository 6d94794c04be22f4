//! Fit of recordings of a cylinder, a sphere or a step.

use super::{Findings, FittedUnit};
use crate::error::{Error, InputError, Place, Result};
use crate::study::recording::{RecordedMap, RecordedPart};
use crate::study::round::{self, RoundShape, arcs};
use crate::study::sampled::median;
use crate::study::step_edge::{self, edges};
use std::path::Path;

/// Name of the value that determines the detection threshold.
pub const RELATIVE_THRESHOLD: &str = "threshold relative to the line at normal incidence";

/// Fits the map of a part whose shape is known.
///
/// # Errors
/// Returns `Error::Input` for too few profiles of the part.
pub(super) fn fit_part(recorded: &RecordedMap, part: RecordedPart) -> Result<Findings> {
    match part {
        RecordedPart::Plane => Ok(Findings::default()),
        RecordedPart::Cylinder => fit_round(recorded, RoundShape::Cylinder),
        RecordedPart::Sphere => fit_round(recorded, RoundShape::Sphere),
        RecordedPart::Step => fit_step(recorded),
    }
}

fn too_few(path: &Path, found: usize, least: usize) -> Error {
    let found = format!("{found} profiles with 20 or more points on the part");
    let expected = format!(
        "{least} such profiles or more; columns, profiles and min_z_mm of the recording select the part"
    );
    InputError::new(path, Place::File, found, expected).into()
}

/// Fits radius and detection threshold.
///
/// A diffuse surface at the angle θ from the beam receives the fraction cos θ of the irradiance at
/// normal incidence. The line has this fraction of its height, and the profile ends where the
/// height is the threshold.
fn fit_round(recorded: &RecordedMap, shape: RoundShape) -> Result<Findings> {
    let path = &recorded.path;
    let blocks = arcs(shape, recorded.profiles());
    let blocks = blocks.map_err(|found| too_few(path, found, round::MIN_PROFILES))?;
    let of_block = |of: fn(&round::Arc) -> Vec<f64>| -> Vec<f64> {
        let values = blocks.iter().map(|arcs| arcs.iter().flat_map(of).collect());
        values.map(median).collect()
    };
    let mut findings = Findings::default();
    let radius = of_block(|arc| vec![arc.radius]);
    findings.add_mean(
        ("radius of the part", None, FittedUnit::Mm),
        path,
        &radius,
        0.0,
    );
    let cosines = of_block(|arc| arc.end_slopes.map(f64::cos).to_vec());
    findings.add_mean(
        (RELATIVE_THRESHOLD, None, FittedUnit::One),
        path,
        &cosines,
        0.0,
    );
    findings.inseparable.push(
        "Threshold and reflectance at grazing incidence: the ends of profiles determine the threshold of a diffuse surface \
         only. Images of the line with the same exposure on the same surface determine threshold_dn."
            .to_owned(),
    );
    Ok(findings)
}

/// Fits the lateral resolution.
fn fit_step(recorded: &RecordedMap) -> Result<Findings> {
    let path = &recorded.path;
    let edges = edges(&recorded.profiles());
    let edges = edges.map_err(|found| too_few(path, found, step_edge::MIN_PROFILES))?;
    let mut findings = Findings::default();
    let heights: Vec<f64> = edges.iter().map(|edge| edge.height).collect();
    findings.add_mean(
        ("height of the step", None, FittedUnit::Mm),
        path,
        &heights,
        0.0,
    );
    let sigmas: Vec<f64> = edges.iter().map(|edge| edge.sigma).collect();
    let name = "lateral resolution, standard deviation of an edge";
    findings.add_mean((name, None, FittedUnit::Mm), path, &sigmas, 0.0);
    findings.inseparable.push(
        "Lateral resolution: grain of the line, output filter and roundness of the edge of the part together.".to_owned(),
    );
    Ok(findings)
}
