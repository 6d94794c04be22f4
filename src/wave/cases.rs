//! Motions for which the wave-optics reference is evaluated.

use super::motion::MotionCase;
use crate::math::{DMat3, DVec3};
use crate::speckle::motion::{RigidMotion, Source, SurfaceView};

/// Wavelength λ of [`reference_cases`], mm.
pub const REFERENCE_WAVELENGTH_MM: f64 = 660e-6;

/// Returns one motion of each type. λ = 660 nm, L_o = 300 mm, L_s = 250 mm, D = 10 mm and
/// magnification 1. The laser is 30° from the normal and the camera along the normal, unless the
/// name states other angles.
pub fn reference_cases() -> Vec<MotionCase> {
    let mut cases = straight_camera();
    cases.extend(oblique_camera());
    cases.extend(out_of_focus());
    cases.extend(grazing_camera());
    cases
}

fn view_with_laser_at(degrees: f64) -> SurfaceView {
    let angle = degrees.to_radians();
    SurfaceView {
        point: DVec3::ZERO,
        normal: DVec3::Z,
        source: Source::Point(250.0 * DVec3::new(angle.sin(), 0.0, angle.cos())),
        pupil_centre: DVec3::Z * 300.0,
        pupil_diameter: 10.0,
        image_x: DVec3::X,
        focus_distance: 300.0,
        magnification: 1.0,
    }
}

/// Returns a translation of the part (mm).
fn part(x: f64, y: f64, z: f64) -> RigidMotion {
    RigidMotion {
        part: DVec3::new(x, y, z),
        ..RigidMotion::default()
    }
}

/// Returns a rotation of the part (mrad).
fn tilt(x: f64, y: f64) -> RigidMotion {
    RigidMotion {
        rotation: DVec3::new(x, y, 0.0) * 1e-3,
        ..RigidMotion::default()
    }
}

fn case(name: &str, view: SurfaceView, motion: RigidMotion) -> MotionCase {
    MotionCase {
        name: name.into(),
        view,
        motion,
    }
}

fn straight_camera() -> Vec<MotionCase> {
    let view = view_with_laser_at(30.0);
    let low = view_with_laser_at(60.0);
    // Wavefront 40 mm from the focus of a thin line: curved across the line, flat along it.
    let curved = SurfaceView {
        source: Source::Wavefront {
            direction: -DVec3::Z,
            curvature_per_mm: DMat3::from_diagonal(DVec3::new(1.0 / 40.0, 0.0, 0.0)),
        },
        ..view
    };
    let camera = RigidMotion {
        camera: DVec3::new(1.0, 2.0, 0.0),
        ..RigidMotion::default()
    };
    vec![
        case("in plane, 1 mm along x", view, part(1.0, 0.0, 0.0)),
        case("in plane, 2 mm along y", view, part(0.0, 2.0, 0.0)),
        case("out of plane, 0.3 mm", view, part(0.0, 0.0, 0.3)),
        case("out of plane, 1.5 mm", view, part(0.0, 0.0, 1.5)),
        case("tilt 3 mrad", view, tilt(0.0, 3.0)),
        case("tilt 8 mrad", view, tilt(0.0, 8.0)),
        case("laser at 60°: tilt 4.5 mrad", low, tilt(4.0, 2.0)),
        case("laser at 60°: 1 mm in plane", low, part(0.7, 0.7, 0.0)),
        case("camera alone, 2.2 mm", view, camera),
        case("curved wavefront, 0.3 mm", curved, part(0.2, 0.2, 0.0)),
    ]
}

/// Returns the cases with the camera 39° from the normal, away from the laser.
fn oblique_camera() -> Vec<MotionCase> {
    let view = SurfaceView {
        pupil_centre: 300.0 * DVec3::new(-0.6, 0.2, 0.6f64.sqrt()),
        ..view_with_laser_at(30.0)
    };
    let everything = RigidMotion {
        part: DVec3::new(0.3, -0.2, 0.2),
        rotation: DVec3::new(1.0, -1.5, 5.0) * 1e-3,
        ..RigidMotion::default()
    };
    vec![
        case("camera at 39°: tilt 2.8 mrad", view, tilt(2.0, 2.0)),
        case("camera at 39°: 1 mm in plane", view, part(0.7, 0.7, 0.0)),
        case("camera at 39°: all at once", view, everything),
    ]
}

fn out_of_focus() -> Vec<MotionCase> {
    let view = |focus_distance| SurfaceView {
        focus_distance,
        ..view_with_laser_at(30.0)
    };
    let both = RigidMotion {
        part: DVec3::X * 0.04,
        ..tilt(0.0, 2.0)
    };
    vec![
        case("focus 20 mm near: tilt 3 mrad", view(280.0), tilt(0.0, 3.0)),
        case("focus 20 mm far: tilt 3 mrad", view(320.0), tilt(0.0, 3.0)),
        case("focus 20 mm near: tilt and shift", view(280.0), both),
        case("focus 20 mm far: tilt and shift", view(320.0), both),
    ]
}

/// Returns the cases with the camera 80° from the normal, away from the laser.
fn grazing_camera() -> Vec<MotionCase> {
    let (sin, cos) = 80f64.to_radians().sin_cos();
    let view = SurfaceView {
        pupil_centre: 300.0 * DVec3::new(-sin, 0.0, cos),
        image_x: DVec3::Y,
        ..view_with_laser_at(30.0)
    };
    vec![
        case("camera at 80°: tilt 1 mrad", view, tilt(0.0, 1.0)),
        case("camera at 80°: 0.3 mm in plane", view, part(0.3, 0.0, 0.0)),
        case("camera at 80°: 1 mm across", view, part(0.0, 1.0, 0.0)),
    ]
}
