//! Where a sample's light was seen in another pose of the path.

use super::rays::Plane;
use crate::camera::{Camera, Distortion};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use crate::speckle::anchor::rotation_vector;
use crate::speckle::coordinate::GrainMap;
use crate::speckle::motion::{Motion, Source, SurfaceView, shifts_on_pupil};
use crate::speckle::strips::Strip;
use glam::DMat2;

/// The strips that a frame's pupil stands on, and the poses that they refer to; see
/// [`strips`](crate::speckle::strips).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strips {
    /// Where the pupil stands on the plane of phasors, and the direction of its way:
    /// diameters, along the sensor's columns and rows.
    pub pupil: DVec2,
    /// Unit vector.
    pub along: DVec2,
    /// The view at which the laser's wavefront is taken, in the camera's frame.
    pub view: SurfaceView,
    /// The two strips that the pupil stands on.
    pub strips: [Reference; 2],
}

/// A strip and the pose it refers to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reference {
    /// The strip as it is read.
    pub strip: Strip,
    /// From where the part is, in the camera's frame, to where it was.
    pub then_from_now: Rigid,
    /// Added to where a point was seen, (columns, rows) in mm on the sensor.
    pub displacement: DVec2,
}

/// The plane that a sample of a pixel sees, in the laser's frame; zero if it sees nothing lit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Seen {
    /// Unit normal.
    pub normal: DVec3,
    /// From the origin along the normal, mm.
    pub distance: f64,
}

impl Seen {
    pub fn new(plane: &Plane) -> Seen {
        Seen {
            normal: plane.normal,
            distance: plane.normal.dot(plane.point),
        }
    }

    /// Whether this is the same plane as another to rounding; what moves a grain is far more.
    pub fn is_on(self, other: Seen) -> bool {
        self.normal == other.normal
            && (self.distance - other.distance).abs() <= 1e-9 * self.distance.abs()
    }
}

/// Where strips are read around a pixel's centre that sees a plane.
pub(super) struct Around {
    seen: Seen,
    pub centre: DVec2,
    /// So many rows up and down of it, and columns, it may be used for.
    rows: f64,
    /// Direction cosines at the centre, and by column and row.
    pub at: [DVec2; 2],
    pub slopes: [DMat2; 2],
}

impl Around {
    /// From its centre to a pixel's; `None` if that sees another plane, or is too far off.
    pub fn to(&self, centre: DVec2, seen: Seen) -> Option<DVec2> {
        let off = centre - self.centre;
        (off.abs().max_element() <= self.rows && seen.is_on(self.seen)).then_some(off)
    }
}

/// Finds where strips are to be read.
pub(super) struct References {
    focal_length: f64,
    /// From the lens to the sensor's pixel (0, 0), and by column and row.
    corner: DVec3,
    steps: [DVec3; 2],
    distortion: Option<Distortion>,
    view: SurfaceView,
    /// Where the part was, and its turn since then.
    strips: [(Rigid, Motion); 2],
    /// Texels to add.
    pub offsets: [DVec2; 2],
    camera_from_laser: Rigid,
    /// Shifts A_p of the pupil since the references, diameters, by which the lens itself moves a field
    /// on the surface that is out of focus; zero for fields on the sensor.
    through_lens: [DVec3; 2],
    /// By how much a place may be missed, direction cosines.
    missed: f64,
}

/// The same, texels: 1 % of a grain.
pub(super) const MISSED: f64 = 0.03;

