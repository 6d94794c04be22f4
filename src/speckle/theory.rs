//! Closed forms for fully developed, polarised speckle. Patterns and lookups are verified against
//! them.

use crate::math::Aperture;
use crate::math::DVec2;
use crate::math::quadrature::gauss_legendre;
use crate::math::sinc;
use glam::DMat2;
use nalgebra::DMatrix;
use std::f64::consts::PI;
use std::sync::LazyLock;

/// Standard deviation of the Gaussian nearest to the core of the Airy pattern across a line, grains
/// (Zhang, Zerubia & Olivo-Marin 2007: 0.21·λ/NA).
pub const AIRY_SIGMA: f64 = 0.42;

impl Aperture {
    /// Returns the correlation μ of the speckle *fields* at two sensor points separated by `lag`,
    /// in units of the minimal speckle size h = λ·d_PI/D (D the pupil width).
    ///
    /// It is the Fourier transform of the pupil (Goodman 2007, eq. 4-58): 2J₁(πr)/(πr) for a
    /// circle, sinc·sinc for a square. The autocovariance of the *intensity* is μ².
    pub fn field_correlation(&self, lag: DVec2) -> f64 {
        match *self {
            Aperture::Circle => jinc(lag.length()),
            Aperture::Ellipse(ratio) => jinc(DVec2::new(lag.x, ratio * lag.y).length()),
            Aperture::Square => sinc(lag.x) * sinc(lag.y),
        }
    }

    /// Returns the overlap of the pupil with itself after a shift, as a fraction of its area.
    ///
    /// This is the correlation μ of the speckle fields before and after the pupil content moved by
    /// `shift`, in pupil widths along x and pupil heights along y. For a circle it is (2/π)·(acos δ
    /// − δ·√(1−δ²)) for δ ≤ 1, else 0 (the optical transfer function of a disc). For a square it is
    /// the product of two triangles. The correlation γ of the *intensities* is μ².
    pub fn overlap(&self, shift: DVec2) -> f64 {
        match self {
            Aperture::Circle | Aperture::Ellipse(_) => {
                let delta = shift.length().min(1.0);
                2.0 / std::f64::consts::PI * (delta.acos() - delta * (1.0 - delta * delta).sqrt())
            }
            Aperture::Square => (1.0 - shift.x.abs()).max(0.0) * (1.0 - shift.y.abs()).max(0.0),
        }
    }
}

/// Returns the contrast of fully developed speckle integrated over square pixels of pitch p = q·h.
///
/// C² = ∬Λ(x)Λ(y)·μ²(qx, qy) dx dy, Λ(x) = 1 − |x| on [−1, 1] (Goodman 2007, eq. 4-92). For a
/// circle, C is 0.975, 0.906, 0.711, 0.440, 0.246, 0.131 at q = ¼ … 8. The integral is computed by
/// Gauss–Legendre quadrature with two panels of eight nodes per grain, to 1e-9.
pub fn integrated_contrast(aperture: Aperture, q: f64) -> f64 {
    let nodes = panels((2.0 * q).ceil().max(2.0) as usize);
    let variance: f64 = nodes
        .iter()
        .flat_map(|&x| nodes.iter().map(move |&y| (x, y)))
        .map(|((x, wx), (y, wy))| {
            let mu = aperture.field_correlation(q * DVec2::new(x, y));
            4.0 * wx * wy * (1.0 - x) * (1.0 - y) * mu * mu
        })
        .sum();
    variance.sqrt()
}

/// Returns the covariance of the irradiance of two pixels separated by `lag` (columns, rows). The
/// pixels are [strips](strip_covariance) one pixel high.
pub fn pixel_covariance(aperture: Aperture, grains: DMat2, lag: DVec2) -> f64 {
    strip_covariance(aperture, grains, 1.0, lag)
}

