//! Directions of the chief rays behind the lens.

use super::CameraModel;
use crate::math::{DVec2, DVec3};
use glam::DMat2;

/// Direction cosines of the chief rays behind the lens as a function of pixel coordinates.
///
/// Let p be the vector from the pupil centre to a sensor point and n = p/|p|. The direction cosines
/// are the components (n_x, n_y) of n in the pupil plane. Lens distortion does not change them,
/// because it acts in front of the lens.
///
/// A field exp(2πi·q·X/λ) in the pupil plane, X being the position in the pupil, is in phase in the
/// direction with cosines −q. Direction cosines are therefore the spatial frequencies of the pupil
/// field. The speckle size in cosines is λ/D everywhere (D is the pupil diameter). The speckle size
/// on the sensor follows from the derivative of the cosines with respect to column and row:
///
/// ```text
/// M  = Tᵀ·(I − n·nᵀ)·P/|p|            T, P: bases of the sensor and of the pupil plane
/// h  = λ/(D·|Mᵀ·e|)                   along the unit vector e of the sensor
/// ```
///
/// The formula follows from the van Cittert–Zernike theorem (Goodman, *Statistical Optics*, section
/// 5.6) without the small-angle approximation. It is exact for pupils much smaller than |p|.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChiefRays {
    /// Vector from the pupil centre to the corner of pixel (0, 0), mm, followed by the steps per
    /// column and per row.
    corner: DVec3,
    by_pixel: [DVec3; 2],
}

impl CameraModel {
    /// Returns the chief rays behind the lens.
    pub fn chief_rays(&self) -> ChiefRays {
        let axes = self.sensor_axes();
        ChiefRays {
            corner: self.sensor_point(DVec2::ZERO),
            by_pixel: [axes.x_axis, axes.y_axis].map(|axis| axis * self.pixel_pitch),
        }
    }
}

impl ChiefRays {
    /// Returns the vector from the pupil centre to the given pixel coordinates, mm.
    fn place(&self, pixel: DVec2) -> DVec3 {
        self.corner + self.by_pixel[0] * pixel.x + self.by_pixel[1] * pixel.y
    }

    /// Returns the direction cosines at the pixel coordinates (column, row).
    #[inline(always)]
    pub fn cosines(&self, pixel: DVec2) -> DVec2 {
        let p = self.place(pixel);
        p.truncate() * (1.0 / p.length())
    }

    /// Returns the direction cosines and their derivatives with respect to column and row.
    #[inline(always)]
    pub fn around(&self, pixel: DVec2) -> (DVec2, DMat2) {
        let p = self.place(pixel);
        let per_mm = 1.0 / p.length();
        let n = p * per_mm;
        let [column, row] = self
            .by_pixel
            .map(|step| (step.truncate() - n.truncate() * n.dot(step)) * per_mm);
        (n.truncate(), DMat2::from_cols(column, row))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::fixture;
    use crate::math::rng::{Purpose, RngKey};

    /// Compares the derivatives with central differences over ±½ pixel. Their relative error is of
    /// order (pitch/distance)² < 1e-7.
    #[test]
    fn slopes_are_those_of_the_cosines() {
        let key = RngKey::new(4, Purpose::SensorNoise);
        for i in 0..100 {
            let uniform = |k| key.with(i).uniform(k);
            let mut camera = fixture();
            camera.tilt = DVec2::new(uniform(0) - 0.5, uniform(1) - 0.5) * 1.2;
            let rays = camera.model().chief_rays();
            let pixel = DVec2::new(uniform(2) * 800.0, uniform(3) * 600.0);
            let (at, slopes) = rays.around(pixel);
            assert!((at - rays.cosines(pixel)).length() < 1e-15, "{pixel}");
            for (step, slope) in [(DVec2::X, slopes.x_axis), (DVec2::Y, slopes.y_axis)] {
                let found = rays.cosines(pixel + step / 2.0) - rays.cosines(pixel - step / 2.0);
                assert!((found - slope).length() < 1e-6 * slope.length(), "{pixel}");
            }
        }
    }

    /// Compares the derivatives with closed forms for a sensor tilted by τ and a point at angle θ.
    /// With d the distance along the axis, |Mᵀe| is cosθ·cos²(θ + τ)/(d·cosτ) along the tilt.
    /// Perpendicular to the tilt it is cos(θ + τ)/(d·cosτ). θ is measured from the axis and is
    /// positive where the sensor is farther from the pupil. τ and θ are random.
    #[test]
    fn slopes_on_a_tilted_sensor_are_the_closed_forms() {
        let key = RngKey::new(5, Purpose::SensorNoise);
        for i in 0..50 {
            let tau = (key.with(i).uniform(0) - 0.5) * 1.4;
            let theta = (key.with(i).uniform(1) - 0.5) * 0.8;
            let mut camera = fixture();
            let d = camera.lens.image_distance();
            let pitch = camera.sensor.pixel_pitch;
            camera.tilt = DVec2::new(0.0, -tau);
            // The plane z = d + x·tanτ intersects the ray x = z·tanθ at x = d·tanθ/(1 − tanτ·tanθ).
            let x = d * theta.tan() / (1.0 - tau.tan() * theta.tan());
            let middle = camera.sensor.resolution.as_dvec2() / 2.0;
            let pixel = middle + DVec2::X * (x / tau.cos() / pitch);
            let (at, slopes) = camera.model().chief_rays().around(pixel);
            assert!((at.x - theta.sin()).abs() < 1e-12, "{tau} {theta}");
            let along = theta.cos() * (theta + tau).cos().powi(2) / (d * tau.cos());
            let across = (theta + tau).cos() / (d * tau.cos());
            let found = slopes.x_axis.length() / pitch;
            assert!(
                (found / along - 1.0).abs() < 1e-9,
                "{tau} {theta} {found} {along}"
            );
            let found = slopes.y_axis.length() / pitch;
            assert!(
                (found / across - 1.0).abs() < 1e-9,
                "{tau} {theta} {found} {across}"
            );
        }
    }
}
