//! Variance of the row of a line by speckle, shot noise, pixel non-uniformity and background noise,
//! as a function of the position on the sensor.

use super::PeakFinder;
use super::estimator_weights::{estimator_weights, pixel_fractions};
use crate::camera::ChiefRays;
use crate::math::Aperture;
use crate::math::DVec2;
use crate::speckle::column_covariance::ColumnCovariance;
use crate::speckle::theory::strip_covariance;
use glam::{DMat2, UVec2};
use rayon::prelude::*;
use std::sync::LazyLock;

/// Minimum and maximum line width, px. Below the minimum, the alias of the pixel grid exceeds 1 %.
pub const SIGMAS_PX: (f64, f64) = (0.4, 64.0);

/// Speckle of the light on the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeckleGrain {
    /// Positions of the pixels behind the lens.
    pub rays: ChiefRays,
    /// Columns and rows of the sensor.
    pub resolution: UVec2,
    /// Minimal speckle size λ/D, in direction cosines.
    pub size: f64,
    /// Contrast of the light before pixel integration; below 1 for depolarised light or several
    /// wavelengths.
    pub contrast: f64,
    /// Shape of the lens pupil.
    pub aperture: Aperture,
}

impl SpeckleGrain {
    /// Returns the grains per pixel along column and row, in the axes of the pupil plane.
    fn grains_per_pixel(&self, place: DVec2) -> DMat2 {
        self.rays.around(place).1 * self.size.recip()
    }

    /// Returns the number of grains across a column at the sensor centre.
    pub(super) fn across_column(&self) -> f64 {
        let middle = self.resolution.as_dvec2() / 2.0;
        self.grains_per_pixel(middle).x_axis.length()
    }

    /// Returns the grain size along the column at `place`, px.
    pub(super) fn along_column_px(&self, place: DVec2) -> f64 {
        self.grains_per_pixel(place).y_axis.length().recip()
    }
}

const NODES: usize = 96;

/// Variances of the row of a line of one width, px².
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Variances {
    pub speckle: f64,
    /// Shot noise variance divided by K/N.
    pub shot: f64,
    /// Background noise variance divided by (s/N)².
    pub white: f64,
    /// Pixel response variance divided by PRNU².
    pub response: f64,
    /// Relative speckle variance of the light of the line; `pixel` is the variance for one pixel.
    pub light: f64,
    pub pixel: f64,
    /// Standard deviation of the line before lens blur, px.
    pub sharp: f64,
}

/// Variances at the nodes of a grid over the sensor, with interpolation between them.
#[derive(Debug, Clone)]
pub(super) struct VarianceGrid {
    /// Distance of the nodes, px; `count` is their number.
    step: DVec2,
    count: [usize; 2],
    /// Nodes, row by row.
    nodes: Vec<WidthTable>,
}

/// Variances of lines at widths with constant logarithmic spacing over [`SIGMAS_PX`].
type WidthTable = [Variances; NODES];

/// Maximum grid step of [`VarianceGrid`] as viewed from the pupil, rad. For angles up to 45°,
/// 1/cos² is interpolated to 1 %, and the standard deviation to half of that.
const PLACES_RAD: f64 = 0.1;

impl VarianceGrid {
    pub fn new(finder: PeakFinder, grain: Option<&SpeckleGrain>) -> VarianceGrid {
        let lines = lines(finder);
        let Some(grain) = grain else {
            return VarianceGrid {
                step: DVec2::ONE,
                count: [1, 1],
                nodes: vec![widths(lines, |_| vec![0.0])],
            };
        };
        let size = grain.resolution.as_dvec2();
        let cells = [DVec2::X, DVec2::Y].map(|axis| {
            let [from, to] = [-0.5, 0.5].map(|side| {
                let cosines = grain.rays.cosines(size * (0.5 + side * axis));
                cosines.extend((1.0 - cosines.length_squared()).sqrt())
            });
            (from.angle_between(to) / PLACES_RAD).ceil().max(1.0) as usize
        });
        let step = size / DVec2::new(cells[0] as f64, cells[1] as f64);
        let count = cells.map(|cells| cells + 1);
        let node = |i: usize| {
            let place = step * DVec2::new((i % count[0]) as f64, (i / count[0]) as f64);
            let column = column(grain, place);
            widths(lines, |parts| covariances(grain, &column, place, parts))
        };
        VarianceGrid {
            step,
            count,
            nodes: (0..count[0] * count[1]).into_par_iter().map(node).collect(),
        }
    }

