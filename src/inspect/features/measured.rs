//! Points of a face and the element fitted to them.

use super::element::{Element, Shape};
use super::nominal::NominalFace;
use super::propagation::{FeaturePoint, ParameterErrors, SpeckleCorrelation, SystematicSums};
use super::quantity::{Joint, Quantity};
use super::spec::{
    self, FeatureKind, FeatureResult, FeatureSpec, NominalPart, PlottedResidual, PointErrors,
    Selection,
};
use crate::inspect::cloud::CloudPoint;
use crate::math::DVec3;
use crate::profile::Flags;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Smallest arc about an axis that a circle, cylinder or cone is evaluated on, degrees. The centre
/// and the radius are separated by 1 − cos of half the arc, 1.5 %.
const LEAST_ARC_DEG: f64 = 20.0;
/// Smallest number of points per parameter of an element.
const LEAST_POINTS: usize = 3;
/// Maximum number of selections of outliers.
const MOST_REJECTIONS: usize = 10;
/// Maximum number of points in a picture.
const MOST_PLOTTED: usize = 2000;

/// Measured feature.
pub struct MeasuredFeature {
    /// Numbers of points with a flag, near an edge, and excluded as outliers.
    counts: [usize; 3],
    /// Fit, or the reason why there is none.
    pub fit: Result<Fit, String>,
}

/// Element fitted to the points of a face.
pub struct Fit {
    pub nominal: Element,
    pub element: Element,
    pub errors: ParameterErrors,
    /// CAD face of the feature.
    pub face: NominalFace,
    /// Points of the fit.
    pub points: Vec<FeaturePoint>,
    /// All points on the face without margin, including points at discontinuities.
    pub on_face: Vec<FacePoint>,
    /// Measured points of the fit, in the order of `points`.
    pub measured: Vec<CloudPoint>,
    /// Number of columns from which errors of points of one profile are not correlated.
    pub correlation_length_columns: u32,
}

/// Point on a face, for the position of its edges.
pub struct FacePoint {
    pub position: DVec3,
    pub profile: u32,
    pub column: u32,
    /// Light of the line in the column.
    pub intensity: f64,
    /// True for a point without flags whose distance from the edges is at least the margin.
    pub is_interior: bool,
}

/// Point on a face.
struct OnFace<'a> {
    point: &'a CloudPoint,
    /// Nearest point of the CAD.
    nearest: DVec3,
    /// True if the distance from the edges of the face and of shadows is at least the margin.
    is_inside: bool,
}

impl OnFace<'_> {
    /// Returns the point of a round element without the distance of the CAD triangle from the element.
    /// The triangles of a scanned part are known. If the part has other triangles, the distance is an
    /// uncertainty: a uniform distribution with this half-width.
    fn on_element(
        &self,
        mut point: FeaturePoint,
        nominal: &Element,
        is_scanned: bool,
    ) -> FeaturePoint {
        if matches!(nominal.shape, Shape::Plane | Shape::Line) {
            return point;
        }
        let chord = nominal.residual(self.nearest);
        match is_scanned {
            true => point.position -= chord.normal * chord.distance,
            false => point.surface = point.surface.hypot(chord.distance / 3f64.sqrt()),
        }
        point
    }

    fn edge_point(&self) -> FacePoint {
        FacePoint {
            position: self.point.position,
            profile: self.point.frame,
            column: self.point.column,
            intensity: self.point.intensity,
            is_interior: self.is_inside && self.point.flags.is_empty(),
        }
    }
}

/// Flags of points at the ends of a face that do not exclude them.
const AT_EDGES: Flags = Flags::DISCONTINUITY.union(Flags::UNCERTAINTY_NOT_VALID);

