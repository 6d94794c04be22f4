//! Uncertainty of the mean deviation of points.

use super::propagation::{SpeckleCorrelation, SystematicSums, add_along, by_name, correlated};
use super::quantity::ErrorContribution;
use super::spec::PointErrors;
use crate::inspect::cloud::CloudPoint;
use crate::profile::PARAMETERS;
use nalgebra::DVector;
use serde::Serialize;

/// Standard uncertainty of the mean deviation of points, with its sources.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeanUncertainty {
    /// Number of points.
    pub points: usize,
    /// Standard uncertainty of the mean, µm.
    pub standard_uncertainty_um: f64,
    /// True if the uncertainty is a lower bound, because the scene has no systematic errors of
    /// sensor and stage.
    pub lower_bound: bool,
    /// Contributions, µm. Their squares sum to the square of the standard uncertainty.
    pub sources: Vec<ErrorContribution>,
}

impl MeanUncertainty {
    /// Propagates the errors of the points to the mean of their deviations. Returns `None` without
    /// points.
    pub fn of(
        points: &[CloudPoint],
        errors: &dyn PointErrors,
        correlation: &SpeckleCorrelation,
    ) -> Option<MeanUncertainty> {
        let n = points.len() as f64;
        let mut noise = 0.0;
        let mut surface = 0.0;
        let mut calibration: DVector<f64> = DVector::zeros(PARAMETERS.len());
        let mut systematic = SystematicSums::new();
        let mut speckle = Vec::with_capacity(points.len());
        for point in points {
            let of = errors.of_point(point)?;
            let normal = point.normal.as_dvec3() / n;
            noise += normal.dot(of.noise).powi(2);
            surface += of.surface / n;
            if let Some(by) = &of.calibration {
                for (sum, by) in calibration.iter_mut().zip(by.iter()) {
                    *sum += normal.dot(*by);
                }
            }
            add_along(&mut systematic, &errors.systematic(point), normal);
            let by_speckle = DVector::from_element(1, normal.dot(of.speckle));
            speckle.push(((of.profile, of.column), by_speckle));
        }
        let speckle = correlated(&speckle, correlation, 1)[(0, 0)];
        let covariance = errors.calibration_covariance();
        let of_calibration = (0..PARAMETERS.len())
            .flat_map(|i| (0..PARAMETERS.len()).map(move |j| (i, j)))
            .map(|(i, j)| calibration[i] * covariance[i][j] * calibration[j])
            .sum::<f64>();
        let random = [
            ("noise", noise),
            ("speckle", speckle),
            ("calibration", of_calibration),
            ("surface", surface * surface),
        ];
        let random = random.map(|(name, variance)| ErrorContribution {
            name,
            standard_uncertainty: 1e3 * variance.max(0.0).sqrt(),
        });
        let by_name = by_name(&systematic, |sum| sum[0] * sum[0]);
        let systematic = by_name
            .into_iter()
            .map(|(name, variance)| ErrorContribution {
                name,
                standard_uncertainty: 1e3 * variance.sqrt(),
            });
        let sources: Vec<ErrorContribution> = random.into_iter().chain(systematic).collect();
        let squares = sources.iter().map(|s| s.standard_uncertainty.powi(2));
        Some(MeanUncertainty {
            points: points.len(),
            standard_uncertainty_um: squares.sum::<f64>().sqrt(),
            lower_bound: !errors.has_systematic(),
            sources,
        })
        .filter(|_| !points.is_empty())
    }
}
