//! From directions behind the lens to texels of the pattern.

use crate::math::DVec2;

/// Where a pattern is read: s and t in texels, u in slices; finite. All wrap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinate {
    /// Texels along a pattern's row.
    pub s: f64,
    /// Texels down a pattern's column.
    pub t: f64,
    /// Slices along the ring.
    pub u: f64,
}

/// Lays the pattern over the sensor.
///
/// The seed's (s,t) = α₁·a_I + α₂·t_screen (Bergmann et al. 2016) takes the grain to be
/// h = λ·d_PI/D in all directions and everywhere. It is so in the direction cosines of
/// the rays behind the lens, of which it is λ/D. So the pattern lies evenly over these,
/// (s,t) = (N/d)·(D/λ)·(cosines + a_I/d_PI), and on the sensor its grains are as long
/// and as wide as tilt and field make them
/// ([`ChiefRays`](crate::camera::ChiefRays)).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrainMap {
    /// Texels per unit of direction cosine, along the direction that the sensor's columns
    /// have on the pattern.
    texels: DVec2,
    /// d_PI on the axis, mm.
    image_distance: f64,
}

impl GrainMap {
    /// `grain` is λ/D, the minimal speckle size in direction cosines; `image_distance`
    /// the distance from pupil to sensor on the axis, mm; `texels_per_speckle` of the
    /// pattern's spec.
    pub fn new(texels_per_speckle: f64, grain: f64, image_distance: f64) -> GrainMap {
        GrainMap {
            texels: DVec2::X * (texels_per_speckle / grain),
            image_distance,
        }
    }

    /// The same map onto a pattern on which the sensor's columns run along `turn`
    /// (unit vector) where they ran along s.
    pub fn turned(self, turn: DVec2) -> GrainMap {
        GrainMap {
            texels: turn.rotate(self.texels),
            ..self
        }
    }

    /// Texels of a difference of direction cosines.
    #[inline(always)]
    pub fn texels(&self, cosines: DVec2) -> DVec2 {
        self.texels.rotate(cosines)
    }

    /// Texels by which a displacement a_I moves the place where the pattern is read. a_I
    /// is in mm on an untilted sensor, in the middle of the field: as the seed adds it, a
    /// pattern that moved by +a over the sensor is read with a_I = −a. It moves grains
    /// without stretching them.
    pub fn displacement(&self, mm: DVec2) -> DVec2 {
        self.texels(mm / self.image_distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grain h = λ·d_PI/D is `texels_per_speckle` texels wide in the middle of the
    /// sensor, for places and for displacements alike.
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