impl MeasuredFeature {
    /// Measures a feature; `None` for a relation.
    pub fn of(
        feature: &FeatureSpec,
        part: &NominalPart,
        points: &[CloudPoint],
        errors: &dyn PointErrors,
        correlation: &SpeckleCorrelation,
    ) -> Option<MeasuredFeature> {
        let (shape, selection, section) = match &feature.kind {
            FeatureKind::Element {
                shape,
                selection,
                section,
                ..
            } => (Some(*shape), selection, section.as_ref()),
            FeatureKind::Profile { selection } => (None, selection, None),
            FeatureKind::Relation { .. } => return None,
        };
        let mut counts = [0; 3];
        let mut fitted = || {
            let face = NominalFace::select(part.accel, part.groups, selection)?;
            // A profile needs no element; a plane carries its points.
            let nominal = match shape {
                Some(shape) => face.element(part.accel, shape, section)?,
                None => Element {
                    shape: Shape::Plane,
                    frame: crate::math::Rigid::translation(face.bounds.center()),
                    radius: 0.0,
                    half_angle: 0.0,
                },
            };
            let margin = |p: &CloudPoint| selection.margin.unwrap_or_else(|| errors.edge_margin(p));
            let is_inside = |p: &CloudPoint, to_edge: f64| {
                let margin = margin(p);
                to_edge >= margin && errors.is_open(p, margin)
            };
            let mut on_face = on_face(part, &face, points, &is_inside);
            if let Some(section) = section {
                let normal = nominal.frame.rotation.y_axis;
                on_face.retain(|p| {
                    let off = normal.dot(p.point.position - section.point);
                    off.abs() <= section.width / 2.0
                });
            }
            let all = on_face.iter().filter(|p| AT_EDGES.contains(p.point.flags));
            let all = all.map(OnFace::edge_point).collect();
            let total = on_face.len();
            on_face.retain(|p| p.point.flags.is_empty());
            counts[0] = total - on_face.len();
            let before = on_face.len();
            on_face.retain(|p| p.is_inside);
            counts[1] = before - on_face.len();
            let used: Vec<(FeaturePoint, CloudPoint)> = on_face
                .iter()
                .filter_map(|p| {
                    let of = errors.of_point(p.point)?;
                    Some((p.on_element(of, &nominal, part.is_scanned), *p.point))
                })
                .collect();
            let least = LEAST_POINTS * shape.map_or(3, Shape::parameters);
            if used.len() < least {
                return Err(too_few(used.len(), least, &face, selection, counts));
            }
            let fit = match shape {
                None => Fit::of_profile(nominal, face, used, (selection, correlation)),
                Some(_) => Fit::of(nominal, face, used, selection, (errors, correlation))?,
            };
            counts[2] = before - counts[1] - fit.points.len();
            Ok(Fit {
                on_face: all,
                ..fit
            })
        };
        let fit = fitted();
        Some(MeasuredFeature { counts, fit })
    }

    /// Returns the result of an element or a profile.
    pub fn result(&self, feature: &FeatureSpec, errors: &dyn PointErrors) -> FeatureResult {
        let [flagged, near_edge, outliers] = self.counts;
        let mut result = FeatureResult {
            flagged,
            near_edge,
            outliers,
            ..spec::empty(feature, "")
        };
        let fit = match &self.fit {
            Ok(fit) => fit,
            Err(problem) => {
                result.problem = Some(problem.clone());
                return result;
            }
        };
        let quantities = match &feature.kind {
            FeatureKind::Element { shape, form, .. } => fit.quantities(*shape, *form, errors),
            _ => vec![fit.profile(errors)],
        };
        if let Some(problem) = undetermined_radius(&quantities) {
            result.problem = Some(problem);
            return result;
        }
        result.problem = None;
        result.points = fit.points.len();
        result.picture = fit.picture(&feature.kind);
        result.quantities = quantities
            .into_iter()
            .map(|q| {
                let limits = feature.tolerance.get(q.name).copied();
                q.with_tolerance(limits)
            })
            .collect();
        result
    }
}

/// Largest standard uncertainty of a radius relative to the radius. Second-order terms, which the
/// propagation omits, are then 5 % of the uncertainty.
const MAX_RELATIVE_U_RADIUS: f64 = 0.05;

/// Returns the message for a round element whose points do not determine the radius.
fn undetermined_radius(quantities: &[Quantity]) -> Option<String> {
    let diameter = quantities.iter().find(|q| q.name == "diameter_mm")?;
    let u = diameter.standard_uncertainty;
    (u > MAX_RELATIVE_U_RADIUS * diameter.nominal).then(|| {
        format!(
            "the points do not determine the diameter: its standard uncertainty is {u:.2} mm, expected at most 5 % of \
             {:.2} mm; a longer arc or more points are needed",
            diameter.nominal
        )
    })
}

/// Returns the message for a feature with too few points. `counts` starts with the numbers of flagged
/// points and of points near an edge.
fn too_few(
    usable: usize,
    least: usize,
    face: &NominalFace,
    selection: &Selection,
    [flagged, near_edge, _]: [usize; 3],
) -> String {
    let margin = match selection.margin {
        Some(margin) => format!("{margin} mm"),
        None => "two beam radii and the column spacing".to_owned(),
    };
    format!(
        "{usable} usable points on the {} triangles of the CAD face, expected at least {least}: \
         {flagged} have a flag, and {near_edge} are closer than {margin} to an edge of the face or of \
         a shadow. See the coverage of the CAD surface",
        face.triangles.len()
    )
}

