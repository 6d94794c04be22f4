//! Correlation slices: the pupil slides along a closed path over one plane of
//! phasors, so that neighbouring patterns share most of it and opposite ones
//! nothing.

use super::pattern::{Aperture, Pattern, PatternSpec, PhasorPlane};
use crate::math::DVec2;
use std::f64::consts::{FRAC_1_SQRT_2, TAU};

/// The patterns along the path, made on demand; slice k stands at the angle
/// 2πk/S.
pub struct Slices {
    spec: PatternSpec,
    plane: PhasorPlane,
}

/// Radius of the path in pupil widths: the least that parts opposite pupils,
/// which for a square slid along its diagonal takes √2 widths.
fn path_radius(aperture: Aperture) -> f64 {
    match aperture {
        Aperture::Circle | Aperture::Ellipse { .. } => 0.5,
        Aperture::Square => FRAC_1_SQRT_2,
    }
}

impl Slices {
    /// `spec` must have passed [`PatternSpec::validate`].
    pub fn new(spec: &PatternSpec) -> Slices {
        Slices {
            spec: *spec,
            plane: PhasorPlane::new(spec),
        }
    }

    /// Centre of slice k from the middle of the path, in pupil widths along x
    /// and heights along y.
    fn position(&self, k: usize) -> DVec2 {
        path_radius(self.spec.aperture)
            * DVec2::from_angle(TAU * k as f64 / self.spec.slices as f64)
    }

    /// Centre of slice k, texels of the plane.
    fn centre(&self, k: usize) -> DVec2 {
        let width = self.spec.pupil_width();
        self.position(k) * DVec2::new(width, width * self.spec.aperture.ratio())
    }

    /// The pattern of slice k (modulo the number of slices).
    pub fn pattern(&self, k: usize) -> Pattern {
        self.plane.pattern(self.centre(k % self.spec.slices))
    }

    /// Field correlation μ of slice k and the next, of the finite pupils.
    pub fn correlation_with_next(&self, k: usize) -> f64 {
        let (a, b) = (self.centre(k), self.centre((k + 1) % self.spec.slices));
        let shared = |p, q| self.plane.shared(p, q) as f64;
        shared(a, b) / (shared(a, a) * shared(b, b)).sqrt()
    }

    /// Carrier of the next slice minus that of slice k, texels of the plane.
    pub fn carrier_step(&self, k: usize) -> [i64; 2] {
        let step = self.centre((k + 1) % self.spec.slices).round() - self.centre(k).round();
        [step.x as i64, step.y as i64]
    }

    /// Slices per pupil diameter travelled along the path.
    pub fn per_diameter(&self) -> f64 {
        self.spec.slices as f64 / (TAU * path_radius(self.spec.aperture))
    }

    /// Intensity correlation γ = μ² of slices k and l by the overlap law, the
    /// argument being the chord between them.
    pub fn overlap_law(&self, k: usize, l: usize) -> f64 {
        let chord = self.position(k) - self.position(l);
        self.spec.aperture.overlap(chord).powi(2)
    }
}
