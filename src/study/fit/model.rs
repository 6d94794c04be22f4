//! Model of the covariance of heights: noise, output filter, topography and rounding.

use super::moments::{Block, COUNT, Detrending, Moments, mean};
use crate::math::{Z95, students_quantile};
use crate::profile::GAUSSIAN_REACH;
use crate::study::least_squares::{derivatives, minimum};
use crate::study::patches::SIDE;
use nalgebra::{DMatrix, DVector};

/// Filters that are tried.
const FILTERS: [Filter; 6] = [
    Filter::None,
    Filter::Mean(3),
    Filter::Mean(5),
    Filter::Mean(7),
    Filter::Mean(9),
    Filter::Gaussian,
];
/// Standard deviations of Gaussian filters that are accepted, columns. A narrower one is no filter,
/// and the covariances of areas of [`SIDE`] columns do not determine a wider one.
const GAUSSIAN_SIGMAS: std::ops::RangeInclusive<f64> = 0.4..=6.0;
/// Largest distance of a column with a weight in a Gaussian filter.
const GAUSSIAN_COLUMNS: isize = SIDE as isize / 2;
/// Ratio of an improvement to its standard error above which a filter or a topography is accepted.
/// One without effect exceeds it with a probability of 16 %.
const ACCEPTED: f64 = 1.0;
/// Largest standard error of the logarithm of a length that the data determine.
const LARGEST_LOG_ERROR: f64 = 0.5;
/// Smallest variance of the noise of a surface with topography, relative to the variance of heights.
const LEAST_NOISE: f64 = 1e-4;
/// Largest inverse hyperbolic tangent of twice a correlation, which is then within 0.5 % of its
/// bound.
const LARGEST_ARTANH: f64 = 3.0;
/// Probability that a correct model is reported as a misfit. An omitted weak term adds to it; the
/// sum is below 5 %.
const FALSE_MISFIT: f64 = 0.02;

/// Output filter along the profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filter {
    /// No filter.
    None,
    /// Moving average over a number of columns.
    Mean(usize),
    /// Gaussian filter; its standard deviation is a parameter.
    Gaussian,
}

impl Filter {
    /// Returns the autocorrelation of the weights at lags of 0, 1, … columns. The covariance of
    /// filtered heights is its convolution with that of the heights.
    fn autocorrelation(self, sigma: f64) -> Vec<f64> {
        let weights: Vec<f64> = match self {
            Filter::None => vec![1.0],
            Filter::Mean(n) => vec![1.0 / n as f64; n],
            Filter::Gaussian => {
                let reach = (GAUSSIAN_REACH * sigma).ceil() as isize;
                let reach = reach.min(GAUSSIAN_COLUMNS);
                let weight = |k: isize| (-0.5 * (k as f64 / sigma).powi(2)).exp();
                let weights = (-reach..=reach).map(weight);
                let total: f64 = weights.clone().sum();
                weights.map(|weight| weight / total).collect()
            }
        };
        let product = |lag: usize| {
            weights
                .iter()
                .zip(&weights[lag..])
                .map(|(a, b)| a * b)
                .sum()
        };
        (0..weights.len()).map(product).collect()
    }

    /// Returns the sum of the squares of the weights of a first estimate.
    fn noise_reduction(self) -> f64 {
        self.autocorrelation(1.0)[0]
    }
}

/// Terms of a model in addition to white noise and rounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terms {
    /// Filter along the profile.
    pub filter: Filter,
    /// Whether the noise of adjacent columns is correlated before the filter.
    pub columns: bool,
    /// Whether the noise of adjacent profiles is correlated.
    pub profiles: bool,
    /// Whether the surface has a topography.
    pub topography: bool,
}

impl Terms {
    /// Returns all models. A Gaussian filter has no correlation of adjacent columns in addition,
    /// because a filter that is slightly wider has nearly equal covariances.
    fn all() -> impl Iterator<Item = Terms> {
        let terms = FILTERS.into_iter().flat_map(|filter| {
            (0..8).map(move |bits| Terms {
                filter,
                columns: bits & 1 > 0,
                profiles: bits & 2 > 0,
                topography: bits & 4 > 0,
            })
        });
        terms.filter(|terms| !(terms.columns && terms.filter == Filter::Gaussian))
    }

    fn parameters(&self) -> usize {
        1 + usize::from(self.columns)
            + usize::from(self.profiles)
            + 2 * usize::from(self.topography)
            + usize::from(self.filter == Filter::Gaussian)
    }

