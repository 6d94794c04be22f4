//! Correlation and displacement of pairs of speckle images, with confidence intervals.

use super::image::{WaveImage, fft2};
use crate::math::DVec2;
use crate::math::rng::{Purpose, RngKey};
use rayon::prelude::*;
use rustfft::FftDirection;
use rustfft::num_complex::Complex64;
use std::f64::consts::TAU;

/// Search range for the peak, in pixels to each side of the expected position.
const SEARCH: isize = 4;
const LAGS: usize = (2 * SEARCH as usize + 1).pow(2);
const RESAMPLES: u64 = 1000;

/// Value with its 95 % confidence interval.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct MeanEstimate {
    /// Best estimate.
    pub value: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

impl MeanEstimate {
    /// True if the interval contains `value`.
    pub fn holds(&self, value: f64) -> bool {
        self.low <= value && value <= self.high
    }

    /// Returns the estimate in a different unit.
    pub fn scaled(&self, factor: f64) -> MeanEstimate {
        let [a, b] = [self.low * factor, self.high * factor];
        MeanEstimate {
            value: self.value * factor,
            low: a.min(b),
            high: a.max(b),
        }
    }
}

/// Relation of the second images to the first images of many independent pairs.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct PairCorrelation {
    /// Correlation of the intensities at the expected displacement.
    pub gamma: MeanEstimate,
    /// Displacement of the highest correlation (mm in the image plane), right and up. `None` if
    /// fewer than nineteen of twenty resamples have a peak within four pixels of the expected
    /// position.
    pub displacement: Option<[MeanEstimate; 2]>,
}

/// Sums of one pair over the compared region.
struct PairSums {
    covariance: [f64; LAGS],
    variance: [f64; 2],
}

/// Computes γ and displacement from independent pairs, over the central `region` × `region` pixels.
///
/// The images are first shifted by half the expected displacement in opposite directions. The shift
/// is exact, because they are band-limited and periodic. γ is then evaluated at one position and
/// not at the highest of many. The maximum of a noisy correlation is biased upwards, and more so
/// for small γ.
///
/// The mean of all realisations is subtracted from each pixel of each image. This is equivalent to
/// subtracting the covariance of images of different realisations. The shape of the patch and the
/// mean of a region therefore cannot imitate or hide correlation. The factor n/(n−1) of this
/// subtraction cancels in the ratio γ = Σcov/√(Σvar₁·Σvar₂).
///
/// The displacement is the expected displacement plus the vertex of a paraboloid through the
/// highest value and its eight neighbours. Intervals are percentiles of 1000 bootstrap resamples of
/// the realisations (Efron 1979).
pub fn correlate_pairs(
    pairs: &[[WaveImage; 2]],
    expected: DVec2,
    region: usize,
    seed: u64,
) -> PairCorrelation {
    assert!(pairs.len() >= 2, "one pair has no error bar");
    let pixel = pairs[0][0].grid.pixel_mm;
    let half = expected / 2.0;
    let shifted: Vec<[WaveImage; 2]> = pairs
        .par_iter()
        .map(|[first, second]| [displaced(first, half), displaced(second, -half)])
        .collect();
    let mean = [0, 1].map(|k| mean_image(shifted.iter().map(|pair| &pair[k])));
    let sums: Vec<PairSums> = shifted
        .par_iter()
        .map(|pair| pair_sums(pair, &mean, region))
        .collect();
    let all: Vec<usize> = (0..sums.len()).collect();
    let (gamma, offset) = gamma_and_offset(&sums, &all);
    let resampled = bootstrap(sums.len(), seed, |drawn| gamma_and_offset(&sums, drawn));
    let found: Vec<DVec2> = resampled.iter().filter_map(|r| r.1).collect();
    let displacement = offset
        .filter(|_| found.len() as u64 * 20 >= RESAMPLES * 19)
        .map(|offset| {
            [DVec2::X, DVec2::Y].map(|axis| {
                interval(
                    axis.dot(expected + offset * pixel),
                    found.iter().map(|o| axis.dot(expected + *o * pixel)),
                )
            })
        });
    PairCorrelation {
        gamma: interval(gamma, resampled.iter().map(|r| r.0)),
        displacement,
    }
}

/// Evaluates `statistic` for 1000 samples of `count` realisations with replacement.
pub(super) fn bootstrap<T>(count: usize, seed: u64, statistic: impl Fn(&[usize]) -> T) -> Vec<T> {
    (0..RESAMPLES)
        .map(|k| {
            let key = RngKey::new(seed, Purpose::Bootstrap).with(k);
            let draw = |i| (key.uniform(i) * count as f64) as usize;
            statistic(&(0..count as u64).map(draw).collect::<Vec<_>>())
        })
        .collect()
}

