//! Camera: a thin lens, projected through its pupil centre, and a sensor that may be tilted.
//!
//! Camera frame: origin at the pupil centre, z along the optical axis into the scene, x towards
//! higher columns, y towards higher rows (mm). The sensor is represented in front of the lens,
//! where its image is upright. Pixel (i, j) covers [i, i+1] × [j, j+1] in (column, row); its centre
//! is (i + ½, j + ½).

mod ambient;
mod chief_rays;
mod column;
mod counts;
mod dark_noise;
mod distortion;
mod lens;
mod model;
mod sensor;
mod sparse_image;
mod speckle_size_range;

pub use ambient::irradiance_per_lux;
pub use chief_rays::ChiefRays;
pub use column::{ColumnView, ImageColumns};
pub use counts::Counts;
pub use dark_noise::DarkNoiseTable;
pub use distortion::Distortion;
pub use lens::{Lens, TELECENTRIC_PUPIL_DISTANCE};
pub use model::{CameraModel, Projector};
pub use sensor::{Noise, PixelPattern, Sensor};
pub use sparse_image::SparseImage;
pub use speckle_size_range::SpeckleSizeRange;

use crate::math::{DVec2, DVec3};
use glam::DMat2;

/// Lens with a sensor behind it.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Camera {
    /// Projection, focus and pupil.
    pub lens: Lens,
    /// Conversion of irradiance to counts.
    pub sensor: Sensor,
    /// Scheimpflug tilt of the sensor about the camera's x axis, then about its y axis, rad. With a
    /// positive tilt about x, high rows are focused closer to the lens.
    pub tilt: DVec2,
}

impl Camera {
    /// Returns the position of the camera in the camera frame: the pupil, or the position of a
    /// telecentric lens.
    pub fn position(&self) -> DVec3 {
        DVec3::Z * self.lens.position()
    }

    /// Returns the geometric model that maps pixels to directions.
    pub fn model(&self) -> CameraModel {
        CameraModel {
            resolution: self.sensor.resolution,
            pixel_pitch: self.sensor.pixel_pitch,
            principal_distance: self.lens.image_distance(),
            principal_point: self.sensor.resolution.as_dvec2() / 2.0 - self.sensor.off_middle,
            tilt: self.tilt,
            distortion: self.lens.distortion,
        }
    }

    /// Converts pixel coordinates to sensor coordinates; see [`CameraModel::screen`].
    pub fn screen(&self, pixel: DVec2) -> DVec2 {
        self.model().screen(pixel)
    }

    /// Returns a point of the sensor in the camera frame; see [`CameraModel::sensor_point`].
    pub fn sensor_point(&self, pixel: DVec2) -> DVec3 {
        self.model().sensor_point(pixel)
    }

    /// Returns the viewing direction of a pixel; see [`CameraModel::direction`].
    pub fn direction(&self, pixel: DVec2) -> DVec3 {
        self.model().direction(pixel)
    }

