//! Scenes of tilted sensors, and means with their errors.

use crate::random::Random;
use lasertrace::math::DVec2;
use lasertrace::scene::Scene;
use std::f64::consts::TAU;

/// A tilt of 15 to 40° in any direction, degrees about the camera's x and y axes.
pub fn drawn_tilt(random: &mut Random) -> DVec2 {
    DVec2::from_angle(random.between(0.0, TAU)) * random.between(15.0, 40.0)
}

pub fn load(text: &str) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

/// Of independent values, and its standard error.
pub fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    (mean, (square / (n * (n - 1.0))).sqrt())
}
