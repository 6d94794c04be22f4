//! Pattern coordinate along a path on which the head rotates relative to the part.

use super::anchor::{MAX_VIEW_CHANGE_RAD, PatternAnchor, PatternCoordinate, StripPose};
use super::frame_field::PupilPosition;
use super::motion::SurfaceView;
use super::strips::PupilStrip;
use crate::math::{DVec2, DVec3, Rigid, rotation_vector};

/// Pattern coordinate of a rotating scan, as a function of the path parameter only. The path
/// parameter is the frame number.
///
/// No function of the pose can follow rotations by more than a fraction of a radian (see
/// [`PatternAnchor`]). The path, however, is completely known before the first frame. The coordinate
/// of frame k is a sum over all j < k. Each term is the change of coordinate from j to j + 1,
/// computed by an anchor at frame j. Every step therefore has the shift of the tensor formula, to
/// first order in the step. The coordinate is linear between frames. Beyond the ends it continues
/// as in the last step, so two poses define a path of equal steps.
///
/// A position that the path visits twice has different grains the second time. This includes the
/// second revolution of a rotary table. u follows −A_p of the largest step. Shifts of other steps
/// across this direction do not decorrelate a ring of slices.
///
/// The coordinate belongs to the point of the view. A rotation displaces every surface point
/// differently, and [`references`](Self::references) returns the poses relative to which these
/// displacements are computed. They are the poses on the path at which the strips of
/// [`strips`](super::strips) fill the pupil, so the sum along the path does not matter. A strip
/// that leaves the pupil and returns has different phasors the second time.
///
/// References must be near enough that the view of the surface is similar. If speckle moves little
/// across the pupil while the surface rotates or approaches, the pupil is still shifted, by one
/// diameter per `FARTHEST`. This occurs in views where the axis of rotation bisects the angle
/// between laser and camera. Grains then change earlier than physically correct.
#[derive(Debug, Clone, PartialEq)]
pub struct PathAnchor {
    at: Vec<PatternCoordinate>,
    along: DVec2,
    /// Distance, in diameters, between the phasors of one visit and the next. A pupil never
    /// contains phasors of both.
    apart: f64,
}

impl PathAnchor {
    /// Creates an anchor from `view` (head coordinates) and the poses of the frames, at least one.
    pub fn new(
        view: SurfaceView,
        part_from_head: impl IntoIterator<Item = Rigid>,
        wavelength_mm: f64,
    ) -> PathAnchor {
        let mut sum = PatternCoordinate {
            sensor: DVec2::ZERO,
            pupil: PupilPosition {
                shift: DVec2::ZERO,
                defocus: 0.0,
            },
            u: 0.0,
        };
        let mut at = vec![sum];
        let mut poses = part_from_head.into_iter();
        let mut last = poses.next();
        let mut largest = DVec2::ZERO;
        for pose in poses {
            if let Some(from) = last.replace(pose) {
                // u is computed below, so the direction of the anchor does not matter.
                let anchor = PatternAnchor::new(view, &from, DVec3::ZERO, wavelength_mm);
                let [a, b] = [from, pose].map(|pose| anchor.coordinate(&pose));
                let shift = b.pupil.shift - a.pupil.shift;
                let step = at_least(shift, largest, renewal_diameters(&view, &from, &pose));
                if step.length_squared() > largest.length_squared() {
                    largest = step;
                }
                sum.sensor += b.sensor - a.sensor;
                sum.pupil.shift += step;
                sum.pupil.defocus += b.pupil.defocus - a.pupil.defocus;
                at.push(sum);
            }
        }
        let along = largest.try_normalize().unwrap_or(DVec2::X);
        for coordinate in &mut at {
            coordinate.u = coordinate.pupil.shift.dot(along);
        }
        let across = |at: &PatternCoordinate| at.pupil.shift.dot(along.perp()).abs();
        PathAnchor {
            apart: 4.0 + 2.0 * at.iter().map(across).fold(0.0, f64::max),
            at,
            along,
        }
    }

