//! From millimetres on the sensor to texels of the pattern.

use crate::math::DVec2;

/// Where a pattern is read: s and t in texels, u in slices; finite. All wrap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinate {
    pub s: f64,
    pub t: f64,
    pub u: f64,
}

/// Lays the pattern over the sensor: (s,t) = α₁·a_I + α₂·t_screen with
/// α₁ = (N/d)/h texels per millimetre, α₂ = α₁·pixel pitch (Bergmann et al.
/// 2016).
///
/// On a tilted sensor h changes from pixel to pixel. α(x)·x would then be
/// wrong to first order, since its derivative α + x·dα/dx is not α. The map
/// here is the conformal one whose scale is α₁·exp(−(∇h/h)·x): grains keep
/// their shape everywhere and have size h to second order in ∇h/h·x (0.5 %
/// where h is 10 % off its central value).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrainMap {
    /// α₁ at the sensor's origin, texels/mm.
    alpha: f64,
    /// ∇h/h at the sensor's origin, 1/mm.
    relative_gradient: DVec2,
}

impl GrainMap {
    /// `grain_mm` the minimal speckle size h = λ·d_PI/D at the sensor's
    /// origin, mm; `gradient` its change per millimetre of sensor, zero for
    /// an untilted one; `texels_per_speckle` of the pattern's spec.
    pub fn new(texels_per_speckle: f64, grain_mm: f64, gradient: DVec2) -> GrainMap {
        GrainMap {
            alpha: texels_per_speckle / grain_mm,
            relative_gradient: gradient / grain_mm,
        }
    }

    /// (s, t) in texels of the sensor point `screen_mm`, whose pattern is
    /// displaced by `a_i_mm` as the seed adds it: a pattern that moved by +a
    /// over the sensor is read with a_I = −a. The displacement is scaled by
    /// the central α₁, whatever its length, so that it moves grains without
    /// stretching them.
    pub fn position(&self, screen_mm: DVec2, a_i_mm: DVec2) -> DVec2 {
        self.alpha * (a_i_mm + self.flatten(screen_mm))
    }

    /// A displacement on the sensor (mm) in texels, as [`position`](Self::position)
    /// adds it.
    pub fn displacement(&self, mm: DVec2) -> DVec2 {
        self.alpha * mm
    }

    /// Whether grains have one size all over the sensor: then the map is linear.
    pub fn is_even(&self) -> bool {
        self.relative_gradient == DVec2::ZERO
    }

    /// (1 − exp(−cz))/c for z = x + iy and c = g_x − i·g_y, whose derivative
    /// has modulus exp(−g·x).
    fn flatten(&self, z: DVec2) -> DVec2 {
        let g = self.relative_gradient;
        if self.is_even() {
            return z;
        }
        let cz = DVec2::new(g.x * z.x + g.y * z.y, g.x * z.y - g.y * z.x);
        // The series' next term is |cz|⁴/120 < 1e-10, where the closed form
        // has begun to cancel.
        if cz.length_squared() < 1e-4 {
            let series = |factor: DVec2, n: f64| DVec2::X - cz.rotate(factor) / n;
            return z.rotate(series(series(series(DVec2::X, 4.0), 3.0), 2.0));
        }
        let shrunk = (-cz.x).exp() * DVec2::from_angle(-cz.y);
        // Division by c is multiplication by its conjugate (g_x, g_y) / |c|².
        (DVec2::X - shrunk).rotate(g) / g.length_squared()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_untilted_sensor_scales_by_alpha() {
        let map = GrainMap::new(4.0, 0.008, DVec2::ZERO);
        let at = map.position(DVec2::new(1.5, -2.0), DVec2::new(0.1, 0.2));
        assert!((at - DVec2::new(800.0, -900.0)).length() < 1e-9, "{at}");
    }

    /// The local scale, by central differences, is α₁·exp(−g·x) the same in
    /// both directions and without shear, and thus (N/d)/h to (g·x)²/2; on
    /// both sides of the switch from series to closed form.
    #[test]
    fn grains_keep_shape_and_have_the_local_size() {
        let (h, gradient) = (0.01, DVec2::new(1e-4, 3e-4));
        let map = GrainMap::new(4.0, h, gradient);
        for p in [
            DVec2::ZERO,
            DVec2::new(0.2, 0.1),
            DVec2::new(-3.0, 2.5),
            DVec2::new(2.0, 3.0),
        ] {
            let step = 1e-4;
            let slope = |d: DVec2| {
                (map.position(p + step * d, DVec2::ZERO) - map.position(p - step * d, DVec2::ZERO))
                    / (2.0 * step)
            };
            let (dx, dy) = (slope(DVec2::X), slope(DVec2::Y));
            let excess = gradient.dot(p) / h;
            let scale = 400.0 * (-excess).exp();
            assert!((dx.length() / scale - 1.0).abs() < 1e-7, "{p}");
            assert!((dy - dx.perp()).length() < 1e-7 * scale, "{p}");
            let local = 4.0 / (h * (1.0 + excess));
            assert!(
                (dx.length() / local - 1.0).abs() < 0.6 * excess * excess + 1e-7,
                "{p}"
            );
        }
    }
}
