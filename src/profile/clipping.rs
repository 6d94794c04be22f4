//! What saturation leaves of a speckled line: its bright grains lose light, those in its
//! middle most.

use std::f64::consts::TAU;

/// Least share of a line's light that is left if its centroid is to be believed. Light that
/// does not saturate, such as a faint second line's, then moves the centroid twice as far as it
/// should at most.
const LEAST_KEPT: f64 = 0.5;

const NODES: usize = 48;

/// A Gaussian line of speckle that saturates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Clipped {
    /// Its light over that of a Gaussian as high as saturation and as wide as it is.
    fill: f64,
    /// Variance of its centroid by speckle over that of a whole line as wide as it is.
    pub variance: f64,
    /// Share of its light that is left.
    kept: f64,
}

impl Clipped {
    pub const WHOLE: Clipped = Clipped {
        fill: 0.0,
        variance: 1.0,
        kept: 1.0,
    };

    pub fn keeps_enough(&self) -> bool {
        self.kept >= LEAST_KEPT
    }

    fn between(&self, other: &Clipped, share: f64) -> Clipped {
        let mean = |a: f64, b: f64| a + share * (b - a);
        Clipped {
            fill: mean(self.fill, other.fill),
            variance: mean(self.variance, other.variance),
            kept: mean(self.kept, other.kept),
        }
    }
}

/// Lines of mean heights from 0 to 10 times saturation.
#[derive(Debug, Clone)]
pub(super) struct Clipping(Vec<Clipped>);

impl Clipping {
    /// `variance` is the relative one of a pixel's light, which is gamma-distributed.
    ///
    /// The centroid's variance is ∫v·x²/(∫m)² with m and v the mean and variance of the light
    /// that a pixel keeps at x: pixels are as correlated as without saturation. By Monte Carlo
    /// with mean heights up to twice saturation, standard deviations are right to 1 % for
    /// h = σ/8, and up to 4 % too small for h = σ/1.4 (grains of 1.2 px) and 6 % for h = σ.
    pub fn new(variance: f64) -> Clipping {
        if variance <= 0.0 {
            return Clipping(Vec::new());
        }
        let grains = gamma(1.0 / variance);
        let heights = (1..NODES).map(|i| 0.05 * 200f64.powf((i - 1) as f64 / (NODES - 2) as f64));
        let clipped = heights.map(|height| clipped(height, &grains, variance));
        Clipping(std::iter::once(Clipped::WHOLE).chain(clipped).collect())
    }

    /// Of lines whose mean light is `light`, as counted, of standard deviation `sigma` with their
    /// pixels, where a pixel holds `full` above background. `None` past the greatest of all,
    /// and where there is no speckle.
    pub fn at(&self, light: f64, sigma: f64, full: f64) -> Option<Clipped> {
        let fill = light / (TAU.sqrt() * sigma * full);
        let after = self.0.partition_point(|clipped| clipped.fill <= fill);
        let (a, b) = (self.0.get(after.checked_sub(1)?)?, self.0.get(after)?);
        Some(a.between(b, (fill - a.fill) / (b.fill - a.fill)))
    }
}

/// Mean height of a line, in saturations, from which on too much of its light is lost for its
/// centroid to be believed. `variance` is the relative one of a pixel's light by speckle;
/// without speckle no pixel may saturate.
pub fn blinding_height(variance: f64) -> f64 {
    if variance <= 0.0 {
        return 1.0;
    }
    let grains = gamma(1.0 / variance);
    let (mut low, mut high) = (1.0, 10.0);
    for _ in 0..30 {
        let middle = (low + high) / 2.0;
        match clipped(middle, &grains, variance).keeps_enough() {
            true => low = middle,
            false => high = middle,
        }
    }
    low
}

