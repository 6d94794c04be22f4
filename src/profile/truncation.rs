//! Lines truncated by an edge along them. A truncated line is darker and narrower than its
//! neighbours. Speckle also makes single columns dark and narrow, but an edge truncates several
//! adjacent columns.

use super::neighbourhood::ADJACENT_COLUMNS;
use super::peak_estimators::{PIXEL_VARIANCE, WINDOW_SIGMAS};
use super::slope::{is_end, touching};
use super::widths::ExpectedLine;
use super::{Flags, Peak};
use std::f64::consts::{SQRT_2, TAU};

/// Probability per column that an edge begins to truncate an unbroken line.
///
/// Where the line ends or jumps, and at columns flagged [`Flags::MULTIPLE_PEAKS`] (two surfaces are
/// visible), the probability is ½. [`Flags::DISCONTINUITY`] is not used: narrow lines have this flag
/// too, and the width is part of the evidence.
const EDGE_ONSET_PROBABILITY: f64 = 1e-3;

/// Probability that the surface of a complete line is darker than the neighbouring surface, because
/// of its incidence or reflectance.
///
/// One half states no preference. Faces of unequal incidence meet at most edges of a part, and only
/// the width then distinguishes a dark face from a truncated line.
const DARKER_SURFACE_PROBABILITY: f64 = 0.5;

/// Returns the number of columns in which an edge at 45° truncates a line of standard deviation
/// `sigma` px.
pub(super) fn columns_cut(sigma: f64) -> f64 {
    (4.0 * sigma).max(2.0)
}

/// Minimum relative variance of the light between columns that is not caused by speckle. It
/// accounts for the reflectance and slope of a smooth part.
const LEAST_VARIANCE: f64 = 0.02;

/// Ratio of the relative variances of squared column width and column light by speckle, to first
/// order. For a line of standard deviation σ, E² is a Gaussian of variance σ²/2, over which
/// (x² − σ²)²/σ⁴ has the mean ¾.
const VARIANCE_OF_WIDTH: f64 = 0.75;

/// Moments of a Gaussian line of unit width and unit light, truncated at one position.
#[derive(Debug, Clone, Copy)]
pub(super) struct TruncatedGaussian {
    pub light: f64,
    /// Distance of the centroid of the truncated line from the centroid of the complete line.
    pub centroid_shift: f64,
    pub variance: f64,
}

/// Returns the moments of the part of the line above z.
///
/// With q the light above z, the mean is φ(z)/q and the variance is 1 + z·φ/q − (φ/q)².
pub(super) fn truncated_gaussian(z: f64) -> TruncatedGaussian {
    let light = 0.5 * libm::erfc(z / SQRT_2);
    let off = (-0.5 * z * z).exp() / TAU.sqrt() / light;
    TruncatedGaussian {
        light,
        centroid_shift: off,
        variance: 1.0 + z * off - off * off,
    }
}

/// Truncated line with which observed lines are compared.
#[derive(Debug, Clone, Copy)]
struct TruncationHypothesis {
    light: f64,
    centroid_shift: f64,
    /// Variance.
    width: f64,
    /// Prior probability. Edges truncate lines anywhere, uniformly in light.
    weight: f64,
    log_light: f64,
}

impl TruncationHypothesis {
    fn new(light: f64, weight: f64) -> TruncationHypothesis {
        let (mut low, mut high) = (-6.0, 6.0);
        for _ in 0..50 {
            let z: f64 = (low + high) / 2.0;
            match truncated_gaussian(z).light > light {
                true => low = z,
                false => high = z,
            }
        }
        let TruncatedGaussian {
            centroid_shift: off,
            variance,
            ..
        } = truncated_gaussian(low);
        TruncationHypothesis {
            light,
            centroid_shift: off,
            width: variance,
            weight,
            log_light: light.ln(),
        }
    }
}

/// Remaining light fractions of the truncated lines, and their prior probabilities.
const REMNANT_LIGHT_FRACTIONS: [[f64; 2]; 12] = [
    [0.002, 0.0035],
    [0.005, 0.004],
    [0.01, 0.0075],
    [0.02, 0.015],
    [0.04, 0.025],
    [0.07, 0.035],
    [0.12, 0.06],
    [0.2, 0.1],
    [0.32, 0.14],
    [0.48, 0.18],
    [0.68, 0.2],
    [0.9, 0.23],
];

/// Detector of truncated lines.
#[derive(Debug, Clone)]
pub(super) struct TruncationModel {
    remnants: [TruncationHypothesis; REMNANT_LIGHT_FRACTIONS.len()],
    /// Fraction of adjacent columns whose light is independent.
    independent: f64,
}

