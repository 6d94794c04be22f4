//! Standard uncertainty of the row of a line from data sheet values of sensor and light. The
//! effects are speckle, shot noise, pixel non-uniformity, background noise and rounding.

use super::clipping::{Clipping, SaturationEffect};
use super::defocus_noise::DefocusNoise;
use super::estimator_weights::bias;
use super::few_grains::few_grains_coefficient;
use super::filter::{Drift, FrameStep};
use super::horizon::{UNFLAGGED_SHIFT_SIGMAS, offsets};
use super::neighbourhood::ADJACENT_COLUMNS;
use super::peak_estimators::PIXEL_VARIANCE;
use super::slope::{LineSlope, runs};
use super::truncation::{TruncationModel, columns_cut};
use super::variances::{
    SIGMAS_PX, SpeckleGrain, VarianceGrid, Variances, along_row, column_correlation,
};
use super::widths::{ExpectedLine, expected};
use super::{Flags, Peak, PeakFinder};
use crate::math::DVec2;

/// Maximum relative variance of the light of a column, 1/M for M independent grains across the
/// line. Up to this value, errors were found to be normal and of first order
/// (`tests/points/uncertainty.rs`).
pub const LARGEST_LIGHT_VARIANCE: f64 = 0.5;
/// Maximum relative variance of the light of a pixel for estimators that assume a Gaussian line
/// shape.
pub const LARGEST_SHAPE_VARIANCE: f64 = 0.02;
/// Minimum line width for estimators other than the centroid, px. The bias for narrower lines is
/// unknown.
const LEAST_SHAPE_SIGMA_PX: f64 = 0.7;
/// Speckle variance of the centroid of a uniform profile relative to a Gaussian of equal standard
/// deviation. The value of ∫E²x²/(∫E)² is σ/√12 for the uniform profile and σ/(4√π) for the
/// Gaussian.
const SPECKLE_OF_A_STRETCH: f64 = 2.0466;

/// Standard uncertainty of the row of a peak, and its components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowUncertainty {
    /// Standard uncertainty, px: the scatter between surface positions, including speckle.
    pub sigma: f64,
    /// Component that differs between images of one surface position, px: shot noise and background
    /// noise (read noise and rounding). Speckle and pixel patterns are constant without motion.
    pub noise: f64,
    /// True if an edge is so close that either of its two surfaces may be the nearest. Either
    /// truncation by an edge dominates `sigma`, or the line ends within the columns in which an
    /// edge at 45° would truncate it.
    pub near_edge: bool,
    /// Slope of the line, rows per column; 0 where the line ends or jumps.
    pub slope: f64,
    /// Expected standard deviation of the sharp image of the laser sheet, px: without lens blur and
    /// without the extent that the slope adds. 0 where no width is expected.
    pub sheet_sigma: f64,
    /// Correlation of the component other than `noise` with errors of frames at other surface
    /// positions.
    pub drift: Drift,
    /// True if `sigma` is valid for this line.
    pub(super) is_valid: bool,
    /// True if complete lines are available for comparison.
    pub(super) has_reference_lines: bool,
    /// True if the probability of truncation by an edge exceeds one half.
    pub(super) is_cut: bool,
    /// True if an edge may have truncated more of the line than its neighbours show.
    pub(super) possible_truncation: bool,
    /// True if the line saturates but retains enough of its light.
    pub(super) saturation_ok: bool,
}

/// Exposure that supplies the pixels in which the next longer exposure saturates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HdrExposure {
    /// Counts above background from which this exposure is used.
    pub from_dn: f64,
    /// Ratio of the longest exposure time to this one, by which the shot noise variance is
    /// multiplied.
    pub ratio: f64,
}

