//! What the ways in from C and Python are timed by.

use crate::lasertrace::accel::{Accel, Ray};
use crate::lasertrace::math::DVec3;
use std::path::{Path, PathBuf};

pub const PAIRS: usize = 21;
pub const RAYS: usize = 1 << 20;
pub const FRAMES: u32 = 8;

pub fn scene_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenes/bracket/scene.toml")
}

/// Towards places in the part from a sphere around it, in no order.
pub fn rays(accel: &Accel) -> Vec<Ray> {
    let (middle, size) = (accel.bounds().center(), accel.bounds().size());
    let mut state = 1u64;
    let mut uniform = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    };
    let mut vector = || DVec3::new(uniform(), uniform(), uniform());
    let ray = |_| {
        let origin = middle + vector().normalize() * size.length();
        Ray {
            origin,
            direction: middle + vector() * size - origin,
            t_max: f64::INFINITY,
        }
    };
    (0..RAYS).map(ray).collect()
}