    /// Returns the number of structures that have keys: filter and topography. Correlations of the
    /// noise are accepted if they improve the prediction at all, as their intervals contain 0 if
    /// they are unnecessary.
    fn complexity(&self) -> usize {
        let filter = match self.filter {
            Filter::None => 0,
            Filter::Mean(_) => 1,
            Filter::Gaussian => 2,
        };
        filter + 2 * usize::from(self.topography)
    }
}

/// Parameter of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    /// Standard deviation of the noise before the filter, µm.
    Noise,
    /// Correlation of the noise of adjacent columns before the filter.
    Columns,
    /// Correlation of the noise of adjacent profiles.
    Profiles,
    /// Root mean square height of the topography, µm.
    Sq,
    /// Autocorrelation length of the topography, mm.
    Length,
    /// Standard deviation of the Gaussian filter, columns.
    Filter,
}

/// Sampling of a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapSampling {
    /// Distance of points and of profiles, mm.
    pub steps: [f64; 2],
    /// Step to which heights are rounded, µm; 0 without rounding.
    pub rounding_um: f64,
}

/// Model that was fitted to the covariances of a half of the data.
pub struct FittedModel {
    pub terms: Terms,
    /// Parameters in their unbounded form, see [`ModelFit::value`].
    unbounded: DVector<f64>,
    covariance: DMatrix<f64>,
    degrees_of_freedom: f64,
    /// Expected covariances.
    pub expected: Moments,
    /// Variance of a height without the removal of parabolas, µm².
    pub variance: f64,
}

/// Fits of all models to a half of the data, and their evaluation on the other half.
pub struct ModelFit<'a> {
    detrending: Detrending,
    sampling: MapSampling,
    /// Half that is fitted, and half that evaluates the fit.
    halves: [&'a [Block]; 2],
}

