//! A scene made ready to take frames: hierarchy built, plan made, speckle
//! patterns computed. Each frame depends on its number alone.

use crate::accel::{Accel, Clusters};
use crate::camera::{Camera, DARK_GROUP, DarkCounts};
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::deviation::signed_distance;
use crate::integrator::plan::SpeckleOptics;
use crate::integrator::{Plan, Speckle, View, footprint_image, irradiance_image};
use crate::math::rng::{Key, Purpose};
use crate::math::{Aabb, DVec2, DVec3, Rigid};
use crate::profile::{Calibration, Peak, find_peaks};
use crate::scene::{Scene, SpeckleModel};
use crate::speckle::anchor::PoseAnchor;
use crate::speckle::coordinate::GrainMap;
use crate::speckle::lookup::{Lookup, Method};
use crate::speckle::motion::{Source, SurfaceView};
use crate::speckle::pattern::{Aperture, PatternSpec};
use rayon::prelude::*;

pub struct Simulation<'s> {
    pub scene: &'s Scene,
    pub accel: Accel<'s>,
    pub plan: Plan,
    speckle: Option<Patterns>,
    /// `None`: every sample is traced.
    clusters: Option<Clusters>,
    /// `None`: dark counts are all the same.
    dark: Option<DarkCounts>,
}

/// Tells the keys of groups of dark pixels from those of pixels: no sensor has as
/// many.
const DARK: u64 = u64::MAX;

/// Speckle of a scan: the patterns, how they lie over the sensor, and how they
/// follow the part.
struct Patterns {
    lookup: Lookup,
    map: GrainMap,
    per_pixel: bool,
    anchor: PoseAnchor,
}

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
        Ok(Simulation {
            scene,
            accel: Accel::build_with(scene.accel, &scene.mesh, rayon::current_num_threads())?,
            plan,
            speckle: match &scene.speckle {
                Some(model) => Some(Patterns::new(scene, model)?),
                None => None,
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
            speckle: self.speckle.as_ref().map(|p| p.in_frame(&part_from_head)),
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

/// The patterns of a scan: ten slices a pupil diameter, 270 MB as fields.
pub(super) fn scan_patterns(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        slices: 32,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

impl Patterns {
    fn new(scene: &Scene, model: &SpeckleModel) -> Result<Patterns> {
        let spec = scan_patterns(scene.seed, model.aperture);
        let wavelength = scene.laser.beam.wavelength;
        let reference = scene.part_from_head(0);
        Ok(Patterns {
            lookup: Lookup::new(&spec, model.method, model.coherence)?,
            map: GrainMap::new(
                spec.texels_per_speckle,
                scene.camera.speckle_size(wavelength),
                scene.camera.speckle_size_gradient(wavelength),
            ),
            per_pixel: matches!(model.method, Method::Prefiltered { .. }),
            anchor: PoseAnchor::new(
                surface_view(scene, None),
                reference.inverse().rotation,
                scene.scan.step,
            ),
        })
    }

    fn in_frame(&self, part_from_head: &Rigid) -> Speckle<'_> {
        let at = self.anchor.coordinate(part_from_head);
        Speckle {
            lookup: &self.lookup,
            map: self.map,
            per_pixel: self.per_pixel,
            // The view's second axis points up, the sensor's rows go down.
            displacement: DVec2::new(at.sensor.x, -at.sensor.y),
            slice: at.u * self.lookup.slices_per_diameter(),
        }
    }
}

/// The view of `point` (head's frame) on a surface across the beam; by default the
/// point in the middle of the field, where the optical axis meets the laser plane
/// (the plane of focus, if nowhere).
pub(super) fn surface_view(scene: &Scene, point: Option<DVec3>) -> SurfaceView {
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
        scene.speckle.as_ref().map(|s| SpeckleOptics {
            per_pixel: matches!(s.method, Method::Prefiltered { .. }),
            aperture: s.aperture,
            contrast: s.coherence.contrast(),
        }),
    )
}
