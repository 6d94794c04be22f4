//! A scene prepared for simulation, with its hierarchy, model configuration and speckle patterns.
//! The result of a frame depends only on the frame number.

use super::error_model::{camera_from_laser, error_model, perfect_calibration};
use super::memory_estimate;
use super::scan_speckle::{ScanSpeckle, speckle_steps};
use super::surface_view::surface_view;
use super::systematic::{SystematicErrors, TruePoses};
use crate::accel::{Accel, TriangleClusters};
use crate::camera::{Counts, Sensor, SparseImage};
use crate::error::Result;
use crate::frame::{
    self, IndirectLight, IndirectSettings, Irradiance, LaserPlaneSampler, PixelQuadrature,
    PoseView, Readout, Reflections, TracedRegion, Truth,
};
use crate::math::Rigid;
use crate::math::rng::{Purpose, RngKey};
use crate::plan::rules::ModelConfig;
use crate::plan::rules::{ExposureMotion, SpeckleOptics};
use crate::plan::visible_line::{SensorOptics, VisibleLine};
use crate::profile::{Calibration, FrameStep, Peak, UncertaintyModel};
use crate::scene::{Scene, SpeckleModel};
use crate::speckle::lookup::Method;
use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

/// Frame number and head position at the midpoint of the exposure. Computed once per frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pose {
    pub frame: u32,
    pub part_from_head: Rigid,
}

/// A scene prepared for simulation: all data that its frames have in common. Several threads can
/// use one simulation. The result of a frame depends only on the frame number.
pub struct Simulation {
    /// Scene that is simulated.
    pub scene: Scene,
    /// Ray intersection with the part. Clones refer to one hierarchy.
    pub accel: Arc<Accel>,
    /// Simulated effects and the method of each.
    #[doc(hidden)]
    pub plan: ModelConfig,
    /// Calibration of the sensor that the measurement uses.
    #[doc(hidden)]
    pub calibration: Calibration,
    speckle: Option<Arc<ScanSpeckle>>,
    /// Parts of the surface that limit tracing; `None` traces every sample.
    clusters: Option<Arc<TriangleClusters>>,
    /// Sensor of the scene, without noise if the plan omits noise.
    readout: Readout,
    pub(crate) errors: Arc<UncertaintyModel>,
    /// Computed on first use.
    pub(crate) column_correlation: OnceLock<Vec<f64>>,
    pub(crate) scan_steps: OnceLock<(Vec<FrameStep>, f64)>,
    /// Systematic errors of this run; `None` if the scene has none.
    pub(crate) systematic: Option<Arc<SystematicErrors>>,
    /// Laser plane for geometric profiles; `None` if profiles come from images.
    pub(crate) sheet: Option<LaserPlaneSampler>,
    /// Flag that cancels frames whose result is no longer needed; see [`frame::unless_stopped`].
    pub(super) stop: Option<Arc<AtomicBool>>,
}

impl Simulation {
    /// Returns this simulation with tracing limited to pixels that may see lit surface.
    pub(crate) fn with_clusters(self, clusters: Arc<TriangleClusters>) -> Simulation {
        Simulation {
            clusters: Some(clusters),
            ..self
        }
    }

    /// Builds a simulation that follows `plan`.
    pub(crate) fn with_plan(
        scene: &Scene,
        accel: Arc<Accel>,
        plan: ModelConfig,
    ) -> Result<Simulation> {
        let speckle = patterns(scene, &accel, &plan)?;
        let errors = Arc::new(error_model(scene, plan.blur));
        Ok(Simulation::with_patterns(
            scene, accel, plan, speckle, errors,
        ))
    }

