use super::*;
use crate::math::Aperture;
use crate::speckle::motion::overlap_correlation_defocused;
use rustfft::num_complex::Complex64;
use std::f64::consts::TAU;

fn spec() -> PatternSpec {
    field_spec(11, Aperture::Circle)
}

/// Grains along a side of a field, and number of fields in a statistic.
const GRAINS: usize = 144;
const PATTERNS: f64 = 40.0;

fn place(x: f64, y: f64, defocus: f64) -> PupilPosition {
    PupilPosition {
        shift: DVec2::new(x, y),
        defocus,
    }
}

/// Reference: the sum over phasors, evaluated directly at texels in f64. Single precision and a
/// thousand roundings give an error of 1e-5 of the mean.
#[test]
fn a_field_is_the_sum_over_its_phasors() {
    let ellipse = Aperture::Ellipse(0.6);
    for aperture in [Aperture::Circle, ellipse, Aperture::Square] {
        let spec = PatternSpec {
            size: 128,
            aperture,
            ..spec()
        };
        let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
        let at = place(-7.31, 2.18, 1.7);
        let field = fields.field(&at);
        let shift = FIELD_AXIS.rotate(at.shift);
        let centre = shift * spec.pupil_width();
        let near = centre.round();
        for texel in [
            DVec2::ZERO,
            DVec2::new(31.0, 77.0),
            DVec2::new(127.0, 127.0),
        ] {
            let (mut sum, mut power) = (Complex64::ZERO, 0.0);
            for (dx, dy) in (-40..=40).flat_map(|y| (-40..=40).map(move |x| (x, y))) {
                let (x, y) = (near.x as i64 + dx, near.y as i64 + dy);
                if !fields.plane.open(centre, x, y) {
                    continue;
                }
                let weight = fields.plane.sharpening(dx) * fields.plane.sharpening(dy);
                let p = (DVec2::new(x as f64, y as f64) - centre) / spec.pupil_width();
                let chirp = 4.0 * at.defocus * (p.length_squared() + p.dot(shift));
                let wave = TAU * (dx as f64 * texel.x + dy as f64 * texel.y) / 128.0;
                let phasor = fields.plane.phasor(x, y);
                sum += Complex64::new(phasor.re as f64, phasor.im as f64)
                    * Complex64::from_polar(weight, chirp + wave);
                power += weight * weight;
            }
            let expected = sum.norm_sqr() / power;
            let read = field.intensity(texel) as f64;
            assert!((read - expected).abs() < 1e-4, "{texel}: {read} {expected}");
        }
    }
}

/// Four readings at a time equal single readings, also across wraps. A position within a texel has
/// an error of up to 1.5 steps of 2⁻¹⁶ along each axis. Slopes are up to 30 per texel, which gives
/// 1e-3.
#[test]
fn four_readings_are_those_of_each() {
    let coherence = Coherence {
        polarisation_degree: 0.5,
        incoherent_modes: 2,
    };
    let fields = FrameFields::new(&spec(), coherence).unwrap();
    let field = fields.field(&place(0.7, -0.1, 2.0));
    let (s, t) = ([0.0, 0.3, -2.1, 3.7], [0.0, -1.4, 0.2, 2.9]);
    for at in grid(40).map(|at| 20.0 * at - 9000.3) {
        let four = field.around(at, s.into(), t.into(), 4).to_array();
        let three = field.around(at, s.into(), t.into(), 3).to_array();
        assert_eq!(three, [four[0], four[1], four[2], 0.0]);
        for i in 0..4 {
            let one = field.intensity(at + DVec2::new(s[i] as f64, t[i] as f64));
            assert!((four[i] - one).abs() < 1e-3, "{at} {i}: {} {one}", four[i]);
        }
    }
}

/// A row of the sensor comes within a tenth of the period of itself only after five periods. A
/// column behaves equally, because the lattice is square.
#[test]
fn rows_meet_themselves_late() {
    let aside = |periods: i32| {
        let across = periods as f64 * FIELD_AXIS.y / FIELD_AXIS.x;
        (across - across.round()).abs()
    };
    assert!((FIELD_AXIS.length() - 1.0).abs() < 1e-15);
    assert!((1..5).all(|periods| aside(periods) > 0.1));
    assert!((aside(5) - 0.09).abs() < 0.001, "{}", aside(5));
}

/// Returns the field correlation of two frames at zero displacement. It is read at sixteen
/// positions within each texel of the period, where it has no sampling error (Parseval).
fn gamma(fields: &FrameFields, places: [PupilPosition; 2]) -> f64 {
    let [a, b] = places.map(|at| fields.field(&at));
    let [from, to] = places.map(|at| carrier(FIELD_AXIS.rotate(at.shift) * spec().pupil_width()));
    let turns = [0, 1].map(|axis| (to[axis] - from[axis]) as f64 * TAU / spec().size as f64);
    let mut sum = Complex64::ZERO;
    let side = 4 * spec().size;
    for i in 0..side * side {
        let at = DVec2::new((i % side) as f64 + 0.5, (i / side) as f64 + 0.5) / 4.0;
        let phase = turns[0] * at.x + turns[1] * at.y;
        let [a, b] = [&a, &b].map(|field| {
            let (amplitude, gain) = field.amplitude(at);
            let amplitude = amplitude.as_dvec2() * (gain as f64).sqrt();
            Complex64::new(amplitude.x, amplitude.y)
        });
        sum += a.conj() * b * Complex64::from_polar(1.0, phase);
    }
    (sum / (side * side) as f64).norm_sqr()
}

