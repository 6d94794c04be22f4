//! The motions the wave-optics reference is asked about.

use super::motion::{Motion, Source, SurfaceView};
use super::wave_motion::MotionCase;
use crate::math::{DMat3, DVec3};

/// λ of [`reference_cases`] (mm).
pub const REFERENCE_WAVELENGTH_MM: f64 = 660e-6;

/// One motion of each kind, at λ = 660 nm, L_o = 300 mm, L_s = 250 mm, D = 10 mm,
/// laser 30° from the normal and camera along it unless the name says otherwise,
/// magnification 1.
pub fn reference_cases() -> Vec<MotionCase> {
    let laser_at = |degrees: f64| {
        let angle = degrees.to_radians();
        Source::Point(250.0 * DVec3::new(angle.sin(), 0.0, angle.cos()))
    };
    let view = SurfaceView {
        point: DVec3::ZERO,
        normal: DVec3::Z,
        source: laser_at(30.0),
        pupil_centre: DVec3::Z * 300.0,
        pupil_diameter: 10.0,
        image_x: DVec3::X,
        focus_distance: 300.0,
        magnification: 1.0,
    };
    let oblique_laser = SurfaceView {
        source: laser_at(60.0),
        ..view
    };
    let oblique_camera = SurfaceView {
        pupil_centre: 300.0 * DVec3::new(-0.6, 0.2, 0.6f64.sqrt()),
        ..view
    };
    let focused = |focus_distance| SurfaceView {
        focus_distance,
        ..view
    };
    let curved = SurfaceView {
        source: Source::Wavefront {
            direction: -DVec3::Z,
            curvature_per_mm: DMat3::from_diagonal(DVec3::new(1.0 / 40.0, 0.0, 0.0)),
        },
        ..view
    };
    let part = |x, y, z| Motion {
        part: DVec3::new(x, y, z),
        ..Motion::default()
    };
    let tilt = |x: f64, y: f64| Motion {
        rotation: DVec3::new(x, y, 0.0) * 1e-3,
        ..Motion::default()
    };
    let tilt_and_shift = Motion {
        part: DVec3::X * 0.04,
        ..tilt(0.0, 2.0)
    };
    let everything = Motion {
        part: DVec3::new(0.3, -0.2, 0.2),
        rotation: DVec3::new(1.0, -1.5, 5.0) * 1e-3,
        ..Motion::default()
    };
    let camera = Motion {
        camera: DVec3::new(1.0, 2.0, 0.0),
        ..Motion::default()
    };
    [
        ("in plane, 1 mm along x", view, part(1.0, 0.0, 0.0)),
        ("in plane, 2 mm along y", view, part(0.0, 2.0, 0.0)),
        ("out of plane, 0.3 mm", view, part(0.0, 0.0, 0.3)),
        ("out of plane, 1.5 mm", view, part(0.0, 0.0, 1.5)),
        ("tilt 3 mrad", view, tilt(0.0, 3.0)),
        ("tilt 8 mrad", view, tilt(0.0, 8.0)),
        ("laser at 60°: tilt 4 mrad", oblique_laser, tilt(4.0, 2.0)),
        (
            "laser at 60°: 1 mm in plane",
            oblique_laser,
            part(0.7, 0.7, 0.0),
        ),
        ("camera at 39°: tilt", oblique_camera, tilt(2.0, 2.0)),
        (
            "camera at 39°: 1 mm in plane",
            oblique_camera,
            part(0.7, 0.7, 0.0),
        ),
        ("camera at 39°: all at once", oblique_camera, everything),
        ("camera alone, 2.2 mm", view, camera),
        ("curved wavefront, 0.2 mm", curved, part(0.2, 0.2, 0.0)),
        (
            "focus 20 mm near: tilt 3 mrad",
            focused(280.0),
            tilt(0.0, 3.0),
        ),
        (
            "focus 20 mm far: tilt 3 mrad",
            focused(320.0),
            tilt(0.0, 3.0),
        ),
        (
            "focus 20 mm near: tilt and shift",
            focused(280.0),
            tilt_and_shift,
        ),
        (
            "focus 20 mm far: tilt and shift",
            focused(320.0),
            tilt_and_shift,
        ),
    ]
    .into_iter()
    .map(|(name, view, motion)| MotionCase {
        name: name.into(),
        view,
        motion,
    })
    .collect()
}
