//! Topography of a surface: a random field of heights that is fixed to the part.

use super::Lay;
use crate::math::rng::RngKey;
use crate::math::{DVec3, Sequence, normal_quantile};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Number of waves. The mean square of the heights over a large area is exact for any number. The
/// autocorrelation of one field deviates from its expected value by at most 1/√(2·512) = 0.03 rms.
const WAVES: u32 = 512;

/// Phase of a wave at the distance of the autocorrelation length, rms: √(2·ln 5).
///
/// The mean of cos(k·r) over normally distributed k with standard deviation s is exp(−s²r²/2). At
/// r = 1 it is 0.2, the value that defines the autocorrelation length in ISO 25178-2.
const PHASE_AT_LENGTH: f64 = 1.794_122_577_994_101_5;

/// Position with lengths in units of the autocorrelation length. Four coordinates represent
/// circular grooves without a seam.
type Scaled = [f64; 4];

/// Random field of heights along the surface normal, with a Gaussian autocorrelation function.
///
/// The field is a function of the position in the part frame, a sum of plane waves whose
/// wave vectors are normally distributed. It is therefore identical from every pose.
#[derive(Debug, Clone)]
pub struct Topography {
    /// Root mean square height Sq, mm.
    sq: f64,
    /// Autocorrelation lengths along the lay and across it, mm; equal for an isotropic surface.
    lengths: [f64; 2],
    lay: Option<Lay>,
    waves: Arc<[Wave]>,
}

#[derive(Debug, Clone, Copy)]
struct Wave {
    wave_vector: Scaled,
    phase: f64,
}

/// Area over which a detected line averages heights, at one point. Vectors are tangents of the
/// surface in the part frame, mm.
#[derive(Debug, Clone)]
pub struct LineFootprint {
    /// Displacement across the line by one standard deviation of the irradiance.
    pub across: DVec3,
    /// Ratio by which the brightness of inclined facets changes the weight of a height, see
    /// [`Topography::averaged`].
    pub shading: f64,
    /// Displacement along the surface from one pixel column to the next.
    pub column: DVec3,
    /// Displacements of the surface under the line during the exposure.
    pub exposure: Vec<DVec3>,
}

impl Topography {
    /// Creates the field of a key from the root mean square height and the autocorrelation lengths
    /// along and across the lay, mm.
    pub fn new(sq: f64, lengths: [f64; 2], lay: Option<Lay>, key: RngKey) -> Topography {
        let sequence = Sequence::new(key);
        let wave = |i: u32| {
            let [a, b, c] = [0, 1, 2].map(|pair| sequence.pair(i, pair));
            let component = |u: f64| PHASE_AT_LENGTH * normal_quantile(u);
            Wave {
                wave_vector: [a.x, a.y, b.x, b.y].map(component),
                phase: TAU * c.x,
            }
        };
        Topography {
            sq,
            lengths,
            lay,
            waves: (0..WAVES).map(wave).collect(),
        }
    }

    /// Returns the height at a point of the surface, part frame, mm.
    ///
    /// ```
    /// use lasertrace::math::DVec3;
    /// use lasertrace::math::rng::{Purpose, RngKey};
    /// use lasertrace::surface::Topography;
    ///
    /// let key = RngKey::new(1, Purpose::Topography);
    /// let milled = Topography::new(0.01, [0.3, 0.3], None, key);
    /// let heights = (0..20_000).map(|i| milled.height(DVec3::new(0.1 * i as f64, 0.0, 0.0)));
    /// let mean_square = heights.map(|h| h * h).sum::<f64>() / 20_000.0;
    /// assert!((mean_square.sqrt() / 0.01 - 1.0).abs() < 0.02);
    /// ```
    pub fn height(&self, point: DVec3) -> f64 {
        let at = self.scaled(point);
        let waves = self.waves.iter();
        self.amplitude() * waves.map(|wave| wave.argument(&at).cos()).sum::<f64>()
    }

