//! Decides whether indirect light matters in a scene, and how many paths keep its noise below the
//! sensor noise.

use super::pilot::spread_frames;
use super::simulation::Simulation;
use crate::accel::Accel;
use crate::camera::Sensor;
use crate::error::Result;
use crate::frame::{Reflections, lit_curve_applies, second_hit_power};
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::ProgressFn;
use crate::plan::ModelConfig;
use crate::plan::rules::{Effect, EffectKind, MAX_REFLECTIONS};
use crate::scene::Scene;
use crate::surface::Lobe;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Number of frames in which the second hits are estimated, uniformly distributed over the scan.
const FRAMES: u32 = 16;
/// Paths per frame. An effect on 1 % of the light is missed in one frame with probability e⁻⁴¹.
const PATHS: u32 = 4096;
/// Fraction of the second-hit light below which further bounces are not simulated.
const REST: f64 = 1e-3;
/// Number of frames whose noise is measured, uniformly distributed over the frames with indirect
/// light.
const MEASURED: u32 = 4;
/// Number of independent images per frame; `PILOT` is the number of light paths per image.
const IMAGES: u64 = 2;
const PILOT: u32 = 1 << 15;
/// Factor on the number of paths for the noisiest frame if the first paths are too few by more than
/// this factor. Noise of few paths concentrates at the pixels that a path hits. It decreases faster
/// than the number of paths suggests.
const SECOND_PILOT: u32 = 8;
/// Smallest side of the pixel blocks over which noise is averaged, px. With `IMAGES` images, 121
/// degrees of freedom determine the variance to 13 %.
const SIDE: usize = 11;
/// Largest accepted ratio of path noise to sensor noise.
pub(super) const NOISE: f64 = 1.0;
/// Fraction of the blocks with visible light or noise in which the ratio may be larger.
const BEYOND: f64 = 0.01;
/// Smallest and largest number of light paths.
const MIN_LIGHT_PATHS: u32 = 1 << 12;
const MAX_LIGHT_PATHS: u32 = 1 << 22;
/// Roughness below which lobes are too narrow for random light paths. Camera paths are then used,
/// whatever the noise of light paths.
const ROUGH: f64 = 0.05;
/// Time per camera path relative to that of a light path. The value is accurate to a factor of two
/// for diffuse and metal parts with few triangles.
const CAMERA_PATH_TIME: f64 = 2.0;
/// Time of a pair of a node of the lit curve and a receiver, relative to that of a light path. The
/// value is a geometric mean. A receiver of a groove, slot or box takes the time of 2 to 17 paths
/// with 64 to 256 nodes and one to nine vertices, so a pair takes 0.004 to 0.1.
const PAIR_TIME: f64 = 0.02;
/// Predicted ratio of the times without and with the lit curve from which the curve is used. It is
/// the factor by which [`PAIR_TIME`] is uncertain.
const LEAST_SPEEDUP: f64 = 5.0;
/// Pairs per pixel below which no image of the lit curve is expected. The lit curve is not tried if
/// paths take less time.
const FEW_PAIRS: f64 = 16.0;

/// Laser light that hits the part again after the first reflection.
pub(crate) struct SecondHitSurvey {
    /// Largest fraction of the incident light over the frames; `None` for diffuse parts without a
    /// request.
    share: Option<f64>,
    /// Selection of the frames with second hits.
    frames: Vec<u32>,
}

impl SecondHitSurvey {
    /// Estimates the second hits in frames along the entire path.
    pub fn of(scene: &Scene, accel: &Arc<Accel>, plan: &ModelConfig) -> Result<SecondHitSurvey> {
        if !scene.considers_indirect_light() {
            return Ok(SecondHitSurvey {
                share: None,
                frames: Vec::new(),
            });
        }
        let simulation = silent(scene.clone(), accel, plan.clone())?;
        let frames = spread_frames(scene.scan.frames, FRAMES);
        let share = |&frame: &u32| {
            let key = RngKey::new(0, Purpose::PlanRays).with(frame as u64);
            let [first, again] = second_hit_power(&simulation.view(frame), PATHS, key);
            let share = if first > 0.0 { again / first } else { 0.0 };
            (share, frame)
        };
        let shares: Vec<(f64, u32)> = frames.par_iter().map(share).collect();
        let with: Vec<u32> = (shares.iter().filter(|(share, _)| *share > 0.0))
            .map(|&(_, frame)| frame)
            .collect();
        let some = spread_frames(with.len() as u32, MEASURED);
        Ok(SecondHitSurvey {
            share: Some(shares.iter().fold(0.0, |most, (share, _)| share.max(most))),
            frames: some.into_iter().map(|i| with[i as usize]).collect(),
        })
    }

