//! Importance sampling of scattered directions, and its densities.

use super::ggx::Ggx;
use super::glossy::Lobe;
use super::{Lay, Surface};
use crate::math::{DMat3, DVec2, DVec3};
use smallvec::SmallVec;
use std::f64::consts::{FRAC_1_PI, PI};

/// Surface at one point, with the direction of the incoming or outgoing light.
pub struct Scatter<'a> {
    surface: &'a Surface,
    local_from_part: DMat3,
    from: DVec3,
}

/// Sampled direction.
pub struct BsdfSample {
    /// Unit vector in the part frame, away from the surface.
    pub direction: DVec3,
    /// Throughput weight f·cosθ/pdf; for a mirror, reflectance divided by selection probability.
    pub share: f64,
    /// Density, 1/sr; `None` for the direction of a mirror.
    pub pdf: Option<f64>,
}

/// Sampling strategy.
enum SamplingStrategy<'a> {
    /// Cosine-weighted sampling.
    Even,
    /// Sampling of visible normals (Heitz 2018).
    Facets(&'a Ggx),
    Mirror,
}

/// Strategies with weights.
type Strategies<'a> = SmallVec<[(f64, SamplingStrategy<'a>); 4]>;

impl Surface {
    /// Evaluates the surface at `point` (part frame, mm) with the given normal and direction
    /// `from`. Unit vectors point away from the surface.
    pub fn scatter(&self, point: DVec3, normal: DVec3, from: DVec3) -> Scatter<'_> {
        let lay = self.glossy().and_then(|glossy| glossy.lay.as_ref());
        let [x, y, z] = Lay::frame(lay, point, normal);
        let local_from_part = DMat3::from_cols(x, y, z).transpose();
        Scatter {
            surface: self,
            local_from_part,
            from: local_from_part * from,
        }
    }

    /// Returns the BRDF, 1/sr, between two local directions, without mirrors; 0 from behind.
    pub(super) fn local_bsdf(&self, from: DVec3, to: DVec3) -> f64 {
        if !(from.z > 0.0 && to.z > 0.0) {
            return 0.0;
        }
        match self {
            Surface::Lambert(lambert) => lambert.bsdf(),
            Surface::Layered(glossy) => {
                let lobes = glossy.lobes.iter();
                let of = |(share, lobe): &(f64, Lobe)| {
                    share * lobe.polarised_and_depolarised(from, to).iter().sum::<f64>()
                };
                lobes.map(of).sum()
            }
        }
    }
}

