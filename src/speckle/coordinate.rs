//! Conversion of directions behind the lens to texels of the pattern.

use crate::math::DVec2;

/// Position at which a pattern is read: s and t in texels, u in slices; finite. All three are
/// periodic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinate {
    /// Texels along a row of the pattern.
    pub s: f64,
    /// Texels along a column of the pattern.
    pub t: f64,
    /// Slices along the ring.
    pub u: f64,
}

/// Mapping from the sensor to the pattern.
///
/// The mapping of Bergmann et al. (2016) is (s,t) = α₁·a_I + α₂·t_screen. It assumes a grain h =
/// λ·d_PI/D in all directions and at all positions. In fact, the grain is constant only in the
/// direction cosines of the rays behind the lens, where its size is λ/D everywhere. The pattern is
/// therefore uniform in these cosines, (s,t) = (N/d)·(D/λ)·(cosines + a_I/d_PI).
///
/// Tilt and field angle determine the length and width of its grains on the sensor
/// ([`ChiefRays`](crate::camera::ChiefRays)).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrainMap {
    /// Texels per unit of direction cosine, as a vector in the direction of the sensor's columns on
    /// the pattern.
    texels: DVec2,
    /// d_PI on the axis, mm.
    image_distance: f64,
}

impl GrainMap {
    /// Creates a mapping. `texels_per_speckle` is taken from the spec of the pattern. `grain` is
    /// λ/D, the minimal speckle size in direction cosines. `image_distance` is the distance from
    /// pupil to sensor on the axis, mm.
    pub fn new(texels_per_speckle: f64, grain: f64, image_distance: f64) -> GrainMap {
        GrainMap {
            texels: DVec2::X * (texels_per_speckle / grain),
            image_distance,
        }
    }

    /// Returns the mapping rotated on the pattern: sensor columns that were parallel to s become
    /// parallel to `turn` (unit vector).
    pub fn turned(self, turn: DVec2) -> GrainMap {
        GrainMap {
            texels: turn.rotate(self.texels),
            ..self
        }
    }

    /// Converts a difference of direction cosines to texels.
    #[inline(always)]
    pub fn texels(&self, cosines: DVec2) -> DVec2 {
        self.texels.rotate(cosines)
    }

    /// Returns the texels by which a displacement a_I moves the reading position. a_I is in mm on
    /// an untilted sensor, at the centre of the field of view. The sign follows Bergmann et al.
    /// (2016): a pattern that moved by +a over the sensor is read with a_I = −a. The displacement
    /// moves grains without stretching them.
    pub fn displacement(&self, mm: DVec2) -> DVec2 {
        self.texels(mm / self.image_distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At the centre of the sensor, a grain h = λ·d_PI/D is `texels_per_speckle` texels wide, for
    /// positions and displacements.
    #[test]
    fn a_grain_in_the_middle_has_the_texels_of_the_pattern() {
        let (grain, distance) = (1e-4, 80.0);
        let map = GrainMap::new(4.0, grain, distance).turned(DVec2::new(0.6, 0.8));
        let h = grain * distance;
        let expected = DVec2::new(0.6, 0.8) * 4.0;
        assert!((map.displacement(DVec2::X * h) - expected).length() < 1e-12);
        assert!((map.texels(DVec2::X * (h / distance)) - expected).length() < 1e-12);
    }
}