/// Returns the points whose nearest CAD triangle is in the face. `is_inside` returns whether a point
/// with a distance from the edges of the face is far enough from all edges.
fn on_face<'a>(
    part: &NominalPart,
    face: &NominalFace,
    points: &'a [CloudPoint],
    is_inside: &(impl Fn(&CloudPoint, f64) -> bool + Sync),
) -> Vec<OnFace<'a>> {
    let near = |p: &CloudPoint| {
        let reach = DVec3::splat(p.deviation.abs() + part.accel.resolution());
        let [low, high] = [face.bounds.min - reach, face.bounds.max + reach];
        low.cmple(p.position).all() && p.position.cmple(high).all()
    };
    points
        .par_iter()
        .filter(|p| near(p))
        .filter_map(|point| {
            let nearest = part.accel.nearest(point.position, None);
            face.contains(nearest.face).then(|| OnFace {
                point,
                nearest: nearest.point,
                is_inside: is_inside(point, face.edge_distance(nearest.point)),
            })
        })
        .collect()
}

impl Fit {
    /// Fits an element to the points and excludes outliers.
    fn of(
        nominal: Element,
        face: NominalFace,
        used: Vec<(FeaturePoint, CloudPoint)>,
        selection: &Selection,
        (errors, correlation): (&dyn PointErrors, &SpeckleCorrelation),
    ) -> Result<Fit, String> {
        check_arc(&nominal, &used)?;
        let positions: Vec<DVec3> = used.iter().map(|(p, _)| p.position).collect();
        let name = nominal.shape.name();
        let no = || {
            format!(
                "the {} points do not determine a {name}: they lie on too small a part of it",
                used.len()
            )
        };
        let kept = used.len() - (selection.outliers * used.len() as f64) as usize;
        let mut chosen: Vec<usize> = (0..used.len()).collect();
        let mut element = nominal.fitted(&positions, None).ok_or_else(no)?;
        for _ in 0..MOST_REJECTIONS {
            let distances = element.distances(&positions);
            let mut order: Vec<usize> = (0..used.len()).collect();
            order.sort_by(|&a, &b| distances[a].abs().total_cmp(&distances[b].abs()));
            order.truncate(kept);
            order.sort_unstable();
            if order == chosen {
                break;
            }
            chosen = order;
            let of_chosen: Vec<DVec3> = chosen.iter().map(|&i| positions[i]).collect();
            element = element.fitted(&of_chosen, None).ok_or_else(no)?;
        }
        let (mut points, measured): (Vec<FeaturePoint>, Vec<CloudPoint>) =
            chosen.iter().map(|&i| used[i].clone()).unzip();
        let element = element.anchored(&nominal);
        for (point, measured) in points.iter_mut().zip(&measured) {
            let of_curvature = errors.curvature_error(measured, &element);
            point.surface = point.surface.hypot(of_curvature);
        }
        let systematic = |i: usize| errors.systematic(&measured[i]);
        let errors = ParameterErrors::of(&element, &points, &systematic, correlation);
        let errors = errors.ok_or_else(no)?;
        Ok(Fit {
            nominal,
            element,
            errors,
            face,
            points,
            on_face: Vec::new(),
            measured,
            correlation_length_columns: correlation.columns.len().max(1) as u32,
        })
    }

    /// Selects the points of a profile of a surface.
    fn of_profile(
        nominal: Element,
        face: NominalFace,
        mut used: Vec<(FeaturePoint, CloudPoint)>,
        (selection, correlation): (&Selection, &SpeckleCorrelation),
    ) -> Fit {
        let kept = used.len() - (selection.outliers * used.len() as f64) as usize;
        used.sort_by(|a, b| (a.1.deviation.abs()).total_cmp(&b.1.deviation.abs()));
        used.truncate(kept);
        used.sort_by_key(|(point, _)| (point.profile, point.column));
        let (points, measured) = used.into_iter().unzip();
        Fit {
            nominal,
            element: nominal,
            errors: ParameterErrors {
                noise: nalgebra::DMatrix::zeros(3, 3),
                speckle: nalgebra::DMatrix::zeros(3, 3),
                surface: nalgebra::DVector::zeros(3),
                calibration: nalgebra::DMatrix::zeros(3, crate::profile::PARAMETERS.len()),
                systematic: SystematicSums::new(),
            },
            face,
            points,
            on_face: Vec::new(),
            measured,
            correlation_length_columns: correlation.columns.len().max(1) as u32,
        }
    }

    pub fn positions(&self) -> Vec<DVec3> {
        self.points.iter().map(|p| p.position).collect()
    }