/// Predicts the standard uncertainty of the rows of peaks.
///
/// To first order, errors δ_i of the light of pixels i move the estimate by Σ w_i·δ_i, where w is
/// `influence`. The uncertainty u follows from
///
/// ```text
/// u² = C²·Σ w_i·G_i·w_j·G_j·ρ(i−j) + P²·Σ w_i²·G_i² + K/N·Σ w_i²·G_i + (s/N)²·Σ w_i² + b²/3
/// ```
///
/// - G_i is the fraction of the light of a Gaussian line in pixel i.
/// - N is the light of the line in counts, and K is the gain in counts per electron.
/// - The background noise s includes read noise, rounding and DSNU.
/// - C is the speckle contrast.
/// - ρ is the light covariance between two pixel parts in a column
///   ([`crate::speckle::theory::strip_covariance`]). Pixels are divided into parts because a narrow
///   line does not illuminate a pixel uniformly. ρ uses the grain size at the position.
/// - P is the standard deviation of the pixel responses (PRNU). Like DSNU, it is constant over
///   frames and differs between positions.
/// - For the centroid, Σ w_i²·G_i is measured from the light of the column.
/// - b is the maximum bias of the estimator (GUM 4.3.7).
/// - h is the minimal speckle size.
///
/// For the centroid and pixels ≪ h ≪ σ, the first term is (32/3π²)·hσ/(4√π)·C².
///
/// The following contributions are added in quadrature or change the first term:
///
/// - the bend of the line within the column (`bend_variance`);
/// - truncation by an edge, weighted by its probability (`Cuts`);
/// - on a steep surface, σ includes the extent of the line in the column;
/// - saturation scales the first term (`Clipping`);
/// - lens blur changes the first term ([`DefocusNoise`]);
/// - with few grains across the line, the first term is divided by 1 + c·L, where L is the relative
///   variance of the column's light (`profile::few_grains`).
///
/// Valid for a Gaussian line without a contrary flag, with a measured width of σ = 0.4 … 64 px
/// (from 0.7 px for estimators other than the centroid). Columns must contain two grains or more
/// ([`LARGEST_LIGHT_VARIANCE`]). Estimators other than the centroid require that speckle is almost
/// averaged out ([`LARGEST_SHAPE_VARIANCE`]). The effects of edges and saturation use the grain
/// size at the centre of the sensor.
#[derive(Debug, Clone)]
pub struct UncertaintyModel {
    finder: PeakFinder,
    gain_dn_per_e: f64,
    prnu: f64,
    fixed_share: f64,
    merged: Vec<HdrExposure>,
    /// Speckle changes between two poses of an exposure, with the fraction of pairs that have each.
    poses: Vec<(FrameStep, f64)>,
    cuts: TruncationModel,
    clipping: Clipping,
    places: VarianceGrid,
    grain: Option<SpeckleGrain>,
    /// Coefficient of the second-order term for lines of few grains.
    few_grains: f64,
    /// `None` for sharp images.
    blurred: Option<DefocusNoise>,
    /// True if the lens images the speckle field; false if speckle multiplies the blurred light.
    is_coherent: bool,
}

impl UncertaintyModel {
    /// Creates the model. `gain_dn_per_e` is the gain in counts per electron, or 0 for light
    /// without shot noise.
    pub fn new(
        finder: PeakFinder,
        gain_dn_per_e: f64,
        grain: Option<SpeckleGrain>,
    ) -> UncertaintyModel {
        let columns = grain.map_or(vec![0.0], |grain| {
            let middle = grain.resolution.as_dvec2() / 2.0;
            along_row(&grain, middle, 2 * ADJACENT_COLUMNS + 1)
        });
        UncertaintyModel {
            finder,
            gain_dn_per_e,
            prnu: 0.0,
            fixed_share: 0.0,
            merged: Vec::new(),
            poses: Vec::new(),
            cuts: TruncationModel::new(variance_of_mean(&columns)),
            clipping: Clipping::new(columns[0]),
            places: VarianceGrid::new(finder, grain.as_ref()),
            grain,
            few_grains: match (finder, grain) {
                (PeakFinder::Centroid, Some(grain)) => {
                    few_grains_coefficient(grain.aperture, grain.across_column())
                }
                _ => 0.0,
            },
            blurred: None,
            is_coherent: false,
        }
    }

    /// Returns the model for images blurred by a lens. `is_coherent`: the lens images the speckle
    /// field. Otherwise, speckle multiplies the blurred light.
    pub fn with_defocus(self, blurred: DefocusNoise, is_coherent: bool) -> UncertaintyModel {
        UncertaintyModel {
            blurred: Some(blurred),
            is_coherent,
            ..self
        }
    }

