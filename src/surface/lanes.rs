//! BRDF of packets of direction pairs, in f32.
//!
//! The functions repeat [`Surface::bsdf`] and the models of its lobes for 16 pairs at once, about
//! ten times faster. They have no branches that depend on the directions, so the compiler
//! vectorises them in the caller. A test compares them with the models.

use super::albedo::Albedo;
use super::ggx::Ggx;
use super::glossy::Lobe;
use super::{Conductor, Surface};
use std::f32::consts::{FRAC_1_PI, PI};

/// Direction pairs per packet.
pub const LANES: usize = 16;

/// One number per pair.
pub type Lanes = [f32; LANES];

/// One vector per pair: x along the lay, y across it, z along the normal.
pub type VectorLanes = [Lanes; 3];

/// Returns the BRDF, 1/sr, of each pair of local unit vectors; 0 unless both are above the surface.
#[inline(always)]
pub fn bsdf(surface: &Surface, i: &VectorLanes, o: &VectorLanes) -> Lanes {
    let mut sum = [0.0; LANES];
    match surface {
        Surface::Lambert(lambert) => sum = [lambert.bsdf() as f32; LANES],
        Surface::Layered(layered) => {
            for (weight, lobe) in &layered.lobes {
                let of_lobe = match lobe {
                    Lobe::Diffuse(lambert) => [lambert.bsdf() as f32; LANES],
                    Lobe::Metal(metal) => self::metal(metal, i, o),
                    Lobe::CoatedDiffuse(coat) => {
                        let fresnel = |cosine| dielectric(coat.index as f32, cosine);
                        let gloss = facets(&coat.facets, i, o, fresnel);
                        let body = multiple_scattering(coat.albedo(), i, o);
                        let scattered = coat.scattered() as f32;
                        std::array::from_fn(|k| gloss[k] + scattered * body[k])
                    }
                    Lobe::Mirror(_) => [0.0; LANES],
                };
                for k in 0..LANES {
                    sum[k] += *weight as f32 * of_lobe[k];
                }
            }
        }
    }
    for k in 0..LANES {
        sum[k] = if i[2][k] > 0.0 && o[2][k] > 0.0 {
            sum[k]
        } else {
            0.0
        };
    }
    sum
}

#[inline(always)]
fn metal(metal: &Conductor, i: &VectorLanes, o: &VectorLanes) -> Lanes {
    let (n, k) = (metal.n as f32, metal.k as f32);
    let mut once = facets(&metal.facets, i, o, |cosine| conductor(n, k, cosine));
    let several = metal.multiple_scattering_albedo() as f32;
    if several > 0.0 {
        let term = multiple_scattering(metal.albedo(), i, o);
        for k in 0..LANES {
            once[k] += several * term[k];
        }
    }
    once
}

