//! A scene made ready to take frames: hierarchy built, plan made, speckle
//! patterns computed. Each frame depends on its number alone.

use super::error_model::{camera_from_laser, error_model, perfect_calibration};
use super::need;
use super::scan_speckle::{ScanSpeckle, steps_of_speckle};
use super::surface_view::surface_view;
use crate::accel::{Accel, Clusters};
use crate::camera::{Counts, NearLight, Sensor};
use crate::error::Result;
use crate::frame::{
    self, Ghosts, Grid, Indirect, Irradiance, Readout, Reflections, Region, Sheet, Truth, View,
};
use crate::math::Rigid;
use crate::math::rng::{Key, Purpose};
use crate::plan::in_view::{InView, Optics};
use crate::plan::rules::Plan;
use crate::plan::rules::{ExposureMotion, SpeckleOptics};
use crate::profile::{Calibration, ErrorModel, FrameStep, Peak};
use crate::scene::{Scene, SpeckleModel};
use crate::speckle::lookup::Method;
use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

/// A frame and where the head is in the middle of it: computed once, and handed on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pose {
    pub frame: u32,
    pub part_from_head: Rigid,
}

/// A scene made ready: everything its frames share. Threads may share it, and each frame
/// depends on its number alone.
pub struct Simulation {
    /// What is simulated.
    pub scene: Scene,
    /// Rays against the part; clones share one hierarchy.
    pub accel: Arc<Accel>,
    /// Which effects are modelled, and how.
    #[doc(hidden)]
    pub plan: Plan,
    /// What the measurement knows of the sensor.
    #[doc(hidden)]
    pub calibration: Calibration,
    speckle: Option<Arc<ScanSpeckle>>,
    /// `None`: every sample is traced.
    clusters: Option<Arc<Clusters>>,
    /// The scene's sensor, without noise if the plan leaves it out.
    readout: Readout,
    pub(crate) errors: Arc<ErrorModel>,
    /// Worked out where it is first asked for.
    pub(crate) column_correlation: OnceLock<Vec<f64>>,
    pub(crate) scan_steps: OnceLock<(Vec<FrameStep>, f64)>,
    /// `None`: profiles come from images.
    pub(crate) sheet: Option<Sheet>,
    /// Ends frames that nobody waits for; see [`frame::unless_stopped`].
    pub(super) stop: Option<Arc<AtomicBool>>,
}

impl Simulation {
    /// The same, tracing only what may see lit surface.
    pub(crate) fn with_clusters(self, clusters: Arc<Clusters>) -> Simulation {
        Simulation {
            clusters: Some(clusters),
            ..self
        }
    }

    /// One that does what `plan` says.
    pub(crate) fn with_plan(scene: &Scene, accel: Arc<Accel>, plan: Plan) -> Result<Simulation> {
        let speckle = patterns(scene, &accel, &plan)?;
        let errors = Arc::new(error_model(scene, plan.blur));
        Ok(Simulation::with_patterns(
            scene, accel, plan, speckle, errors,
        ))
    }

    /// The same by the same plan with speckle, noise and patterns of pixels of another seed.
    pub(crate) fn with_seed(&self, seed: u64) -> Result<Simulation> {
        let scene = Scene {
            seed,
            ..self.scene.clone()
        };
        let plan = self.plan.clone();
        Ok(Simulation {
            accel: self.accel.clone(),
            calibration: self.calibration.clone(),
            speckle: patterns(&scene, &self.accel, &plan)?,
            clusters: self.clusters.clone(),
            readout: readout(&scene, &plan),
            errors: self.errors.clone(),
            column_correlation: self.column_correlation.clone(),
            scan_steps: self.scan_steps.clone(),
            sheet: sheet(&scene, &plan),
            stop: self.stop.clone(),
            scene,
            plan,
        })
    }

