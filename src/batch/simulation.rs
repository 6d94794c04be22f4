//! A scene made ready to take frames: hierarchy built, plan made, speckle
//! patterns computed. Each frame depends on its number alone.

use super::forecast;
use super::measure::error_model;
use super::planner;
use super::scan_speckle::{ScanSpeckle, step_of_speckle};
use super::surface_view::surface_view;
use crate::accel::{Accel, Clusters};
use crate::camera::{Counts, DarkCounts, Sensor};
use crate::error::Result;
use crate::integrator::accuracy::geometry_only;
use crate::integrator::in_view::{InView, Optics};
use crate::integrator::plan::{ExposureMotion, SpeckleOptics};
use crate::integrator::{
    Irradiance, Plan, Sheet, View, footprint_image, irradiance_image, lit_columns, strip_image,
};
use crate::math::Rigid;
use crate::math::rng::{Key, Purpose};
use crate::mesh::Watch;
use crate::profile::{Calibration, ErrorModel, Peak};
use crate::scene::{Scene, SpeckleModel};
use crate::speckle::lookup::Method;
use std::ops::Range;
use std::sync::Arc;

pub struct Simulation<'s> {
    pub scene: &'s Scene,
    pub accel: Arc<Accel<'s>>,
    pub plan: Plan,
    /// What the measurement knows of the sensor.
    pub calibration: Calibration,
    speckle: Option<Arc<ScanSpeckle>>,
    /// `None`: every sample is traced.
    clusters: Option<Arc<Clusters>>,
    /// The scene's, without noise if the plan leaves it out.
    sensor: Sensor,
    /// `None`: dark counts are all the same.
    dark: Option<DarkCounts>,
    pub(super) errors: ErrorModel,
    /// `None`: profiles come from images.
    pub(super) sheet: Option<Sheet>,
}

/// Tells the key of the groups of dark pixels from those of pixels: no sensor has
/// as many.
const DARK: u64 = u64::MAX;

/// Builds the hierarchy a scene asks for; `watch` hears how far that is.
pub(super) fn hierarchy<'s>(scene: &'s Scene, watch: &Watch) -> Result<Accel<'s>> {
    let threads = rayon::current_num_threads();
    Accel::build_with(scene.accel, &scene.mesh, threads, watch)?.with_copies(&scene.copies)
}

impl<'s> Simulation<'s> {
    pub fn new(scene: &'s Scene) -> Result<Simulation<'s>> {
        Simulation::of_footprint(scene, hierarchy(scene, &|_| Ok(()))?)
    }

    pub(super) fn of_footprint(scene: &'s Scene, accel: Accel<'s>) -> Result<Simulation<'s>> {
        let simulation = Simulation::of_everything(scene, accel)?;
        Ok(simulation.with_clusters(Arc::new(Clusters::new(&scene.mesh))))
    }