    /// Returns the maximum number of bounces. The scene's value has priority. The default is one
    /// for diffuse parts. For other parts, later bounces carry less than the fraction [`REST`].
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
        methods.max_bounces.unwrap_or(chosen)
    }

    /// Returns the method for indirect light with its ratio of path noise to sensor noise, and the
    /// effect to report.
    pub fn planned(
        &self,
        scene: &Scene,
        accel: &Arc<Accel>,
        plan: &ModelConfig,
        watch: &ProgressFn,
    ) -> Result<(Option<(Reflections, f64)>, Effect)> {
        let most = self.most(scene);
        let percent = 100.0 * self.share.unwrap_or(0.0);
        if most < 2 || plan.geometry_only {
            let why = match self.share {
                None => "the surface is diffuse: what meets it again is wide and faint; model.max_bounces = 4 \
                         models it"
                    .to_owned(),
                Some(share) if share <= 0.0 => {
                    "no light that is reflected meets the part again".to_owned()
                }
                Some(_) => {
                    format!("named in [model]; {percent:.1} % of the light meets the part again")
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
        let line = match reflections.line {
            true => "the lit curve as light source, ",
            false => "",
        };
        let method = format!(
            "up to {most} reflections: {line}{from_laser} paths from the laser, {:.0} from the camera",
            per_pixel * pixels
        );
        let why = format!(
            "up to {percent:.1} % of the light meets the part again; the paths' noise is {noise:.2} of the \
             sensor noise or less at 99 % of the pixels where either is visible"
        );
        let effect = Effect::new(EffectKind::Reflections, true, method, why);
        Ok((Some((reflections, noise)), effect))
    }

    /// Returns the number of paths that keeps path noise below sensor noise, and the resulting
    /// noise ratio.
    fn paths(&self, pilots: &Pilots, watch: &ProgressFn) -> Result<(Reflections, f64)> {
        let first = (self.frames.len() * pilots.strategies.len()) as f64;
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
        let ways = pilots
            .strategies
            .iter()
            .map(|&few| Ok((most_noise(few)?, few)));
        let ways = ways.collect::<Result<Vec<_>>>()?.into_iter();
        let least = ways.min_by(|((a, _), _), ((b, _), _)| a.total_cmp(b));
        let ((mut ratio, frame), few) = least.expect("there is a way");
        let mut measured = 1.0;
        if (ratio / NOISE).powi(2) > f64::from(SECOND_PILOT) {
            measured = f64::from(SECOND_PILOT);
            ratio = pilots.noise(frame, few.scaled(measured), &|share| {
                watch((first + measured * share) / all)
            })?;
        }
        // The variance of stratified paths decreases at least in proportion to their number.
        let needed = PILOT as f64 * measured * (ratio / NOISE).powi(2);
        let least = LEAST_SPEEDUP * pilots.line_time(FEW_PAIRS * pilots.pixels());
        if needed > least && lit_curve_applies(&pilots.scene.surface) {
            let with_line = pilots.with_line(&self.frames, few, needed, &|_| watch(1.0))?;
            if let Some(found) = with_line {
                return Ok(found);
            }
        }
        let needed = path_count(needed);
        let chosen = needed as f64 / PILOT as f64;
        Ok((few.scaled(chosen), ratio * (measured / chosen).sqrt()))
    }
}

/// Returns the number of light paths nearest to `needed` that the plan accepts.
fn path_count(needed: f64) -> u32 {
    let needed = needed.clamp(MIN_LIGHT_PATHS as f64, MAX_LIGHT_PATHS as f64) as u32;
    needed.next_power_of_two()
}

/// Images from few paths that determine the number of paths a scene needs.
struct Pilots<'a> {
    scene: &'a Scene,
    accel: &'a Arc<Accel>,
    plan: &'a ModelConfig,
    /// Candidate path distributions of the first images, with equal computing time. Light paths
    /// only, if they may suffice, and paths from both ends.
    strategies: Vec<Reflections>,
    seeds: Range<u64>,
}

impl Pilots<'_> {
    fn new<'a>(
        scene: &'a Scene,
        accel: &'a Arc<Accel>,
        plan: &'a ModelConfig,
        most: u32,
    ) -> Pilots<'a> {
        let pixels = scene.camera.sensor.resolution.as_dvec2().element_product();
        let shared = |laser: f64| Reflections {
            most,
            from_laser: (laser * PILOT as f64) as u32,
            per_pixel: (1.0 - laser) * PILOT as f64 / CAMERA_PATH_TIME / pixels,
            line: false,
        };
        let alone = (!needs_camera(scene)).then(|| shared(1.0));
        Pilots {
            scene,
            accel,
            plan,
            strategies: alone.into_iter().chain([shared(0.5)]).collect(),
            seeds: 0..IMAGES,
        }
    }

    /// Returns the paths in addition to the lit curve and the resulting noise ratio. Returns `None`
    /// if the curve shortens the predicted time for equal noise by less than [`LEAST_SPEEDUP`], and if
    /// its noise is above [`NOISE`] and above the noise of [`MAX_LIGHT_PATHS`] paths.
    /// `without` is the number of paths without the curve for the ratio [`NOISE`].
    ///
    /// The squared ratio is a + b/n for n paths, where a belongs to the lit curve. Two numbers of
    /// paths determine a and b in the noisiest frame. Times follow from numbers of paths and pairs, so
    /// the result does not depend on the machine.
    fn with_line(
        &self,
        frames: &[u32],
        few: Reflections,
        without: f64,
        watch: &ProgressFn,
    ) -> Result<Option<(Reflections, f64)>> {
        let few = Reflections { line: true, ..few };
        let times = f64::from(SECOND_PILOT);
        let (mut first, mut noisiest, mut pairs) = (0.0, frames[0], 0.0f64);
        for &frame in frames {
            let pilot = self.pilot(frame, few, watch)?;
            pairs = pairs.max(pilot.pairs);
            if LEAST_SPEEDUP * self.line_time(pilot.pairs) >= without {
                return Ok(None);
            }
            if pilot.ratio > first {
                (first, noisiest) = (pilot.ratio, frame);
            }
        }
        let second = self.noise(noisiest, few.scaled(times), watch)?.powi(2);
        let of_paths = ((first.powi(2) - second) / (1.0 - 1.0 / times)).max(0.0);
        let of_line = (second - of_paths / times).max(0.0);
        // Paths do not have to be much better than the lit curve.
        let allowed = (NOISE.powi(2) - of_line).max(NOISE.powi(2) / 4.0);
        let paths = path_count(PILOT as f64 * of_paths / allowed);
        let chosen = paths as f64 / PILOT as f64;
        let noise = (of_line + of_paths / chosen).sqrt();
        let of_most_paths = NOISE * (without / MAX_LIGHT_PATHS as f64).sqrt();
        if noise > of_most_paths.max(NOISE) {
            return Ok(None);
        }
        let without = without / (noise / NOISE).max(1.0).powi(2);
        let is_shorter = LEAST_SPEEDUP * (paths as f64 + self.line_time(pairs)) < without;
        Ok(is_shorter.then(|| (few.scaled(chosen), noise)))
    }

    fn pixels(&self) -> f64 {
        let resolution = self.scene.camera.sensor.resolution;
        resolution.as_dvec2().element_product()
    }

    /// Returns the time for these pairs of node and receiver in each pose of an exposure, in light
    /// paths.
    fn line_time(&self, pairs: f64) -> f64 {
        PAIR_TIME * pairs * f64::from(self.scene.scan.motion_samples)
    }

    /// Returns the ratio of path noise to sensor noise for these paths in a frame.
    fn noise(&self, frame: u32, reflections: Reflections, watch: &ProgressFn) -> Result<f64> {
        Ok(self.pilot(frame, reflections, watch)?.ratio)
    }

    /// Measures the noise of these paths in a frame.
    fn pilot(&self, frame: u32, reflections: Reflections, watch: &ProgressFn) -> Result<Pilot> {
        let plan = ModelConfig {
            reflections: Some(reflections),
            ..self.plan.clone()
        };
        let sensor = &self.scene.camera.sensor;
        let electrons = sensor.electrons_per_irradiance(self.scene.laser.beam.wavelength);
        let mut pairs = 0.0f64;
        let mut images = Vec::new();
        for seed in self.seeds.clone() {
            let scene = Scene {
                seed,
                ..self.scene.clone()
            };
            let light = silent(scene, self.accel, plan.clone())?.indirect_light(frame);
            watch((seed + 1 - self.seeds.start) as f64 / IMAGES as f64)?;
            pairs = pairs.max(light.line_pairs as f64);
            let dense = light.mean.dense();
            images.push(dense.iter().map(|&e| f64::from(e) * electrons).collect());
        }
        let mut ratios = noise_ratios(sensor, &images);
        ratios.sort_by(f64::total_cmp);
        let at = ((1.0 - BEYOND) * ratios.len() as f64) as usize;
        let ratio = ratios.get(at).or(ratios.last()).copied().unwrap_or(0.0);
        Ok(Pilot { ratio, pairs })
    }
}

