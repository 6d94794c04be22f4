//! Values of features with uncertainty and conformance.

use super::element::Element;
use super::propagation::{ParameterErrors, SystematicSums, by_name, sum_of};
use crate::inspect::tolerance::GUARD_BAND_K;
use crate::math::chi_squared_quantile;
use crate::profile::{Covariance, PARAMETERS};
use nalgebra::{DMatrix, SymmetricEigen};
use serde::Serialize;

/// Conformance with a tolerance by ISO 14253-1, with the expanded uncertainty U as guard band.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Conformance {
    /// The value is inside the limits by at least U.
    Conforms,
    /// The value is outside the limits by more than U.
    DoesNotConform,
    /// The value is closer to a limit than U.
    Undecided,
}

impl Conformance {
    /// Returns the verdict as text.
    pub fn text(self) -> &'static str {
        match self {
            Conformance::Conforms => "conforms",
            Conformance::DoesNotConform => "does not conform",
            Conformance::Undecided => "undecided",
        }
    }
}

/// Contribution of a source to the standard uncertainty of a value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorContribution {
    /// Name of the source.
    pub name: &'static str,
    /// Standard uncertainty by this source alone, in the unit of the value.
    pub standard_uncertainty: f64,
}

/// Value of a feature. All numbers are in the unit at the end of the name: mm or degrees.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantity {
    /// Name with the unit.
    pub name: &'static str,
    /// Value of the CAD.
    pub nominal: f64,
    /// Measured value.
    pub measured: f64,
    /// Measured minus nominal value.
    pub deviation: f64,
    /// Standard uncertainty u of the measured value.
    pub standard_uncertainty: f64,
    /// Expanded uncertainty U = k·u, for a coverage probability of about 95 %: k = 2, and 2 to 2.9
    /// for a displacement or tilt, which has errors in two or three directions.
    pub expanded_uncertainty: f64,
    /// Contributions to the standard uncertainty. Their squares sum to its square.
    pub sources: Vec<ErrorContribution>,
    /// Lower and upper limit of the deviation; `null` without a tolerance.
    pub tolerance: Option<[f64; 2]>,
    /// Conformance; `null` without a tolerance.
    pub conformance: Option<Conformance>,
    /// Ratio U/T of the expanded uncertainty and the width of the tolerance; `null` without a
    /// tolerance.
    pub u_over_t: Option<f64>,
    /// Width of the smallest tolerance whose conformance can be proven for a part without a
    /// deviation: 2·U, or U for a value that cannot be negative, plus the expected bias of a form.
    pub smallest_tolerance: f64,
}

/// Elements of a quantity: measured, nominal, and errors of the parameters.
pub struct Joint<'a> {
    pub measured: Vec<Element>,
    pub nominal: Vec<Element>,
    pub errors: Vec<&'a ParameterErrors>,
    pub calibration: &'a Covariance,
}

/// Step of the numerical derivatives, mm and rad.
const STEP: f64 = 1e-6;

impl Joint<'_> {
    /// Returns a quantity of the elements. A magnitude is the length of the vector that `of`
    /// returns; other quantities are its only component.
    pub fn quantity(
        &self,
        name: &'static str,
        is_magnitude: bool,
        of: &dyn Fn(&[Element]) -> Vec<f64>,
    ) -> Quantity {
        let value = |vector: Vec<f64>| match is_magnitude {
            true => vector.iter().map(|v| v * v).sum::<f64>().sqrt(),
            false => vector[0],
        };
        let (measured, nominal) = (of(&self.measured), of(&self.nominal));
        let dimension = measured.len();
        let mut noise = DMatrix::zeros(dimension, dimension);
        let (mut speckle, mut surface) = (noise.clone(), noise.clone());
        let mut systematic = SystematicSums::new();
        let mut by_calibration = DMatrix::zeros(dimension, PARAMETERS.len());
        for (i, errors) in self.errors.iter().enumerate() {
            let jacobian = self.jacobian(i, dimension, of);
            noise += &jacobian * &errors.noise * jacobian.transpose();
            speckle += &jacobian * &errors.speckle * jacobian.transpose();
            let by_surface = &jacobian * &errors.surface;
            surface += &by_surface * by_surface.transpose();
            by_calibration += &jacobian * &errors.calibration;
            for (&component, (name, by)) in &errors.systematic {
                *sum_of(&mut systematic, component, name, dimension) += &jacobian * by;
            }
        }
        let n = PARAMETERS.len();
        let parameters = DMatrix::from_fn(n, n, |i, j| self.calibration[i][j]);
        let calibration = &by_calibration * parameters * by_calibration.transpose();
        let mut all = &noise + &speckle + &surface + &calibration;
        for (_, sum) in systematic.values() {
            all += sum * sum.transpose();
        }
        // A magnitude has the uncertainty of its most uncertain direction, because the direction of
        // a small deviation is unknown.
        let eigen = SymmetricEigen::new(all);
        let direction = eigen.eigenvectors.column(eigen.eigenvalues.imax());
        let along = |c: &DMatrix<f64>| (direction.transpose() * c * direction)[0].max(0.0).sqrt();
        let mut sources = vec![
            ErrorContribution {
                name: "noise",
                standard_uncertainty: along(&noise),
            },
            ErrorContribution {
                name: "speckle",
                standard_uncertainty: along(&speckle),
            },
            ErrorContribution {
                name: "calibration",
                standard_uncertainty: along(&calibration),
            },
            ErrorContribution {
                name: "surface",
                standard_uncertainty: along(&surface),
            },
        ];
        let factor = match is_magnitude {
            true => magnitude_factor(eigen.eigenvalues.as_slice()),
            false => GUARD_BAND_K,
        };
        let of_source = by_name(&systematic, |sum| direction.dot(sum).powi(2));
        sources.extend(
            of_source
                .into_iter()
                .map(|(name, variance)| ErrorContribution {
                    name,
                    standard_uncertainty: variance.sqrt(),
                }),
        );
        let values = [value(nominal), value(measured)];
        Quantity::new(name, values, sources, is_magnitude).with_coverage_factor(factor)
    }

    /// Returns the derivatives with respect to the parameters of element `i`.
    fn jacobian(
        &self,
        i: usize,
        dimension: usize,
        of: &dyn Fn(&[Element]) -> Vec<f64>,
    ) -> DMatrix<f64> {
        let count = self.measured[i].shape.parameters();
        let mut jacobian = DMatrix::zeros(dimension, count);
        for k in 0..count {
            let at = |step: f64| {
                let mut by = nalgebra::DVector::zeros(count);
                by[k] = step;
                let mut elements = self.measured.clone();
                elements[i] = elements[i].changed(&by).anchored(&self.nominal[i]);
                of(&elements)
            };
            for (d, (up, down)) in at(STEP).iter().zip(at(-STEP)).enumerate() {
                jacobian[(d, k)] = (up - down) / (2.0 * STEP);
            }
        }
        jacobian
    }
}

