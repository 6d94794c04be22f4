//! Features of the part: associated elements, their values compared with the CAD, uncertainties and
//! verdicts.
//!
//! An element is fitted to the measured points by least squares (the associated feature of ISO
//! 25378). Form is the width of the minimum zone. The nominal element is the fit to the vertices of
//! the CAD face.

mod element;
mod faces;
mod mean;
mod measured;
mod nominal;
mod propagation;
mod quantity;
mod relation;
mod spec;
mod zone;

pub use element::{Element, Shape};
pub(crate) use faces::faces;
pub use mean::MeanUncertainty;
pub(crate) use nominal::NominalFace;
pub use propagation::{FeaturePoint, ParameterErrors, SpeckleCorrelation, SystematicShift};
pub(crate) use quantity::is_magnitude;
pub use quantity::{Conformance, ErrorContribution, Quantity};
pub use spec::{
    FeatureKind, FeatureResult, FeatureSpec, NominalPart, PlottedResidual, PointErrors, Relation,
    Section, Selection,
};

use super::cloud::CloudPoint;
use measured::MeasuredFeature;

/// Evaluates all features from the points of a scan.
pub fn evaluate(
    features: &[FeatureSpec],
    part: &NominalPart,
    points: &[CloudPoint],
    errors: &dyn PointErrors,
) -> Vec<FeatureResult> {
    if features.is_empty() {
        return Vec::new();
    }
    let correlation = errors.correlation(points);
    let measured: Vec<Option<MeasuredFeature>> = features
        .iter()
        .map(|feature| MeasuredFeature::of(feature, part, points, errors, &correlation))
        .collect();
    let of = |(i, feature): (usize, &FeatureSpec)| match &feature.kind {
        FeatureKind::Relation { relation, of } => {
            let [a, b] = of.map(|j| measured[j].as_ref().map(|m| (&features[j].name, m)));
            relation::evaluate(feature, *relation, [a, b], errors)
        }
        _ => measured[i]
            .as_ref()
            .map_or_else(|| spec::empty(feature, ""), |m| m.result(feature, errors)),
    };
    let results = features.iter().enumerate().map(of);
    let lower_bound = !errors.has_systematic();
    results
        .map(|result| FeatureResult {
            lower_bound,
            ..result
        })
        .collect()
}
