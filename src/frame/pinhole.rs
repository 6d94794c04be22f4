//! Viewing geometry in the part's frame: rays of pixels and projection of points.

use crate::camera::{Camera, Distortion};
use crate::math::{DMat3, DVec2, DVec3, Rigid};

/// Pupil centre, and sensor mirrored to the front of it, in the part's frame, mm.
pub(crate) struct PinholeGeometry {
    pub camera_center: DVec3,
    pub axis: DVec3,
    /// Vector from the eye to the sensor point of pixel coordinate (0, 0), and the steps per column
    /// and per row. The sensor is a plane.
    origin: DVec3,
    column: DVec3,
    row: DVec3,
    /// Numerator of the pupil's solid angle. Area × cos·cos/r² is this value × z/r⁴, where r is the
    /// distance to the sensor point and z its component along the axis.
    pupil: f64,
    /// Distortion of the lens, and the rotation of part_from_camera.
    distortion: Option<(Distortion, DMat3)>,
}

impl PinholeGeometry {
    pub fn new(camera: &Camera, part_from_camera: &Rigid) -> PinholeGeometry {
        let at = |x: f64, y: f64| part_from_camera.vector(camera.sensor_point(DVec2::new(x, y)));
        let origin = at(0.0, 0.0);
        let (column, row) = (at(1.0, 0.0) - origin, at(0.0, 1.0) - origin);
        let normal = column.cross(row).normalize();
        PinholeGeometry {
            camera_center: part_from_camera.translation,
            axis: part_from_camera.rotation.z_axis,
            origin,
            column,
            row,
            pupil: camera.lens.pupil_area() * normal.dot(origin),
            distortion: camera
                .lens
                .distortion
                .map(|d| (d, part_from_camera.rotation)),
        }
    }

    /// Returns the viewing direction from the eye for a point on the sensor; its length is
    /// arbitrary. `bend` is the ray deflection by distortion, in normalised coordinates. On input
    /// it is an initial value (zero, or the deflection of a neighbouring point), on output the
    /// deflection at this point.
    pub fn towards(&self, to_sensor: DVec3, bend: &mut DVec2) -> DVec3 {
        let Some((distortion, axes)) = &self.distortion else {
            return to_sensor;
        };
        let behind = axes.transpose() * to_sensor;
        let seen = behind.truncate() / behind.z;
        let x = distortion.undistort(seen, seen + *bend);
        *bend = x - seen;
        *axes * x.extend(1.0)
    }

    /// Returns the direction [`Self::towards`] a sensor position and its derivatives with respect
    /// to column and row, as differences across one pixel.
    pub fn around(&self, place: DVec2) -> (DVec3, [DVec3; 2]) {
        let to_sensor = self.to_sensor(place);
        if self.distortion.is_none() {
            return (to_sensor, [self.column, self.row]);
        }
        let mut bend = DVec2::ZERO;
        let direction = self.towards(to_sensor, &mut bend);
        let steps = [self.column, self.row].map(|step| {
            let mut at = |share: f64| self.towards(to_sensor + step * share, &mut bend);
            at(0.5) - at(-0.5)
        });
        (direction, steps)
    }

    /// Returns upper bounds of the change of ray direction per column and per row, radians, without
    /// distortion. They hold at the sensor point nearest to the eye.
    pub fn steps(&self) -> [DVec3; 2] {
        let normal = self.column.cross(self.row).normalize();
        let distance = normal.dot(self.origin).abs();
        [self.column / distance, self.row / distance]
    }

    /// Returns the irradiance at a sensor position per radiance of the surface visible in
    /// `direction` from the eye, sr; see
    /// [`Camera::pupil_solid_angle`](crate::camera::Camera::pupil_solid_angle).
    pub fn solid_angle(&self, place: DVec2, direction: DVec3) -> f64 {
        let to_sensor = self.to_sensor(place);
        let r2 = to_sensor.length_squared();
        let without = self.pupil * self.axis.dot(to_sensor) / (r2 * r2);
        match &self.distortion {
            None => without,
            Some((distortion, axes)) => {
                let seen = axes.transpose() * direction;
                without * distortion.irradiance_jacobian(seen.truncate() / seen.z)
            }
        }
    }