    fn quantities(&self, shape: Shape, form: bool, errors: &dyn PointErrors) -> Vec<Quantity> {
        let joint = Joint {
            measured: vec![self.element],
            nominal: vec![self.nominal],
            errors: vec![&self.errors],
            calibration: errors.calibration_covariance(),
        };
        let nominal = self.nominal;
        let origin = nominal.frame.translation;
        let axis = nominal.frame.rotation.z_axis;
        let mut quantities = Vec::new();
        if matches!(shape, Shape::Circle | Shape::Cylinder | Shape::Sphere) {
            let diameter = |e: &[Element]| vec![2.0 * e[0].radius];
            quantities.push(joint.quantity("diameter_mm", false, &diameter));
        }
        if shape == Shape::Cone {
            let angle = |e: &[Element]| vec![2.0 * e[0].half_angle.to_degrees()];
            quantities.push(joint.quantity("angle_deg", false, &angle));
        }
        match shape {
            Shape::Plane | Shape::Line => {
                let offset = |e: &[Element]| vec![axis.dot(e[0].frame.translation - origin)];
                quantities.push(joint.quantity("offset_mm", false, &offset));
            }
            _ => {
                for (i, name) in ["x_mm", "y_mm", "z_mm"].into_iter().enumerate() {
                    // The position along an axis is not defined.
                    let along = shape.is_round() && axis[i].abs() > 1.0 - 1e-9;
                    if !along {
                        let at = |e: &[Element]| vec![e[0].frame.translation[i]];
                        quantities.push(joint.quantity(name, false, &at));
                    }
                }
                let away = |e: &[Element]| (e[0].frame.translation - origin).to_array().to_vec();
                quantities.push(joint.quantity("displacement_mm", true, &away));
            }
        }
        let direction = |e: &Element| match shape {
            Shape::Line => e.frame.rotation.x_axis,
            _ => e.frame.rotation.z_axis,
        };
        if !matches!(shape, Shape::Sphere | Shape::Circle) {
            // The chord of a small angle; its error is below 1e-4 of it up to 2°.
            let tilt = |e: &[Element]| {
                let turned = direction(&e[0]) - direction(&nominal);
                (turned * 1f64.to_degrees()).to_array().to_vec()
            };
            quantities.push(joint.quantity("tilt_deg", true, &tilt));
        }
        if form && let Some(form) = self.form(errors) {
            quantities.push(form);
        }
        quantities
    }

    /// Returns the points and residuals of a picture.
    fn picture(&self, kind: &FeatureKind) -> Vec<PlottedResidual> {
        let part_from = self.element.frame;
        let of_profile = matches!(kind, FeatureKind::Profile { .. });
        let stride = self.points.len().div_ceil(MOST_PLOTTED).max(1);
        let deviations = self.measured.iter().map(|point| point.deviation);
        let plotted = self.points.iter().zip(deviations).step_by(stride);
        plotted
            .map(|(point, deviation)| {
                let p = part_from.inverse().point(point.position);
                let at = match self.element.shape.is_round() {
                    true => [p.y.atan2(p.x).to_degrees(), p.z],
                    false => [p.x, p.y],
                };
                let residual = match of_profile {
                    true => deviation,
                    false => self.element.residual(point.position).distance,
                };
                PlottedResidual { at, residual }
            })
            .collect()
    }
}

/// Checks that the points cover enough of a round element.
fn check_arc(nominal: &Element, used: &[(FeaturePoint, CloudPoint)]) -> Result<(), String> {
    let local = nominal.frame.inverse();
    let local = used.iter().map(|(p, _)| local.point(p.position));
    let name = nominal.shape.name();
    let arc = if nominal.shape.is_round() {
        let mut angles: Vec<f64> = local.map(|p| p.y.atan2(p.x)).collect();
        angles.sort_by(f64::total_cmp);
        let gaps = angles.windows(2).map(|pair| pair[1] - pair[0]);
        let closing = TAU + angles[0] - angles[angles.len() - 1];
        TAU - gaps.fold(closing, f64::max)
    } else if nominal.shape == Shape::Sphere {
        let directions: Vec<DVec3> = local.map(DVec3::normalize_or_zero).collect();
        let mean = directions.iter().sum::<DVec3>().normalize_or_zero();
        let angles = directions.iter().map(|d| d.angle_between(mean));
        2.0 * angles.fold(0.0, f64::max)
    } else {
        return Ok(());
    };
    match arc.to_degrees() {
        arc if arc < LEAST_ARC_DEG => Err(format!(
            "the points cover an arc of {arc:.1}° of the {name}, expected at least \
             {LEAST_ARC_DEG}°: a smaller arc does not separate the centre from the radius"
        )),
        _ => Ok(()),
    }
}