/// Values and shares of a gamma-distributed light of shape `m` and mean 1.
fn gamma(m: f64) -> Vec<(f64, f64)> {
    let most = 1.0 + 8.0 / m.sqrt() + 8.0 / m;
    let n = 400;
    let value = |i: usize| (i as f64 + 0.5) / n as f64 * most;
    let density = |x: f64| ((m - 1.0) * x.ln() - m * (x - 1.0)).exp();
    let all: f64 = (0..n).map(|i| density(value(i))).sum();
    (0..n)
        .map(|i| (value(i), density(value(i)) / all))
        .collect()
}

/// A line of unit width whose mean height is so many times saturation.
fn clipped(height: f64, grains: &[(f64, f64)], variance: f64) -> Clipped {
    let step = 0.1;
    let (mut light, mut second, mut spread) = (0.0, 0.0, 0.0);
    for i in 0..60 {
        let x = (i as f64 + 0.5) * step;
        let mean = height * (-0.5 * x * x).exp();
        let kept = |power: i32| -> f64 {
            let of = |&(value, share): &(f64, f64)| share * (mean * value).min(1.0).powi(power);
            grains.iter().map(of).sum()
        };
        let (first, squares) = (kept(1), kept(2));
        light += 2.0 * step * first;
        second += 2.0 * step * first * x * x;
        spread += 2.0 * step * (squares - first * first) * x * x;
    }
    let width = (second / light).sqrt();
    // ∫E²x²dx/(∫E dx)² of a Gaussian.
    let whole = variance * width / (4.0 * (TAU / 2.0).sqrt());
    Clipped {
        fill: light / (TAU.sqrt() * width),
        variance: spread / (light * light) / whole,
        kept: light / (TAU.sqrt() * height),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Exponential light of mean μ keeps μ·(1 − e^(−1/μ)) of itself below 1. A line that does not
    /// reach saturation is whole; one as high as it loses a quarter of its light.
    #[test]
    fn exponential_light_keeps_what_the_closed_form_says() {
        let grains = gamma(1.0);
        let kept: f64 = grains
            .iter()
            .map(|(x, share)| share * (2.0 * x).min(1.0))
            .sum();
        assert!(
            (kept / (2.0 * (1.0 - (-0.5f64).exp())) - 1.0).abs() < 2e-3,
            "{kept}"
        );
        let low = clipped(0.02, &grains, 1.0);
        for value in [low.variance, low.kept, low.fill / 0.02] {
            assert!((value - 1.0).abs() < 0.01, "{low:?}");
        }
        let high = clipped(1.0, &grains, 1.0);
        assert!((high.kept - 0.761).abs() < 0.005, "{high:?}");
    }

    /// Exponential light keeps 1 - e^(-1/μ) of itself, half of it on average over a Gaussian
    /// line 2.31 times as high as saturation (its integral by quadrature).
    #[test]
    fn a_line_that_blinds_keeps_half_its_light() {
        assert_eq!(blinding_height(0.0), 1.0);
        let height = blinding_height(1.0);
        assert!((height - 2.31).abs() < 0.03, "{height}");
    }

    /// What is found by its light and width is the line that was clipped.
    #[test]
    fn a_clipped_line_is_told_by_its_light_and_width() {
        let clipping = Clipping::new(0.5);
        let line = clipped(1.5, &gamma(2.0), 0.5);
        let light = 1.5 * line.kept * TAU.sqrt() * 3.0 * 800.0;
        let sigma = light / (line.fill * TAU.sqrt() * 800.0);
        let found = clipping.at(light, sigma, 800.0).unwrap();
        assert!(
            (found.kept / line.kept - 1.0).abs() < 0.01,
            "{found:?} {line:?}"
        );
        assert!((found.variance / line.variance - 1.0).abs() < 0.01);
        assert!(found.keeps_enough());
        assert_eq!(clipping.at(10.0 * light, sigma, 800.0), None);
        assert_eq!(Clipping::new(0.0).at(light, sigma, 800.0), None);
    }
}
