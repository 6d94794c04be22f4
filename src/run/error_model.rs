//! The error model of a scene's peaks.

use crate::camera::Camera;
use crate::profile::{ErrorModel, SpeckleGrain};
use crate::scene::Scene;

/// What data sheets of the scene's laser and camera tell of the errors of peaks.
pub(crate) fn error_model(scene: &Scene) -> ErrorModel {
    let Camera { sensor, .. } = &scene.camera;
    let shot = sensor.noise.map_or(0.0, |_| sensor.gain_dn_per_e);
    let grain = scene.speckle.map(|model| SpeckleGrain {
        rays: scene.camera.model().chief_rays(),
        resolution: sensor.resolution,
        size: scene.camera.speckle_angle(scene.laser.beam.wavelength),
        contrast: model.coherence.contrast(),
        aperture: model.aperture,
    });
    ErrorModel::new(scene.measure.finder, shot, grain)
}
