//! Correlation slices: the pupil slides along a closed path over one plane of
//! phasors, so that neighbouring patterns share most of it and opposite ones
//! nothing.

use super::pattern::{Pattern, PatternSpec, PhasorPlane};
use crate::math::DVec2;
use std::f64::consts::TAU;

/// Radius of the path in pupil widths. Opposite pupils are 1.5 widths apart:
/// disjoint for a circle (needs 1) and for a square moved along its diagonal
/// (needs √2).
pub const PATH_RADIUS: f64 = 0.75;

/// The patterns along the path, made on demand; slice k stands at the angle
/// 2πk/S.
pub struct Slices {
    spec: PatternSpec,
    plane: PhasorPlane,
}

/// How a slice relates to the next one.
#[derive(Debug, Clone, Copy)]
pub struct Link {
    /// Carrier of the next slice minus that of this one, texels of the plane:
    /// its field, seen in this slice's band, is field·exp(2πi·shift·(s,t)/N).
    pub shift: [i64; 2],
    /// Field correlation μ of the two slices.
    pub correlation: f64,
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
        PATH_RADIUS * DVec2::from_angle(TAU * k as f64 / self.spec.slices as f64)
    }

    /// Centre of slice k, texels of the plane.
    fn centre(&self, k: usize) -> DVec2 {
        let width = self.spec.pupil_width();
        self.position(k) * DVec2::new(width, width * self.spec.aperture.ratio())
    }

    /// The pattern of slice k (modulo the number of slices).
    pub fn pattern(&self, k: usize) -> Pattern {
        self.plane.pattern(self.centre(k))
    }

    pub fn link(&self, k: usize) -> Link {
        let next = (k + 1) % self.spec.slices;
        let (a, b) = (self.centre(k), self.centre(next));
        let count = |p, q| self.plane.shared(p, q) as f64;
        let shift = b.round() - a.round();
        Link {
            shift: [shift.x as i64, shift.y as i64],
            correlation: count(a, b) / (count(a, a) * count(b, b)).sqrt(),
        }
    }

    /// Intensity correlation γ = μ² of slices k and l by the overlap law, the
    /// argument being the chord between them.
    pub fn overlap_law(&self, k: usize, l: usize) -> f64 {
        let chord = self.position(k) - self.position(l);
        self.spec.aperture.overlap(chord).powi(2)
    }
}
