//! Relations of two features.

use super::element::{Element, Shape};
use super::measured::{FacePoint, Fit, MeasuredFeature};
use super::quantity::{ErrorContribution, Joint, Quantity};
use super::spec::{self, FeatureResult, FeatureSpec, PointErrors, Relation};
use crate::math::DVec3;
use std::collections::BTreeMap;

/// Evaluates a relation of two measured features, given with their names.
pub fn evaluate(
    feature: &FeatureSpec,
    relation: Relation,
    of: [Option<(&String, &MeasuredFeature)>; 2],
    errors: &dyn PointErrors,
) -> FeatureResult {
    let mut fits = Vec::new();
    for of in of {
        match of.map(|(name, measured)| (name, &measured.fit)) {
            Some((_, Ok(fit))) => fits.push(fit),
            Some((name, Err(problem))) => {
                return spec::empty(feature, &format!("{name} has no value: {problem}"));
            }
            None => return spec::empty(feature, "a relation of a relation has no value"),
        }
    }
    let joint = Joint {
        measured: fits.iter().map(|fit| fit.element).collect(),
        nominal: fits.iter().map(|fit| fit.nominal).collect(),
        errors: fits.iter().map(|fit| &fit.errors).collect(),
        calibration: errors.calibration_covariance(),
    };
    let height = |e: &[Element]| vec![height(&e[0], &e[1])];
    let quantities = match relation {
        Relation::StepHeight => Ok(vec![joint.quantity("height_mm", false, &height)]),
        Relation::Distance => {
            let distance = |e: &[Element]| vec![distance(&e[0], &e[1])];
            Ok(vec![joint.quantity("distance_mm", false, &distance)])
        }
        Relation::Angle => {
            let angle = |e: &[Element]| vec![angle(&e[0], &e[1])];
            Ok(vec![joint.quantity("angle_deg", false, &angle)])
        }
        Relation::GapFlush => {
            let flush = joint.quantity("flush_mm", false, &height);
            gap(fits[0], fits[1]).map(|gap| vec![gap, flush])
        }
    };
    match quantities {
        Err(problem) => spec::empty(feature, &problem),
        Ok(quantities) => FeatureResult {
            problem: None,
            points: fits.iter().map(|fit| fit.on_face.len()).sum(),
            quantities: quantities
                .into_iter()
                .map(|q| {
                    let limits = feature.tolerance.get(q.name).copied();
                    q.with_tolerance(limits)
                })
                .collect(),
            ..spec::empty(feature, "")
        },
    }
}

/// Returns the height of the origin of `b` above plane `a`.
fn height(a: &Element, b: &Element) -> f64 {
    let away = b.frame.translation - a.frame.translation;
    a.frame.rotation.z_axis.dot(away)
}

/// Returns the distance of two elements: from a plane along its normal, from an axis perpendicular
/// to it, and otherwise between the centres. The other element is represented by its centre.
fn distance(a: &Element, b: &Element) -> f64 {
    let is_plane = |e: &Element| matches!(e.shape, Shape::Plane);
    let has_axis = |e: &Element| matches!(e.shape, Shape::Cylinder | Shape::Cone | Shape::Line);
    let away = b.frame.translation - a.frame.translation;
    match (is_plane(a), is_plane(b)) {
        (true, _) => height(a, b).abs(),
        (_, true) => height(b, a).abs(),
        _ if has_axis(a) => away.reject_from_normalized(direction(a)).length(),
        _ if has_axis(b) => away.reject_from_normalized(direction(b)).length(),
        _ => away.length(),
    }
}

/// Returns the direction of an element: the normal of a plane, the axis, or the line.
fn direction(e: &Element) -> DVec3 {
    match e.shape {
        Shape::Line => e.frame.rotation.x_axis,
        _ => e.frame.rotation.z_axis,
    }
}

/// Returns the angle between two planes (between their normals), two axes, or an axis and a plane,
/// degrees.
fn angle(a: &Element, b: &Element) -> f64 {
    let between = direction(a).angle_between(direction(b)).to_degrees();
    let planes = [a, b].map(|e| e.shape == Shape::Plane);
    match planes[0] == planes[1] {
        true => between,
        false => (90.0 - between).abs(),
    }
}