    /// Returns a simulation with the same plan but another seed for speckle, noise and fixed
    /// patterns.
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
            systematic: SystematicErrors::of(&scene).map(Arc::new),
            sheet: sheet(&scene, &plan),
            stop: self.stop.clone(),
            scene,
            plan,
        })
    }

    /// Returns a simulation of this scene with another plan. Speckle patterns are reused if both
    /// plans have equal patterns.
    pub(crate) fn with_plan_shared(&self, plan: ModelConfig) -> Result<Simulation> {
        let patterns =
            |plan: &ModelConfig| (plan.speckle, plan.local_speckle_motion, plan.pupil_scale());
        let other = if plan.speckle.is_none() || patterns(&plan) == patterns(&self.plan) {
            let shared = self.speckle.clone().filter(|_| plan.speckle.is_some());
            let errors = Arc::new(error_model(&self.scene, plan.blur));
            Simulation::with_patterns(&self.scene, self.accel.clone(), plan, shared, errors)
        } else {
            Simulation::with_plan(&self.scene, self.accel.clone(), plan)?
        };
        Ok(other.with_clusters_of(self))
    }

    /// Returns this simulation with the trace limits of `other`, which must have the same part.
    pub(crate) fn with_clusters_of(self, other: &Simulation) -> Simulation {
        Simulation {
            clusters: other.clusters.clone(),
            ..self
        }
    }

    pub(super) fn with_patterns(
        scene: &Scene,
        accel: Arc<Accel>,
        plan: ModelConfig,
        speckle: Option<Arc<ScanSpeckle>>,
        errors: Arc<UncertaintyModel>,
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
            systematic: SystematicErrors::of(scene).map(Arc::new),
            sheet: sheet(scene, &plan),
            stop: None,
            plan,
        }
    }

    /// Returns the memory of the speckle patterns, bytes.
    pub(crate) fn speckle_memory(&self) -> usize {
        self.speckle.as_ref().map_or(0, |speckle| speckle.memory())
    }

    /// Returns the head position at the midpoint of the exposure of a frame.
    pub(crate) fn pose(&self, frame: u32) -> Pose {
        Pose {
            frame,
            part_from_head: self.scene.part_from_head(frame),
        }
    }

    /// Returns the view of `frame` at the midpoint of its exposure.
    #[doc(hidden)]
    pub fn view(&self, frame: u32) -> PoseView<'_> {
        self.view_of(&self.pose(frame))
    }

    pub(crate) fn view_of(&self, pose: &Pose) -> PoseView<'_> {
        self.view_at(pose.frame as f64, pose.part_from_head)
    }

    /// Returns the view at a position on the path, in frames; the position can be between two
    /// frames.
    fn view_at(&self, place: f64, part_from_head: Rigid) -> PoseView<'_> {
        let scene = &self.scene;
        let per_side = self.plan.samples_per_side;
        let systematic = self.systematic.as_deref();
        let nominal = TruePoses {
            part_from_head,
            head_from_laser: scene.head_from_laser,
            head_from_camera: scene.head_from_camera,
        };
        let TruePoses {
            part_from_head,
            head_from_laser,
            head_from_camera,
        } = systematic.map_or(nominal, |errors| errors.poses(place, part_from_head));
        PoseView {
            accel: &self.accel,
            surface: scene.surface.clone(),
            laser: systematic.map_or(&scene.laser, |errors| &errors.laser),
            part_from_laser: part_from_head * head_from_laser,
            camera: systematic.map_or(&scene.camera, |errors| &errors.camera),
            part_from_camera: part_from_head * head_from_camera,
            speckle: (self.speckle.as_ref())
                .map(|speckle| speckle.at(scene, place, &part_from_head)),
            grid: PixelQuadrature::Gauss { per_side },
            lens: self.plan.lens_blur(),
            indirect: self.indirect_settings(place),
            sampling: self.plan.sampling,
            beam_cutoff_radii: self.plan.beam_cutoff_radii,
            stop: self.stop.as_deref(),
        }
    }

    /// Returns the settings for indirect light at a position on the path.
    fn indirect_settings(&self, place: f64) -> Option<IndirectSettings> {
        let poses = self.scene.scan.motion_samples;
        let of_exposure = self.plan.reflections?;
        Some(IndirectSettings {
            reflections: Reflections {
                from_laser: of_exposure.from_laser.div_ceil(poses),
                per_pixel: of_exposure.per_pixel / poses as f64,
                ..of_exposure
            },
            key: RngKey::new(self.scene.camera_seed(), Purpose::Reflections).with(place.to_bits()),
            coherence_length: self.scene.coherence_length_mm.unwrap_or(f64::INFINITY),
        })
    }

    /// Returns one view per pose of the exposure.
    fn views(&self, &pose: &Pose) -> impl Iterator<Item = PoseView<'_>> + use<'_> {
        let places = self.scene.scan.exposure_places(pose.frame);
        places.map(move |place| match place == pose.frame as f64 {
            true => self.view_of(&pose),
            false => self.view_at(place, self.scene.part_from_head_at(place)),
        })
    }

    /// Returns the region to trace: pixels that may see lit surface, or all pixels.
    fn region(&self) -> TracedRegion<'_> {
        (self.clusters.as_ref()).map_or(TracedRegion::All, |clusters| TracedRegion::Lit(clusters))
    }

    /// Returns the irradiance on the sensor in a frame, averaged over the poses of the exposure.
    #[doc(hidden)]
    pub fn irradiance(&self, frame: u32) -> Irradiance {
        self.irradiance_with(&self.pose(frame), &self.indirect(frame))
    }

    /// Returns the irradiance of a frame, given its [`indirect`](Self::indirect) light.
    pub(crate) fn irradiance_with(&self, pose: &Pose, indirect: &[IndirectLight]) -> Irradiance {
        self.irradiance_in(pose, &self.region(), indirect)
    }

    fn irradiance_in(
        &self,
        pose: &Pose,
        region: &TracedRegion,
        indirect: &[IndirectLight],
    ) -> Irradiance {
        let images = (self.views(pose).enumerate())
            .map(|(i, view)| frame::irradiance_with(&view, region, indirect.get(i)));
        Irradiance::mean(images.collect())
    }

    /// Computes the indirect light for each pose of the exposure of a frame. Returns an empty list
    /// if the plan omits indirect light.
    pub(crate) fn indirect(&self, frame: u32) -> Vec<IndirectLight> {
        self.indirect_in(frame, &self.region(), 1.0)
    }

    /// Computes the indirect light in a region. The number of paths is `times` the number in the
    /// plan.
    fn indirect_in(&self, frame: u32, region: &TracedRegion, times: f64) -> Vec<IndirectLight> {
        if self.plan.reflections.is_none() {
            return Vec::new();
        }
        let light = |view: PoseView| {
            let indirect = view.indirect?;
            let reflections = indirect.reflections.scaled(times);
            let indirect = IndirectSettings {
                reflections,
                ..indirect
            };
            Some(frame::indirect_irradiance(&view, region, &indirect))
        };
        self.views(&self.pose(frame)).filter_map(light).collect()
    }

    /// Returns the indirect light of a frame at the midpoint of its exposure. The plan must
    /// simulate indirect light.
    pub(crate) fn indirect_light(&self, frame: u32) -> IndirectLight {
        let view = self.view(frame);
        let indirect = view.indirect.expect("the plan follows it");
        frame::indirect_irradiance(&view, &TracedRegion::All, &indirect)
    }

    /// Returns the mean direct and mean indirect light of a frame, without speckle.
    #[doc(hidden)]
    pub fn direct_and_indirect(&self, frame: u32) -> [Irradiance; 2] {
        self.direct_and_indirect_with(&self.pose(frame), &self.indirect(frame))
    }

    /// Returns the result of [`Self::direct_and_indirect`], given the
    /// [`indirect`](Self::indirect) light.
    pub(crate) fn direct_and_indirect_with(
        &self,
        pose: &Pose,
        indirect: &[IndirectLight],
    ) -> [Irradiance; 2] {
        let region = self.region();
        let direct = self.views(pose);
        let direct = direct.map(|view| frame::mean_direct(&view, &region));
        let indirect = match indirect {
            [] => vec![Irradiance::dark(self.scene.camera.sensor.resolution)],
            _ => indirect.iter().map(|light| light.mean.clone()).collect(),
        };
        [direct.collect(), indirect].map(Irradiance::mean)
    }

    /// Returns the irradiance of a frame in `columns`; all other columns are dark. The indirect
    /// light is the result of [`strip_ghosts`](Self::strip_ghosts). The simulation must trace the
    /// footprint.
    pub(crate) fn strip(
        &self,
        frame: u32,
        columns: &Range<usize>,
        ghosts: &[IndirectLight],
    ) -> Irradiance {
        self.irradiance_in(&self.pose(frame), &self.columns_alone(columns), ghosts)
    }

    /// Computes the indirect light in `columns` for each pose of the exposure. The number of paths
    /// is `times` the number in the plan. Returns an empty list if the plan omits indirect light.
    pub(crate) fn strip_ghosts(
        &self,
        frame: u32,
        columns: &Range<usize>,
        times: f64,
    ) -> Vec<IndirectLight> {
        self.indirect_in(frame, &self.columns_alone(columns), times)
    }

    fn columns_alone(&self, columns: &Range<usize>) -> TracedRegion<'_> {
        let clusters = self.clusters.as_ref().expect("it traces the footprint");
        TracedRegion::Columns(clusters, columns.clone())
    }

    /// Returns the range from the first to the last column that may be lit in a frame.
    pub(crate) fn lit_columns(&self, frame: u32) -> Option<Range<usize>> {
        let clusters = self.clusters.as_ref()?;
        frame::footprint(&self.view(frame), &TracedRegion::Lit(clusters)).span()
    }

    /// Returns the number of columns that may be lit in a frame; all columns if every sample is
    /// traced.
    pub(crate) fn columns_at_most(&self, frame: u32) -> usize {
        match &self.clusters {
            Some(_) => self.lit_columns(frame).map_or(0, |columns| columns.len()),
            None => self.scene.camera.sensor.resolution.x as usize,
        }
    }

    /// Returns the lines of a frame, from its image or, for a geometric plan, from geometry.
    pub(crate) fn frame_peaks(&self, frame: u32) -> Vec<Peak> {
        match self.plan.geometry_only {
            true => self.geometric_peaks(&self.pose(frame)).0,
            false => self.peaks(&self.image_of(&self.pose(frame))).0,
        }
    }

    fn noise(&self, frame: u32) -> RngKey {
        RngKey::new(self.scene.camera_seed(), Purpose::SensorNoise).with(frame as u64)
    }

    /// Returns the counts of the sensor for the given irradiance.
    #[doc(hidden)]
    pub fn counts(&self, frame: u32, irradiance: &Irradiance) -> Counts {
        self.readout.counts(irradiance, self.noise(frame))
    }

    /// Returns the counts of the sensor without noise for the given irradiance.
    pub(crate) fn counts_without_noise(&self, irradiance: &Irradiance) -> Counts {
        let sensor = Sensor {
            noise: None,
            ..self.scene.camera.sensor.clone()
        };
        let readout = Readout::new(
            sensor,
            self.scene.laser.beam.wavelength,
            self.scene.camera_seed(),
        );
        readout.counts(
            irradiance,
            RngKey::new(self.scene.camera_seed(), Purpose::SensorNoise),
        )
    }

    /// Returns the counts of the sensor near the light only.
    #[doc(hidden)]
    pub fn counts_near_light(&self, frame: u32, irradiance: &Irradiance) -> SparseImage {
        self.readout.near_light(irradiance, self.noise(frame))
    }

    /// Returns the ground truth at each pixel centre of a frame: depth, position, normal and
    /// triangle.
    pub fn truth(&self, frame: u32) -> Truth {
        frame::truth_layers(&self.view(frame))
    }

    /// Returns the image of a frame.
    pub fn image(&self, frame: u32) -> Counts {
        self.image_of(&self.pose(frame)).into_counts()
    }

    /// Returns the image of a frame, simulated only near its light.
    pub(crate) fn image_of(&self, pose: &Pose) -> SparseImage {
        self.image_with(pose, &self.indirect(pose.frame))
    }

    /// Returns the result of [`Self::image_of`], given the [`indirect`](Self::indirect) light.
    pub(crate) fn image_with(&self, pose: &Pose, indirect: &[IndirectLight]) -> SparseImage {
        self.counts_near_light(pose.frame, &self.irradiance_with(pose, indirect))
    }
}

