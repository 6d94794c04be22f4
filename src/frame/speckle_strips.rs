//! Position at which the light of a sample was imaged in a reference pose of the path.

use super::rays::SurfaceElement;
use crate::camera::{Camera, Distortion};
use crate::math::{DVec2, DVec3, Rigid, rotation_vector};
use crate::speckle::coordinate::GrainMap;
use crate::speckle::motion::{RigidMotion, Source, SurfaceView, shifts_on_pupil};
use crate::speckle::strips::PupilStrip;
use glam::DMat2;

/// The two strips that a frame's pupil covers, and their reference poses; see
/// [`strips`](crate::speckle::strips).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StripReferences {
    /// Position of the pupil on the phasor plane, and the direction of its motion: pupil diameters,
    /// along the sensor's columns and rows.
    pub pupil: DVec2,
    /// Unit vector of the pupil motion.
    pub along: DVec2,
    /// View at which the wavefront of the laser is evaluated, in the camera's frame.
    pub view: SurfaceView,
    /// The two strips that the pupil covers.
    pub strips: [StripReference; 2],
}

/// Strip and its reference pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StripReference {
    /// Strip, with the parameters for reading its field.
    pub strip: PupilStrip,
    /// Transform from the present part pose to the reference part pose, in the camera's frame.
    pub then_from_now: Rigid,
    /// Displacement added to the image of a point in the reference pose, (columns, rows) in mm on
    /// the sensor.
    pub displacement: DVec2,
}

/// Tangent plane at the hit of a pixel sample, in the laser's frame; zero if the sample hits no lit
/// surface.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct TangentPlane {
    /// Unit normal.
    pub normal: DVec3,
    /// Distance from the origin along the normal, mm.
    pub distance: f64,
}

impl TangentPlane {
    pub fn new(plane: &SurfaceElement) -> TangentPlane {
        TangentPlane {
            normal: plane.normal,
            distance: plane.normal.dot(plane.point),
        }
    }

    /// Returns true if both planes are equal within rounding. Any plane change that displaces a
    /// speckle grain is much larger.
    pub fn is_on(self, other: TangentPlane) -> bool {
        self.normal == other.normal
            && (self.distance - other.distance).abs() <= 1e-9 * self.distance.abs()
    }
}

/// Linearised reading position of strips around the centre of a pixel on a plane.
pub(super) struct StripCache {
    seen: TangentPlane,
    pub centre: DVec2,
    /// Half-width of the neighbourhood in which the linearisation may be reused, rows or columns.
    rows: f64,
    /// Direction cosines at the centre, and their derivatives with respect to column and row.
    pub at: [DVec2; 2],
    pub slopes: [DMat2; 2],
}

impl StripCache {
    /// Returns the offset from this centre to the centre of another pixel. `None` if that pixel
    /// hits a different plane or is outside the neighbourhood.
    pub fn to(&self, centre: DVec2, seen: TangentPlane) -> Option<DVec2> {
        let off = centre - self.centre;
        (off.abs().max_element() <= self.rows && seen.is_on(self.seen)).then_some(off)
    }
}

/// Reading positions of strips for one frame.
pub(super) struct StripLocator {
    focal_length: f64,
    /// Vector from the lens to the sensor's pixel (0, 0), and its steps per column and per row.
    corner: DVec3,
    steps: [DVec3; 2],
    distortion: Option<Distortion>,
    view: SurfaceView,
    /// Transform to the reference pose of the part, and the rotation since then, for each strip.
    strips: [(Rigid, RigidMotion); 2],
    /// Offsets added to the texture coordinates, texels.
    pub offsets: [DVec2; 2],
    camera_from_laser: Rigid,
    /// Shifts A_p of the pupil since the reference poses, diameters. With them the lens itself
    /// displaces fields on a surface that is out of focus. They are zero for fields on the sensor.
    through_lens: [DVec3; 2],
    /// Tolerance of the reading position, direction cosines.
    position_tolerance: f64,
}

/// Tolerance of the reading position, texels: 1 % of a grain.
pub(super) const POSITION_TOLERANCE_TEXELS: f64 = 0.03;

