//! Rays as in a simulation of laser triangulation, for any mesh that fills the view.

use crate::accel::embree_race::FlatRay;
use crate::accel::{Accel, Hit, Ray, WIDTH};
use crate::math::DVec3;
use crate::math::rng::{Purpose, RngKey};
use std::f64::consts::TAU;

/// Rays of one kind, ordered by neighbourhood.
pub struct RaySet {
    pub kind: &'static str,
    pub rays: Vec<FlatRay>,
    /// True if neighbouring rays are nearly parallel.
    pub coherent: bool,
    /// True for occlusion queries, which only return whether there is a hit.
    pub any_hit: bool,
}

/// Returns the ray sets. The mesh of `accel` must be centred at the origin.
pub fn sets(accel: &Accel, count: usize) -> [RaySet; 4] {
    let reach = accel.bounds().size().length() / 2.0;
    let towards_eye = DVec3::new(0.3, -0.55, 0.78).normalize();
    let eye = towards_eye * 4.0 * reach;
    let lamp = DVec3::new(-0.1, 0.05, 1.0).normalize() * 3.0 * reach;
    let camera = camera(eye, reach, count);
    let seen = hits(accel, &camera);
    let start = |hit: &Hit| hit.point + hit.normal * (8.0 * accel.resolution());
    let to_lamp = |i: usize| Ray::between(start(&seen[i % seen.len()]), lamp);
    let key = RngKey::new(1, Purpose::RaceRays);
    let bounce = |i: usize| {
        let hit = &seen[i % seen.len()];
        Some(Ray {
            origin: start(hit),
            direction: diffuse(hit.normal, key.with(i as u64)),
            t_max: f64::INFINITY,
        })
    };
    // Without visible surface, there are no secondary rays.
    let secondary = if seen.is_empty() { 0 } else { count };
    let set = |kind, rays: Vec<Ray>, coherent, any_hit| RaySet {
        kind,
        rays: rays.iter().map(flat).collect(),
        coherent,
        any_hit,
    };
    [
        set("camera", camera, true, false),
        set("sheet", sheets(lamp, reach, count), true, false),
        set(
            "shadow",
            (0..secondary).filter_map(to_lamp).collect(),
            true,
            true,
        ),
        set(
            "diffuse",
            (0..secondary).filter_map(bounce).collect(),
            false,
            false,
        ),
    ]
}

/// Returns the rays of a square image in row-major order.
fn camera(eye: DVec3, reach: f64, count: usize) -> Vec<Ray> {
    let side = (count as f64).sqrt().ceil() as usize;
    let right = eye.cross(DVec3::Z).normalize();
    let up = right.cross(eye.normalize());
    let at = |i: usize| (i as f64 + 0.5) / side as f64 * 2.0 - 1.0;
    let ray = |k: usize| towards(eye, (right * at(k % side) - up * at(k / side)) * reach);
    (0..count).map(ray).collect()
}

/// Returns fans of 512 rays in planes perpendicular to y, as from a laser line while the part moves
/// below it.
fn sheets(lamp: DVec3, reach: f64, count: usize) -> Vec<Ray> {
    const FAN: usize = 512;
    let fans = count.div_ceil(FAN);
    let at = |i: usize, of: usize| ((i as f64 + 0.5) / of as f64 * 2.0 - 1.0) * reach;
    let ray = |k: usize| {
        let y = at(k / FAN, fans);
        towards(
            DVec3::new(lamp.x, y, lamp.z),
            DVec3::new(at(k % FAN, FAN), y, 0.0),
        )
    };
    (0..count).map(ray).collect()
}

fn towards(from: DVec3, to: DVec3) -> Ray {
    Ray {
        t_max: f64::INFINITY,
        ..Ray::between(from, to).expect("eye and part are apart")
    }
}

fn hits(accel: &Accel, rays: &[Ray]) -> Vec<Hit> {
    rays.chunks(WIDTH)
        .flat_map(|packet| accel.closest(packet, |_, _| true))
        .flatten()
        .collect()
}

/// Samples a direction from the Lambertian cosine distribution about a normal.
fn diffuse(normal: DVec3, key: RngKey) -> DVec3 {
    let (height, turn) = (2.0 * key.uniform(0) - 1.0, TAU * key.uniform(1));
    let ring = (1.0 - height * height).sqrt();
    let on_sphere = DVec3::new(ring * turn.cos(), ring * turn.sin(), height);
    (normal + on_sphere).try_normalize().unwrap_or(normal)
}

pub fn flat(ray: &Ray) -> FlatRay {
    FlatRay {
        origin: ray.origin.as_vec3().to_array(),
        direction: ray.direction.as_vec3().to_array(),
        t_max: ray.t_max as f32,
    }
}

/// Converts a ray to f64, without rounding.
pub fn exact(flat: &FlatRay) -> Ray {
    let wide = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    Ray {
        origin: wide(flat.origin),
        direction: wide(flat.direction),
        t_max: flat.t_max.into(),
    }
}