/// Returns the speckle patterns that a plan requires. Errors: an image does not fit into memory.
pub(super) fn patterns(
    scene: &Scene,
    accel: &Accel,
    plan: &ModelConfig,
) -> Result<Option<Arc<ScanSpeckle>>> {
    if !plan.geometry_only {
        memory_estimate::require_images(scene, 1)?;
    }
    let (Some(model), Some(method)) = (&scene.speckle, plan.speckle) else {
        return Ok(None);
    };
    let model = SpeckleModel { method, ..*model };
    let patterns = ScanSpeckle::new(
        scene,
        accel,
        &model,
        plan.local_speckle_motion,
        plan.pupil_scale(),
    )?;
    Ok(Some(Arc::new(patterns)))
}

fn readout(scene: &Scene, plan: &ModelConfig) -> Readout {
    let mut sensor = scene.camera.sensor.clone();
    sensor.noise = sensor.noise.filter(|_| plan.noise);
    Readout::new(sensor, scene.laser.beam.wavelength, scene.camera_seed())
}

/// Returns the laser plane of a geometric plan; `None` if profiles come from images.
fn sheet(scene: &Scene, plan: &ModelConfig) -> Option<LaserPlaneSampler> {
    let fan = scene.laser.fan.as_ref().filter(|_| plan.geometry_only)?;
    Some(LaserPlaneSampler::new(
        fan,
        &scene.camera,
        &camera_from_laser(scene),
    ))
}

