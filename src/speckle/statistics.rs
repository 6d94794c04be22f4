//! Patterns and slices held against theory: the figures `lasertrace speckle`
//! writes and the tests assert.
//!
//! Tolerances are what the project promises (1 % and the like). Each figure
//! carries the standard error of its own measurement; enough patterns are
//! measured to keep it below a quarter of the tolerance, so that a right
//! pattern fails a check by chance with a probability under 1e-4.

pub use super::estimate::Check;
use super::estimate::{Estimate, realisation};
use super::pattern::{PatternSpec, PhasorPlane};
use super::slice_statistics::SliceStatistics;
use super::spectrum::Spectrum;
use super::theory::integrated_contrast;
use crate::error::Result;
use crate::math::DVec2;
use crate::math::sinc;
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use serde::Serialize;

/// Everything measured of one pattern spec.
#[derive(Debug, Clone, Serialize)]
pub struct SpeckleStatistics {
    /// What was made.
    pub spec: PatternSpec,
    /// Patterns made from seeds of their own.
    pub realisations: usize,
    /// In all of them: the phasors they were made from.
    pub independent_speckles: usize,
    /// Contrast σ/⟨I⟩ at a point.
    pub contrast: Check,
    /// Law of the intensity at a point.
    pub exponential: KolmogorovSmirnov,
    /// Shape and size of the grain.
    pub autocovariance: Autocovariance,
    /// For pixels of several sizes.
    pub pixel_integration: Vec<PixelIntegration>,
    /// From one slice of the ring to the next.
    pub slices: SliceStatistics,
    /// All checks pass.
    pub pass: bool,
}

/// Intensities against P(I ≤ x) = 1 − exp(−x). Samples are four grains apart,
/// where the autocovariance is below 0.002 and they count as independent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KolmogorovSmirnov {
    /// Number of intensities.
    pub samples: usize,
    /// Greatest distance of the distributions.
    pub distance: f64,
    /// Distance exceeded with probability `false_alarm_rate`: 2.2253/√n
    /// (Kolmogorov's asymptotic law).
    pub critical: f64,
    /// Probability that a right pattern fails.
    pub false_alarm_rate: f64,
    /// `distance` is not above `critical`.
    pub pass: bool,
}

/// Normalised autocovariance of the intensity against μ².
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Autocovariance {
    /// Along s and along t, at lags of 0, 1, 2 … texels.
    pub along_s: Vec<f64>,
    /// Along t.
    pub along_t: Vec<f64>,
    /// |μ|² along s.
    pub theory_s: Vec<f64>,
    /// |μ|² along t.
    pub theory_t: Vec<f64>,
    /// Greatest deviation over all lags, slanting ones too, within four
    /// grains.
    pub largest_error: f64,
    /// Deviation that passes.
    pub tolerance: f64,
    /// `largest_error` is not above `tolerance`.
    pub pass: bool,
}

/// Contrast after integration over square pixels of pitch p.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PixelIntegration {
    /// p/h.
    pub q: f64,
    /// Contrast σ/⟨I⟩ of the integrals.
    pub contrast: Check,
}

const PIXEL_RATIOS: [f64; 6] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0];

/// Independent speckles measured. Integration over 8 × 8 grains leaves one
/// value of some eighty, so that they fix C there to 0.2 %.
const SPECKLES: usize = 4_000_000;

/// Range of lags and spacing of independent samples, grains.
const FAR: f64 = 4.0;

/// Makes patterns and slices of `spec` under seeds derived from its own and
/// measures them.
pub fn measure(spec: &PatternSpec) -> Result<SpeckleStatistics> {
    spec.validate()?;
    let plane = PhasorPlane::new(spec);
    let phasors = plane.shared(DVec2::ZERO, DVec2::ZERO);
    let realisations = SPECKLES.div_ceil(phasors);
    let totals = Totals::measure(spec, realisations);
    let contrast = Check::new(Estimate::contrast(&totals.squares), 1.0, 0.01);
    let exponential = KolmogorovSmirnov::new(totals.samples);
    let autocovariance = Autocovariance::new(spec, totals.power);
    let integrated = |(i, &q): (usize, &f64)| {
        let squares: Vec<f64> = totals.integrated.iter().map(|c| c[i]).collect();
        let theory = integrated_contrast(spec.aperture, q);
        PixelIntegration {
            q,
            contrast: Check::new(Estimate::contrast(&squares), theory, 0.01 * theory),
        }
    };
    let pixel_integration: Vec<_> = PIXEL_RATIOS.iter().enumerate().map(integrated).collect();
    let slices = SliceStatistics::measure(spec, phasors)?;
    let pass = contrast.pass
        && exponential.pass
        && autocovariance.pass
        && pixel_integration.iter().all(|p| p.contrast.pass)
        && slices.pass;
    Ok(SpeckleStatistics {
        spec: *spec,
        realisations,
        independent_speckles: realisations * phasors,
        contrast,
        exponential,
        autocovariance,
        pixel_integration,
        slices,
        pass,
    })
}

/// What is kept of each realisation, and the sum of their spectra.
struct Totals {
    /// Square of the contrast.
    squares: Vec<f64>,
    /// The same, integrated over each pixel.
    integrated: Vec<[f64; PIXEL_RATIOS.len()]>,
    samples: Vec<f32>,
    /// |FFT of I|², transposed, without its zero frequency.
    power: Vec<f32>,
}