impl References {
    pub fn new(
        map: &GrainMap,
        wider: f64,
        strips: &Strips,
        camera: &Camera,
        camera_from_laser: Rigid,
    ) -> References {
        let at = |x: f64, y: f64| camera.sensor_point(DVec2::new(x, y));
        References {
            focal_length: camera.lens.focal_length,
            corner: at(0.0, 0.0),
            steps: [at(1.0, 0.0), at(0.0, 1.0)].map(|next| next - at(0.0, 0.0)),
            distortion: camera.lens.distortion,
            view: strips.view,
            strips: strips.strips.map(|reference| {
                let now_from_then = reference.then_from_now.inverse();
                let motion = Motion {
                    rotation: rotation_vector(&now_from_then.rotation),
                    ..Motion::default()
                };
                (reference.then_from_now, motion)
            }),
            offsets: (strips.strips).map(|reference| map.displacement(reference.displacement)),
            camera_from_laser,
            through_lens: strips.strips.map(|reference| {
                let since = strips.pupil - reference.strip.reference;
                -since.extend(0.0) * wider
            }),
            missed: MISSED / map.texels(DVec2::X).length(),
        }
    }

    /// For each strip, the direction cosines behind the lens of the chief ray of the surface point in
    /// the strip's reference whose light now reaches `place` through the strip's middle.
    ///
    /// That middle has shifted since by A_p, which is that of the very point: of its
    /// own way, normal, viewing ray and light. The point that the chief ray meets lies
    /// 1 − L_o/L_f of the way to a point of the pupil beside the one whose light comes
    /// through that; beyond ±1 the blur is wider than the pupil and the formula is out of
    /// its domain. Points lie where the rays before the lens point; a lens that distorts images
    /// them where the rays behind it point, now and then.
    pub fn cosines(&self, place: DVec2, seen: Seen) -> [DVec2; 2] {
        let behind = self.behind(place);
        let (direction, _) = self.before(behind);
        let point = self.point(direction, seen);
        let aside = self.aside(behind, point, seen);
        [0, 1].map(|i| {
            let then = self.strips[i].0.point(point + aside[i]);
            self.imaged(then).0.normalize_or_zero().truncate()
        })
    }

    /// From the lens to a place on the sensor.
    fn behind(&self, place: DVec2) -> DVec3 {
        let [by_column, by_row] = self.steps;
        self.corner + by_column * place.x + by_row * place.y
    }

    /// Returns the ray before the lens, of any length, that leaves along one behind it, and its derivatives with
    /// respect to column and row.
    fn before(&self, behind: DVec3) -> (DVec3, [DVec3; 2]) {
        let Some(distortion) = &self.distortion else {
            return (behind, self.steps);
        };
        let seen = behind.truncate() / behind.z;
        let x = distortion.undistort(seen, seen);
        let scale = distortion.jacobian(x).inverse();
        let steps = self.steps.map(|step| {
            let turned = (step.truncate() - seen * step.z) / behind.z;
            (scale * turned).extend(0.0)
        });
        (x.extend(1.0), steps)
    }

    /// Returns the ray behind the lens, of any length, that images a point, and the matrix that takes a step of
    /// the point to one of that ray.
    fn imaged(&self, point: DVec3) -> (DVec3, DMat3) {
        let Some(distortion) = &self.distortion else {
            return (point, DMat3::IDENTITY);
        };
        let per_mm = 1.0 / point.z;
        let (imaged, scale) = distortion.continued(point.truncate() * per_mm);
        let [x, y] = [scale.x_axis * per_mm, scale.y_axis * per_mm];
        let along = -scale * point.truncate() * (per_mm * per_mm);
        let by_step = DMat3::from_cols(x.extend(0.0), y.extend(0.0), along.extend(0.0));
        (imaged.extend(1.0), by_step)
    }

    /// Returns the intersection of a ray with the plane, camera's frame.
    fn point(&self, direction: DVec3, seen: Seen) -> DVec3 {
        let (normal, distance) = self.in_camera(seen);
        direction * (distance / normal.dot(direction))
    }

    /// Normal and distance of a plane in the camera's frame.
    fn in_camera(&self, seen: Seen) -> (DVec3, f64) {
        let normal = self.camera_from_laser.vector(seen.normal);
        let distance = seen.distance + normal.dot(self.camera_from_laser.translation);
        (normal, distance)
    }

