//! The camera as the part sees it: where its pixels look, and which pixel looks
//! at a point.

use crate::camera::{Camera, Distortion};
use crate::math::{DMat3, DVec2, DVec3, Rigid};

/// The pupil centre and the sensor drawn in front of it, in the part's frame, mm.
pub(crate) struct Sight {
    pub eye: DVec3,
    pub axis: DVec3,
    /// From the eye to the sensor point of pixel coordinate (0, 0), and the steps
    /// from column to column and row to row: the sensor is a plane.
    origin: DVec3,
    column: DVec3,
    row: DVec3,
    /// Numerator of the pupil's solid angle: area × cos·cos/r² is this × z/r⁴
    /// with r the distance to the sensor point and z that along the axis.
    pupil: f64,
    /// The lens's distortion, and part_from_camera.
    distortion: Option<(Distortion, DMat3)>,
}

impl Sight {
    pub fn new(camera: &Camera, part_from_camera: &Rigid) -> Sight {
        let at = |x: f64, y: f64| part_from_camera.vector(camera.sensor_point(DVec2::new(x, y)));
        let origin = at(0.0, 0.0);
        let (column, row) = (at(1.0, 0.0) - origin, at(0.0, 1.0) - origin);
        let normal = column.cross(row).normalize();
        Sight {
            eye: part_from_camera.translation,
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

    /// From the eye towards what is seen at a place on the sensor, any length;
    /// `bend` is how far the lens bends light, in normalised coordinates: a guess
    /// (zero, or that of a place beside it) and then this place's.
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

    /// [`Self::towards`] a place on the sensor, and how that changes by column and by
    /// row within a pixel.
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

    /// How the direction of a ray turns, at most and but for distortion, from column to column and from row to
    /// row, radians: as on the sensor's nearest point.
    pub fn steps(&self) -> [DVec3; 2] {
        let normal = self.column.cross(self.row).normalize();
        let distance = normal.dot(self.origin).abs();
        [self.column / distance, self.row / distance]
    }

    /// Irradiance at a place on the sensor per radiance of what it sees there, in
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
                without * distortion.concentration(seen.truncate() / seen.z)
            }
        }
    }

    /// From the eye to a place (column, row) on the sensor, mm; along the chief ray
    /// behind the lens.
    pub fn to_sensor(&self, pixel: DVec2) -> DVec3 {
        self.origin + self.row * pixel.y + self.column * pixel.x
    }
}

/// A point on or off the sensor: `pixel` looks at it from `scale` times as far as
/// the sensor is drawn. In front of the lens `scale` is positive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Image {
    pub pixel: DVec2,
    pub scale: f64,
}

/// [`Sight::to_sensor`] turned round: a projective map, as three linear forms of
/// the vector from the eye, `pixel = (column, row)/scale`.
pub(crate) struct Projection {
    eye: DVec3,
    pub column: DVec3,
    pub row: DVec3,
    pub scale: DVec3,
    /// See [`Self::spread`].
    steepest: DVec2,
}

impl Projection {
    /// For a sensor of `resolution` pixels.
    pub fn new(sight: &Sight, resolution: DVec2) -> Projection {
        let inverse = DMat3::from_cols(sight.column, sight.row, sight.origin).inverse();
        let forms = inverse.transpose();
        let (column, row, scale) = (forms.x_axis, forms.y_axis, forms.z_axis);
        let steepest = |form: DVec3, end: f64| form.length().max((form - scale * end).length());
        Projection {
            eye: sight.eye,
            column,
            row,
            scale,
            steepest: DVec2::new(steepest(column, resolution.x), steepest(row, resolution.y)),
        }
    }

    pub fn image(&self, p: DVec3) -> Image {
        let v = p - self.eye;
        let scale = self.scale.dot(v);
        let pixel = DVec2::new(self.column.dot(v), self.row.dot(v)) / scale;
        Image { pixel, scale }
    }

    /// How far apart the images of two points `distance` apart can lie in column
    /// and row, if one of them is on the sensor and the other has `scale` > 0:
    /// with a the form of the columns, c that of the scale and u = a·P/c·P the
    /// column of P on the sensor, u(Q) - u = (a - u·c)·(Q - P)/(c·Q), and
    /// |a - u·c| is greatest for a u at an end of the sensor.
    pub fn spread(&self, distance: f64, scale: f64) -> DVec2 {
        self.steepest * (distance / scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    /// Against the camera's own projection, at a tilt; and no two near points,
    /// one of them on the sensor, are imaged further apart than the bound.
    #[test]
    fn images_are_where_the_camera_has_them_and_spread_is_a_bound() {
        let camera = Camera {
            tilt: DVec2::new(0.4, -0.3),
            ..crate::camera::fixture()
        };
        let pose = Rigid::from_euler_xyz(DVec3::new(1.0, 2.0, -0.5), DVec3::new(7.0, 90.0, -3.0));
        let sight = Sight::new(&camera, &pose);
        let resolution = DVec2::new(800.0, 600.0);
        let projection = Projection::new(&sight, resolution);
        let key = Key::new(1, Purpose::SensorNoise);
        let mut closest = f64::INFINITY;
        for i in 0..2000 {
            let random = |j: u64| key.with(i).uniform(j);
            let pixel = DVec2::new(random(0), random(1)) * resolution;
            let p = sight.eye + sight.to_sensor(pixel) * (0.1 + 20.0 * random(2));
            let image = projection.image(p);
            let seen = camera.project(pose.inverse().point(p)).unwrap();
            assert!((image.pixel - pixel).length() < 1e-9);
            assert!((seen - pixel).length() < 1e-9 && image.scale > 0.0);
            let step = DVec3::new(random(3), random(4), random(5)) - 0.5;
            let other = projection.image(p + step);
            if other.scale > 0.0 {
                let bound = projection.spread(step.length(), other.scale);
                let moved = (other.pixel - pixel).abs();
                assert!(moved.cmple(bound + 1e-9).all(), "{moved} {bound}");
                closest = closest.min((bound / moved).min_element());
            }
        }
        // And it is no idle one.
        assert!(closest < 1.2, "{closest}");
    }
}