/// The overlap law holds within 0.01 anywhere on the path, at any distance and in any direction.
/// This includes displacements along the viewing ray with phases of hundreds of radians at the rim.
/// Discs of 144 texels follow the law to 0.008.
#[test]
fn frames_correlate_by_the_overlap_law_and_their_defocus() {
    let fields = FrameFields::new(&spec(), Coherence::FULL).unwrap();
    for (delta, phase) in [
        (0.003, 0.0),
        (0.05, 0.0),
        (0.1, 0.5),
        (0.077, 1.98),
        (0.2, 1.0),
        (0.3, 4.0),
        (0.7, 0.3),
        (1.1, 0.0),
    ] {
        let step = DVec2::from_angle(0.7) * delta;
        for start in [0.0, 40.0] {
            let at = |n: f64| PupilPosition {
                shift: step * n,
                defocus: phase * n,
            };
            let found = gamma(&fields, [at(start), at(start + 1.0)]);
            let law = overlap_correlation_defocused(delta, phase);
            assert!(
                (found - law).abs() < 0.01,
                "{delta} {phase} {start}: {found} {law}"
            );
        }
    }
    // Displacement along the viewing ray only.
    let found = gamma(&fields, [place(0.0, 0.0, 1.0), place(0.0, 0.0, 3.0)]);
    let law = overlap_correlation_defocused(0.0, 2.0);
    assert!((found - law).abs() < 0.01, "{found} {law}");
}

/// Returns `side` × `side` positions at a spacing of one grain, texels.
fn grid(side: usize) -> impl Iterator<Item = DVec2> {
    (0..side * side).map(move |i| DVec2::new((i % side) as f64, (i / side) as f64) * 2.65)
}

/// Returns mean and standard deviation.
fn moments(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    (mean, square.sqrt())
}

/// The contrast between texels equals the theory of the light. 40 patterns of 16 000 grains
/// determine it to 0.0013; 3.8 standard errors are the 0.5 % that interpolation may lose. Light of
/// n parts has n times fewer effective grains: its error is 0.0013·√n of a contrast 1/√n.
#[test]
fn interpolation_loses_no_contrast() {
    let along = DVec2::from_angle(2.0);
    for (polarisation_degree, incoherent_modes) in [(1.0, 1), (0.0, 1), (0.5, 2)] {
        let coherence = Coherence {
            polarisation_degree,
            incoherent_modes,
        };
        let mut square = 0.0;
        for seed in 0..PATTERNS as u64 {
            let spec = PatternSpec { seed, ..spec() };
            let fields = FrameFields::new(&spec, coherence).unwrap();
            let field = fields.field(&PupilPosition {
                shift: along * 0.37 * seed as f64,
                defocus: 0.0,
            });
            let values: Vec<f64> = grid(GRAINS).map(|p| field.intensity(p) as f64).collect();
            let (mean, deviation) = moments(&values);
            square += (deviation / mean).powi(2) / PATTERNS;
        }
        let (found, theory) = (square.sqrt(), coherence.contrast());
        assert!(
            (found - theory).abs() < 0.005,
            "{coherence:?}: {found} {theory}"
        );
    }
}

/// The autocovariance at positions between texels equals |μ|² of theory, in all directions of the
/// sensor. 40 patterns of 16 000 grains determine it to 0.002 (1σ) where it is largest. The
/// tolerance is 0.01.
#[test]
fn grains_have_the_size_and_shape_of_the_pupils() {
    let ellipse = Aperture::Ellipse(0.5);
    for aperture in [Aperture::Circle, ellipse, Aperture::Square] {
        let lags = [0.25, 0.5, 0.75, 1.0, 1.5].map(|r| {
            let turn = |angle: f64| DVec2::from_angle(angle) * r;
            [0.0, 0.8, 1.6, 2.7].map(turn)
        });
        let lags = lags.as_flattened();
        let mut sums = vec![0.0; lags.len()];
        for seed in 0..PATTERNS as u64 {
            let spec = field_spec(seed, aperture);
            let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
            let field = fields.field(&place(0.0, 0.3 * seed as f64, 0.0));
            let map = fields.map(1.0, 1.0);
            let read = |at: DVec2| field.intensity(map.displacement(at)) as f64 - 1.0;
            for (sum, lag) in sums.iter_mut().zip(lags) {
                // Positions at a spacing of one grain over the period, which are at varying
                // positions within texels.
                let places = grid(GRAINS).map(|p| p / spec.texels_per_speckle);
                let products = places.map(|p| read(p) * read(p + *lag));
                *sum += products.sum::<f64>() / (PATTERNS * (GRAINS * GRAINS) as f64);
            }
        }
        for (found, lag) in sums.iter().zip(lags) {
            let theory = aperture.field_correlation(*lag).powi(2);
            assert!(
                (found - theory).abs() < 0.01,
                "{aperture:?} {lag}: {found} {theory}"
            );
        }
    }
}
