use super::*;

/// Geometry of the reference values: λ = 660 nm, L_o = 300, L_s = 250, D = 10, point source 30°
/// from the normal, camera along the normal.
fn reference_view() -> SurfaceView {
    let angle = 30f64.to_radians();
    SurfaceView {
        point: DVec3::ZERO,
        normal: DVec3::Z,
        source: Source::Point(250.0 * DVec3::new(angle.sin(), 0.0, angle.cos())),
        pupil_centre: DVec3::new(0.0, 0.0, 300.0),
        pupil_diameter: 10.0,
        image_x: DVec3::X,
        focus_distance: 300.0,
        magnification: 1.0,
    }
}

fn oblique_view() -> SurfaceView {
    SurfaceView {
        point: DVec3::new(3.0, -2.0, 1.0),
        normal: DVec3::new(0.2, -0.1, 1.0).normalize(),
        source: Source::Point(DVec3::new(-90.0, 30.0, 220.0)),
        pupil_centre: DVec3::new(120.0, 40.0, 260.0),
        focus_distance: 270.0,
        magnification: -0.4,
        ..reference_view()
    }
}

fn turn_y(mrad: f64) -> RigidMotion {
    RigidMotion {
        rotation: DVec3::Y * mrad * 1e-3,
        ..RigidMotion::default()
    }
}

#[test]
fn the_overlap_law_has_its_tabled_values() {
    let table = [
        (0.0, 1.0),
        (0.05, 0.877),
        (0.1, 0.762),
        (0.2, 0.558),
        (0.3, 0.389),
        (0.5, 0.153),
        (0.7, 0.035),
        (1.0, 0.0),
        (MAX_DELTA, 0.0),
    ];
    for (delta, gamma) in table {
        let found = overlap_correlation(delta);
        assert!((found - gamma).abs() <= 0.0005 + 1e-12, "{delta}: {found}");
    }
}

#[test]
fn a_tilt_shifts_the_pupil_field_by_the_reference_values() {
    for (mrad, delta, gamma) in [(3.0, 0.168, 0.620), (8.0, 0.448, 0.202)] {
        let shift = speckle_shift(&reference_view(), &turn_y(mrad));
        assert!((shift.delta - delta).abs() <= 0.0005, "{}", shift.delta);
        // γ falls by up to 2.5 per unit of δ, and both are rounded to three decimals.
        assert!((overlap_correlation(shift.delta) - gamma).abs() <= 0.0005);
        assert_eq!(shift.sensor, DVec2::ZERO);
    }
}

#[test]
fn an_out_of_focus_pattern_moves_by_the_reference_values() {
    let both = RigidMotion {
        part: DVec3::X * 0.04,
        ..turn_y(2.0)
    };
    let table = [
        (280.0, turn_y(3.0), 112.0),
        (300.0, turn_y(3.0), 0.0),
        (320.0, turn_y(3.0), -112.0),
        (280.0, both, 117.0),
        (320.0, both, -37.0),
    ];
    for (focus_distance, motion, micrometres) in table {
        let view = SurfaceView {
            focus_distance,
            ..reference_view()
        };
        let shift = speckle_shift(&view, &motion);
        assert!(
            (shift.sensor - DVec2::X * micrometres * 1e-3).length() <= 0.05e-3,
            "{focus_distance}: {}",
            shift.sensor
        );
    }
}

/// The projection without a basis T equals L_o·(TᵀQ)⁻¹·Tᵀ·g as stated in the module.
#[test]
fn the_projection_is_the_tensor_formula_in_any_tangent_basis() {
    let view = oblique_view();
    let motion = RigidMotion {
        part: DVec3::new(0.1, -0.2, 0.3),
        rotation: DVec3::new(1e-3, 2e-3, -3e-3),
        laser: DVec3::new(0.0, 0.4, 0.1),
        camera: DVec3::new(-0.2, 0.1, 0.2),
    };
    let ray = ViewRay::of(&view).unwrap();
    let (n_s, curvature) = view.source.at(view.point).unwrap();
    let body = motion.part - motion.camera;
    let g = curvature * (motion.part - motion.laser)
        + (body - ray.direction * ray.direction.dot(body)) / ray.length
        - motion.rotation.cross(n_s - ray.direction);
    let t1 = view.normal.cross(DVec3::new(0.3, 1.0, 0.0));
    let t2 = t1 * 0.5 + view.normal.cross(DVec3::X);
    let (q1, q2) = (ray.basis[0], ray.basis[1]);
    let tq = glam::DMat2::from_cols(
        DVec2::new(t1.dot(q1), t2.dot(q1)),
        DVec2::new(t1.dot(q2), t2.dot(q2)),
    );
    let expected = ray.length * (tq.inverse() * DVec2::new(t1.dot(g), t2.dot(g)));
    let found = speckle_shift(&view, &motion);
    assert!((found.pupil - expected).length() < 1e-12 * expected.length());
    let b = ray.project(body);
    let image = -0.4 * (b + (1.0 - 270.0 / ray.length) * (expected - b));
    assert!((found.sensor - image).length() < 1e-12);
}

#[test]
fn the_camera_alone_moves_the_field_by_minus_its_way_and_a_head_like_the_part() {
    let view = oblique_view();
    let ray = ViewRay::of(&view).unwrap();
    let way = DVec3::new(0.3, -0.7, 0.2);
    let camera = RigidMotion {
        camera: way,
        ..RigidMotion::default()
    };
    let found = speckle_shift(&view, &camera).pupil;
    assert!((found + ray.project(way)).length() < 1e-12);
    let head = RigidMotion {
        laser: way,
        ..camera
    };
    let part = RigidMotion {
        part: -way,
        ..RigidMotion::default()
    };
    let [head, part] = [head, part].map(|m| speckle_shift(&view, &m));
    assert!((head.pupil - part.pupil).length() < 1e-12);
    assert!((head.sensor - part.sensor).length() < 1e-15);
}

