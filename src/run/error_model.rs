//! Error model of a scene's points, derived from the data of laser and camera.

use crate::camera::{Camera, Sensor};
use crate::frame::Blur;
use crate::math::Rigid;
use crate::profile::{Calibration, DefocusNoise, HdrExposure, SpeckleGrain, UncertaintyModel};
use crate::run::scan_speckle::frame_steps;
use crate::scene::Scene;

/// Returns the error model of peaks for the data of the scene's laser and camera, in images with
/// the given blur.
pub(crate) fn error_model(scene: &Scene, blur: Blur) -> UncertaintyModel {
    let Camera { sensor, .. } = &scene.camera;
    let shot = sensor.noise.map_or(0.0, |_| sensor.gain_dn_per_e);
    let of_contrast = |contrast: f64| SpeckleGrain {
        rays: scene.camera.model().chief_rays(),
        resolution: sensor.resolution,
        size: scene.camera.speckle_angle(scene.laser.beam.wavelength),
        contrast,
        aperture: scene.camera.lens.aperture,
    };
    let grain = (scene.speckle).map(|model| of_contrast(model.coherence.contrast()));
    let noise = sensor.noise.unwrap_or_default();
    // The background includes rounding.
    let rounding_e = 1.0 / (12f64.sqrt() * sensor.gain_dn_per_e);
    let fixed_share =
        (sensor.fixed_dark_noise_e() / sensor.dark_noise_e().hypot(rounding_e)).powi(2);
    let model = UncertaintyModel::new(scene.measure.finder, shot, grain)
        .with_patterns(noise.prnu, fixed_share);
    let model = model.with_exposures(merged(sensor));
    let model = match scene.scan.motion_samples {
        1 => model,
        _ => model.with_poses(&frame_steps(scene, scene.scan.exposure_places(0))),
    };
    match blur {
        Blur::None => model,
        // The lens widens a line without speckle by the same amount.
        _ => model.with_defocus(
            DefocusNoise::new(
                &scene.camera,
                &perfect_calibration(scene),
                grain.unwrap_or_else(|| of_contrast(0.0)),
            ),
            blur == Blur::Coherent,
        ),
    }
}

/// Returns the counts above which shorter exposures are used.
fn merged(sensor: &Sensor) -> Vec<HdrExposure> {
    let full = sensor.full_scale() - sensor.black_level_dn;
    let before = std::iter::once(1.0).chain(sensor.shorter.iter().copied());
    let of = |(before, &ratio): (f64, &f64)| HdrExposure {
        from_dn: full * before,
        ratio,
    };
    before.zip(&sensor.shorter).map(of).collect()
}

/// Returns the calibration with the true values of the scene's sensor.
pub(crate) fn perfect_calibration(scene: &Scene) -> Calibration {
    let camera_from_laser = camera_from_laser(scene);
    Calibration::perfect(
        scene.camera.model(),
        scene.head_from_camera,
        camera_from_laser.translation,
        camera_from_laser.rotation.y_axis,
    )
}

/// Returns the pose of the laser in the camera's frame.
pub(crate) fn camera_from_laser(scene: &Scene) -> Rigid {
    scene.head_from_camera.inverse() * scene.head_from_laser
}
