//! Tests for the selection of frames, and for the overlap of light and field of view.

use super::*;
use crate::camera::fixture;
use crate::laser::{Beam, Fan, FanProfile};

#[test]
fn strata_hold_one_place_each() {
    let key = RngKey::new(5, Purpose::PlanRays);
    assert!(strata(8, 0, key).next().is_none());
    assert!(strata(8, 8, key).eq(0..8));
    for (most, count) in [(8, 9), (7, 100), (1024, 1_000_003)] {
        let places: Vec<usize> = strata(most, count, key).collect();
        assert_eq!(places.len(), most);
        for (i, &place) in places.iter().enumerate() {
            let part = |i: usize| i as f64 / most as f64 * count as f64;
            assert!((part(i).floor()..part(i + 1)).contains(&(place as f64)));
        }
    }
}

/// A camera views a fan of 20° at an angle of 30°. All returned positions are illuminated and
/// visible. The half-spaces contain all of them.
#[test]
fn light_and_view_meet_where_both_are() {
    let beam = Beam {
        wavelength: 660e-6,
        power_mw: 1.0,
        waist_radius: 0.1,
        waist_distance: 200.0,
        m_squared: 1.0,
    };
    let fan = Fan {
        angle: 20f64.to_radians(),
        profile: FanProfile::Uniform,
    };
    let camera = fixture();
    let eye = DVec3::new(0.0, -115.0, 0.0);
    let laser_from_camera = Rigid::from_z_and_x(eye, DVec3::Z * 200.0 - eye, DVec3::X).unwrap();
    for fan in [Some(fan), None] {
        let laser = Laser { beam, fan };
        let optics = SensorOptics {
            laser: &laser,
            camera: &camera,
            camera_from_laser: &laser_from_camera.inverse(),
            glossy: false,
        };
        let region = region(&optics, 1e-9);
        let places = optics.overlap();
        assert!(places.len() >= NODES, "{}", places.len());
        for p in places {
            let pixel = camera.project(optics.camera_from_laser.point(p)).unwrap();
            let size = camera.sensor.resolution.as_dvec2();
            assert!(pixel.cmpge(-DVec2::splat(1e-6)).all());
            assert!(pixel.cmple(size + 1e-6).all());
            assert!(laser.at(p).is_some_and(|light| light.flux.length() > 0.0));
            assert!(region.iter().all(|half| half.height(p) >= 0.0));
        }
    }
}
