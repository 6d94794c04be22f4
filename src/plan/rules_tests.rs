//! How the plan chooses samples.

use super::*;
use crate::math::Aperture;
use crate::speckle::lookup::Method;

#[test]
fn narrow_lines_and_fine_grain_need_more_samples() {
    let optics = SpeckleOptics {
        aperture: Aperture::Circle,
        contrast: 1.0,
        method: Method::Field,
        steps: Vec::new(),
    };
    assert_eq!(samples_per_side(3.0, 1.0, None), 1);
    assert_eq!(samples_per_side(0.5, 1.0, None), 3);
    assert_eq!(samples_per_side(0.4, 1.0, None), 4);
    let fine = samples_per_side(3.0, 0.25, Some(&optics));
    assert!(fine > samples_per_side(3.0, 1.0, Some(&optics)) && fine < MAX_SAMPLES_PER_SIDE);
    // One sample of a quarter of a grain has 2.6 % too much contrast.
    assert_eq!(samples_per_side(3.0, 4.0, Some(&optics)), 2);
    assert_eq!(samples_per_side(1e-9, 1.0, None), MAX_SAMPLES_PER_SIDE);
    assert_eq!(
        samples_per_side(3.0, 1e-9, Some(&optics)),
        MAX_SAMPLES_PER_SIDE
    );
}
