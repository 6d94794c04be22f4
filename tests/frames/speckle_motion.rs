//! How patterns of rendered frames move and change from frame to frame, at several
//! windows of the sensor, against waves with exact paths.

use crate::rendered::{Geometry, HALF, Image, PIXELS, Step, WAVELENGTH, images, images_of, moved};
use lasertrace::camera::Distortion;
use lasertrace::frame::Blur;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::math::{DVec2, DVec3};
use lasertrace::run::Simulation;
use lasertrace::speckle::motion::{defocus_phase, overlap_correlation, speckle_shift};
use lasertrace::wave::motion::{WaveSampling, measure_motions};

/// Standard errors allowed. Of the 135 numbers compared here one lies further off in one of
/// 300 draws of all of them: 2.4e-5 each, by Student's distribution (1908) of the 15
/// degrees of freedom that 16 blocks leave. Seeds are fixed.
const ERRORS: f64 = 6.0;
/// Correlation by which a mean over pixels of a quarter of a grain is too high.
const PIXEL_GAMMA: f64 = 0.01;
/// Pixels by which a paraboloid through places a quarter of a grain apart errs.
const VERTEX: f64 = 0.02;

/// Of a coherent lens, pixels: an eighth of a grain, by which patterns of correlation 1 lose 5 %.
const LENS: f64 = 0.5;

/// Rendered frames against waves, at the middle and two ends of the sensor.
fn assert_as_waves(name: &str, geometry: &Geometry, seed: u64, blur: Blur) {
    let scene = geometry.scene(true);
    let [width, height] = geometry.resolution;
    let images = images(geometry, [0, geometry.frames_apart], blur);
    let margin = HALF + 50;
    let centres = [
        [width / 2, height / 2],
        [margin, height - margin],
        [width - margin, margin],
    ];
    let cases = centres.map(|[x, y]| geometry.case(&scene, DVec2::new(x as f64, y as f64)));
    let sampling = WaveSampling {
        wavelength_mm: WAVELENGTH,
        region_grains: 24.0,
        realisations: 12,
        seed,
    };
    let rows = measure_motions(&cases, &sampling).unwrap();
    for ((centre, case), row) in centres.into_iter().zip(&cases).zip(&rows) {
        let shift = speckle_shift(&case.view, &case.motion);
        let expected = DVec2::new(shift.sensor.x, -shift.sensor.y) / geometry.pitch();
        let found = moved(&images, centre, expected);
        let waves = row.waves.displacement.expect("frames that correlate");
        let pitch = geometry.pitch();
        let waves_at = DVec2::new(waves[0].value, -waves[1].value) / pitch;
        // Intervals of 95 % are 1.96 standard errors to each side.
        let spread = waves.map(|e| (e.high - e.low) / (2.0 * 1.96 * pitch));
        let waves_gamma = row.waves.gamma;
        let gamma_spread = (waves_gamma.high - waves_gamma.low) / (2.0 * 1.96);
        let place = format!("{name} {centre:?}");
        for (found, error, waves, spread) in [
            (found.pixels.x, found.pixels_error.x, waves_at.x, spread[0]),
            (found.pixels.y, found.pixels_error.y, waves_at.y, spread[1]),
        ] {
            let lens = if blur == Blur::Coherent { LENS } else { VERTEX };
            let bound = ERRORS * error.hypot(spread) + lens;
            println!("{place}: moved {found:.2} ± {error:.2}, waves {waves:.2} ± {spread:.2}");
            assert!(
                (found - waves).abs() < bound,
                "{place}: {found} for {waves}"
            );
        }
        let (gamma, error, waves) = (found.gamma, found.gamma_error, waves_gamma.value);
        println!("{place}: γ {gamma:.3} ± {error:.3}, waves {waves:.3} ± {gamma_spread:.3}");
        let bound = ERRORS * error.hypot(gamma_spread) + PIXEL_GAMMA;
        assert!(
            (gamma - waves).abs() < bound,
            "{place}: {gamma} for {waves}"
        );
    }
}