    /// The same done by another plan; patterns of speckle are shared where both have the
    /// same.
    pub(crate) fn otherwise(&self, plan: Plan) -> Result<Simulation> {
        let patterns = |plan: &Plan| (plan.speckle, plan.speckle_slips, plan.wider());
        let other = if plan.speckle.is_none() || patterns(&plan) == patterns(&self.plan) {
            let shared = self.speckle.clone().filter(|_| plan.speckle.is_some());
            let errors = Arc::new(error_model(&self.scene, plan.blur));
            Simulation::with_patterns(&self.scene, self.accel.clone(), plan, shared, errors)
        } else {
            Simulation::with_plan(&self.scene, self.accel.clone(), plan)?
        };
        Ok(other.with_clusters_of(self))
    }

    /// The same, tracing what another of the same part traces.
    pub(crate) fn with_clusters_of(self, other: &Simulation) -> Simulation {
        Simulation {
            clusters: other.clusters.clone(),
            ..self
        }
    }

    pub(super) fn with_patterns(
        scene: &Scene,
        accel: Arc<Accel>,
        plan: Plan,
        speckle: Option<Arc<ScanSpeckle>>,
        errors: Arc<ErrorModel>,
    ) -> Simulation {
        Simulation {
            scene: scene.clone(),
            accel,
            calibration: scene
                .calibration
                .clone()
                .unwrap_or_else(|| perfect_calibration(scene)),
            speckle,
            clusters: None,
            readout: readout(scene, &plan),
            errors,
            column_correlation: OnceLock::new(),
            scan_steps: OnceLock::new(),
            sheet: sheet(scene, &plan),
            stop: None,
            plan,
        }
    }

    /// Bytes of the patterns of speckle.
    pub(crate) fn speckle_memory(&self) -> usize {
        self.speckle.as_ref().map_or(0, |speckle| speckle.memory())
    }

    /// Where the head is in the middle of a frame.
    pub(crate) fn pose(&self, frame: u32) -> Pose {
        Pose {
            frame,
            part_from_head: self.scene.part_from_head(frame),
        }
    }