impl Quantity {
    /// Creates a quantity from the nominal and the measured value, and its sources.
    pub fn new(
        name: &'static str,
        [nominal, measured]: [f64; 2],
        sources: Vec<ErrorContribution>,
        is_magnitude: bool,
    ) -> Quantity {
        let squares = sources.iter().map(|s| s.standard_uncertainty.powi(2));
        let u = squares.sum::<f64>().sqrt();
        let expanded = GUARD_BAND_K * u;
        Quantity {
            name,
            nominal,
            measured,
            deviation: measured - nominal,
            standard_uncertainty: u,
            expanded_uncertainty: expanded,
            sources,
            tolerance: None,
            conformance: None,
            u_over_t: None,
            smallest_tolerance: if is_magnitude { 1.0 } else { 2.0 } * expanded,
        }
    }

    /// Returns the quantity with another coverage factor.
    fn with_coverage_factor(mut self, factor: f64) -> Quantity {
        let ratio = factor / GUARD_BAND_K;
        self.expanded_uncertainty *= ratio;
        self.smallest_tolerance *= ratio;
        self
    }

    /// Returns the quantity with its tolerance and conformance. A lower limit of 0 or less has no
    /// effect for values that cannot be negative.
    pub fn with_tolerance(mut self, limits: Option<[f64; 2]>) -> Quantity {
        let Some([lower, upper]) = limits else {
            return self;
        };
        let (d, guard) = (self.deviation, self.expanded_uncertainty);
        let bounded = !(is_magnitude(self.name) && lower <= 0.0);
        let conforms = d <= upper - guard && (!bounded || d >= lower + guard);
        let fails = d > upper + guard || bounded && d < lower - guard;
        self.tolerance = limits;
        self.conformance = Some(match (conforms, fails) {
            (true, _) => Conformance::Conforms,
            (_, true) => Conformance::DoesNotConform,
            _ => Conformance::Undecided,
        });
        self.u_over_t = Some(guard / (upper - lower));
        self
    }
}

/// Returns the coverage factor of the length of a vector with normal errors, from the variances in
/// its principal directions. The true length is 0; it is contained more often if it is larger.
///
/// The sum of squares has the mean Σλ and the variance 2·Σλ². A scaled χ² distribution with equal
/// moments (Satterthwaite 1946) gives the quantile. One direction has k = 2.
fn magnitude_factor(variances: &[f64]) -> f64 {
    let sum: f64 = variances.iter().map(|v| v.max(0.0)).sum();
    let squares: f64 = variances.iter().map(|v| v.max(0.0).powi(2)).sum();
    let largest = variances.iter().copied().fold(0.0, f64::max);
    if largest <= 0.0 {
        return GUARD_BAND_K;
    }
    let (scale, freedom) = (squares / sum, sum * sum / squares);
    let quantile = scale * chi_squared_quantile(0.95, freedom);
    GUARD_BAND_K * (quantile / largest / chi_squared_quantile(0.95, 1.0)).sqrt()
}

/// True if a quantity cannot be negative, and its nominal value is 0.
pub(crate) fn is_magnitude(name: &str) -> bool {
    matches!(
        name,
        "tilt_deg" | "form_mm" | "displacement_mm" | "profile_mm"
    )
}
