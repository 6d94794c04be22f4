//! Compares the search with an exhaustive evaluation of all plans.

use super::*;
use crate::camera::SpeckleSizeRange;
use crate::math::rng::{Purpose, RngKey};
use crate::speckle::lookup::Method;

/// Returns a plan with speckle and noise. Fields that the search does not read are empty.
fn base() -> ModelConfig {
    ModelConfig {
        geometry_only: false,
        speckle: Some(Method::Field),
        noise: true,
        samples_per_side: 3,
        sampling: Sampling::Planes,
        blur: crate::frame::Blur::None,
        cutoff_radii: 3.06,
        line_half_width_px: 3.0,
        narrowest_half_width_px: 3.0,
        grain: SpeckleSizeRange::NONE,
        defocus_blur_px: 0.0,
        blurred_share: 0.0,
        defocus_noise_factor: 1.0,
        reflections: None,
        reflections_noise: None,
        airy_radius_px: 0.0,
        px_per_mm: 1.0,
        scheimpflug_tilt_deg: None,
        laser_plane_distance_mm: None,
        speckle_slips: false,
        effects: Vec::new(),
        accuracy: None,
    }
}

/// Random fractions of points beyond the tolerance for all plans. A finer method has a smaller
/// fraction. The fractions of methods add up.
struct Shares {
    key: RngKey,
}

impl Shares {
    fn drawn(seed: u64) -> Shares {
        Shares {
            key: RngKey::new(seed, Purpose::SensorNoise),
        }
    }

    fn of(&self, plan: &ModelConfig) -> f64 {
        let weight = |method: u64| 10f64.powf(-4.0 * self.key.uniform(method));
        let rays = plan.sampling == Sampling::Rays && plan.samples_per_side > 1;
        let left = [
            f64::from(u8::from(plan.speckle.is_none())),
            f64::from(u8::from(!plan.noise)),
            f64::from(u8::from(!rays)),
            f64::from(plan.samples_per_side).powi(-2),
            (-plan.cutoff_radii).exp(),
        ];
        (0u64..).zip(left).map(|(i, left)| weight(i) * left).sum()
    }
}

/// Returns random counts of a frame.
fn pilot(key: RngKey) -> PilotSample {
    let lit = 10f64.powf(3.0 + 2.0 * key.uniform(20));
    let radii = [1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.06];
    PilotSample {
        points: Vec::new(),
        pixels: 10f64.powf(4.0 + 2.0 * key.uniform(21)),
        columns: 1000.0,
        traced_pixels: radii.map(|r| (r, lit * r)).to_vec(),
        grain: None,
    }
}

const DRAWS: u64 = 200;

/// For limits between the fraction of the finest plan and that of the coarsest, no sufficient plan
/// is cheaper than the result. The search evaluates less than half of the plans.
#[test]
fn none_that_is_good_enough_is_cheaper_than_the_one_found() {
    let images = candidates(&base(), 8);
    let mut asked = 0;
    for seed in 0..DRAWS {
        let shares = Shares::drawn(seed);
        let pilot = pilot(shares.key);
        let cost = |plan: &ModelConfig| pilot.cost_ms(plan);
        let of = |plan: &&ModelConfig| shares.of(plan);
        let finest = images
            .iter()
            .min_by(|a, b| of(a).total_cmp(&of(b)))
            .unwrap();
        let coarsest = images.iter().map(|plan| of(&plan)).fold(0.0, f64::max);
        let limit = shares.of(finest) * (coarsest / shares.of(finest)).powf(shares.key.uniform(30));
        let is_kept = |plan: &ModelConfig, _| {
            asked += 1;
            Ok(shares.of(plan) <= limit)
        };
        let (plan, sure) = cheapest(finest, images.clone(), false, &cost, is_kept).unwrap();
        let within = images.iter().filter(|plan| of(plan) <= limit);
        let least = within.map(&cost).min_by(f64::total_cmp).unwrap();
        assert!(sure && shares.of(&plan) <= limit, "{seed}");
        assert_eq!(cost(&plan), least, "{seed}: {plan:?}");
    }
    assert!(asked < DRAWS as usize * images.len() / 2, "{asked}");
}

/// The geometric plan is chosen if it is allowed and sufficient. If no plan is surely sufficient,
/// the cheapest by estimate is chosen. If no plan is sufficient by estimate, the finest is chosen.
#[test]
fn what_is_not_sure_is_said_not_to_be() {
    let images = candidates(&base(), 8);
    let finest = images.last().unwrap();
    let cost = |plan: &ModelConfig| f64::from(plan.samples_per_side);
    let search = |geometry: bool, is_kept: &dyn Fn(&ModelConfig, Criterion) -> bool| {
        cheapest(finest, images.clone(), geometry, &cost, |plan, judged| {
            Ok(is_kept(plan, judged))
        })
        .unwrap()
    };
    let (plan, sure) = search(true, &|_, _| true);
    assert!(plan.geometry_only && sure);
    let (plan, sure) = search(false, &|_, _| true);
    assert!(!plan.geometry_only && plan.samples_per_side == 1 && sure);
    let (plan, sure) = search(true, &|plan, judged| {
        judged == Criterion::ByEstimate && plan.samples_per_side >= 4
    });
    assert_eq!((plan.samples_per_side, sure), (4, false));
    let (plan, sure) = search(true, &|_, _| false);
    let same = is_no_finer_than(&plan, finest) && is_no_finer_than(finest, &plan);
    assert!(same && !plan.geometry_only && !sure);
}

/// A plan that is no finer in any respect does not cost more, for all counts of a frame. Otherwise
/// the omission of an effect could be more expensive than its simulation.
#[test]
fn what_is_in_nothing_finer_costs_no_more() {
    let images = candidates(&base(), 8);
    for seed in 0..20 {
        let pilot = pilot(RngKey::new(seed, Purpose::SensorNoise));
        for plan in &images {
            for other in images.iter().filter(|other| is_no_finer_than(plan, other)) {
                assert!(
                    pilot.cost_ms(plan) <= pilot.cost_ms(other),
                    "{seed}: {plan:?} {other:?}"
                );
            }
        }
    }
}