/// Images of one frame with independent seeds.
struct Pilot {
    /// Ratio of path noise to sensor noise.
    ratio: f64,
    /// Largest number of pairs of node and receiver in an image.
    pairs: f64,
}

/// Builds a simulation without speckle and noise. An error model with speckle would take long to
/// compute.
fn silent(scene: Scene, accel: &Arc<Accel>, plan: ModelConfig) -> Result<Simulation> {
    let scene = Scene {
        speckle: None,
        ..scene
    };
    let plan = ModelConfig {
        speckle: None,
        noise: false,
        blur: plan.blur.without_field(),
        ..plan
    };
    Simulation::with_plan(&scene, accel.clone(), plan)
}

/// Returns whether the camera may see mirrors or narrow lobes, which light paths rarely find.
fn needs_camera(scene: &Scene) -> bool {
    scene.surface.glossy().any(|glossy| {
        let mirrors = glossy
            .lobes
            .iter()
            .any(|(_, lobe)| matches!(lobe, Lobe::Mirror(_)));
        mirrors || glossy.min_roughness() < ROUGH
    })
}

/// Sums over the pixels of one block.
#[derive(Clone, Copy, Default)]
struct Square {
    pixels: f64,
    /// Sum of the light, electrons.
    light: f64,
    /// Sum of the variance between images.
    paths: f64,
}

