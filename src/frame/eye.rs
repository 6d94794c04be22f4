//! The lens as paths of light meet it: which place on the sensor a point of the part reaches through a point
//! of the pupil.

use super::View;
use super::defocus::Blur;
use super::sight::Sight;
use crate::camera::Projector;
use crate::math::{Aperture, DVec2, DVec3, Rigid};
use std::f64::consts::PI;

/// A thin lens in the part's frame. Out of focus it spreads light over the image of its pupil, unless the
/// view's image is sharp.
pub(super) struct Eye<'a> {
    view: &'a View<'a>,
    sight: Sight,
    projector: Projector,
    camera_from_part: Rigid,
    blurred: bool,
}

/// A point of the pupil.
#[derive(Clone, Copy)]
pub(super) struct PupilPoint {
    /// From its middle, camera frame, mm.
    off: DVec2,
    /// Part's frame.
    pub point: DVec3,
    /// From where surface is seen: the point, or in a sharp image the pupil's middle.
    pub origin: DVec3,
}

/// A place on the sensor and what it sees.
pub(super) struct Looked {
    /// Column and row.
    pub place: DVec2,
    /// Solid angle of a pixel there, as seen from the pupil's point, sr.
    pub solid_angle: f64,
    /// Irradiance on the sensor per radiance, sr.
    pub gain: f64,
}

impl<'a> Eye<'a> {
    pub fn new(view: &'a View<'a>) -> Eye<'a> {
        Eye {
            view,
            sight: Sight::new(view.camera, &view.part_from_camera),
            projector: view.camera.model().projector(),
            camera_from_part: view.part_from_camera.inverse(),
            blurred: view.lens.blur != Blur::None,
        }
    }

    /// At a place of the unit square, whose measure is area.
    pub fn pupil_point(&self, u: DVec2) -> PupilPoint {
        let aperture = self.view.camera.lens.aperture;
        let unit = match aperture {
            Aperture::Square => u * 2.0 - 1.0,
            Aperture::Circle | Aperture::Ellipse(_) => {
                let (sin, cos) = (2.0 * PI * u.y).sin_cos();
                DVec2::new(cos, sin * aperture.ratio()) * u.x.sqrt()
            }
        };
        let off = unit * (self.view.camera.lens.pupil_diameter() / 2.0);
        let axes = self.view.part_from_camera.rotation;
        let point = self.sight.eye + axes.x_axis * off.x + axes.y_axis * off.y;
        let origin = if self.blurred { point } else { self.sight.eye };
        PupilPoint { off, point, origin }
    }

    /// 1/z of what is in focus at a place on the sensor, 1/mm.
    fn vergence(&self, place: DVec2) -> f64 {
        let behind = self.sight.axis.dot(self.sight.to_sensor(place));
        // Nothing is focused beyond infinity.
        (1.0 / self.view.camera.lens.focal_length - 1.0 / behind).max(1e-12)
    }

    /// What a place on the sensor has in focus, from the middle of the pupil; in a sharp image any point of its
    /// ray.
    fn in_focus(&self, place: DVec2) -> DVec3 {
        let mut bend = DVec2::ZERO;
        let towards = self.sight.towards(self.sight.to_sensor(place), &mut bend);
        let scale = match self.blurred {
            true => self.vergence(place),
            false => 1.0,
        };
        towards / (scale * self.sight.axis.dot(towards))
    }

    /// Where a place on the sensor looks through a point of the pupil, unit vector.
    pub fn direction(&self, place: DVec2, pupil: &PupilPoint) -> DVec3 {
        (self.sight.eye + self.in_focus(place) - pupil.origin).normalize()
    }

    /// A place on the sensor.
    pub fn looked(&self, place: DVec2, pupil: &PupilPoint) -> Looked {
        let seen = |x: f64, y: f64| {
            let off = DVec2::new(x, y);
            self.sight.eye + self.in_focus(place + off) - pupil.origin
        };
        let by_column = seen(0.5, 0.0) - seen(-0.5, 0.0);
        let by_row = seen(0.0, 0.5) - seen(0.0, -0.5);
        let middle = seen(0.0, 0.0);
        let solid_angle = middle.dot(by_column.cross(by_row)).abs() / middle.length().powi(3);
        let chief = self.in_focus(place);
        Looked {
            place,
            solid_angle,
            gain: self.sight.solid_angle(place, chief),
        }
    }

    /// Where light from `point` comes through a point of the pupil. `None`: not to the sensor.
    pub fn image(&self, point: DVec3, pupil: &PupilPoint) -> Option<Looked> {
        let seen = self.camera_from_part.point(point);
        let mut place = self.projector.project(seen)?;
        if self.blurred {
            // What is in focus depends on the place where the sensor is tilted.
            for _ in 0..3 {
                let moved = pupil.off * (seen.z * self.vergence(place) - 1.0);
                place = self.projector.project(seen + moved.extend(0.0))?;
            }
        }
        let on_sensor = self.view.camera.sensor.resolution.as_dvec2();
        let hits = place.cmpge(DVec2::ZERO).all() && place.cmplt(on_sensor).all();
        hits.then(|| self.looked(place, pupil))
    }
}