    /// From the point that the chief ray meets to those whose light comes through the middles
    /// of the strips.
    fn aside(&self, behind: DVec3, point: DVec3, seen: Seen) -> [DVec3; 2] {
        let focused_on = 1.0 / self.focal_length - 1.0 / behind.z;
        let blur = (1.0 - focused_on * point.z).clamp(-1.0, 1.0) * self.view.pupil_diameter;
        if blur == 0.0 {
            return [DVec3::ZERO; 2];
        }
        let normal = self.camera_from_laser.vector(seen.normal);
        let beside = |i: usize, shift: DVec3| (shift - self.through_lens[i]) * blur;
        let shifts = self.shifts(point, normal);
        [0, 1].map(|i| {
            let aside = beside(i, shifts[i]);
            // The shift is that of the point sought. It changes from there to here by a share of
            // some ten times aside/L_o of itself; once more is enough where that counts.
            if 10.0 * aside.length_squared() <= self.missed * point.z * point.z {
                return aside;
            }
            beside(i, self.shifts(point + aside, normal)[i])
        })
    }

    /// The same for all places of the pixel around `centre`; `None` where one of them would see
    /// the plane behind it.
    ///
    /// What lies aside is taken to be the same all over the pixel. It changes there by the
    /// change of the defocus, the pixel's image times the plane's slope over L_f, times D·|A_p|,
    /// which is at most D: a share D/L_f times the slope of the pixel.
    ///
    /// The same holds a few rows away: there cosines bend by the square of the way over that to
    /// the lens, and what lies aside changes by ten times the way's share of itself.
    pub fn around(&self, centre: DVec2, seen: Seen) -> Option<Around> {
        let behind = self.behind(centre);
        let (direction, steps) = self.before(behind);
        let (normal, distance) = self.in_camera(seen);
        let along = 1.0 / normal.dot(direction);
        let way = distance * along;
        let point = direction * way;
        let slants = steps.map(|step| normal.dot(step) * along);
        // Half a pixel away the plane is still before the lens.
        let is_seen = point.is_finite()
            && point.z * self.corner.z > 0.0
            && slants.iter().all(|slant| slant.abs() < 2.0);
        if !is_seen {
            return None;
        }
        let moves = [0, 1].map(|i| (steps[i] - direction * slants[i]) * way);
        let aside = self.aside(behind, point, seen);
        let furthest = aside[0].length().max(aside[1].length());
        let pitch = (self.steps[1] / self.corner.z).length();
        let rows = (self.missed.sqrt() / pitch)
            .min(0.1 * self.missed * point.z / (pitch * furthest.max(f64::MIN_POSITIVE)));
        let mut around = Around {
            seen,
            centre,
            rows: if rows < 1.0 { 0.0 } else { rows },
            at: [DVec2::ZERO; 2],
            slopes: [DMat2::ZERO; 2],
        };
        for (i, aside) in aside.into_iter().enumerate() {
            let then_from_now = &self.strips[i].0;
            let (then, by_step) = self.imaged(then_from_now.point(point + aside));
            if !then.is_finite() {
                return None;
            }
            let per_mm = 1.0 / then.length();
            let cosines = then * per_mm;
            let slope = |step: DVec3| {
                let step = by_step * then_from_now.vector(step) * per_mm;
                (step - cosines * cosines.dot(step)).truncate()
            };
            around.at[i] = cosines.truncate();
            around.slopes[i] = DMat2::from_cols(slope(moves[0]), slope(moves[1]));
        }
        Some(around)
    }