    /// Projects a point to pixel coordinates; see [`Projector::project`].
    ///
    /// ```
    /// use lasertrace::Scene;
    /// use lasertrace::math::{DVec2, DVec3};
    ///
    /// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
    /// let camera = &scene.camera;
    /// let pixel = camera.project(DVec3::new(0.0, 0.0, 150.0)).expect("in front of it");
    /// assert!((pixel - DVec2::new(320.0, 150.0)).length() < 1e-9);
    /// // At 150 mm, a lens of f = 50 mm has a magnification of ½: 1 mm is 100 pixels of 5 µm.
    /// let beside = camera.project(DVec3::new(1.0, 0.0, 150.0)).expect("in front of it");
    /// assert!((beside - pixel - DVec2::X * 100.0).length() < 1e-9);
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        self.model().project(point)
    }

    /// Returns the ratio of the irradiance at `pixel` to the radiance of the observed surface, sr.
    ///
    /// It is the pupil area times the cosines at pupil and sensor, divided by the squared distance.
    /// On axis it is π/(4·N²·(1+m)²). For a Lambertian source, the true value is smaller; the
    /// relative difference is below 1/(4N²(1+m)²), 0.4 % at f/8.
    ///
    /// The entrance pupil is modelled as a flat disc at a fixed position for all directions.
    /// Distortion therefore redistributes light and conserves its power; see
    /// [`Distortion::irradiance_jacobian`].
    pub fn pupil_solid_angle(&self, pixel: DVec2) -> f64 {
        let projector = self.model().projector();
        let to_sensor = projector.sensor_point(pixel);
        let distance = to_sensor.length();
        let cos_lens = to_sensor.z / distance;
        let cos_sensor = projector.sensor_normal().dot(to_sensor) / distance;
        let without = self.lens.pupil_area() * cos_lens * cos_sensor / (distance * distance);
        match &self.lens.distortion {
            None => without,
            Some(distortion) => {
                let seen = to_sensor.truncate() / to_sensor.z;
                without * distortion.irradiance_jacobian(distortion.undistort(seen, seen))
            }
        }
    }

    /// Returns an upper bound of [`Self::pupil_solid_angle`] over the sensor.
    pub fn greatest_pupil_solid_angle(&self) -> f64 {
        let size = self.sensor.resolution.as_dvec2();
        let corners = [DVec2::ZERO, size.with_y(0.0), size.with_x(0.0), size];
        let behind = corners.map(|corner| self.sensor_point(corner).z);
        let behind = behind.into_iter().fold(f64::INFINITY, f64::min);
        let reach = self.model().reach().unwrap_or(f64::INFINITY);
        let distortion = self.lens.distortion.as_ref();
        self.lens.pupil_area() / (behind * behind)
            * distortion.map_or(1.0, |d| d.greatest_concentration(reach))
    }

    /// Returns the minimal speckle size h = λ·d_PI/D at the centre of an untilted sensor, mm
    /// (Goodman 1975). The wavelength is in mm. For other positions, see
    /// [`Camera::grains_per_pixel`].
    pub fn speckle_size(&self, wavelength: f64) -> f64 {
        self.speckle_angle(wavelength) * self.lens.image_distance()
    }

    /// Returns the derivative of speckle coordinates with respect to column and row at pixel
    /// coordinates (column, row). The wavelength is in mm.
    ///
    /// This matrix converts a lag in pixels to a lag in units of the minimal speckle size, in the
    /// axes of the pupil plane. See [`ChiefRays`] for the formula.
    pub fn grains_per_pixel(&self, pixel: DVec2, wavelength: f64) -> DMat2 {
        let (_, slopes) = self.model().chief_rays().around(pixel);
        slopes * self.speckle_angle(wavelength).recip()
    }

    /// Returns the minimal speckle size λ/D in the direction cosines of [`ChiefRays`]. The
    /// wavelength is in mm.
    pub fn speckle_angle(&self, wavelength: f64) -> f64 {
        wavelength / self.lens.pupil_diameter()
    }

    /// Returns the blur diameter on the sensor for an object point at `point`, mm. The blur has the
    /// shape of the pupil (thin-lens geometry).
    pub fn defocus_blur(&self, point: DVec3) -> Option<f64> {
        let sensor_z = self.sensor_z(point)?;
        let image_z = self.lens.image_of(point.z)?;
        Some(self.lens.pupil_diameter() * ((sensor_z - image_z) / image_z).abs())
    }

    /// Returns the distance from the lens, along the axis, of the sensor position at which `point`
    /// is imaged, mm.
    fn sensor_z(&self, point: DVec3) -> Option<f64> {
        let projector = self.model().projector();
        Some(projector.sensor_point(projector.project(point)?).z)
    }

    /// Returns the defocus 1 − L_f/L_o of a point. L_o is its distance from the lens; L_f is the
    /// distance of the point in focus on the same ray. The value is zero in focus and negative for
    /// closer points.
    pub fn defocus(&self, point: DVec3) -> Option<f64> {
        let sensor_z = self.sensor_z(point)?;
        let focused_on = 1.0 / self.lens.focal_length - 1.0 / sensor_z;
        Some(1.0 - 1.0 / (focused_on * point.z)).filter(|d| d.is_finite())
    }

    /// Returns the focus distance (mm) and the sensor tilt (rad) that bring a plane into focus
    /// (Scheimpflug). The plane passes through `point` with `normal` (camera frame).
    ///
    /// The lens is focused at the intersection of the plane with the axis, and the sensor normal is
    /// along f·n − (n·p)·ẑ. Returns `None` if the plane contains the lens centre.
    pub fn focused_on_plane(
        focal_length: f64,
        (point, normal): (DVec3, DVec3),
    ) -> Option<(f64, DVec2)> {
        let offset = normal.dot(point);
        let mut n = normal * focal_length - DVec3::Z * offset;
        n = n.try_normalize()?;
        if n.z < 0.0 {
            n = -n;
        }
        // The z column of `sensor_axes` is (sin y·cos x, −sin x, cos y·cos x).
        let tilt = DVec2::new((-n.y).asin(), n.x.atan2(n.z));
        Some((offset / normal.z, tilt))
    }
}

