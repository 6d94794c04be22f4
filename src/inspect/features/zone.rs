//! Widths of zones that contain all points of a feature, with the bias by errors of the points.
//!
//! Errors widen a zone. The true form is between W − w and W, where W is the width of the zone. The
//! expected widening w is the range of independent errors of the points near the extreme points.
//! The value is the centre of this interval, W − w/2. The remaining bias has a uniform distribution
//! over ±w/2.
//!
//! Errors are taken from the uncertainty of the points, but not larger than their scatter between
//! neighbouring points.

use super::element::{Residual, width};
use super::measured::Fit;
use super::propagation::{SystematicSums, add_along, by_name, sum_of};
use super::quantity::{ErrorContribution, Quantity};
use super::spec::PointErrors;
use crate::math::{DVec3, normal_quantile};
use crate::profile::PARAMETERS;
use nalgebra::{DVector, Vector6};
use std::collections::BTreeSet;
use std::f64::consts::SQRT_2;

/// Probability that the maximum of many normal errors is below its mean, exp(−exp(−γ)) of the
/// Gumbel distribution with Euler's constant γ.
const PROBABILITY_BELOW_MEAN: f64 = 0.570_376;
/// Number of points from which the widening is computed.
const MAX_SAMPLES: usize = 5_000;
/// Distance from the extreme point, in standard deviations, within which points may be extreme.
const EXTREME_SIGMAS: f64 = 4.0;

/// Effects of smooth errors on the distance of a point from the element.
struct SmoothErrors {
    calibration: DVector<f64>,
    systematic: SystematicSums,
}

/// Surface normal at a point, and the derivatives of its distance with respect to the parameters of
/// the element.
type Gradient = (DVec3, Vector6<f64>);

impl Fit {
    /// Returns the width of the minimum zone.
    pub fn form(&self, errors: &dyn PointErrors) -> Option<Quantity> {
        let positions = self.positions();
        let zone = self.element.minimum_zone(&positions)?;
        let distances = zone.distances(&positions);
        let order = |a: &usize, b: &usize| distances[*a].total_cmp(&distances[*b]);
        let low = (0..distances.len()).min_by(order)?;
        let high = (0..distances.len()).max_by(order)?;
        let gradient = |i: usize| {
            let Residual { normal, row, .. } = self.element.residual(positions[i]);
            (normal, row)
        };
        let measured = ("form_mm", width(&distances));
        let ends = [(low, -1.0), (high, 1.0)];
        Some(self.zone(measured, &distances, &ends, &gradient, errors))
    }

    /// Returns the width of the zone about the CAD face that contains the points.
    pub fn profile(&self, errors: &dyn PointErrors) -> Quantity {
        let deviation = |i: usize| self.measured[i].deviation;
        let order = |a: &usize, b: &usize| deviation(*a).abs().total_cmp(&deviation(*b).abs());
        let farthest = (0..self.measured.len()).max_by(order);
        let end = farthest.map(|i| (i, 2.0 * deviation(i).signum()));
        let gradient = |i: usize| (self.measured[i].normal.as_dvec3(), Vector6::zeros());
        let largest = farthest.map_or(0.0, |i| deviation(i).abs());
        let measured = ("profile_mm", 2.0 * largest);
        let distances: Vec<f64> = (0..self.measured.len()).map(deviation).collect();
        self.zone(measured, &distances, end.as_slice(), &gradient, errors)
    }

