//! Path for a purpose: features or the complete surface, with the uncertainty that a scan along it
//! predicts.

use super::RunControl;
use super::path_planner::{
    MAX_PASSES, PathLimits, PlannedPath, TargetCoverage, TargetSurface, is_too_large, plan,
};
use super::sensor_figures::SensorFigures;
use super::simulation::Simulation;
use crate::accel::Accel;
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::features::{FeatureKind, FeatureResult, NominalFace, Shape, faces};
use crate::inspect::tolerance::GUARD_BAND_K;
use crate::math::{DVec3, Rigid};
use crate::mesh::ProgressFn;
use crate::scene::Scene;
use glam::DQuat;
use rayon::prelude::*;
use serde::Serialize;
use std::fmt::Write;
use std::path::PathBuf;
use std::sync::Arc;

/// Maximum number of times that the distance of frames is halved.
const MAX_REFINEMENTS: usize = 3;
/// Smallest relative decrease of the smallest tolerance for which the distance is halved again.
/// Independent errors decrease by 29 %.
const LEAST_DECREASE: f64 = 0.1;
/// Maximum number of frames from which the uncertainty of the surface is predicted.
const MAX_FRAMES: u32 = 200;

/// Purpose and limits of a planned path.
#[derive(Debug, Clone)]
pub struct PathGoal {
    /// Surface that the path measures.
    pub purpose: PathPurpose,
    /// Distance between frames, mm.
    pub spacing_mm: f64,
    /// Largest angle between the beam and the axis that points up, degrees.
    pub max_tilt_deg: f64,
}

/// Surface that a planned path measures.
#[derive(Debug, Clone)]
pub enum PathPurpose {
    /// Features: a TOML file with `[[feature]]` tables.
    Features(PathBuf),
    /// The largest planes, cylinders, spheres and cones of the part, with tolerances of plus and
    /// minus this length, mm.
    Faces(f64),
    /// The complete surface. A point is sufficient if its expanded uncertainty is at most this
    /// length, mm.
    Surface(f64),
}

/// Summary of a planned path.
#[derive(Debug, Clone, Serialize)]
pub struct PathSummary {
    /// Length of the path with the links between passes, mm.
    pub length_mm: f64,
    /// Distance of the frames of each pass, mm.
    pub spacings_mm: Vec<f64>,
    /// Measured and hidden surface of each feature, or of the part.
    pub targets: Vec<TargetCoverage>,
    /// Features with their predicted uncertainty; empty for the complete surface.
    pub features: Vec<FeatureResult>,
    /// Fraction of the points whose expanded uncertainty is at most the tolerance; `null` for
    /// features.
    pub sufficient_fraction: Option<f64>,
}

/// Planned path of a goal.
pub(crate) struct GoalPath {
    pub path: PlannedPath,
    purpose: PathPurpose,
    /// Features that each target belongs to: itself, and the relations that use it.
    dependents: Vec<Vec<usize>>,
    features: Vec<FeatureResult>,
    sufficient_fraction: Option<f64>,
}

