//! Features of the part from the points of a scan: errors of the points, and the table of results.

use super::measure::{is_wall, trace};
use super::simulation::Simulation;
use super::systematic::ErrorShift;
use crate::accel::Ray;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::features::{
    self, Element, FeaturePoint, FeatureResult, MeanUncertainty, NominalPart, PointErrors, Shape,
    SpeckleCorrelation, SystematicShift,
};
use crate::math::{DMat3, DVec2, DVec3};
use crate::profile::Covariance;
use std::io::{self, Write};

impl Simulation {
    /// Evaluates the features of the scene from the points of a scan.
    pub fn features(&self, points: &[CloudPoint]) -> Vec<FeatureResult> {
        self.features_with(points, self)
    }

    /// Evaluates the features from points with these errors.
    pub(super) fn features_with(
        &self,
        points: &[CloudPoint],
        errors: &dyn PointErrors,
    ) -> Vec<FeatureResult> {
        let scene = &self.scene;
        let nominal = scene.nominal.as_ref();
        let part = NominalPart {
            accel: self.accel.nominal(),
            groups: nominal.map_or(&*scene.groups, |nominal| &*nominal.groups),
            is_scanned: nominal.is_none(),
        };
        features::evaluate(&scene.features, &part, points, errors)
    }
}

/// Node of the Gauss–Hermite rule of three nodes, in standard deviations.
const ROOT_3: f64 = 1.732_050_807_568_877_2;
/// Number of steps to the intersection of a ray with an element. Each squares the error, which is less
/// than the beam radius before the first step.
const NEWTON_STEPS: usize = 4;
/// Numbers of points whose mean deviation is evaluated.
const MEANS: [usize; 3] = [1, 100, 10_000];

impl Simulation {
    /// Returns the drawn errors of a source at the start of the scan, in the units of their effects.
    #[doc(hidden)]
    pub fn systematic_values(&self, name: &str) -> Vec<f64> {
        (self.systematic.as_deref()).map_or(Vec::new(), |errors| errors.values(name))
    }

    /// Returns the standard deviations of the errors of a source.
    #[doc(hidden)]
    pub fn systematic_deviations(&self, name: &str) -> Vec<f64> {
        let errors = self.scene.systematic.errors.iter();
        let errors = errors.filter(|error| error.name == name);
        errors.map(|error| error.standard_deviation).collect()
    }

    /// Returns the uncertainty of the mean deviation of points.
    #[doc(hidden)]
    pub fn mean_uncertainty(&self, points: &[CloudPoint]) -> Option<MeanUncertainty> {
        MeanUncertainty::of(points, self, &PointErrors::correlation(self, points))
    }
}

/// Returns the uncertainties of the mean of 1, 100 and 10 000 points without a flag. The points are
/// consecutive in the scan, around its middle.
pub(super) fn means(points: &[CloudPoint], errors: &dyn PointErrors) -> Vec<MeanUncertainty> {
    let valid = points.iter().filter(|point| point.flags.is_empty());
    let valid: Vec<CloudPoint> = valid.copied().collect();
    let of = |n: usize| {
        let first = valid.len().checked_sub(n)? / 2;
        let points = &valid[first..first + n];
        MeanUncertainty::of(points, errors, &errors.correlation(points))
    };
    MEANS.into_iter().filter_map(of).collect()
}

