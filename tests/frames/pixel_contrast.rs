//! The contrast of speckle in images: pixels of the plan against pixels of many samples,
//! and these against the closed form.

use crate::program::folder_with;
use lasertrace::math::Aperture;
use lasertrace::math::DVec2;
use lasertrace::plan::ModelConfig;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::speckle::theory::{integrated_contrast, sampled_contrast, sampling_deviation};
use std::path::Path;

/// Sensor of 200 × 200 pixels of `pitch_um` in light that is even over them to 1e-3, at
/// f/8 and 660 nm: grains of h = 6.25 µm. `coherence` are lines of [laser] and [part].
fn scene_text(pitch_um: f64, [part, laser]: [&str; 2]) -> String {
    format!(
        r#"seed = 3
speckle = true
[part]
plane = {{ size_mm = [400, 400] }}
reflectance = 0.5
{part}
[laser]
wavelength_nm = 660
power_mw = 1000
waist_radius_um = 100000
waist_distance_mm = 300
position_mm = [0, 0, 300]
direction = [0, 0, -1]
{laser}
[camera]
focal_length_mm = 16
f_number = 8
focus_distance_mm = 100
resolution_px = [200, 200]
pixel_pitch_um = {pitch_um}
position_mm = [0, -50, 86.6025]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.01
quantum_efficiency = 0.5
gain_dn_per_e = 0.02
bit_depth = 10
full_well_e = 50000
[scan]
frames = 1
step_mm = 0
direction = [0, 1, 0]
start_mm = [0, 0, 0]
"#
    )
}

/// Light of a frame over the same light without speckle, and the plan.
fn speckle(path: &Path, samples_per_side: Option<u32>) -> (Vec<f64>, ModelConfig) {
    let light = |speckle| {
        let mut scene = Scene::load(path).unwrap();
        scene.methods.samples_per_side = samples_per_side;
        scene.methods.speckle = Some(speckle);
        let simulation = Simulation::new(&scene).unwrap();
        (simulation.irradiance(0).dense(), simulation.plan.clone())
    };
    let ((speckled, plan), (even, _)) = (light(true), light(false));
    let ratios = speckled
        .iter()
        .zip(&even)
        .map(|(&a, &b)| a as f64 / b as f64);
    (ratios.collect(), plan)
}

fn contrast(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
    variance.sqrt() / mean
}

/// Pixels from a quarter of a grain to four grains, polarised light, light polarised in
/// part and independent patterns. What the plan's samples make of the same grains is
/// within 0.5 % of the contrast that 16 × 16 make. The two differ by a part of each pixel,
/// of relative standard deviation s by theory, which is as good as independent from
/// grain to grain: to first order the ratio hangs on its covariance with the light, which
/// strays by s/√(grains), of which five are allowed.
#[test]
fn the_plans_samples_keep_the_contrast() {
    let kinds = [
        ["", ""],
        ["polarisation_degree = 0.3", ""],
        ["", "incoherent_modes = 4"],
    ];
    for (i, q) in [0.25, 0.4, 0.7, 1.0, 1.5, 2.0, 4.0].into_iter().enumerate() {
        for kind in &kinds[..if i % 3 == 0 { 3 } else { 1 }] {
            let grain = 0.66 * 8.0 * (1.0 + 16.0 / 84.0);
            let folder = folder_with(&scene_text(q * grain, *kind));
            let path = folder.path().join("scene.toml");
            let (planned, plan) = speckle(&path, None);
            // On the axis the grain is a pixel over q; off it the smallest side is 1/cos θ longer.
            let corner = Scene::load(&path).unwrap().camera.sensor_point(DVec2::ZERO);
            let grain = plan.grain.speckle_size_px * q;
            assert!((1.0 - 1e-9..=corner.length() / corner.z + 1e-9).contains(&grain));
            let (fine, _) = speckle(&path, Some(16));
            let n = plan.samples_per_side as usize;
            let theory = integrated_contrast(Aperture::Circle, q);
            let by_samples = sampled_contrast(Aperture::Circle, q, n) / theory;
            let deviation = sampling_deviation(Aperture::Circle, q, n) / theory;
            let grains = (200.0 * q).powi(2).min(planned.len() as f64);
            let chance = 5.0 * deviation / grains.sqrt();
            let ratio = contrast(&planned) / contrast(&fine);
            println!("{q} {kind:?}: {n} samples, {ratio:.5}, theory {by_samples:.5} ± {chance:.5}");
            assert!((by_samples - 1.0).abs() <= 0.005);
            assert!(
                (ratio - 1.0).abs() < 0.005 + chance,
                "{q} {kind:?}: {ratio}"
            );
        }
    }
}