impl ModelFit<'_> {
    /// Creates the fits; each half needs at least two blocks.
    pub fn new(sampling: MapSampling, halves: [&[Block]; 2]) -> ModelFit<'_> {
        ModelFit {
            detrending: Detrending::new(),
            sampling,
            halves,
        }
    }

    /// Returns the simplest model whose prediction of the other half is not worse than the best
    /// prediction by more than [`ACCEPTED`] standard errors. Of equally simple models, it is the one
    /// with the best prediction.
    pub fn selected(&self) -> FittedModel {
        let models = Terms::all().map(|terms| self.fitted(terms));
        let determined = models.filter(FittedModel::is_determined);
        let fits: Vec<(FittedModel, Vec<f64>)> = determined
            .map(|model| {
                let losses = self.losses(&model);
                (model, losses)
            })
            .collect();
        let total = |losses: &[f64]| losses.iter().sum::<f64>();
        let best = fits
            .iter()
            .min_by(|a, b| total(&a.1).total_cmp(&total(&b.1)));
        let best = best.expect("some models").1.clone();
        let worse = |losses: &[f64]| {
            let differences: Vec<f64> = losses.iter().zip(&best).map(|(a, b)| a - b).collect();
            let (mean, error) = mean_and_error(&differences);
            mean > ACCEPTED * error
        };
        let sufficient = fits.into_iter().filter(|(_, losses)| !worse(losses));
        let simplest = sufficient.min_by(|(a, of_a), (b, of_b)| {
            let by_terms = a.terms.complexity().cmp(&b.terms.complexity());
            by_terms.then(total(of_a).total_cmp(&total(of_b)))
        });
        simplest.expect("the best model is sufficient").0
    }

    /// Returns the squared errors of the predicted covariances in each block of the other half,
    /// relative to the square of its variance.
    fn losses(&self, model: &FittedModel) -> Vec<f64> {
        let scale = mean(self.halves[1]).moments[0].powi(2);
        let of_block = |block: &Block| {
            let pairs = block.moments.iter().zip(&model.expected);
            pairs
                .map(|(found, expected)| (found - expected).powi(2))
                .sum::<f64>()
                / scale
        };
        self.halves[1].iter().map(of_block).collect()
    }

    /// Fits a model by least squares to the mean covariances.
    fn fitted(&self, terms: Terms) -> FittedModel {
        let found = mean(self.halves[0]).moments;
        let start = |length: f64| {
            let noise = (found[0].max(1e-12) / 2.0).sqrt();
            let mut start = vec![noise.ln() - 0.5 * terms.filter.noise_reduction().ln()];
            start.extend([0.0].repeat(terms.parameters() - 1));
            if terms.topography {
                let first = terms.parameters() - 2 - usize::from(terms.filter == Filter::Gaussian);
                start[first] = noise.ln();
                start[first + 1] = (length * self.sampling.steps[1]).ln();
            }
            DVector::from_vec(start)
        };
        let lengths: &[f64] = if terms.topography {
            &[2.0, 5.0, 15.0]
        } else {
            &[1.0]
        };
        let fits = lengths
            .iter()
            .map(|&length| self.minimum(terms, &found, start(length)));
        let best = fits.min_by(|a, b| a.1.total_cmp(&b.1)).expect("a start");
        let unbounded = best.0;
        // The covariance of the estimate follows from the scatter of the blocks.
        let jacobian = self.jacobian(terms, &unbounded);
        let normal = jacobian.transpose() * &jacobian;
        let scale = normal.trace().max(f64::MIN_POSITIVE);
        let inverse = (normal / scale).pseudo_inverse(1e-12);
        let inverse = inverse.expect("the tolerance is not negative") / scale;
        let gain = inverse * jacobian.transpose();
        let covariance = &gain * covariance_of_mean(self.halves[0]) * gain.transpose();
        FittedModel {
            terms,
            expected: self.expected(terms, &unbounded),
            variance: self.covariances(terms, &unbounded, 0)[0],
            unbounded,
            covariance,
            degrees_of_freedom: (self.halves[0].len() - 1) as f64,
        }
    }

    fn minimum(&self, terms: Terms, found: &Moments, start: DVector<f64>) -> (DVector<f64>, f64) {
        let residual = |at: &DVector<f64>| {
            let expected = self.expected(terms, at);
            DVector::from_iterator(COUNT, found.iter().zip(expected).map(|(f, e)| f - e))
        };
        minimum(start, residual, |at| self.jacobian(terms, at))
    }

    fn expected(&self, terms: Terms, at: &DVector<f64>) -> Moments {
        self.detrending
            .expected(|profiles| self.covariances(terms, at, profiles))
    }

    /// Returns the derivatives of the expected covariances.
    fn jacobian(&self, terms: Terms, at: &DVector<f64>) -> DMatrix<f64> {
        derivatives(at, |at| DVector::from_row_slice(&self.expected(terms, at)))
    }

    /// Returns the covariances of two heights at a lag of 0 to [`SIDE`] − 1 columns, µm².
    fn covariances(&self, terms: Terms, at: &DVector<f64>, profiles: usize) -> Vec<f64> {
        let values = ParameterValues::of(terms, at);
        let [x, y] = self.sampling.steps;
        let between_profiles = match profiles {
            0 => 1.0,
            1 => values.profiles,
            _ => 0.0,
        };
        let raw = |lag: usize| {
            let between_columns = match lag {
                0 => 1.0,
                1 => values.columns,
                _ => 0.0,
            };
            let noise = values.noise.powi(2) * between_profiles * between_columns;
            let squared = (lag as f64 * x).powi(2) + (profiles as f64 * y).powi(2);
            let topography = match terms.topography {
                true => values.sq.powi(2) * (-5f64.ln() * squared / values.length.powi(2)).exp(),
                false => 0.0,
            };
            noise + topography
        };
        let weights = terms.filter.autocorrelation(values.filter);
        let n = weights.len() as isize;
        let raw: Vec<f64> = (0..SIDE + weights.len()).map(raw).collect();
        let filtered = |columns: usize| {
            let at = |lag: isize| raw[(columns as isize + lag).unsigned_abs()];
            let weighted = (1 - n..n).map(|lag| weights[lag.unsigned_abs()] * at(lag));
            weighted.sum::<f64>()
        };
        let mut filtered: Vec<f64> = (0..SIDE).map(filtered).collect();
        if profiles == 0 {
            filtered[0] += self.sampling.rounding_um.powi(2) / 12.0;
        }
        filtered
    }

    /// Returns whether the other half disagrees with the model: any of its covariances deviates by
    /// more than its standard error allows, at a probability of [`FALSE_MISFIT`].
    pub fn misfit(&self, model: &FittedModel) -> Option<String> {
        let found = mean(self.halves[1]).moments;
        let errors = covariance_of_mean(self.halves[1]);
        let jacobian = self.jacobian(model.terms, &model.unbounded);
        let of_fit = &jacobian * &model.covariance * jacobian.transpose();
        let freedom = (self.halves[0].len().min(self.halves[1].len()) - 1) as f64;
        let z = crate::math::normal_quantile(1.0 - FALSE_MISFIT / 2.0 / COUNT as f64);
        let limit = students_quantile(z, freedom);
        let deviation = |i: usize| {
            let error = (errors[(i, i)] + of_fit[(i, i)]).sqrt();
            (found[i] - model.expected[i]) / error.max(f64::MIN_POSITIVE)
        };
        let worst =
            (0..COUNT).max_by(|&a, &b| deviation(a).abs().total_cmp(&deviation(b).abs()))?;
        let worst_deviation = deviation(worst);
        (worst_deviation.abs() > limit).then(|| {
            let (columns, profiles) = (worst % super::moments::LAGS[0], worst / super::moments::LAGS[0]);
            format!(
                "The covariance at a lag of {columns} columns and {profiles} profiles deviates by {:.1} standard errors: \
                 the sensor has a filter, or the surface a structure, that no term of the model describes.",
                worst_deviation.abs()
            )
        })
    }
}