    /// Returns the quantity of a zone from its name, its measured width and the distances of the
    /// points. `ends` are the points that determine the width, with its derivatives with respect to
    /// their distances.
    fn zone(
        &self,
        (name, measured): (&'static str, f64),
        distances: &[f64],
        ends: &[(usize, f64)],
        gradient: &dyn Fn(usize) -> Gradient,
        errors: &dyn PointErrors,
    ) -> Quantity {
        let deviation = |i: usize| {
            let (normal, point) = (gradient(i).0, &self.points[i]);
            normal.dot(point.noise).hypot(normal.dot(point.speckle))
        };
        let at_ends = |of: &dyn Fn(usize) -> f64| {
            let squares = ends.iter().map(|&(i, by)| (by * of(i)).powi(2));
            squares.sum::<f64>().sqrt()
        };
        let deviations: Vec<f64> = (0..self.points.len()).map(deviation).collect();
        let by_noise = self.noise_widening(distances, &deviations, ends);
        let stride = self.points.len().div_ceil(MAX_SAMPLES).max(1);
        let samples: Vec<usize> = (0..self.points.len()).step_by(stride).collect();
        let smooth = |i: usize| self.smooth_errors(i, gradient(i), errors);
        let by_smooth = self.smooth_widening(&samples, &smooth, errors);
        let total = by_noise.hypot(by_smooth);
        let widened = total.min(measured);
        let of_widening = match total > 0.0 {
            true => widened / total / 12f64.sqrt(),
            false => 0.0,
        };
        let mut calibration: DVector<f64> = DVector::zeros(PARAMETERS.len());
        let mut systematic = SystematicSums::new();
        for &(i, by) in ends {
            let of = smooth(i);
            calibration += by * of.calibration;
            for (component, (name, change)) in of.systematic {
                sum_of(&mut systematic, component, name, 1)[0] += by * change[0];
            }
        }
        let source = |name, standard_uncertainty| ErrorContribution {
            name,
            standard_uncertainty,
        };
        let mut sources = vec![
            source(
                "noise and speckle of the extreme points",
                at_ends(&deviation),
            ),
            source("widening by noise and speckle", by_noise * of_widening),
            source("calibration", variance(&calibration, errors).sqrt()),
            source("surface", at_ends(&|i| self.points[i].surface)),
        ];
        let of_source = by_name(&systematic, |sum| sum[0] * sum[0]);
        sources.extend(
            of_source
                .into_iter()
                .map(|(name, v)| source(name, v.sqrt())),
        );
        if by_smooth > 0.0 {
            sources.push(source(
                "widening by systematic errors",
                by_smooth * of_widening,
            ));
        }
        let mut quantity = Quantity::new(name, [0.0, measured - widened / 2.0], sources, true);
        quantity.smallest_tolerance += total / 2.0;
        quantity
    }

    /// Returns the expected widening by independent errors with these standard deviations, mm.
    fn noise_widening(&self, distances: &[f64], deviations: &[f64], ends: &[(usize, f64)]) -> f64 {
        let squares: f64 = deviations.iter().map(|s| s * s).sum();
        let stated = (squares / deviations.len().max(1) as f64).sqrt();
        let found = self.scatter(distances).unwrap_or(stated);
        let ratio = if stated > found { found / stated } else { 1.0 };
        let of_end = |&(end, by): &(usize, f64)| {
            let outward = |i: usize| match ends.len() {
                1 => distances[i].abs(),
                _ => distances[i] * by.signum(),
            };
            let near = (0..distances.len())
                .filter(|&i| outward(end) - outward(i) <= EXTREME_SIGMAS * deviations[i]);
            let near: Vec<f64> = near.map(|i| ratio * deviations[i]).collect();
            let stride = near.len().div_ceil(MAX_SAMPLES).max(1);
            let samples: Vec<f64> = near.iter().step_by(stride).copied().collect();
            // The largest absolute error determines a zone about the CAD face.
            let tails = if ends.len() == 1 { 2.0 } else { 1.0 };
            let times = tails * near.len() as f64 / samples.len().max(1) as f64;
            by.abs() * expected_maximum(&samples, times)
        };
        ends.iter().map(of_end).sum()
    }

    /// Returns the standard deviation of the distances from the differences of points of a profile
    /// whose errors are not correlated, mm; `None` without such points. Points are sorted by profile
    /// and column.
    fn scatter(&self, distances: &[f64]) -> Option<f64> {
        let (mut sum, mut count, mut next) = (0.0, 0.0, 0);
        for (i, point) in self.points.iter().enumerate() {
            let first = (
                point.profile,
                point.column + self.correlation_length_columns,
            );
            let last = (
                point.profile,
                point.column + 2 * self.correlation_length_columns,
            );
            next = next.max(i + 1);
            let at = |j: usize| self.points.get(j).map(|p| (p.profile, p.column));
            while at(next).is_some_and(|at| at < first) {
                next += 1;
            }
            if at(next).is_some_and(|at| at <= last) {
                sum += (distances[next] - distances[i]).powi(2) / 2.0;
                count += 1.0;
            }
        }
        (count > 0.0).then(|| f64::sqrt(sum / count))
    }

    /// Returns the changes of a point's distance by calibration parameters and systematic errors.
    fn smooth_errors(
        &self,
        i: usize,
        (normal, row): Gradient,
        errors: &dyn PointErrors,
    ) -> SmoothErrors {
        let of_fit = self.errors.calibration.nrows();
        let row = row.rows(0, of_fit);
        let mut calibration = -(row.transpose() * &self.errors.calibration).transpose();
        if let Some(by) = &self.points[i].calibration {
            for (sum, by) in calibration.iter_mut().zip(by.iter()) {
                *sum += normal.dot(*by);
            }
        }
        let mut systematic = SystematicSums::new();
        for (&component, (name, by)) in &self.errors.systematic {
            systematic.insert(component, (name, DVector::from_element(1, -row.dot(by))));
        }
        add_along(
            &mut systematic,
            &errors.systematic(&self.measured[i]),
            normal,
        );
        SmoothErrors {
            calibration,
            systematic,
        }
    }

    /// Returns the expected widening by calibration and systematic errors, mm. Smooth errors widen a
    /// zone as independent errors of m points do, where m is the number of components.
    fn smooth_widening(
        &self,
        samples: &[usize],
        smooth: &dyn Fn(usize) -> SmoothErrors,
        errors: &dyn PointErrors,
    ) -> f64 {
        let (mut total, mut components) = (0.0, BTreeSet::new());
        for &i in samples {
            let of = smooth(i);
            total += variance(&of.calibration, errors);
            for (component, (_, by)) in of.systematic {
                total += by[0] * by[0];
                components.insert(component);
            }
        }
        let covariance = errors.calibration_covariance();
        let parameters = (0..PARAMETERS.len()).filter(|&i| covariance[i][i] > 0.0);
        let m = (components.len() + parameters.count()).min(self.points.len());
        let m = m.max(2) as f64;
        // Mean of the maximum of m normal values (Blom 1958).
        2.0 * (total / samples.len().max(1) as f64).sqrt()
            * normal_quantile((m - 0.375) / (m + 0.25))
    }
}

/// Returns the variance of a value by the calibration, from its derivatives.
fn variance(by: &DVector<f64>, errors: &dyn PointErrors) -> f64 {
    let covariance = errors.calibration_covariance();
    let terms = (0..by.len()).flat_map(|i| (0..by.len()).map(move |j| (i, j)));
    let sum: f64 = terms.map(|(i, j)| by[i] * covariance[i][j] * by[j]).sum();
    sum.max(0.0)
}

/// Returns the expected maximum of independent normal errors. Each standard deviation counts `times`
/// times.
fn expected_maximum(deviations: &[f64], times: f64) -> f64 {
    let largest = deviations.iter().fold(0.0, |most: f64, &s| most.max(s));
    let below = |x: f64| {
        let errors = deviations.iter().filter(|&&s| s > 0.0);
        let tails = errors.map(|s| (-0.5 * libm::erfc(x / s / SQRT_2)).ln_1p());
        (times * tails.sum::<f64>()).exp() < PROBABILITY_BELOW_MEAN
    };
    // 10 standard deviations are exceeded by one error of 1e23.
    let (mut low, mut high) = (0.0, 10.0 * largest);
    for _ in 0..40 {
        let center = (low + high) / 2.0;
        match below(center) {
            true => low = center,
            false => high = center,
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// The expected maximum of normal errors equals the mean over 4000 draws, within 5 standard
    /// errors and the 2 % by which the Gumbel distribution approximates the maximum of 20 errors.
    /// Standard deviations are drawn from 1 to 4.
    #[test]
    fn expected_maxima_are_means_over_draws() {
        const DRAWS: u64 = 4000;
        for (seed, n) in [(1, 20), (2, 100), (3, 400)] {
            let key = RngKey::new(seed, Purpose::Bootstrap);
            let deviations: Vec<f64> = (0..n).map(|i| 1.0 + 3.0 * key.uniform(i)).collect();
            let normal = |i: u64| normal_quantile(key.uniform(1000 + i));
            let maxima: Vec<f64> = (0..DRAWS)
                .map(|draw| {
                    let errors = deviations.iter().enumerate();
                    let errors = errors.map(|(i, s)| s * normal(draw * n + i as u64));
                    errors.fold(f64::NEG_INFINITY, f64::max)
                })
                .collect();
            let mean = maxima.iter().sum::<f64>() / DRAWS as f64;
            let squares: f64 = maxima.iter().map(|m| (m - mean).powi(2)).sum();
            let error = squares.sqrt() / DRAWS as f64;
            let found = expected_maximum(&deviations, 1.0);
            assert!(
                (found - mean).abs() < 5.0 * error + 0.02 * mean,
                "{n}: {found} {mean}"
            );
        }
        assert_eq!(expected_maximum(&[0.0; 5], 1.0), 0.0);
    }
}