impl PointErrors for Simulation {
    fn of_point(&self, point: &CloudPoint) -> Option<FeaturePoint> {
        let pixel = DVec2::new(f64::from(point.column) + 0.5, point.row);
        let jacobian = self.calibration.point_jacobian(pixel)?;
        let part_from_head = self.scene.part_from_head(point.frame);
        let by_row = part_from_head.vector(jacobian.by_pixel[1]);
        let per_row = by_row.length();
        let covariance = self.calibration.point_covariance(&jacobian);
        let frame = f64::from(point.frame);
        let systematic = self.systematic_covariance(pixel, &jacobian, frame, &part_from_head);
        let systematic = systematic.unwrap_or(DMat3::ZERO);
        let noise = point.repeatability / per_row;
        let common = trace(&covariance) + trace(&systematic);
        let of_row = (point.u_position.powi(2) - common).max(0.0) / per_row.powi(2);
        let speckle = (of_row - noise * noise).max(0.0).sqrt();
        let normal = point.normal.as_dvec3();
        let in_head = part_from_head.inverse().vector(normal);
        let of_position = normal.dot(by_row).powi(2) * of_row + in_head.dot(covariance * in_head);
        let known = of_position + normal.dot(systematic * normal);
        // The deviation of a point next to an edge contains errors along the surface, because either
        // of two surfaces may be the nearest. The face of a feature is known. Along its normal, only
        // partly lit walls and the chordal deviation add to the errors of the position.
        let chord = self.chord_variance();
        let surface = match is_wall(of_position, per_row * per_row * of_row + trace(&covariance)) {
            true => {
                let wall = self.partial_light_covariance(pixel, jacobian.point);
                let largest = chord + in_head.dot(wall * in_head);
                (point.u_deviation.powi(2) - known).clamp(0.0, largest)
            }
            false => chord,
        };
        let by_parameters = jacobian.by_parameters;
        let exact = self.calibration.is_exact();
        Some(FeaturePoint {
            position: point.position,
            profile: point.frame / self.scene.measure.filters.average_frames,
            column: point.column,
            noise: by_row * noise,
            speckle: by_row * speckle,
            surface: surface.sqrt(),
            calibration: (!exact)
                .then(|| Box::new(by_parameters.map(|by| part_from_head.vector(by)))),
        })
    }

    fn correlation(&self, points: &[CloudPoint]) -> SpeckleCorrelation {
        let filters = &self.scene.measure.filters;
        let columns = match filters.smooth.is_some() || filters.resample.is_some() {
            false => self.column_correlation().to_vec(),
            true => triangle(self.correlated_points(points)),
        };
        SpeckleCorrelation {
            columns,
            profiles: self.speckle_over_profiles(points),
        }
    }

    /// The margin is the sum of two beam radii (1/e²) across the line and the column spacing along
    /// it, both on the surface.
    fn edge_margin(&self, point: &CloudPoint) -> f64 {
        let normal = point.normal.as_dvec3();
        let on_surface = 2.0 * self.beam_radius(point) / self.across_line(point).length();
        let pixel = DVec2::new(f64::from(point.column) + 0.5, point.row);
        let Some(jacobian) = self.calibration.point_jacobian(pixel) else {
            return f64::INFINITY;
        };
        let in_head = self
            .scene
            .part_from_head(point.frame)
            .inverse()
            .vector(normal);
        let [by_column, by_row] = jacobian.by_pixel;
        let rows = -in_head.dot(by_column) / in_head.dot(by_row);
        on_surface + (by_column + by_row * rows).length()
    }

    /// Tests 5 × 3 lines of sight from a square around the point to laser and camera. At the laser, the
    /// five lines across are up to two beam radii from the axis. Objects closer than `distance` to the
    /// surface, and those between the lines, do not count.
    fn is_open(&self, point: &CloudPoint, distance: f64) -> bool {
        if distance == 0.0 {
            return true;
        }
        let across = self.across_line(point).normalize_or_zero();
        let along = point.normal.as_dvec3().cross(across);
        let pose = self.head_pose(point.frame);
        let beam = across * 2.0 * self.scene.laser.radius(DVec3::ZERO);
        let is_free = |end: DVec3, at_end: DVec3| {
            let ray = |i: i32| {
                let (a, b) = (f64::from(i / 3 - 2) / 2.0, f64::from(i % 3 - 1));
                let from = point.position + (across * a + along * b) * distance;
                let to = end + at_end * a;
                let above = from + (to - from).normalize_or_zero() * distance;
                Ray::between(above, to)
            };
            let rays: Vec<Ray> = (0..15).filter_map(ray).collect();
            self.accel.occluded(&rays) == 0
        };
        is_free(pose.part_from_laser.translation, beam)
            && is_free(pose.part_from_camera.translation, DVec3::ZERO)
    }