    /// Returns the variances of a line of width `sigma` px at `place`.
    pub fn at(&self, place: DVec2, sigma: f64) -> Variances {
        let (least, most) = SIGMAS_PX;
        let width = (sigma / least).max(1.0).ln() / (most / least).ln() * (NODES - 1) as f64;
        let at = (place / self.step).to_array();
        let ends = |at: f64, count: usize| {
            let first = (at.max(0.0) as usize).min(count.saturating_sub(2));
            let share = (at - first as f64).clamp(0.0, 1.0);
            [(first, 1.0 - share), ((first + 1).min(count - 1), share)]
        };
        let [columns, rows] = [0, 1].map(|axis| ends(at[axis], self.count[axis]));
        let mut sum = Variances {
            sharp: sigma,
            ..Variances::default()
        };
        for (row, of_row) in rows {
            for (column, of_column) in columns {
                let node = &self.nodes[row * self.count[0] + column];
                for (width, of_width) in ends(width, NODES) {
                    sum.add(&node[width], of_row * of_column * of_width);
                }
            }
        }
        sum
    }
}

/// Returns the variances of `lines`. `covariances` returns the covariances of the light of pixel
/// parts, for a given number of parts per pixel.
fn widths(lines: &[LineResponse], covariances: impl Fn(usize) -> Vec<f64>) -> WidthTable {
    let pixel = covariances(1)[0];
    let mut known = (0, Vec::new());
    std::array::from_fn(|i| {
        let line = &lines[i];
        if known.0 != line.parts {
            known = (line.parts, covariances(line.parts));
        }
        line.variances(pixel, &known.1)
    })
}

/// Returns the number of parts into which a pixel is divided so that a line of width σ illuminates
/// each part almost uniformly.
///
/// A part of height s·σ omits s²/12·(dG/dx)²/G² of the mean square of the light, on average s²/24
/// over the line. For σ/4, this is 0.3 %.
fn subpixel_count(sigma: f64) -> usize {
    (4.0 / sigma).ceil() as usize
}

/// Returns the covariance function of the light of a column at `place`, for all lags that
/// [`covariances`] uses.
fn column(grain: &SpeckleGrain, place: DVec2) -> ColumnCovariance {
    let grains = grain.grains_per_pixel(place);
    // Eight grains, rounded up to parts, plus the height of a part.
    let reach = (8.0 * grain.along_column_px(place)).min(MOST_PIXELS) + 3.0;
    ColumnCovariance::new(grain.aperture, grains, reach)
}

/// Maximum number of pixels and of pixel parts illuminated by any line. Covariances at greater lags
/// are not used.
const MOST_PIXELS: f64 = 512.0;
const MOST_PARTS: f64 = 64.0;

/// Returns the covariances of the light of pixel parts at lags of 0, 1, … parts in a column at
/// `place`.
///
/// Each pixel has `parts` parts. The list ends where the remainder is below a thousandth of the
/// total, since ∫μ² beyond r decreases as (h/r)²/60. It also ends at the maximum extent of any line
/// with this number of parts.
fn covariances(
    grain: &SpeckleGrain,
    column: &ColumnCovariance,
    place: DVec2,
    parts: usize,
) -> Vec<f64> {
    let most = if parts > 1 { MOST_PARTS } else { MOST_PIXELS };
    let along = grain.along_column_px(place) * parts as f64;
    let lags = (8.0 * along).ceil().min(most) as usize + 1;
    let high = 1.0 / parts as f64;
    let mut all = column.of(high, (0..=lags).map(|lag| lag as f64 * high));
    all.iter_mut().for_each(|c| *c *= grain.contrast.powi(2));
    all
}

/// Returns the covariances of the light of pixels at lags of 0, 1, … columns at `place`.
pub(super) fn along_row(grain: &SpeckleGrain, place: DVec2, count: usize) -> Vec<f64> {
    let grains = grain.grains_per_pixel(place);
    let covariance = |lag| strip_covariance(grain.aperture, grains, 1.0, DVec2::X * lag as f64);
    let of = |lag| grain.contrast.powi(2) * covariance(lag);
    (0..count).map(of).collect()
}