/// Returns `value` with the central 95 % of its bootstrap resamples.
pub(super) fn interval(value: f64, resampled: impl Iterator<Item = f64>) -> MeanEstimate {
    let mut sorted: Vec<f64> = resampled.collect();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted[(share * (sorted.len() - 1) as f64).round() as usize];
    MeanEstimate {
        value,
        low: at(0.025),
        high: at(0.975),
    }
}

/// Displaces the image by `by` (mm), as a periodic band-limited function.
fn displaced(image: &WaveImage, by: DVec2) -> WaveImage {
    let n = image.grid.pixels;
    let mut samples: Vec<Complex64> = image.intensity.iter().map(|i| (*i).into()).collect();
    fft2(&mut samples, n, FftDirection::Forward);
    let ramp = |shift: f64| -> Vec<Complex64> {
        (0..n)
            .map(|k| {
                let frequency = if k < n / 2 {
                    k as f64
                } else {
                    k as f64 - n as f64
                };
                let phase = -TAU * frequency * shift / (image.grid.pixel_mm * n as f64);
                Complex64::from_polar(1.0 / n as f64, phase)
            })
            .collect()
    };
    let (x, y) = (ramp(by.x), ramp(by.y));
    for (index, s) in samples.iter_mut().enumerate() {
        *s *= x[index % n] * y[index / n];
    }
    fft2(&mut samples, n, FftDirection::Inverse);
    WaveImage {
        grid: image.grid,
        intensity: samples.iter().map(|s| s.re).collect(),
    }
}

fn mean_image<'a>(images: impl ExactSizeIterator<Item = &'a WaveImage>) -> Vec<f64> {
    let share = 1.0 / images.len() as f64;
    images.fold(Vec::new(), |mut sum, image| {
        sum.resize(image.intensity.len(), 0.0);
        for (s, i) in sum.iter_mut().zip(&image.intensity) {
            *s += i * share;
        }
        sum
    })
}

fn pair_sums(images: &[WaveImage; 2], mean: &[Vec<f64>; 2], region: usize) -> PairSums {
    let n = images[0].grid.pixels;
    let margin = (n - region) / 2;
    assert!(margin > SEARCH as usize, "region as wide as the image");
    let rest: [Vec<f64>; 2] = [0, 1].map(|k| {
        let both = images[k].intensity.iter().zip(&mean[k]);
        both.map(|(i, m)| i - m).collect()
    });
    let product = |a: &[f64], b: &[f64], dx: isize, dy: isize| -> f64 {
        (margin..margin + region)
            .map(|j| {
                let from = j * n + margin;
                let to = (from as isize + dy * n as isize + dx) as usize;
                let (a, b) = (&a[from..from + region], &b[to..to + region]);
                a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()
            })
            .sum()
    };
    let side = 2 * SEARCH + 1;
    PairSums {
        covariance: std::array::from_fn(|k| {
            let (dx, dy) = (k as isize % side - SEARCH, k as isize / side - SEARCH);
            product(&rest[0], &rest[1], dx, dy)
        }),
        variance: [0, 1].map(|k| product(&rest[k], &rest[k], 0, 0)),
    }
}

/// Returns γ at the expected position, and the offset of the peak from it in pixels.
fn gamma_and_offset(sums: &[PairSums], drawn: &[usize]) -> (f64, Option<DVec2>) {
    let mut covariance = [0.0; LAGS];
    let mut variance = [0.0; 2];
    for &index in drawn {
        for (total, c) in covariance.iter_mut().zip(&sums[index].covariance) {
            *total += c;
        }
        for (total, v) in variance.iter_mut().zip(&sums[index].variance) {
            *total += v;
        }
    }
    let gamma = covariance[LAGS / 2] / (variance[0] * variance[1]).sqrt();
    (gamma, peak_offset(&covariance))
}

