//! Tests of energy conservation and reciprocity of the lobes, by independent quadrature.

use super::albedo::Albedo;
use super::*;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3};
use std::f64::consts::PI;

/// Returns the albedo of `bsdf` for light from `o`.
///
/// The value combines two midpoint rules: one follows facets distributed as D (Walter et al. 2007),
/// and one follows the cosine. Each is weighted by its fraction of both densities (Veach 1995), so
/// that neither misses a peak.
fn power(facets: &Ggx, o: DVec3, bsdf: impl Fn(DVec3) -> f64) -> f64 {
    const STEPS: usize = 300;
    let of_facets = |i: DVec3| {
        let m = (i + o).normalize();
        facets.normal_distribution(m) * m.z / (4.0 * o.dot(m).max(1e-12))
    };
    let of_cosine = |i: DVec3| i.z / PI;
    let mut sum = 0.0;
    for k in 0..STEPS * STEPS {
        let u = DVec2::new((k % STEPS) as f64 + 0.5, (k / STEPS) as f64 + 0.5) / STEPS as f64;
        let (sin, cos) = (2.0 * PI * u.y).sin_cos();
        let tan = (u.x / (1.0 - u.x)).sqrt();
        let m = DVec3::new(facets.alpha_u * tan * cos, facets.alpha_v * tan * sin, 1.0).normalize();
        let mirrored = m * (2.0 * o.dot(m)) - o;
        let even = DVec3::new(u.x.sqrt() * cos, u.x.sqrt() * sin, (1.0 - u.x).sqrt());
        for i in [mirrored, even] {
            if i.z > 0.0 {
                sum += bsdf(i) * i.z / (of_facets(i) + of_cosine(i));
            }
        }
    }
    sum / (STEPS * STEPS) as f64
}

fn towards(degrees: f64, azimuth: f64) -> DVec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let (y, x) = azimuth.to_radians().sin_cos();
    DVec3::new(sin * x, sin * y, cos)
}

const ROUGH: [[f64; 2]; 6] = [
    [0.02, 0.02],
    [0.1, 0.1],
    [0.4, 0.4],
    [1.0, 1.0],
    [0.05, 0.3],
    [0.2, 0.8],
];

/// White furnace test: metal of reflectance 1 reflects all light from each direction. The required
/// accuracy is 0.5 %.
#[test]
fn white_metal_loses_nothing() {
    for [along, across] in ROUGH {
        let facets = Ggx {
            alpha_u: along,
            alpha_v: across,
        };
        let metal = Conductor::white(facets);
        let once = |i, o| facets.bsdf(i, o, |_| 1.0);
        for angle in [0.0, 30.0, 60.0, 80.0, 87.0] {
            let azimuths: &[f64] = if along == across {
                &[0.0]
            } else {
                &[0.0, 35.0, 90.0]
            };
            for &azimuth in azimuths {
                let o = towards(angle, azimuth);
                let all = power(&facets, o, |i| metal.bsdf(i, o));
                assert!(
                    (all - 1.0).abs() < 5e-3,
                    "{along} {across} {angle} {azimuth}: {all}"
                );
                // Without compensation of multiple scattering, rough metal fails the test.
                let lost = 1.0 - power(&facets, o, |i| once(i, o));
                assert!(along < 1.0 || lost > 0.1, "{lost}");
            }
        }
    }
}

/// Energy lost at the first facet for F = 1: 1 − E(μ), and 1 − E_avg. Two independent integrations
/// give equal values in these three digits.
const LOST: [(f64, [f64; 5]); 6] = [
    (0.01, [1.01e-4, 1.31e-4, 2.58e-4, 1.41e-3, 5.1e-4]),
    (0.02, [4.1e-4, 5.3e-4, 1.07e-3, 6.05e-3, 1.76e-3]),
    (0.05, [2.70e-3, 3.54e-3, 7.28e-3, 3.74e-2, 8.71e-3]),
    (0.1, [1.17e-2, 1.54e-2, 3.08e-2, 9.54e-2, 2.79e-2]),
    (0.2, [5.24e-2, 6.63e-2, 0.105, 0.142, 8.42e-2]),
    (0.4, [0.213, 0.231, 0.243, 0.184, 0.227]),
];

fn at_cosine(mu: f64) -> DVec3 {
    DVec3::new((1.0 - mu * mu).sqrt(), 0.0, mu)
}

