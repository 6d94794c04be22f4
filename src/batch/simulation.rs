//! A scene made ready to take frames: hierarchy built, plan made, speckle
//! patterns computed. Each frame depends on its number alone.

use super::measure::error_model;
use crate::accel::{Accel, Clusters};
use crate::camera::{DARK_GROUP, DarkCounts};
use crate::error::Result;
use crate::integrator::plan::{ExposureMotion, SpeckleOptics};
use crate::integrator::{Plan, Sheet, Speckle, View, footprint_image, irradiance_image};
use crate::math::rng::{Key, Purpose};
use crate::math::{Aabb, DVec2, DVec3, Rigid};
use crate::profile::{Calibration, ErrorModel};
use crate::scene::{Motion, Moves, Scene, SpeckleModel};
use crate::speckle::anchor::PoseAnchor;
use crate::speckle::coordinate::GrainMap;
use crate::speckle::lookup::{Lookup, Method};
use crate::speckle::motion::{Source, SurfaceView};
use crate::speckle::path::PathAnchor;
use crate::speckle::pattern::{Aperture, PatternSpec};
use rayon::prelude::*;

pub struct Simulation<'s> {
    pub scene: &'s Scene,
    pub accel: Accel<'s>,
    pub plan: Plan,
    /// What the measurement knows of the sensor.
    pub calibration: Calibration,
    speckle: Option<Patterns>,
    /// `None`: every sample is traced.
    clusters: Option<Clusters>,
    /// `None`: dark counts are all the same.
    dark: Option<DarkCounts>,
    pub(super) errors: ErrorModel,
    /// `None`: profiles come from images.
    pub(super) sheet: Option<Sheet>,
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
    anchor: Anchor,
}

enum Anchor {
    /// Nothing turns: exact over any length.
    Pose(Box<PoseAnchor>),
    Path(PathAnchor),
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
        let patterns = scene.speckle.as_ref();
        Ok(Simulation {
            speckle: patterns
                .map(|model| Patterns::new(scene, model))
                .transpose()?,
            ..Simulation::measuring(scene)?
        })
    }

    /// One that takes no images, only [`Self::geometric`] profiles of a line laser.
    pub fn geometry(scene: &'s Scene) -> Result<Simulation<'s>> {
        let sheet = |fan| Sheet::new(fan, &scene.camera, &camera_from_laser(scene));
        Ok(Simulation {
            sheet: scene.laser.fan.as_ref().map(sheet),
            ..Simulation::measuring(scene)?
        })
    }

    fn measuring(scene: &'s Scene) -> Result<Simulation<'s>> {
        Ok(Simulation {
            scene,
            accel: Accel::build(&scene.mesh, rayon::current_num_threads())?,
            plan: plan(scene),
            calibration: scene
                .calibration
                .clone()
                .unwrap_or_else(|| perfect_calibration(scene)),
            speckle: None,
            clusters: None,
            dark: DarkCounts::new(&scene.camera.sensor),
            errors: error_model(scene),
            sheet: None,
        })
    }

    pub fn view(&self, frame: u32) -> View<'_> {
        self.view_at(frame as f64)
    }

    /// The view at a place on the path, a frame number or between two.
    fn view_at(&self, place: f64) -> View<'_> {
        let scene = self.scene;
        let part_from_head = scene.part_from_head_at(place);
        View {
            accel: &self.accel,
            surface: scene.surface,
            laser: &scene.laser,
            part_from_laser: part_from_head * scene.head_from_laser,
            camera: &scene.camera,
            part_from_camera: part_from_head * scene.head_from_camera,
            speckle: self.speckle.as_ref().map(|p| p.at(place, &part_from_head)),
            samples_per_side: self.plan.samples_per_side,
        }
    }

    /// Irradiance on the sensor in a frame, mW/mm², the mean over the poses of its
    /// exposure.
    pub fn irradiance(&self, frame: u32) -> Vec<f32> {
        let image = |place| {
            let view = self.view_at(place);
            match &self.clusters {
                Some(clusters) => footprint_image(&view, clusters),
                None => irradiance_image(&view),
            }
        };
        let mut places = self.scene.scan.exposure_places(frame);
        let mut mean = image(places.next().expect("an exposure has a pose"));
        let share = 1.0 / self.scene.scan.exposure_poses as f32;
        if share < 1.0 {
            mean.iter_mut().for_each(|e| *e *= share);
        }
        for place in places {
            for (mean, e) in mean.iter_mut().zip(image(place)) {
                *mean += e * share;
            }
        }
        mean
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
        Ok(Patterns {
            lookup: Lookup::new(&spec, model.method, model.coherence)?,
            map: GrainMap::new(
                spec.texels_per_speckle,
                scene.camera.speckle_size(wavelength),
                scene.camera.speckle_size_gradient(wavelength),
            ),
            per_pixel: matches!(model.method, Method::Prefiltered { .. }),
            anchor: anchor(scene),
        })
    }

    fn at(&self, place: f64, part_from_head: &Rigid) -> Speckle<'_> {
        let at = match &self.anchor {
            Anchor::Pose(anchor) => anchor.coordinate(part_from_head),
            Anchor::Path(anchor) => anchor.coordinate(place),
        };
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