    /// What `frame` is taken of, at the middle of its exposure.
    #[doc(hidden)]
    pub fn view(&self, frame: u32) -> View<'_> {
        self.view_of(&self.pose(frame))
    }

    pub(crate) fn view_of(&self, pose: &Pose) -> View<'_> {
        self.view_at(pose.frame as f64, pose.part_from_head)
    }

    /// The view at a place on the path, a frame number or between two, where the head is there.
    fn view_at(&self, place: f64, part_from_head: Rigid) -> View<'_> {
        let scene = &self.scene;
        let per_side = self.plan.samples_per_side;
        View {
            accel: &self.accel,
            surface: scene.surface.clone(),
            laser: &scene.laser,
            part_from_laser: part_from_head * scene.head_from_laser,
            camera: &scene.camera,
            part_from_camera: part_from_head * scene.head_from_camera,
            speckle: (self.speckle.as_ref())
                .map(|speckle| speckle.at(scene, place, &part_from_head)),
            grid: Grid::Gauss { per_side },
            lens: self.plan.lens_blur(),
            indirect: self.indirect(place),
            sampling: self.plan.sampling,
            cutoff_radii: self.plan.cutoff_radii,
            stop: self.stop.as_deref(),
        }
    }

    /// Of light that is reflected more than once, at a place on the path.
    fn indirect(&self, place: f64) -> Option<Indirect> {
        let poses = self.scene.scan.exposure_poses;
        let of_exposure = self.plan.reflections?;
        Some(Indirect {
            reflections: Reflections {
                from_laser: of_exposure.from_laser.div_ceil(poses),
                per_pixel: of_exposure.per_pixel / poses as f64,
                ..of_exposure
            },
            key: Key::new(self.scene.seed, Purpose::Reflections).with(place.to_bits()),
            coherence_length: self.scene.coherence_length_mm.unwrap_or(f64::INFINITY),
        })
    }

    /// The views of one exposure.
    fn views(&self, &pose: &Pose) -> impl Iterator<Item = View<'_>> + use<'_> {
        let places = self.scene.scan.exposure_places(pose.frame);
        places.map(move |place| match place == pose.frame as f64 {
            true => self.view_of(&pose),
            false => self.view_at(place, self.scene.part_from_head_at(place)),
        })
    }

    /// Where light is sought: in what may see lit surface, or everywhere.
    fn region(&self) -> Region<'_> {
        (self.clusters.as_ref()).map_or(Region::All, |clusters| Region::Lit(clusters))
    }

    /// The light on the sensor in a frame, the mean over the poses of its exposure.
    #[doc(hidden)]
    pub fn irradiance(&self, frame: u32) -> Irradiance {
        self.mean(frame, &self.region())
    }

    /// The mean light of a frame that is reflected more than once, at the middle of its exposure; of a plan that
    /// follows it.
    pub(crate) fn ghosts(&self, frame: u32) -> Irradiance {
        let view = self.view(frame);
        let indirect = view.indirect.expect("the plan follows it");
        frame::ghosts(&view, &Region::All, &indirect).mean
    }

    /// The mean light of a frame without speckle: reflected once, and more than once.
    #[doc(hidden)]
    pub fn shares(&self, frame: u32) -> [Irradiance; 2] {
        let (pose, region) = (self.pose(frame), self.region());
        let shares = self.views(&pose).map(|view| frame::shares(&view, &region));
        let (direct, ghosts) = shares.map(|[direct, ghosts]| (direct, ghosts)).unzip();
        [direct, ghosts].map(Irradiance::mean)
    }

    /// The same in these columns alone, and dark elsewhere, of one that traces the footprint; with what
    /// [`strip_ghosts`](Self::strip_ghosts) found there.
    pub(crate) fn strip(
        &self,
        frame: u32,
        columns: &Range<usize>,
        ghosts: &[Ghosts],
    ) -> Irradiance {
        let (pose, region) = (self.pose(frame), self.columns_alone(columns));
        let images = (self.views(&pose).enumerate())
            .map(|(i, view)| frame::irradiance_with(&view, &region, ghosts.get(i)));
        Irradiance::mean(images.collect())
    }

    /// Light that is reflected more than once in these columns, at each pose of the exposure, by so many times the
    /// plan's paths; empty if the plan follows none.
    pub(crate) fn strip_ghosts(
        &self,
        frame: u32,
        columns: &Range<usize>,
        times: f64,
    ) -> Vec<Ghosts> {
        let (pose, region) = (self.pose(frame), self.columns_alone(columns));
        let ghosts = |view: View| {
            let indirect = view.indirect?;
            let reflections = indirect.reflections.times(times);
            let indirect = Indirect {
                reflections,
                ..indirect
            };
            Some(frame::ghosts(&view, &region, &indirect))
        };
        self.views(&pose).filter_map(ghosts).collect()
    }

    fn columns_alone(&self, columns: &Range<usize>) -> Region<'_> {
        let clusters = self.clusters.as_ref().expect("it traces the footprint");
        Region::Columns(clusters, columns.clone())
    }

    /// From the first column that may be lit in a frame to the last.
    pub(crate) fn lit_columns(&self, frame: u32) -> Option<Range<usize>> {
        let clusters = self.clusters.as_ref()?;
        frame::footprint(&self.view(frame), &Region::Lit(clusters)).span()
    }

    /// How many columns may be lit in a frame: all of them if every sample is traced.
    pub(crate) fn columns_at_most(&self, frame: u32) -> usize {
        match &self.clusters {
            Some(_) => self.lit_columns(frame).map_or(0, |columns| columns.len()),
            None => self.scene.camera.sensor.resolution.x as usize,
        }
    }

    fn mean(&self, frame: u32, region: &Region) -> Irradiance {
        let pose = self.pose(frame);
        let images = self.views(&pose);
        let images = images.map(|view| frame::irradiance(&view, region));
        Irradiance::mean(images.collect())
    }

    /// The lines of a frame, from its image or, if the plan takes none, from geometry.
    pub(crate) fn frame_peaks(&self, frame: u32) -> Vec<Peak> {
        match self.plan.geometry_only {
            true => self.geometric_peaks(&self.pose(frame)).0,
            false => self.peaks(&self.image_of(&self.pose(frame))).0,
        }
    }

    fn noise(&self, frame: u32) -> Key {
        Key::new(self.scene.seed, Purpose::SensorNoise).with(frame as u64)
    }

    /// What the sensor makes of the light.
    #[doc(hidden)]
    pub fn counts(&self, frame: u32, irradiance: &Irradiance) -> Counts {
        self.readout.counts(irradiance, self.noise(frame))
    }

    /// Returns the counts of a sensor without noise under the light.
    pub(crate) fn counts_without_noise(&self, irradiance: &Irradiance) -> Counts {
        let sensor = Sensor {
            noise: None,
            ..self.scene.camera.sensor.clone()
        };
        let readout = Readout::new(sensor, self.scene.laser.beam.wavelength, self.scene.seed);
        readout.counts(irradiance, Key::new(self.scene.seed, Purpose::SensorNoise))
    }

    /// The same near the light alone.
    #[doc(hidden)]
    pub fn counts_near_light(&self, frame: u32, irradiance: &Irradiance) -> NearLight {
        self.readout.near_light(irradiance, self.noise(frame))
    }

    /// What each pixel's centre looks at in a frame: depth, position, normal, triangle.
    pub fn truth(&self, frame: u32) -> Truth {
        frame::truth_layers(&self.view(frame))
    }

    /// The image that the sensor takes.
    pub fn image(&self, frame: u32) -> Counts {
        self.image_of(&self.pose(frame)).into_counts()
    }

    /// The same, drawn near its light alone.
    pub(crate) fn image_of(&self, pose: &Pose) -> NearLight {
        let (region, key) = (self.region(), self.noise(pose.frame));
        frame::take(self.views(pose), &region, &self.readout, key)
    }
}