impl Totals {
    fn measure(spec: &PatternSpec, realisations: usize) -> Totals {
        let spectrum = Spectrum::new(spec.size);
        let responses = PIXEL_RATIOS.map(|q| {
            let width = q * spec.texels_per_speckle;
            let response = |i| sinc(width * spectrum.frequency(i)).powi(2);
            (0..spec.size).map(response).collect::<Vec<f64>>()
        });
        let spacing = (FAR * spec.texels_per_speckle / spec.aperture.ratio()).ceil() as usize;
        let mut totals = Totals {
            squares: Vec::new(),
            integrated: Vec::new(),
            samples: Vec::new(),
            power: vec![0.0; spec.size * spec.size],
        };
        // Spectra are added in order, a few at a time: the sum must not depend
        // on which thread ends first, nor memory on how many patterns there are.
        let indices: Vec<usize> = (0..realisations).collect();
        for batch in indices.chunks(8) {
            let measured: Vec<_> = batch
                .par_iter()
                .map(|&r| {
                    let plane = PhasorPlane::new(&realisation(spec, r));
                    let mut values = plane.pattern(DVec2::ZERO).field;
                    values.iter_mut().for_each(|a| *a = a.norm_sqr().into());
                    let rows = values.chunks_exact(spec.size).step_by(spacing);
                    let samples = rows.flat_map(|row| row.iter().step_by(spacing).map(|i| i.re));
                    let samples: Vec<f32> = samples.collect();
                    (samples, power(values, &spectrum))
                })
                .collect();
            for (samples, power) in measured {
                totals.add(samples, &power, &responses);
            }
        }
        totals
    }

    fn add(&mut self, samples: Vec<f32>, power: &[f32], responses: &[Vec<f64>; 6]) {
        self.squares.push(power.iter().map(|p| *p as f64).sum());
        self.integrated.push(std::array::from_fn(|q| {
            let rows = power.chunks_exact(responses[q].len());
            let row_sum = |row: &[f32]| -> f64 {
                row.iter()
                    .zip(&responses[q])
                    .map(|(p, r)| *p as f64 * r)
                    .sum()
            };
            rows.zip(&responses[q])
                .map(|(row, r)| r * row_sum(row))
                .sum()
        }));
        self.samples.extend(samples);
        self.power
            .iter_mut()
            .zip(power)
            .for_each(|(sum, p)| *sum += p);
    }
}

/// Variance of a periodic intensity of mean 1 by frequency (transposed); its
/// sum is the variance itself.
fn power(mut intensity: Vec<Complex32>, spectrum: &Spectrum) -> Vec<f32> {
    let scale = 1.0 / intensity.len() as f32;
    spectrum.forward(&mut intensity);
    intensity[0] = Complex32::ZERO;
    intensity.iter().map(|a| (a * scale).norm_sqr()).collect()
}

impl KolmogorovSmirnov {
    fn new(mut samples: Vec<f32>) -> KolmogorovSmirnov {
        samples.sort_by(f32::total_cmp);
        let n = samples.len() as f64;
        let distance = samples.iter().enumerate().fold(0f64, |most, (i, &x)| {
            let law = 1.0 - (-x as f64).exp();
            let below = law - i as f64 / n;
            let above = (i + 1) as f64 / n - law;
            most.max(below).max(above)
        });
        let critical = 2.2253 / n.sqrt();
        KolmogorovSmirnov {
            samples: samples.len(),
            distance,
            critical,
            false_alarm_rate: 1e-4,
            pass: distance <= critical,
        }
    }
}

impl Autocovariance {
    fn new(spec: &PatternSpec, power: Vec<f32>) -> Autocovariance {
        let size = spec.size;
        let mut covariance: Vec<Complex32> = power.into_iter().map(Complex32::from).collect();
        // The spectrum is transposed; this transposes it back.
        Spectrum::new(size).inverse(&mut covariance);
        let measured = |s: usize, t: usize| (covariance[t * size + s].re / covariance[0].re) as f64;
        let theory = |s: usize, t: usize| {
            let lag = DVec2::new(s as f64, t as f64) / spec.texels_per_speckle;
            spec.aperture.field_correlation(lag).powi(2)
        };
        let lags = 0..=(FAR * spec.texels_per_speckle) as usize;
        let along = |f: &dyn Fn(usize) -> f64| lags.clone().map(f).collect();
        let all = lags.clone().flat_map(|t| lags.clone().map(move |s| (s, t)));
        let largest_error = all.fold(0f64, |most, (s, t)| {
            // Lags (s, −t) are not those (s, t) mirrored: both count.
            let mirrored = measured(s, (size - t) % size);
            let error = |value: f64| (value - theory(s, t)).abs();
            most.max(error(measured(s, t))).max(error(mirrored))
        });
        Autocovariance {
            along_s: along(&|lag| measured(lag, 0)),
            along_t: along(&|lag| measured(0, lag)),
            theory_s: along(&|lag| theory(lag, 0)),
            theory_t: along(&|lag| theory(0, lag)),
            largest_error,
            tolerance: 0.01,
            pass: largest_error <= 0.01,
        }
    }
}