impl Scatter<'_> {
    /// Returns the BRDF, 1/sr, between both directions, without mirrors; 0 from behind.
    pub fn bsdf(&self, to: DVec3) -> f64 {
        self.local_bsdf(self.local_from_part * to)
    }

    fn local_bsdf(&self, to: DVec3) -> f64 {
        self.surface.local_bsdf(self.from, to)
    }

    /// Returns the matrix from the part frame to the local frame of the surface.
    pub fn local_from_part(&self) -> DMat3 {
        self.local_from_part
    }

    /// Returns the density with which [`Self::draw`] samples a direction, 1/sr.
    pub fn pdf(&self, to: DVec3) -> f64 {
        pdf(
            &self.strategies(self.from),
            self.from,
            self.local_from_part * to,
        )
    }

    /// Returns the reverse density: the density of sampling `from` for light arriving from `to`,
    /// 1/sr.
    pub fn pdf_reverse(&self, to: DVec3) -> f64 {
        let to = self.local_from_part * to;
        pdf(&self.strategies(to), to, self.from)
    }

    /// Samples a direction from `u` in the unit square. `choice` in [0, 1) selects the strategy.
    /// Returns `None` if the light is absorbed.
    pub fn draw(&self, choice: f64, u: DVec2) -> Option<BsdfSample> {
        let ways = self.strategies(self.from);
        let all: f64 = ways.iter().map(|(weight, _)| weight).sum();
        let mut left = choice * all;
        let chosen = ways.iter().find(|(weight, _)| {
            left -= weight;
            left < 0.0
        });
        let (_, way) = chosen?;
        let (sin, cos) = (2.0 * PI * u.y).sin_cos();
        let mirrored = |m: DVec3| m * (2.0 * self.from.dot(m)) - self.from;
        let to = match way {
            SamplingStrategy::Even => {
                let flat = u.x.sqrt();
                DVec3::new(flat * cos, flat * sin, (1.0 - u.x).sqrt())
            }
            SamplingStrategy::Facets(facets) => {
                mirrored(facets.sample_visible_normal(self.from, u))
            }
            SamplingStrategy::Mirror => mirrored(DVec3::Z),
        };
        let direction = self.local_from_part.transpose() * to;
        if let SamplingStrategy::Mirror = way {
            // The weight of a mirror is its reflectance.
            return Some(BsdfSample {
                direction,
                share: all,
                pdf: None,
            });
        }
        let density = pdf(&ways, self.from, to);
        let share = self.local_bsdf(to) * to.z / density;
        (share > 0.0 && share.is_finite()).then_some(BsdfSample {
            direction,
            share,
            pdf: Some(density),
        })
    }

    /// Returns the strategies for light from `from`, weighted by their approximate reflectance.
    fn strategies(&self, from: DVec3) -> Strategies<'_> {
        let mut ways = Strategies::new();
        if from.z <= 0.0 {
            return ways;
        }
        let glossy = match self.surface {
            Surface::Lambert(lambert) => {
                ways.push((lambert.reflectance, SamplingStrategy::Even));
                return ways;
            }
            Surface::Layered(glossy) => glossy,
        };
        for (share, lobe) in &glossy.lobes {
            match lobe {
                Lobe::Diffuse(matt) => {
                    ways.push((share * matt.reflectance, SamplingStrategy::Even))
                }
                Lobe::Metal(metal) => {
                    let [once, several] = metal.albedo_split(from);
                    ways.push((share * once, SamplingStrategy::Facets(&metal.facets)));
                    ways.push((share * several, SamplingStrategy::Even));
                }
                Lobe::CoatedDiffuse(coat) => {
                    let [gloss, body] = coat.albedo_split(from);
                    ways.push((share * gloss, SamplingStrategy::Facets(&coat.facets)));
                    ways.push((share * body, SamplingStrategy::Even));
                }
                Lobe::Mirror(mirror) => {
                    ways.push((share * mirror.reflectance, SamplingStrategy::Mirror))
                }
            }
        }
        ways
    }
}