    /// Returns the vector from the eye to a sensor position (column, row), mm. It is parallel to
    /// the chief ray behind the lens.
    pub fn to_sensor(&self, pixel: DVec2) -> DVec3 {
        self.origin + self.row * pixel.y + self.column * pixel.x
    }
}

/// Projection of a point: `pixel` (on or off the sensor), and the distance `scale` of the point
/// relative to the distance of the mirrored sensor. `scale` is positive in front of the lens.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Image {
    pub pixel: DVec2,
    pub scale: f64,
}

/// Inverse of [`PinholeGeometry::to_sensor`]: a projective map, stored as three linear forms of the
/// vector from the eye. `pixel = (column, row)/scale`.
pub(crate) struct Projection {
    camera_center: DVec3,
    pub column: DVec3,
    pub row: DVec3,
    pub scale: DVec3,
    /// Largest gradient of column and row, see [`Self::max_image_distance`].
    steepest: DVec2,
}

impl Projection {
    /// Builds the projection onto a sensor of `resolution` pixels.
    pub fn new(sight: &PinholeGeometry, resolution: DVec2) -> Projection {
        let inverse = DMat3::from_cols(sight.column, sight.row, sight.origin).inverse();
        let forms = inverse.transpose();
        let (column, row, scale) = (forms.x_axis, forms.y_axis, forms.z_axis);
        let steepest = |form: DVec3, end: f64| form.length().max((form - scale * end).length());
        Projection {
            camera_center: sight.camera_center,
            column,
            row,
            scale,
            steepest: DVec2::new(steepest(column, resolution.x), steepest(row, resolution.y)),
        }
    }

    pub fn image(&self, p: DVec3) -> Image {
        let v = p - self.camera_center;
        let scale = self.scale.dot(v);
        let pixel = DVec2::new(self.column.dot(v), self.row.dot(v)) / scale;
        Image { pixel, scale }
    }

    /// Returns an upper bound of the image distance, in columns and rows, of two points that are
    /// `distance` apart. One of them is on the sensor, the other has `scale` > 0.
    ///
    /// Let a be the linear form of the column, c the linear form of the scale, and u = a·P/c·P the
    /// column of P on the sensor. Then u(Q) - u = (a - u·c)·(Q - P)/(c·Q). The factor |a - u·c| is
    /// largest for a u at an end of the sensor.
    pub fn max_image_distance(&self, distance: f64, scale: f64) -> DVec2 {
        self.steepest * (distance / scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Projected images agree with the projection by the camera for a tilted sensor. Images of two
    /// nearby points, one of them on the sensor, are never further apart than the bound.
    #[test]
    fn images_are_where_the_camera_has_them_and_spread_is_a_bound() {
        let camera = Camera {
            tilt: DVec2::new(0.4, -0.3),
            ..crate::camera::fixture()
        };
        let pose = Rigid::from_euler_xyz(DVec3::new(1.0, 2.0, -0.5), DVec3::new(7.0, 90.0, -3.0));
        let sight = PinholeGeometry::new(&camera, &pose);
        let resolution = DVec2::new(800.0, 600.0);
        let projection = Projection::new(&sight, resolution);
        let key = RngKey::new(1, Purpose::SensorNoise);
        let mut closest = f64::INFINITY;
        for i in 0..2000 {
            let random = |j: u64| key.with(i).uniform(j);
            let pixel = DVec2::new(random(0), random(1)) * resolution;
            let p = sight.camera_center + sight.to_sensor(pixel) * (0.1 + 20.0 * random(2));
            let image = projection.image(p);
            let seen = camera.project(pose.inverse().point(p)).unwrap();
            assert!((image.pixel - pixel).length() < 1e-9);
            assert!((seen - pixel).length() < 1e-9 && image.scale > 0.0);
            let step = DVec3::new(random(3), random(4), random(5)) - 0.5;
            let other = projection.image(p + step);
            if other.scale > 0.0 {
                let bound = projection.max_image_distance(step.length(), other.scale);
                let moved = (other.pixel - pixel).abs();
                assert!(moved.cmple(bound + 1e-9).all(), "{moved} {bound}");
                closest = closest.min((bound / moved).min_element());
            }
        }
        // The bound is tight: it is approached within 20 %.
        assert!(closest < 1.2, "{closest}");
    }
}
