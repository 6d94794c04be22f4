//! Cost model: predicts the time per frame from the number of operations.

use super::accuracy::PilotSample;
use super::config::ModelConfig;
use crate::frame::{Blur, Sampling, TILE, reach_px};
use crate::speckle::lookup::Method;

/// Time per operation, ns. The values were fitted to `lasertrace chart` of the demo, with residuals
/// up to 21 %.
struct Cost {
    /// Camera ray with its shadow ray.
    ray: f64,
    /// Camera ray of a pixel centre with its shadow ray and the classification of its
    /// neighbourhood.
    center: f64,
    /// Sample on a known plane, including a proportion of samples with a separate ray.
    sample: f64,
    /// Counts and peak detection, per sensor pixel.
    pixel: f64,
    noise: f64,
    speckle_field: f64,
    speckle_sample: f64,
    /// Column of a geometric profile.
    geometric: f64,
    /// Sample of a tile that is blurred.
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

fn speckle_ns(plan: &ModelConfig, samples: f64) -> f64 {
    match plan.speckle {
        Some(_) => COST.speckle_field + COST.speckle_sample * samples,
        None => 0.0,
    }
}

fn noise_ns(plan: &ModelConfig, pixels: f64) -> f64 {
    if plan.noise { COST.noise * pixels } else { 0.0 }
}

impl PilotSample {
    /// Returns the number of traced pixels per frame.
    fn traced_pixels(&self, plan: &ModelConfig) -> f64 {
        let of = |(radii, _): &&(f64, f64)| *radii >= plan.cutoff_radii;
        let widest = self.traced_pixels.last().map_or(0.0, |(_, pixels)| *pixels);
        self.traced_pixels
            .iter()
            .find(of)
            .map_or(widest, |(_, pixels)| *pixels)
    }

    fn blur_ns(&self, plan: &ModelConfig) -> f64 {
        let grain = plan.grain.speckle_extent_px;
        let margin = |grain: f64| reach_px(plan.defocus_blur_px, grain);
        let high = self.traced_pixels(plan) / self.columns + 2.0 * margin(grain[1]);
        let wide = self.columns * (1.0 + 2.0 * margin(grain[0]) / TILE);
        match plan.blur {
            Blur::None => 0.0,
            _ => COST.blur * wide * high * (plan.samples_per_side as f64).powi(2),
        }
    }

    /// Predicts the time per frame on one core, ms. The times per operation were measured with the
    /// demo (`lasertrace chart`). For other scenes, the prediction is accurate to a factor of two
    /// and allows comparison of configurations.
    pub fn cost_ms(&self, plan: &ModelConfig) -> f64 {
        let ns = match plan.geometry_only {
            true => COST.geometric * self.columns,
            false => {
                let pixels = self.traced_pixels(plan);
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

    /// Returns the cost of speckle and the cost of noise per frame, ms, as if both were simulated.
    pub fn cost_of_randomness_ms(&self, plan: &ModelConfig) -> [f64; 2] {
        let samples = self.traced_pixels(plan) * (plan.samples_per_side as f64).powi(2);
        let with = ModelConfig {
            speckle: Some(Method::Field),
            noise: true,
            ..plan.clone()
        };
        [speckle_ns(&with, samples), noise_ns(&with, self.pixels)].map(|ns| ns * 1e-6)
    }
}