    /// Returns the height that a detected line has at a point, part frame, mm.
    ///
    /// The light at a distance y from the laser plane lies on the surface at a height h(y). The row
    /// of its image is linear in y and h, and its brightness is linear in the slope. To first order
    /// in h and its slope, the centroid of a Gaussian line of standard deviation σ weights a wave
    /// of phase κ per σ by
    ///
    /// ```text
    /// (1 − ε·κ²)·exp(−κ²/2)
    /// ```
    ///
    /// ε is [`LineFootprint::shading`]. It is 1 for a Lambertian surface that is perpendicular to
    /// the beam, and 0 for a surface whose brightness does not depend on the slope. The column and
    /// the motion during the exposure average the wave, too.
    pub fn averaged(&self, point: DVec3, footprint: &LineFootprint) -> f64 {
        let at = self.scaled(point);
        let tangent = |by: DVec3| self.scaled_tangent(point, by);
        let (across, column) = (tangent(footprint.across), tangent(footprint.column));
        let exposure: Vec<Scaled> = footprint.exposure.iter().map(|&by| tangent(by)).collect();
        let height = |wave: &Wave| {
            let squared = dot(&wave.wave_vector, &across).powi(2);
            let half_column = dot(&wave.wave_vector, &column) / 2.0;
            let in_column = match half_column.abs() > 1e-6 {
                true => half_column.sin() / half_column,
                false => 1.0,
            };
            let argument = wave.argument(&at);
            let shifted = |by: &Scaled| (argument + dot(&wave.wave_vector, by)).cos();
            let mean = match &exposure[..] {
                [] | [_] => argument.cos(),
                all => all.iter().map(shifted).sum::<f64>() / all.len() as f64,
            };
            (1.0 - footprint.shading * squared) * (-0.5 * squared).exp() * in_column * mean
        };
        self.amplitude() * self.waves.iter().map(height).sum::<f64>()
    }

    /// Returns the root mean square height, and the autocorrelation lengths along and across the
    /// lay, mm.
    pub fn parameters(&self) -> (f64, [f64; 2]) {
        (self.sq, self.lengths)
    }

    /// Amplitude of one wave. The mean square of a cosine is 1/2.
    fn amplitude(&self) -> f64 {
        self.sq * (2.0 / f64::from(WAVES)).sqrt()
    }

    /// Returns the scaled position of a point.
    ///
    /// Let q be the ratio of the lengths across and along circular grooves. A point at radius ρ,
    /// azimuth φ and z has the coordinates (z, √(1 − q²)·ρ, q·ρ·cos φ, q·ρ·sin φ). Distances are
    /// then dz² + dρ² + (q·ρ·dφ)², which is correct in every direction.
    fn scaled(&self, point: DVec3) -> Scaled {
        let [along, across] = self.lengths;
        match &self.lay {
            Some(Lay::About { point: on, axis }) => {
                let ratio = across / along;
                let from_axis = point - *on;
                let radial = from_axis.reject_from_normalized(*axis);
                let [x, y] = azimuth_axes(*axis).map(|direction| radial.dot(direction));
                let z = from_axis.dot(*axis);
                let outward = (1.0 - ratio * ratio).sqrt() * radial.length();
                [z, outward, ratio * x, ratio * y].map(|length| length / across)
            }
            _ => self.linear(point),
        }
    }

    /// Returns the change of the scaled position along a tangent vector.
    fn scaled_tangent(&self, point: DVec3, by: DVec3) -> Scaled {
        let [along, across] = self.lengths;
        match &self.lay {
            Some(Lay::About { point: on, axis }) => {
                let ratio = across / along;
                let radial = (point - *on).reject_from_normalized(*axis);
                let [x, y] = azimuth_axes(*axis).map(|direction| by.dot(direction));
                let outward = radial.try_normalize().map_or(0.0, |radial| radial.dot(by));
                let outward = (1.0 - ratio * ratio).sqrt() * outward;
                [by.dot(*axis), outward, ratio * x, ratio * y].map(|length| length / across)
            }
            _ => self.linear(by),
        }
    }

    /// Returns a vector in units of the lengths, for straight grooves or an isotropic surface.
    fn linear(&self, v: DVec3) -> Scaled {
        let [along, across] = self.lengths;
        let scaled = match &self.lay {
            Some(Lay::Along(lay)) => v / across + *lay * lay.dot(v) * (1.0 / along - 1.0 / across),
            _ => v / across,
        };
        [scaled.x, scaled.y, scaled.z, 0.0]
    }
}

impl Wave {
    fn argument(&self, at: &Scaled) -> f64 {
        dot(&self.wave_vector, at) + self.phase
    }
}

/// Returns two unit vectors perpendicular to an axis and to each other.
fn azimuth_axes(axis: DVec3) -> [DVec3; 2] {
    let x = axis.any_orthonormal_vector();
    [x, axis.cross(x)]
}

fn dot(a: &Scaled, b: &Scaled) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
#[path = "topography_tests.rs"]
mod tests;