    /// Averages the rows of light at three Gauss–Hermite nodes across the beam, where the standard
    /// deviation of the irradiance is half the beam radius. The light of a node is in proportion to the
    /// cosine of the angle to the camera, as from a diffuse surface.
    fn curvature_error(&self, point: &CloudPoint, element: &Element) -> f64 {
        if matches!(element.shape, Shape::Plane | Shape::Line) {
            return 0.0;
        }
        let pose = self.head_pose(point.frame);
        let camera_from_part = pose.part_from_camera.inverse();
        let across = pose.part_from_laser.rotation.y_axis * (self.beam_radius(point) / 2.0);
        let beam = (point.position - pose.part_from_laser.translation).normalize_or_zero();
        let level = element.residual(point.position).distance;
        let at = |offset: f64| {
            let mut p = point.position + across * offset;
            for _ in 0..NEWTON_STEPS {
                let residual = element.residual(p);
                p -= beam * ((residual.distance - level) / residual.normal.dot(beam));
            }
            let to_camera = pose.part_from_camera.translation - p;
            let cosine = element
                .residual(p)
                .normal
                .dot(to_camera.normalize_or_zero());
            let row = self.scene.camera.project(camera_from_part.point(p))?.y;
            Some((row, cosine.abs()))
        };
        let (Some(middle), Some(below), Some(above)) = (at(0.0), at(-ROOT_3), at(ROOT_3)) else {
            return 0.0;
        };
        let nodes = [(4.0, middle), (1.0, below), (1.0, above)];
        let light: f64 = nodes
            .iter()
            .map(|(weight, (_, light))| weight * light)
            .sum();
        let rows = nodes
            .iter()
            .map(|(weight, (row, light))| weight * light * (row - middle.0));
        let rows = rows.sum::<f64>() / light;
        let pixel = DVec2::new(f64::from(point.column) + 0.5, point.row);
        let Some(jacobian) = self.calibration.point_jacobian(pixel) else {
            return 0.0;
        };
        let by_row = self
            .scene
            .part_from_head(point.frame)
            .vector(jacobian.by_pixel[1]);
        let error = element.residual(point.position).normal.dot(by_row) * rows;
        // Not finite where the beam is tangent to the element.
        if error.is_finite() { error } else { 0.0 }
    }

    fn calibration_covariance(&self) -> &Covariance {
        &self.calibration.covariance
    }

    fn systematic(&self, point: &CloudPoint) -> Vec<SystematicShift> {
        let Some(errors) = self.systematic.as_deref() else {
            return Vec::new();
        };
        let pixel = DVec2::new(f64::from(point.column) + 0.5, point.row);
        let Some(jacobian) = self.calibration.point_jacobian(pixel) else {
            return Vec::new();
        };
        let place = f64::from(point.frame);
        let part_from_head = self.scene.part_from_head(point.frame);
        let mut all = Vec::new();
        for ErrorShift { error, shift } in errors.shifts(pixel, &jacobian, place, &part_from_head) {
            errors.nodes(error, place, jacobian.point, &mut |node, weight| {
                all.push(SystematicShift {
                    name: errors.name(error),
                    component: (error, node),
                    shift: shift * weight,
                });
            });
        }
        all
    }

    fn has_systematic(&self) -> bool {
        self.systematic.is_some()
    }
}

impl Simulation {
    /// Returns the radius of the laser beam (1/e²) at a point, mm.
    fn beam_radius(&self, point: &CloudPoint) -> f64 {
        let part_from_laser = self.head_pose(point.frame).part_from_laser;
        let in_laser = part_from_laser.inverse().point(point.position);
        self.scene.laser.radius(in_laser)
    }