impl PathGoal {
    /// Returns the `[[feature]]` tables of the goal, as text after an empty line; empty without
    /// features. `accel` is the part.
    ///
    /// # Errors
    /// A file that cannot be read, or has other keys, and a part without faces.
    pub(crate) fn feature_tables(&self, accel: &Accel) -> Result<String> {
        let file = match &self.purpose {
            PathPurpose::Features(file) => file,
            PathPurpose::Faces(tolerance) => return tables_of_faces(accel, *tolerance),
            PathPurpose::Surface(_) => return Ok(String::new()),
        };
        let text = input_file::read_text(file, LARGEST_TEXT, "a file with [[feature]] tables")?;
        let expected = "[[feature]] tables only";
        let mistake = |place, found: String| InputError::new(file, place, found, expected);
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let at = error.span().map_or(0, |span| span.start);
            let line = 1 + text.bytes().take(at).filter(|&b| b == b'\n').count();
            mistake(Place::Line(line), error.message().to_owned())
        })?;
        match table.keys().find(|key| *key != "feature") {
            Some(key) => Err(mistake(Place::File, format!("the key {key}")).into()),
            None if table.is_empty() => Err(mistake(Place::File, "no table".to_owned()).into()),
            None => Ok(format!("\n{text}")),
        }
    }

    /// Moves an error in the text of a scene to the file of the features, whose first line has the
    /// number `before` + 1 there.
    pub(crate) fn in_feature_file(&self, error: Error, before: usize) -> Error {
        match (error, &self.purpose) {
            (Error::Input(mut error), PathPurpose::Features(file)) => {
                if let Place::Line(line) = error.place
                    && line > before
                {
                    error.place = Place::Line(line - before);
                    error.file = file.clone();
                }
                Error::Input(error)
            }
            (error, _) => error,
        }
    }
}

/// Returns `[[feature]]` tables of the largest faces of a part.
fn tables_of_faces(accel: &Accel, tolerance: f64) -> Result<String> {
    let mut text = String::new();
    for (i, face) in faces(accel).into_iter().enumerate() {
        let [x, y, z] = face.point.to_array();
        let (kind, t) = (face.shape.name(), tolerance);
        let tolerance = match face.shape {
            Shape::Plane => format!("offset_mm = [-{t}, {t}]"),
            Shape::Cone => format!("displacement_mm = [0.0, {t}]"),
            _ => format!("diameter_mm = [-{t}, {t}]"),
        };
        let _ = write!(
            text,
            "\n[[feature]]\nname = \"{kind} {}\"\nkind = \"{kind}\"\npoint_mm = [{x}, {y}, {z}]\n\
             tolerance = {{ {tolerance} }}\n",
            i + 1
        );
    }
    match text.is_empty() {
        true => Err(Error::Usage(
            "the part has no face that is a plane, cylinder, sphere or cone; describe its features in a file".to_owned(),
        )),
        false => Ok(text),
    }
}

impl GoalPath {
    /// Plans a path. `up` is the axis of the part's file from which the head may tilt. `watch` is
    /// called with the progress, from any thread.
    ///
    /// # Errors
    /// Features without a CAD face, goals that no pass measures, and errors of `watch`.
    pub fn new(
        (scene, accel): (&Scene, &Accel),
        figures: &SensorFigures,
        goal: &PathGoal,
        up: DVec3,
        watch: &ProgressFn,
    ) -> Result<GoalPath> {
        let mut dependents = Vec::new();
        let targets = match goal.purpose {
            PathPurpose::Surface(_) => vec![TargetSurface::part(accel)],
            PathPurpose::Features(_) | PathPurpose::Faces(_) => {
                let mut targets = Vec::new();
                for (i, feature) in scene.features.iter().enumerate() {
                    let (FeatureKind::Element { selection, .. }
                    | FeatureKind::Profile { selection }) = &feature.kind
                    else {
                        continue;
                    };
                    let face = NominalFace::select(accel, &scene.groups, selection);
                    let face = face.map_err(|problem| {
                        Error::Usage(format!("feature {}: {problem}", feature.name))
                    })?;
                    targets.push(TargetSurface::face(accel, &feature.name, &face));
                    let uses = |kind: &FeatureKind| match kind {
                        FeatureKind::Relation { of, .. } => of.contains(&i),
                        _ => false,
                    };
                    let others = scene.features.iter().enumerate();
                    let others = others.filter(|(j, other)| *j == i || uses(&other.kind));
                    dependents.push(others.map(|(j, _)| j).collect());
                }
                targets
            }
        };
        let limits = PathLimits {
            up,
            max_tilt: goal.max_tilt_deg.to_radians(),
            spacing: goal.spacing_mm,
        };
        if is_too_large(figures, &targets) {
            return Err(Error::Usage(format!(
                "a part of {:.4} mm needs more than {MAX_PASSES} passes of this sensor, whose field is {:.4} mm wide; check the unit \
                 of the part, or take a sensor with a larger field",
                accel.bounds().size().length(),
                figures.width_at_center().unwrap_or(0.0)
            )));
        }
        let path = plan((scene, accel), figures, &targets, &limits, watch)?;
        if path.passes.is_empty() {
            let reasons = path.targets.iter().flat_map(|target| &target.hidden);
            let reasons =
                reasons.map(|hidden| format!("{:.1} mm² {}", hidden.area_mm2, hidden.reason));
            return Err(Error::Usage(format!(
                "no pass with a tilt of at most {}° measures the surface: {}; allow a larger tilt, or name another axis \
                 that points up",
                goal.max_tilt_deg,
                reasons.collect::<Vec<_>>().join(", ")
            )));
        }
        Ok(GoalPath {
            path,
            purpose: goal.purpose.clone(),
            dependents,
            features: Vec::new(),
            sufficient_fraction: None,
        })
    }

