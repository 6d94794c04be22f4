use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::speckle::motion::Source;
use crate::wave::correlation::correlate_pairs;
use crate::wave::patch::{RoughPatch, lit, patch_filling_view};

const WAVELENGTH: f64 = 660e-6;
const DISTANCE: f64 = 300.0;
const DIAMETER: f64 = 10.0;
/// Grain size λL/D.
const GRAIN: f64 = WAVELENGTH * DISTANCE / DIAMETER;

fn pupil() -> WavePupil {
    WavePupil {
        centre: DVec3::Z * DISTANCE,
        right: DVec3::X,
        up: DVec3::Y,
        diameter: DIAMETER,
        aperture: Aperture::Circle,
    }
}

fn grid(pixels: usize, pixels_per_grain: f64) -> ImageGrid {
    ImageGrid {
        pixels,
        pixel_mm: GRAIN / pixels_per_grain,
        focus_distance: DISTANCE,
    }
}

fn image(scatterers: &[Scatterer], grid: &ImageGrid) -> WaveImage {
    intensity_at_focus(
        &pupil_field(scatterers, &pupil(), WAVELENGTH, grid).unwrap(),
        grid,
    )
}

fn unit(position: DVec3, light_path: f64) -> Scatterer {
    Scatterer {
        position,
        amplitude: 1.0,
        light_path,
    }
}

/// Returns J₁ from Bessel's integral (1/π)·∫₀^π cos(τ − x·sin τ) dτ. The trapezoid rule converges
/// exponentially for it.
fn bessel_j1(x: f64) -> f64 {
    let n = 64;
    (0..n)
        .map(|i| {
            let t = PI * (i as f64 + 0.5) / n as f64;
            (t - x * t.sin()).cos()
        })
        .sum::<f64>()
        / n as f64
}

/// Returns |2J₁(πr/h)/(πr/h)|²: the Airy pattern, and the autocovariance of speckle.
fn airy(r_over_h: f64) -> f64 {
    let x = PI * r_over_h;
    if x < 1e-9 {
        1.0
    } else {
        (2.0 * bessel_j1(x) / x).powi(2)
    }
}

#[test]
fn the_phase_factor_is_that_of_the_standard_library() {
    for k in 0..4001 {
        let part = f64::from(k) / 4000.0 - 0.5;
        for whole in [0.0, 3.0, 850_000.0] {
            let turns: f64 = whole + part;
            let (sin, cos) = (TAU * (turns - turns.round())).sin_cos();
            let error = cis_turns(turns) - Complex64::new(cos, sin);
            assert!(error.norm() < 1e-14, "{turns}: {error}");
        }
    }
}

/// 81 pupil samples across and pixels of h/16. The mean of the pattern over a pixel differs from
/// its central value by p²/24·∇²I ≤ π²/(2·24·256) = 0.0008. The diameter of the staircase, and
/// therefore r, is uncertain by a tenth of a sample, 0.1 %.
#[test]
fn one_scatterer_makes_an_airy_pattern() {
    let image = image(&[unit(DVec3::ZERO, 0.0)], &grid(1296, 16.0));
    for (i, j) in [(0, 0), (4, 0), (0, 8), (9, 9), (16, 3), (26, 0), (-33, 7)] {
        let r = (i as f64).hypot(j as f64) / 16.0;
        let found = image.at(i, j);
        assert!((found - airy(r)).abs() < 0.002, "{r}: {found} {}", airy(r));
    }
    // The first zero, from a parabola through the three lowest pixels.
    let k = (12..26).min_by(|&a, &b| image.at(a, 0).total_cmp(&image.at(b, 0)));
    let k = k.unwrap();
    let [a, b, c] = [k - 1, k, k + 1].map(|i| image.at(i, 0));
    let zero = (k as f64 + 0.5 * (a - c) / (a - 2.0 * b + c)) / 16.0;
    assert!((zero - 1.2197).abs() < 0.01, "{zero}");
    assert!(b < 1e-3, "{b}");
}

