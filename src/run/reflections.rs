//! Whether light that is reflected more than once matters in a scene, and how many paths it takes to see it with
//! less noise than the sensor's own.

use super::pilot::spread_frames;
use super::simulation::Simulation;
use crate::accel::Accel;
use crate::camera::Sensor;
use crate::error::Result;
use crate::frame::{Reflections, met_again};
use crate::math::rng::{Key, Purpose};
use crate::mesh::Watch;
use crate::plan::Plan;
use crate::plan::rules::{Effect, EffectKind, MAX_REFLECTIONS};
use crate::scene::Scene;
use crate::surface::Lobe;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Frames in which it is asked what meets the part again, evenly spread over the scan.
const FRAMES: u32 = 16;
/// Paths of each: a share of one of a hundred of the light is not seen with a chance of e⁻⁴¹ in one frame.
const PATHS: u32 = 4096;
/// Share of the light met again whose further reflections are not followed.
const REST: f64 = 1e-3;
/// Frames, evenly spread over those with such light, whose noise is measured.
const MEASURED: u32 = 4;
/// Independent images of each, and the paths from the laser that each takes.
const IMAGES: u64 = 4;
const PILOT: u32 = 1 << 15;
/// Times as many for the frame with most noise, if these are too few by more than that: noise of few paths lies in
/// places that one of them met, and falls faster than their number says.
const SECOND_PILOT: u32 = 8;
/// Side of the squares of pixels over which noise is averaged: 192 degrees of freedom of IMAGES images know it to
/// 10 %.
const SIDE: usize = 8;
/// Noise of paths over the sensor's own, at most.
pub(super) const NOISE: f64 = 1.0;
/// Share of the squares that show light or noise in which it may be more.
const BEYOND: f64 = 0.01;
/// Paths from the laser, at least and at most.
const LEAST: u32 = 1 << 12;
const MOST: u32 = 1 << 22;
/// Roughness below which lobes are too narrow to be met by chance: there are paths from the camera, whatever the noise of
/// those from the laser alone says.
const ROUGH: f64 = 0.05;
/// Time of a path from the laser and of one from the camera, ns of one core: of matt and metal parts of few
/// triangles, to a factor of two.
const PATH_NS: f64 = 2e3;
const CAMERA_PATH_NS: f64 = 4e3;

/// Whether anything is looked for; of matt parts only if the scene names it.
pub(super) fn asked(scene: &Scene) -> bool {
    scene.surface.glossy().next().is_some() || scene.methods.reflections.is_some()
}

/// What of the laser's light meets the part again after it was reflected once.
pub(crate) struct MetAgain {
    /// Of that which meets it at all, the largest of frames; `None` of matt parts for which nobody asked.
    share: Option<f64>,
    /// Some of those that have it.
    frames: Vec<u32>,
}

impl MetAgain {
    /// In frames all over the path.
    pub fn of(scene: &Scene, accel: &Arc<Accel>, plan: &Plan) -> Result<MetAgain> {
        if !asked(scene) {
            return Ok(MetAgain {
                share: None,
                frames: Vec::new(),
            });
        }
        let simulation = silent(scene.clone(), accel, plan.clone())?;
        let frames = spread_frames(scene.scan.frames, FRAMES);
        let share = |&frame: &u32| {
            let key = Key::new(0, Purpose::PlanRays).with(frame as u64);
            let [first, again] = met_again(&simulation.view(frame), PATHS, key);
            let share = if first > 0.0 { again / first } else { 0.0 };
            (share, frame)
        };
        let shares: Vec<(f64, u32)> = frames.par_iter().map(share).collect();
        let with: Vec<u32> = (shares.iter().filter(|(share, _)| *share > 0.0))
            .map(|&(_, frame)| frame)
            .collect();
        let some = spread_frames(with.len() as u32, MEASURED);
        Ok(MetAgain {
            share: Some(shares.iter().fold(0.0, |most, (share, _)| share.max(most))),
            frames: some.into_iter().map(|i| with[i as usize]).collect(),
        })
    }

    /// Most reflections that are followed: those the scene names; else of matt parts one, of others so many that
    /// further ones carry less than [`REST`].
    fn most(&self, scene: &Scene) -> u32 {
        let methods = &scene.methods;
        let share = match self.share {
            Some(share) if share > 0.0 && methods.geometry_only != Some(true) => share,
            _ => return 1,
        };
        let chosen = match scene.surface.glossy().next() {
            None => 1,
            Some(_) => {
                let reflections = REST.ln() / share.min(0.9).ln();
                (reflections.ceil() as u32).clamp(2, MAX_REFLECTIONS)
            }
        };
        methods.reflections.unwrap_or(chosen)
    }

