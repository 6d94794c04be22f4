//! The search against a look at every plan.

use super::*;
use crate::camera::GrainExtent;
use crate::math::rng::{Key, Purpose};
use crate::speckle::lookup::Method;

/// A plan with speckle and noise; what no search asks for is left at nothing.
fn base() -> Plan {
    Plan {
        geometry_only: false,
        speckle: Some(Method::Field),
        noise: true,
        samples_per_side: 3,
        sampling: Sampling::Planes,
        blur: crate::frame::Blur::None,
        cutoff_radii: 3.06,
        line_half_width_px: 3.0,
        narrowest_half_width_px: 3.0,
        grain: GrainExtent::NONE,
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

/// Shares beyond of all plans: a finer method leaves less, by amounts drawn at random; the
/// shares of methods add up.
struct Shares {
    key: Key,
}

impl Shares {
    fn drawn(seed: u64) -> Shares {
        Shares {
            key: Key::new(seed, Purpose::SensorNoise),
        }
    }

    fn of(&self, plan: &Plan) -> f64 {
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

/// Counts of a frame drawn at random.
fn pilot(key: Key) -> Pilot {
    let lit = 10f64.powf(3.0 + 2.0 * key.uniform(20));
    let radii = [1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.06];
    Pilot {
        points: Vec::new(),
        pixels: 10f64.powf(4.0 + 2.0 * key.uniform(21)),
        columns: 1000.0,
        looked_at: radii.map(|r| (r, lit * r)).to_vec(),
        grain: None,
    }
}

const DRAWS: u64 = 200;

/// For limits from what the finest plan leaves to what the coarsest does: of all plans that are
/// within, none is cheaper than the one found. Most are never asked for.
#[test]
fn none_that_is_good_enough_is_cheaper_than_the_one_found() {
    let images = candidates(&base(), 8);
    let mut asked = 0;
    for seed in 0..DRAWS {
        let shares = Shares::drawn(seed);
        let pilot = pilot(shares.key);
        let cost = |plan: &Plan| pilot.cost_ms(plan);
        let of = |plan: &&Plan| shares.of(plan);
        let finest = images
            .iter()
            .min_by(|a, b| of(a).total_cmp(&of(b)))
            .unwrap();
        let coarsest = images.iter().map(|plan| of(&plan)).fold(0.0, f64::max);
        let limit = shares.of(finest) * (coarsest / shares.of(finest)).powf(shares.key.uniform(30));
        let is_kept = |plan: &Plan, _| {
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

/// Geometry is taken where it may be and is good enough; where no plan surely is, the cheapest
/// by estimate; where none is by estimate either, the finest.
#[test]
fn what_is_not_sure_is_said_not_to_be() {
    let images = candidates(&base(), 8);
    let finest = images.last().unwrap();
    let cost = |plan: &Plan| f64::from(plan.samples_per_side);
    let search = |geometry: bool, is_kept: &dyn Fn(&Plan, Judged) -> bool| {
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
        judged == Judged::ByEstimate && plan.samples_per_side >= 4
    });
    assert_eq!((plan.samples_per_side, sure), (4, false));
    let (plan, sure) = search(true, &|_, _| false);
    let same = no_finer(&plan, finest) && no_finer(finest, &plan);
    assert!(same && !plan.geometry_only && !sure);
}

/// A plan that is in nothing finer costs no more, whatever a frame's counts are: else leaving
/// something out could be dearer than doing it.
#[test]
fn what_is_in_nothing_finer_costs_no_more() {
    let images = candidates(&base(), 8);
    for seed in 0..20 {
        let pilot = pilot(Key::new(seed, Purpose::SensorNoise));
        for plan in &images {
            for other in images.iter().filter(|other| no_finer(plan, other)) {
                assert!(
                    pilot.cost_ms(plan) <= pilot.cost_ms(other),
                    "{seed}: {plan:?} {other:?}"
                );
            }
        }
    }
}