    /// Returns the correlations of row errors by speckle at lags of 0, 1, 2, … columns, at the
    /// sensor centre. `sigma` is the standard deviation of the line in the sharp image, px. The
    /// result is [1] without speckle.
    pub fn column_correlation(&self, sigma: f64) -> Vec<f64> {
        let of = |grain: &SpeckleGrain| {
            let middle = grain.resolution.as_dvec2() / 2.0;
            column_correlation(self.finder, grain, middle, self.measured(middle, sigma))
        };
        self.grain.as_ref().map_or(vec![1.0], of)
    }

    /// Returns the model for pixel patterns. `prnu` is the relative standard deviation of the pixel
    /// responses. `fixed_share` is the fraction of the background variance that is constant over
    /// images (DSNU).
    pub fn with_patterns(self, prnu: f64, fixed_share: f64) -> UncertaintyModel {
        UncertaintyModel {
            prnu,
            fixed_share,
            ..self
        }
    }

    /// Returns the model for images of several exposures, in ascending order of `ratio`.
    pub fn with_exposures(self, merged: Vec<HdrExposure>) -> UncertaintyModel {
        UncertaintyModel { merged, ..self }
    }

    /// Returns the model for images that average uniformly distributed poses of an exposure.
    /// `poses` lists the speckle change from the first pose to each pose, beginning with 0.
    pub fn with_poses(self, poses: &[FrameStep]) -> UncertaintyModel {
        let n = poses.len() as f64;
        let pairs = poses.iter().enumerate().map(|(apart, step)| {
            let signs = if apart == 0 { 1.0 } else { 2.0 };
            (*step, signs * (n - apart as f64) / (n * n))
        });
        UncertaintyModel {
            poses: pairs.collect(),
            ..self
        }
    }

    /// Returns the model for light without shot noise.
    pub fn without_shot_noise(self) -> UncertaintyModel {
        UncertaintyModel {
            gain_dn_per_e: 0.0,
            ..self
        }
    }

    /// Returns the correlation of speckle errors under motion of the surface, for a line with a
    /// measured width of `width` px at `place`.
    pub fn drift(&self, place: DVec2, width: f64) -> Drift {
        self.drift_of(place, width, &self.at_rest(place, width))
    }

    /// Returns the correlation for a line whose centroid has the variance V and whose light has the
    /// relative variance L.
    ///
    /// A lens images the complex fields of the surface lit by the line in both frames. This surface
    /// is lit like by a line of equal σ halfway between both lines, attenuated by exp(−u²/4). V
    /// becomes exp(−u²/4)·(V − u²σ²·L/4). Otherwise, the pattern multiplies a line of the measured
    /// width W. The correlation R(u) = exp(−u²/4)·(1 − u²/2) is convolved with the covariance of
    /// the grains. This widens W² to W⁴·L/2V (exact for a Gaussian covariance). u is in units of σ,
    /// the width before lens blur.
    fn drift_of(&self, place: DVec2, width: f64, at: &Variances) -> Drift {
        if at.light <= 0.0 || at.speckle <= 0.0 {
            return Drift::FINE;
        }
        let sharp = at.sharp.powi(2);
        if self.is_coherent {
            return Drift {
                decay: 0.25,
                turn: 0.25 * sharp * at.light / at.speckle,
            };
        }
        let on_sensor = self.places.at(place, width);
        let widened = width.powi(4) * on_sensor.light / (2.0 * on_sensor.speckle);
        Drift {
            decay: 0.25 * sharp / widened,
            turn: 0.5 * sharp / widened,
        }
    }

    /// Returns the variances of a line with a measured width of `width` px at `place`, without
    /// motion during the exposure.
    fn at_rest(&self, place: DVec2, width: f64) -> Variances {
        match &self.blurred {
            None => self.places.at(place, width),
            Some(blurred) => blurred.at(&self.places, place, width),
        }
    }