/// Returns the covariance of the irradiance of two strips separated by `lag` (columns, rows), for
/// fully developed speckle of mean 1. Each strip is one pixel wide and `high` pixels high.
///
/// The covariance is ∬Λ(x)Λ(y)·μ²(G·((x, high·y) + lag)) dx dy with Λ(x) = 1 − |x| on [−1, 1]. G is
/// the number of grains per column and per row, in the axes of the pupil
/// ([`Camera::grains_per_pixel`](crate::camera::Camera::grains_per_pixel)). For full pixels, G =
/// q·1 and zero lag, it is the square of [`integrated_contrast`].
///
/// The integral is computed by Gauss–Legendre quadrature with panels of eight nodes per half grain.
/// Above 16 grains per side, the value for 16 grains is scaled with the inverse number of grains.
/// The error is then 2 % for full pixels.
pub fn strip_covariance(aperture: Aperture, grains: DMat2, high: f64, lag: DVec2) -> f64 {
    let across = [grains.x_axis.length(), grains.y_axis.length() * high];
    let share = effective_pixel_fraction(across);
    let [columns, rows] = across.map(|grains| triangle(share * grains));
    let of_row = |&(y, wy): &(f64, f64)| {
        let row = columns.iter().map(|&(x, wx)| {
            let place = DVec2::new(x, high * y) + lag;
            let mu = aperture.field_correlation(share * (grains * place));
            wx * mu * mu
        });
        wy * row.sum::<f64>()
    };
    rows.iter().map(of_row).sum::<f64>() * share * share
}

/// Returns the fraction of a pixel that represents the full pixel in an integral, for a pixel of
/// `across` grains along each side.
pub(super) fn effective_pixel_fraction(across: [f64; 2]) -> f64 {
    (16.0 / across[0].max(across[1])).min(1.0)
}

/// Returns nodes and weights on [−1, 1] for ∫Λ(x)·f(x) dx over a side of `grains` grains.
pub(super) fn triangle(grains: f64) -> Vec<(f64, f64)> {
    let nodes = panels((2.0 * grains).ceil().max(1.0) as usize);
    let sides = nodes.into_iter().flat_map(|(x, w)| [(x, w), (-x, w)]);
    sides.map(|(x, w)| (x, w * (1.0 - x.abs()))).collect()
}

/// Returns the contrast of the mean of n × n point samples, at the nodes of Gauss–Legendre
/// quadrature over a pixel of pitch p = q·h. It converges to [`integrated_contrast`].
pub fn sampled_contrast(aperture: Aperture, q: f64, n: usize) -> f64 {
    let rule = gauss_legendre(n);
    covariance(aperture, q, &rule, &rule).sqrt()
}

/// Returns the covariance of the means over two symmetric rules of nodes and weights on [0, 1], for
/// a pixel of pitch q·h.
fn covariance(aperture: Aperture, q: f64, a: &[(f64, f64)], b: &[(f64, f64)]) -> f64 {
    // μ² is even along both axes.
    let twice = |lag: f64| if lag > 1e-9 { 2.0 } else { 1.0 };
    let lags = a
        .iter()
        .flat_map(|&(x, w)| b.iter().map(move |&(y, v)| (x - y, w * v)));
    let lags = lags.filter(|&(lag, _)| lag > -1e-9);
    let lags: Vec<(f64, f64)> = lags.map(|(lag, w)| (lag, w * twice(lag))).collect();
    let of_row = |&(y, w): &(f64, f64)| {
        let row = lags.iter().map(|&(x, v)| {
            let mu = aperture.field_correlation(q * DVec2::new(x, y));
            v * mu * mu
        });
        w * row.sum::<f64>()
    };
    lags.iter().map(of_row).sum()
}

/// Returns the standard deviation of the sampling error: the mean of n × n point samples over a
/// pixel of pitch p = q·h, minus the mean over the full pixel. The speckle has mean 1. The result
/// is √(C_n² + C² − 2·K), where K is the covariance of both means from the quadrature above.
pub fn sampling_deviation(aperture: Aperture, q: f64, n: usize) -> f64 {
    let (rule, pixel) = (
        gauss_legendre(n),
        panels((2.0 * q).ceil().max(2.0) as usize),
    );
    let variances =
        covariance(aperture, q, &rule, &rule) + integrated_contrast(aperture, q).powi(2);
    let shared = covariance(aperture, q, &rule, &pixel);
    (variances - 2.0 * shared).max(0.0).sqrt()
}

