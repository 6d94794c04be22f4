//! Ground truth: depth, position, normal, triangle and instance at each pixel centre, for training
//! and debugging.

use super::PoseView;
use crate::accel::{Hit, Ray, WIDTH};
use crate::math::DVec2;
use rayon::prelude::*;

/// Ground-truth layers with one value per pixel, row by row; part's frame, mm. A pixel without a
/// hit has depth +∞, zero position and normal, and `u32::MAX` as triangle and instance index.
pub struct Truth {
    /// Distance from the pupil centre along the camera's optical axis, mm.
    pub depth: Vec<f32>,
    /// Intersection of the chief ray of the pixel centre with the part.
    pub position: Vec<[f32; 3]>,
    /// Unit normal of the triangle, towards the camera.
    pub normal: Vec<[f32; 3]>,
    /// Triangle index in the mesh.
    pub triangle: Vec<u32>,
    /// Index of the mesh instance, in the order of the instance poses.
    pub copy: Vec<u32>,
}

/// Traces the ray of every pixel centre and returns the layers of the first hits.
pub fn truth_layers(view: &PoseView) -> Truth {
    let resolution = view.camera.sensor.resolution;
    let eye = view.part_from_camera.translation;
    let axis = view.part_from_camera.rotation.z_axis;
    let hits: Vec<Option<Hit>> = (0..resolution.y)
        .into_par_iter()
        .flat_map_iter(|row| {
            let rays: Vec<Ray> = (0..resolution.x)
                .map(|column| {
                    let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                    Ray {
                        origin: eye,
                        direction: view.part_from_camera.vector(view.camera.direction(pixel)),
                        t_max: f64::INFINITY,
                    }
                })
                .collect();
            let hits: Vec<Option<Hit>> = rays
                .chunks(WIDTH)
                .flat_map(|packet| view.accel.closest(packet, |_, _| true)[..packet.len()].to_vec())
                .collect();
            hits
        })
        .collect();
    let vector = |of: fn(&Hit) -> crate::math::DVec3| {
        hits.iter()
            .map(|hit| {
                hit.as_ref()
                    .map_or([0.0; 3], |h| of(h).as_vec3().to_array())
            })
            .collect()
    };
    let number = |of: fn(&Hit) -> u32| {
        let numbers = hits.iter().map(|hit| hit.as_ref().map_or(u32::MAX, of));
        numbers.collect()
    };
    Truth {
        depth: hits
            .iter()
            .map(|hit| hit.map_or(f32::INFINITY, |h| (h.point - eye).dot(axis) as f32))
            .collect(),
        position: vector(|hit| hit.point),
        normal: vector(|hit| hit.normal),
        triangle: number(|hit| hit.face.triangle),
        copy: number(|hit| hit.face.copy),
    }
}
