//! Correlation slices: the pupil slides along a closed path over one plane of
//! phasors, so that neighbouring patterns share most of it and opposite ones
//! nothing.
//!
//! u is the arc travelled: u = δ·`per_diameter`, δ in pupil diameters, wrapping
//! after π diameters (π·√2 for a square pupil). Two readings Δ of arc apart
//! correlate by the overlap law of their *chord*, sin Δ for a circle of radius
//! ½: the same as Δ to 0.003 in γ up to Δ = 0.2, and up to 0.022 higher where
//! it differs most, at 0.65, where γ itself is below 0.1. Between slices
//! [`Slices::interpolation_error`] comes on top. A displacement across an
//! elliptical pupil counts in widths along x and heights along y; the path of a
//! square one turns through all directions, whose laws differ.

use super::pattern::{Pattern, PatternSpec, PhasorPlane};
use crate::math::Aperture;
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
        Aperture::Circle | Aperture::Ellipse(_) => 0.5,
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

    /// Point of the path at u (slices), from its middle, in pupil widths along
    /// x and heights along y.
    fn point(&self, u: f64) -> DVec2 {
        let angle = TAU * u / self.spec.slices as f64;
        path_radius(self.spec.aperture) * DVec2::from_angle(angle)
    }

    /// Centre of slice k, whole texels of the plane: a square pupil at
    /// fractions of a texel would overlap its neighbour by whole ones all the
    /// same.
    fn centre(&self, k: usize) -> DVec2 {
        (self.point(k as f64) * self.pupil()).round()
    }

    /// The same, in pupil widths and heights.
    fn position(&self, k: usize) -> DVec2 {
        self.centre(k) / self.pupil()
    }

    /// Width and height of the pupil, texels.
    fn pupil(&self) -> DVec2 {
        self.spec.pupil_width() * DVec2::new(1.0, self.spec.aperture.ratio())
    }

    /// The pattern of slice k (modulo the number of slices).
    pub fn pattern(&self, k: usize) -> Pattern {
        self.plane.pattern(self.centre(k % self.spec.slices))
    }

    /// The same, sharpened for linear interpolation of the field.
    pub fn sharpened(&self, k: usize) -> Pattern {
        self.plane.sharpened(self.centre(k % self.spec.slices))
    }

    /// Correlations of sharpened fields one column and one row apart.
    pub fn sharpened_correlations(&self) -> [f64; 2] {
        self.plane.sharpened_correlations()
    }

    /// Field correlation μ of slice k and the next, of the finite pupils.
    pub fn correlation_with_next(&self, k: usize) -> f64 {
        let (a, b) = (self.centre(k), self.centre((k + 1) % self.spec.slices));
        let shared = |p, q| self.plane.shared(p, q) as f64;
        shared(a, b) / (shared(a, a) * shared(b, b)).sqrt()
    }

    /// Largest excess of the intensity correlation of two readings of a
    /// lookup that blends fields over the overlap law. The law has a cusp at
    /// zero: every step decorrelates anew, while two readings between the same
    /// slices are made of the same two fields. Greatest for readings half a
    /// slice apart, a quarter on either side of one: 0.058 with 64 slices and
    /// a circular pupil, halved when slices are doubled.
    pub fn interpolation_error(&self) -> f64 {
        let overlap = |k: usize, l: usize| {
            let shift = self.position(k) - self.position(l);
            self.spec.aperture.overlap(shift)
        };
        // Weights of slices 0 to 3 at u = 0 … 3.
        let weights =
            |u: f64| -> [f64; 4] { std::array::from_fn(|k| (1.0 - (u - k as f64).abs()).max(0.0)) };
        let product = |a: [f64; 4], b: [f64; 4]| -> f64 {
            let term = |(k, l): (usize, usize)| a[k] * b[l] * overlap(k, l);
            (0..16).map(|i| term((i / 4, i % 4))).sum()
        };
        let steps = 16;
        let readings = (0..=steps).flat_map(|a| (a..=a + steps).map(move |b| (a, b)));
        readings
            .map(|(a, b)| (a as f64 / steps as f64, b as f64 / steps as f64))
            .map(|(a, b)| {
                let (x, y) = (weights(a), weights(b));
                let blend = product(x, y).powi(2) / (product(x, x) * product(y, y));
                let law = self.spec.aperture.overlap(self.point(a) - self.point(b));
                blend - law.powi(2)
            })
            .fold(0.0, f64::max)
    }

    /// Carrier of the next slice minus that of slice k, texels of the plane.
    pub fn carrier_step(&self, k: usize) -> [i64; 2] {
        let step = self.centre((k + 1) % self.spec.slices) - self.centre(k);
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