    /// Returns the variances under motion during the exposure, and the correlation over frames.
    ///
    /// The errors average over all poses. The resulting correlation is the mean over all pairs of
    /// poses.
    fn exposed(&self, place: DVec2, width: f64) -> (Variances, Drift) {
        let at = self.at_rest(place, width);
        let drift = self.drift_of(place, width, &at);
        if self.poses.len() < 2 {
            return (at, drift);
        }
        let mean = |drift: Drift| -> f64 {
            let pairs = self.poses.iter();
            let sum: f64 = pairs
                .map(|(step, share)| share * drift.correlation(step))
                .sum();
            sum.max(0.0)
        };
        let of_light = mean(Drift { turn: 0.0, ..drift });
        let exposed = Variances {
            speckle: at.speckle * mean(drift),
            light: at.light * of_light,
            pixel: at.pixel * of_light,
            ..at
        };
        (exposed, drift)
    }

    /// Returns the measured width, px, behind the lens of a line of standard deviation `sigma` px.
    pub(crate) fn measured(&self, place: DVec2, sigma: f64) -> f64 {
        let blurred = self.blurred.as_ref();
        blurred.map_or(sigma, |blurred| {
            blurred.measured(&self.places, place, sigma)
        })
    }

    /// Returns the variance of a row due to the pixel pattern, px². The variance is part of the
    /// uncertainty, and constant while the line covers the same pixels. `of_dark` is the standard
    /// deviation of the dark signals relative to the light of the line.
    pub(crate) fn pattern_variance(&self, place: DVec2, width: f64, of_dark: f64) -> f64 {
        let at = self.at_rest(place, width);
        at.response * self.prnu.powi(2) + at.white * of_dark.powi(2)
    }

    /// Returns the uncertainty of each peak of a frame, in the order of columns.
    ///
    /// `columns` is the number of columns of the frame. The width of a line is averaged over its
    /// neighbourhood, because the width of one column is dominated by speckle. The contribution of
    /// its slope is added.
    pub fn row_errors(&self, peaks: &[Peak], columns: usize) -> Vec<RowUncertainty> {
        let runs = runs(peaks);
        let expected = expected(peaks, &runs);
        let clipped = self.clipped(peaks, &expected);
        let width = |(peak, e): (&Peak, &Option<ExpectedLine>)| e.map_or(peak.sigma, |e| e.sigma);
        let sigmas: Vec<f64> = peaks.iter().zip(&expected).map(width).collect();
        let lined = peaks.iter().zip(&sigmas);
        let lined = lined.map(|(peak, &sigma)| self.exposed(peak.place(), sigma));
        let (variances, drifts): (Vec<Variances>, Vec<Drift>) = lined.unzip();
        let lights: Vec<f64> = variances.iter().map(|v| v.light).collect();
        let spread = |(width, at): (&f64, &Variances)| (width * width - at.sharp.powi(2)).max(0.0);
        let spreads: Vec<f64> = sigmas.iter().zip(&variances).map(spread).collect();
        let cuts = self
            .cuts
            .find(peaks, &expected, &sigmas, &lights, &spreads, columns);
        let unseen = offsets(peaks, &runs);
        let near_ends = near_ends(peaks, &sigmas, columns);
        let of = |i: usize| {
            let (peak, width, expected) = (&peaks[i], sigmas[i], &expected[i]);
            let climb = expected.map_or(0.0, |e| e.slope_rows_per_column);
            let whole = clipped[i].unwrap_or(SaturationEffect::UNSATURATED);
            let variance = self.variance(peak, width, climb, &variances[i], &whole);
            let uncut = variance + bend_variance(&runs[i], variance);
            let cut = cuts[i].probability * cuts[i].mean_square_shift_px2;
            let sigma = (uncut + cut).sqrt();
            let noise = self.noise_variance(peak, &variances[i]).sqrt();
            RowUncertainty {
                sigma,
                noise,
                near_edge: near_ends[i] || cut > uncut,
                slope: runs[i].slope,
                sheet_sigma: match expected {
                    Some(_) => variances[i].sharp * (1.0 - climb).max(0.0).sqrt(),
                    None => 0.0,
                },
                drift: drifts[i],
                is_valid: expected.is_some() && self.is_valid(width, &variances[i]),
                has_reference_lines: expected.is_some_and(|e| !e.is_isolated),
                is_cut: cuts[i].probability > 0.5,
                possible_truncation: unseen[i] > UNFLAGGED_SHIFT_SIGMAS * sigma,
                saturation_ok: clipped[i].is_some(),
            }
        };
        (0..sigmas.len()).map(of).collect()
    }

