//! First-order propagation of the points' errors to the parameters of an element (JCGM 100).

use super::element::{Element, NormalEquations, Residual};
use crate::math::DVec3;
use crate::profile::PARAMETERS;
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Measured point with the sources of its error, part frame.
#[derive(Debug, Clone)]
pub struct FeaturePoint {
    /// Position, mm.
    pub position: DVec3,
    /// Index of the profile.
    pub profile: u32,
    /// Image column.
    pub column: u32,
    /// Displacement by one standard deviation of the noise, mm. Errors of points are independent.
    pub noise: DVec3,
    /// Displacement by one standard deviation of the speckle, mm. Errors of nearby points are
    /// correlated by [`SpeckleCorrelation`].
    pub speckle: DVec3,
    /// Standard uncertainty along the surface normal from partly lit walls, the chordal deviation and
    /// the curvature within the width of the line, mm. Errors of all points of a face have one sign.
    pub surface: f64,
    /// Derivatives of the position with respect to the calibration parameters; `None` for an exact
    /// calibration.
    pub calibration: Option<Box<[DVec3; PARAMETERS.len()]>>,
}

/// Displacement of a point by one standard deviation of an independent component of a systematic
/// error.
///
/// An error of constant value has one component. A component of an error that changes along the
/// travel or over the field affects only the points near its node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SystematicShift {
    /// Name of the source in the budget.
    pub name: &'static str,
    /// Index of the error, and of the component.
    pub component: (usize, u64),
    /// Displacement, part frame, mm.
    pub shift: DVec3,
}

/// Sums of the effects of systematic errors, by component, with the name of the source.
pub type SystematicSums = BTreeMap<(usize, u64), (&'static str, DVector<f64>)>;

/// Correlation of speckle errors at a lag of 0, 1, 2, … columns and profiles. The correlation at
/// both lags is the product.
#[derive(Debug, Clone)]
pub struct SpeckleCorrelation {
    /// Over columns of one profile.
    pub columns: Vec<f64>,
    /// Over profiles in one column.
    pub profiles: Vec<f64>,
}

/// Covariances of the parameters of an element, by source.
#[derive(Debug, Clone)]
pub struct ParameterErrors {
    /// Covariance by noise.
    pub noise: DMatrix<f64>,
    /// Covariance by speckle.
    pub speckle: DMatrix<f64>,
    /// Change of the parameters by one standard deviation of the common surface error.
    pub surface: DVector<f64>,
    /// Derivatives of the parameters with respect to the calibration parameters.
    pub calibration: DMatrix<f64>,
    /// Changes of the parameters by one standard deviation of the components of systematic errors.
    pub systematic: SystematicSums,
}

impl ParameterErrors {
    /// Propagates the errors of all points through the least-squares fit. `systematic` returns the
    /// displacements of the point of an index by systematic errors. Returns `None` if the points do
    /// not determine the element.
    pub fn of(
        element: &Element,
        points: &[FeaturePoint],
        systematic: &dyn Fn(usize) -> Vec<SystematicShift>,
        correlation: &SpeckleCorrelation,
    ) -> Option<ParameterErrors> {
        let positions: Vec<DVec3> = points.iter().map(|p| p.position).collect();
        let inverse = NormalEquations::of(element, &positions, None).inverse()?;
        let n = inverse.nrows();
        let mut errors = ParameterErrors {
            noise: DMatrix::zeros(n, n),
            speckle: DMatrix::zeros(n, n),
            surface: DVector::zeros(n),
            calibration: DMatrix::zeros(n, PARAMETERS.len()),
            systematic: SystematicSums::new(),
        };
        let mut of_speckle = Vec::with_capacity(points.len());
        for (i, point) in points.iter().enumerate() {
            let Residual { normal, row, .. } = element.residual(point.position);
            // Change of the parameters per displacement of the point along the normal.
            let gain = &inverse * row.rows(0, n);
            let noise = normal.dot(point.noise);
            errors.noise.syger(noise * noise, &gain, &gain, 1.0);
            errors.surface.axpy(point.surface, &gain, 1.0);
            if let Some(by) = &point.calibration {
                for (mut column, by) in errors.calibration.column_iter_mut().zip(by.iter()) {
                    column.axpy(normal.dot(*by), &gain, 1.0);
                }
            }
            for of in systematic(i) {
                let sum = sum_of(&mut errors.systematic, of.component, of.name, n);
                sum.axpy(normal.dot(of.shift), &gain, 1.0);
            }
            let at = (point.profile, point.column);
            of_speckle.push((at, gain * normal.dot(point.speckle)));
        }
        errors.noise.fill_upper_triangle_with_lower_triangle();
        errors.speckle = correlated(&of_speckle, correlation, n);
        Some(errors)
    }
}

/// Returns the sum of a component. A new sum is a zero vector of `dimension` entries.
pub fn sum_of<'a>(
    sums: &'a mut SystematicSums,
    component: (usize, u64),
    name: &'static str,
    dimension: usize,
) -> &'a mut DVector<f64> {
    let (_, sum) = (sums.entry(component)).or_insert_with(|| (name, DVector::zeros(dimension)));
    sum
}

