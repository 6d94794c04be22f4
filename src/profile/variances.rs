//! What speckle, shot noise, uneven pixels and the background's noise do to the row of a line, anywhere on
//! the sensor.

use super::PeakFinder;
use super::influence::{influence, shares};
use crate::camera::ChiefRays;
use crate::math::Aperture;
use crate::math::DVec2;
use crate::speckle::column_covariance::ColumnCovariance;
use crate::speckle::theory::strip_covariance;
use glam::{DMat2, UVec2};
use rayon::prelude::*;
use std::sync::LazyLock;

/// Narrowest and widest line, px: below, pixels alias by more than a hundredth.
pub const SIGMAS_PX: (f64, f64) = (0.4, 64.0);

/// Speckle of the light on the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeckleGrain {
    /// Where pixels lie behind the lens.
    pub rays: ChiefRays,
    /// Columns, rows of the sensor.
    pub resolution: UVec2,
    /// Minimal speckle size λ/D, in direction cosines.
    pub size: f64,
    /// Contrast of the light before pixels integrate it; below 1 if it is
    /// depolarised or of several wavelengths.
    pub contrast: f64,
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
}

impl SpeckleGrain {
    /// By column and by row, in the axes of the pupil's plane.
    fn grains_per_pixel(&self, place: DVec2) -> DMat2 {
        self.rays.around(place).1 * self.size.recip()
    }

    /// Length along the column of the grains there, px.
    pub(super) fn along_column_px(&self, place: DVec2) -> f64 {
        self.grains_per_pixel(place).y_axis.length().recip()
    }
}

const NODES: usize = 96;

/// Variances of the row of a line of one width, px².
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Variances {
    pub speckle: f64,
    /// Over K/N.
    pub shot: f64,
    /// Over (s/N)².
    pub white: f64,
    /// Over PRNU².
    pub response: f64,
    /// Relative, of the line's light, from speckle, and of one pixel's.
    pub light: f64,
    pub pixel: f64,
    /// Standard deviation of the line before the lens spreads it, px.
    pub sharp: f64,
}

/// Of lines at nodes of a grid over the sensor, between which they are interpolated.
#[derive(Debug, Clone)]
pub(super) struct Places {
    /// Distance of the nodes, px, and their number.
    step: DVec2,
    count: [usize; 2],
    /// Row by row.
    nodes: Vec<Widths>,
}

/// Variances of lines at widths evenly spaced in their logarithm, over [`SIGMAS_PX`].
type Widths = [Variances; NODES];

/// Widest step of [`Places`] as seen from the pupil, rad: between nodes so far apart
/// 1/cos² of an angle up to 45° is interpolated to 1 %, half of that in the standard
/// deviation.
const PLACES_RAD: f64 = 0.1;