    /// Predicts the uncertainty of the scan without images. `write` writes the poses and returns the
    /// scene. The distance of frames is halved along passes over features whose tolerance is not
    /// proven, as often as [`halvings_that_help`] predicts.
    pub fn refined(
        &mut self,
        sensor: &Scene,
        accel: Accel,
        write: &dyn Fn(String) -> Result<Scene>,
        control: &RunControl,
    ) -> Result<Simulation> {
        let laser_from_head = sensor.head_from_laser.inverse();
        let accel = Arc::new(accel);
        let simulated = |path: &PlannedPath| {
            let poses = path.passes.iter().flat_map(|pass| pass.poses());
            let scene = write(pose_table(poses.map(|pose| pose * laser_from_head)))?;
            Simulation::geometry_only(&scene, accel.clone())
        };
        let mut simulation = simulated(&self.path)?;
        if let PathPurpose::Surface(tolerance) = self.purpose {
            self.sufficient_fraction = sufficient(&simulation, tolerance, control)?;
            return Ok(simulation);
        }
        let mut points = simulation.aligned_points(control)?;
        self.features = simulation.features(&points);
        let mut left = MAX_REFINEMENTS;
        loop {
            let lacking: Vec<usize> = (0..self.features.len())
                .filter(|&i| excess(&self.features[i]) > 1.0)
                .collect();
            if lacking.is_empty() {
                break;
            }
            // The points are freed before the next scan is simulated.
            let thinned = simulation.features(&every_second_profile(std::mem::take(&mut points)));
            let halvings = halvings_that_help(&self.features, &thinned, &lacking, left);
            if halvings == 0 {
                break;
            }
            let needed =
                |target: &usize| self.dependents[*target].iter().any(|i| lacking.contains(i));
            let needed: Vec<bool> = (0..self.dependents.len()).map(|t| needed(&t)).collect();
            let before: f64 = lacking.iter().map(|&i| excess(&self.features[i])).sum();
            let mut finer = self.path.clone();
            let over = finer.passes.iter_mut();
            for pass in over.filter(|pass| pass.targets.iter().any(|&t| needed[t])) {
                pass.spacing /= 2f64.powi(halvings as i32);
            }
            let next = simulated(&finer)?;
            points = next.aligned_points(control)?;
            let features = next.features(&points);
            let after: f64 = lacking.iter().map(|&i| excess(&features[i])).sum();
            if after >= before * (1.0 - LEAST_DECREASE) {
                // The files are those of the coarser path.
                simulation = simulated(&self.path)?;
                break;
            }
            (self.path, self.features, simulation) = (finer, features, next);
            left -= halvings;
        }
        Ok(simulation)
    }

    /// Returns the summary.
    pub fn summary(self) -> PathSummary {
        PathSummary {
            length_mm: self.path.length_mm,
            spacings_mm: self.path.passes.iter().map(|pass| pass.spacing).collect(),
            targets: self.path.targets,
            features: self.features,
            sufficient_fraction: self.sufficient_fraction,
        }
    }
}

