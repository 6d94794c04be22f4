//! Numbers as large and small as a scene takes them, through to the points; and laser,
//! lens and speckle where their formulas end.

use crate::cameras;
use crate::program::{PLANE, folder_with, numbers, scene};
use lasertrace::camera::Camera;
use lasertrace::laser::{Beam, Fan, FanProfile, Laser};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;

fn load(text: &str) -> Option<Scene> {
    Scene::load(&folder_with(text).path().join("scene.toml")).ok()
}

/// Frame 0 of a scene: everything in it is finite, and no light is negative.
fn assert_finite(scene: &Scene, what: &str) {
    let simulation = match Simulation::new(scene) {
        Ok(simulation) => simulation,
        // A pattern that cannot be made is refused, not made of nothing.
        Err(error) => return assert_eq!(error.exit_code(), 65, "{what}: {error}"),
    };
    let irradiance = simulation.irradiance(0);
    let valid = |e: &f32| e.is_finite() && *e >= 0.0;
    assert!(irradiance.dense().iter().all(valid), "{what}");
    let (peaks, points) = simulation.measure(0, &simulation.counts(0, &irradiance));
    for p in &peaks {
        let numbers = [p.row, p.intensity, p.height, p.sigma, p.noise];
        assert!(numbers.iter().all(|x| x.is_finite()), "{what}: {p:?}");
    }
    for p in &points {
        let numbers = [p.deviation, p.u_position, p.u_deviation, p.intensity];
        let valid = p.position.is_finite() && numbers.iter().all(|x| x.is_finite());
        assert!(valid, "{what}: {p:?}");
    }
}

/// Each number of a scene is replaced by each of these values, with or without speckle in turn.
/// There is no NaN and no infinity at any stage.
#[test]
fn extreme_numbers_stay_numbers_to_the_points() {
    let taken = extreme_numbers(|case, speckle| case % 8 == 4 * usize::from(speckle));
    assert!(taken > 37, "{taken}");
}

/// The test above with and without speckle for each number and value.
#[test]
#[ignore = "a minute; run by tests/verify.sh"]
fn all_extreme_numbers_stay_numbers_to_the_points() {
    let taken = extreme_numbers(|_, _| true);
    assert!(taken > 300, "{taken}");
}

/// Tests the cases that `is_chosen` selects by their number and by speckle. Returns the number of
/// accepted scenes.
fn extreme_numbers(is_chosen: impl Fn(usize, bool) -> bool) -> usize {
    const VALUES: [&str; 9] = [
        "1e300", "1e-300", "5e-324", "0", "-1", "1e12", "1e-12", "1e6", "0.001",
    ];
    let mut taken = 0;
    for speckle in [false, true] {
        let text = scene(PLANE).replace("speckle = false", &format!("speckle = {speckle}"));
        for (number, (key, at)) in numbers(&text).into_iter().enumerate() {
            let values = VALUES.into_iter().enumerate();
            for (_, value) in values.filter(|(i, _)| is_chosen(number + i, speckle)) {
                let mut text = text.clone();
                text.replace_range(at.clone(), value);
                if let Some(scene) = load(&text) {
                    assert_finite(&scene, &format!("{key} = {value}, speckle {speckle}"));
                    taken += 1;
                }
            }
        }
    }
    taken
}

const BEAM: Beam = Beam {
    wavelength: 660e-6,
    power_mw: 5.0,
    waist_radius: 0.02,
    waist_distance: 150.0,
    m_squared: 1.0,
};

/// With the waist at, before and behind the surface, and before the aperture itself, a
/// round beam's irradiance on the axis is 2P/(π·w²) to rounding, for the surface at the
/// aperture too; a sheet's grows as 1/ρ towards it and stays finite.
#[test]
fn beams_are_finite_up_to_the_aperture() {
    for waist_distance in [-1e6, -50.0, 0.0, 149.0, 150.0, 151.0, 1e6] {
        let beam = Beam {
            waist_distance,
            ..BEAM
        };
        for z in [5e-324, 1e-200, 1e-9, 1e-3, 1.0, 150.0, 1e6, 1e12] {
            let round = Laser { beam, fan: None };
            let w = beam.radius(z);
            let irradiance = round.at(DVec3::Z * z).expect("light").flux.length();
            let expected = 2.0 * 5.0 / (std::f64::consts::PI * w * w);
            assert!(
                (irradiance / expected - 1.0).abs() < 1e-12,
                "{waist_distance} {z}"
            );
            for (degrees, profile) in [1e-6f64, 1.0, 90.0, 179.0, 179.999]
                .into_iter()
                .flat_map(|d| [(d, FanProfile::Uniform), (d, FanProfile::Gaussian)])
            {
                let angle = degrees.to_radians();
                let fan = Some(Fan { angle, profile });
                for x in [0.0, z * (angle / 2.0).tan() * 0.999] {
                    let fan = fan.clone();
                    let light = Laser { beam, fan }.at(DVec3::new(x, 0.0, z));
                    let Some(light) = light else { continue };
                    assert!(light.flux.is_finite(), "{waist_distance} {z} {degrees}");
                    assert!(light.aperture_point.is_finite());
                }
            }
        }
    }
}