#[test]
fn a_wavefront_with_a_point_sources_curvature_is_a_point_source() {
    let view = oblique_view();
    let (direction, curvature_per_mm) = view.source.at(view.point).unwrap();
    let wave = SurfaceView {
        source: Source::Wavefront {
            direction,
            curvature_per_mm,
        },
        ..view
    };
    let motion = RigidMotion {
        part: DVec3::new(0.5, 0.1, -0.2),
        ..turn_y(1.0)
    };
    assert_eq!(speckle_shift(&view, &motion), speckle_shift(&wave, &motion));
}

#[test]
fn the_seeds_sum_is_never_less_and_equal_for_one_kind_of_motion() {
    let view = oblique_view();
    let single = RigidMotion {
        camera: DVec3::new(0.3, 0.2, 0.0),
        ..RigidMotion::default()
    };
    let delta = speckle_shift(&view, &single).delta;
    assert!((bergmann_scalar_sum(&view, &single) - delta).abs() < 1e-15);
    // The camera follows the part: nothing moves across the pupil, but the scalar sum is not zero.
    let part = DVec3::new(0.3, 0.2, 0.0);
    let follow = RigidMotion {
        part,
        laser: part,
        camera: part,
        ..RigidMotion::default()
    };
    assert!(speckle_shift(&view, &follow).delta < 1e-15);
    assert!(bergmann_scalar_sum(&view, &follow) > 0.03);
}

#[test]
fn singular_views_decorrelate_and_stay_finite() {
    let base = reference_view();
    let motion = RigidMotion {
        part: DVec3::new(0.1, 0.02, 0.03),
        ..turn_y(3.0)
    };
    let with = |normal, pupil_centre, source| SurfaceView {
        normal,
        pupil_centre,
        source,
        focus_distance: 280.0,
        ..base
    };
    let views = [
        with(DVec3::X, base.pupil_centre, base.source),
        with(DVec3::new(1.0, 0.0, 1e-12), base.pupil_centre, base.source),
        with(DVec3::Z, DVec3::ZERO, base.source),
        with(DVec3::Z, base.pupil_centre, Source::Point(DVec3::ZERO)),
        with(
            DVec3::Z,
            base.pupil_centre,
            Source::Point(DVec3::Z * 1e-300),
        ),
        SurfaceView {
            pupil_diameter: 0.0,
            ..base
        },
    ];
    for view in views {
        let shift = speckle_shift(&view, &motion);
        assert_eq!(shift.delta, MAX_DELTA, "{view:?}");
        assert!(shift.pupil.is_finite() && shift.sensor.length() <= motion.part.length());
        assert!(shift.pupil.length() <= MAX_DELTA * view.pupil_diameter * 1.000_001);
        assert_eq!(overlap_correlation(shift.delta), 0.0);
        assert_eq!(bergmann_scalar_sum(&view, &motion), MAX_DELTA);
        let still = speckle_shift(&view, &RigidMotion::default());
        assert_eq!((still.delta, still.sensor), (0.0, DVec2::ZERO));
    }
    // A point in the pupil plane, next to the pupil's centre: the magnification is undefined there.
    let beside = SurfaceView {
        pupil_centre: DVec3::new(40.0, 0.0, 0.0),
        normal: DVec3::new(1.0, 0.0, 1.0).normalize(),
        magnification: f64::INFINITY,
        ..base
    };
    let shift = speckle_shift(&beside, &motion);
    assert!(shift.delta.is_finite() && shift.sensor.is_finite());
}

#[test]
fn motions_of_many_pupil_diameters_keep_their_length() {
    let far = RigidMotion {
        camera: DVec3::X * 5e4,
        ..RigidMotion::default()
    };
    let shift = speckle_shift(&reference_view(), &far);
    assert!((shift.delta - 5e3).abs() < 1e-9);
    assert_eq!(overlap_correlation(shift.delta), 0.0);
}

#[test]
fn defocus_lowers_the_correlation_by_the_closed_forms() {
    for delta in [0.0, 0.1, 0.5, 0.9] {
        let difference = overlap_correlation_defocused(delta, 0.0) - overlap_correlation(delta);
        assert!(difference.abs() < 1e-4, "{delta}: {difference}");
    }
    for phase in [0.5f64, -1.32, 4.0, 40.0] {
        let expected = ((phase / 2.0).sin() / (phase / 2.0)).powi(2);
        let difference = overlap_correlation_defocused(0.0, phase) - expected;
        assert!(difference.abs() < 1e-4, "{phase}: {difference}");
    }
    for (delta, phase) in [(1.0, 0.0), (0.0, 1e9), (f64::NAN, 0.0), (0.0, f64::NAN)] {
        assert_eq!(overlap_correlation_defocused(delta, phase), 0.0);
    }
    // One longitudinal grain, 8λ(L/D)², is a phase of 2π.
    let grain = RigidMotion {
        part: DVec3::Z * 8.0 * 660e-6 * 900.0,
        ..RigidMotion::default()
    };
    let phase = defocus_phase(&reference_view(), &grain, 660e-6);
    assert!((phase - std::f64::consts::TAU).abs() < 1e-12);
}