/// Probability that an edge truncates the line in this column, and the mean-square centroid shift
/// in that case.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct TruncationEstimate {
    /// Probability that an edge truncates the line.
    pub probability: f64,
    /// Mean square of the centroid shift of a truncated line, px².
    pub mean_square_shift_px2: f64,
}

impl TruncationModel {
    /// Creates a detector. `beside` is the variance of the mean light of adjacent columns relative
    /// to the variance of one column, both by speckle.
    pub fn new(beside: f64) -> TruncationModel {
        TruncationModel {
            remnants: REMNANT_LIGHT_FRACTIONS
                .map(|[light, weight]| TruncationHypothesis::new(light, weight)),
            independent: 1.0 / ((2 * ADJACENT_COLUMNS + 1) as f64 * beside),
        }
    }

    /// Returns the truncation of each peak, in the order of columns.
    ///
    /// `sigmas` are the line widths, px. `variances` are the relative variances of the light of
    /// such lines by speckle. `spreads` are the increases of the squared widths by the lens, px²;
    /// they also apply to truncated lines. `columns` is the number of columns of the frame; a line
    /// does not end at the first and the last column.
    ///
    /// The model is a hidden Markov chain along the columns with two states, complete and truncated
    /// (Rabiner 1989, forward–backward algorithm). The evidence of a column consists of its light
    /// and its width relative to the expected values, both gamma-distributed by speckle. It is
    /// weighted by the independent fraction of adjacent columns.
    pub fn find(
        &self,
        peaks: &[Peak],
        expected: &[Option<ExpectedLine>],
        sigmas: &[f64],
        variances: &[f64],
        spreads: &[f64],
        columns: usize,
    ) -> Vec<TruncationEstimate> {
        let mut widths = RemnantWidths::default();
        let seen: Vec<(f64, f64)> = (0..peaks.len())
            .map(|i| match &expected[i] {
                Some(expected) if !expected.is_isolated => {
                    self.evidence(&peaks[i], expected, variances[i], spreads[i], &mut widths)
                }
                _ => (1.0, 0.0),
            })
            .collect();
        // Whether the line continues from the peak before. The last element is for the end.
        let continues: Vec<bool> = (0..=peaks.len())
            .map(|i| match (i.checked_sub(1), peaks.get(i)) {
                (Some(before), Some(peak)) => {
                    touching(&peaks[before], peak, sigmas[before].max(sigmas[i]))
                }
                _ => false,
            })
            .collect();
        let may_be_cut: Vec<bool> = peaks
            .iter()
            .zip(continues.windows(2))
            .map(|(peak, sides)| {
                is_end(peak, [sides[0], sides[1]], columns)
                    || peak.flags.contains(Flags::MULTIPLE_PEAKS)
            })
            .collect();
        // Transition probabilities from complete to truncated and from truncated to complete.
        let step = |i: usize| {
            let cut = if may_be_cut[i] || may_be_cut[i + 1] {
                0.5
            } else {
                EDGE_ONSET_PROBABILITY
            };
            (cut, columns_cut(sigmas[i]).recip())
        };
        let normal = |[whole, cut]: [f64; 2]| [whole / (whole + cut), cut / (whole + cut)];
        let mut chances = vec![[1.0; 2]; peaks.len()];
        let at_first = match may_be_cut.first() {
            // The stationary probability: a line continues beyond the border of the image.
            Some(false) => {
                let end = columns_cut(sigmas[0]).recip();
                EDGE_ONSET_PROBABILITY / (EDGE_ONSET_PROBABILITY + end)
            }
            _ => 0.5,
        };
        let mut from = [1.0 - at_first, at_first];
        for i in 0..peaks.len() {
            let here = normal([from[0], from[1] * seen[i].0]);
            chances[i] = here;
            if i + 1 < peaks.len() {
                let (cut, whole) = step(i);
                let cut = here[0] * cut + here[1] * (1.0 - whole);
                from = [1.0 - cut, cut];
            }
        }
        let mut onward = [1.0; 2];
        for i in (0..peaks.len()).rev() {
            let [whole, cut] = chances[i];
            chances[i] = normal([whole * onward[0], cut * onward[1]]);
            if i > 0 {
                let here = [onward[0], onward[1] * seen[i].0];
                let (cut, whole) = step(i - 1);
                onward = normal([
                    (1.0 - cut) * here[0] + cut * here[1],
                    whole * here[0] + (1.0 - whole) * here[1],
                ]);
            }
        }
        let cut = |(chance, seen): (&[f64; 2], &(f64, f64))| TruncationEstimate {
            probability: if seen.1 > 0.0 { chance[1] } else { 0.0 },
            mean_square_shift_px2: seen.1,
        };
        chances.iter().zip(&seen).map(cut).collect()
    }

