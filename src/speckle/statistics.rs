//! Comparison of patterns and slices with theory: the figures written by `lasertrace speckle` and
//! asserted by the tests.
//!
//! Tolerances are the accuracy that the project promises, for example 1 %. Each figure includes the
//! standard error of its measurement. Enough patterns are measured to keep this error below a
//! quarter of the tolerance. A correct pattern then fails a check by chance with a probability
//! below 1e-4.

pub use super::estimate::StatisticalCheck;
use super::estimate::{Estimate, realisation};
use super::fft2::Spectrum;
use super::pattern::{PatternSpec, PhasorPlane};
use super::slice_statistics::SliceStatistics;
use super::theory::integrated_contrast;
use crate::error::Result;
use crate::math::DVec2;
use crate::math::sinc;
use rayon::prelude::*;
use rustfft::num_complex::Complex32;
use serde::Serialize;

/// All measured figures of one pattern spec.
#[derive(Debug, Clone, Serialize)]
pub struct SpeckleStatistics {
    /// Parameters of the patterns.
    pub spec: PatternSpec,
    /// Number of patterns, each made with a separate seed.
    pub realisations: usize,
    /// Independent speckles in all patterns, equal to the number of phasors.
    pub independent_speckles: usize,
    /// Contrast σ/⟨I⟩ at a point.
    pub contrast: StatisticalCheck,
    /// Distribution of the intensity at a point.
    pub exponential: KolmogorovSmirnov,
    /// Shape and size of the grains.
    pub autocovariance: Autocovariance,
    /// Contrast for several pixel sizes.
    pub pixel_integration: Vec<PixelIntegration>,
    /// Correlation between neighbouring slices of the ring.
    pub slices: SliceStatistics,
    /// True if all checks pass.
    pub pass: bool,
}

/// Kolmogorov–Smirnov test of the intensities against P(I ≤ x) = 1 − exp(−x). The samples have a
/// spacing of four grains. The autocovariance there is below 0.002, so they count as independent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KolmogorovSmirnov {
    /// Number of intensities.
    pub samples: usize,
    /// Largest distance between the two distribution functions.
    pub distance: f64,
    /// Distance that is exceeded with probability `false_alarm_rate`: 2.2253/√n (Kolmogorov's
    /// asymptotic law).
    pub critical: f64,
    /// Probability that a correct pattern fails.
    pub false_alarm_rate: f64,
    /// True if `distance` is not above `critical`.
    pub pass: bool,
}

/// Normalised autocovariance of the intensity against μ².
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Autocovariance {
    /// Autocovariance along s, at lags of 0, 1, 2 … texels.
    pub along_s: Vec<f64>,
    /// Autocovariance along t, at the lags of `along_s`.
    pub along_t: Vec<f64>,
    /// |μ|² along s.
    pub theory_s: Vec<f64>,
    /// |μ|² along t.
    pub theory_t: Vec<f64>,
    /// Largest deviation over all lags within four grains, including oblique lags.
    pub largest_error: f64,
    /// Largest accepted deviation.
    pub tolerance: f64,
    /// True if `largest_error` is not above `tolerance`.
    pub pass: bool,
}

/// Contrast after integration over square pixels of pitch p.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PixelIntegration {
    /// p/h.
    pub q: f64,
    /// Contrast σ/⟨I⟩ of the integrals.
    pub contrast: StatisticalCheck,
}

const PIXEL_RATIOS: [f64; 6] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0];

/// Independent speckles to measure. Integration over 8 × 8 grains reduces about eighty speckles to
/// one value, so C is determined there to 0.2 %.
const SPECKLES: usize = 4_000_000;

/// Largest lag, and spacing of independent samples, grains.
const FAR: f64 = 4.0;

/// Generates patterns and slices of `spec`, with seeds derived from its seed, and measures them.
pub fn measure(spec: &PatternSpec) -> Result<SpeckleStatistics> {
    spec.validate()?;
    let plane = PhasorPlane::new(spec);
    let phasors = plane.shared(DVec2::ZERO, DVec2::ZERO);
    let realisations = SPECKLES.div_ceil(phasors);
    let totals = Totals::measure(spec, realisations);
    let contrast = StatisticalCheck::new(Estimate::contrast(&totals.squares), 1.0, 0.01);
    let exponential = KolmogorovSmirnov::new(totals.samples);
    let autocovariance = Autocovariance::new(spec, totals.power);
    let integrated = |(i, &q): (usize, &f64)| {
        let squares: Vec<f64> = totals.integrated.iter().map(|c| c[i]).collect();
        let theory = integrated_contrast(spec.aperture, q);
        PixelIntegration {
            q,
            contrast: StatisticalCheck::new(Estimate::contrast(&squares), theory, 0.01 * theory),
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

/// Measured values of each realisation, and the sum of their spectra.
struct Totals {
    /// Squared contrast.
    squares: Vec<f64>,
    /// Squared contrast after integration over each pixel size.
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
        // Spectra are added in order, in small batches. The sum must not depend on the order in
        // which threads finish, and memory must not grow with the number of patterns.
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

/// Returns the power spectrum of a periodic intensity of mean 1 (transposed). Its sum is the
/// variance.
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
        // The spectrum is transposed, and this transform transposes it back.
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
            // The lags (s, −t) are not mirror images of the lags (s, t): both count.
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
