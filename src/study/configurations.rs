//! Model configurations for the frames of a scene, whose results are compared with each other.

use crate::accel::{Accel, Backend, TriangleClusters};
use crate::error::Result;
use crate::frame::{self, Blur, Sampling};
use crate::plan::ModelConfig;
use crate::plan::accuracy::geometry_only;
use crate::plan::display::words;
use crate::profile::{Peak, PeakFinder};
use crate::run::TraceMode;
use crate::run::methods::reference_config;
use crate::run::planner::scene_plan_with;
use crate::run::simulation::Simulation;
use crate::scene::Scene;
use crate::speckle::lookup::Method;
use std::sync::Arc;

/// One model configuration.
pub struct Configuration {
    pub name: String,
    pub simulation: Simulation,
    pub finder: PeakFinder,
    pub coverage: TraceMode,
    pub accel: Backend,
    /// True if the speckle differs from the reference model's speckle realisation. The difference
    /// then includes the difference of the realisations, and the scatter is the measure of quality.
    pub independent_speckle: bool,
}

/// Result of a configuration for a frame.
pub struct TierFrame {
    pub peaks: Vec<Peak>,
    /// Number of traced pixels; 0 without an image.
    pub pixels: usize,
}

impl Configuration {
    pub fn frame(&self, frame: u32) -> TierFrame {
        if self.simulation.plan.geometry_only {
            return TierFrame {
                peaks: (self.simulation)
                    .geometric_peaks(&self.simulation.pose(frame))
                    .0,
                pixels: 0,
            };
        }
        let irradiance = self.simulation.irradiance(frame);
        let counts = self.simulation.counts_near_light(frame, &irradiance);
        TierFrame {
            peaks: self.simulation.peaks_by(self.finder, &counts).0,
            pixels: irradiance.traced_pixels(),
        }
    }

    /// Returns the memory of the hierarchy during its build, the patterns, and a frame with this
    /// number of traced pixels, bytes.
    pub fn memory(&self, pixels: usize) -> usize {
        let scene = &self.simulation.scene;
        let hierarchy = scene.mesh.triangles.len() * self.accel.build_bytes() as usize;
        let image = match self.simulation.plan.geometry_only {
            true => 0,
            false => scene.camera.sensor.resolution.element_product() as usize * size_of::<u16>(),
        };
        hierarchy + self.simulation.speckle_memory() + image + pixels * size_of::<f32>()
    }
}

/// Model configurations of a scene, with their common data.
pub struct ConfigurationSet<'s> {
    scene: &'s Scene,
    pub accel: Arc<Accel>,
    clusters: Arc<TriangleClusters>,
    pub list: Vec<Configuration>,
    /// Index of the configuration that runs of the scene use.
    pub chosen: usize,
}