    /// The same, tracing only what may see lit surface.
    pub(super) fn with_clusters(self, clusters: Arc<Clusters>) -> Simulation<'s> {
        Simulation {
            clusters: Some(clusters),
            ..self
        }
    }

    /// One that traces every sample, to the same bytes.
    pub fn exhaustive(scene: &'s Scene) -> Result<Simulation<'s>> {
        Simulation::of_everything(scene, hierarchy(scene, &|_| Ok(()))?)
    }

    pub(super) fn of_everything(scene: &'s Scene, accel: Accel<'s>) -> Result<Simulation<'s>> {
        let accel = Arc::new(accel);
        let plan = planner::scene_plan_with(scene, &accel)?;
        Simulation::with_plan(scene, accel, plan)
    }

    /// One that takes no images, only [`Self::geometric`] profiles of a line laser.
    pub fn geometry(scene: &'s Scene) -> Result<Simulation<'s>> {
        let accel = hierarchy(scene, &|_| Ok(()))?;
        Simulation::of_geometry(scene, accel)
    }

    pub(super) fn of_geometry(scene: &'s Scene, accel: Accel<'s>) -> Result<Simulation<'s>> {
        let plan = geometry_only(plan(scene, &accel));
        Simulation::with_plan(scene, Arc::new(accel), plan)
    }

    /// One that does what `plan` says.
    pub(super) fn with_plan(
        scene: &'s Scene,
        accel: Arc<Accel<'s>>,
        plan: Plan,
    ) -> Result<Simulation<'s>> {
        if !plan.geometry_only {
            forecast::require_images(scene, 1)?;
        }
        let speckle = match (&scene.speckle, plan.speckle) {
            (Some(model), Some(method)) => {
                let model = SpeckleModel { method, ..*model };
                let patterns = ScanSpeckle::new(scene, &accel, &model, plan.speckle_slips)?;
                Some(Arc::new(patterns))
            }
            _ => None,
        };
        Ok(Simulation::with_patterns(scene, accel, plan, speckle))
    }

    /// The same done by another plan; patterns of speckle are shared where both have the
    /// same.
    pub(super) fn otherwise(&self, plan: Plan) -> Result<Simulation<'s>> {
        let patterns = |plan: &Plan| (plan.speckle, plan.speckle_slips);
        let other = if plan.speckle.is_none() || patterns(&plan) == patterns(&self.plan) {
            let shared = self.speckle.clone().filter(|_| plan.speckle.is_some());
            Simulation::with_patterns(self.scene, self.accel.clone(), plan, shared)
        } else {
            Simulation::with_plan(self.scene, self.accel.clone(), plan)?
        };
        Ok(Simulation {
            clusters: self.clusters.clone(),
            ..other
        })
    }

    fn with_patterns(
        scene: &'s Scene,
        accel: Arc<Accel<'s>>,
        plan: Plan,
        speckle: Option<Arc<ScanSpeckle>>,
    ) -> Simulation<'s> {
        let mut sensor = scene.camera.sensor.clone();
        sensor.noise = sensor.noise.filter(|_| plan.noise);
        let sheet = |fan| Sheet::new(fan, &scene.camera, &camera_from_laser(scene));
        Simulation {
            scene,
            accel,
            calibration: scene
                .calibration
                .clone()
                .unwrap_or_else(|| perfect_calibration(scene)),
            speckle,
            clusters: None,
            dark: DarkCounts::new(&sensor),
            sensor,
            errors: error_model(scene),
            sheet: scene
                .laser
                .fan
                .as_ref()
                .filter(|_| plan.geometry_only)
                .map(sheet),
            plan,
        }
    }

    /// Bytes of the patterns of speckle.
    pub(super) fn speckle_memory(&self) -> usize {
        self.speckle.as_ref().map_or(0, |speckle| speckle.memory())
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
            speckle: (self.speckle.as_ref())
                .map(|speckle| speckle.at(scene, place, &part_from_head)),
            samples_per_side: self.plan.samples_per_side,
            sampling: self.plan.sampling,
            cutoff_radii: self.plan.cutoff_radii,
        }
    }

    /// The light on the sensor in a frame, the mean over the poses of its exposure.
    pub fn irradiance(&self, frame: u32) -> Irradiance {
        self.mean(frame, |view| match &self.clusters {
            Some(clusters) => footprint_image(view, clusters),
            None => irradiance_image(view),
        })
    }

    /// The same in these columns alone, and dark elsewhere; of one that traces the
    /// footprint.
    pub(super) fn strip(&self, frame: u32, columns: &Range<usize>) -> Irradiance {
        let clusters = self.clusters.as_ref().expect("it traces the footprint");
        self.mean(frame, |view| strip_image(view, clusters, columns))
    }

    /// From the first column that may be lit in a frame to the last.
    pub(super) fn lit_columns(&self, frame: u32) -> Option<Range<usize>> {
        lit_columns(&self.view(frame), self.clusters.as_ref()?)
    }

    /// How many columns may be lit in a frame: all of them if every sample is traced.
    pub(super) fn columns_at_most(&self, frame: u32) -> usize {
        match &self.clusters {
            Some(_) => self.lit_columns(frame).map_or(0, |columns| columns.len()),
            None => self.scene.camera.sensor.resolution.x as usize,
        }
    }

    fn mean(&self, frame: u32, image: impl Fn(&View) -> Irradiance) -> Irradiance {
        let places = self.scene.scan.exposure_places(frame);
        let images = places.map(|place| image(&self.view_at(place)));
        Irradiance::mean(images.collect())
    }

    /// The lines of a frame, from its image or, if the plan takes none, from geometry.
    pub(super) fn frame_peaks(&self, frame: u32) -> Vec<Peak> {
        match self.plan.geometry_only {
            true => self.geometric_peaks(frame).0,
            false => self.peaks(&self.counts(frame, &self.irradiance(frame))).0,
        }
    }

    /// What the sensor makes of the light.
    pub fn counts(&self, frame: u32, irradiance: &Irradiance) -> Counts {
        let sensor = &self.sensor;
        let electrons = sensor.electrons_per_irradiance(self.scene.laser.beam.wavelength);
        let key = Key::new(self.scene.seed, Purpose::SensorNoise).with(frame as u64);
        let (columns, rows) = (irradiance.columns(), irradiance.rows());
        let mut image = match &self.dark {
            None => Counts::filled(columns, rows, sensor.count(0.0, key)),
            Some(dark) => Counts::of_columns(dark.draw(columns * rows, key.with(DARK)), rows),
        };
        let counts = image.by_column_mut();
        for row in 0..rows {
            for (column, e) in irradiance.row(row).filter(|&(_, e)| e != 0.0) {
                let pixel = key.with((row * columns + column) as u64);
                counts[column * rows + row] = sensor.count(e as f64 * electrons, pixel);
            }
        }
        image
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

/// What of the part the laser lights and the camera sees along the path, in which of its
/// frames; empty if never.
pub fn part_in_view(scene: &Scene, accel: &Accel) -> InView {
    let part_from_laser = |frame| scene.part_from_head(frame) * scene.head_from_laser;
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    InView::along(&optics, accel, scene.scan.frames, part_from_laser)
}

fn optics<'a>(scene: &'a Scene, camera_from_laser: &'a Rigid) -> Optics<'a> {
    Optics {
        laser: &scene.laser,
        camera: &scene.camera,
        camera_from_laser,
    }
}

/// The plan for what the sensor sees of the part; where that is nothing, for all that it
/// could see.
pub(super) fn plan(scene: &Scene, accel: &Accel) -> Plan {
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    let mut places = part_in_view(scene, accel).places;
    if places.is_empty() {
        places = optics.overlap();
    }
    Plan::new(
        &optics,
        &places,
        exposure_motion(scene),
        scene.speckle.as_ref().map(|s| SpeckleOptics {
            method: s.method,
            aperture: s.aperture,
            contrast: s.coherence.contrast(),
            step: step_of_speckle(scene, s.method == Method::Field),
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
