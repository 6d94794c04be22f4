//! The laser's field of flux against closed forms.

use lasertrace::laser::{Beam, Fan, FanProfile, Laser};
use lasertrace::math::DVec3;
use std::f64::consts::PI;

fn beam() -> Beam {
    Beam {
        wavelength: 660e-6,
        power_mw: 5.0,
        waist_radius: 0.02,
        waist_distance: 150.0,
        m_squared: 1.0,
    }
}

/// Power through the plane through (0, 0, `distance`) whose normal is tilted by
/// `tilt` about x and `roll` about z, by the rectangle rule with `n`² cells over
/// ±`extent` in the plane. On a smooth function that vanishes at the border the
/// rule converges faster than any power of n (Trefethen & Weideman 2014).
fn power_through(laser: &Laser, distance: f64, tilt: f64, extent: [f64; 2], n: usize) -> f64 {
    let normal = DVec3::new(0.0, tilt.sin(), -tilt.cos());
    let (u, v) = (DVec3::X, DVec3::new(0.0, tilt.cos(), tilt.sin()));
    let at = |i: usize, half: f64| half * ((2 * i + 1) as f64 / n as f64 - 1.0);
    let cell = 4.0 * extent[0] * extent[1] / (n * n) as f64;
    let mut sum = 0.0;
    for i in 0..n {
        for j in 0..n {
            let p = DVec3::Z * distance + u * at(i, extent[0]) + v * at(j, extent[1]);
            if let Some(light) = laser.at(p) {
                sum -= light.flux.dot(normal) * cell;
            }
        }
    }
    sum
}

/// The cutoff at 4 radii drops e⁻³² of a round beam and less of a sheet; 400
/// nodes across 4.5 radii leave a quadrature error below that, so rounding of
/// 160 000 terms (1e-13) rules: 1e-12 is demanded. On a tilted plane the beam's
/// border is cut where w differs, which costs no more.
#[test]
fn power_through_planes_equals_the_power_of_a_round_beam() {
    let laser = Laser {
        beam: beam(),
        fan: None,
    };
    // From 60 mm on, even the plane tilted by 80° meets the beam before the
    // aperture nowhere.
    for distance in [60.0, 150.0, 151.0, 400.0] {
        for tilt in [0.0f64, 0.3, 1.0, 80f64.to_radians()] {
            let w = laser.beam.radius(distance);
            // The tilted cut reaches where the beam is wider or narrower.
            let reach = (1..40).fold(w, |w, _| {
                laser
                    .beam
                    .radius(distance + 4.2 * w * tilt.tan())
                    .max(laser.beam.radius(distance - 4.2 * w * tilt.tan()))
            });
            let extent = [4.2 * reach, 4.2 * reach / tilt.cos()];
            let power = power_through(&laser, distance, tilt, extent, 600);
            let error = power / laser.beam.power_mw - 1.0;
            assert!(error.abs() < 1e-12, "{distance} {tilt}: {error:e}");
        }
    }
}

/// A Gaussian fan vanishes smoothly at its ends (as far as ±π/2 lets it) and is
/// integrated like the round beam; the plane must hold x = ρ·tan φ out to where
/// exp(-2φ²/φ_w²) is e⁻³², φ = 4φ_w = 40° here.
#[test]
fn power_through_planes_equals_the_power_of_a_sheet() {
    let fan = Fan {
        angle: 20f64.to_radians(),
        profile: FanProfile::Gaussian,
    };
    let laser = Laser {
        beam: beam(),
        fan: Some(fan),
    };
    for (distance, tilt) in [(100.0, 0.0f64), (150.0, 0.4), (300.0, -1.0)] {
        let half_x = distance * 40f64.to_radians().tan();
        let w = laser
            .beam
            .radius(distance)
            .max(laser.beam.radius(distance / 40f64.to_radians().cos()));
        let extent = [half_x, 6.0 * w / tilt.cos()];
        let power = power_through(&laser, distance, tilt, extent, 1200);
        let error = power / laser.beam.power_mw - 1.0;
        assert!(error.abs() < 1e-9, "{distance} {tilt}: {error:e}");
    }
}

/// Whatever the fan, p(φ) integrates to 1. The uniform one jumps at its ends:
/// the midpoint rule is off by at most one cell in 20 000.
#[test]
fn fan_profiles_hold_all_the_power() {
    for profile in [FanProfile::Uniform, FanProfile::Gaussian] {
        for degrees in [0.1f64, 30.0, 90.0, 179.0] {
            let fan = Fan {
                angle: degrees.to_radians(),
                profile,
            };
            let n = 200_000;
            let reach = (PI / 2.0).min(4.0 * fan.angle);
            let step = 2.0 * reach / n as f64;
            let sum: f64 = (0..n)
                .map(|i| fan.power_per_radian(-reach + (i as f64 + 0.5) * step) * step)
                .sum();
            assert!(
                (sum - 1.0).abs() < step / fan.angle + 1e-9,
                "{fan:?}: {sum}"
            );
        }
    }
}

#[test]
fn radius_follows_the_closed_form() {
    let beam = Beam {
        m_squared: 1.3,
        ..beam()
    };
    let (w0, lambda) = (0.02, 660e-6);
    for z in [0.0, 100.0, 150.0, 170.0, 1000.0] {
        // The seed's form, with M² multiplying λ.
        let x: f64 = (z - 150.0) * lambda * 1.3 / (w0 * w0 * PI);
        let expected = w0 * (1.0 + x * x).sqrt();
        assert!((beam.radius(z) / expected - 1.0).abs() < 1e-14);
    }
    assert!((beam.radius(150.0 + beam.rayleigh_range()) / w0 - 2f64.sqrt()).abs() < 1e-14);
}

#[test]
fn irradiance_on_axis_is_the_closed_form() {
    let beam = beam();
    let point = Laser { beam, fan: None };
    let line = Laser {
        beam,
        fan: Some(Fan {
            angle: 0.5,
            profile: FanProfile::Uniform,
        }),
    };
    for z in [1.0, 150.0, 320.0] {
        let w = beam.radius(z);
        let p = DVec3::new(0.0, 0.0, z);
        let on_axis = point.at(p).unwrap().flux;
        assert!((on_axis.z / (2.0 * 5.0 / (PI * w * w)) - 1.0).abs() < 1e-14);
        assert_eq!((on_axis.x, on_axis.y), (0.0, 0.0));
        let on_sheet = line.at(p).unwrap().flux;
        let expected = 5.0 / 0.5 / z * (2.0 / PI).sqrt() / w;
        assert!((on_sheet.z / expected - 1.0).abs() < 1e-14);
    }
    assert!(point.at(DVec3::new(0.0, 0.0, -1.0)).is_none());
    assert!(
        line.at(DVec3::new(60.0, 0.0, 100.0)).is_none(),
        "past the fan"
    );
}

/// The aperture point keeps relative radius and azimuth.
#[test]
fn aperture_points_keep_their_relative_radius() {
    let laser = Laser {
        beam: beam(),
        fan: None,
    };
    let p = DVec3::new(0.02, -0.01, 180.0);
    let s = laser.at(p).unwrap().aperture_point;
    let scale = laser.beam.radius(0.0) / laser.beam.radius(180.0);
    assert!((s - DVec3::new(0.02, -0.01, 0.0) * scale).length() < 1e-15);
}