/// The loss agrees with the reference values, which are rounded to at most 1 %. The table is linear
/// in √μ, with an error of 0.3 % of the mean.
#[test]
fn lost_energy_is_that_of_the_reference() {
    for (alpha, reference) in LOST {
        let facets = Ggx {
            alpha_u: alpha,
            alpha_v: alpha,
        };
        let albedo = Albedo::new(&facets, |_| 1.0);
        let found = [1.0, 0.8, 0.5, 0.2].map(|mu| 1.0 - facets.albedo(at_cosine(mu), |_| 1.0));
        let read = [1.0, 0.8, 0.5, 0.2].map(|mu| 1.0 - albedo.of(at_cosine(mu)));
        for (k, expected) in reference.into_iter().enumerate().take(4) {
            assert!(
                (found[k] / expected - 1.0).abs() < 0.01,
                "{alpha} {k}: {}",
                found[k]
            );
            assert!(
                (read[k] / expected - 1.0).abs() < 0.015,
                "{alpha} {k}: {}",
                read[k]
            );
        }
        let mean = 1.0 - albedo.mean;
        assert!((mean / reference[4] - 1.0).abs() < 0.013, "{alpha}: {mean}");
    }
}

/// For random roughness and directions from three seeds, the loss agrees with a midpoint rule of
/// 4000 × 200 nodes in v = −ln(1 − u). The error of this rule, averaged over azimuths, is below
/// 1e-4 of the loss. It is caused by a discontinuity within one cell.
#[test]
fn lost_energy_is_that_of_a_fine_rule() {
    for seed in [1, 2, 3] {
        let key = RngKey::new(seed, Purpose::Samples);
        for k in 0..3u64 {
            let draw = |i: u64| key.with(k).uniform(i);
            let roughness = |i: u64| 0.01 * 40f64.powf(draw(i));
            let facets = Ggx {
                alpha_u: roughness(0),
                alpha_v: roughness(1),
            };
            let o = towards(85.0 * draw(2), 360.0 * draw(3));
            let (rings, azimuths, furthest) = (4000, 200, 36.0);
            let seen = facets.lambda(o);
            let mut loss = 0.0;
            for ring in 0..rings {
                let v = furthest * (ring as f64 + 0.5) / rings as f64;
                let weight = (-v).exp() * furthest / rings as f64 / azimuths as f64;
                for azimuth in 0..azimuths {
                    let azimuth = (azimuth as f64 + 0.5) / azimuths as f64;
                    let m = facets.sample_visible_normal(o, DVec2::new(-(-v).exp_m1(), azimuth));
                    let i = m * (2.0 * o.dot(m)) - o;
                    let kept = match i.z > 0.0 {
                        true => (1.0 + seen) / (1.0 + seen + facets.lambda(i)),
                        false => 0.0,
                    };
                    loss += weight * (1.0 - kept);
                }
            }
            let found = 1.0 - facets.albedo(o, |_| 1.0);
            assert!(
                (found / loss - 1.0).abs() < 0.01,
                "{facets:?} {o}: {found} {loss}"
            );
        }
    }
}

/// A white coat reflects all light. Other coats and metals reflect less.
#[test]
fn coats_and_metals_make_no_light() {
    for [along, across] in ROUGH {
        let facets = Ggx {
            alpha_u: along,
            alpha_v: across,
        };
        let metal = Conductor::new(1.6575, 9.2238, facets);
        let white = CoatedDiffuse::new(1.5, 1.0, facets);
        let grey = CoatedDiffuse::new(1.5, 0.5, facets);
        for angle in [0.0, 45.0, 80.0] {
            let o = towards(angle, 20.0);
            let all =
                |coat: &CoatedDiffuse| power(&facets, o, |i| coat.gloss(i, o) + coat.body(i, o));
            assert!(
                (all(&white) - 1.0).abs() < 5e-3,
                "{along} {angle} {}",
                all(&white)
            );
            // ρ = 0.5 within n = 1.5: (1 − E)·ρ·out/(1 − ρ(1 − out)), out = 0.404 (Saunderson
            // 1942).
            assert!((0.25..0.7).contains(&all(&grey)), "{}", all(&grey));
            let metal = power(&facets, o, |i| metal.bsdf(i, o));
            assert!(
                (0.8..0.97).contains(&metal),
                "{along} {across} {angle} {metal}"
            );
        }
    }
}

/// A smooth coat (α = 0.01) of n = 1.5 over ρ = 0.5 agrees with Saunderson (1942) outside the
/// specular lobe. The formula is (1 − F)²·ρ/(π·n²·(1 − ρ·r)) with r = 1 − (1 − 0.0918)/n².
#[test]
fn a_smooth_coat_is_saundersons() {
    let facets = Ggx {
        alpha_u: 0.01,
        alpha_v: 0.01,
    };
    let coat = CoatedDiffuse::new(1.5, 0.5, facets);
    let (i, o) = (towards(20.0, 0.0), towards(20.0, 90.0));
    let fresnel = 1.0 - fresnel::dielectric(1.5, i.z);
    let held = 1.0 - (1.0 - 0.0918) / 2.25;
    let expected = fresnel * fresnel * 0.5 / (PI * 2.25 * (1.0 - 0.5 * held));
    let found = coat.body(i, o);
    // The table has 65 nodes, and E_avg refers to a surface that is not perfectly smooth.
    assert!((found / expected - 1.0).abs() < 2e-3, "{found} {expected}");
}