impl<'s> ConfigurationSet<'s> {
    fn none(scene: &'s Scene, accel: Accel) -> ConfigurationSet<'s> {
        ConfigurationSet {
            scene,
            accel: Arc::new(accel),
            clusters: Arc::new(TriangleClusters::new(&scene.mesh)),
            list: Vec::new(),
            chosen: 0,
        }
    }

    fn add(
        &mut self,
        name: &str,
        plan: ModelConfig,
        coverage: TraceMode,
    ) -> Result<&mut Configuration> {
        let full = self.list.first().map(|tier| &tier.simulation.plan);
        let grains = |plan: &ModelConfig| {
            let of_field = plan.blur == Blur::Coherent;
            (plan.speckle, plan.local_speckle_motion, of_field)
        };
        let independent_speckle =
            plan.speckle.is_some() && full.is_some_and(|full| grains(full) != grains(&plan));
        let simulation = Simulation::with_plan(self.scene, self.accel.clone(), plan)?;
        let simulation = match coverage {
            TraceMode::Footprint => simulation.with_clusters(self.clusters.clone()),
            TraceMode::Exhaustive => simulation,
        };
        self.list.push(Configuration {
            name: name.into(),
            simulation,
            finder: self.scene.measure.finder,
            coverage,
            accel: self.scene.accel,
            independent_speckle,
        });
        Ok(self.list.last_mut().expect("it was pushed"))
    }

    /// Returns all available configurations; the reference model is first.
    pub fn all(scene: &'s Scene, accel: Accel) -> Result<ConfigurationSet<'s>> {
        let mut tiers = ConfigurationSet::none(scene, accel);
        let plan = scene_plan_with(scene, &tiers.accel, &|_| Ok(()))?;
        let base = ModelConfig {
            reflections: plan.reflections,
            ..crate::run::simulation::plan(scene, &tiers.accel)
        };
        let n = base.samples_per_side;
        let most = reference_config(&base, &plan);
        let side = most.samples_per_side;
        let mut name = format!("full model: every pixel, {side} × {side} rays in each");
        if let (Some(most), Some(planned)) = (most.reflections, plan.reflections) {
            let times = most.from_laser / planned.from_laser;
            name += &format!(", {times} × paths");
        }
        tiers.add(&name, most, TraceMode::Exhaustive)?;
        let rays = ModelConfig {
            sampling: Sampling::Rays,
            ..base.clone()
        };
        let name = format!("every pixel, {n} × {n} rays in each");
        tiers.add(&name, rays.clone(), TraceMode::Exhaustive)?;
        let name = format!("pixels at the line only, {n} × {n} rays in each");
        tiers.add(&name, rays, TraceMode::Footprint)?;
        tiers.images(&base, plan)?;
        tiers.reflections(&base)?;
        tiers.blurs(&base)?;
        tiers.randomness(&base)?;
        tiers.finders(&base)?;
        tiers.backend(&base)?;
        if scene.laser.fan.is_some() {
            tiers.add(
                "geometry only, no image",
                geometry_only(base),
                TraceMode::Footprint,
            )?;
        }
        Ok(tiers)
    }

    /// Adds the numbers of samples and the beam cut-offs, and the plan of the scene.
    fn images(&mut self, base: &ModelConfig, plan: ModelConfig) -> Result<()> {
        let n = base.samples_per_side;
        let name = match self.scene.tolerance_um {
            Some(tolerance) => format!("plan for {tolerance} µm"),
            None => "plan: flat pieces 1 ray a pixel".to_owned(),
        };
        self.chosen = self.list.len();
        self.add(&name, plan, TraceMode::Footprint)?;
        let mut counts = vec![1, 2, n, 2 * n];
        counts.sort_unstable();
        counts.dedup();
        for samples_per_side in counts {
            let plan = ModelConfig {
                samples_per_side,
                ..base.clone()
            };
            self.unless_chosen(plan, base)?;
        }
        let Scene { laser, camera, .. } = self.scene;
        if frame::unmet_plane_cut_requirement(laser, camera, &self.scene.surface).is_none() {
            let plan = ModelConfig {
                sampling: Sampling::PlaneCut,
                ..base.clone()
            };
            self.unless_chosen(plan, base)?;
        }
        for radii in [1.5, 2.0] {
            let plan = ModelConfig {
                beam_cutoff_radii: base.beam_cutoff_radii.min(radii),
                ..base.clone()
            };
            self.unless_chosen(plan, base)?;
        }
        Ok(())
    }

    fn unless_chosen(&mut self, plan: ModelConfig, base: &ModelConfig) -> Result<()> {
        if words(&self.list[self.chosen].simulation.plan) == words(&plan) {
            return Ok(());
        }
        let name = match difference(&plan, base) {
            name if name.is_empty() => "without a tolerance".into(),
            name => name,
        };
        self.add(&name, plan, TraceMode::Footprint).map(drop)
    }

    /// Adds configurations of indirect light: none, and fewer and more paths than the plan.
    fn reflections(&mut self, base: &ModelConfig) -> Result<()> {
        let Some(planned) = base.reflections else {
            return Ok(());
        };
        let mut add = |name: &str, reflections| {
            let plan = ModelConfig {
                reflections,
                ..base.clone()
            };
            self.add(name, plan, TraceMode::Footprint).map(drop)
        };
        add("direct light only", None)?;
        add("¼ of the paths of reflections", Some(planned.scaled(0.25)))?;
        add("4 × the paths of reflections", Some(planned.scaled(4.0)))
    }

    /// Adds the models of the lens blur.
    fn blurs(&mut self, base: &ModelConfig) -> Result<()> {
        for blur in [Blur::None, Blur::Mean, Blur::Coherent] {
            if blur != Blur::Coherent || base.speckle == Some(Method::Field) {
                let plan = ModelConfig {
                    blur,
                    ..base.clone()
                };
                self.unless_chosen(plan, base)?;
            }
        }
        Ok(())
    }

    /// Adds configurations without speckle or noise, and with different methods for them.
    fn randomness(&mut self, base: &ModelConfig) -> Result<()> {
        let mut plans = Vec::new();
        let with = |speckle, noise| ModelConfig {
            speckle,
            noise,
            blur: match speckle {
                Some(Method::Field) => base.blur,
                _ => base.blur.without_field(),
            },
            ..base.clone()
        };
        if base.speckle.is_some() {
            plans.push(with(None, base.noise));
            if base.speckle != Some(Method::Trilinear) {
                plans.push(with(Some(Method::Trilinear), base.noise));
            }
        }
        if base.speckle == Some(Method::Field) && !self.scene.scan.turns() {
            plans.push(ModelConfig {
                local_speckle_motion: !base.local_speckle_motion,
                ..base.clone()
            });
        }
        if base.noise {
            plans.push(with(base.speckle, false));
        }
        if base.speckle.is_some() && base.noise {
            plans.push(with(None, false));
        }
        plans.push(ModelConfig {
            samples_per_side: 1,
            beam_cutoff_radii: base.beam_cutoff_radii.min(1.5),
            ..with(None, false)
        });
        plans
            .into_iter()
            .try_for_each(|plan| self.unless_chosen(plan, base))
    }

    fn finders(&mut self, base: &ModelConfig) -> Result<()> {
        for finder in PeakFinder::ALL {
            if finder != self.scene.measure.finder {
                let name = format!("peak finder {finder}");
                self.add(&name, base.clone(), TraceMode::Footprint)?.finder = finder;
            }
        }
        Ok(())
    }

    fn backend(&mut self, base: &ModelConfig) -> Result<()> {
        if self.scene.accel == Backend::Rust {
            return Ok(());
        }
        let threads = rayon::current_num_threads();
        let accel = Accel::build_with(Backend::Rust, &self.scene.mesh, threads, &|_| Ok(()))?;
        let accel = accel.with_copies(self.scene.copies.clone())?;
        let embree = std::mem::replace(&mut self.accel, Arc::new(accel));
        let tier = self.add("hierarchy in Rust", base.clone(), TraceMode::Footprint)?;
        tier.accel = Backend::Rust;
        self.accel = embree;
        Ok(())
    }
}

/// Returns the settings in which `plan` differs from `base`, as text.
fn difference(plan: &ModelConfig, base: &ModelConfig) -> String {
    let base = words(base);
    let mut words = words(plan);
    words.retain(|word| !base.contains(word));
    words.join(", ")
}