/// A geometry drawn from a seed: part tilted, laser and camera oblique, focus before or
/// behind the surface.
fn drawn(seed: u64, axial: bool) -> Geometry {
    let key = RngKey::new(seed, Purpose::SpecklePattern);
    let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
    let direction = |k: u64, least: f64, most: f64, azimuth: f64| {
        let (sin, cos) = between(k, least, most).to_radians().sin_cos();
        DVec2::from_angle(azimuth).extend(cos / sin) * sin
    };
    let azimuth = between(0, 0.0, std::f64::consts::TAU);
    let apart = between(1, 1.5, 4.8);
    let distance = between(2, 180.0, 320.0);
    let camera = direction(3, 12.0, 40.0, azimuth + apart) * distance;
    let mut geometry = Geometry {
        part_deg: [4, 5, 6].map(|k| between(k, -12.0, 12.0)),
        laser: direction(7, 10.0, 40.0, azimuth) * between(8, 180.0, 320.0),
        camera,
        columns: DVec2::from_angle(between(9, 0.0, 6.0)).extend(0.0),
        focal_length: between(10, 35.0, 50.0),
        f_number: between(11, 5.0, 7.0),
        focus: distance * between(12, 0.94, 1.06),
        step: Step::Way(DVec3::ZERO),
        frames_apart: 1,
        resolution: [500, 400],
    };
    let aside = DVec3::new(
        between(13, -1.0, 1.0),
        between(14, -1.0, 1.0),
        between(15, -1.0, 1.0),
    );
    // Nearly along the ray, to a rim's phase of 1; or turned to a shift by 0.12 pupils.
    geometry.step = match axial {
        true => Step::Way(camera / distance + aside * 0.1),
        false => Step::Turn {
            point: DVec3::new(between(16, -8.0, 8.0), between(17, -8.0, 8.0), 0.0),
            axis: aside,
            degrees: 0.1,
        },
    };
    let case = geometry.case(&geometry.scene(true), geometry.resolution_middle());
    let delta = speckle_shift(&case.view, &case.motion).delta;
    let phase = defocus_phase(&case.view, &case.motion, WAVELENGTH).abs();
    geometry.step = geometry.step.times(match axial {
        true => (1.0 / phase).min(0.15 / delta),
        false => 0.12 / delta,
    });
    geometry
}

const AXIAL: Geometry = Geometry {
    part_deg: [0.0, 15.0, 0.0],
    laser: DVec3::new(85.505, 0.0, 234.923),
    camera: DVec3::new(58.852, 161.696, 245.746),
    columns: DVec3::new(-0.925, -0.175, 0.337),
    focal_length: 50.0,
    f_number: 5.0,
    focus: 300.0,
    step: Step::Way(DVec3::new(0.0796, 0.2188, 0.3326)),
    frames_apart: 1,
    resolution: [500, 400],
};

#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn motion_along_the_ray_is_that_of_waves() {
    assert_as_waves("axial", &AXIAL, 1, Blur::None);
    for seed in [1, 2, 3] {
        assert_as_waves(
            &format!("axial {seed}"),
            &drawn(seed, true),
            seed,
            Blur::None,
        );
    }
}

/// Asserts that random geometries out of focus, through a coherent lens, agree with waves.
fn assert_lens_as_waves(draws: &[(bool, u64)]) {
    for &(axial, seed) in draws {
        let name = format!("lens, {axial} {seed}");
        assert_as_waves(&name, &drawn(seed, axial), seed, Blur::Coherent);
    }
}

/// Out of focus speckle through a coherent lens moves by itself as that of waves does.
#[test]
fn speckle_behind_a_lens_moves_as_waves_do() {
    assert_lens_as_waves(&[(true, 2), (false, 4)]);
}

#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn speckle_behind_more_lenses_moves_as_waves_do() {
    assert_as_waves("lens, axial", &AXIAL, 1, Blur::Coherent);
    assert_lens_as_waves(&[(true, 3), (false, 7)]);
}

/// Slip of hundredths of a grain a frame adds up: the plan has it if frames further apart,
/// which are correlated, need it. Twice as far as in the other tests.
#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn slow_motion_is_that_of_waves_between_frames_far_apart() {
    for (name, geometry, seed) in [
        ("axial", AXIAL, 1),
        ("axial 1", drawn(1, true), 1),
        ("turn 4", drawn(4, false), 4),
        ("turn 6", drawn(6, false), 6),
    ] {
        let slow = Geometry {
            frames_apart: 50,
            step: geometry.step.times(2.0),
            ..geometry
        };
        let plan = Simulation::new(&slow.scene(true)).unwrap().plan;
        assert!(plan.local_speckle_motion, "{name}: {:?}", plan.effects);
        assert_as_waves(&format!("slow {name}"), &slow, seed, Blur::None);
    }
}