/// Returns the points of every second profile.
fn every_second_profile(mut points: Vec<CloudPoint>) -> Vec<CloudPoint> {
    let mut frames: Vec<u32> = points.iter().map(|point| point.frame).collect();
    frames.sort_unstable();
    frames.dedup();
    points.retain(|point| frames.binary_search(&point.frame).is_ok_and(|i| i % 2 == 0));
    points
}

/// Predicts how often, up to `most` times, the distance of frames must be halved to prove the
/// tolerances of the `lacking` features. A halving by which their smallest tolerances decrease by
/// less than [`LEAST_DECREASE`] does not count. The square of the smallest tolerance is the sum of a
/// constant and a part that is proportional to the distance. Both follow from the features of all
/// profiles and of every second profile.
fn halvings_that_help(
    all: &[FeatureResult],
    thinned: &[FeatureResult],
    lacking: &[usize],
    most: usize,
) -> usize {
    let predicted = |halvings: usize, i: usize| {
        let [square, of_thinned] = [all, thinned].map(|features| excess(&features[i]).powi(2));
        // A feature without a value has the excess 0.
        let proportional = match of_thinned > 0.0 {
            true => (of_thinned - square).clamp(0.0, square),
            false => square,
        };
        (square - proportional * (1.0 - 0.5f64.powi(halvings as i32))).sqrt()
    };
    let sum = |halvings| lacking.iter().map(|&i| predicted(halvings, i)).sum::<f64>();
    let is_lacking = |halvings| lacking.iter().any(|&i| predicted(halvings, i) > 1.0);
    (0..most)
        .take_while(|&n| is_lacking(n) && sum(n + 1) < sum(n) * (1.0 - LEAST_DECREASE))
        .count()
}

/// Returns the largest ratio of the smallest provable tolerance of a value to its tolerance.
fn excess(feature: &FeatureResult) -> f64 {
    let values = feature.quantities.iter();
    let ratios = values.filter_map(|q| {
        let [lower, upper] = q.tolerance?;
        Some(q.smallest_tolerance / (upper - lower))
    });
    ratios.fold(0.0, f64::max)
}

/// Returns the fraction of the valid points whose expanded uncertainty is at most the tolerance;
/// `None` without points.
fn sufficient(
    simulation: &Simulation,
    tolerance: f64,
    control: &RunControl,
) -> Result<Option<f64>> {
    let frames = simulation.scene.scan.frames;
    let stride = frames.div_ceil(MAX_FRAMES).max(1) as usize;
    let chosen: Vec<u32> = (0..frames).step_by(stride).collect();
    let counts = chosen.into_par_iter().map(|frame| {
        control.check()?;
        let points = simulation.profile(frame).1;
        let valid = points.iter().filter(|point| point.is_valid());
        let enough = |p: &&CloudPoint| GUARD_BAND_K * p.u_deviation <= tolerance;
        Ok([valid.clone().filter(enough).count(), valid.count()])
    });
    let counts = counts.collect::<Result<Vec<_>>>()?;
    let sum = |k: usize| counts.iter().map(|count| count[k]).sum::<usize>() as f64;
    Ok((sum(1) > 0.0).then(|| sum(0) / sum(1)))
}

/// Returns poses of the head as CSV.
pub(crate) fn pose_table(poses: impl IntoIterator<Item = Rigid>) -> String {
    let mut text = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n".to_owned();
    for pose in poses {
        let turn = DQuat::from_mat3(&pose.rotation).normalize();
        let [w, x, y, z] = [turn.w, turn.x, turn.y, turn.z];
        let at = pose.translation;
        let _ = writeln!(text, "{:.6},{:.6},{:.6},{w},{x},{y},{z}", at.x, at.y, at.z);
    }
    text
}
