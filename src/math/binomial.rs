//! Binomial and Poisson random numbers by inversion of the distribution.
//!
//! For fixed random numbers, the result rises with the mean. A small change of the mean therefore
//! causes a small change of the sample.

use super::rng::RngKey;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// Variance from which quantiles are computed by expansion.
pub const EXPANDED: f64 = 12.0;

/// Samples a binomial number of `count` trials with success probability `chance` (0 to 1).
///
/// `ln_not` is ln(1 − p), where p ≤ ½ is the probability of the rarer outcome. The caller computes
/// it once for many samples. From a variance of 12 on, [`expanded_quantile`] is used; below, the
/// terms are summed up to a uniform number. The cumulative probability at every k is within 5e-5 of
/// the exact value.
pub fn binomial(count: u32, chance: f64, ln_not: f64, key: RngKey) -> u32 {
    let rarer = chance.min(1.0 - chance);
    let n = f64::from(count);
    let mut stream = key.counter_stream();
    if n * chance * (1.0 - chance) >= EXPANDED {
        let w = StandardNormal.sample(&mut stream);
        return expanded_quantile(n * chance, chance, w).min(n) as u32;
    }
    let uniform: f64 = StandardUniform.sample(&mut stream);
    // Both results are in [0, 1).
    let uniform = match chance > 0.5 {
        true => 1f64.next_down() - uniform,
        false => uniform,
    };
    let odds = rarer / (1.0 - rarer);
    let mut term = (n * ln_not).exp();
    let mut at_most = term;
    let mut k = 0;
    // The sum of all terms may be rounded to below the greatest uniform number.
    while uniform >= at_most && k < count {
        term *= odds * f64::from(count - k) / f64::from(k + 1);
        k += 1;
        at_most += term;
    }
    if chance > 0.5 { count - k } else { k }
}

/// Returns the binomial quantile of cumulative probability Φ(w), at least 0, for this mean and
/// success probability.
///
/// Uses the expansion of Cornish and Fisher (1938) up to order 1/σ². The cumulants include the
/// continuity correction for a distribution over integers. A `chance` of 0 gives the Poisson
/// distribution.
pub fn expanded_quantile(mean: f64, chance: f64, w: f64) -> f64 {
    let (skew, both) = (1.0 - 2.0 * chance, chance * (1.0 - chance));
    let variance = mean * (1.0 - chance);
    let deviation = variance.sqrt();
    let w2 = w * w;
    let zeroth = skew * (w2 - 1.0) / 6.0 + 0.5;
    let first = w / 36.0 * (1.0 + 0.5 * w2 + both * (w2 - 7.0));
    let second = skew * (1.0 + 0.5 * both) * (w2 * (7.0 + 3.0 * w2) - 16.0) / 810.0;
    let k = mean + deviation * w + zeroth - first / deviation + second / variance;
    k.floor().max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::Purpose;
    use std::f64::consts::FRAC_1_SQRT_2;

    /// Compares the cumulative probability below each k with Φ(w), where the expansion reaches k at
    /// w. The difference must not exceed `bound`. `term` is the first probability; `ratio` gives
    /// the ratio of consecutive terms.
    fn compare(mean: f64, chance: f64, mut term: f64, ratio: impl Fn(f64) -> f64, bound: f64) {
        let end = mean + 10.0 * mean.sqrt();
        let (mut below, mut k) = (0.0, 0.0);
        while k < end && term > 0.0 {
            let (mut low, mut high) = (-9.0, 12.0);
            for _ in 0..60 {
                let w = 0.5 * (low + high);
                match expanded_quantile(mean, chance, w) < k {
                    true => low = w,
                    false => high = w,
                }
            }
            let share = 0.5 * libm::erfc(-high * FRAC_1_SQRT_2);
            let wrong = (share - below).abs();
            assert!(wrong < bound, "{mean} {chance} {k}: {share} {below}");
            below += term;
            term *= ratio(k);
            k += 1.0;
        }
    }

    /// Tests the error bounds of the expansion: 3.2e-5 for Poisson, and the documented 5e-5 for
    /// binomial distributions.
    #[test]
    fn expanded_quantiles_are_those_of_the_sums() {
        for mean in [EXPANDED, 15.3, 30.0, 200.0, 700.0] {
            compare(mean, 0.0, (-mean).exp(), |k| mean / (k + 1.0), 3.2e-5);
        }
        for (count, chance) in [
            (48, 0.5),
            (70, 0.25),
            (70, 0.75),
            (1000, 0.0125),
            (1000, 0.4),
        ] {
            let n = f64::from(count);
            let odds = chance / (1.0 - chance);
            let ratio = |k: f64| odds * (n - k) / (k + 1.0);
            let none = (1.0f64 - chance).powi(count);
            compare(n * chance, chance, none, ratio, 5e-5);
        }
    }

    /// Tests the frequencies of n = 20 000 samples by χ² over the values expected at least 20
    /// times.
    ///
    /// With k values, χ² has mean k − 1 and standard deviation √(2(k − 1)). The limit is six
    /// standard deviations above the mean, a false-alarm probability below 1e-6. The cases cover
    /// few and many trials and probabilities on both sides of ½.
    #[test]
    fn draws_are_binomial() {
        let draws = 20_000;
        for (count, chance) in [(1, 0.3f64), (9, 0.9), (40, 0.5), (300, 0.02), (1000, 0.7)] {
            let key = RngKey::new(6, Purpose::SensorNoise).with(u64::from(count));
            let ln_not = (-chance.min(1.0 - chance)).ln_1p();
            let mut times = vec![0.0; count as usize + 1];
            for i in 0..draws {
                times[binomial(count, chance, ln_not, key.with(i)) as usize] += 1.0;
            }
            let n = f64::from(count);
            let log =
                |k: f64| libm::lgamma(n + 1.0) - libm::lgamma(k + 1.0) - libm::lgamma(n - k + 1.0);
            let of = |k: usize| {
                let k = k as f64;
                draws as f64 * (log(k) + k * chance.ln() + (n - k) * (1.0 - chance).ln()).exp()
            };
            let seen = (0..times.len()).filter(|&k| of(k) >= 20.0);
            let bins = seen.clone().count() as f64;
            let chi2: f64 = seen.map(|k| (times[k] - of(k)).powi(2) / of(k)).sum();
            let bound = bins - 1.0 + 6.0 * (2.0 * (bins - 1.0)).sqrt();
            assert!(chi2 <= bound, "{count} {chance}: {chi2} > {bound}");
        }
    }

    #[test]
    fn certain_trials_succeed_and_impossible_ones_fail() {
        let key = RngKey::new(6, Purpose::SensorNoise);
        for count in [0, 1, 5000] {
            assert_eq!(binomial(count, 0.0, 0.0, key), 0);
            assert_eq!(binomial(count, 1.0, 0.0, key), count);
        }
    }
}
