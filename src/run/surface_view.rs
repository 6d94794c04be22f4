//! The surface between laser and camera that a scan's speckle is computed for.

use crate::accel::{Accel, Ray, WIDTH};
use crate::math::{DVec2, DVec3, Rigid};
use crate::scene::Scene;
use crate::speckle::motion::{Source, SurfaceView};

/// The view of `point` (head's frame) on a surface across the beam; by default the
/// point in the middle of the field, where the optical axis meets the laser plane
/// (the plane of focus, if nowhere).
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

/// The view in the camera's frame.
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

/// Places along the path, and rays along either side of the view, at which the surface is
/// looked at: as many as tell its mean slope.
const PLACES: u32 = 5;
const RAYS: u32 = 9;

/// Mean normal (head's frame, towards the laser) of what the laser's sheet lights of the
/// part within the camera's view, over the path; `None` where that is nothing.
pub(crate) fn lit_normal(scene: &Scene, accel: &Accel) -> Option<DVec3> {
    let last = scene.scan.frames.saturating_sub(1) as u64;
    let frames = (0..PLACES as u64).map(|i| (last * i / (PLACES as u64 - 1)) as u32);
    let sum: DVec3 = frames.map(|frame| normals_of(scene, accel, frame)).sum();
    sum.try_normalize()
}

/// Sum of the normals at one pose.
fn normals_of(scene: &Scene, accel: &Accel, frame: u32) -> DVec3 {
    let part_from_head = scene.part_from_head(frame);
    let (camera, laser) = (&scene.head_from_camera, &scene.head_from_laser);
    let size = scene.camera.sensor.resolution.as_dvec2();
    let sheet = laser.rotation.y_axis;
    let ray = |i: u32| {
        let share = DVec2::new((i % RAYS) as f64 + 0.5, (i / RAYS) as f64 + 0.5) / RAYS as f64;
        let sight = camera.vector(scene.camera.direction(share * size));
        let distance = sheet.dot(laser.translation - camera.translation) / sheet.dot(sight);
        let on_sheet = camera.translation + sight * distance;
        let along = part_from_head
            .vector(on_sheet - laser.translation)
            .try_normalize()?;
        (distance > 0.0).then(|| Ray {
            origin: part_from_head.point(laser.translation),
            direction: along,
            t_max: f64::INFINITY,
        })
    };
    let rays: Vec<Ray> = (0..RAYS * RAYS).filter_map(ray).collect();
    let eye = part_from_head.point(camera.translation);
    let camera_from_part = (part_from_head * *camera).inverse();
    let seen = |point: DVec3| {
        let pixel = scene.camera.project(camera_from_part.point(point));
        pixel.is_some_and(|p| p.cmpge(DVec2::ZERO).all() && p.cmple(size).all())
    };
    let hits = rays
        .chunks(WIDTH)
        .flat_map(|rays| accel.closest(rays, |_, _| true));
    let lit = hits
        .flatten()
        .filter(|hit| seen(hit.point) && hit.normal.dot(eye - hit.point) > 0.0);
    let normals: DVec3 = lit.map(|hit| hit.normal).sum();
    part_from_head.inverse().vector(normals)
}