/// Returns the least n for which n × n point samples give the contrast of a pixel of pitch p = q·h
/// to the relative `error`.
pub fn samples_across_pixel(aperture: Aperture, q: f64, error: f64) -> usize {
    // Few samples have too little contrast, or too much if their spacing is several grains. An
    // accidental match between the two cases fails for coarser grains.
    let grains = [1.0, 0.95, 0.9, 0.85, 0.8].map(|coarser| coarser * q);
    let exact = grains.map(|q| (q, integrated_contrast(aperture, q)));
    let close = |n: usize, (q, exact): (f64, f64)| {
        (sampled_contrast(aperture, q, n) / exact - 1.0).abs() <= error
    };
    (1..)
        .find(|&n| exact.into_iter().all(|pixel| close(n, pixel)))
        .expect("the sum converges to the integral")
}

/// Returns the standard deviation of the centroid of a Gaussian line along one sensor column, from
/// speckle only, in the unit of the arguments.
///
/// It is √(∫μ²dx · hσ/(4√π))·C = 0.3905·√(hσ)·C. `h` is the minimal speckle size, `sigma` the
/// standard deviation of the line (half its 1/e² radius) and `contrast` the contrast of the light.
/// For a circular pupil, ∫μ²dx = 32/(3π²) h. Pixels are assumed ≪ h. The error is 1.5 % for σ ≥ 5h.
/// At 2h the value is 4–5 % too high, and below 2h it is not valid.
pub fn centroid_noise(h: f64, sigma: f64, contrast: f64) -> f64 {
    let pi = std::f64::consts::PI;
    contrast * (32.0 / (3.0 * pi * pi) * h * sigma / (4.0 * pi.sqrt())).sqrt()
}

/// Returns κ of the centroid noise that defocus adds to a line in fully developed speckle.
///
/// Per column of the image, std² = std₀² + (κ·b)²·h/σ. Here b is the diameter of the blur (the
/// pupil's width, on the sensor) and h the minimal speckle size. σ is the standard deviation of the
/// line's sharp image, and std₀ the noise in focus ([`centroid_noise`]). The added noise is
/// proportional to the contrast of the light. `sigma` is σ/h, clamped to 0.25–16 for a pupil's
/// height. A square pixel is `q` grains wide.
///
/// In the pupil, the field of one column is B₀(p)·exp(iπbhp²) for |p| ≤ 1/(2h). B₀ is circular
/// Gaussian noise of the covariance min(c(p), c(p′))·exp(−2π²σ²(p−p′)²), where c(p) is the pupil's
/// chord across the column (Goodman 2007, sections 4.4 and 4.5). The centroid moves by
/// b·h·∫p|B₀|²/∫|B₀|², a ratio of quadratic forms. Its variance is ∫₀^∞ t·Σ
/// λᵢλⱼPᵢⱼ²/((1+tλᵢ)(1+tλⱼ))·Π 1/(1+tλ) dt (Magnus 1986). Here λ are the eigenvalues of the
/// covariance, and P is p in the basis of its eigenvectors. The variance is interpolated from a
/// table over σ, to 1e-4. Pixels are included to first order, as the mean of the columns within
/// them.
///
/// For σ ≫ h and q → 0, κ is √(4/(15·π^2.5)) = 0.1235 for a disc and (24√π)^−½ = 0.1533 for a
/// square. κ is valid for a uniformly lit pupil and a blur that is constant along the line.
pub fn defocus_noise(aperture: Aperture, q: f64, sigma: f64) -> f64 {
    // An ellipse is a disc in units of its height.
    let ratio = aperture.ratio();
    let lines = match aperture {
        Aperture::Square => &SQUARE_LINES,
        _ => &DISC_LINES,
    };
    let octaves = (sigma * ratio).log2().clamp(LINES.0, LINES.1);
    let steps = (octaves - LINES.0) * LINE_STEPS;
    let first = (steps as usize).min(lines.len() - 4);
    let four: Vec<f64> = lines[first..first + 4].iter().map(|l| l.noise(q)).collect();
    ratio.sqrt() * lagrange(&four, steps - first as f64)
}

/// Range of σ/h in the table of κ, in octaves, and table steps per octave.
const LINES: (f64, f64) = (-2.0, 4.0);
const LINE_STEPS: f64 = 4.0;

