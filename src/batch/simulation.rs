//! A scene made ready to take frames: hierarchy built, plan made, speckle
//! patterns computed. Each frame depends on its number alone.

use crate::accel::{Accel, Clusters};
use crate::camera::{Camera, DARK_GROUP, DarkCounts};
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::deviation::signed_distance;
use crate::integrator::{Plan, Speckle, View, footprint_image, irradiance_image};
use crate::math::rng::{Key, Purpose};
use crate::math::{Aabb, Rigid};
use crate::profile::{Calibration, Peak, find_peaks};
use crate::scene::Scene;
use crate::speckle::lookup::{Lookup, Method};
use crate::speckle::pattern::{Aperture, PatternSpec};
use rayon::prelude::*;

pub struct Simulation<'s> {
    pub scene: &'s Scene,
    pub accel: Accel<'s>,
    pub plan: Plan,
    speckle: Option<Lookup>,
    /// `None`: every sample is traced.
    clusters: Option<Clusters>,
    /// `None`: dark counts are all the same.
    dark: Option<DarkCounts>,
}

/// Tells the keys of groups of dark pixels from those of pixels: no sensor has as
/// many.
const DARK: u64 = u64::MAX;

/// Texels per minimal speckle size.
const TEXELS_PER_SPECKLE: f64 = 4.0;

impl<'s> Simulation<'s> {
    pub fn new(scene: &'s Scene) -> Result<Simulation<'s>> {
        Ok(Simulation {
            clusters: Some(Clusters::new(&scene.mesh)),
            ..Simulation::exhaustive(scene)?
        })
    }

    /// One that traces every sample, to the same bytes.
    pub fn exhaustive(scene: &'s Scene) -> Result<Simulation<'s>> {
        let plan = plan(scene);
        let spec = PatternSpec {
            size: 1024,
            texels_per_speckle: TEXELS_PER_SPECKLE,
            aperture: Aperture::Circle,
            slices: 8,
            seed: scene.seed,
        };
        Ok(Simulation {
            scene,
            accel: Accel::build(&scene.mesh, rayon::current_num_threads())?,
            plan,
            speckle: match scene.speckle {
                true => Some(Lookup::new(&spec, Method::Field)?),
                false => None,
            },
            clusters: None,
            dark: DarkCounts::new(&scene.camera.sensor),
        })
    }

    pub fn view(&self, frame: u32) -> View<'_> {
        let scene = self.scene;
        let part_from_head = scene.part_from_head(frame);
        View {
            accel: &self.accel,
            surface: scene.surface,
            laser: &scene.laser,
            part_from_laser: part_from_head * scene.head_from_laser,
            camera: &scene.camera,
            part_from_camera: part_from_head * scene.head_from_camera,
            speckle: self.speckle.as_ref().map(|lookup| Speckle {
                lookup,
                texels_per_pixel: TEXELS_PER_SPECKLE / self.plan.speckle_size_px,
            }),
            samples_per_side: self.plan.samples_per_side,
        }
    }

    /// Irradiance on the sensor in a frame, mW/mm².
    pub fn irradiance(&self, frame: u32) -> Vec<f32> {
        let view = self.view(frame);
        match &self.clusters {
            Some(clusters) => footprint_image(&view, clusters),
            None => irradiance_image(&view),
        }
    }

    /// What the sensor makes of an irradiance image.
    pub fn counts(&self, frame: u32, irradiance: &[f32]) -> Vec<u16> {
        let sensor = &self.scene.camera.sensor;
        let electrons = sensor.electrons_per_irradiance(self.scene.laser.beam.wavelength);
        let key = Key::new(self.scene.seed, Purpose::SensorNoise).with(frame as u64);
        let pixel = |i: usize| key.with(i as u64);
        let group = |i: usize| key.with(DARK).with((i / DARK_GROUP) as u64);
        let mut counts = vec![0; irradiance.len()];
        counts
            .par_chunks_mut(DARK_GROUP)
            .zip(irradiance.par_chunks(DARK_GROUP))
            .enumerate()
            .with_min_len(1024)
            .for_each(|(chunk, (counts, irradiance))| {
                let first = chunk * DARK_GROUP;
                let is_dark = |i: usize| irradiance[i] == 0.0;
                if let Some(dark) = &self.dark {
                    dark.draw(counts, is_dark, group(first), |i| pixel(first + i));
                }
                for (i, (count, &e)) in counts.iter_mut().zip(irradiance).enumerate() {
                    if self.dark.is_none() || e != 0.0 {
                        *count = sensor.count(e as f64 * electrons, pixel(first + i));
                    }
                }
            });
        counts
    }

    /// What the measurement knows of the sensor.
    pub fn calibration(&self) -> Calibration {
        let camera_from_laser = camera_from_laser(self.scene);
        Calibration {
            camera: self.scene.camera.clone(),
            plane_point: camera_from_laser.translation,
            plane_normal: camera_from_laser.rotation.y_axis,
        }
    }

    /// The profile in an image and its points on the part.
    pub fn measure(&self, frame: u32, counts: &[u16]) -> (Vec<Peak>, Vec<CloudPoint>) {
        let Camera { sensor, .. } = &self.scene.camera;
        let calibration = self.calibration();
        let part_from_camera = self.view(frame).part_from_camera;
        let peaks = find_peaks(counts, sensor.resolution.x as usize);
        let points = peaks
            .iter()
            .filter_map(|peak| {
                let position = part_from_camera.point(calibration.point(peak)?);
                Some(CloudPoint {
                    position,
                    deviation: signed_distance(&self.accel, position, part_from_camera.translation),
                    intensity: peak.intensity,
                    frame,
                    column: peak.column,
                })
            })
            .collect();
        (peaks, points)
    }
}

fn camera_from_laser(scene: &Scene) -> Rigid {
    scene.head_from_camera.inverse() * scene.head_from_laser
}

/// The plan for a scene, with the head in the middle of its way.
pub fn plan(scene: &Scene) -> Plan {
    let laser_from_part =
        (scene.part_from_head(scene.scan.frames / 2) * scene.head_from_laser).inverse();
    let corners = scene.mesh.bounds().corners();
    Plan::new(
        &scene.laser,
        &scene.camera,
        &camera_from_laser(scene),
        &Aabb::of(corners.map(|c| laser_from_part.point(c))),
        scene.speckle,
    )
}