    /// Returns the effect of saturation for each saturated line that retains enough of its light.
    fn clipped(
        &self,
        peaks: &[Peak],
        expected: &[Option<ExpectedLine>],
    ) -> Vec<Option<SaturationEffect>> {
        let saturated = |peak: &&Peak| peak.flags.contains(Flags::SATURATED);
        let heights = peaks.iter().filter(saturated).map(|peak| peak.height);
        let full = heights.fold(0.0, f64::max);
        let of = |expected: &Option<ExpectedLine>| {
            let expected = expected.filter(|e| !e.is_isolated)?;
            let sigma = (expected.sigma.powi(2) + PIXEL_VARIANCE).sqrt();
            let clipped = self.clipping.at(expected.light, sigma, full);
            clipped.filter(SaturationEffect::keeps_enough)
        };
        if full == 0.0 || self.finder != PeakFinder::Centroid {
            return vec![None; peaks.len()];
        }
        expected.iter().map(of).collect()
    }

    fn is_valid(&self, sigma: f64, at: &Variances) -> bool {
        let centroid = self.finder == PeakFinder::Centroid;
        let least = if centroid {
            SIGMAS_PX.0
        } else {
            LEAST_SHAPE_SIGMA_PX
        };
        (least..=SIGMAS_PX.1).contains(&sigma)
            && at.light <= LARGEST_LIGHT_VARIANCE
            && (centroid || at.pixel <= LARGEST_SHAPE_VARIANCE)
    }

    /// Returns the variance of the row that differs between images, px².
    ///
    /// Shot noise is proportional to the light of each pixel. For the centroid, its variance
    /// therefore follows from the measured width of this column. Columns that speckle leaves dark
    /// at the line centre are wider and have less light, which an average width would not include.
    fn noise_variance(&self, peak: &Peak, at: &Variances) -> f64 {
        let n = peak.intensity;
        let shot = match self.finder {
            PeakFinder::Centroid => peak.sigma.powi(2) + PIXEL_VARIANCE,
            _ => at.shot,
        };
        let drawn = peak.noise.powi(2) - self.fixed_pattern_variance(peak);
        // Shorter exposures add shot noise at the core of the line. Diffraction makes the core
        // narrower than a Gaussian of equal variance, and without speckle its height shows by how
        // much.
        let core = match self.grain {
            None => (n / peak.height).powi(2) / std::f64::consts::TAU,
            Some(_) => shot,
        };
        let shot = shot + core.min(shot) * (self.shorter_exposures(peak) - 1.0);
        shot * self.gain_dn_per_e / n + at.white * drawn / (n * n)
    }

    /// Returns the factor by which shorter exposures increase the shot noise of a line.
    ///
    /// The shorter exposures supply the line centre. The factor is
    /// 1 + Σ(r_k − r_(k−1))·(erf u − 2u·e^(−u²)/√π). The second factor is the fraction of Σ w²·G of
    /// a Gaussian in the range where its height exceeds the start of exposure k. Here
    /// u² = ln(height/from).
    fn shorter_exposures(&self, peak: &Peak) -> f64 {
        let mut before = 1.0;
        let added = self.merged.iter().map(|merged| {
            let more = merged.ratio - before;
            before = merged.ratio;
            let u = (peak.height / merged.from_dn).max(1.0).ln().sqrt();
            let share = libm::erf(u) - 2.0 * u * (-u * u).exp() / std::f64::consts::PI.sqrt();
            more * share
        });
        1.0 + added.sum::<f64>()
    }

    /// Returns the variance of the background noise that is constant over images, counts².
    fn fixed_pattern_variance(&self, peak: &Peak) -> f64 {
        self.fixed_share * peak.noise.powi(2)
    }