/// At 2λM²/π the beam spreads by 0.5 rad, and below it is refused.
#[test]
fn a_waist_past_the_paraxial_limit_is_refused() {
    let limit = 2.0 * 0.66 * 1.1 / std::f64::consts::PI;
    let with = |waist: f64| {
        let waist = format!("waist_radius_um = {waist}");
        let text = scene(PLANE).replace("waist_radius_um = 300", &waist);
        load(&text).is_some()
    };
    assert!(with(limit * (1.0 + 1e-9)) && !with(limit * (1.0 - 1e-9)));
    for (fan, taken) in [
        ("0", false),
        ("1e-9", true),
        ("179.999", true),
        ("180", false),
    ] {
        let text = scene(PLANE).replace("fan_deg = 12", &format!("fan_deg = {fan}"));
        assert_eq!(load(&text).is_some(), taken, "{fan}");
    }
}

/// Points at, behind and hardly before the lens, in its focal plane, and in directions
/// that a tilted sensor's plane does not meet: no image, or a finite one.
#[test]
fn no_point_has_an_image_that_is_no_number() {
    for tilt in [[0.0, 0.0], [80.0, 0.0], [-80.0, 80.0], [0.0, 45.0]] {
        let mut camera = cameras::camera();
        camera.tilt = DVec2::from(tilt.map(f64::to_radians));
        for z in [
            -1e12, -1.0, -5e-324, 0.0, 5e-324, 1e-200, 1e-9, 25.0, 240.0, 1e12,
        ] {
            for (x, y) in [(0.0, 0.0), (1.0, -1.0), (1e12, 0.0), (z, z), (-z, 1e-300)] {
                let p = DVec3::new(x, y, z);
                if let Some(pixel) = camera.project(p) {
                    assert!(z > 0.0, "{p}");
                    // So far off the sensor that f64 has no number for it is none.
                    assert!(!pixel.is_nan(), "{tilt:?} {p}: {pixel}");
                }
                let finite = |x: Option<f64>| x.is_none_or(|x| !x.is_nan());
                assert!(finite(camera.defocus_blur(p)), "{tilt:?} {p}");
                assert!(finite(camera.defocus(p)), "{tilt:?} {p}");
            }
        }
        // A plane through the lens cannot be brought into focus.
        let point = DVec3::new(0.0, 0.0, 240.0);
        let f = camera.lens.focal_length;
        let found = Camera::focused_on_plane(f, (point, DVec3::X));
        assert!(found.is_none_or(|(_, tilt)| tilt.is_finite()), "{found:?}");
        assert_eq!(Camera::focused_on_plane(f, (point, DVec3::ZERO)), None);
    }
}

/// Speckle far smaller and larger than a pixel, at f/1 and f/128, at grazing view and
/// after a long motion: intensities are what no other light could be, none negative,
/// and on average the light without speckle to within its own scatter.
#[test]
fn speckle_keeps_the_light_from_f_1_to_f_128_and_after_a_kilometre() {
    let light = |text: &str, frame: u32| -> f64 {
        let scene = load(text).expect("a scene");
        let irradiance = Simulation::new(&scene).unwrap().irradiance(frame);
        assert!(
            irradiance
                .dense()
                .iter()
                .all(|e| e.is_finite() && *e >= 0.0)
        );
        irradiance.dense().iter().map(|&e| e as f64).sum()
    };
    for (what, from, to) in [
        ("f/1", "f_number = 8", "f_number = 1"),
        ("f/128", "f_number = 8", "f_number = 128"),
        (
            "pixels of 3 µm",
            "pixel_pitch_um = 30",
            "pixel_pitch_um = 3",
        ),
        (
            "70°",
            "rotation_deg = [0, 0, 0]",
            "rotation_deg = [0, 70, 0]",
        ),
        ("a kilometre", "step_mm = 0.5", "step_mm = 0.5"),
    ] {
        let plain = scene(PLANE).replace(from, to);
        let far = what == "a kilometre";
        let (plain, frame) = match far {
            // The part is moved along, so that the last frame sees it.
            true => (
                plain
                    .replace("frames = 3", "frames = 2000001")
                    .replace("position_mm = [0, 0, 0]", "position_mm = [0, 1000000, 0]"),
                2_000_000,
            ),
            false => (plain, 1),
        };
        let grains = plain.replace("speckle = false", "speckle = true");
        let (mean, found) = (light(&plain, frame), light(&grains, frame));
        println!("{what}: {:.3} of the light without speckle", found / mean);
        assert!(
            mean > 0.0 && (0.5..2.0).contains(&(found / mean)),
            "{what}: {found} {mean}"
        );
    }
}