/// Returns the correlations of row errors by speckle at lags of 0, 1, 2, … columns at `place`, for
/// lines of width `sigma` px.
///
/// The error is Σ w_i·G_i·δ_i over the pixels of a column ([`ErrorModel`](super::ErrorModel)). The
/// list ends at the last value above [`LEAST_CORRELATION`]. For a round pupil and pixels ≪ h ≪ σ,
/// the sum over both signs of the lag is (4/π)/(32/3π²)·h = 1.178 h.
pub(super) fn column_correlation(
    finder: PeakFinder,
    grain: &SpeckleGrain,
    place: DVec2,
    sigma: f64,
) -> Vec<f64> {
    let line = LineResponse::new(finder, sigma.clamp(SIGMAS_PX.0, SIGMAS_PX.1));
    let grains = grain.grains_per_pixel(place);
    let high = 1.0 / line.parts as f64;
    let rows = (8.0 * grain.along_column_px(place) / high)
        .ceil()
        .min(MOST_PIXELS) as usize;
    let covariance = |columns: usize| -> f64 {
        let of = |(row, product): (usize, &f64)| {
            let lag = DVec2::new(columns as f64, row as f64 * high);
            // For sheared grains, the covariances of the two diagonals differ.
            let sides = [lag, lag * DVec2::new(1.0, -1.0)];
            let light = sides.map(|lag| strip_covariance(grain.aperture, grains, high, lag));
            product * (light[0] + light[1]) / 2.0
        };
        line.weight_autocorrelation
            .iter()
            .enumerate()
            .take(rows + 1)
            .map(of)
            .sum()
    };
    let all = covariance(0);
    let next = (1..MOST_COLUMNS).map(|columns| covariance(columns) / all);
    let next = next.take_while(|&rho| rho > LEAST_CORRELATION);
    std::iter::once(1.0).chain(next).collect()
}

/// Minimum correlation between columns. The omitted remainder is below a hundredth of the sum.
const LEAST_CORRELATION: f64 = 0.01;
/// Maximum number of columns, for grains of 16 columns.
const MOST_COLUMNS: usize = 64;

/// Returns the lines of all widths of [`WidthTable`]; computed once per estimator.
fn lines(finder: PeakFinder) -> &'static [LineResponse] {
    static LINES: [LazyLock<Vec<LineResponse>>; 4] = [
        LazyLock::new(|| of_all_widths(PeakFinder::Centroid)),
        LazyLock::new(|| of_all_widths(PeakFinder::LogParabola)),
        LazyLock::new(|| of_all_widths(PeakFinder::GaussianFit)),
        LazyLock::new(|| of_all_widths(PeakFinder::DerivativeZero)),
    ];
    &LINES[finder as usize]
}

fn of_all_widths(finder: PeakFinder) -> Vec<LineResponse> {
    let (least, most) = SIGMAS_PX;
    let sigma = |i: usize| least * (most / least).powf(i as f64 / (NODES - 1) as f64);
    (0..NODES)
        .map(|i| LineResponse::new(finder, sigma(i)))
        .collect()
}

/// Line of one width, averaged over a line at a pixel centre and a line at a pixel border.
struct LineResponse {
    /// Number of parts per pixel.
    parts: usize,
    shot: f64,
    white: f64,
    response: f64,
    /// Autocorrelation, over both signs of the lag, of the light of pixel parts weighted by their
    /// influence. `lights` is the autocorrelation without the weights.
    weight_autocorrelation: Vec<f64>,
    lights: Vec<f64>,
}

impl LineResponse {
    fn new(finder: PeakFinder, sigma: f64) -> LineResponse {
        let parts = subpixel_count(sigma);
        let mut line = LineResponse {
            parts,
            shot: 0.0,
            white: 0.0,
            response: 0.0,
            weight_autocorrelation: Vec::new(),
            lights: Vec::new(),
        };
        for row in [0.0, 0.5] {
            let pixels = estimator_weights(finder, sigma, row);
            for &(light, weight) in &pixels {
                line.shot += weight * weight * light / 2.0;
                line.white += weight * weight / 2.0;
                line.response += (weight * light).powi(2) / 2.0;
            }
            // All parts of a pixel have the influence of the pixel.
            let weights = pixels.iter().flat_map(|p| std::iter::repeat_n(p.1, parts));
            let lights: Vec<f64> = pixel_fractions(sigma, row, parts).collect();
            let moves: Vec<f64> = lights.iter().zip(weights).map(|(l, w)| l * w).collect();
            add_products(&mut line.lights, &lights);
            add_products(&mut line.weight_autocorrelation, &moves);
        }
        line
    }

    /// Returns the variances; `covariance` refers to pixel parts.
    fn variances(&self, pixel: f64, covariance: &[f64]) -> Variances {
        let sum = |products: &[f64]| products.iter().zip(covariance).map(|(p, c)| p * c).sum();
        Variances {
            speckle: sum(&self.weight_autocorrelation),
            shot: self.shot,
            white: self.white,
            response: self.response,
            light: sum(&self.lights),
            pixel,
            sharp: 0.0,
        }
    }
}