/// Reciprocity f(i, o) = f(o, i) holds to 1e-6 in random directions for a mixture of all lobes with
/// a lay.
#[test]
fn light_may_go_both_ways() {
    let facets = Ggx {
        alpha_u: 0.07,
        alpha_v: 0.4,
    };
    let lobes = vec![
        (0.3, Lobe::Diffuse(Lambert { reflectance: 0.8 })),
        (0.4, Lobe::Metal(Conductor::new(2.9, 3.1, facets))),
        (
            0.3,
            Lobe::CoatedDiffuse(CoatedDiffuse::new(1.6, 0.4, facets)),
        ),
    ];
    let lay = Lay::About {
        point: DVec3::new(1.0, 2.0, 3.0),
        axis: DVec3::Z,
    };
    let surface = Surface::Layered(Arc::new(LayeredBrdf {
        lobes,
        lay: Some(lay),
    }));
    let key = RngKey::new(3, Purpose::SensorNoise);
    for trial in 0..2000 {
        let random = |j| key.with(trial).uniform(j);
        let any = |j| (DVec3::new(random(j), random(j + 1), random(j + 2)) - 0.5).normalize();
        let normal = any(0);
        let above = |v: DVec3| if v.dot(normal) < 0.0 { -v } else { v };
        let (i, o, point) = (above(any(3)), above(any(6)), any(9) * 10.0);
        let there = surface.bsdf(point, normal, i, o);
        let back = surface.bsdf(point, normal, o, i);
        assert!(there > 0.0 && there.is_finite());
        assert!((there / back - 1.0).abs() < 1e-6, "{there} {back}");
        assert_eq!(surface.bsdf(point, normal, -normal, o), 0.0);
    }
}

/// Grooves along x scatter light across x. A rotation of the lay by 90° equals a rotation of the
/// surface.
#[test]
fn the_lay_turns_the_lobe() {
    let facets = Ggx {
        alpha_u: 0.05,
        alpha_v: 0.4,
    };
    let milled = |lay| {
        let lobes = vec![(1.0, Lobe::Metal(Conductor::new(1.6575, 9.2238, facets)))];
        Surface::Layered(Arc::new(LayeredBrdf {
            lobes,
            lay: Some(lay),
        }))
    };
    let along_x = milled(Lay::Along(DVec3::X));
    let seen = |surface: &Surface, point: DVec3, azimuth: f64| {
        surface.bsdf(point, DVec3::Z, DVec3::Z, towards(30.0, azimuth))
    };
    let [beside, across] = [0.0, 90.0].map(|azimuth| seen(&along_x, DVec3::ZERO, azimuth));
    assert!(across > 5.0 * beside, "{across} {beside}");
    let turned = milled(Lay::About {
        point: DVec3::ZERO,
        axis: DVec3::Z * 1.0,
    });
    // At (0, −1), grooves about z run along x; at (1, 0), along y.
    for (point, turn) in [(DVec3::NEG_Y, 0.0), (DVec3::X, 90.0)] {
        for azimuth in [0.0, 20.0, 90.0] {
            let there = seen(&turned, point, azimuth + turn);
            let here = seen(&along_x, DVec3::ZERO, azimuth);
            assert!((there / here - 1.0).abs() < 1e-12, "{there} {here}");
        }
    }
    // On the axis, the lay is undefined, but the BRDF is positive.
    assert!(seen(&turned, DVec3::ZERO, 10.0) > 0.0);
}

/// Metal preserves polarisation, diffuse reflection does not, and a coated surface mixes both.
#[test]
fn polarisation_follows_the_lobe() {
    let facets = Ggx {
        alpha_u: 0.1,
        alpha_v: 0.1,
    };
    let of = |lobe: Lobe, eye: DVec3| {
        let surface = LayeredBrdf {
            lobes: vec![(1.0, lobe)],
            lay: None,
        };
        let lit = surface.lit(DVec3::ZERO, DVec3::Z, towards(30.0, 180.0));
        lit.degree_of_polarisation(eye)
    };
    let mirrored = towards(30.0, 0.0);
    assert_eq!(
        of(Lobe::Metal(Conductor::new(2.9, 3.1, facets)), mirrored),
        1.0
    );
    assert_eq!(
        of(Lobe::Diffuse(Lambert { reflectance: 0.5 }), mirrored),
        0.0
    );
    let paint = || Lobe::CoatedDiffuse(CoatedDiffuse::new(1.5, 0.5, facets));
    assert!(of(paint(), mirrored) > 0.5);
    assert!(of(paint(), towards(60.0, 180.0)) < 0.05);
}
