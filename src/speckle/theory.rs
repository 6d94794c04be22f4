//! Closed forms for fully developed, polarised speckle: what patterns and
//! lookups are measured against.

use super::pattern::Aperture;
use crate::math::DVec2;

impl Aperture {
    /// Correlation μ of the speckle *fields* at two points of the sensor,
    /// `lag` apart, in units of the minimal speckle size h = λ·d_PI/D (D the
    /// pupil's width). The Fourier transform of the pupil (Goodman 2007,
    /// eq. 4-58): 2J₁(πr)/(πr) for a circle, sinc·sinc for a square. The
    /// autocovariance of the *intensity* is μ².
    pub fn field_correlation(&self, lag: DVec2) -> f64 {
        match *self {
            Aperture::Circle => jinc(lag.length()),
            Aperture::Ellipse { ratio } => jinc(DVec2::new(lag.x, ratio * lag.y).length()),
            Aperture::Square => sinc(lag.x) * sinc(lag.y),
        }
    }

    /// Overlap of the pupil with itself after a shift, as a share of its area:
    /// the correlation μ of the speckle fields before and after the pupil
    /// content moved by `shift`, in pupil widths along x and pupil heights
    /// along y. Circle: (2/π)·(acos δ − δ·√(1−δ²)) for δ ≤ 1, else 0 (the
    /// optical transfer function of a disc); square: the product of two
    /// triangles. The correlation γ of the *intensities* is μ².
    pub fn overlap(&self, shift: DVec2) -> f64 {
        match self {
            Aperture::Circle | Aperture::Ellipse { .. } => {
                let delta = shift.length().min(1.0);
                2.0 / std::f64::consts::PI * (delta.acos() - delta * (1.0 - delta * delta).sqrt())
            }
            Aperture::Square => (1.0 - shift.x.abs()).max(0.0) * (1.0 - shift.y.abs()).max(0.0),
        }
    }
}

/// 2J₁(πr)/(πr), 1 at 0.
fn jinc(r: f64) -> f64 {
    let x = std::f64::consts::PI * r;
    if x.abs() < 1e-6 {
        1.0
    } else {
        2.0 * libm::j1(x) / x
    }
}

/// sin(πr)/(πr), 1 at 0.
pub(super) fn sinc(r: f64) -> f64 {
    let x = std::f64::consts::PI * r;
    if x.abs() < 1e-6 { 1.0 } else { x.sin() / x }
}