/// Returns the vertex of the least-squares paraboloid through the highest value and its eight
/// neighbours. Returns `None` if the highest value is on the border, or if the vertex is outside
/// the nine positions.
fn peak_offset(values: &[f64; LAGS]) -> Option<DVec2> {
    let side = 2 * SEARCH as usize + 1;
    let top = (0..LAGS).max_by(|&a, &b| values[a].total_cmp(&values[b]))?;
    let (x, y) = (top % side, top / side);
    if x == 0 || y == 0 || x == side - 1 || y == side - 1 {
        return None;
    }
    let mut fit = [0.0; 5];
    for dy in -1..=1isize {
        for dx in -1..=1isize {
            let z = values[(top as isize + dy * side as isize + dx) as usize];
            let (u, v) = (dx as f64, dy as f64);
            let terms = [
                u / 6.0,
                v / 6.0,
                u * u - 2.0 / 3.0,
                u * v / 4.0,
                v * v - 2.0 / 3.0,
            ];
            for (f, t) in fit.iter_mut().zip(terms) {
                *f += z * t;
            }
        }
    }
    let [gx, gy, hxx, hxy, hyy] = fit;
    let determinant = hxx * hyy - hxy * hxy;
    let vertex = DVec2::new(hxy * gy - hyy * gx, hxy * gx - hxx * gy) / determinant;
    (determinant > 0.0 && vertex.abs().max_element() <= 1.0)
        .then(|| vertex + DVec2::new(x as f64, y as f64) - DVec2::splat(SEARCH as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Aperture, DVec3};
    use crate::wave::image::{ImageGrid, PupilField, WavePupil, intensity_at_focus};

    /// Returns a pupil field of independent circular Gaussian samples.
    fn random_field(key: RngKey) -> PupilField {
        let reach = 10usize;
        let side = 2 * reach + 1;
        let value = |k: usize| {
            let (i, j) = (k % side, k / side);
            if i.abs_diff(reach).pow(2) + j.abs_diff(reach).pow(2) > reach * reach {
                return Complex64::ZERO;
            }
            let u = |c| key.with(k as u64).uniform(c);
            Complex64::from_polar((-(1.0 - u(0)).ln()).sqrt(), TAU * u(1))
        };
        let pupil = WavePupil {
            centre: DVec3::Z * 300.0,
            right: DVec3::X,
            up: DVec3::Y,
            diameter: 10.0,
            aperture: Aperture::Circle,
        };
        PupilField {
            pupil,
            wavelength_mm: 660e-6,
            pitch: 0.5,
            reach,
            values: (0..side * side).map(value).collect(),
            inside: 317,
        }
    }

    /// Returns `count` pairs whose fields correlate by μ, with the second image displaced by `way`.
    fn pairs(count: u64, mu: f64, way: DVec2) -> Vec<[WaveImage; 2]> {
        let grid = ImageGrid {
            pixels: 128,
            pixel_mm: 660e-6 * 300.0 / 0.5 / 128.0,
            focus_distance: 300.0,
        };
        let field = |k| random_field(RngKey::new(9, Purpose::WaveScatterers).with(k));
        (0..count)
            .map(|k| {
                let (first, mut other) = (field(2 * k), field(2 * k + 1));
                for (o, f) in other.values.iter_mut().zip(&first.values) {
                    *o = f * mu + *o * (1.0 - mu * mu).sqrt();
                }
                let second = intensity_at_focus(&other, &grid);
                [intensity_at_focus(&first, &grid), displaced(&second, way)]
            })
            .collect()
    }

    /// Nineteen of twenty intervals contain the true value. The seeds are fixed, and the tolerance
    /// of 1.5 intervals is three standard errors.
    #[test]
    fn gamma_is_the_square_of_the_field_correlation_and_zero_without_bias() {
        for mu in [0.0, 0.4, 0.8] {
            let way = DVec2::new(0.011, -0.004);
            let found = correlate_pairs(&pairs(24, mu, way), way, 100, 1);
            let half = 0.75 * (found.gamma.high - found.gamma.low);
            let error = found.gamma.value - mu * mu;
            assert!(error.abs() < half && half < 0.06, "{mu}: {:?}", found.gamma);
            assert_eq!(found.displacement.is_some(), mu > 0.3, "{mu}");
        }
    }

    #[test]
    fn a_displacement_off_the_expected_place_is_found_to_a_fraction_of_a_pixel() {
        let way = DVec2::new(0.0133, -0.0042);
        let found = correlate_pairs(&pairs(8, 1.0, way), way + DVec2::new(0.004, 0.002), 100, 1);
        let [x, y] = found.displacement.unwrap();
        // A grain is 6.4 pixels of 3.1 µm. The vertex of a paraboloid through nine pixels deviates
        // from the true peak by a few hundredths of a pixel.
        assert!((x.value - way.x).abs() < 0.15e-3, "{x:?}");
        assert!((y.value - way.y).abs() < 0.15e-3, "{y:?}");
    }

    #[test]
    fn the_paraboloid_finds_its_own_vertex_and_refuses_a_border() {
        let vertex = DVec2::new(1.3, -0.6);
        let side = 2 * SEARCH as usize + 1;
        let place = |k: usize| DVec2::new((k % side) as f64, (k / side) as f64) - SEARCH as f64;
        let hill = |top: DVec2| -> [f64; LAGS] {
            std::array::from_fn(|k| {
                let d = place(k) - top;
                5.0 - d.x * d.x - 0.4 * d.x * d.y - 2.0 * d.y * d.y
            })
        };
        let found = peak_offset(&hill(vertex)).unwrap();
        assert!((found - vertex).length() < 1e-12, "{found}");
        assert_eq!(peak_offset(&hill(DVec2::new(6.0, 0.0))), None);
    }
}