/// Number of lines in the table.
const LINE_COUNT: usize = 26;
/// κ² of the lines for infinitely narrow pixels, from the eigenvalues of the covariance. A test
/// computes the values.
const DISC_VARIANCES: [f64; LINE_COUNT] = [
    0.0016337705428950712,
    0.0021934569280064476,
    0.0028508622919242964,
    0.003582078159220296,
    0.004369653315222811,
    0.0051962828769489796,
    0.006042580774483602,
    0.006891205971609227,
    0.007720779441134236,
    0.008520721696803788,
    0.00927973842080111,
    0.009989687188712197,
    0.01064060720046655,
    0.011234970381254601,
    0.011771643176979294,
    0.012249946679392448,
    0.012671607771527846,
    0.013041756290444547,
    0.013364552983416333,
    0.013644452579402161,
    0.013885039459298545,
    0.014091273468549131,
    0.014267894653865595,
    0.014418518551153881,
    0.014546435635130873,
    0.01465500490229795,
];
const SQUARE_VARIANCES: [f64; LINE_COUNT] = [
    0.003513087578565487,
    0.004484432311778555,
    0.005564902611874024,
    0.006719261232233967,
    0.007912026326278973,
    0.009113421848994373,
    0.010301032660655683,
    0.011459079875641374,
    0.012576632203149724,
    0.013645712366477707,
    0.014660027001484405,
    0.015614402212684815,
    0.016504695965320025,
    0.017327926894807968,
    0.018082430923699943,
    0.018767941358509038,
    0.01938555553310248,
    0.019937595306211614,
    0.020427391659746746,
    0.020859030440990384,
    0.021237092873483052,
    0.021566416033175023,
    0.0218518888285477,
    0.022098290408595265,
    0.022310171428240967,
    0.022491774404289504,
];

static DISC_LINES: LazyLock<Vec<DefocusLine>> =
    LazyLock::new(|| lines(Aperture::Circle, &DISC_VARIANCES));
static SQUARE_LINES: LazyLock<Vec<DefocusLine>> =
    LazyLock::new(|| lines(Aperture::Square, &SQUARE_VARIANCES));

/// Returns σ/h of a line of the table. The table begins one step before the least σ/h.
fn line_sigma(i: usize) -> f64 {
    (LINES.0 + (i as f64 - 1.0) / LINE_STEPS).exp2()
}

/// Creates the table.
fn lines(aperture: Aperture, variances: &[f64; LINE_COUNT]) -> Vec<DefocusLine> {
    let lines = variances.iter().enumerate();
    lines
        .map(|(i, &variance)| DefocusLine::new(aperture, line_sigma(i), variance))
        .collect()
}

/// κ of a line for one image column, for a pupil of equal height and width; see [`defocus_noise`].
struct DefocusLine {
    /// κ².
    variance: f64,
    /// Chords of the pupil. For each, the fraction of κ² from pairs of pupil positions in which
    /// this chord is the shorter one.
    chords: Vec<[f64; 2]>,
}

impl DefocusLine {
    /// Creates a line of standard deviation `sigma`, in grains, with this κ².
    fn new(aperture: Aperture, sigma: f64, variance: f64) -> DefocusLine {
        let (nodes, covariance) = pupil_covariance(aperture, sigma);
        let mut chords: Vec<[f64; 2]> = nodes.iter().map(|[_, _, c]| [*c, 0.0]).collect();
        for (i, [p, _, c]) in nodes.iter().enumerate() {
            for (j, [r, _, d]) in nodes.iter().enumerate() {
                let shorter = if c < d { i } else { j };
                chords[shorter][1] += p * r * covariance[(i, j)].powi(2);
            }
        }
        let all: f64 = chords.iter().map(|[_, share]| share).sum();
        chords.iter_mut().for_each(|[_, share]| *share /= all);
        DefocusLine { variance, chords }
    }

    /// Returns κ for pixels `q` grains wide.
    fn noise(&self, q: f64) -> f64 {
        let of_chord = |[chord, share]: &[f64; 2]| share * pixel_variance_factor(chord * q);
        (self.variance * self.chords.iter().map(of_chord).sum::<f64>()).sqrt()
    }
}

