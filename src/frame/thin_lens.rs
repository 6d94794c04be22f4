//! Thin-lens camera for light paths: images points of the part through points of the pupil.

use super::PoseView;
use super::defocus::Blur;
use super::pinhole::PinholeGeometry;
use crate::camera::Projector;
use crate::math::{Aperture, DVec2, DVec3, Rigid};
use std::f64::consts::PI;

/// Maximum number of iterations for the image of a point through a pupil point. Each step is about
/// a hundredth of the previous one.
const MOST_STEPS: usize = 16;
/// Squared step at which the iteration has converged, pixels².
const CONVERGED: f64 = 1e-16;

/// Thin lens in the part's frame. Light out of focus is distributed over the image of the pupil,
/// unless the view has a sharp image.
pub(super) struct ThinLens<'a> {
    view: &'a PoseView<'a>,
    pinhole: PinholeGeometry,
    projector: Projector,
    camera_from_part: Rigid,
    blurred: bool,
}

/// Point of the pupil.
#[derive(Clone, Copy)]
pub(super) struct PupilPoint {
    /// Position relative to the pupil centre, camera frame, mm.
    pupil_offset_mm: DVec2,
    /// Position in the part's frame, mm.
    pub point: DVec3,
    /// Origin of viewing rays: the pupil point, or the pupil centre for a sharp image.
    pub origin: DVec3,
}

/// Sensor position and its viewing geometry.
pub(super) struct SensorSample {
    /// Column and row.
    pub place: DVec2,
    /// Solid angle of the pixel at this position, as viewed from the pupil point, sr.
    pub solid_angle: f64,
    /// Irradiance on the sensor per radiance, sr.
    pub gain: f64,
}

impl<'a> ThinLens<'a> {
    pub fn new(view: &'a PoseView<'a>) -> ThinLens<'a> {
        ThinLens {
            view,
            pinhole: PinholeGeometry::new(view.camera, &view.part_from_camera),
            projector: view.camera.model().projector(),
            camera_from_part: view.part_from_camera.inverse(),
            blurred: view.lens.blur != Blur::None,
        }
    }

    /// Maps a position in the unit square to a pupil point. The density on the pupil is uniform.
    pub fn pupil_point(&self, u: DVec2) -> PupilPoint {
        let aperture = self.view.camera.lens.aperture;
        let unit = match aperture {
            Aperture::Square => u * 2.0 - 1.0,
            Aperture::Circle | Aperture::Ellipse(_) => {
                let (sin, cos) = (2.0 * PI * u.y).sin_cos();
                DVec2::new(cos, sin * aperture.ratio()) * u.x.sqrt()
            }
        };
        self.pupil_at(unit)
    }

    /// Returns the centre of the pupil.
    pub fn pupil_center(&self) -> PupilPoint {
        self.pupil_at(DVec2::ZERO)
    }

    /// Returns points of the pupil whose mean is the mean over the pupil for polynomials of degree
    /// 3 in the position.
    pub fn pupil_nodes(&self) -> [PupilPoint; 4] {
        let aperture = self.view.camera.lens.aperture;
        // Two of four points lie on each axis, at √2 standard deviations. The unit is half the width.
        let height = (2.0 * 4.0 * aperture.variance_along_height()).sqrt();
        let [x, y] = [DVec2::X * height / aperture.ratio(), DVec2::Y * height];
        [x, -x, y, -y].map(|unit| self.pupil_at(unit))
    }

    /// Returns the pupil point at a position relative to the centre, in units of the half diameter.
    fn pupil_at(&self, unit: DVec2) -> PupilPoint {
        let off = unit * (self.view.camera.lens.pupil_diameter() / 2.0);
        let axes = self.view.part_from_camera.rotation;
        let point = self.pinhole.camera_center + axes.x_axis * off.x + axes.y_axis * off.y;
        let origin = if self.blurred {
            point
        } else {
            self.pinhole.camera_center
        };
        PupilPoint {
            pupil_offset_mm: off,
            point,
            origin,
        }
    }

    /// Returns 1/z of the point in focus at a sensor position, 1/mm.
    fn vergence(&self, place: DVec2) -> f64 {
        let behind = self.pinhole.axis.dot(self.pinhole.to_sensor(place));
        // Clamped, because the focus cannot be beyond infinity.
        (1.0 / self.view.camera.lens.focal_length - 1.0 / behind).max(1e-12)
    }

    /// Returns the vector from the pupil centre to the point in focus at a sensor position. For a
    /// sharp image, it is an arbitrary point on the viewing ray.
    fn in_focus(&self, place: DVec2) -> DVec3 {
        let mut bend = DVec2::ZERO;
        let towards = self
            .pinhole
            .towards(self.pinhole.to_sensor(place), &mut bend);
        let scale = match self.blurred {
            true => self.vergence(place),
            false => 1.0,
        };
        towards / (scale * self.pinhole.axis.dot(towards))
    }

    /// Returns the unit viewing direction of a sensor position through a pupil point.
    pub fn direction(&self, place: DVec2, pupil: &PupilPoint) -> DVec3 {
        (self.pinhole.camera_center + self.in_focus(place) - pupil.origin).normalize()
    }

    /// Returns the viewing geometry of a sensor position.
    pub fn sensor_sample(&self, place: DVec2, pupil: &PupilPoint) -> SensorSample {
        let seen = |x: f64, y: f64| {
            let off = DVec2::new(x, y);
            self.pinhole.camera_center + self.in_focus(place + off) - pupil.origin
        };
        let by_column = seen(0.5, 0.0) - seen(-0.5, 0.0);
        let by_row = seen(0.0, 0.5) - seen(0.0, -0.5);
        let middle = seen(0.0, 0.0);
        let solid_angle = middle.dot(by_column.cross(by_row)).abs() / middle.length().powi(3);
        let chief = self.in_focus(place);
        SensorSample {
            place,
            solid_angle,
            gain: self.pinhole.solid_angle(place, chief),
        }
    }

    /// Returns the sensor position reached by light from `point` through a pupil point. `None` if
    /// it is not on the sensor.
    pub fn image(&self, point: DVec3, pupil: &PupilPoint) -> Option<SensorSample> {
        let seen = self.camera_from_part.point(point);
        let mut place = self.projector.project(seen)?;
        if self.blurred {
            // On a tilted sensor, the focus distance depends on the sensor position.
            for _ in 0..MOST_STEPS {
                let moved = pupil.pupil_offset_mm * (seen.z * self.vergence(place) - 1.0);
                let next = self.projector.project(seen + moved.extend(0.0))?;
                let step = (next - place).length_squared();
                place = next;
                if step < CONVERGED {
                    break;
                }
            }
        }
        let on_sensor = self.view.camera.sensor.resolution.as_dvec2();
        let hits = place.cmpge(DVec2::ZERO).all() && place.cmplt(on_sensor).all();
        hits.then(|| self.sensor_sample(place, pupil))
    }
}