/// Adds half the autocorrelation of `values`, over both signs of the lag.
fn add_products(sums: &mut Vec<f64>, values: &[f64]) {
    sums.resize(sums.len().max(values.len()), 0.0);
    for (lag, sum) in sums.iter_mut().enumerate().take(values.len()) {
        let signs = if lag == 0 { 1.0 } else { 2.0 };
        let pairs = values.iter().zip(&values[lag..]);
        *sum += signs / 2.0 * pairs.map(|(a, b)| a * b).sum::<f64>();
    }
}

impl Variances {
    fn add(&mut self, other: &Variances, share: f64) {
        self.speckle += share * other.speckle;
        self.shot += share * other.shot;
        self.white += share * other.white;
        self.response += share * other.response;
        self.light += share * other.light;
        self.pixel += share * other.pixel;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraModel;
    use crate::speckle::theory::centroid_noise;
    use std::f64::consts::PI;

    fn at(finder: PeakFinder, size_px: f64, sigma: f64) -> Variances {
        // A large distance makes the grains round.
        let camera = CameraModel {
            resolution: UVec2::splat(100),
            pixel_pitch: 1e-3,
            principal_distance: 1e3,
            principal_point: DVec2::splat(50.0),
            tilt: DVec2::ZERO,
            distortion: None,
        };
        let grain = SpeckleGrain {
            rays: camera.chief_rays(),
            resolution: camera.resolution,
            size: size_px * 1e-6,
            contrast: 0.5,
            aperture: Aperture::Circle,
        };
        VarianceGrid::new(finder, Some(&grain)).at(DVec2::splat(50.0), sigma)
    }

    /// For the centroid and pixels ≪ h ≪ σ, the speckle variance agrees with the closed form.
    ///
    /// Integration over a pixel of h/4 reduces the variance by 5 % (C = 0.975). The finite
    /// h/σ = 1/12 contributes 2 % (4 % at 1/2 in the test of the closed form, decreasing with h/σ),
    /// and interpolation 0.4 %.
    #[test]
    fn the_law_of_centroid_noise_is_a_limit() {
        let found = at(PeakFinder::Centroid, 4.0, 48.0).speckle.sqrt();
        let law = centroid_noise(4.0, 48.0, 0.5);
        assert!((0.95..1.0).contains(&(found / law)), "{found} {law}");
    }

    /// The sum of correlations is (4/π)/(32/3π²) = 1.178 grains, the ratio of the integral of μ²
    /// over the plane to the integral along a column.
    ///
    /// Pixels of h/4 increase it by (1/16)/24·π²/2, which is 1 %. The finite h/σ = 1/12 and the
    /// truncation at a hundredth contribute 2 % each.
    #[test]
    fn the_sum_of_correlations_is_that_of_two_dimensional_grains() {
        let camera = CameraModel {
            resolution: UVec2::splat(100),
            pixel_pitch: 1e-3,
            principal_distance: 1e3,
            principal_point: DVec2::splat(50.0),
            tilt: DVec2::ZERO,
            distortion: None,
        };
        let grain = SpeckleGrain {
            rays: camera.chief_rays(),
            resolution: camera.resolution,
            size: 4e-6,
            contrast: 0.5,
            aperture: Aperture::Circle,
        };
        let middle = DVec2::splat(50.0);
        let rho = column_correlation(PeakFinder::Centroid, &grain, middle, 48.0);
        let sum = 1.0 + 2.0 * rho[1..].iter().sum::<f64>();
        assert!((sum / (4.0 * 1.178) - 1.0).abs() < 0.04, "{sum} {rho:?}");
    }

    /// In white noise, the weights of the fit attain the Cramér–Rao bound for a line of unit light.
    /// For pixels ≪ σ, Σw² = 4√π·σ³. The centroid has (2/3)·(4σ)³.
    #[test]
    fn white_noise_is_weighted_as_each_finder_does() {
        let white = |finder| at(finder, 1.0, 20.0).white;
        let fit = 4.0 * PI.sqrt() * 8000.0;
        assert!((white(PeakFinder::GaussianFit) / fit - 1.0).abs() < 0.01);
        let centroid = 2.0 / 3.0 * 80f64.powi(3);
        assert!((white(PeakFinder::Centroid) / centroid - 1.0).abs() < 0.01);
        assert!(white(PeakFinder::LogParabola) > fit && white(PeakFinder::DerivativeZero) > fit);
    }
}