impl Places {
    pub fn new(finder: PeakFinder, grain: Option<&SpeckleGrain>) -> Places {
        let lines = lines(finder);
        let Some(grain) = grain else {
            return Places {
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
        Places {
            step,
            count,
            nodes: (0..count[0] * count[1]).into_par_iter().map(node).collect(),
        }
    }

    /// Variances of a line so wide at a place on the sensor.
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

/// Variances of `lines`; `covariances`: of the light of parts of pixels that have so many each.
fn widths(lines: &[Line], covariances: impl Fn(usize) -> Vec<f64>) -> Widths {
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

/// Parts into which a pixel's height is divided so that a line of σ lights each all but evenly.
/// Of the mean square of light, a part s·σ high leaves out s²/12·(dG/dx)²/G², s²/24 on average
/// over the line; of σ/4 that is 0.3 %.
fn parts(sigma: f64) -> usize {
    (4.0 / sigma).ceil() as usize
}

/// The same light of pixels of a column about a place, at all distances that [`covariances`]
/// asks for.
fn column(grain: &SpeckleGrain, place: DVec2) -> ColumnCovariance {
    let grains = grain.grains_per_pixel(place);
    // Eight grains, rounded up to parts, and a part's own height.
    let reach = (8.0 * grain.along_column_px(place)).min(MOST_PIXELS) + 3.0;
    ColumnCovariance::new(grain.aperture, grains, reach)
}

/// Most pixels, and parts of pixels, that any line lights so that covariances of those further
/// apart matter.
const MOST_PIXELS: f64 = 512.0;
const MOST_PARTS: f64 = 64.0;

/// Covariance of the light of parts 0, 1, … apart of the pixels of a column about a place, which
/// have so many each, until what is left is below a thousandth of it all, as ∫μ² beyond r falls
/// as (h/r)²/60, or past what any line of that many parts lights.
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

/// Covariance of the light of pixels 0, 1, … columns apart about a place.
pub(super) fn along_row(grain: &SpeckleGrain, place: DVec2, count: usize) -> Vec<f64> {
    let grains = grain.grains_per_pixel(place);
    let covariance = |lag| strip_covariance(grain.aperture, grains, 1.0, DVec2::X * lag as f64);
    let of = |lag| grain.contrast.powi(2) * covariance(lag);
    (0..count).map(of).collect()
}

/// Correlation of the rows that speckle gives to lines of `sigma` px in columns 0, 1, 2, … apart about a place,
/// up to the last above [`LEAST_CORRELATION`]: of Σ w_i·G_i·δ_i over the pixels of one column with that of another
/// ([`ErrorModel`](super::ErrorModel)). For a round pupil, pixels ≪ h ≪ σ, their sum over both sides is (4/π)/(32/3π²)·h = 1.178 h.
pub(super) fn column_correlation(
    finder: PeakFinder,
    grain: &SpeckleGrain,
    place: DVec2,
    sigma: f64,
) -> Vec<f64> {
    let line = Line::new(finder, sigma.clamp(SIGMAS_PX.0, SIGMAS_PX.1));
    let grains = grain.grains_per_pixel(place);
    let high = 1.0 / line.parts as f64;
    let rows = (8.0 * grain.along_column_px(place) / high)
        .ceil()
        .min(MOST_PIXELS) as usize;
    let covariance = |columns: usize| -> f64 {
        let of = |(row, product): (usize, &f64)| {
            let lag = DVec2::new(columns as f64, row as f64 * high);
            // Sheared grains lie otherwise on the two sides.
            let sides = [lag, lag * DVec2::new(1.0, -1.0)];
            let light = sides.map(|lag| strip_covariance(grain.aperture, grains, high, lag));
            product * (light[0] + light[1]) / 2.0
        };
        line.moves.iter().enumerate().take(rows + 1).map(of).sum()
    };
    let all = covariance(0);
    let next = (1..MOST_COLUMNS).map(|columns| covariance(columns) / all);
    let next = next.take_while(|&rho| rho > LEAST_CORRELATION);
    std::iter::once(1.0).chain(next).collect()
}

/// Correlation between columns that counts as none: what lies beyond is below a hundredth of its sum.
const LEAST_CORRELATION: f64 = 0.01;
/// Columns beyond which it is not followed: grains of 16 columns.
const MOST_COLUMNS: usize = 64;

/// Lines of all widths of [`Widths`], worked out once.
fn lines(finder: PeakFinder) -> &'static [Line] {
    static LINES: [LazyLock<Vec<Line>>; 4] = [
        LazyLock::new(|| of_all_widths(PeakFinder::Centroid)),
        LazyLock::new(|| of_all_widths(PeakFinder::LogParabola)),
        LazyLock::new(|| of_all_widths(PeakFinder::GaussianFit)),
        LazyLock::new(|| of_all_widths(PeakFinder::DerivativeZero)),
    ];
    &LINES[finder as usize]
}

fn of_all_widths(finder: PeakFinder) -> Vec<Line> {
    let (least, most) = SIGMAS_PX;
    let sigma = |i: usize| least * (most / least).powf(i as f64 / (NODES - 1) as f64);
    (0..NODES).map(|i| Line::new(finder, sigma(i))).collect()
}

/// A line of one width, as the mean over one at a pixel's middle and one at its edge.
struct Line {
    /// Into which each pixel's height is divided.
    parts: usize,
    shot: f64,
    white: f64,
    response: f64,
    /// Sums of products of the light of parts so far apart, as it moves the finder and as it
    /// is; those of both signs of a distance.
    moves: Vec<f64>,
    lights: Vec<f64>,
}

impl Line {
    fn new(finder: PeakFinder, sigma: f64) -> Line {
        let parts = parts(sigma);
        let mut line = Line {
            parts,
            shot: 0.0,
            white: 0.0,
            response: 0.0,
            moves: Vec::new(),
            lights: Vec::new(),
        };
        for row in [0.0, 0.5] {
            let pixels = influence(finder, sigma, row);
            for &(light, weight) in &pixels {
                line.shot += weight * weight * light / 2.0;
                line.white += weight * weight / 2.0;
                line.response += (weight * light).powi(2) / 2.0;
            }
            // A part moves the finder as its pixel does.
            let weights = pixels.iter().flat_map(|p| std::iter::repeat_n(p.1, parts));
            let lights: Vec<f64> = shares(sigma, row, parts).collect();
            let moves: Vec<f64> = lights.iter().zip(weights).map(|(l, w)| l * w).collect();
            add_products(&mut line.lights, &lights);
            add_products(&mut line.moves, &moves);
        }
        line
    }

    /// `covariance` is that of parts.
    fn variances(&self, pixel: f64, covariance: &[f64]) -> Variances {
        let sum = |products: &[f64]| products.iter().zip(covariance).map(|(p, c)| p * c).sum();
        Variances {
            speckle: sum(&self.moves),
            shot: self.shot,
            white: self.white,
            response: self.response,
            light: sum(&self.lights),
            pixel,
            sharp: 0.0,
        }
    }
}

/// Adds half the sums of products of `values` so far apart, of both signs of the distance.
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
        // So far away that grains are round.
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
        Places::new(finder, Some(&grain)).at(DVec2::splat(50.0), sigma)
    }

    /// Pixels ≪ h ≪ σ: integration over a pixel of h/4 takes 5 % off the variance
    /// (C = 0.975), the finite h/σ = 1/12 2 % (4 % at 1/2 by the closed form's own
    /// check, falling with h/σ), the interpolation 0.4 %.
    #[test]
    fn the_law_of_centroid_noise_is_a_limit() {
        let found = at(PeakFinder::Centroid, 4.0, 48.0).speckle.sqrt();
        let law = centroid_noise(4.0, 48.0, 0.5);
        assert!((0.95..1.0).contains(&(found / law)), "{found} {law}");
    }

    /// (4/π)/(32/3π²) = 1.178 grains, the integral of μ² over the plane over that along a column. Pixels of h/4
    /// widen it by (1/16)/24·π²/2 of itself, 1 %; h/σ = 1/12, and what is cut off below a hundredth, are 2 % each.
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

    /// In white noise the weights of the fit give the Cramér–Rao bound of a line of unit
    /// light: Σw² = 4√π·σ³ for pixels ≪ σ, and the centroid's (2/3)·(4σ)³.
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
