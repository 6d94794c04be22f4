//! A few frames without speckle and noise, from which the plan for a tolerance
//! predicts what each effect does to the scene's points.

use super::Simulation;
use super::measure::error_model;
use crate::accel::{Accel, Clusters};
use crate::error::Result;
use crate::integrator::accuracy::{Grain, Pilot, PilotPoint, geometry_only};
use crate::integrator::{Plan, Sampling};
use crate::math::DVec2;
use crate::profile::{ErrorModel, Peak, WEAK_SNR};
use crate::scene::Scene;
use rayon::prelude::*;
use std::sync::Arc;

/// Frames of a pilot, evenly spread over the scan.
const FRAMES: u32 = 5;
/// Points of a pilot that are looked at, evenly spread.
const POINTS: usize = 2000;
/// Samples a side of the frame that those with 1 and 2 are held against.
const SAMPLES: u32 = 4;

/// `wanted` frames in the middle of as many equal parts of the scan; fewer if it has
/// fewer.
pub(super) fn spread_frames(frames: u32, wanted: u32) -> Vec<u32> {
    let wanted = wanted.min(frames);
    let middle = |i: u32| (frames as u64 * (2 * i as u64 + 1) / (2 * wanted as u64)) as u32;
    (0..wanted).map(middle).collect()
}

/// The simulations that a pilot compares.
struct Compared<'s> {
    fine: Simulation<'s>,
    coarse: [Simulation<'s>; 2],
    geometric: Simulation<'s>,
    models: Models,
}

/// Errors of rows from one cause each.
struct Models {
    speckle: ErrorModel,
    shot: ErrorModel,
    none: ErrorModel,
    /// Noise of dark pixels, counts.
    dark: f64,
    columns: usize,
}

impl Models {
    fn new(scene: &Scene) -> Models {
        let sensor = &scene.camera.sensor;
        let finder = scene.measure.finder;
        let shot = sensor.noise.map_or(0.0, |_| sensor.gain_dn_per_e);
        let read = sensor.noise.map_or(0.0, |n| n.read_noise_e);
        Models {
            speckle: error_model(scene).without_shot(),
            shot: ErrorModel::new(finder, shot, None),
            none: ErrorModel::new(finder, 0.0, None),
            dark: (read * sensor.gain_dn_per_e).hypot(1.0 / 12f64.sqrt()),
            columns: sensor.resolution.x as usize,
        }
    }

    /// Standard deviations of the rows of `peaks` from speckle, from noise, and from
    /// pixels that err by one count.
    fn deviations(&self, peaks: &[Peak]) -> Vec<[f64; 3]> {
        let of = |model: &ErrorModel, noise: f64| {
            let mut peaks = peaks.to_vec();
            peaks.iter_mut().for_each(|peak| peak.noise = noise);
            model.row_errors(&mut peaks, self.columns)
        };
        let none = of(&self.none, 0.0);
        let all = [
            of(&self.speckle, 0.0),
            of(&self.shot, self.dark),
            of(&self.none, 1.0),
        ];
        // What is left without any is the finder's own bias.
        let less = |with: f64, none: f64| (with * with - none * none).max(0.0).sqrt();
        (0..peaks.len())
            .map(|i| {
                all.each_ref()
                    .map(|errors| less(errors[i].sigma, none[i].sigma))
            })
            .collect()
    }
}

/// Looks at some frames of a scene; `plans` are those to choose from, `base` is the
/// scene's without a tolerance.
pub(super) fn pilot<'s>(
    scene: &'s Scene,
    accel: &Arc<Accel<'s>>,
    base: &Plan,
    plans: &[Plan],
) -> Result<Pilot> {
    let clusters = Arc::new(Clusters::new(&scene.mesh));
    let clean = |samples_per_side| {
        let plan = Plan {
            geometry_only: false,
            speckle: None,
            noise: false,
            sampling: Sampling::Planes,
            samples_per_side,
            ..base.clone()
        };
        let simulation = Simulation::with_plan(scene, accel.clone(), plan)?;
        Result::Ok(simulation.with_clusters(clusters.clone()))
    };
    let compared = Compared {
        fine: clean(SAMPLES)?,
        coarse: [clean(1)?, clean(2)?],
        geometric: Simulation::with_plan(scene, accel.clone(), geometry_only(base.clone()))?,
        models: Models::new(scene),
    };
    let frames = spread_frames(scene.scan.frames, FRAMES);
    let found: Vec<Vec<PilotPoint>> = frames.par_iter().map(|&f| compared.frame(f)).collect();
    let lines = found.iter().map(Vec::len).sum::<usize>();
    let sensor = &scene.camera.sensor;
    let grains = 1.0 / base.grain.speckle_size_px;
    let each = lines.div_ceil(POINTS).max(1);
    Ok(Pilot {
        points: found.into_iter().flatten().step_by(each).collect(),
        lines: lines as f64 / frames.len().max(1) as f64,
        pixels: sensor.resolution.as_dvec2().element_product(),
        columns: sensor.resolution.x as f64,
        dark: compared.models.dark,
        step: sensor.noise.map_or(1.0, |_| sensor.gain_dn_per_e.max(1.0)),
        grain: scene
            .speckle
            .map(|s| Grain::new(s.aperture, grains, s.coherence.contrast(), plans)),
        frames,
    })
}

impl Compared<'_> {
    fn frame(&self, frame: u32) -> Vec<PilotPoint> {
        let scene = self.fine.scene;
        let columns = scene.camera.sensor.resolution.x as usize;
        let peaks = |simulation: &Simulation| {
            let counts = simulation.counts(frame, &simulation.irradiance(frame));
            simulation.peaks(&counts).0
        };
        let by_column = |peaks: Vec<Peak>| {
            let mut rows = vec![None; columns];
            for peak in peaks {
                rows[peak.column as usize] = Some(peak.row);
            }
            rows
        };
        let fine = peaks(&self.fine);
        let coarse = self.coarse.each_ref().map(|s| by_column(peaks(s)));
        let geometry = by_column(self.geometric.geometric_peaks(frame).0);
        // Without noise fainter lines are found than a real image would show.
        let faintest = match scene.camera.sensor.noise {
            Some(_) => WEAK_SNR * self.models.dark,
            None => 0.0,
        };
        let deviations = self.models.deviations(&fine);
        let seen = fine.iter().zip(deviations);
        let seen = seen.filter(|(peak, _)| peak.flags.is_sound() && peak.height >= faintest);
        let point = |(peak, [speckle, noise, per_count]): (&Peak, [f64; 3])| {
            let column = peak.column as usize;
            let place = DVec2::new(column as f64 + 0.5, peak.row);
            let jacobian = self.fine.calibration.point_jacobian(place)?;
            let off = |rows: &[Option<f64>]| rows[column].map(|row| row - peak.row);
            Some(PilotPoint {
                um_per_px: jacobian.by_pixel[1].length() * 1e3,
                // A line within one pixel measures as of no width.
                sigma: peak.sigma.max(0.1),
                height: peak.height,
                speckle,
                noise,
                per_count,
                geometry: off(&geometry),
                coarse: coarse.each_ref().map(|rows| off(rows)),
            })
        };
        seen.filter_map(point).collect()
    }
}