impl StripLocator {
    pub fn new(
        map: &GrainMap,
        wider: f64,
        strips: &StripReferences,
        camera: &Camera,
        camera_from_laser: Rigid,
    ) -> StripLocator {
        let at = |x: f64, y: f64| camera.sensor_point(DVec2::new(x, y));
        StripLocator {
            focal_length: camera.lens.focal_length,
            corner: at(0.0, 0.0),
            steps: [at(1.0, 0.0), at(0.0, 1.0)].map(|next| next - at(0.0, 0.0)),
            distortion: camera.lens.distortion,
            view: strips.view,
            strips: strips.strips.map(|reference| {
                let now_from_then = reference.then_from_now.inverse();
                let motion = RigidMotion {
                    rotation: rotation_vector(&now_from_then.rotation),
                    ..RigidMotion::default()
                };
                (reference.then_from_now, motion)
            }),
            offsets: (strips.strips).map(|reference| map.displacement(reference.displacement)),
            camera_from_laser,
            through_lens: strips.strips.map(|reference| {
                let since = strips.pupil - reference.strip.reference;
                -since.extend(0.0) * wider
            }),
            position_tolerance: POSITION_TOLERANCE_TEXELS / map.texels(DVec2::X).length(),
        }
    }

    /// Returns direction cosines before the lens for each strip. They belong to the chief ray of a
    /// surface point in the reference pose of the strip. The light of this surface point now
    /// reaches `place` through the centre of the strip.
    ///
    /// Since the reference pose, the strip centre has shifted by A_p. A_p is evaluated for the
    /// surface point itself, with its displacement, normal, viewing ray and illumination. The hit
    /// of the chief ray deviates from the surface point by 1 − L_o/L_f times the vector between the
    /// two pupil points. Beyond ±1 the blur is wider than the pupil, and the formula is not valid.
    /// Points lie on the rays before the lens, on which `place` is imaged with distortion. In the
    /// reference pose, points lie beyond the field of view by up to the pupil diameter, where the
    /// distortion is not defined. Grains are therefore read without distortion there, and in the
    /// image they are scaled by the local scale of the distortion.
    pub fn cosines(&self, place: DVec2, seen: TangentPlane) -> [DVec2; 2] {
        let behind = self.behind(place);
        let (direction, _) = self.before(behind);
        let point = self.point(direction, seen);
        let aside = self.pupil_parallax(behind, point, seen);
        [0, 1].map(|i| {
            let then = self.strips[i].0.point(point + aside[i]);
            then.normalize_or_zero().truncate()
        })
    }

    /// Returns the vector from the lens to a sensor position.
    fn behind(&self, place: DVec2) -> DVec3 {
        let [by_column, by_row] = self.steps;
        self.corner + by_column * place.x + by_row * place.y
    }

    /// Returns the ray before the lens that belongs to a ray behind it, and its derivatives with
    /// respect to column and row. The length of the ray is arbitrary.
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

    /// Returns the intersection of a ray with the plane, camera's frame.
    fn point(&self, direction: DVec3, seen: TangentPlane) -> DVec3 {
        let (normal, distance) = self.in_camera(seen);
        direction * (distance / normal.dot(direction))
    }

    /// Returns the normal and distance of a plane in the camera's frame.
    fn in_camera(&self, seen: TangentPlane) -> (DVec3, f64) {
        let normal = self.camera_from_laser.vector(seen.normal);
        let distance = seen.distance + normal.dot(self.camera_from_laser.translation);
        (normal, distance)
    }