/// Returns the term of [`Ggx::bsdf`] for each pair.
#[inline(always)]
fn facets(facets: &Ggx, i: &VectorLanes, o: &VectorLanes, fresnel: impl Fn(f32) -> f32) -> Lanes {
    let (along, across) = (facets.alpha_u as f32, facets.alpha_v as f32);
    let lambda = |[x, y, z]: [f32; 3]| {
        let [u, v] = [x * along, y * across];
        (1.0 + (u * u + v * v) / (z * z)).sqrt() * 0.5 - 0.5
    };
    let mut out = [0.0; LANES];
    for k in 0..LANES {
        let [a, b] = [[i[0][k], i[1][k], i[2][k]], [o[0][k], o[1][k], o[2][k]]];
        let [x, y, z] = [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
        let inverse = 1.0 / (x * x + y * y + z * z).sqrt();
        let [x, y, z] = [x * inverse, y * inverse, z * inverse];
        let [u, v] = [x / along, y / across];
        let e = u * u + v * v + z * z;
        let normals = FRAC_1_PI / (along * across * e * e);
        let masking = 1.0 / (4.0 * a[2] * b[2] * (1.0 + lambda(a) + lambda(b)));
        let cosine = (b[0] * x + b[1] * y + b[2] * z).min(1.0);
        out[k] = normals * masking * fresnel(cosine);
    }
    out
}

/// Returns [`super::fresnel::conductor`].
#[inline(always)]
fn conductor(n: f32, k: f32, cosine: f32) -> f32 {
    let c2 = cosine * cosine;
    let sin2 = 1.0 - c2;
    let real = n * n - k * k - sin2;
    let imaginary = 2.0 * n * k;
    let size = (real * real + imaginary * imaginary).sqrt();
    let a = ((size + real) * 0.5).max(0.0).sqrt();
    let twice = 2.0 * a * cosine;
    let across = (size + c2 - twice) / (size + c2 + twice);
    let (sum, twice) = (size * c2 + sin2 * sin2, twice * sin2);
    let along = across * (sum - twice) / (sum + twice);
    (across + along) * 0.5
}

/// Returns [`super::fresnel::dielectric`].
#[inline(always)]
fn dielectric(n: f32, cosine: f32) -> f32 {
    let inside = (1.0 - (1.0 - cosine * cosine) / (n * n)).sqrt();
    let across = (cosine - n * inside) / (cosine + n * inside);
    let along = (n * cosine - inside) / (n * cosine + inside);
    (across * across + along * along) * 0.5
}

/// Returns [`Albedo::multiple_scattering_term`] for each pair.
#[inline(always)]
fn multiple_scattering(albedo: &Albedo, i: &VectorLanes, o: &VectorLanes) -> Lanes {
    let left = (1.0 - albedo.mean) as f32;
    if left < 1e-9 {
        return [0.0; LANES];
    }
    let [a, b] = [i, o].map(|w| {
        let mut lost = [0.0; LANES];
        for k in 0..LANES {
            lost[k] = albedo.lost([w[0][k], w[1][k], w[2][k]]);
        }
        lost
    });
    std::array::from_fn(|k| a[k] * b[k] / (PI * left))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec3;
    use crate::math::rng::{Purpose, RngKey};
    use crate::surface::{CoatedDiffuse, Lambert, LayeredBrdf};
    use std::sync::Arc;

    /// The packets agree with the models. The tolerance is 2e-4: rounding of f32 to 6e-8 in
    /// directions changes the argument of a lobe of α = 0.05 by 1e-6 of its width at most, and the
    /// masking 1/μ at μ = 1e-3 by 6e-5.
    #[test]
    fn packets_agree_with_the_models() {
        let ggx = |alpha_u, alpha_v| Ggx { alpha_u, alpha_v };
        let lobes = vec![
            (
                0.5,
                Lobe::Metal(Conductor::new(1.6575, 9.2238, ggx(0.08, 0.3))),
            ),
            (0.2, Lobe::Metal(Conductor::new(2.9, 3.1, ggx(0.4, 0.4)))),
            (
                0.2,
                Lobe::CoatedDiffuse(CoatedDiffuse::new(1.5, 0.5, ggx(0.05, 0.05))),
            ),
            (0.1, Lobe::Diffuse(Lambert { reflectance: 0.8 })),
        ];
        let layered = Surface::Layered(Arc::new(LayeredBrdf { lobes, lay: None }));
        let key = RngKey::new(1, Purpose::Reflections);
        for surface in [layered, Lambert { reflectance: 0.6 }.into()] {
            for packet in 0..200 {
                let direction = |which: u64, k: usize| {
                    let u = |j| key.with(packet).with(k as u64).uniform(3 * which + j);
                    let z = 1e-3 + 0.999 * u(0);
                    let (sin, cos) = (std::f64::consts::TAU * u(1)).sin_cos();
                    let flat = (1.0 - z * z).sqrt();
                    DVec3::new(flat * cos, flat * sin, z)
                };
                let lanes = |which: u64| -> VectorLanes {
                    std::array::from_fn(|axis| {
                        std::array::from_fn(|k| direction(which, k)[axis] as f32)
                    })
                };
                let found = bsdf(&surface, &lanes(0), &lanes(1));
                for (k, &found) in found.iter().enumerate() {
                    let [i, o] = [0, 1].map(|which| direction(which, k));
                    let local = surface.local_bsdf(i, o);
                    assert!(
                        (f64::from(found) / local - 1.0).abs() < 2e-4,
                        "{i} {o}: {found} {local}"
                    );
                }
            }
        }
    }
}
