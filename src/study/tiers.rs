//! Ways of doing a scene's frames, side by side: what each finds and how far that is
//! from what another found.

use crate::accel::{Accel, Backend, Clusters};
use crate::error::Result;
use crate::frame::{Blur, Sampling};
use crate::plan::Plan;
use crate::plan::accuracy::geometry_only;
use crate::plan::words::words;
use crate::profile::{Peak, PeakFinder, PeakSettings, find_peaks, weigh};
use crate::run::Coverage;
use crate::run::methods::full;
use crate::run::planner::scene_plan_with;
use crate::run::simulation::Simulation;
use crate::scene::Scene;
use crate::speckle::lookup::Method;
use std::sync::Arc;

/// One way of doing a frame.
pub struct Tier {
    pub name: String,
    pub simulation: Simulation,
    pub finder: PeakFinder,
    pub coverage: Coverage,
    pub accel: Backend,
    /// Its speckle has other grains than the full model's: it errs by as much as two
    /// draws differ, and its scatter says how well it does.
    pub other_grains: bool,
}

/// What a tier makes of a frame.
pub struct TierFrame {
    pub peaks: Vec<Peak>,
    /// Pixels looked at; none without an image.
    pub pixels: usize,
}

impl Tier {
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
        let settings = PeakSettings {
            finder: self.finder,
            ..self.simulation.peak_settings()
        };
        let mut peaks = find_peaks(&counts, &settings);
        let errors = (self.simulation.errors).row_errors(&peaks, irradiance.columns());
        weigh(&mut peaks, &errors);
        TierFrame {
            peaks,
            pixels: irradiance.looked_at(),
        }
    }

    /// Bytes of its hierarchy while that is built, its patterns, and a frame of so many
    /// pixels looked at.
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

/// What tiers of a scene share.
pub struct Tiers<'s> {
    scene: &'s Scene,
    pub accel: Arc<Accel>,
    clusters: Arc<Clusters>,
    pub list: Vec<Tier>,
    /// That which the scene's runs use.
    pub chosen: usize,
}

impl<'s> Tiers<'s> {
    fn none(scene: &'s Scene, accel: Accel) -> Tiers<'s> {
        Tiers {
            scene,
            accel: Arc::new(accel),
            clusters: Arc::new(Clusters::new(&scene.mesh)),
            list: Vec::new(),
            chosen: 0,
        }
    }

    fn add(&mut self, name: &str, plan: Plan, coverage: Coverage) -> Result<&mut Tier> {
        let full = self.list.first().map(|tier| &tier.simulation.plan);
        let grains = |plan: &Plan| {
            let of_field = plan.blur == Blur::Coherent;
            (plan.speckle, plan.speckle_slips, of_field)
        };
        let other_grains =
            plan.speckle.is_some() && full.is_some_and(|full| grains(full) != grains(&plan));
        let simulation = Simulation::with_plan(self.scene, self.accel.clone(), plan)?;
        let simulation = match coverage {
            Coverage::Footprint => simulation.with_clusters(self.clusters.clone()),
            Coverage::Exhaustive => simulation,
        };
        self.list.push(Tier {
            name: name.into(),
            simulation,
            finder: self.scene.measure.finder,
            coverage,
            accel: self.scene.accel,
            other_grains,
        });
        Ok(self.list.last_mut().expect("it was pushed"))
    }

    /// All that this program can do; the full model first.
    pub fn all(scene: &'s Scene, accel: Accel) -> Result<Tiers<'s>> {
        let mut tiers = Tiers::none(scene, accel);
        let plan = scene_plan_with(scene, &tiers.accel, &|_| Ok(()))?;
        let base = Plan {
            reflections: plan.reflections,
            ..crate::run::simulation::plan(scene, &tiers.accel)
        };
        let n = base.samples_per_side;
        let most = full(&base, &plan);
        let side = most.samples_per_side;
        let mut name = format!("full model: every pixel, {side} × {side} rays in each");
        if let (Some(most), Some(planned)) = (most.reflections, plan.reflections) {
            let times = most.from_laser / planned.from_laser;
            name += &format!(", {times} × paths");
        }
        tiers.add(&name, most, Coverage::Exhaustive)?;
        let rays = Plan {
            sampling: Sampling::Rays,
            ..base.clone()
        };
        let name = format!("every pixel, {n} × {n} rays in each");
        tiers.add(&name, rays.clone(), Coverage::Exhaustive)?;
        let name = format!("pixels at the line only, {n} × {n} rays in each");
        tiers.add(&name, rays, Coverage::Footprint)?;
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
                Coverage::Footprint,
            )?;
        }
        Ok(tiers)
    }

