//! How the plan chooses samples.

use super::*;

/// The bound against brute force over all phases of the line in its pixel.
#[test]
fn the_sampling_error_is_what_sampling_does() {
    for (sigma, n) in [(0.5, 1), (0.7, 1), (0.3, 2), (0.35, 3)] {
        let step = 1.0 / n as f64;
        let worst = (0..100)
            .map(|i| {
                let phase = step * i as f64 / 100.0;
                let (mut sum, mut moment) = (0.0, 0.0);
                for k in -200..200 {
                    let y: f64 = (k as f64 + 0.5) * step + phase;
                    let g = (-y * y / (2.0 * sigma * sigma)).exp();
                    sum += g;
                    moment += g * y;
                }
                (moment / sum).abs()
            })
            .fold(0.0, f64::max);
        // Second aliases and the sum's own error are what is left.
        let bound = sampling_error(sigma, n);
        assert!(
            (worst / bound - 1.0).abs() < 0.05,
            "{sigma} {n}: {worst} {bound}"
        );
    }
}

#[test]
fn narrow_lines_and_fine_grain_need_more_samples() {
    let optics = SpeckleOptics {
        aperture: Aperture::Circle,
        contrast: 1.0,
        method: Method::Field,
        step: SpeckleStep {
            across_sheet: 0.0,
            gamma: 1.0,
            slip_grains: None,
        },
    };
    let prefiltered = SpeckleOptics {
        method: Method::Prefiltered { q: 1.0 },
        ..optics
    };
    assert_eq!(samples_per_side(3.0, 1.0, None), 1);
    assert_eq!(samples_per_side(0.4, 1.0, None), 2);
    let fine = samples_per_side(3.0, 0.25, Some(&optics));
    assert!(fine > samples_per_side(3.0, 1.0, Some(&optics)) && fine < MAX_SAMPLES_PER_SIDE);
    assert_eq!(samples_per_side(3.0, 0.25, Some(&prefiltered)), 1);
    assert_eq!(samples_per_side(1e-9, 1.0, None), MAX_SAMPLES_PER_SIDE);
    assert_eq!(
        samples_per_side(3.0, 1e-9, Some(&optics)),
        MAX_SAMPLES_PER_SIDE
    );
}