    /// Returns the likelihood ratio of a truncated to a complete line, and the mean-square centroid
    /// shift of the truncated line, px².
    ///
    /// For a gamma-distributed x of shape M, the likelihood ratio of the means m and 1 is
    /// e^(−M·(ln m + x/m − x)). A complete line has the expected width. Its light is the expected
    /// light or, on a darker surface, a fraction with the prior probabilities of the truncated lines.
    fn evidence(
        &self,
        peak: &Peak,
        expected: &ExpectedLine,
        variance: f64,
        spread: f64,
        widths: &mut RemnantWidths,
    ) -> (f64, f64) {
        let variance = variance.max(LEAST_VARIANCE);
        let whole = expected.sigma.powi(2) + PIXEL_VARIANCE;
        // Squared width before lens blur, at least a hundredth of the squared width after it.
        let square = (expected.sigma.powi(2) - spread).max(0.01 * expected.sigma.powi(2));
        let light = peak.intensity / expected.light;
        let width = (peak.sigma.powi(2) + PIXEL_VARIANCE) / whole;
        // Noise variance of a squared width: Σx⁴ over the window.
        let half = WINDOW_SIGMAS * whole.sqrt();
        let noise = (peak.noise / peak.intensity).powi(2) * 0.4 * half.powi(5);
        let of_width = VARIANCE_OF_WIDTH * variance + noise / (whole * whole);
        let (mut sum, mut off) = (f64::MIN_POSITIVE, 0.0);
        let mut on_darker_surface = 0.0;
        // Most of the exponentials are negligible and expensive.
        let likelihood = |weight: f64, exponent: f64| match exponent > -40.0 {
            true => weight * exponent.min(300.0).exp(),
            false => 0.0,
        };
        let narrow = widths.of(&self.remnants, (whole - square) / square);
        for (remnant, &(narrow, log_narrow)) in self.remnants.iter().zip(narrow) {
            let of_light = -(remnant.log_light + light / remnant.light - light) / variance;
            let of_both = of_light - (log_narrow + width / narrow - width) / of_width;
            let likely = likelihood(remnant.weight, of_both);
            sum += likely;
            off += likely * remnant.centroid_shift.powi(2);
            on_darker_surface += likelihood(remnant.weight, of_light);
        }
        let complete = 1.0 + DARKER_SURFACE_PROBABILITY * (on_darker_surface - 1.0);
        // Limit of the evidence of one column.
        let ratio = (sum / complete).powf(self.independent).clamp(1e-12, 1e12);
        (ratio, off / sum * square)
    }
}

/// Squared widths of truncated lines relative to the complete line, with their logarithms.
///
/// The widths include pixel integration and lens blur. The values are cached for one relative
/// contribution of pixel and lens, rounded to steps of 4 %.
#[derive(Default)]
struct RemnantWidths {
    key: i32,
    narrow: [(f64, f64); REMNANT_LIGHT_FRACTIONS.len()],
}

impl RemnantWidths {
    const PER_E_FOLD: f64 = 25.0;