#[test]
fn a_scatterer_is_shown_where_it_is_and_blurs_out_of_focus() {
    let g = grid(256, 4.0);
    let place = DVec2::new(12.0, -7.0) * g.pixel_mm;
    let image = image(&[unit(DVec3::new(place.x, place.y, 0.0), 3.0)], &g);
    assert!(image.at(12, -7) > 0.9 && image.at(-12, 7) < 0.01);

    let field = pupil_field(&[unit(DVec3::ZERO, 0.0)], &pupil(), WAVELENGTH, &g).unwrap();
    let near = refocused(&g, 280.0);
    let blurred = intensity_at_focus(&field, &near);
    // A defocused point is a uniformly lit disc of diameter D·20/300, sharp to about √(λ·Δz) = 0.11
    // mm. Its power is unchanged.
    let radius = DIAMETER * 20.0 / 300.0 / 2.0;
    let power = |image: &WaveImage, within: f64| {
        let half = g.pixels as isize / 2;
        let mut sum = 0.0;
        for j in -half..half {
            for i in -half..half {
                if (i as f64).hypot(j as f64) * image.grid.pixel_mm <= within {
                    sum += image.at(i, j);
                }
            }
        }
        sum * image.grid.pixel_mm.powi(2)
    };
    let total = power(&blurred, 1e9);
    let sharp = power(&intensity_at_focus(&field, &g), 1e9);
    assert!((total / sharp - (280.0f64 / 300.0).powi(2)).abs() < 1e-9);
    assert!(power(&blurred, radius + 0.1) > 0.95 * total);
    let half_area = power(&blurred, radius / 2f64.sqrt()) / total;
    assert!((half_area - 0.5).abs() < 0.05, "{half_area}");
}

/// Young's fringes at the pupil, 4·cos²(π·s·p/(λL)). The next term of the path is
/// k·s·p³/(2L³) = 0.002 rad at the rim.
#[test]
fn two_scatterers_make_fringes_at_the_pupil_and_add_as_amplitudes() {
    let separation = 0.1;
    let at = |x: f64, path: f64| unit(DVec3::X * x, path);
    let g = grid(256, 4.0);
    let pair = [at(-separation / 2.0, 0.0), at(separation / 2.0, 0.0)];
    let field = pupil_field(&pair, &pupil(), WAVELENGTH, &g).unwrap();
    let side = 2 * field.reach + 1;
    for i in 2..side - 2 {
        let p = (i as f64 - field.reach as f64) * field.pitch;
        let found = field.values[field.reach * side + i].norm_sqr();
        let fringe = 4.0
            * (PI * separation * p / (WAVELENGTH * DISTANCE))
                .cos()
                .powi(2);
        assert!((found - fringe).abs() < 0.01, "{p}: {found} {fringe}");
    }
    // At a spacing of half a grain, the centre is bright for scatterers in phase and dark for half
    // a wave of phase difference.
    let close = |path| image(&[at(-GRAIN / 4.0, 0.0), at(GRAIN / 4.0, path)], &g).at(0, 0);
    assert!((close(0.0) / (4.0 * airy(0.25)) - 1.0).abs() < 0.06);
    assert!(close(WAVELENGTH / 2.0) < 0.03 * close(0.0));
}

fn rough_patch(grains: f64, scatterers_per_grain: f64) -> RoughPatch {
    patch_filling_view(
        DVec3::ZERO,
        DVec3::Z,
        [DVec3::X, DVec3::Y],
        DVec2::splat(grains * GRAIN),
        DVec2::splat(GRAIN / scatterers_per_grain.sqrt()),
        2.0 * WAVELENGTH,
    )
}

fn rough_scatterers(patch: &RoughPatch, seed: u64) -> Vec<Scatterer> {
    let key = RngKey::new(seed, Purpose::WaveScatterers);
    let source = Source::Point(DVec3::new(125.0, 0.0, 216.5));
    lit(&patch.points(key), &source, DVec3::ZERO, |_| 1.0)
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let scatterers = rough_scatterers(&rough_patch(8.0, 4.0), 5);
    let run = |threads| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(|| image(&scatterers, &grid(64, 4.0)))
    };
    let one = run(1);
    assert!(one == run(3) && one.intensity.iter().sum::<f64>() > 0.0);
}