/// Returns the surface that is lit and visible along the path, and the frames in which it is. The
/// result is empty if no surface is lit and visible in any frame.
pub fn part_in_view(scene: &Scene, accel: &Accel) -> VisibleLine {
    let part_from_laser = |frame| scene.part_from_head(frame) * scene.head_from_laser;
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    VisibleLine::along(&optics, accel, scene.scan.frames, part_from_laser)
}

pub(super) fn optics<'a>(scene: &'a Scene, camera_from_laser: &'a Rigid) -> SensorOptics<'a> {
    SensorOptics {
        laser: &scene.laser,
        camera: &scene.camera,
        camera_from_laser,
        glossy: scene.surface.glossy().next().is_some(),
    }
}

/// Makes the plan for the surface in view. If no surface is in view, the plan covers the overlap of
/// light and camera view.
pub(crate) fn plan(scene: &Scene, accel: &Accel) -> ModelConfig {
    plan_for(scene, part_in_view(scene, accel))
}

/// Makes the plan from the rules for the surface in view.
pub(super) fn plan_for(scene: &Scene, mut seen: VisibleLine) -> ModelConfig {
    let camera_from_laser = camera_from_laser(scene);
    let optics = optics(scene, &camera_from_laser);
    if seen.places.is_empty() {
        seen.places = optics.overlap();
    }
    ModelConfig::new(
        &optics,
        &seen,
        exposure_motion(scene),
        scene.speckle.as_ref().map(|s| SpeckleOptics {
            method: s.method,
            aperture: s.aperture,
            contrast: s.coherence.contrast(),
            steps: speckle_steps(scene, s.method == Method::Field),
        }),
    )
}

/// Returns the displacement of the field centre over the part during one exposure.
fn exposure_motion(scene: &Scene) -> Option<ExposureMotion> {
    let half = scene.scan.exposure_share? / 2.0;
    let middle = (scene.scan.frames / 2) as f64;
    let point = surface_view(scene, None).point;
    let at = |place| scene.part_from_head_at(place).point(point);
    Some(ExposureMotion {
        way: at(middle + half).distance(at(middle - half)),
        poses: scene.scan.motion_samples,
    })
}