    /// Samples and where light ends; the plan of the scene among them.
    fn images(&mut self, base: &Plan, plan: Plan) -> Result<()> {
        let n = base.samples_per_side;
        let name = match self.scene.tolerance_um {
            Some(tolerance) => format!("plan for {tolerance} µm"),
            None => "plan: flat pieces 1 ray a pixel".to_owned(),
        };
        self.chosen = self.list.len();
        self.add(&name, plan, Coverage::Footprint)?;
        let mut counts = vec![1, 2, n, 2 * n];
        counts.sort_unstable();
        counts.dedup();
        for samples_per_side in counts {
            let plan = Plan {
                samples_per_side,
                ..base.clone()
            };
            self.unless_chosen(plan, base)?;
        }
        for radii in [1.5, 2.0] {
            let plan = Plan {
                cutoff_radii: base.cutoff_radii.min(radii),
                ..base.clone()
            };
            self.unless_chosen(plan, base)?;
        }
        Ok(())
    }

    fn unless_chosen(&mut self, plan: Plan, base: &Plan) -> Result<()> {
        if words(&self.list[self.chosen].simulation.plan) == words(&plan) {
            return Ok(());
        }
        let name = match difference(&plan, base) {
            name if name.is_empty() => "without a tolerance".into(),
            name => name,
        };
        self.add(&name, plan, Coverage::Footprint).map(drop)
    }

    /// Light that is reflected more than once: left out, and by fewer and more paths than the plan's.
    fn reflections(&mut self, base: &Plan) -> Result<()> {
        let Some(planned) = base.reflections else {
            return Ok(());
        };
        let mut add = |name: &str, reflections| {
            let plan = Plan {
                reflections,
                ..base.clone()
            };
            self.add(name, plan, Coverage::Footprint).map(drop)
        };
        add("direct light only", None)?;
        add("¼ of the paths of reflections", Some(planned.times(0.25)))?;
        add("4 × the paths of reflections", Some(planned.times(4.0)))
    }

    /// The lens's blur.
    fn blurs(&mut self, base: &Plan) -> Result<()> {
        for blur in [Blur::None, Blur::Mean, Blur::Coherent] {
            if blur != Blur::Coherent || base.speckle == Some(Method::Field) {
                let plan = Plan {
                    blur,
                    ..base.clone()
                };
                self.unless_chosen(plan, base)?;
            }
        }
        Ok(())
    }

    /// Speckle and noise: without, and otherwise.
    fn randomness(&mut self, base: &Plan) -> Result<()> {
        let mut plans = Vec::new();
        let with = |speckle, noise| Plan {
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
            plans.push(Plan {
                speckle_slips: !base.speckle_slips,
                ..base.clone()
            });
        }
        if base.noise {
            plans.push(with(base.speckle, false));
        }
        if base.speckle.is_some() && base.noise {
            plans.push(with(None, false));
        }
        plans.push(Plan {
            samples_per_side: 1,
            cutoff_radii: base.cutoff_radii.min(1.5),
            ..with(None, false)
        });
        plans
            .into_iter()
            .try_for_each(|plan| self.unless_chosen(plan, base))
    }

    fn finders(&mut self, base: &Plan) -> Result<()> {
        for finder in PeakFinder::ALL {
            if finder != self.scene.measure.finder {
                let name = format!("peak finder {finder}");
                self.add(&name, base.clone(), Coverage::Footprint)?.finder = finder;
            }
        }
        Ok(())
    }

    fn backend(&mut self, base: &Plan) -> Result<()> {
        if self.scene.accel == Backend::Rust {
            return Ok(());
        }
        let threads = rayon::current_num_threads();
        let accel = Accel::build_with(Backend::Rust, &self.scene.mesh, threads, &|_| Ok(()))?;
        let accel = accel.with_copies(self.scene.copies.clone())?;
        let embree = std::mem::replace(&mut self.accel, Arc::new(accel));
        let tier = self.add("hierarchy in Rust", base.clone(), Coverage::Footprint)?;
        tier.accel = Backend::Rust;
        self.accel = embree;
        Ok(())
    }
}

/// In what it is not as `base`.
fn difference(plan: &Plan, base: &Plan) -> String {
    let base = words(base);
    let mut words = words(plan);
    words.retain(|word| !base.contains(word));
    words.join(", ")
}
