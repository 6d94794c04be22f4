//! Tests for the choice of samples.

use super::*;
use crate::camera::fixture;
use crate::laser::{Beam, Fan, FanProfile, Laser};
use crate::math::Rigid;
use crate::math::rng::{Purpose, RngKey};
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
    // A single sample of a pixel that is a quarter of a grain has a contrast that is 2.6 % too
    // high.
    assert_eq!(samples_per_side(3.0, 4.0, Some(&optics)), 2);
    assert_eq!(samples_per_side(1e-9, 1.0, None), MAX_SAMPLES_PER_SIDE);
    assert_eq!(
        samples_per_side(3.0, 1e-9, Some(&optics)),
        MAX_SAMPLES_PER_SIDE
    );
}

/// The loss of the peak agrees with a sum over frequencies of the pupil's transfer function in
/// focus, and with the variance of the blur. The tolerance is the next order, the square of the
/// loss by diffraction.
#[test]
fn a_line_loses_of_its_peak_what_the_pupil_takes() {
    for (aperture, transfer) in [
        (
            Aperture::Circle,
            (|f: f64| 2.0 / PI * (f.acos() - f * (1.0 - f * f).sqrt())) as fn(f64) -> f64,
        ),
        (Aperture::Square, |f: f64| 1.0 - f),
    ] {
        for sigma in [3.0, 6.0, 12.0] {
            let step = 1e-4;
            let sums = (0..10_000).map(|i| (i as f64 + 0.5) * step).map(|f| {
                let line = (-2.0 * (PI * sigma * f).powi(2)).exp();
                (line, line * transfer(f))
            });
            let (all, kept) = sums.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
            let expected = 1.0 - kept / all;
            let found = peak_loss(aperture, sigma, 1.0, 0.0);
            let next = found * found;
            assert!(
                (found - expected).abs() < next,
                "{aperture:?} {sigma}: {found} {expected}"
            );
        }
    }
    // The blur of a square pupil has the variance of a round blur of √(16/12) times the diameter.
    let round = peak_loss(Aperture::Circle, 1.0, 0.0, 0.5 * (16f64 / 12.0).sqrt());
    assert!((peak_loss(Aperture::Square, 1.0, 0.0, 0.5) - round).abs() < 1e-12);
    let flat = peak_loss(Aperture::Ellipse(0.5), 1.0, 0.0, 0.5);
    assert!((flat - peak_loss(Aperture::Circle, 1.0, 0.0, 0.25)).abs() < 1e-12);
}

/// The image of a line does not depend on the order of positions. The sensor is tilted by 30°, so
/// the grain size varies between positions. The line width on a plane agrees with the projected
/// edges of the beam.
#[test]
fn a_line_s_image_is_that_of_its_places() {
    let laser = Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 1.0,
            waist_radius: 0.1,
            waist_distance: 200.0,
            m_squared: 1.0,
        },
        fan: Some(Fan {
            angle: 0.3,
            profile: FanProfile::Uniform,
        }),
    };
    let mut camera = fixture();
    camera.tilt.x = 30f64.to_radians();
    let eye = DVec3::new(0.0, -115.0, 0.0);
    let laser_from_camera = Rigid::from_z_and_x(eye, DVec3::Z * 200.0 - eye, DVec3::X).unwrap();
    let optics = SensorOptics {
        laser: &laser,
        camera: &camera,
        camera_from_laser: &laser_from_camera.inverse(),
        glossy: false,
    };
    let mut seen = VisibleLine {
        places: optics.overlap(),
        ..VisibleLine::default()
    };
    let forth = LineImageBounds::for_positions(&optics, &seen);
    seen.places.reverse();
    let back = LineImageBounds::for_positions(&optics, &seen);
    let all = |image: &LineImageBounds| {
        let LineImageBounds {
            coherent_share,
            lowered_share,
            ..
        } = *image;
        [coherent_share, lowered_share]
    };
    for (a, b) in all(&forth).into_iter().zip(all(&back)) {
        assert!((a - b).abs() <= 1e-12 * a.abs(), "{a} {b}");
    }
    let key = RngKey::new(3, Purpose::SensorNoise);
    for i in 0..50 {
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.with(i).uniform(k);
        let place = DVec3::new(between(0, -5.0, 5.0), 0.0, between(1, 195.0, 205.0));
        let normal = DVec3::new(between(2, -3.0, 3.0), between(3, -3.0, 3.0), -1.0).normalize();
        let project = |p: DVec3| camera.project(optics.camera_from_laser.point(p)).unwrap();
        // Tangent of the line on the plane, and offset from the line to the 1/e² edge of the beam.
        let along = normal.cross(DVec3::Y);
        let radius = 1e-3;
        let off = DVec3::new(0.0, radius, radius * -normal.y / normal.z);
        let line = (project(place + along * 1e-3) - project(place - along * 1e-3)).normalize();
        let expected = line.perp_dot(project(place + off) - project(place)).abs();
        let found = width_on_plane(&optics, place, normal, radius).unwrap();
        // The projection of a point at an offset of 1 µm, and up to 3 µm deeper, is linear to
        // 2·10⁻⁵.
        assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
    }
}
