//! Directions drawn as a surface scatters light, and how likely each is.

use super::ggx::Ggx;
use super::glossy::Lobe;
use super::{Lay, Surface};
use crate::math::{DMat3, DVec2, DVec3};
use smallvec::SmallVec;
use std::f64::consts::{FRAC_1_PI, PI};

/// A surface at one point, which light reaches or leaves in one direction.
pub struct Scatter<'a> {
    surface: &'a Surface,
    local_from_part: DMat3,
    from: DVec3,
}

/// A direction that was drawn.
pub struct Drawn {
    /// Unit vector of the part's frame, away from the surface.
    pub direction: DVec3,
    /// What is to be multiplied to the light for it: BRDF × cosine over the density; of a mirror its
    /// reflectance over the chance to draw it.
    pub share: f64,
    /// `None`: a mirror's only direction.
    pub density: Option<f64>,
}

/// A way to draw a direction.
enum Way<'a> {
    /// By the cosine.
    Even,
    /// By the facets that are seen (Heitz 2018).
    Facets(&'a Ggx),
    Mirror,
}

/// Each with its weight.
type Ways<'a> = SmallVec<[(f64, Way<'a>); 4]>;

impl Surface {
    /// At `point` (part's frame, mm) with this normal, towards `from`; unit vectors away from the
    /// surface.
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
}

impl Scatter<'_> {
    /// BRDF (1/sr) between both directions, without what mirrors reflect; 0 from behind.
    pub fn bsdf(&self, to: DVec3) -> f64 {
        self.local_bsdf(self.local_from_part * to)
    }

    fn local_bsdf(&self, to: DVec3) -> f64 {
        if !(self.from.z > 0.0 && to.z > 0.0) {
            return 0.0;
        }
        match self.surface {
            Surface::Lambert(lambert) => lambert.bsdf(),
            Surface::Glossy(glossy) => {
                let lobes = glossy.lobes.iter();
                let of = |(share, lobe): &(f64, Lobe)| {
                    share * lobe.parts(self.from, to).iter().sum::<f64>()
                };
                lobes.map(of).sum()
            }
        }
    }

    /// How likely [`Self::draw`] draws a direction, 1/sr.
    pub fn density(&self, to: DVec3) -> f64 {
        density(&self.ways(self.from), self.from, self.local_from_part * to)
    }

    /// How likely it were, if light came from `to`, to draw the direction that light comes from here, 1/sr.
    pub fn density_back(&self, to: DVec3) -> f64 {
        let to = self.local_from_part * to;
        density(&self.ways(to), to, self.from)
    }

    /// A direction at a place of the unit square, the way to it by `choice` in [0, 1). `None`: the light is lost.
    pub fn draw(&self, choice: f64, u: DVec2) -> Option<Drawn> {
        let ways = self.ways(self.from);
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
            Way::Even => {
                let flat = u.x.sqrt();
                DVec3::new(flat * cos, flat * sin, (1.0 - u.x).sqrt())
            }
            Way::Facets(facets) => mirrored(facets.seen_facet(self.from, u)),
            Way::Mirror => mirrored(DVec3::Z),
        };
        let direction = self.local_from_part.transpose() * to;
        if let Way::Mirror = way {
            // Its weight is the reflectance itself.
            return Some(Drawn {
                direction,
                share: all,
                density: None,
            });
        }
        let density = density(&ways, self.from, to);
        let share = self.local_bsdf(to) * to.z / density;
        (share > 0.0 && share.is_finite()).then_some(Drawn {
            direction,
            share,
            density: Some(density),
        })
    }

    /// Weights are about what each way reflects of light from `from`.
    fn ways(&self, from: DVec3) -> Ways<'_> {
        let mut ways = Ways::new();
        if from.z <= 0.0 {
            return ways;
        }
        let glossy = match self.surface {
            Surface::Lambert(lambert) => {
                ways.push((lambert.reflectance, Way::Even));
                return ways;
            }
            Surface::Glossy(glossy) => glossy,
        };
        for (share, lobe) in &glossy.lobes {
            match lobe {
                Lobe::Matt(matt) => ways.push((share * matt.reflectance, Way::Even)),
                Lobe::Metal(metal) => {
                    let [once, several] = metal.shares(from);
                    ways.push((share * once, Way::Facets(&metal.facets)));
                    ways.push((share * several, Way::Even));
                }
                Lobe::Coat(coat) => {
                    let [gloss, body] = coat.shares(from);
                    ways.push((share * gloss, Way::Facets(&coat.facets)));
                    ways.push((share * body, Way::Even));
                }
                Lobe::Mirror(mirror) => ways.push((share * mirror.reflectance, Way::Mirror)),
            }
        }
        ways
    }
}