/// Adds the displacements along `direction` to sums of one entry.
pub fn add_along(sums: &mut SystematicSums, shifts: &[SystematicShift], direction: DVec3) {
    for of in shifts {
        sum_of(sums, of.component, of.name, 1)[0] += direction.dot(of.shift);
    }
}

/// Returns the variances by source, in the order of the errors.
pub fn by_name(
    sums: &SystematicSums,
    variance: impl Fn(&DVector<f64>) -> f64,
) -> Vec<(&'static str, f64)> {
    let mut all: Vec<(&'static str, f64)> = Vec::new();
    for (name, sum) in sums.values() {
        match all.iter_mut().find(|(known, _)| known == name) {
            Some((_, total)) => *total += variance(sum),
            None => all.push((name, variance(sum))),
        }
    }
    all
}

/// Returns Σ_ij ρ_ij·v_i·v_jᵀ of the vectors at (profile, column).
pub fn correlated(
    vectors: &[((u32, u32), DVector<f64>)],
    correlation: &SpeckleCorrelation,
    n: usize,
) -> DMatrix<f64> {
    let mut profiles: BTreeMap<u32, BTreeMap<u32, DVector<f64>>> = BTreeMap::new();
    for ((profile, column), vector) in vectors {
        let profile = profiles.entry(*profile).or_default();
        let sum = profile.entry(*column);
        *sum.or_insert_with(|| DVector::zeros(n)) += vector;
    }
    let columns = &correlation.columns;
    let reach = columns.len().saturating_sub(1) as u32;
    // Sums over the columns of each profile, at every column that a point may be correlated with.
    let smooth = |profile: &BTreeMap<u32, DVector<f64>>| {
        let mut sums: BTreeMap<u32, DVector<f64>> = BTreeMap::new();
        for (&column, vector) in profile {
            for at in column.saturating_sub(reach)..=column + reach {
                let rho = columns.get(at.abs_diff(column) as usize);
                let sum = sums.entry(at).or_insert_with(|| DVector::zeros(n));
                sum.axpy(rho.copied().unwrap_or(0.0), vector, 1.0);
            }
        }
        sums
    };
    let smoothed: BTreeMap<u32, BTreeMap<u32, DVector<f64>>> = profiles
        .iter()
        .map(|(&profile, vectors)| (profile, smooth(vectors)))
        .collect();
    let lags = correlation.profiles.len().saturating_sub(1) as u32;
    let mut covariance = DMatrix::zeros(n, n);
    for (&profile, vectors) in &profiles {
        for (&other, sums) in smoothed.range(profile.saturating_sub(lags)..=profile + lags) {
            let rho = correlation.profiles[other.abs_diff(profile) as usize];
            for (column, vector) in vectors {
                if let Some(sum) = sums.get(column) {
                    covariance.ger(rho, vector, sum, 1.0);
                }
            }
        }
    }
    (&covariance + covariance.transpose()) / 2.0
}