    /// Returns the widths. `added` is the increase of the squared line width by pixel and lens,
    /// relative to the squared width of the line.
    fn of(&mut self, remnants: &[TruncationHypothesis], added: f64) -> &[(f64, f64)] {
        let key = (added.min(1e6).ln() * RemnantWidths::PER_E_FOLD).round() as i32;
        if key != self.key || self.narrow[0].0 == 0.0 {
            let added = (key as f64 / RemnantWidths::PER_E_FOLD).exp();
            let of = |remnant: &TruncationHypothesis| (remnant.width + added) / (1.0 + added);
            for (narrow, remnant) in self.narrow.iter_mut().zip(remnants) {
                *narrow = (of(remnant), of(remnant).ln());
            }
            self.key = key;
        }
        &self.narrow
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VARIANCE: f64 = 0.2;

    /// Returns the detected truncation of lines of σ = 2 px with the given light fractions, in
    /// columns without flags.
    fn found(left: &[f64]) -> Vec<TruncationEstimate> {
        let line = |(column, left): (usize, &f64)| {
            let remnant = TruncationHypothesis::new(*left, 1.0);
            Peak {
                column: column as u32,
                row: 10.0,
                intensity: 1e4 * left,
                height: 1e3,
                sigma: 2.0 * remnant.width.sqrt(),
                noise: 1.0,
                flags: Flags::empty(),
            }
        };
        let peaks: Vec<Peak> = left.iter().enumerate().map(line).collect();
        let whole = ExpectedLine {
            sigma: 2.0,
            slope_rows_per_column: 0.0,
            light: 1e4,
            is_isolated: false,
        };
        let variances = vec![VARIANCE; left.len()];
        let sigmas = vec![whole.sigma; left.len()];
        let sharp = vec![0.0; left.len()];
        TruncationModel::new(0.3).find(
            &peaks,
            &vec![Some(whole); left.len()],
            &sigmas,
            &variances,
            &sharp,
            left.len(),
        )
    }

    /// The moments agree with tables. Above 1.5 σ, a Gaussian has a light fraction of 0.0668, a
    /// mean of 1.9388 σ, and a variance of 1 + 1.5·1.9388 − 1.9388² = 0.1493. Above its centre, the
    /// variance is 1 − 2/π.
    #[test]
    fn remnants_are_those_of_a_gaussian() {
        let tail = TruncationHypothesis::new(0.066_807, 1.0);
        assert!(
            (tail.centroid_shift - 1.938_8).abs() < 1e-3 && (tail.width - 0.149_3).abs() < 2e-3
        );
        let half = TruncationHypothesis::new(0.5, 1.0);
        assert!((half.width - (1.0 - 4.0 / TAU)).abs() < 1e-9, "{half:?}");
        let weights: f64 = REMNANT_LIGHT_FRACTIONS
            .iter()
            .map(|[_, weight]| weight)
            .sum();
        assert!((weights - 1.0).abs() < 1e-9, "{weights}");
    }

    /// Six columns with a light fraction of 0.1 are detected as truncated.
    ///
    /// The centroids are shifted by 1.755 σ = 3.51 px. The tolerance is 10 %: speckle leaves the
    /// fraction uncertain by a third, and the shift varies with its fourth root. A complete column has
    /// a likelihood ratio of 0.38, and truncation continues with a probability of 7/8. The odds
    /// therefore decrease by a factor of 0.33 per column of distance; the bound is 0.35.
    #[test]
    fn neighbouring_columns_that_are_dark_and_narrow_are_cut() {
        let mut left = vec![1.0 - 1e-6; 40];
        left[20..26].fill(0.1);
        let cuts = found(&left);
        for (i, cut) in cuts.iter().enumerate().take(32).skip(10) {
            let distance = match i {
                ..20 => 20 - i,
                20..26 => 0,
                _ => i - 25,
            };
            if distance == 0 {
                // A column next to complete lines has its own evidence only.
                let least = if [20, 25].contains(&i) { 0.95 } else { 0.99 };
                assert!(cut.probability > least, "{i} {cut:?}");
                assert!(
                    (cut.mean_square_shift_px2.sqrt() / 3.51 - 1.0).abs() < 0.1,
                    "{i} {cut:?}"
                );
            } else {
                let most = 0.35f64.powi(distance as i32).max(2e-3);
                assert!(cut.probability < most, "{i} {cut:?}");
            }
        }
    }

    /// In 20 000 columns of complete lines with independent speckle in light and width, fewer than
    /// one in a thousand is classified as truncated.
    #[test]
    fn speckle_is_not_taken_for_edges() {
        use crate::math::rng::{Purpose, RngKey};
        use rand_distr::{Distribution, Gamma};
        let shape = 1.0 / VARIANCE;
        let light = Gamma::new(shape, VARIANCE).unwrap();
        let width = Gamma::new(shape / 0.75, 0.75 * VARIANCE).unwrap();
        let mut stream = RngKey::new(3, Purpose::SensorNoise).counter_stream();
        let mut wrong = 0;
        for _ in 0..50 {
            let peak = |column: u32| Peak {
                column,
                row: 10.0,
                intensity: 1e4 * light.sample(&mut stream),
                height: 1e3,
                sigma: (4.0 * width.sample(&mut stream)).sqrt(),
                noise: 1.0,
                flags: Flags::empty(),
            };
            let peaks: Vec<Peak> = (0..400).map(peak).collect();
            let whole = ExpectedLine {
                sigma: 2.0,
                slope_rows_per_column: 0.0,
                light: 1e4,
                is_isolated: false,
            };
            // All columns are independent: the mean of five has a fifth of the variance of one.
            let cuts = TruncationModel::new(0.2).find(
                &peaks,
                &[Some(whole); 400],
                &[whole.sigma; 400],
                &[VARIANCE; 400],
                &[0.0; 400],
                400,
            );
            wrong += cuts.iter().filter(|cut| cut.probability > 0.5).count();
        }
        assert!(wrong < 20, "{wrong}");
    }
}