/// Returns nodes of the pupil (position, weight, chord) and the covariance of the weighted field at
/// these nodes, for a line of standard deviation `sigma`, in grains.
fn pupil_covariance(aperture: Aperture, sigma: f64) -> (Vec<[f64; 3]>, DMatrix<f64>) {
    let chord = |x: f64| match aperture {
        Aperture::Square => 1.0,
        _ => (1.0 - x * x).sqrt(),
    };
    // About four nodes per standard deviation of the covariance, 1/(2πσ).
    let rule = gauss_legendre(16 + (12.0 * sigma) as usize);
    let nodes: Vec<[f64; 3]> = (rule.iter())
        .map(|&(x, w)| [x - 0.5, w, chord(2.0 * x - 1.0)])
        .collect();
    let n = nodes.len();
    let power: f64 = nodes.iter().map(|[_, w, c]| w * c).sum();
    let covariance = DMatrix::from_fn(n, n, |i, j| {
        let ([p, v, c], [r, w, d]) = (nodes[i], nodes[j]);
        (v * w).sqrt() * c.min(d) * (-2.0 * (PI * sigma * (p - r)).powi(2)).exp() / power
    });
    (nodes, covariance)
}

/// Returns ∫Λ(x)·sinc²(ax) dx, Λ(x) = 1 − |x| on [−1, 1]. This is the fraction of the variance that
/// remains after the mean over a pixel, for light with the field correlation sinc(ax) along the
/// pixel.
///
/// The value is interpolated from a table by cubics. Both Λ and the spectrum of sinc² are triangles
/// of fourth moment 1/15, so the error is below (2π/32)⁴/15²·(9/16)/24 = 1.6e-7. Above a = 16, the
/// value for 16 is scaled by 16/a.
fn pixel_variance_factor(a: f64) -> f64 {
    const MOST: f64 = 16.0;
    const STEPS: f64 = 32.0;
    static TABLE: LazyLock<Vec<f64>> = LazyLock::new(|| {
        let places = (-1..=(MOST * STEPS) as i32).map(|step| f64::from(step) / STEPS);
        places.map(exact_over_pixel).collect()
    });
    lagrange(&TABLE, a.min(MOST) * STEPS) * (MOST / a.max(MOST))
}

/// Computes [`pixel_variance_factor`] by quadrature.
fn exact_over_pixel(a: f64) -> f64 {
    let nodes = panels((2.0 * a.abs()).ceil().max(1.0) as usize).into_iter();
    nodes
        .map(|(x, w)| 2.0 * w * (1.0 - x) * sinc(a * x).powi(2))
        .sum()
}

/// Returns nodes and weights on [0, 1], eight in each of the `panels`.
fn panels(panels: usize) -> Vec<(f64, f64)> {
    static RULE: LazyLock<Vec<(f64, f64)>> = LazyLock::new(|| gauss_legendre(8));
    let share = 1.0 / panels as f64;
    (0..panels)
        .flat_map(|i| {
            RULE.iter()
                .map(move |(x, w)| (share * (i as f64 + x), share * w))
        })
        .collect()
}

/// Returns 2J₁(πr)/(πr), 1 at r = 0. Up to r = 64 it is interpolated from a table by cubics. The
/// function has no frequency above half a cycle, so the error is below (π/128)⁴·(9/16)/24 = 9e-9.
fn jinc(r: f64) -> f64 {
    const MOST: f64 = 64.0;
    const STEPS: f64 = 128.0;
    static TABLE: LazyLock<Vec<f64>> = LazyLock::new(|| {
        let places = (-1..=(MOST * STEPS) as i32 + 2).map(|step| f64::from(step) / STEPS);
        places.map(exact_jinc).collect()
    });
    if r.abs() < MOST {
        lagrange(&TABLE, r.abs() * STEPS)
    } else {
        exact_jinc(r)
    }
}

/// Interpolates a function at `steps` ≥ 0 steps from 0, by the cubic through the four nearest of
/// its `values` (Lagrange 1795). The first value belongs to −1 step.
pub(super) fn lagrange(values: &[f64], steps: f64) -> f64 {
    let first = (steps as usize).min(values.len() - 4);
    let t = steps - first as f64;
    let [a, b, c, d] = [0, 1, 2, 3].map(|i| values[first + i]);
    let (before, next, after) = (t + 1.0, t - 1.0, t - 2.0);
    (b * before * next * after - c * before * t * after) / 2.0
        + (d * before * t * next - a * t * next * after) / 6.0
}

/// Computes [`jinc`] without the table.
fn exact_jinc(r: f64) -> f64 {
    let x = PI * r;
    if x.abs() < 1e-6 {
        1.0
    } else {
        2.0 * libm::j1(x) / x
    }
}

#[cfg(test)]
#[path = "theory_defocus_tests.rs"]
mod defocus_tests;

#[cfg(test)]
mod tests {
    use super::*;