    /// Returns the normal of the laser plane, projected onto the surface at a point.
    fn across_line(&self, point: &CloudPoint) -> DVec3 {
        let part_from_laser = self.head_pose(point.frame).part_from_laser;
        let normal_of_plane = part_from_laser.rotation.y_axis;
        normal_of_plane.reject_from_normalized(point.normal.as_dvec3())
    }

    /// Returns the median number of columns within which the errors of filtered points are alike.
    fn correlated_points(&self, points: &[CloudPoint]) -> f64 {
        let columns = points.iter().filter(|p| p.is_valid()).filter_map(|p| {
            let pixel = DVec2::new(f64::from(p.column) + 0.5, p.row);
            let jacobian = self.calibration.point_jacobian(pixel)?;
            Some(p.correlation_length / jacobian.by_pixel[0].length())
        });
        let mut columns: Vec<f64> = columns.filter(|n| n.is_finite()).collect();
        columns.sort_by(f64::total_cmp);
        columns.get(columns.len() / 2).map_or(1.0, |n| n.max(1.0))
    }
}

/// Returns the triangular correlation whose sum over both signs of the lag is `sum`.
fn triangle(sum: f64) -> Vec<f64> {
    let lags = sum.ceil() as usize;
    (0..lags.max(1))
        .map(|lag| (1.0 - lag as f64 / sum).max(0.0))
        .collect()
}

/// Name of the table of features; written only if the scene has features.
pub const TABLE: &str = "features.csv";

/// Columns of the table.
const COLUMNS: &str = "feature,kind,quantity,nominal,measured,deviation,standard_uncertainty,\
                       expanded_uncertainty,lower,upper,conformance,u_over_t,smallest_tolerance,\
                       points,problem,lower_bound";

/// Writes the values of all features as CSV, in the unit at the end of the quantity's name.
pub fn write_csv(out: &mut dyn Write, features: &[FeatureResult]) -> io::Result<()> {
    writeln!(out, "{COLUMNS}")?;
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    for feature in features {
        let (name, kind, points) = (quoted(&feature.name), feature.kind, feature.points);
        if let Some(problem) = &feature.problem {
            writeln!(
                out,
                "{name},{kind},,,,,,,,,,,,{points},{},",
                quoted(problem)
            )?;
        }
        for q in &feature.quantities {
            let limits = q
                .tolerance
                .map_or(",".to_owned(), |[a, b]| format!("{a},{b}"));
            writeln!(
                out,
                "{name},{kind},{},{},{},{},{},{},{limits},{},{},{},{points},,{}",
                q.name,
                q.nominal,
                q.measured,
                q.deviation,
                q.standard_uncertainty,
                q.expanded_uncertainty,
                q.conformance.map_or("", |verdict| verdict.text()),
                q.u_over_t.map_or(String::new(), |ratio| ratio.to_string()),
                q.smallest_tolerance,
                feature.lower_bound,
            )?;
        }
    }
    Ok(())
}

/// Returns the values of all features as text, one line per value.
#[cfg(feature = "cli")]
pub fn features_text(features: &[FeatureResult]) -> String {
    let mut text = String::new();
    for feature in features {
        if let Some(problem) = &feature.problem {
            text += &format!("{}: no value. {problem}\n", feature.name);
        }
        let least = if feature.lower_bound { "≥ " } else { "" };
        for q in &feature.quantities {
            let (name, unit) = q.name.rsplit_once('_').unwrap_or((q.name, ""));
            let verdict = q
                .conformance
                .map_or(String::new(), |verdict| format!(", {}", verdict.text()));
            text += &format!(
                "{} {name}: {:.4} {unit}, nominal {:.4}, deviation {:+.4}, U {least}{}{verdict}\n",
                feature.name,
                q.measured,
                q.nominal,
                q.deviation,
                crate::report::chart::uncertainty(q.expanded_uncertainty)
            );
        }
    }
    text
}