    /// Returns the vectors from the hit of the chief ray to the surface points whose light passes
    /// through the strip centres.
    fn pupil_parallax(&self, behind: DVec3, point: DVec3, seen: TangentPlane) -> [DVec3; 2] {
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
            // The shift belongs to the unknown surface point. Between the two points it changes by
            // a fraction of about ten times aside/L_o. One iteration suffices if that exceeds the
            // tolerance.
            if 10.0 * aside.length_squared() <= self.position_tolerance * point.z * point.z {
                return aside;
            }
            beside(i, self.shifts(point + aside, normal)[i])
        })
    }

    /// Returns the linearisation of [`Self::cosines`] for all positions in the pixel around
    /// `centre`. `None` if one of them would see the plane behind the lens.
    ///
    /// The lateral offset of the surface points is treated as constant over the pixel. Its change
    /// is the change of defocus times D·|A_p|. The change of defocus is the footprint of the pixel
    /// times the slope of the plane over L_f. D·|A_p| is at most D. The error is therefore at most
    /// D/L_f times the slope, as a fraction of the footprint.
    ///
    /// The linearisation is also accurate a few rows away. At a relative distance r (distance over
    /// L_o), the error of the cosines is r². The lateral offset changes by a fraction of 10·r.
    pub fn around(&self, centre: DVec2, seen: TangentPlane) -> Option<StripCache> {
        let behind = self.behind(centre);
        let (direction, steps) = self.before(behind);
        let (normal, distance) = self.in_camera(seen);
        let along = 1.0 / normal.dot(direction);
        let way = distance * along;
        let point = direction * way;
        let slants = steps.map(|step| normal.dot(step) * along);
        // The plane is still in front of the lens half a pixel away.
        let is_seen = point.is_finite()
            && point.z * self.corner.z > 0.0
            && slants.iter().all(|slant| slant.abs() < 2.0);
        if !is_seen {
            return None;
        }
        let moves = [0, 1].map(|i| (steps[i] - direction * slants[i]) * way);
        let aside = self.pupil_parallax(behind, point, seen);
        let furthest = aside[0].length().max(aside[1].length());
        let pitch = (self.steps[1] / self.corner.z).length();
        let rows = (self.position_tolerance.sqrt() / pitch).min(
            0.1 * self.position_tolerance * point.z / (pitch * furthest.max(f64::MIN_POSITIVE)),
        );
        let mut around = StripCache {
            seen,
            centre,
            rows: if rows < 1.0 { 0.0 } else { rows },
            at: [DVec2::ZERO; 2],
            slopes: [DMat2::ZERO; 2],
        };
        for (i, aside) in aside.into_iter().enumerate() {
            let then_from_now = &self.strips[i].0;
            let then = then_from_now.point(point + aside);
            if !then.is_finite() {
                return None;
            }
            let per_mm = 1.0 / then.length();
            let cosines = then * per_mm;
            let slope = |step: DVec3| {
                let step = then_from_now.vector(step) * per_mm;
                (step - cosines * cosines.dot(step)).truncate()
            };
            around.at[i] = cosines.truncate();
            around.slopes[i] = DMat2::from_cols(slope(moves[0]), slope(moves[1]));
        }
        Some(around)
    }

    /// Returns, for each strip, the shift A_p of a point (camera's frame) since the reference pose,
    /// in pupil diameters.
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
        let motions = self.strips.map(|(then_from_now, motion)| RigidMotion {
            part: point - then_from_now.point(point),
            ..motion
        });
        shifts_on_pupil(&view, &motions, DVec3::Z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    const PUPIL: f64 = 6.0;
    const DEPTH: f64 = 240.0;

    /// Linearised positions agree with exact ones within a pixel. Planes have random slopes up to
    /// 1, in and out of focus. The motions shift the pupil field by up to a diameter.
    ///
    /// Over a pixel footprint of width o at depth L_o, the lateral offset changes by D·|A_p| times
    /// the change of defocus, Δdepth/L_f. It also changes with A_p: direction, distance and slant
    /// each change by o/L_o, which ten times o/L_o bounds in total. The tolerance is the sum of
    /// both over L_o and of the curvature of the cosines, (o/L_o)².
    #[test]
    fn a_pixel_on_a_plane_is_read_as_each_of_its_samples() {
        let (key, mut drawn) = (RngKey::new(5, Purpose::SpecklePattern), 0);
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
            let references = StripLocator {
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
                        RigidMotion {
                            rotation,
                            ..RigidMotion::default()
                        },
                    )
                }),
                offsets: [DVec2::ZERO; 2],
                camera_from_laser: Rigid::IDENTITY,
                through_lens: [DVec3::ZERO; 2],
                position_tolerance: 0.0,
            };
            let normal = DVec3::new(draw(-0.7, 0.7), draw(-0.7, 0.7), -1.0).normalize();
            let centre = DVec2::new(draw(0.0, 1600.0).floor(), draw(0.0, 1200.0).floor()) + 0.5;
            let distance = normal.z * DEPTH;
            let seen = TangentPlane { normal, distance };
            let around = references.around(centre, seen).unwrap();
            let place = centre + DVec2::new(draw(-0.5, 0.5), draw(-0.5, 0.5));
            let off = place - centre;
            let found = [0, 1].map(|i| around.at[i] + around.slopes[i] * off);
            assert_eq!(around.to(centre, seen), Some(DVec2::ZERO));
            let expected = references.cosines(place, seen);
            let behind = references.behind(centre);
            let point = references.point(behind, seen);
            let aside = references.pupil_parallax(behind, point, seen)[1];
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
            assert_eq!(around.to(centre, TangentPlane { normal, distance }), None);
            moved_far += usize::from(aside.length() > 100.0 * missed * DEPTH);
        }
        assert!(moved_far > 200, "{moved_far}");
    }
}
