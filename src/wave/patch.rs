//! Rough patches for the wave-optics reference: random scatterers on a plane parallelogram, moved
//! as a rigid body and illuminated.

use super::image::Scatterer;
use crate::math::rng::RngKey;
use crate::math::{DVec2, DVec3};
use crate::speckle::motion::Source;
use glam::DQuat;
use std::f64::consts::TAU;

/// Plane rough patch (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoughPatch {
    /// Centre of the parallelogram.
    pub centre: DVec3,
    /// Unit normal.
    pub normal: DVec3,
    /// Two edges of the parallelogram, perpendicular to `normal`.
    pub edges: [DVec3; 2],
    /// Number of cells along each edge; each cell contains one scatterer.
    pub cells: [usize; 2],
    /// Standard deviation of the Gaussian height (mm). From one wavelength on, the phases of
    /// neighbouring scatterers are independent and speckle is fully developed.
    pub height_rms: f64,
}

/// Scatterer of the surface before it is illuminated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoughPoint {
    /// Position, mm.
    pub position: DVec3,
    /// √reflectivity; its mean square is 1.
    pub amplitude_reflectivity: f64,
}

impl RoughPatch {
    /// Returns one scatterer at a uniformly random position in each cell, with Gaussian height and
    /// Rayleigh-distributed strength.
    ///
    /// With random phases, every amplitude is then circular Gaussian. The field is therefore a
    /// Gaussian process for any number of scatterers per grain. Equal strengths at independent
    /// uniform positions were tested. For n scatterers per unit area, they give C² = 1 + κ/n, κ =
    /// ∫PSF²/(∫PSF)². They also raise the correlation of two patterns above γ by this excess. For γ
    /// ≈ 0.2 and n = 10 per grain, the error is one sixth.
    pub fn points(&self, key: RngKey) -> Vec<RoughPoint> {
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
                    amplitude_reflectivity: radius(4),
                }
            })
            .collect()
    }
}

/// Applies a rigid motion: a rotation by the rotation vector `rotation` (rad) about `centre`, then
/// a translation. The motion is finite, not linearised.
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

/// Illuminates the points with the irradiance E(x) (any unit) from `source`: the amplitude is √E
/// times the strength. A [`Source::Wavefront`] passes through `origin` with its stated direction
/// and curvature, ℓ = d·r + ½·rᵀC·r with r = x − `origin`.
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
            amplitude: irradiance(p.position).sqrt() * p.amplitude_reflectivity,
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

/// Returns the parallelogram of a plane surface that fills a `size` rectangle (mm) as viewed from a
/// large distance. The rectangle lies in the plane across the viewing direction, with the unit axes
/// `basis`. `cell` is the largest spacing of scatterers (mm), measured in that plane.
pub fn patch_filling_view(
    centre: DVec3,
    normal: DVec3,
    basis: [DVec3; 2],
    size: DVec2,
    cell: DVec2,
    height_rms: f64,
) -> RoughPatch {
    let view = basis[0].cross(basis[1]);
    let on_surface = |edge: DVec3| edge - view * (edge.dot(normal) / view.dot(normal));
    RoughPatch {
        centre,
        normal,
        edges: [on_surface(basis[0] * size.x), on_surface(basis[1] * size.y)],
        cells: [size.x / cell.x, size.y / cell.y].map(|n| n.ceil() as usize),
        height_rms,
    }
}
