//! How speckle is read, and the coherence of the light it is of.

use super::coordinate::Coordinate;
use super::pattern::{PatternSpec, refuse};
use crate::error::Result;
use serde::{Deserialize, Serialize};

/// How the pattern is interpolated; what a reading costs, `cargo bench --bench speckle` tells. Losses
/// are of contrast, anywhere between texels and slices, at N/d = 4 and 64 slices.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Intensity, linear in s, t and u (Bergmann et al. 2016). Loses 7 % of
    /// the contrast.
    Trilinear,
    /// Complex field, linear in s, t and u, divided by the variance the blend
    /// leaves. A sum of circular Gaussian fields is one, whatever the weights:
    /// the intensity is exponential at every point and loses nothing (measured
    /// below 0.1 %). Wants N/d ≥ 4, where interpolation has no visible
    /// effect on the grains; halfway between slices they are a slice's width
    /// too large, which adds 0.4 % to the contrast of a pixel with q = 1. That
    /// pixel takes 7 × 7 readings for 0.5 %: see
    /// [`super::theory::samples_across_pixel`]. A scan does not read it from a
    /// ring but from a [`super::frame_field`] of each frame's own.
    Field,
}

impl Method {
    /// Floats per texel.
    pub(super) fn channels(&self) -> usize {
        match self {
            Method::Trilinear => 1,
            Method::Field => 2,
        }
    }
}

/// What lowers the contrast of the light itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Coherence {
    /// Degree of polarisation 𝒫 of the light on the sensor, 0 to 1.
    pub polarisation_degree: f64,
    /// Number of independent patterns of equal power (wavelengths, sources).
    pub independent_patterns: usize,
}

impl Coherence {
    /// One wavelength, polarised: contrast 1.
    pub const FULL: Coherence = Coherence {
        polarisation_degree: 1.0,
        independent_patterns: 1,
    };

    /// C = √((1 + 𝒫²)/2N) (Goodman 2007, sections 3.4 and 3.3).
    pub fn contrast(&self) -> f64 {
        let p = self.polarisation_degree;
        ((1.0 + p * p) / (2.0 * self.independent_patterns as f64)).sqrt()
    }

    pub(super) fn validate(&self) -> Result<()> {
        let p = self.polarisation_degree;
        if !(0.0..=1.0).contains(&p) {
            return refuse("polarisation_degree", p.to_string(), "a number in [0, 1]");
        }
        let n = self.independent_patterns;
        if !(1..=64).contains(&n) {
            return refuse(
                "independent_patterns",
                n.to_string(),
                "a number from 1 to 64",
            );
        }
        Ok(())
    }

    /// The patterns that add up to this light: N times two orthogonal
    /// polarisations of powers (1 ± 𝒫)/2N. They are the stored pattern read
    /// far apart: at steps of a low-discrepancy lattice in (s,t) (Roberts
    /// 2018) and evenly round the path in u. At one place and time they are
    /// independent; the sum repeats, at 1/n of its variance, at the distances
    /// between them, as every pattern does at its period.
    pub(super) fn layers(&self, spec: &PatternSpec) -> Vec<Layer> {
        let n = self.independent_patterns;
        let p = self.polarisation_degree;
        let powers = [(1.0 + p) / 2.0, (1.0 - p) / 2.0];
        let powers = (0..n).flat_map(|_| powers).filter(|power| *power > 0.0);
        let powers: Vec<f64> = powers.collect();
        let count = powers.len();
        let texels = |share: f64| (spec.size as f64 * share.fract()).round();
        powers
            .into_iter()
            .enumerate()
            .map(|(j, power)| Layer {
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

/// One of the independent patterns of a [`Coherence`].
pub(super) struct Layer {
    pub weight: f32,
    pub offset: Coordinate,
}
