//! Relations of two features.

use super::element::{Element, Shape};
use super::measured::{Fit, MeasuredFeature};
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
/// The ends of both faces are the last points on either side, in each profile or, for a gap across
/// the scan, in each column. The edge lies between the last point and the next position without
/// one, with a uniform distribution over the point distance. The errors of all profiles are equal,
/// because the positions of the columns are.
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
    let end = |fit: &Fit, sign: f64| {
        let along = fit.face.edge_points().map(|p| sign * toward.dot(p));
        sign * along.fold(f64::NEG_INFINITY, f64::max)
    };
    let nominal = end(b, -1.0) - end(a, 1.0);
    let found = [
        ends(a, b, toward, |&(_, profile, _)| profile),
        ends(a, b, toward, |&(_, _, column)| column),
    ];
    let (gaps, spacing) = found
        .into_iter()
        .filter(|(gaps, spacing)| !gaps.is_empty() && spacing.is_finite())
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .ok_or("no profile and no column has points on both faces")?;
    let measured = gaps.iter().sum::<f64>() / gaps.len() as f64 - spacing;
    let sources = vec![ErrorContribution {
        name: "point distance",
        // Two independent uniform distributions of half-width `spacing`.
        standard_uncertainty: spacing * (2f64 / 3.0).sqrt(),
    }];
    Ok(Quantity::new("gap_mm", [nominal, measured], sources, false))
}

/// Returns the distances of the last points of both faces in each row of points, and the median
/// distance of points along these rows.
fn ends(
    a: &Fit,
    b: &Fit,
    toward: DVec3,
    row: impl Fn(&(DVec3, u32, u32)) -> u32,
) -> (Vec<f64>, f64) {
    let collect = |fit: &Fit| {
        let mut rows: BTreeMap<u32, Vec<f64>> = BTreeMap::new();
        for point in &fit.on_face {
            let along = rows.entry(row(point)).or_default();
            along.push(toward.dot(point.0));
        }
        rows
    };
    let (first, second) = (collect(a), collect(b));
    let mut steps: Vec<f64> = Vec::new();
    for along in first.values() {
        let mut along = along.clone();
        along.sort_by(f64::total_cmp);
        steps.extend(along.windows(2).map(|pair| pair[1] - pair[0]));
    }
    steps.sort_by(f64::total_cmp);
    let spacing = steps.get(steps.len() / 2).copied();
    let gaps = first.iter().filter_map(|(row, along)| {
        let last = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let next = second.get(row)?.iter().copied();
        Some(next.fold(f64::INFINITY, f64::min) - last)
    });
    // Points of a row perpendicular to the gap do not advance along it.
    let spacing = spacing.filter(|s| *s > 0.0).unwrap_or(f64::INFINITY);
    (gaps.collect(), spacing)
}
