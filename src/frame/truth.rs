//! What each pixel's centre looks at: the layers a learner or a debugger compares
//! an image with.

use super::View;
use crate::accel::{Hit, Ray, WIDTH};
use crate::math::DVec2;
use rayon::prelude::*;

/// One value a pixel, row by row; in the part's frame, mm. A pixel that sees
/// nothing has depth +∞, zero position and normal, and triangle and copy `u32::MAX`.
pub struct Truth {
    /// Distance from the pupil centre along the camera's axis.
    pub depth: Vec<f32>,
    /// Where the ray of the pixel's centre meets the part.
    pub position: Vec<[f32; 3]>,
    /// Unit normal of the triangle, towards the camera.
    pub normal: Vec<[f32; 3]>,
    /// Of the mesh.
    pub triangle: Vec<u32>,
    /// Of the mesh, in the order of their poses.
    pub copy: Vec<u32>,
}

/// What the rays through the pixels' centres meet first.
pub fn truth_layers(view: &View) -> Truth {
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
