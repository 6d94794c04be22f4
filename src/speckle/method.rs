//! Interpolation of speckle patterns, and coherence of the light.

use super::coordinate::Coordinate;
use super::pattern::{PatternSpec, refuse};
use crate::error::Result;
use serde::{Deserialize, Serialize};

/// Interpolation of the pattern. `cargo bench --bench speckle` measures the cost of a reading. The
/// stated losses of contrast are for positions between texels and slices, at N/d = 4 and 64 slices.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Linear interpolation of the intensity in s, t and u (Bergmann et al. 2016). It loses 7 % of
    /// the contrast.
    Trilinear,
    /// Linear interpolation of the complex field in s, t and u, divided by the variance that
    /// interpolation keeps.
    ///
    /// A weighted sum of circular Gaussian fields is again circular Gaussian. The intensity is
    /// therefore exponential at every point and loses no contrast (measured below 0.1 %). The
    /// method needs N/d ≥ 4, where interpolation has no visible effect on the grains. Halfway
    /// between slices, grains are too large by the width of a slice. This adds 0.4 % to the
    /// contrast of a pixel with q = 1. Such a pixel needs 7 × 7 readings for an error of 0.5 %: see
    /// [`super::theory::samples_across_pixel`]. A scan does not read a ring but a separate
    /// [`super::frame_field`] for each frame.
    Field,
}

impl Method {
    /// Returns the number of floats per texel.
    pub(super) fn channels(&self) -> usize {
        match self {
            Method::Trilinear => 1,
            Method::Field => 2,
        }
    }
}

/// Properties of the light that lower its speckle contrast.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Coherence {
    /// Degree of polarisation 𝒫 of the light on the sensor, 0 to 1.
    pub polarisation_degree: f64,
    /// Number of independent patterns of equal power (wavelengths, sources).
    pub incoherent_modes: usize,
}

impl Coherence {
    /// One wavelength, polarised: contrast 1.
    pub const FULL: Coherence = Coherence {
        polarisation_degree: 1.0,
        incoherent_modes: 1,
    };

    /// Returns the contrast C = √((1 + 𝒫²)/2N) (Goodman 2007, sections 3.4 and 3.3).
    pub fn contrast(&self) -> f64 {
        let p = self.polarisation_degree;
        ((1.0 + p * p) / (2.0 * self.incoherent_modes as f64)).sqrt()
    }

    pub(super) fn validate(&self) -> Result<()> {
        let p = self.polarisation_degree;
        if !(0.0..=1.0).contains(&p) {
            return refuse("polarisation_degree", p.to_string(), "a number in [0, 1]");
        }
        let n = self.incoherent_modes;
        if !(1..=64).contains(&n) {
            return refuse("incoherent_modes", n.to_string(), "a number from 1 to 64");
        }
        Ok(())
    }

    /// Returns the patterns whose sum is this light: N times two orthogonal polarisations of powers
    /// (1 ± 𝒫)/2N.
    ///
    /// All are the stored pattern, read at distant positions. In (s,t) the positions are steps of a
    /// low-discrepancy lattice (Roberts 2018), and in u they divide the ring equally. At a given
    /// position and time, the patterns are independent. The sum has repeated structure, with 1/n of
    /// its variance, at the distances between these positions. Every pattern also repeats at its
    /// period.
    pub(super) fn layers(&self, spec: &PatternSpec) -> Vec<PatternLayer> {
        let n = self.incoherent_modes;
        let p = self.polarisation_degree;
        let powers = [(1.0 + p) / 2.0, (1.0 - p) / 2.0];
        let powers = (0..n).flat_map(|_| powers).filter(|power| *power > 0.0);
        let powers: Vec<f64> = powers.collect();
        let count = powers.len();
        let texels = |share: f64| (spec.size as f64 * share.fract()).round();
        powers
            .into_iter()
            .enumerate()
            .map(|(j, power)| PatternLayer {
                weight: (power / n as f64) as f32,
                offset: Coordinate {
                    s: texels(0.754_877_666_246_693 * j as f64),
                    t: texels(0.569_840_290_998_053 * j as f64),
                    u: (spec.slices * j / count) as f64,
                },
            })
            .collect()
    }
}

/// Independent pattern of a [`Coherence`].
pub(super) struct PatternLayer {
    pub weight: f32,
    pub offset: Coordinate,
}