/// The patterns of speckle that a plan asks for. Errors: no image fits into memory.
pub(super) fn patterns(
    scene: &Scene,
    accel: &Accel,
    plan: &Plan,
) -> Result<Option<Arc<ScanSpeckle>>> {
    if !plan.geometry_only {
        need::require_images(scene, 1)?;
    }
    let (Some(model), Some(method)) = (&scene.speckle, plan.speckle) else {
        return Ok(None);
    };
    let model = SpeckleModel { method, ..*model };
    let patterns = ScanSpeckle::new(scene, accel, &model, plan.speckle_slips, plan.wider())?;
    Ok(Some(Arc::new(patterns)))
}

fn readout(scene: &Scene, plan: &Plan) -> Readout {
    let mut sensor = scene.camera.sensor.clone();
    sensor.noise = sensor.noise.filter(|_| plan.noise);
    Readout::new(sensor, scene.laser.beam.wavelength, scene.seed)
}

/// `None` where profiles come from images.
fn sheet(scene: &Scene, plan: &Plan) -> Option<Sheet> {
    let fan = scene.laser.fan.as_ref().filter(|_| plan.geometry_only)?;
    Some(Sheet::new(fan, &scene.camera, &camera_from_laser(scene)))
}

/// What of the part the laser lights and the camera sees along the path, in which of its
/// frames; empty if never.
pub fn part_in_view(scene: &Scene, accel: &Accel) -> InView {
    let part_from_laser = |frame| scene.part_from_head(frame) * scene.head_from_laser;
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    InView::along(&optics, accel, scene.scan.frames, part_from_laser)
}

pub(super) fn optics<'a>(scene: &'a Scene, camera_from_laser: &'a Rigid) -> Optics<'a> {
    Optics {
        laser: &scene.laser,
        camera: &scene.camera,
        camera_from_laser,
        glossy: scene.surface.glossy().next().is_some(),
    }
}

/// The plan for what the sensor sees of the part; where that is nothing, for all that it
/// could see.
pub(crate) fn plan(scene: &Scene, accel: &Accel) -> Plan {
    plan_for(scene, part_in_view(scene, accel))
}

/// The plan by the rules for what is in view.
pub(super) fn plan_for(scene: &Scene, mut seen: InView) -> Plan {
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    if seen.places.is_empty() {
        seen.places = optics.overlap();
    }
    Plan::new(
        &optics,
        &seen,
        exposure_motion(scene),
        scene.speckle.as_ref().map(|s| SpeckleOptics {
            method: s.method,
            aperture: s.aperture,
            contrast: s.coherence.contrast(),
            steps: steps_of_speckle(scene, s.method == Method::Field),
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