/// Returns a camera with 800 × 600 pixels of 5.5 µm and a lens of 25 mm, f/8, focused at 240 mm. It
/// has no tilt and no noise.
#[cfg(test)]
pub(crate) fn fixture() -> Camera {
    Camera {
        lens: Lens {
            focal_length: 25.0,
            f_number: 8.0,
            focus_distance: 240.0,
            aperture: crate::math::Aperture::Circle,
            telecentric: false,
            distortion: None,
        },
        sensor: Sensor {
            resolution: glam::UVec2::new(800, 600),
            off_middle: DVec2::ZERO,
            readout_ms: 0.0,
            pixel_pitch: 0.0055,
            exposure_ms: 1.0,
            shorter: Vec::new(),
            quantum_efficiency: 0.5,
            gain_dn_per_e: 0.1,
            bit_depth: 12,
            full_well_e: 20_000.0,
            black_level_dn: 0.0,
            noise: None,
        },
        tilt: DVec2::ZERO,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    fn camera(tilt_deg: [f64; 2]) -> Camera {
        Camera {
            tilt: DVec2::from(tilt_deg.map(f64::to_radians)),
            ..fixture()
        }
    }

    #[test]
    fn the_axis_meets_the_middle_and_y_points_to_higher_rows() {
        let camera = camera([0.0, 0.0]);
        assert_eq!(
            camera.project(DVec3::Z * 99.0),
            Some(DVec2::new(400.0, 300.0))
        );
        let off = camera.project(DVec3::new(1.0, 2.0, 240.0)).unwrap();
        let scale = camera.lens.image_distance() / 240.0 / 0.0055;
        assert!((off - DVec2::new(400.0 + scale, 300.0 + 2.0 * scale)).length() < 1e-9);
        assert_eq!(camera.project(-DVec3::Z), None);
        assert_eq!(camera.project(DVec3::X), None);
    }

    #[test]
    fn projection_inverts_direction_at_any_tilt() {
        for tilt in [[0.0, 0.0], [12.0, 0.0], [-7.0, 20.0], [0.0, -45.0]] {
            let camera = camera(tilt);
            let key = RngKey::new(3, Purpose::SensorNoise);
            for i in 0..200 {
                let pixel = DVec2::new(
                    key.with(i).uniform(0) * 800.0,
                    key.with(i).uniform(1) * 600.0,
                );
                let seen = camera.direction(pixel) * (1.0 + 500.0 * key.with(i).uniform(2));
                let back = camera.project(seen).unwrap();
                assert!((back - pixel).length() < 1e-9, "{tilt:?} {pixel} {back}");
            }
        }
    }

    /// With the computed tilt, points on an oblique plane are in focus. The thin-lens geometry is
    /// exact, so only rounding errors remain.
    #[test]
    fn the_scheimpflug_tilt_brings_an_oblique_plane_into_focus() {
        let mut camera = camera([0.0, 0.0]);
        let point = DVec3::Z * camera.lens.focus_distance;
        let normal = DVec3::new(0.2, -0.7, 0.4);
        let along = [normal.cross(DVec3::X), normal.cross(DVec3::Y)];
        let blur_at = |camera: &Camera, a: f64, b: f64| {
            let p = point + along[0] * a + along[1] * b;
            camera.defocus_blur(p).unwrap()
        };
        assert!(blur_at(&camera, 20.0, 10.0) > 0.01);
        let (distance, tilt) = Camera::focused_on_plane(25.0, (point, normal)).unwrap();
        assert!((distance - 240.0).abs() < 1e-9);
        camera.tilt = tilt;
        for (a, b) in [(0.0, 0.0), (20.0, 10.0), (-15.0, 5.0), (0.0, -20.0)] {
            assert!(blur_at(&camera, a, b) < 1e-12, "{a} {b}");
        }
    }

    /// Compares the solid angle with a numerical integral of cos·cos/r² over the pupil, at a corner
    /// of a tilted sensor. The relative error of the small-pupil formula is (D/2b)² = 0.3 % times a
    /// factor of order 1, where b is the image distance.
    #[test]
    fn the_pupil_solid_angle_is_the_integral_over_a_small_pupil() {
        let camera = camera([8.0, -5.0]);
        let pixel = DVec2::new(30.0, 570.0);
        let p = camera.sensor_point(pixel);
        let normal = camera.model().sensor_axes().z_axis;
        let (n, radius) = (400, camera.lens.pupil_diameter() / 2.0);
        let cell = (2.0 * radius / n as f64).powi(2);
        let at = |i: usize| radius * ((2 * i + 1) as f64 / n as f64 - 1.0);
        let sum: f64 = (0..n * n)
            .map(|k| DVec3::new(at(k % n), at(k / n), 0.0))
            .filter(|q| q.length() <= radius)
            .map(|q| {
                let d = p - q;
                cell * d.z * d.dot(normal) / d.length().powi(4)
            })
            .sum();
        let ratio = camera.pupil_solid_angle(pixel) / sum;
        let bound = 2.0 * (radius / camera.lens.image_distance()).powi(2);
        assert!((ratio - 1.0).abs() < bound, "{ratio}");
    }

    /// Distortion conserves light. A Gaussian spot in the corner of the field is imaged by random
    /// lenses. The sum over pixels equals the light through the entrance pupil, which is the sum of
    /// A·cos⁴θ·d²x over object-side directions. Both sums sample the Gaussian at steps of at most
    /// σ/4, with aliases below exp(−2π²·16). They extend to 7 σ, beyond which exp(−24) remains.
    /// Rounding of 10⁴ terms is of the same order.
    #[test]
    fn distortion_moves_light_and_makes_none() {
        let key = RngKey::new(17, Purpose::SensorNoise);
        for i in 0..12 {
            let random = |k: u64| 2.0 * key.with(i).uniform(k) - 1.0;
            let mut camera = camera([20.0 * random(0), 15.0 * random(1)]);
            camera.sensor.pixel_pitch = 0.02;
            let sign = if i % 2 == 0 { 0.1 } else { -0.1 };
            let tangential = [0.01 * random(2), 0.01 * random(3)];
            let reach = camera.model().reach().unwrap();
            let lens = Distortion::new([sign, 0.1 * random(4), 0.0], tangential, reach).unwrap();
            camera.lens.distortion = Some(lens);
            let middle = camera.direction(DVec2::new(680.0, 120.0 + 180.0 * (i % 3) as f64));
            let middle = middle.truncate() / middle.z;
            // At least 5 pixels, because a pixel covers at most 1.7·pitch/distance with these
            // tilts.
            let sigma = 5.0 * 1.7 * camera.sensor.pixel_pitch / camera.lens.image_distance();
            let spot = |x: DVec2| (-0.5 * (x - middle).length_squared() / sigma.powi(2)).exp();
            let mut on_sensor = 0.0;
            for k in 0..800 * 600 {
                let pixel = DVec2::new((k % 800) as f64 + 0.5, (k / 800) as f64 + 0.5);
                let seen = camera.direction(pixel);
                let x = seen.truncate() / seen.z;
                if (x - middle).length() < 7.0 * sigma {
                    on_sensor += spot(x) * camera.pupil_solid_angle(pixel);
                }
            }
            let on_sensor = on_sensor * camera.sensor.pixel_pitch.powi(2);
            let step = sigma / 8.0;
            let mut through_pupil = 0.0;
            for k in 0..113 * 113 {
                let x = middle + step * (DVec2::new((k % 113) as f64, (k / 113) as f64) - 56.0);
                through_pupil += spot(x) * (1.0 + x.length_squared()).powi(-2);
            }
            let through_pupil = through_pupil * step * step * camera.lens.pupil_area();
            let ratio = on_sensor / through_pupil;
            assert!((ratio - 1.0).abs() < 1e-9, "{i}: {ratio}");
        }
    }
}