    /// How it is followed in a scene, with the noise of its paths over the sensor's own, and what is to be said of it.
    pub fn planned(
        &self,
        scene: &Scene,
        accel: &Arc<Accel>,
        plan: &Plan,
        watch: &Watch,
    ) -> Result<(Option<(Reflections, f64)>, Effect)> {
        let most = self.most(scene);
        let percent = 100.0 * self.share.unwrap_or(0.0);
        if most < 2 || plan.geometry_only {
            let why = match self.share {
                None => "the surface is diffuse: what meets it again is wide and faint; plan.reflections = 4 \
                         models it"
                    .to_owned(),
                Some(share) if share <= 0.0 => {
                    "no light that is reflected meets the part again".to_owned()
                }
                Some(_) => {
                    format!("named in [plan]; {percent:.1} % of the light meets the part again")
                }
            };
            let none = Effect::new(
                EffectKind::Reflections,
                false,
                "direct light only".into(),
                why,
            );
            return Ok((None, none));
        }
        let (reflections, noise) = self.paths(&Pilots::new(scene, accel, plan, most), watch)?;
        let pixels = scene.camera.sensor.resolution.as_dvec2().element_product();
        let Reflections {
            from_laser,
            per_pixel,
            ..
        } = reflections;
        let method = format!(
            "up to {most} reflections: {from_laser} paths from the laser, {:.0} from the camera",
            per_pixel * pixels
        );
        let why = format!(
            "up to {percent:.1} % of the light meets the part again; the paths' noise is {noise:.2} of the \
             sensor's own in 99 of 100 places where either shows, or less"
        );
        let mut effect = Effect::new(EffectKind::Reflections, true, method, why);
        let ns = from_laser as f64 * PATH_NS + per_pixel * pixels * CAMERA_PATH_NS;
        effect.cost_ms = Some(ns * 1e-6);
        Ok((Some((reflections, noise)), effect))
    }

    /// So many paths that their noise is below the sensor's, and what it is of that.
    fn paths(&self, pilots: &Pilots, watch: &Watch) -> Result<(Reflections, f64)> {
        let first = (self.frames.len() * pilots.ways.len()) as f64;
        let all = first + f64::from(SECOND_PILOT);
        let mut done = 0.0;
        let mut most_noise = |few: Reflections| -> Result<(f64, u32)> {
            let mut most = (0.0, self.frames[0]);
            for &frame in &self.frames {
                let ratio = pilots.noise(frame, few, &|share| watch((done + share) / all))?;
                done += 1.0;
                if ratio > most.0 {
                    most = (ratio, frame);
                }
            }
            Ok(most)
        };
        let ways = pilots.ways.iter().map(|&few| Ok((most_noise(few)?, few)));
        let ways = ways.collect::<Result<Vec<_>>>()?.into_iter();
        let least = ways.min_by(|((a, _), _), ((b, _), _)| a.total_cmp(b));
        let ((mut ratio, frame), few) = least.expect("there is a way");
        let mut measured = 1.0;
        if (ratio / NOISE).powi(2) > f64::from(SECOND_PILOT) {
            measured = f64::from(SECOND_PILOT);
            ratio = pilots.noise(frame, few.times(measured), &|share| {
                watch((first + measured * share) / all)
            })?;
        }
        // The variance of stratified paths falls at least as their number grows.
        let needed = PILOT as f64 * measured * (ratio / NOISE).powi(2);
        let needed = (needed.clamp(LEAST as f64, MOST as f64) as u32).next_power_of_two();
        let chosen = needed as f64 / PILOT as f64;
        Ok((few.times(chosen), ratio * (measured / chosen).sqrt()))
    }
}

/// Images of few paths, by which it is known how many a scene takes.
struct Pilots<'a> {
    scene: &'a Scene,
    accel: &'a Arc<Accel>,
    plan: &'a Plan,
    /// The paths of the first, in as much time each way: from the laser alone, where that may do, and from both ends.
    ways: Vec<Reflections>,
    seeds: Range<u64>,
}

