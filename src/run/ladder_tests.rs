//! Tests for the order of the rungs and for the choice among them.

use super::*;
use crate::camera::SpeckleSizeRange;
use crate::frame::Blur;
use crate::math::rng::{Purpose, RngKey};
use crate::speckle::lookup::Method;

/// Returns a plan with speckle and noise. Fields that the ladder does not read are empty.
fn base(samples_per_side: u32, beam_cutoff_radii: f64) -> ModelConfig {
    ModelConfig {
        geometry_only: false,
        speckle: Some(Method::Field),
        noise: true,
        samples_per_side,
        sampling: Sampling::Planes,
        blur: Blur::Coherent,
        beam_cutoff_radii,
        line_half_width_px: 3.0,
        narrowest_half_width_px: 3.0,
        grain: SpeckleSizeRange::NONE,
        defocus_blur_px: 0.0,
        defocused_fraction: 0.0,
        defocus_noise_factor: 1.0,
        reflections: None,
        reflections_noise: None,
        airy_radius_px: 0.0,
        px_per_mm: 1.0,
        scheimpflug_tilt_deg: None,
        laser_plane_distance_mm: None,
        local_speckle_motion: false,
        effects: Vec::new(),
        accuracy: None,
    }
}

fn rungs(base: &ModelConfig, full_samples: u32) -> Vec<(&'static Rung, ModelConfig)> {
    let config = |rung: &'static Rung| (rung, rung.config(base, full_samples));
    LADDER.iter().map(config).collect()
}

/// In every method, each rung is at least as fine as the rung before it. The rung of the rules is
/// the plan without a tolerance, and only rungs before it omit effects.
#[test]
fn the_ladder_ascends() {
    for seed in 0..20 {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let samples = 1 + (8.0 * key.uniform(0)) as u32;
        let base = base(samples, 1.0 + 2.1 * key.uniform(1));
        let full = samples.max(4) + (8.0 * key.uniform(2)) as u32;
        let rungs = rungs(&base, full);
        let rays = |plan: &ModelConfig| plan.sampling == Sampling::Rays;
        for ((lower, a), (upper, b)) in rungs.iter().zip(&rungs[1..]) {
            assert!(a.geometry_only >= b.geometry_only, "{lower:?} {upper:?}");
            assert!(a.speckle.is_some() <= b.speckle.is_some());
            assert!(a.noise <= b.noise && a.blur <= b.blur && rays(a) <= rays(b));
            assert!(a.samples_per_side <= b.samples_per_side);
            assert!(a.beam_cutoff_radii <= b.beam_cutoff_radii);
            assert!(lower.omits() >= upper.omits());
        }
        let (rung, plan) = &rungs[first_complete(&rungs)];
        assert_eq!(rung.name, "rules");
        assert_eq!(format!("{plan:?}"), format!("{base:?}"));
    }
}

/// The result is the first rung that meets the tolerance, for random fractions of points beyond it.
/// If the last rung does not meet it at the stated confidence, nothing is omitted.
#[test]
fn the_first_sufficient_rung_is_chosen() {
    let rungs = rungs(&base(3, 3.06), 4);
    let index = |plan: &ModelConfig| {
        let same = |other: &ModelConfig| format!("{other:?}") == format!("{plan:?}");
        rungs.iter().position(|(_, other)| same(other)).unwrap()
    };
    let complete = first_complete(&rungs);
    for seed in 0..200 {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let kept: Vec<[bool; 2]> = (0..rungs.len() as u64)
            .map(|i| {
                let u = key.uniform(i);
                // A rung that is surely sufficient is also sufficient by estimate.
                [u < 0.3, u < 0.6]
            })
            .collect();
        let mut tested = 0;
        let is_kept = |plan: &ModelConfig, judged: Criterion| {
            tested += 1;
            Ok(kept[index(plan)][usize::from(judged == Criterion::ByEstimate)])
        };
        let (chosen, sure) = first_sufficient(&rungs, is_kept).unwrap();
        let last = rungs.len() - 1;
        let expected = match kept[last] {
            [true, _] => (kept.iter().position(|kept| kept[0]).unwrap(), true),
            [_, true] => {
                let first = kept[complete..].iter().position(|kept| kept[1]).unwrap();
                (complete + first, false)
            }
            _ => (last, false),
        };
        assert_eq!((chosen, sure), expected, "{seed}: {kept:?}");
        assert!(tested <= rungs.len() + 1);
    }
}