/// Of the ways but mirrors, of all.
fn density(ways: &Ways, from: DVec3, to: DVec3) -> f64 {
    if !(from.z > 0.0 && to.z > 0.0) {
        return 0.0;
    }
    let (mut all, mut sum) = (0.0, 0.0);
    for (weight, way) in ways {
        all += weight;
        sum += weight
            * match way {
                Way::Even => to.z * FRAC_1_PI,
                Way::Facets(facets) => facets.mirrored_density(from, to),
                Way::Mirror => 0.0,
            };
    }
    if all > 0.0 { sum / all } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};
    use crate::surface::{Coat, Glossy, Lambert, Metal, Mirror};
    use std::sync::Arc;

    fn surfaces() -> Vec<Surface> {
        let facets = |along, across| Ggx { along, across };
        let glossy = |lobes| Surface::Glossy(Arc::new(Glossy { lobes, lay: None }));
        vec![
            Lambert { reflectance: 0.6 }.into(),
            glossy(vec![(
                1.0,
                Lobe::Metal(Metal::new(1.6575, 9.2238, facets(0.2, 0.2))),
            )]),
            glossy(vec![(
                1.0,
                Lobe::Metal(Metal::new(2.9, 3.1, facets(0.15, 0.6))),
            )]),
            glossy(vec![
                (0.5, Lobe::Coat(Coat::new(1.5, 0.5, facets(0.3, 0.3)))),
                (0.2, Lobe::Matt(Lambert { reflectance: 0.8 })),
                (0.3, Lobe::Mirror(Mirror { reflectance: 0.7 })),
            ]),
        ]
    }

    fn towards(degrees: f64) -> DVec3 {
        let (sin, cos) = f64::to_radians(degrees).sin_cos();
        DVec3::new(sin, 0.0, cos)
    }

    /// The density is that of what is drawn: in each of 8 × 16 cells of equal solid angle as many directions as
    /// its integral says, within five standard deviations (false alarm below 1e-3 for all cells).
    #[test]
    fn directions_are_as_dense_as_is_said() {
        const RINGS: usize = 8;
        const TURNS: usize = 16;
        for (which, surface) in surfaces().iter().enumerate() {
            for angle in [10.0, 60.0] {
                let scatter = surface.scatter(DVec3::ZERO, DVec3::Z, towards(angle));
                let key = Key::new(which as u64, Purpose::Reflections).with(angle as u64);
                let n = 100_000;
                let mut counts = [0.0; RINGS * TURNS];
                for i in 0..n {
                    let u = |j| key.with(i).uniform(j);
                    let drawn = scatter.draw(u(0), DVec2::new(u(1), u(2)));
                    let Some(Drawn {
                        direction: d,
                        density: Some(_),
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
                        share += scatter.density(DVec3::new(cos * flat, sin * flat, z));
                    }
                    share *= 2.0 * PI / (counts.len() * STEPS * STEPS) as f64;
                    let sigma = (n as f64 * share.max(1e-4)).sqrt();
                    // The rule of 64 × 64 is good to 1e-3 where the lobe is.
                    let expected = n as f64 * share;
                    assert!(
                        (count - expected).abs() < 5.0 * sigma + 1e-3 * expected,
                        "{which} {angle} {cell}: {count} {expected}"
                    );
                }
            }
        }
    }

    /// What is drawn carries the albedo, which is the same however it is drawn: against the mean over the
    /// hemisphere by the cosine, within five standard errors of both.
    #[test]
    fn shares_carry_the_albedo() {
        for (which, surface) in surfaces().iter().enumerate() {
            let from = towards(35.0);
            let scatter = surface.scatter(DVec3::ZERO, DVec3::Z, from);
            let key = Key::new(which as u64, Purpose::Reflections);
            let n = 200_000;
            let (mut drawn, mut even) = ([0.0; 2], [0.0; 2]);
            let add = |sums: &mut [f64; 2], x: f64| {
                sums[0] += x;
                sums[1] += x * x;
            };
            for i in 0..n {
                let u = |j| key.with(i).uniform(j);
                let share = scatter.draw(u(0), DVec2::new(u(1), u(2)));
                let smooth = share.filter(|drawn| drawn.density.is_some());
                add(&mut drawn, smooth.map_or(0.0, |drawn| drawn.share));
                let (sin, cos) = (2.0 * PI * u(3)).sin_cos();
                let flat = u(4).sqrt();
                let d = DVec3::new(flat * cos, flat * sin, (1.0 - u(4)).sqrt());
                add(&mut even, PI * scatter.bsdf(d));
                // Light may go both ways, and so may what is likely.
                let back = surface.scatter(DVec3::ZERO, DVec3::Z, d);
                let both = [scatter.density_back(d), back.density(from)];
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