    /// Returns e, the direction in which the pupil moves over the field.
    pub fn along(&self) -> DVec2 {
        self.along
    }

    /// Returns the references of the two strips under the pupil at `place`, for strips `width`
    /// diameters wide. `pose` returns the poses of the path.
    pub fn references(
        &self,
        place: f64,
        width: f64,
        pose: impl Fn(f64) -> Rigid,
    ) -> [StripPose; 2] {
        let way = self.coordinate(place).u;
        PupilStrip::numbers(way, width).map(|number| {
            let visit = self.visit(place, PupilStrip::middle(number, width), width);
            StripPose {
                number,
                part_from_head: pose(visit.middle),
                at: self.coordinate(visit.middle),
                pupil_parallax: visit.first as f64 * self.apart,
            }
        })
    }

    /// Returns the pupil's visit to the strip centred at `middle`, for the part of the path around
    /// `place`.
    fn visit(&self, place: f64, middle: f64, width: f64) -> StripPass {
        let last = self.at.len() - 1;
        let off = |node: usize| self.at[node].u - middle;
        let seen = |node: &usize| off(*node).abs() < width;
        let before = (place.max(0.0) as usize).min(last.saturating_sub(1));
        let entered = (0..=before).rev().find(|node| !seen(node));
        let first = entered.unwrap_or(0);
        // The path continues linearly before its first node and after its last.
        let beyond = |node: usize, next: usize| {
            let step = off(next) - off(node);
            (step != 0.0).then(|| node as f64 - off(node) / step * (next as f64 - node as f64))
        };
        let before_all = (entered.is_none() && last > 0).then(|| beyond(0, 1));
        if let Some(crossing) = before_all.flatten().filter(|crossing| *crossing < 0.0) {
            return StripPass {
                first,
                middle: crossing,
            };
        }
        let mut nearest = first;
        for node in first..last {
            // The pupil left the strip without crossing its centre.
            if node > before && !seen(&node) {
                return StripPass {
                    first,
                    middle: nearest as f64,
                };
            }
            let crossed = off(node) * off(node + 1) <= 0.0 && off(node) != off(node + 1);
            if let Some(crossing) = beyond(node, node + 1).filter(|_| crossed) {
                return StripPass {
                    first,
                    middle: crossing,
                };
            }
            if off(node + 1).abs() < off(nearest).abs() {
                nearest = node + 1;
            }
        }
        let after = (last > 0).then(|| beyond(last, last - 1)).flatten();
        let middle = after.filter(|crossing| *crossing > last as f64);
        StripPass {
            first,
            middle: middle.unwrap_or(nearest as f64),
        }
    }

    /// Returns the pattern coordinate at a frame number or between two frames.
    pub fn coordinate(&self, place: f64) -> PatternCoordinate {
        let before = (place.max(0.0) as usize).min(self.at.len().saturating_sub(2));
        let from = self.at[before];
        let to = self.at[(before + 1).min(self.at.len() - 1)];
        let share = place - before as f64;
        PatternCoordinate {
            sensor: from.sensor + (to.sensor - from.sensor) * share,
            pupil: PupilPosition {
                shift: from.pupil.shift.lerp(to.pupil.shift, share),
                defocus: from.pupil.defocus + (to.pupil.defocus - from.pupil.defocus) * share,
            },
            u: from.u + (to.u - from.u) * share,
        }
    }
}

/// Interval of the path in which a strip is in the pupil.
struct StripPass {
    /// Last node of the path before the visit, or the first node of the path.
    first: usize,
    /// Path parameter at which the pupil is centred on the strip, or nearest to its centre.
    middle: f64,
}