    /// The table agrees with the exact function between its steps, at its end and beyond. The
    /// tolerance is the stated error bound.
    #[test]
    fn a_table_gives_the_correlation_of_a_round_pupil() {
        for i in 0..70_000 {
            let r = 0.001 * (f64::from(i) + 0.37);
            let (found, exact) = (jinc(r), exact_jinc(r));
            assert!((found - exact).abs() < 9e-9, "{r}: {found} {exact}");
        }
    }

    /// Between the table's steps, the tolerance is the stated error bound. Beyond the table, the
    /// integral is (1 − (ln 2πa + 0.58)/(π²a))/a plus oscillations of order 1/a³.
    #[test]
    fn a_table_gives_the_mean_over_a_pixel() {
        for i in 0..1600 {
            let a = 0.01 * (f64::from(i) + 0.37);
            let (found, exact) = (pixel_variance_factor(a), exact_over_pixel(a));
            assert!((found - exact).abs() < 1.6e-7, "{a}: {found} {exact}");
        }
        assert!((pixel_variance_factor(20.0) / exact_over_pixel(20.0) - 1.0).abs() < 0.01);
    }

    /// Compares with an independent simulation, to its three digits.
    #[test]
    fn integrated_contrast_of_a_circular_pupil() {
        let known = [
            (0.25, 0.975),
            (0.5, 0.906),
            (1.0, 0.711),
            (2.0, 0.440),
            (4.0, 0.246),
            (8.0, 0.131),
        ];
        for (q, contrast) in known {
            let c = integrated_contrast(Aperture::Circle, q);
            assert!((c - contrast).abs() < 6e-4, "q = {q}: {c}");
        }
    }

    /// At zero lag, the covariance is the squared contrast. The sum over all lags is the covariance
    /// of a full line of pixels, q⁻²·∫Λ(x)∫μ²(qx, y) dy dx·q. For a square pupil, ∫sinc² is 1 and
    /// the sum is q⁻¹·∫Λ(x)·sinc²(qx) dx, computed with the same nodes. The contribution of lags
    /// beyond 200 pixels is less than 2/(π²·200·q²).
    #[test]
    fn the_covariance_of_pixels_adds_up() {
        for aperture in [Aperture::Circle, Aperture::Square] {
            for q in [0.3, 1.0, 3.0] {
                let contrast = integrated_contrast(aperture, q);
                let even = DMat2::from_diagonal(DVec2::splat(q));
                let none = pixel_covariance(aperture, even, DVec2::ZERO);
                assert!((none / contrast.powi(2) - 1.0).abs() < 1e-9, "{q}");
            }
        }
        for q in [0.5, 1.0] {
            let sum: f64 = (-200..=200)
                .map(|lag| DVec2::new(0.0, lag as f64))
                .map(|lag| {
                    pixel_covariance(Aperture::Square, DMat2::from_diagonal(DVec2::splat(q)), lag)
                })
                .sum();
            let across: f64 = gauss_legendre(4)
                .iter()
                .map(|&(x, w)| 2.0 * w * (1.0 - x) * sinc(q * x).powi(2))
                .sum();
            let beyond = 2.0 / (200.0 * (std::f64::consts::PI * q).powi(2));
            assert!((sum - across / q).abs() < beyond + 1e-6, "{q}: {sum}");
        }
    }

    /// Stretched, rotated and sheared grains are compared with the mean over pairs of 16 × 16
    /// points in both pixels. The midpoint rule has an error of (|G|/16)²/24 times the curvature of
    /// μ², π²/2, for each pixel.
    #[test]
    fn the_covariance_of_pixels_under_stretched_grains_is_that_of_pairs_of_points() {
        let turn = DMat2::from_angle(0.7);
        let grains = turn * DMat2::from_cols(DVec2::new(0.9, 0.2), DVec2::new(-0.1, 0.4));
        let point = |i: usize| (i as f64 + 0.5) / 16.0;
        let points = || (0..256).map(|i| DVec2::new(point(i % 16), point(i / 16)));
        for aperture in [Aperture::Circle, Aperture::Ellipse(0.6)] {
            for lag in [DVec2::ZERO, DVec2::new(0.0, 1.0), DVec2::new(2.0, -1.0)] {
                let pairs = points().flat_map(|a| points().map(move |b| b - a));
                let mu = pairs.map(|off| aperture.field_correlation(grains * (off + lag)));
                let mean = mu.map(|mu| mu * mu).sum::<f64>() / 65536.0;
                let found = pixel_covariance(aperture, grains, lag);
                assert!((found - mean).abs() < 2e-3, "{lag}: {found} {mean}");
            }
        }
    }