/// In focus grains keep to the surface: from frame to frame they move as the image of the
/// surface point does, 13° off the axis as in the middle, where a pattern moved as a whole would
/// run ahead by 7 %. The plan chooses. Of the mean over two ends of three geometries four
/// standard errors are allowed, one draw in 16 000, and what the paraboloid errs.
#[test]
fn grains_off_the_axis_keep_to_the_surface() {
    let (mut ahead, mut variance, mut ends) = (0.0, 0.0, 0.0);
    for seed in [1, 2, 3] {
        let key = RngKey::new(seed, Purpose::SpecklePattern);
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
        let distance = between(0, 200.0, 300.0);
        // A quarter of the pupil, whose speckle goes 1 + L_o/L_s = 2 times as far as the part.
        let (pupil, shift) = (1.4, 0.25);
        let direction = DVec2::from_angle(between(1, -0.7, 0.7)) * between(2, -1.0, 1.0).signum();
        let geometry = Geometry {
            part_deg: [0.0; 3],
            laser: DVec3::new(0.0, between(3, 0.2, 0.6), 1.0).normalize() * distance,
            camera: DVec3::Z * distance,
            columns: DVec3::X,
            focal_length: 35.0,
            f_number: 35.0 / pupil,
            focus: distance,
            step: Step::Way((direction * (shift * pupil / 2.0)).extend(0.0)),
            frames_apart: 2,
            resolution: [4000, 180],
        };
        let scene = geometry.scene(true);
        let images = images(&geometry, [0, 2], Blur::None);
        let [width, height] = geometry.resolution;
        for x in [HALF + 25, width - HALF - 25] {
            let centre = [x, height / 2];
            let pixel = DVec2::new(x as f64, height as f64 / 2.0);
            let point = geometry.seen(&scene, pixel) + geometry.motion(DVec3::ZERO).part;
            let there = scene.head_from_camera.inverse().point(point);
            let expected = scene.camera.project(there).unwrap() - pixel;
            let found = moved(&images, centre, expected);
            println!(
                "{seed} {x}: moved {} ± {}, surface {expected}",
                found.pixels, found.pixels_error
            );
            let along = expected / expected.length_squared();
            ahead += (found.pixels - expected).dot(along);
            variance += (found.pixels_error * along).length_squared();
            ends += 1.0;
        }
    }
    let (ahead, error) = (ahead / ends, variance.sqrt() / ends);
    println!("ahead by {ahead:.4} ± {error:.4}");
    let way = 5.0;
    assert!(
        ahead.abs() < 4.0 * error + VERTEX / way,
        "{ahead} ± {error}"
    );
}

/// A lens that distorts scales what it images by the local scale of its distortion, and the way of the grains
/// with it: near the corners of the sensor grains go as far as the closed form for a lens without distortion
/// says of the same surface point, times that scale, 0.75 to 1.3 here; in and out of focus, on ways and turns. All windows
/// together give the share of what distortion changes that is found: 1, to four standard errors, and to a twentieth, as the scale
/// itself changes by a tenth from a window's middle to its sides.
#[test]
fn distortion_scales_the_way_of_the_grains() {
    let (mut found_by, mut expected_by, mut variance) = (0.0, 0.0, 0.0);
    for (seed, axial) in [(1, true), (4, false), (5, false), (6, false)] {
        let geometry = drawn(seed, axial);
        let [width, height] = geometry.resolution;
        let distance = geometry.magnification() * geometry.focus;
        let corner = DVec2::new(width as f64, height as f64) / 2.0 * geometry.pitch() / distance;
        let strength = 1.0 + RngKey::new(seed, Purpose::SpecklePattern).uniform(40);
        let k1 = [-0.07, 0.12][seed as usize % 2] * strength / corner.length_squared();
        let scene = |speckle| {
            let mut scene = geometry.scene(speckle);
            let reach = scene.camera.model().reach().unwrap();
            let lens = Distortion::new([k1, 0.0, 0.0], [0.0; 2], reach).unwrap();
            scene.camera.lens.distortion = Some(lens);
            scene
        };
        let images = images_of(scene, [0, geometry.frames_apart], Blur::None);
        let scene = scene(true);
        let margin = HALF + 20;
        for centre in [[margin, height - margin], [width - margin, margin]] {
            let pixel = DVec2::new(centre[0] as f64, centre[1] as f64);
            let case = geometry.case(&scene, pixel);
            let shift = speckle_shift(&case.view, &case.motion);
            let straight = DVec2::new(shift.sensor.x, -shift.sensor.y) / geometry.pitch();
            let seen = scene.camera.direction(pixel);
            let lens = scene.camera.lens.distortion.unwrap();
            let expected = lens.jacobian(seen.truncate() / seen.z) * straight;
            let found = moved(&images, centre, expected);
            println!(
                "{seed} {centre:?}: moved {:.2} ± {:.2}, expected {expected:.2}, without distortion {straight:.2}",
                found.pixels, found.pixels_error
            );
            let change = expected - straight;
            found_by += (found.pixels - straight).dot(change);
            expected_by += change.length_squared();
            variance += (found.pixels_error * change).length_squared();
        }
    }
    let (share, error) = (found_by / expected_by, variance.sqrt() / expected_by);
    println!("share of the change found: {share:.3} ± {error:.3}");
    assert!((share - 1.0).abs() < 4.0 * error + 0.05 && 4.0 * error < 0.5);
}

