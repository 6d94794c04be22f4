//! Correlation slices: the pupil moves along a closed path over one phasor plane. Neighbouring
//! patterns have most of their phasors in common, and opposite patterns have none.
//!
//! u is the arc length along the path: u = δ·`per_diameter`, with δ in pupil diameters. It wraps
//! after π diameters (π·√2 for a square pupil). Two readings separated by the arc Δ correlate by
//! the overlap law of their *chord*, which is sin Δ for a circle of radius ½. Up to Δ = 0.2, this γ
//! equals γ(Δ) to 0.003. The largest excess is 0.022, at Δ = 0.65, where γ itself is below 0.1.
//! Between slices, [`Slices::interpolation_error`] is added.
//!
//! A displacement across an elliptical pupil is measured in widths along x and heights along y. The
//! path of a square pupil passes through all directions, whose overlap laws differ.

use super::pattern::{Pattern, PatternSpec, PhasorPlane};
use crate::math::Aperture;
use crate::math::DVec2;
use std::f64::consts::{FRAC_1_SQRT_2, TAU};

/// Patterns along the path, generated on demand. Slice k is at the angle 2πk/S.
pub struct Slices {
    spec: PatternSpec,
    plane: PhasorPlane,
}

/// Returns the radius of the path in pupil widths. Smaller radii would let opposite pupils overlap.
/// A square shifted along its diagonal needs √2 widths.
fn path_radius(aperture: Aperture) -> f64 {
    match aperture {
        Aperture::Circle | Aperture::Ellipse(_) => 0.5,
        Aperture::Square => FRAC_1_SQRT_2,
    }
}

impl Slices {
    /// Creates the slices; `spec` must have passed [`PatternSpec::validate`].
    pub fn new(spec: &PatternSpec) -> Slices {
        Slices {
            spec: *spec,
            plane: PhasorPlane::new(spec),
        }
    }

    /// Returns the point of the path at u (slices) relative to its centre, in pupil widths along x
    /// and heights along y.
    fn point(&self, u: f64) -> DVec2 {
        let angle = TAU * u / self.spec.slices as f64;
        path_radius(self.spec.aperture) * DVec2::from_angle(angle)
    }

    /// Returns the centre of slice k, rounded to full texels of the plane. At fractions of a texel,
    /// a square pupil would still overlap its neighbour by an integer number of texels.
    fn centre(&self, k: usize) -> DVec2 {
        (self.point(k as f64) * self.pupil()).round()
    }

    /// Returns the centre of slice k in pupil widths and heights.
    fn position(&self, k: usize) -> DVec2 {
        self.centre(k) / self.pupil()
    }

    /// Returns width and height of the pupil, texels.
    fn pupil(&self) -> DVec2 {
        self.spec.pupil_width() * DVec2::new(1.0, self.spec.aperture.ratio())
    }

    /// Returns the pattern of slice k (modulo the number of slices).
    pub fn pattern(&self, k: usize) -> Pattern {
        self.plane.pattern(self.centre(k % self.spec.slices))
    }

    /// Returns the pattern of slice k, sharpened for linear interpolation of the field.
    pub fn sharpened(&self, k: usize) -> Pattern {
        self.plane.sharpened(self.centre(k % self.spec.slices))
    }

    /// Returns the correlations of sharpened fields at a lag of one column and of one row.
    pub fn sharpened_correlations(&self) -> [f64; 2] {
        self.plane.sharpened_correlations()
    }

    /// Returns the field correlation μ of slice k and the next slice, counted over the phasors of
    /// their pupils.
    pub fn correlation_with_next(&self, k: usize) -> f64 {
        let (a, b) = (self.centre(k), self.centre((k + 1) % self.spec.slices));
        let shared = |p, q| self.plane.shared(p, q) as f64;
        shared(a, b) / (shared(a, a) * shared(b, b)).sqrt()
    }

    /// Returns the largest excess of the intensity correlation over the overlap law, for two
    /// readings of a lookup that interpolates fields.
    ///
    /// The law has a cusp at zero, so every step decorrelates. Two readings between the same
    /// slices, however, are made of the same two fields. The excess is largest for readings a
    /// quarter of a slice on either side of a slice. It is 0.058 with 64 slices and a circular
    /// pupil, and halves when the number of slices doubles.
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

    /// Returns the carrier of the next slice minus the carrier of slice k, texels of the plane.
    pub fn carrier_step(&self, k: usize) -> [i64; 2] {
        let step = self.centre((k + 1) % self.spec.slices) - self.centre(k);
        [step.x as i64, step.y as i64]
    }

    /// Returns the number of slices per pupil diameter along the path.
    pub fn per_diameter(&self) -> f64 {
        self.spec.slices as f64 / (TAU * path_radius(self.spec.aperture))
    }

    /// Returns the intensity correlation γ = μ² of slices k and l by the overlap law of the chord
    /// between them.
    pub fn overlap_law(&self, k: usize, l: usize) -> f64 {
        let chord = self.position(k) - self.position(l);
        self.spec.aperture.overlap(chord).powi(2)
    }
}