/// The image converges as the sampling density of the pupil is doubled and quadrupled.
#[test]
fn the_image_converges_in_pupil_samples() {
    let scatterers = rough_scatterers(&rough_patch(10.0, 4.0), 1);
    let images = [16.0, 32.0, 64.0, 128.0]
        .map(|grains| image(&scatterers, &grid((grains * 4.0) as usize, 4.0)));
    let region = |f: &dyn Fn(isize, isize) -> f64| {
        let mut sum = 0.0;
        for j in -12..12 {
            for i in -12..12 {
                sum += f(i, j);
            }
        }
        sum / 576.0
    };
    let finest = &images[3];
    let mean = region(&|i, j| finest.at(i, j));
    let error =
        |k: usize| region(&|i, j| (images[k].at(i, j) - finest.at(i, j)).powi(2)).sqrt() / mean;
    let errors = [error(0), error(1), error(2)];
    println!("rms error at 17, 33, 65 pupil samples across: {errors:?}");
    assert!(errors.windows(2).all(|e| e[1] < 0.5 * e[0]), "{errors:?}");
    assert!(errors[2] < 0.02, "{errors:?}");
}

/// Returns the mean over images and its standard error.
fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    (mean, (square / (n * (n - 1.0))).sqrt())
}

/// Returns ⟨I²⟩/⟨I⟩² − 1 of each image, with the mean over all images.
fn squared_contrasts(images: &[WaveImage]) -> Vec<f64> {
    let pixels = images[0].intensity.len() as f64;
    let sum =
        |image: &WaveImage, power| -> f64 { image.intensity.iter().map(|i| i.powi(power)).sum() };
    let mean = images.iter().map(|i| sum(i, 1)).sum::<f64>() / pixels / images.len() as f64;
    images
        .iter()
        .map(|image| sum(image, 2) / pixels / (mean * mean) - 1.0)
        .collect()
}

/// N equal scatterers at independent uniform positions, n per squared grain, have C² = 1 + κ/n −
/// 2/N. Here κ = ∫PSF²/(∫PSF)² in squared grains. This is the fourth moment of a sum of random
/// phasors whose lengths are also random.
#[test]
fn contrast_converges_in_scatterers_as_shot_noise_says() {
    let step = 5e-3;
    let ring = |f: &dyn Fn(f64) -> f64| {
        let node = |i| f64::from(i) * step;
        (1..4000).map(|i| node(i) * f(node(i))).sum::<f64>() * TAU * step
    };
    let kappa = ring(&|r| airy(r).powi(2)) / ring(&airy).powi(2);
    let g = grid(96, 8.0);
    let window = 96.0 * g.pixel_mm;
    for count in [72, 288] {
        let images: Vec<WaveImage> = (0..256)
            .map(|seed| {
                let key = RngKey::new(seed, Purpose::WaveScatterers);
                let scatterer = |j| {
                    let u = |c| key.with(j).uniform(c) - 0.5;
                    unit(DVec3::new(u(0), u(1), 0.0) * window, u(2) * WAVELENGTH)
                };
                image(&(0..count).map(scatterer).collect::<Vec<_>>(), &g)
            })
            .collect();
        let (c2, error) = mean_and_error(&squared_contrasts(&images));
        let count = count as f64;
        let excess = kappa * 144.0 / count - 2.0 / count;
        println!("{count}: C² = {c2} ± {error}, expected {}", 1.0 + excess);
        assert!((c2 - 1.0 - excess).abs() < 3.0 * error, "{c2} ± {error}");
        assert!(3.0 * error < excess, "the test decides nothing");
    }
}

