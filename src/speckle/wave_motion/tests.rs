use super::*;
use crate::math::DVec3;
use crate::speckle::wave_cases::{REFERENCE_WAVELENGTH_MM, reference_cases};

/// Rows of the reference table whose names start with one of `names`, from 8
/// surfaces each.
fn rows(names: &[&str]) -> Vec<MotionRow> {
    let cases: Vec<MotionCase> = reference_cases()
        .into_iter()
        .filter(|case| names.iter().any(|name| case.name.starts_with(name)))
        .collect();
    assert!(cases.len() >= names.len());
    let sampling = WaveSampling {
        wavelength_mm: REFERENCE_WAVELENGTH_MM,
        region_grains: 28.0,
        realisations: 8,
        seed: 4,
    };
    measure_motions(&cases, &sampling).unwrap()
}

/// The prediction lies within 1.5 times the 95 % interval (three standard errors,
/// one false alarm in 370 numbers; the seed is fixed). γ gets 0.01 more, the sum of
/// the simulation's own known errors: scatterers 0.004, pixels 0.003, and the
/// staircase of a pupil 40 samples across.
fn assert_predicted(row: &MotionRow) {
    let near = |e: &super::super::wave_correlation::Estimate, value: f64, slack: f64| {
        let half = 1.5 * (e.high - e.low) / 2.0 + slack;
        (e.value - value).abs() <= half && half < 10.0 * slack.max(1e-3)
    };
    assert!(near(&row.waves.gamma, row.gamma_defocused, 0.01), "{row:?}");
    for axis in 0..2 {
        let found = &row.waves.displacement.unwrap()[axis];
        assert!(
            near(found, row.displacement_um[axis] * 1e-3, 0.0),
            "{row:?}"
        );
    }
}

#[test]
fn tilts_and_oblique_views_decorrelate_and_displace_as_the_tensor_formula_says() {
    for row in rows(&["tilt 3", "camera at 39°: all"]) {
        assert_predicted(&row);
    }
}

/// What the formula without the defocus of an axial motion says is refuted.
#[test]
fn a_motion_along_the_viewing_ray_decorrelates_by_defocus_too() {
    for row in rows(&["out of plane, 1.5"]) {
        assert_predicted(&row);
        assert!(row.waves.gamma.high < row.gamma_overlap - 0.1, "{row:?}");
    }
}

#[test]
fn a_tilt_displaces_an_out_of_focus_pattern() {
    for row in rows(&["focus 20 mm near: tilt 3"]) {
        assert_predicted(&row);
        assert!(row.waves.displacement.unwrap()[0].low > 0.1);
    }
}

/// At 80° from the normal the surface leaves the depth of focus within some grains: the
/// region is 8 grains wide.
#[test]
fn a_grazing_camera_sees_what_the_tensor_formula_says() {
    let cases: Vec<MotionCase> = reference_cases()
        .into_iter()
        .filter(|case| case.name.starts_with("camera at 80°"))
        .collect();
    assert_eq!(cases.len(), 3);
    for region_grains in [8.0, 24.0] {
        let sampling = WaveSampling {
            wavelength_mm: REFERENCE_WAVELENGTH_MM,
            region_grains,
            realisations: 16,
            seed: 4,
        };
        for row in measure_motions(&cases, &sampling).unwrap() {
            println!(
                "{region_grains} grains, {}: δ {:.2}, γ {:.3} ({:.3} to {:.3}), law {:.3}; \
                 displacement {:?}, formula {:?}",
                row.name,
                row.delta,
                row.waves.gamma.value,
                row.waves.gamma.low,
                row.waves.gamma.high,
                row.gamma_defocused,
                row.waves.displacement.map(|d| d.map(|e| e.value * 1e3)),
                row.displacement_um
            );
        }
    }
}

/// An abrupt step: half of the patch lies this much lower, out of focus by a blur circle
/// of 5 grains.
const STEP_MM: f64 = 3.0;

/// What a tilt does to the speckle on both sides of a step, and on it. γ is taken at the
/// displacement that the formula has for the side's own depth.
#[test]
fn on_both_sides_of_a_step_speckle_moves_by_its_own_depth() {
    let case = reference_cases()
        .into_iter()
        .find(|case| case.name == "tilt 3 mrad")
        .unwrap();
    let sampling = WaveSampling {
        wavelength_mm: REFERENCE_WAVELENGTH_MM,
        region_grains: 34.0,
        realisations: 24,
        seed: 9,
    };
    let upper = speckle_shift(&case.view, &case.motion);
    let lower_point = case.view.point - DVec3::Z * STEP_MM;
    let lower = speckle_shift(
        &SurfaceView {
            point: lower_point,
            ..case.view
        },
        &Motion {
            part: case.motion.part + case.motion.rotation.cross(lower_point - case.view.point),
            ..case.motion
        },
    );
    let plan = Plan::of(&case, upper.sensor, &sampling).unwrap();
    let pairs: Vec<[WaveImage; 2]> = (0..sampling.realisations)
        .into_par_iter()
        .map(|k| {
            let mut points = plan.points(Key::new(9, Purpose::WaveScatterers).with(k));
            for p in &mut points {
                if (p.position - case.view.point).dot(plan.ray.basis[0]) < 0.0 {
                    p.position -= DVec3::Z * STEP_MM;
                }
            }
            [-0.5, 0.5].map(|share| plan.image(&points, share).unwrap())
        })
        .collect();
    // So many grains to the right of the step.
    let gamma = |grains: f64, expected: DVec2| {
        let by = (grains * PIXELS_PER_GRAIN) as isize;
        let rolled = |image: &WaveImage| {
            let n = image.grid.pixels as isize;
            let half = n / 2;
            let pixel = |k: isize| image.at(k % n - half + by, k / n - half);
            WaveImage {
                intensity: (0..n * n).map(pixel).collect(),
                ..*image
            }
        };
        let pairs: Vec<[WaveImage; 2]> =
            pairs.iter().map(|[a, b]| [rolled(a), rolled(b)]).collect();
        correlate_pairs(&pairs, expected, 4 * PIXELS_PER_GRAIN as usize, 9)
    };
    println!(
        "displacement {:?} above, {:?} below, µm",
        upper.sensor * 1e3,
        lower.sensor * 1e3
    );
    for grains in [-12.0, -8.0, -5.0, -3.0, -1.0, 1.0, 3.0, 5.0, 8.0, 12.0] {
        let (above, below) = (gamma(grains, upper.sensor), gamma(grains, lower.sensor));
        println!(
            "{grains} grains: γ {:.3} as above, {:.3} as below; law {:.3}, {:.3}",
            above.gamma.value,
            below.gamma.value,
            overlap_correlation(upper.delta),
            overlap_correlation(lower.delta)
        );
    }
}