    /// Returns the variance of the row of an unbroken line of width `sigma`, px².
    fn variance(
        &self,
        peak: &Peak,
        sigma: f64,
        climb: f64,
        at: &Variances,
        clipped: &SaturationEffect,
    ) -> f64 {
        let shape = 1.0 + (SPECKLE_OF_A_STRETCH - 1.0) * climb;
        // The second-order term is not known for the mean over the poses of an exposure.
        let few_grains = match self.poses.len() {
            0 | 1 => 1.0 + self.few_grains * at.light,
            _ => 1.0,
        };
        at.speckle / few_grains * clipped.variance * shape
            + self.noise_variance(peak, at)
            + at.white * self.fixed_pattern_variance(peak) / peak.intensity.powi(2)
            + at.response * self.prnu.powi(2)
            + bias(self.finder, sigma).powi(2) / 3.0
    }
}

/// Returns whether the line ends so close to each peak that an edge there may truncate it. `sigmas`
/// are the line widths, px. At an image border, the line does not count as ended.
fn near_ends(peaks: &[Peak], sigmas: &[f64], columns: usize) -> Vec<bool> {
    let mut near = Vec::with_capacity(peaks.len());
    for run in peaks.chunk_by(|a, b| a.column + 1 == b.column) {
        let ends = [run[0], run[run.len() - 1]];
        let (first, last) = (ends[0].column, ends[1].column);
        let [begins, ends] = ends.map(|peak| !peak.flags.contains(Flags::IMAGE_BORDER));
        for peak in run {
            let reach = columns_cut(sigmas[near.len()]);
            let before = first > 0 && begins && f64::from(peak.column - first) <= reach;
            let after =
                (last as usize + 1) < columns && ends && f64::from(last - peak.column) <= reach;
            near.push(before || after);
        }
    }
    near
}

/// Returns the variance, px², of the difference between the mean row of a line over a column and
/// its row at the column centre.
///
/// If the slope changes by K rows per column at a position t in the column, the difference is
/// K·(½ − |t|)²/2. Its mean square over t is K²/320. Row errors contribute six times their
/// `variance` to the measured bend, which is subtracted.
fn bend_variance(run: &LineSlope, variance: f64) -> f64 {
    (run.bend.powi(2) - 6.0 * variance).max(0.0) / 320.0
}

/// Returns the variance of the mean of a column and its [`ADJACENT_COLUMNS`] neighbours on either
/// side, relative to the variance of one column. If `covariance` is zero, the columns are assumed
/// independent.
fn variance_of_mean(covariance: &[f64]) -> f64 {
    let n = 2 * ADJACENT_COLUMNS + 1;
    let at = |lag: usize| covariance.get(lag).copied().unwrap_or(0.0);
    if at(0) == 0.0 {
        return 1.0 / n as f64;
    }
    let pairs: f64 = (1..n).map(|lag| 2.0 * (n - lag) as f64 * at(lag)).sum();
    (n as f64 + pairs / at(0)) / (n * n) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// The constants agree with numerical values. A uniform profile of σ = W/√12 has
    /// ∫E²x²/(∫E)² = W/12, and a Gaussian has σ/(4√π). The bias of a bend is summed here as the
    /// mean row minus the central row.
    #[test]
    fn constants_of_stretches_and_bends_are_what_they_are_said_to_be() {
        let ratio = (12f64.sqrt() / 12.0) / (1.0 / (4.0 * PI.sqrt()));
        assert!((ratio - SPECKLE_OF_A_STRETCH).abs() < 1e-4, "{ratio}");
        let n = 400;
        let at = |i: usize| (i as f64 + 0.5) / n as f64 - 0.5;
        let row = |x: f64, t: f64| (x - t).max(0.0);
        let bias = |t: f64| (0..n).map(|i| row(at(i), t)).sum::<f64>() / n as f64 - row(0.0, t);
        let square = (0..n).map(|i| bias(at(i)).powi(2)).sum::<f64>() / n as f64;
        let run = LineSlope {
            slope: 0.0,
            bend: 1.0,
        };
        assert!(
            (square / bend_variance(&run, 0.0) - 1.0).abs() < 1e-3,
            "{square}"
        );
        assert_eq!(bend_variance(&run, 1.0), 0.0);
    }
}