/// Returns the least shift of the pupil between two poses, in diameters, that keeps references near
/// enough.
fn renewal_diameters(view: &SurfaceView, from: &Rigid, to: &Rigid) -> f64 {
    let motion = to.inverse() * *from;
    let turn = rotation_vector(&motion.rotation).length();
    let way = motion.point(view.point).distance(view.point);
    (turn + way / view.pupil_centre.distance(view.point)) / MAX_VIEW_CHANGE_RAD
}

/// Returns `step`, lengthened to `least` if it is shorter. A zero step takes the direction
/// `else_along`.
fn at_least(step: DVec2, else_along: DVec2, least: f64) -> DVec2 {
    if step.length() >= least {
        return step;
    }
    let direction = step.try_normalize().or(else_along.try_normalize());
    direction.unwrap_or(DVec2::X) * least
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DMat3;
    use crate::speckle::motion::{RigidMotion, Source, speckle_shift};

    /// Top of a cylinder under a laser, viewed obliquely and in focus.
    fn view() -> SurfaceView {
        let pupil_centre = DVec3::new(0.0, -106.0, 106.0);
        SurfaceView {
            point: DVec3::ZERO,
            normal: DVec3::Z,
            source: Source::Point(DVec3::new(0.0, 0.0, 150.0)),
            pupil_centre,
            pupil_diameter: 6.0,
            image_x: DVec3::X,
            focus_distance: pupil_centre.length(),
            magnification: -0.5,
        }
    }

    const RADIUS: f64 = 12.0;

    /// Returns the pose of the head over a table that rotates about x, RADIUS below the view.
    fn pose(angle: f64) -> Rigid {
        let centre = DVec3::Z * -RADIUS;
        let rotation = DMat3::from_axis_angle(DVec3::X, angle);
        let world_from_part = Rigid {
            rotation,
            translation: centre - rotation * centre,
        };
        world_from_part.inverse()
    }

    /// Every step, at 0° as at 350°, equals the tensor formula for the surface displacement R·θ and
    /// the rotation θ. The finite step has a relative residual of the next order, θ/2.
    #[test]
    fn each_step_of_a_full_turn_is_the_tensor_formula_s() {
        let step = 1e-3;
        let frames = (std::f64::consts::TAU / step) as usize;
        let anchor = PathAnchor::new(view(), (0..frames).map(|k| pose(step * k as f64)), 660e-6);
        let expected = speckle_shift(
            &view(),
            &RigidMotion {
                part: DVec3::X.cross(DVec3::Z * RADIUS) * step,
                rotation: DVec3::X * step,
                ..RigidMotion::default()
            },
        );
        for k in [0, 1000, 3141, 3142, frames - 2] {
            let [a, b] = [k, k + 1].map(|k| anchor.coordinate(k as f64));
            let sensor = b.sensor - a.sensor + expected.sensor;
            let pupil = (b.pupil.shift - a.pupil.shift) * view().pupil_diameter + expected.pupil;
            assert!(
                sensor.length() < step * expected.sensor.length(),
                "{k} {sensor}"
            );
            assert!(
                pupil.length() < step * expected.pupil.length(),
                "{k} {pupil}"
            );
            assert!((b.u - a.u - expected.delta).abs() < step * expected.delta);
        }
    }

    #[test]
    fn two_poses_stand_for_a_path_of_equal_steps() {
        let all = PathAnchor::new(view(), (0..400).map(|k| pose(0.02 * k as f64)), 660e-6);
        let two = PathAnchor::new(view(), (0..2).map(|k| pose(0.02 * k as f64)), 660e-6);
        for place in [-0.5, 0.0, 0.3, 1.0, 170.25, 399.5] {
            let (a, b) = (all.coordinate(place), two.coordinate(place));
            // Rounding of 400 sums of numbers up to 100.
            assert!(
                (a.sensor - b.sensor).length() < 1e-9,
                "{place}: {a:?} {b:?}"
            );
            assert!((a.u - b.u).abs() < 1e-9, "{place}: {a:?} {b:?}");
        }
    }

    #[test]
    fn a_path_of_one_pose_or_of_none_that_moves_stays_at_its_start() {
        for frames in [1, 3] {
            let anchor = PathAnchor::new(view(), (0..frames).map(|_| pose(0.4)), 660e-6);
            let there = anchor.coordinate(0.5);
            assert_eq!((there.sensor, there.u), (DVec2::ZERO, 0.0));
        }
    }

    /// u(t) of paths that proceed, return, stop, cross a strip in one step and jump several strips
    /// in another. The reference of a strip is constant while the pupil is on it. Strips enter and
    /// leave only at the pupil's rim. No two visits have phasors in common.
    #[test]
    fn references_change_only_when_the_pupil_has_left_their_strip() {
        let paths: [&dyn Fn(f64) -> f64; 4] = [
            &|k| 0.02 * k,
            &|k| 0.7 * (0.11 * k).sin(),
            &|k| if k < 80.0 { 0.013 * k } else { 1.04 },
            &|k| 0.9 * (0.5 * k).sin() + if k > 60.0 { 5.0 } else { 0.0 },
        ];
        for (which, angle) in paths.into_iter().enumerate() {
            let poses: Vec<Rigid> = (0..150).map(|k| pose(angle(k as f64))).collect();
            let anchor = PathAnchor::new(view(), poses, 660e-6);
            let pose = |place: f64| Rigid::translation(DVec3::X * place);
            let width = 1.0;
            let fine = 2e-3;
            let mut last: Option<[StripPose; 2]> = None;
            let mut phasors: Vec<(f64, f64, f64)> = Vec::new();
            for place in (0..75_000).map(|i| fine * i as f64 - 0.5) {
                let u = anchor.coordinate(place).u;
                let both = anchor.references(place, width, pose);
                for now in &both {
                    let middle = PupilStrip::middle(now.number, width);
                    assert!(now.at.sensor.is_finite() && now.at.pupil.shift.is_finite());
                    let place = now.part_from_head.translation.x;
                    assert!(place.is_finite(), "{which} {place}");
                    let before = last.iter().flatten().find(|r| r.number == now.number);
                    // The strip overlaps the pupil, which extends half a diameter from its centre.
                    let step = (anchor.coordinate(place + fine).u - u).abs();
                    let stands = (u - middle).abs() < width - 2.0 * fine - step.min(0.5);
                    if let Some(before) = before.filter(|_| stands) {
                        assert_eq!(before, now, "{which} {place}");
                    }
                    let known = phasors
                        .iter()
                        .find(|p| p.0 == now.number && p.1 == now.pupil_parallax);
                    match known {
                        Some(known) => assert_eq!(known.2, place, "{which}"),
                        None => phasors.push((now.number, now.pupil_parallax, place)),
                    }
                }
                last = Some(both);
            }
        }
    }

    /// A rotation about the bisector of the angle between laser and camera does not move the
    /// speckle in the pupil. References stay within half a radian.
    #[test]
    fn references_are_near_where_speckle_hardly_crosses_the_pupil() {
        let to_laser = DVec3::Z;
        let to_camera = view().pupil_centre.normalize();
        let axis = (to_laser + to_camera).normalize();
        let pose = |k: f64| Rigid {
            rotation: DMat3::from_axis_angle(axis, -0.01 * k),
            translation: DVec3::ZERO,
        };
        let anchor = PathAnchor::new(view(), (0..2).map(|k| pose(k as f64)), 660e-6);
        for place in [0.0, 31.4, 300.0, 1e5] {
            for reference in anchor.references(place, 1.0, pose) {
                let motion = pose(place).inverse() * reference.part_from_head;
                let turn = rotation_vector(&motion.rotation).length();
                assert!(turn < MAX_VIEW_CHANGE_RAD * (1.0 + 1e-6), "{place}: {turn}");
            }
        }
    }
}