impl FittedModel {
    /// Returns whether the data determine the model: the standard errors of the logarithms of
    /// topography and Gaussian filter are below [`LARGEST_LOG_ERROR`], and no parameter is at its
    /// bound, where its interval has no width.
    fn is_determined(&self) -> bool {
        let mut names = names(self.terms).into_iter().enumerate();
        names.all(|(i, name)| match name {
            // A topography that is shorter than the distance of the points may replace all noise.
            Parameter::Noise => {
                let variance = (2.0 * self.unbounded[i]).exp();
                !self.terms.topography
                    || variance > LEAST_NOISE * self.variance
                        && self.covariance[(i, i)] < LARGEST_LOG_ERROR.powi(2)
            }
            Parameter::Columns | Parameter::Profiles => self.unbounded[i].abs() < LARGEST_ARTANH,
            Parameter::Sq | Parameter::Length => {
                self.covariance[(i, i)] < LARGEST_LOG_ERROR.powi(2)
            }
            Parameter::Filter => {
                GAUSSIAN_SIGMAS.contains(&self.unbounded[i].exp())
                    && self.covariance[(i, i)] < LARGEST_LOG_ERROR.powi(2)
            }
        })
    }

    /// Returns the parameters with their values and 95 % intervals.
    pub fn parameters(&self) -> Vec<(Parameter, [f64; 3])> {
        let quantile = students_quantile(Z95, self.degrees_of_freedom);
        let names = names(self.terms);
        let values = names.into_iter().enumerate().map(|(i, name)| {
            let half = quantile * self.covariance[(i, i)].max(0.0).sqrt();
            let at = [0.0, -half, half].map(|by| bounded(name, self.unbounded[i] + by));
            (name, at)
        });
        values.collect()
    }
}

fn names(terms: Terms) -> Vec<Parameter> {
    let mut names = vec![Parameter::Noise];
    names.extend(terms.columns.then_some(Parameter::Columns));
    names.extend(terms.profiles.then_some(Parameter::Profiles));
    if terms.topography {
        names.extend([Parameter::Sq, Parameter::Length]);
    }
    names.extend((terms.filter == Filter::Gaussian).then_some(Parameter::Filter));
    names
}

/// Returns the value of a parameter from its unbounded form: a logarithm of a positive number, or
/// the inverse hyperbolic tangent of twice a correlation, whose bound is 1/2 for neighbours alone.
fn bounded(parameter: Parameter, value: f64) -> f64 {
    match parameter {
        Parameter::Columns | Parameter::Profiles => 0.5 * value.tanh(),
        _ => value.exp(),
    }
}

/// Values of all parameters; those of absent terms are 0.
struct ParameterValues {
    noise: f64,
    columns: f64,
    profiles: f64,
    sq: f64,
    length: f64,
    filter: f64,
}

impl ParameterValues {
    fn of(terms: Terms, at: &DVector<f64>) -> ParameterValues {
        let mut values = ParameterValues {
            noise: 0.0,
            columns: 0.0,
            profiles: 0.0,
            sq: 0.0,
            length: 0.0,
            filter: 0.0,
        };
        for (name, &value) in names(terms).into_iter().zip(at.iter()) {
            let value = bounded(name, value);
            match name {
                Parameter::Noise => values.noise = value,
                Parameter::Columns => values.columns = value,
                Parameter::Profiles => values.profiles = value,
                Parameter::Sq => values.sq = value,
                Parameter::Length => values.length = value,
                Parameter::Filter => values.filter = value,
            }
        }
        values
    }
}

/// Returns the covariance matrix of the mean of the blocks' covariances.
fn covariance_of_mean(blocks: &[Block]) -> DMatrix<f64> {
    let middle = mean(blocks).moments;
    let n = blocks.len() as f64;
    let mut sum = DMatrix::zeros(COUNT, COUNT);
    for block in blocks {
        let rest = DVector::from_fn(COUNT, |i, _| block.moments[i] - middle[i]);
        sum += &rest * rest.transpose();
    }
    sum / (n * (n - 1.0))
}

/// Returns the mean of values and its standard error.
pub fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>();
    (mean, (squares / (n * (n - 1.0))).sqrt())
}
