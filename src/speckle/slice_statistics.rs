//! Comparison of slices and their interpolation with theory.

use super::estimate::{Estimate, StatisticalCheck, realisation};
use super::lookup::{Coherence, Coordinate, Method, SpeckleTexture};
use super::pattern::PatternSpec;
use super::slices::Slices;
use crate::error::Result;
use crate::math::rng::{Purpose, RngKey};
use rayon::prelude::*;
use serde::Serialize;

/// Measured figures of the slices of one pattern spec.
#[derive(Debug, Clone, Serialize)]
pub struct SliceStatistics {
    /// Number of rings of slices, each made with a separate seed.
    pub realisations: usize,
    pub correlation: SliceCorrelation,
    /// Largest excess of the intensity correlation between two slices over the overlap law, from
    /// theory; see [`Slices::interpolation_error`].
    pub interpolation_error: f64,
    /// Contrast of trilinear lookups between texels and slices; 1 if none is lost.
    pub trilinear_contrast: f64,
    pub field_contrast: StatisticalCheck,
    pub pass: bool,
}

/// Intensity correlation of all pairs of slices, compared with the overlap law.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SliceCorrelation {
    pub pairs: usize,
    pub largest_error: f64,
    /// Root mean square of the standard errors of all pairs.
    pub standard_error: f64,
    pub tolerance: f64,
    pub pass: bool,
}

/// Independent speckles per slice, over all realisations. They determine a correlation to 0.0015,
/// and the contrast over all slices to 0.001.
const SPECKLES: usize = 200_000;

impl SliceStatistics {
    pub(super) fn measure(spec: &PatternSpec, phasors: usize) -> Result<SliceStatistics> {
        let realisations = SPECKLES.div_ceil(phasors);
        let mut correlations = Vec::new();
        let mut contrasts = [Vec::new(), Vec::new()];
        for r in 0..realisations {
            let spec = realisation(spec, r);
            for (method, contrasts) in [Method::Trilinear, Method::Field]
                .iter()
                .zip(&mut contrasts)
            {
                let lookup = SpeckleTexture::new(&spec, *method, Coherence::FULL)?;
                contrasts.push(square_contrast(&lookup, &spec));
                // At texels and slices, trilinear lookups return the pattern itself.
                if *method == Method::Trilinear {
                    correlations.push(correlation_of_pairs(&lookup, &spec));
                }
            }
        }
        let slices = Slices::new(spec);
        let correlation = SliceCorrelation::new(&slices, spec.slices, &correlations);
        let field_contrast = StatisticalCheck::new(Estimate::contrast(&contrasts[1]), 1.0, 0.005);
        Ok(SliceStatistics {
            realisations,
            correlation,
            interpolation_error: slices.interpolation_error(),
            trilinear_contrast: Estimate::contrast(&contrasts[0]).value,
            field_contrast,
            pass: correlation.pass && field_contrast.pass,
        })
    }
}

impl SliceCorrelation {
    fn new(slices: &Slices, count: usize, realisations: &[Vec<f64>]) -> SliceCorrelation {
        let mut largest_error = 0f64;
        let mut squares = 0.0;
        let pairs: Vec<_> = pairs(count).collect();
        for (i, &(k, l)) in pairs.iter().enumerate() {
            let values: Vec<f64> = realisations.iter().map(|r| r[i]).collect();
            let mean = Estimate::mean(&values);
            largest_error = largest_error.max((mean.value - slices.overlap_law(k, l)).abs());
            squares += mean.standard_error.powi(2);
        }
        SliceCorrelation {
            pairs: pairs.len(),
            largest_error,
            standard_error: (squares / pairs.len() as f64).sqrt(),
            tolerance: 0.01,
            pass: largest_error <= 0.01,
        }
    }
}

fn pairs(count: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..count).flat_map(move |l| (0..l).map(move |k| (k, l)))
}

/// Returns the correlation coefficients of the intensities of all pairs of slices, read exactly at
/// slices and texels.
fn correlation_of_pairs(lookup: &SpeckleTexture, spec: &PatternSpec) -> Vec<f64> {
    // Two samples per grain determine the intensity completely.
    let step = (spec.texels_per_speckle / 2.0) as usize;
    let texels = || (0..spec.size).step_by(step).map(|i| i as f64);
    let deviations = |k: usize| -> Vec<f32> {
        let at = |(s, t)| Coordinate { s, t, u: k as f64 };
        let points = texels().flat_map(|t| texels().map(move |s| (s, t)));
        let mut values: Vec<f32> = points.map(|p| lookup.intensity(at(p))).collect();
        let mean = values.iter().map(|v| *v as f64).sum::<f64>() / values.len() as f64;
        values.iter_mut().for_each(|v| *v -= mean as f32);
        values
    };
    let slices: Vec<Vec<f32>> = (0..spec.slices).into_par_iter().map(deviations).collect();
    let product = |k: usize, l: usize| -> f64 {
        // Blocks are added in single precision, and their sums in double precision.
        let rows = slices[k].chunks(64).zip(slices[l].chunks(64));
        rows.map(|(a, b)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>() as f64)
            .sum()
    };
    let powers: Vec<f64> = (0..spec.slices).map(|k| product(k, k)).collect();
    let all: Vec<(usize, usize)> = pairs(spec.slices).collect();
    all.into_par_iter()
        .map(|(k, l)| product(k, l) / (powers[k] * powers[l]).sqrt())
        .collect()
}

/// Returns the squared contrast over the complete ring, at random positions between texels and
/// slices.
fn square_contrast(lookup: &SpeckleTexture, spec: &PatternSpec) -> f64 {
    let moments = |row: usize| {
        let key = RngKey::new(spec.seed, Purpose::SpecklePattern).with(row as u64);
        let (t, u) = (
            key.uniform(0) * spec.size as f64,
            key.uniform(1) * spec.slices as f64,
        );
        let read = |i: usize| {
            let s = (i as f64 + key.uniform(i as u64 + 2)) * spec.texels_per_speckle / 2.0;
            lookup.intensity(Coordinate { s, t, u }) as f64
        };
        let points = (2.0 * spec.pupil_width()) as usize;
        (0..points)
            .map(read)
            .fold([0.0; 3], |[n, sum, squares], i| {
                [n + 1.0, sum + i, squares + i * i]
            })
    };
    // Twice the number of independent rows in all slices.
    let rows = 2 * spec.slices * spec.pupil_width() as usize;
    let rows: Vec<[f64; 3]> = (0..rows).into_par_iter().map(moments).collect();
    let [n, sum, squares] = rows
        .into_iter()
        .fold([0.0; 3], |a, b| std::array::from_fn(|i| a[i] + b[i]));
    squares * n / (sum * sum) - 1.0
}