/// How the patterns follow the part along the scene's path.
fn anchor(scene: &Scene) -> Anchor {
    let view = surface_view(scene, None);
    let scan = &scene.scan;
    let first = scene.part_from_head(0);
    let ways = |frame| {
        first
            .inverse()
            .vector(scene.part_from_head(frame).translation - first.translation)
    };
    let direction = match &scan.motion {
        _ if scan.turns() => {
            // A rotary table turns alike from each frame to the next.
            let frames = match scan.motion {
                Motion::Rotary { .. } => 2,
                _ => scan.frames,
            };
            let poses = (0..frames).map(|frame| scene.part_from_head(frame));
            return Anchor::Path(PathAnchor::new(view, poses));
        }
        Motion::Linear { step } if scan.moves == Moves::Head => *step,
        Motion::Linear { step } => -*step,
        // The farthest from the first: the last may be there again.
        _ => (0..scan.frames)
            .map(ways)
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
            .unwrap_or(DVec3::ZERO),
    };
    let anchor = PoseAnchor::new(view, first.inverse().rotation, direction);
    Anchor::Pose(Box::new(anchor))
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

/// The true values of a scene's sensor.
pub(super) fn perfect_calibration(scene: &Scene) -> Calibration {
    let camera_from_laser = camera_from_laser(scene);
    Calibration::perfect(
        scene.camera.model(),
        scene.head_from_camera,
        camera_from_laser.translation,
        camera_from_laser.rotation.y_axis,
    )
}

fn camera_from_laser(scene: &Scene) -> Rigid {
    scene.head_from_camera.inverse() * scene.head_from_laser
}

/// The plan for a scene: with the head in the middle of its way, and on a path that
/// turns or wanders at nine places along it, since there the middle stands for no
/// other.
pub fn plan(scene: &Scene) -> Plan {
    let scan = &scene.scan;
    let corners = scene.mesh.bounds().corners();
    let places = match scan.motion {
        Motion::Linear { .. } => 1,
        _ => 9,
    };
    let boxes: Vec<Aabb> = (1..=places)
        .map(|i| {
            let frame = (scan.frames as u64 * i / (places + 1)) as u32;
            let laser_from_part = (scene.part_from_head(frame) * scene.head_from_laser).inverse();
            Aabb::of(corners.map(|c| laser_from_part.point(c)))
        })
        .collect();
    Plan::new(
        &scene.laser,
        &scene.camera,
        &camera_from_laser(scene),
        &boxes,
        exposure_motion(scene),
        scene.speckle.as_ref().map(|s| SpeckleOptics {
            per_pixel: matches!(s.method, Method::Prefiltered { .. }),
            aperture: s.aperture,
            contrast: s.coherence.contrast(),
        }),
    )
}

/// How far the middle of the field goes over the part in one exposure.
fn exposure_motion(scene: &Scene) -> Option<ExposureMotion> {
    let half = scene.scan.exposure_share? / 2.0;
    let middle = (scene.scan.frames / 2) as f64;
    let point = surface_view(scene, None).point;
    let at = |place| scene.part_from_head_at(place).point(point);
    Some(ExposureMotion {
        way: at(middle + half).distance(at(middle - half)),
        poses: scene.scan.exposure_poses,
    })
}