/// Returns the gap between two faces, along the first plane and perpendicular to the gap.
///
/// Each edge follows from the light of the points beyond the last interior point of each profile or,
/// for a gap across the scan, of each column. Pixels and blur distribute this light over several
/// points, but do not change its sum. The error of an edge has a uniform distribution over one point
/// distance on both sides, for the light below the detection threshold. The errors of all profiles are
/// equal, because the positions of the columns are. The error by speckle and noise of this light follows
/// from its scatter over the rows.
fn gap(a: &Fit, b: &Fit) -> Result<Quantity, String> {
    let normal = a.nominal.frame.rotation.z_axis;
    let across = b.nominal.frame.translation - a.nominal.frame.translation;
    // The gap is perpendicular to the edge of the first face that is nearest to the second.
    let across = across.reject_from_normalized(normal);
    let toward = a
        .face
        .nearest_edge(b.nominal.frame.translation)
        .and_then(|edge| across.reject_from_normalized(edge).try_normalize())
        .ok_or("the faces have no edges that face each other")?;
    let end = |fit: &Fit, direction: DVec3| {
        let along = fit.face.edge_points().map(|p| direction.dot(p));
        along.fold(f64::NEG_INFINITY, f64::max)
    };
    let nominal = -end(b, -toward) - end(a, toward);
    let edges = |row: fn(&FacePoint) -> u32| {
        let [a, b] = [face_rows(a, toward, row), face_rows(b, -toward, row)];
        let both: Vec<u32> = a
            .keys()
            .copied()
            .filter(|row| b.contains_key(row))
            .collect();
        Some([mean_edge(&a, &both)?, mean_edge(&b, &both)?])
    };
    let found = [edges(|p| p.profile), edges(|p| p.column)];
    let [first, second] = found
        .into_iter()
        .flatten()
        .min_by(|a, b| a[0].spacing.total_cmp(&b[0].spacing))
        .ok_or("no profile and no column has points on both faces")?;
    let measured = -second.position - first.position;
    let sources = vec![
        ErrorContribution {
            name: "point distance",
            // Two independent uniform distributions of half-width `spacing`.
            standard_uncertainty: first.spacing.hypot(second.spacing) / 3f64.sqrt(),
        },
        ErrorContribution {
            name: "light at the edges",
            standard_uncertainty: first.scatter.hypot(second.scatter),
        },
    ];
    Ok(Quantity::new("gap_mm", [nominal, measured], sources, false))
}

/// Points of one profile or column: position towards the edge, light, and whether the point is
/// interior, from the edge inwards.
type FaceRow = Vec<(f64, f64, bool)>;

/// Number of interior points next to the edge whose mean light is the light of a complete line.
const REFERENCE_POINTS: usize = 10;

/// Returns the points of a face by profile or column, for rows with interior points.
fn face_rows(fit: &Fit, direction: DVec3, row: fn(&FacePoint) -> u32) -> BTreeMap<u32, FaceRow> {
    let mut rows: BTreeMap<u32, FaceRow> = BTreeMap::new();
    for point in &fit.on_face {
        let along = direction.dot(point.position);
        let of_row = rows.entry(row(point)).or_default();
        of_row.push((along, point.intensity, point.is_interior));
    }
    rows.retain(|_, points| points.iter().any(|(.., is_interior)| *is_interior));
    for points in rows.values_mut() {
        points.sort_by(|a, b| b.0.total_cmp(&a.0));
    }
    rows
}

/// Edge of a face.
struct MeanEdge {
    /// Mean position over the rows, mm.
    position: f64,
    /// Median distance of points along the rows, mm.
    spacing: f64,
    /// Standard deviation of the position by the scatter of the light over the rows, mm.
    scatter: f64,
}

/// Returns the variance of the mean of a series with the correlation of its values, estimated up to
/// the first lag without a positive correlation.
///
/// Deviations from the mean of the series reduce each covariance by the variance of this mean. The sum
/// over 2 L + 1 lags of both signs is therefore divided by n − 2 L − 1, at least by n/4 (a choice).
fn variance_of_mean(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let covariance = |lag: usize| {
        let pairs = values.iter().zip(&values[lag..]);
        pairs.map(|(a, b)| (a - mean) * (b - mean)).sum::<f64>() / n
    };
    let positive = (1..values.len()).map(covariance).take_while(|c| *c > 0.0);
    let lags: Vec<f64> = positive.collect();
    let sum = covariance(0) + 2.0 * lags.iter().sum::<f64>();
    sum / (n - 2.0 * lags.len() as f64 - 1.0).max(n / 4.0)
}

/// Returns the mean edge of the rows with these keys. Returns `None` without rows, and if the points
/// of a row do not advance towards the edge.
fn mean_edge(rows: &BTreeMap<u32, FaceRow>, keys: &[u32]) -> Option<MeanEdge> {
    let rows: Vec<&FaceRow> = keys.iter().filter_map(|key| rows.get(key)).collect();
    let steps = rows.iter().flat_map(|row| row.windows(2));
    let mut steps: Vec<f64> = steps.map(|pair| pair[0].0 - pair[1].0).collect();
    steps.sort_by(f64::total_cmp);
    let spacing = steps.get(steps.len() / 2).copied().filter(|s| *s > 0.0)?;
    let (mut last, mut beyond, mut complete) = (Vec::new(), Vec::new(), Vec::new());
    for row in &rows {
        let interior = || row.iter().filter(|(.., is_interior)| *is_interior);
        last.push(interior().next()?.0);
        let outside = row.iter().take_while(|(.., is_interior)| !is_interior);
        beyond.push(outside.map(|(_, light, _)| light).sum::<f64>());
        let reference = interior().take(REFERENCE_POINTS);
        let sum: f64 = reference.clone().map(|(_, light, _)| light).sum();
        complete.push(sum / reference.count() as f64);
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let complete_line = mean(&complete);
    let of_rows = last.iter().zip(&beyond);
    let of_rows = of_rows.map(|(last, beyond)| last + spacing * beyond / complete_line);
    let of_rows: Vec<f64> = of_rows.collect();
    let columns = mean(&beyond) / complete_line;
    let relative = variance_of_mean(&complete).sqrt() / complete_line;
    // The pixel of the last interior point extends half of a point distance towards the edge.
    Some(MeanEdge {
        position: mean(&of_rows) + spacing / 2.0,
        spacing,
        scatter: variance_of_mean(&of_rows)
            .sqrt()
            .hypot(spacing * columns * relative),
    })
    .filter(|edge| edge.position.is_finite())
}