    /// Pixels much larger than grains average q²/∬μ² independent grains. For a square pupil, ∬sinc²
    /// = 1 in each direction. The next order is O(ln q/q).
    #[test]
    fn large_pixels_average_independent_grains() {
        let q = 100.0;
        let c = integrated_contrast(Aperture::Square, q);
        assert!((c * q - 1.0).abs() < 0.02, "{}", c * q);
    }

    /// Many samples converge to the integral. The returned number of samples is sufficient, and one
    /// fewer is not.
    #[test]
    fn samples_across_a_pixel_converge() {
        for q in [0.25, 1.0, 4.0] {
            let exact = integrated_contrast(Aperture::Circle, q);
            let error = |n| (sampled_contrast(Aperture::Circle, q, n) / exact - 1.0).abs();
            assert!(error(40) < 1e-3, "q = {q}");
            let n = samples_across_pixel(Aperture::Circle, q, 0.01);
            assert!(
                error(n) <= 0.01 && (n == 1 || error(n - 1) > 0.01),
                "q = {q}: {n}"
            );
        }
    }

    #[test]
    fn finer_grains_never_take_fewer_samples() {
        for aperture in [Aperture::Circle, Aperture::Square] {
            for error in [0.005, 0.03] {
                let samples = |i| samples_across_pixel(aperture, 0.05 * i as f64, error);
                let all: Vec<usize> = (1..100).map(samples).collect();
                assert!(all.is_sorted(), "{aperture:?} {error}: {all:?}");
            }
        }
    }

    #[test]
    fn overlap_law_has_its_known_values() {
        let known = [
            (0.0, 1.0),
            (0.05, 0.877),
            (0.1, 0.762),
            (0.2, 0.558),
            (0.5, 0.153),
            (0.7, 0.035),
            (1.0, 0.0),
            (3.0, 0.0),
        ];
        for (delta, gamma) in known {
            let law = Aperture::Circle.overlap(DVec2::new(0.0, delta)).powi(2);
            assert!((law - gamma).abs() < 6e-4, "{delta}: {law}");
        }
    }

    #[test]
    fn centroid_noise_is_the_law() {
        let law = centroid_noise(2.0, 8.0, 0.5) / (16f64.sqrt() * 0.5);
        assert!((law - 0.3905).abs() < 1e-4, "{law}");
    }

    /// Compares the error of n × n samples, relative to the mean of 24 × 24 uniform samples, with
    /// the direct sum over all pairs of samples.
    #[test]
    fn samples_miss_what_pairs_of_samples_say() {
        let even: Vec<(f64, f64)> = (0..24)
            .map(|i| ((i as f64 + 0.5) / 24.0, 1.0 / 24.0))
            .collect();
        let square = |rule: &[(f64, f64)]| -> Vec<(DVec2, f64)> {
            let rows = rule.iter().flat_map(|y| rule.iter().map(move |x| (x, y)));
            rows.map(|(x, y)| (DVec2::new(x.0, y.0), x.1 * y.1))
                .collect()
        };
        for (q, n) in [(1.0, 1), (1.0, 3), (2.5, 2)] {
            let (few, many) = (square(&gauss_legendre(n)), square(&even));
            let covariance = |a: &[(DVec2, f64)], b: &[(DVec2, f64)]| -> f64 {
                let pairs = a
                    .iter()
                    .flat_map(|p| b.iter().map(move |r| (p.0 - r.0, p.1 * r.1)));
                let mu = |lag: DVec2| Aperture::Circle.field_correlation(q * lag);
                pairs.map(|(lag, weight)| weight * mu(lag).powi(2)).sum()
            };
            let pairs =
                covariance(&few, &few) + covariance(&many, &many) - 2.0 * covariance(&few, &many);
            let found = sampling_deviation(Aperture::Circle, q, n);
            // A midpoint rule of 24 × 24 nodes has an error of (q/24)²/24·π²/2 for a variance of 1.
            assert!(
                (found.powi(2) - pairs).abs() < 3e-3,
                "{q} {n}: {found} {pairs}"
            );
        }
    }
}