/// Returns the density of the mixture of all strategies; mirrors contribute 0.
fn pdf(ways: &Strategies, from: DVec3, to: DVec3) -> f64 {
    if !(from.z > 0.0 && to.z > 0.0) {
        return 0.0;
    }
    let (mut all, mut sum) = (0.0, 0.0);
    for (weight, way) in ways {
        all += weight;
        sum += weight
            * match way {
                SamplingStrategy::Even => to.z * FRAC_1_PI,
                SamplingStrategy::Facets(facets) => facets.vndf_pdf(from, to),
                SamplingStrategy::Mirror => 0.0,
            };
    }
    if all > 0.0 { sum / all } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use crate::surface::{CoatedDiffuse, Conductor, Lambert, LayeredBrdf, Mirror};
    use std::sync::Arc;

    fn surfaces() -> Vec<Surface> {
        let facets = |along, across| Ggx {
            alpha_u: along,
            alpha_v: across,
        };
        let glossy = |lobes| Surface::Layered(Arc::new(LayeredBrdf { lobes, lay: None }));
        vec![
            Lambert { reflectance: 0.6 }.into(),
            glossy(vec![(
                1.0,
                Lobe::Metal(Conductor::new(1.6575, 9.2238, facets(0.2, 0.2))),
            )]),
            glossy(vec![(
                1.0,
                Lobe::Metal(Conductor::new(2.9, 3.1, facets(0.15, 0.6))),
            )]),
            glossy(vec![
                (
                    0.5,
                    Lobe::CoatedDiffuse(CoatedDiffuse::new(1.5, 0.5, facets(0.3, 0.3))),
                ),
                (0.2, Lobe::Diffuse(Lambert { reflectance: 0.8 })),
                (0.3, Lobe::Mirror(Mirror { reflectance: 0.7 })),
            ]),
        ]
    }

    fn towards(degrees: f64) -> DVec3 {
        let (sin, cos) = f64::to_radians(degrees).sin_cos();
        DVec3::new(sin, 0.0, cos)
    }

    /// The stated density agrees with the sampled directions.
    ///
    /// The test compares 8 × 16 cells of equal solid angle with the integral of the density. The
    /// tolerance is five standard deviations (false alarm below 1e-3 over all cells).
    #[test]
    fn directions_are_as_dense_as_is_said() {
        const RINGS: usize = 8;
        const TURNS: usize = 16;
        for (which, surface) in surfaces().iter().enumerate() {
            for angle in [10.0, 60.0] {
                let scatter = surface.scatter(DVec3::ZERO, DVec3::Z, towards(angle));
                let key = RngKey::new(which as u64, Purpose::Reflections).with(angle as u64);
                let n = 100_000;
                let mut counts = [0.0; RINGS * TURNS];
                for i in 0..n {
                    let u = |j| key.with(i).uniform(j);
                    let drawn = scatter.draw(u(0), DVec2::new(u(1), u(2)));
                    let Some(BsdfSample {
                        direction: d,
                        pdf: Some(_),
                        ..
                    }) = drawn
                    else {
                        continue;
                    };
                    let turn = (d.y.atan2(d.x) / (2.0 * PI)).rem_euclid(1.0);
                    let cell = ((d.z * RINGS as f64) as usize).min(RINGS - 1) * TURNS;
                    counts[cell + ((turn * TURNS as f64) as usize).min(TURNS - 1)] += 1.0;
                }
                for (cell, &count) in counts.iter().enumerate() {
                    const STEPS: usize = 64;
                    let mut share = 0.0;
                    for k in 0..STEPS * STEPS {
                        let at = |k: usize| (k as f64 + 0.5) / STEPS as f64;
                        let z = ((cell / TURNS) as f64 + at(k % STEPS)) / RINGS as f64;
                        let turn = ((cell % TURNS) as f64 + at(k / STEPS)) / TURNS as f64;
                        let (sin, cos) = (2.0 * PI * turn).sin_cos();
                        let flat = (1.0 - z * z).sqrt();
                        share += scatter.pdf(DVec3::new(cos * flat, sin * flat, z));
                    }
                    share *= 2.0 * PI / (counts.len() * STEPS * STEPS) as f64;
                    let sigma = (n as f64 * share.max(1e-4)).sqrt();
                    // The quadrature of 64 × 64 nodes has a relative error of 1e-3 in the lobe.
                    let expected = n as f64 * share;
                    assert!(
                        (count - expected).abs() < 5.0 * sigma + 1e-3 * expected,
                        "{which} {angle} {cell}: {count} {expected}"
                    );
                }
            }
        }
    }

    /// The mean throughput weight is the albedo. It agrees with cosine-weighted sampling of the
    /// BRDF within five standard errors of both.
    #[test]
    fn shares_carry_the_albedo() {
        for (which, surface) in surfaces().iter().enumerate() {
            let from = towards(35.0);
            let scatter = surface.scatter(DVec3::ZERO, DVec3::Z, from);
            let key = RngKey::new(which as u64, Purpose::Reflections);
            let n = 200_000;
            let (mut drawn, mut even) = ([0.0; 2], [0.0; 2]);
            let add = |sums: &mut [f64; 2], x: f64| {
                sums[0] += x;
                sums[1] += x * x;
            };
            for i in 0..n {
                let u = |j| key.with(i).uniform(j);
                let share = scatter.draw(u(0), DVec2::new(u(1), u(2)));
                let smooth = share.filter(|drawn| drawn.pdf.is_some());
                add(&mut drawn, smooth.map_or(0.0, |drawn| drawn.share));
                let (sin, cos) = (2.0 * PI * u(3)).sin_cos();
                let flat = u(4).sqrt();
                let d = DVec3::new(flat * cos, flat * sin, (1.0 - u(4)).sqrt());
                add(&mut even, PI * scatter.bsdf(d));
                // The reverse density agrees with the forward density of the reversed path.
                let back = surface.scatter(DVec3::ZERO, DVec3::Z, d);
                let both = [scatter.pdf_reverse(d), back.pdf(from)];
                assert!((both[0] - both[1]).abs() <= 1e-9 * both[1], "{both:?}");
            }
            let of = |sums: [f64; 2]| {
                let mean = sums[0] / n as f64;
                (mean, (sums[1] / n as f64 - mean * mean).max(0.0) / n as f64)
            };
            let ((a, va), (b, vb)) = (of(drawn), of(even));
            assert!(
                (a - b).abs() < 5.0 * (va + vb).sqrt() + 1e-12,
                "{which}: {a} {b}"
            );
        }
    }
}
