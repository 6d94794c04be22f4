//! Surface between laser and camera for which the speckle of a scan is computed.

use crate::math::{DVec3, Rigid};
use crate::scene::Scene;
use crate::speckle::motion::{Source, SurfaceView};

/// Returns the view of `point` (head's frame) on a surface perpendicular to the beam. The default
/// point is the field centre, where the optical axis intersects the laser plane. Without an
/// intersection it is on the plane of focus.
pub(crate) fn surface_view(scene: &Scene, point: Option<DVec3>) -> SurfaceView {
    let camera = &scene.head_from_camera;
    let laser = &scene.head_from_laser;
    let (eye, axis) = (camera.translation, camera.rotation.z_axis);
    let normal = laser.rotation.y_axis;
    let distance = normal.dot(laser.translation - eye) / normal.dot(axis);
    let lens = &scene.camera.lens;
    let point =
        point.unwrap_or_else(
            || match distance.is_finite() && distance > lens.focal_length {
                true => eye + axis * distance,
                false => eye + axis * lens.focus_distance,
            },
        );
    let wave = scene.laser.wavefront(laser.inverse().point(point));
    let turn = laser.rotation;
    SurfaceView {
        point,
        normal: -laser.rotation.z_axis,
        source: Source::Wavefront {
            direction: turn * wave.direction,
            curvature_per_mm: turn * wave.curvature_per_mm * turn.transpose(),
        },
        pupil_centre: eye,
        pupil_diameter: lens.pupil_diameter(),
        image_x: camera.rotation.x_axis,
        focus_distance: lens.focus_distance,
        magnification: lens.image_distance() / (point - eye).length(),
    }
}

/// Returns the view in the camera's frame.
pub(crate) fn in_camera(view: &SurfaceView, camera_from_head: &Rigid) -> SurfaceView {
    let turn = camera_from_head.rotation;
    let source = match view.source {
        Source::Point(point) => Source::Point(camera_from_head.point(point)),
        Source::Wavefront {
            direction,
            curvature_per_mm,
        } => Source::Wavefront {
            direction: turn * direction,
            curvature_per_mm: turn * curvature_per_mm * turn.transpose(),
        },
    };
    SurfaceView {
        point: camera_from_head.point(view.point),
        normal: turn * view.normal,
        source,
        pupil_centre: camera_from_head.point(view.pupil_centre),
        image_x: turn * view.image_x,
        ..*view
    }
}