#[test]
fn a_turning_surface_is_that_of_waves() {
    let about_z = Geometry {
        step: Step::Turn {
            point: DVec3::new(8.0, 3.0, 0.0),
            axis: DVec3::Z,
            degrees: 0.1,
        },
        ..AXIAL
    };
    assert_as_waves("about z", &about_z, 2, Blur::None);
    let out_of_focus = Geometry {
        part_deg: [10.0, -12.0, 30.0],
        laser: DVec3::new(-115.702, 0.0, 137.888),
        camera: DVec3::new(-28.909, 79.426, 181.262),
        columns: DVec3::new(-0.493, 0.765, -0.414),
        focal_length: 35.0,
        f_number: 5.8333,
        focus: 190.0,
        step: Step::Turn {
            point: DVec3::new(0.0, 0.02, 0.0),
            axis: DVec3::new(1.0, -0.4, 0.3),
            degrees: 0.12,
        },
        frames_apart: 1,
        resolution: [500, 400],
    };
    assert_as_waves("out of focus", &out_of_focus, 3, Blur::None);
}

#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn more_turning_surfaces_are_those_of_waves() {
    assert_turns_as_waves(&[4, 5, 6, 7]);
}

/// Asserts that random geometries on a turn agree with waves.
fn assert_turns_as_waves(seeds: &[u64]) {
    for &seed in seeds {
        let name = format!("turn {seed}");
        assert_as_waves(&name, &drawn(seed, false), seed, Blur::None);
    }
}

/// A table under an oblique sensor, over a whole turn: neighbouring frames correlate as the
/// law says, displaced by their way; light and contrast stay what they are; frames far
/// apart have nothing in common; and threads do not matter. The 12 500 grains of an image
/// (a grain is sixteen pixels) fix means and contrasts to 1/√12 500 = 0.009 and a
/// correlation of nothing to as much; six of these are allowed, one draw in 10⁷ for each
/// of 40 numbers. Pixels of a quarter of a grain have a contrast of 0.975.
#[test]
fn a_table_may_turn_all_round() {
    let table = Geometry {
        part_deg: [0.0; 3],
        focus: 290.0,
        step: Step::Turn {
            point: DVec3::new(4.0, -6.0, 0.0),
            axis: DVec3::Z,
            degrees: 0.05,
        },
        ..AXIAL
    };
    let scene = table.scene(true);
    let middle = table.resolution.map(|n| n / 2);
    let case = table.case(&scene, table.resolution_middle());
    let shift = speckle_shift(&case.view, &case.motion);
    let law = overlap_correlation(shift.delta);
    let expected = DVec2::new(shift.sensor.x, -shift.sensor.y) / table.pitch();
    let grains = table.resolution.iter().product::<i64>() as f64 / (PIXELS * PIXELS);
    let mut first: Vec<Image> = Vec::new();
    // Frames a quarter of a turn apart, and one turn on.
    for frame in [0, 1800, 3600, 5400, 7200] {
        let pair = images(&table, [frame, frame + 1], Blur::None);
        for image in &pair {
            let (mean, contrast) = image.moments();
            assert!((mean - 1.0).abs() < 6.0 / grains.sqrt(), "{frame}: {mean}");
            assert!(
                (contrast - 0.975).abs() < 6.0 / grains.sqrt(),
                "{frame}: {contrast}"
            );
        }
        let found = moved(&pair, middle, expected);
        let bound = found.pixels_error * ERRORS + VERTEX;
        assert!(
            (found.pixels - expected).abs().cmplt(bound).all(),
            "{frame}: {} ± {} for {expected}",
            found.pixels,
            found.pixels_error
        );
        let bound = ERRORS * found.gamma_error + PIXEL_GAMMA;
        assert!(
            (found.gamma - law).abs() < bound,
            "{frame}: {} for {law}",
            found.gamma
        );
        let [image, _] = pair;
        for other in &first {
            let n = image.values.len() as f64;
            let product = |(a, b): (&f64, &f64)| (a - 1.0) * (b - 1.0);
            let both = image.values.iter().zip(&other.values);
            let correlation = both.map(product).sum::<f64>() / n;
            assert!(
                correlation.abs() < 6.0 / grains.sqrt(),
                "{frame}: {correlation}"
            );
        }
        first.push(image);
    }
    let render = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let simulation = Simulation::new(&scene).unwrap();
        pool.unwrap()
            .install(|| simulation.irradiance(1801).dense())
    };
    assert!(
        render(1) == render(3),
        "other light by another number of threads"
    );
}