/// 96 images of about 310 independent grains: contrast, exponential law and grain size. The
/// tolerances are three standard errors over the images plus the effect of pixels of h/8. These
/// pixels keep 0.9875 of C² (C = 0.975 at h/4, with a loss proportional to p²), and affect the
/// other figures less.
#[test]
fn speckle_is_fully_developed_and_its_grains_have_the_size_of_the_law() {
    let g = grid(160, 8.0);
    let images: Vec<WaveImage> = (0..96)
        .map(|seed| image(&rough_scatterers(&rough_patch(20.0, 8.0), seed), &g))
        .collect();
    let (c2, error) = mean_and_error(&squared_contrasts(&images));
    println!("contrast {} ± {}", c2.sqrt(), error / 2.0);
    assert!(
        (c2 - 0.9875).abs() < 3.0 * error && error < 0.03,
        "{c2} ± {error}"
    );

    let pixels = images[0].intensity.len() as f64;
    let over = |f: &dyn Fn(&WaveImage) -> f64| {
        mean_and_error(
            &images
                .iter()
                .map(|image| f(image) / pixels)
                .collect::<Vec<_>>(),
        )
    };
    let mean = over(&|image| image.intensity.iter().sum()).0;
    for t in [0.5f64, 1.0, 2.0, 4.0] {
        let brighter = |i: &&f64| **i > t * mean;
        let (found, error) = over(&|image| image.intensity.iter().filter(brighter).count() as f64);
        println!("P(I > {t}⟨I⟩) = {found} ± {error}, law {}", (-t).exp());
        assert!((found - (-t).exp()).abs() < 3.0 * error + 0.0125 * (-t).exp());
    }
    for lag in [2isize, 4, 6, 10] {
        let product = |image: &WaveImage| {
            let mut sum = 0.0;
            for j in 0..160 {
                for i in 0..160 {
                    let neighbours = image.at(i + lag, j) + image.at(i, j + lag) - 2.0 * mean;
                    sum += (image.at(i, j) - mean) * neighbours / 2.0;
                }
            }
            sum / (mean * mean)
        };
        let (found, error) = over(&product);
        let law = airy(lag as f64 / 8.0);
        println!("autocovariance at {lag}/8 h: {found} ± {error}, law {law}");
        assert!(
            (found - law).abs() < 3.0 * error + 0.0125,
            "{lag}: {found}, {law}"
        );
    }
}

/// 3D pattern from one pupil field. Two focus distances separated by Δ correlate by
/// (sin(φ/2)/(φ/2))², φ = k·D²·Δ/(8L²). At a separation of one longitudinal grain, 8λ(L/D)², the
/// correlation is zero. The tolerances are 1.5 times the 95 % interval, plus 0.01 for the staircase
/// of 20 pupil samples across.
#[test]
fn a_focus_stack_of_one_field_is_the_3d_pattern() {
    let g = grid(160, 8.0);
    let fields: Vec<PupilField> = (100..148)
        .map(|seed| {
            let scatterers = rough_scatterers(&rough_patch(20.0, 8.0), seed);
            pupil_field(&scatterers, &pupil(), WAVELENGTH, &g).unwrap()
        })
        .collect();
    let long_grain = 8.0 * WAVELENGTH * (DISTANCE / DIAMETER).powi(2);
    for share in [0.25, 0.5, 1.0] {
        let pairs: Vec<[WaveImage; 2]> = fields
            .iter()
            .map(|field| {
                [-0.5, 0.5].map(|side| {
                    let at = refocused(&g, DISTANCE + side * share * long_grain);
                    intensity_at_focus(field, &at)
                })
            })
            .collect();
        let found = correlate_pairs(&pairs, DVec2::ZERO, 144, 1).gamma;
        let law = ((PI * share).sin() / (PI * share)).powi(2);
        println!("{share} of a longitudinal grain: {found:?}, law {law}");
        let half = 0.75 * (found.high - found.low) + 0.01;
        assert!(
            (found.value - law).abs() < half && half < 0.1,
            "{found:?} {law}"
        );
    }
}