    /// For each strip A_p of a point (camera's frame) since the reference, in pupil diameters.
    fn shifts(&self, point: DVec3, normal: DVec3) -> [DVec3; 2] {
        let source = match self.view.source {
            Source::Wavefront {
                direction,
                curvature_per_mm,
            } => Source::Wavefront {
                direction: direction + curvature_per_mm * (point - self.view.point),
                curvature_per_mm,
            },
            source => source,
        };
        let view = SurfaceView {
            point,
            normal,
            source,
            ..self.view
        };
        let motions = self.strips.map(|(then_from_now, motion)| Motion {
            part: point - then_from_now.point(point),
            ..motion
        });
        shifts_on_pupil(&view, &motions, DVec3::Z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    const PUPIL: f64 = 6.0;
    const DEPTH: f64 = 240.0;

    /// Planes drawn at slopes up to 1, in and out of focus, under motions that shift the pupil
    /// field by up to a diameter. Over a pixel, o wide at depth L_o, what lies aside changes by
    /// D·|A_p| times the change of the defocus, Δdepth/L_f, and with A_p itself: its direction,
    /// distance and slant change by o/L_o each, ten times that in all. Over L_o, and with the
    /// bend of the cosines, (o/L_o)², that is what may be missed.
    #[test]
    fn a_pixel_on_a_plane_is_read_as_each_of_its_samples() {
        let (key, mut drawn) = (Key::new(5, Purpose::SpecklePattern), 0);
        let mut draw = |low: f64, high: f64| {
            drawn += 1;
            low + (high - low) * key.uniform(drawn)
        };
        let mut moved_far = 0;
        for _ in 0..400 {
            let blur = draw(-0.08, 0.08);
            let focal_length = 25.0;
            let behind = 1.0 / (1.0 / focal_length - (1.0 - blur) / DEPTH);
            let moved = DVec3::new(draw(-2.0, 2.0), draw(-2.0, 2.0), draw(-0.5, 0.5));
            let turn = Rigid::from_euler_xyz(DVec3::splat(draw(-2e-3, 2e-3)), moved);
            let references = References {
                focal_length,
                corner: DVec3::new(-4.0, -3.0, behind),
                steps: [DVec3::X * 5e-3, DVec3::Y * 5e-3],
                distortion: None,
                view: SurfaceView {
                    point: DVec3::Z * DEPTH,
                    normal: DVec3::NEG_Z,
                    source: Source::Point(DVec3::new(0.0, 120.0, 20.0)),
                    pupil_centre: DVec3::ZERO,
                    pupil_diameter: PUPIL,
                    image_x: DVec3::X,
                    focus_distance: DEPTH / (1.0 - blur),
                    magnification: behind / DEPTH,
                },
                strips: [Rigid::IDENTITY, turn].map(|then_from_now| {
                    let rotation = rotation_vector(&then_from_now.inverse().rotation);
                    (
                        then_from_now,
                        Motion {
                            rotation,
                            ..Motion::default()
                        },
                    )
                }),
                offsets: [DVec2::ZERO; 2],
                camera_from_laser: Rigid::IDENTITY,
                through_lens: [DVec3::ZERO; 2],
                missed: 0.0,
            };
            let normal = DVec3::new(draw(-0.7, 0.7), draw(-0.7, 0.7), -1.0).normalize();
            let centre = DVec2::new(draw(0.0, 1600.0).floor(), draw(0.0, 1200.0).floor()) + 0.5;
            let distance = normal.z * DEPTH;
            let seen = Seen { normal, distance };
            let around = references.around(centre, seen).unwrap();
            let place = centre + DVec2::new(draw(-0.5, 0.5), draw(-0.5, 0.5));
            let off = place - centre;
            let found = [0, 1].map(|i| around.at[i] + around.slopes[i] * off);
            assert_eq!(around.to(centre, seen), Some(DVec2::ZERO));
            let expected = references.cosines(place, seen);
            let behind = references.behind(centre);
            let point = references.point(behind, seen);
            let aside = references.aside(behind, point, seen)[1];
            let wide = 5e-3 / behind.z;
            let deeper = (references.point(references.behind(place), seen).z - point.z).abs();
            let missed = PUPIL / DEPTH * (deeper / DEPTH + 10.0 * blur.abs() * wide) + wide * wide;
            for (found, expected) in found.iter().zip(expected) {
                assert!(
                    found.distance(expected) <= missed,
                    "{found} {expected} {missed:e}"
                );
            }
            let distance = distance + 1e-3;
            assert_eq!(around.to(centre, Seen { normal, distance }), None);
            moved_far += usize::from(aside.length() > 100.0 * missed * DEPTH);
        }
        assert!(moved_far > 200, "{moved_far}");
    }
}