impl Square {
    /// Returns the ratio of the standard deviation between images to the sensor noise, whose
    /// variance in the dark is `dark`. Returns `None` if neither light nor path noise exceeds the
    /// dark noise, or if the pixels are saturated.
    ///
    /// All values are averages over the block. One of few paths may saturate a pixel that many
    /// paths would not saturate.
    fn ratio(&self, dark: f64, full_well: f64) -> Option<f64> {
        let [light, paths] = [self.light, self.paths].map(|sum| sum / self.pixels);
        let shows = light * light >= dark || paths >= dark;
        (shows && light < full_well).then(|| (paths / (light + dark)).sqrt())
    }
}

/// Returns the ratio of the standard deviation between images to the sensor noise, for each block
/// with visible light or noise. Images are in electrons, row by row.
fn noise_ratios(sensor: &Sensor, images: &[Vec<f64>]) -> Vec<f64> {
    let dark = sensor.dark_variance_e();
    let [columns, rows] = sensor.resolution.to_array().map(|side| side as usize);
    let [across, down] = [columns, rows].map(|side| (side / SIDE).max(1));
    let count = images.len() as f64;
    let mut squares = vec![Square::default(); across * down];
    for pixel in 0..images[0].len() {
        let values = images.iter().map(|image| image[pixel]);
        let (sum, square) = values.fold((0.0, 0.0), |(s, q), e| (s + e, q + e * e));
        let mean = sum / count;
        let variance = (square / count - mean * mean) * count / (count - 1.0);
        let (row, column) = (
            pixel / columns * down / rows,
            pixel % columns * across / columns,
        );
        let square = &mut squares[row * across + column];
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