impl Pilots<'_> {
    fn new<'a>(scene: &'a Scene, accel: &'a Arc<Accel>, plan: &'a Plan, most: u32) -> Pilots<'a> {
        let pixels = scene.camera.sensor.resolution.as_dvec2().element_product();
        let shared = |laser: f64| Reflections {
            most,
            from_laser: (laser * PILOT as f64) as u32,
            per_pixel: (1.0 - laser) * PILOT as f64 * PATH_NS / CAMERA_PATH_NS / pixels,
        };
        let alone = (!needs_camera(scene)).then(|| shared(1.0));
        Pilots {
            scene,
            accel,
            plan,
            ways: alone.into_iter().chain([shared(0.5)]).collect(),
            seeds: 0..IMAGES,
        }
    }

    /// Noise over the sensor's own of these paths in a frame.
    fn noise(&self, frame: u32, reflections: Reflections, watch: &Watch) -> Result<f64> {
        let plan = Plan {
            reflections: Some(reflections),
            ..self.plan.clone()
        };
        let image = |seed: u64| {
            let scene = Scene {
                seed,
                ..self.scene.clone()
            };
            let image = silent(scene, self.accel, plan.clone())?.ghosts(frame);
            watch((seed + 1 - self.seeds.start) as f64 / IMAGES as f64)?;
            let wavelength = self.scene.laser.beam.wavelength;
            let electrons = self
                .scene
                .camera
                .sensor
                .electrons_per_irradiance(wavelength);
            Ok((image.dense().iter().map(|&e| e as f64 * electrons)).collect())
        };
        let images = (self.seeds.clone())
            .map(image)
            .collect::<Result<Vec<_>>>()?;
        let mut ratios = noise_ratios(&self.scene.camera.sensor, &images);
        ratios.sort_by(f64::total_cmp);
        let at = ((1.0 - BEYOND) * ratios.len() as f64) as usize;
        Ok(ratios.get(at).or(ratios.last()).copied().unwrap_or(0.0))
    }
}

/// Without speckle and noise, and without what is stated of errors, which takes long to work out for speckle.
fn silent(scene: Scene, accel: &Arc<Accel>, plan: Plan) -> Result<Simulation> {
    let scene = Scene {
        speckle: None,
        ..scene
    };
    let plan = Plan {
        speckle: None,
        noise: false,
        blur: plan.blur.without_field(),
        ..plan
    };
    Simulation::with_plan(&scene, accel.clone(), plan)
}

/// Whether the camera may see what hardly a path from the laser finds: mirrors, and lobes that are narrow.
fn needs_camera(scene: &Scene) -> bool {
    scene.surface.glossy().any(|glossy| {
        let mirrors = glossy
            .lobes
            .iter()
            .any(|(_, lobe)| matches!(lobe, Lobe::Mirror(_)));
        mirrors || glossy.narrowest() < ROUGH
    })
}

/// What a square of pixels has, summed over them.
#[derive(Clone, Copy, Default)]
struct Square {
    pixels: f64,
    /// Electrons.
    light: f64,
    /// Variance of images.
    paths: f64,
}

impl Square {
    /// Standard deviation of images over the sensor's own, whose variance in the dark is `dark`. `None` where light and
    /// noise are both below that, so that neither shows, and where pixels are full. All is of the square: a pixel that
    /// one of few paths fills need not be full of many.
    fn ratio(&self, dark: f64, full_well: f64) -> Option<f64> {
        let [light, paths] = [self.light, self.paths].map(|sum| sum / self.pixels);
        let shows = light * light >= dark || paths >= dark;
        (shows && light < full_well).then(|| (paths / (light + dark)).sqrt())
    }
}

/// Standard deviation of images, electrons row by row, over that of the sensor's own noise in them, in each square that
/// shows any.
fn noise_ratios(sensor: &Sensor, images: &[Vec<f64>]) -> Vec<f64> {
    let dark = sensor.dark_variance_e();
    let columns = sensor.resolution.x as usize;
    let across = columns.div_ceil(SIDE);
    let count = images.len() as f64;
    let mut squares = vec![Square::default(); across * (images[0].len() / columns).div_ceil(SIDE)];
    for pixel in 0..images[0].len() {
        let values = images.iter().map(|image| image[pixel]);
        let (sum, square) = values.fold((0.0, 0.0), |(s, q), e| (s + e, q + e * e));
        let mean = sum / count;
        let variance = (square / count - mean * mean) * count / (count - 1.0);
        let square = &mut squares[pixel / columns / SIDE * across + pixel % columns / SIDE];
        square.pixels += 1.0;
        square.light += mean;
        square.paths += variance.max(0.0);
    }
    let ratio = |square: &Square| square.ratio(dark, sensor.full_well_e);
    squares.iter().filter_map(ratio).collect()
}

#[cfg(test)]
#[path = "reflections_tests.rs"]
mod tests;
