//! Rough patches for the wave-optics reference: random scatterers on a plane
//! parallelogram, moved as a rigid body and lit.

use super::image::Scatterer;
use crate::math::rng::Key;
use crate::math::{DVec2, DVec3};
use crate::speckle::motion::Source;
use glam::DQuat;
use std::f64::consts::TAU;

/// A plane rough patch (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patch {
    /// Middle of the parallelogram.
    pub centre: DVec3,
    /// Unit.
    pub normal: DVec3,
    /// Two edges of the parallelogram, across `normal`.
    pub edges: [DVec3; 2],
    /// Cells along each edge; each holds one scatterer.
    pub cells: [usize; 2],
    /// Standard deviation of the Gaussian height (mm). At one wavelength and more
    /// the phases of neighbours are independent and speckle is fully developed.
    pub height_rms: f64,
}

/// A scatterer of the surface before it is lit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoughPoint {
    /// mm.
    pub position: DVec3,
    /// √reflectivity, mean square 1.
    pub strength: f64,
}

impl Patch {
    /// One scatterer at a uniform place in each cell, of Gaussian height and of
    /// Rayleigh-distributed strength.
    ///
    /// With random phases that makes every amplitude circular Gaussian, so the
    /// field is a Gaussian process however few scatterers a grain holds. Equal
    /// strengths at independent uniform places were tried: they leave
    /// C² = 1 + κ/n, κ = ∫PSF²/(∫PSF)², for n scatterers an area, and correlate
    /// two patterns by that much more than γ, which for γ ≈ 0.2 and n = 10 a grain
    /// is an error of a sixth.
    pub fn points(&self, key: Key) -> Vec<RoughPoint> {
        let [along, across] = self.cells;
        (0..along * across)
            .map(|index| {
                let key = key.with(index as u64);
                let cell = [(index % along, along), (index / along, across)];
                let [u, v] = [0, 1].map(|axis| {
                    let (i, n) = cell[axis];
                    (i as f64 + key.uniform(axis as u64)) / n as f64 - 0.5
                });
                // Box & Muller (1958); 1 − uniform is never 0.
                let radius = |counter| (-(1.0 - key.uniform(counter)).ln()).sqrt();
                let height = 2f64.sqrt() * radius(2) * (TAU * key.uniform(3)).cos();
                RoughPoint {
                    position: self.centre
                        + self.edges[0] * u
                        + self.edges[1] * v
                        + self.normal * height * self.height_rms,
                    strength: radius(4),
                }
            })
            .collect()
    }
}

/// A rigid motion: turned by the rotation vector `rotation` (rad) about `centre`,
/// then translated. Finite, not linearised.
pub fn moved(
    points: &[RoughPoint],
    centre: DVec3,
    rotation: DVec3,
    translation: DVec3,
) -> Vec<RoughPoint> {
    let turn = DQuat::from_scaled_axis(rotation);
    points
        .iter()
        .map(|p| RoughPoint {
            position: centre + turn * (p.position - centre) + translation,
            ..*p
        })
        .collect()
}

/// The points as lit by the irradiance E(x) (any unit) from `source`: amplitude
/// √E times the strength. A [`Source::Wavefront`] passes through `origin` with its
/// stated direction and curvature, ℓ = d·r + ½·rᵀC·r with r = x − `origin`.
pub fn lit(
    points: &[RoughPoint],
    source: &Source,
    origin: DVec3,
    irradiance: impl Fn(DVec3) -> f64,
) -> Vec<Scatterer> {
    points
        .iter()
        .map(|p| Scatterer {
            position: p.position,
            amplitude: irradiance(p.position).sqrt() * p.strength,
            light_path: match *source {
                Source::Point(s) => (p.position - s).length(),
                Source::Wavefront {
                    direction,
                    curvature_per_mm,
                } => {
                    let r = p.position - origin;
                    direction.dot(r) + 0.5 * r.dot(curvature_per_mm * r)
                }
            },
        })
        .collect()
}

/// The parallelogram of a plane surface that fills a `size` rectangle (mm) in
/// the plane across the unit viewing direction, with axes `basis`, as seen from
/// far along that direction. `cell` is the largest spacing of scatterers (mm),
/// measured in that plane.
pub fn patch_filling_view(
    centre: DVec3,
    normal: DVec3,
    basis: [DVec3; 2],
    size: DVec2,
    cell: DVec2,
    height_rms: f64,
) -> Patch {
    let view = basis[0].cross(basis[1]);
    let on_surface = |edge: DVec3| edge - view * (edge.dot(normal) / view.dot(normal));
    Patch {
        centre,
        normal,
        edges: [on_surface(basis[0] * size.x), on_surface(basis[1] * size.y)],
        cells: [size.x / cell.x, size.y / cell.y].map(|n| n.ceil() as usize),
        height_rms,
    }
}
