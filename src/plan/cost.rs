//! What a plan costs: predicted from counts of what a frame does.

use super::accuracy::Pilot;
use super::chosen::Plan;
use crate::frame::{Blur, Sampling, TILE, reach_px};
use crate::speckle::lookup::Method;

/// Time of one of each, ns: fitted to the demo's rows of `lasertrace chart`, which they
/// gave to 21 %.
struct Cost {
    /// A camera ray with its shadow ray.
    ray: f64,
    /// The same through a pixel's centre, with what is asked of its neighbours.
    center: f64,
    /// A sample on a known plane, and its share of those that have a ray.
    sample: f64,
    /// Counts and peaks of one pixel of the sensor.
    pixel: f64,
    noise: f64,
    speckle_field: f64,
    speckle_sample: f64,
    /// A column of a geometric profile.
    geometric: f64,
    /// A sample of a tile that the lens spreads light in.
    blur: f64,
}

const COST: Cost = Cost {
    ray: 280.0,
    center: 400.0,
    sample: 18.0,
    pixel: 5.0,
    noise: 4.7,
    speckle_field: 1.2e6,
    speckle_sample: 10.0,
    geometric: 700.0,
    blur: 30.0,
};

fn speckle_ns(plan: &Plan, samples: f64) -> f64 {
    match plan.speckle {
        Some(_) => COST.speckle_field + COST.speckle_sample * samples,
        None => 0.0,
    }
}

fn noise_ns(plan: &Plan, pixels: f64) -> f64 {
    if plan.noise { COST.noise * pixels } else { 0.0 }
}

impl Pilot {
    /// Pixels of a frame that are looked at.
    fn looked_at(&self, plan: &Plan) -> f64 {
        let of = |(radii, _): &&(f64, f64)| *radii >= plan.cutoff_radii;
        let widest = self.looked_at.last().map_or(0.0, |(_, pixels)| *pixels);
        self.looked_at
            .iter()
            .find(of)
            .map_or(widest, |(_, pixels)| *pixels)
    }

    fn blur_ns(&self, plan: &Plan) -> f64 {
        let grain = plan.grain.speckle_extent_px;
        let margin = |grain: f64| reach_px(plan.defocus_blur_px, grain);
        let high = self.looked_at(plan) / self.columns + 2.0 * margin(grain[1]);
        let wide = self.columns * (1.0 + 2.0 * margin(grain[0]) / TILE);
        match plan.blur {
            Blur::None => 0.0,
            _ => COST.blur * wide * high * (plan.samples_per_side as f64).powi(2),
        }
    }

    /// Predicted time of one frame on one core, ms, from the counts of what it does
    /// and the times these took in the demo (`lasertrace chart`): good to a factor of
    /// two elsewhere, and for comparing plans.
    pub fn cost_ms(&self, plan: &Plan) -> f64 {
        let ns = match plan.geometry_only {
            true => COST.geometric * self.columns,
            false => {
                let pixels = self.looked_at(plan);
                let samples = pixels * (plan.samples_per_side as f64).powi(2);
                let light = match plan.sampling {
                    _ if plan.samples_per_side == 1 => COST.center * pixels,
                    Sampling::Rays => COST.ray * samples,
                    Sampling::Planes => COST.center * pixels + COST.sample * samples,
                };
                light
                    + COST.pixel * self.pixels
                    + self.blur_ns(plan)
                    + speckle_ns(plan, samples)
                    + noise_ns(plan, self.pixels)
            }
        };
        ns * 1e-6
    }

    /// Of it that of speckle and of noise, modelled or not.
    pub fn cost_of_randomness_ms(&self, plan: &Plan) -> [f64; 2] {
        let samples = self.looked_at(plan) * (plan.samples_per_side as f64).powi(2);
        let with = Plan {
            speckle: Some(Method::Field),
            noise: true,
            ..plan.clone()
        };
        [speckle_ns(&with, samples), noise_ns(&with, self.pixels)].map(|ns| ns * 1e-6)
    }
}
