//! The pattern coordinate along a path on which the head turns against the part.

use super::anchor::{FARTHEST, PoseAnchor, Reference, ScanCoordinate, rotation_vector};
use super::frame_field::PupilPlace;
use super::motion::SurfaceView;
use super::strips::Strip;
use crate::math::{DVec2, DVec3, Rigid};

/// The coordinate of a turning scan, a function of the place on its path alone.
///
/// No function of the pose follows turns past a fraction of a radian (see
/// [`PoseAnchor`]); the path, known as a whole before the first frame, can be
/// followed: the coordinate of frame k is the sum over j < k of what an anchor at
/// frame j says of the step from j to j + 1, so that every step has the tensor
/// formula's shift to the first order in the step. Between frames it is linear;
/// past the ends it goes on as in the last step, so two poses are enough for a path
/// of equal steps.
///
/// A place that the path visits twice has other grains the second time: also the
/// second turn of a rotary table. u follows −A_p of the largest step, and what
/// other steps shift across that direction does not decorrelate a ring of slices.
///
/// The coordinate is that of the view's point. A turn moves every place otherwise,
/// and [`references`](Self::references) say for each from where: the poses on the path in
/// which the strips of [`strips`](super::strips) filled the pupil, so that what is
/// added up along the path does not matter. A strip that the pupil leaves and comes
/// back to has other phasors the second time.
///
/// References must not be so far that the surface shows another side. So where speckle
/// hardly crosses the pupil, while the surface turns or comes nearer, the pupil is shifted
/// all the same, by a diameter for each `FARTHEST`. It is a view in which
/// the turn's axis halves the angle between laser and camera, and grains under it change
/// sooner than they should.
#[derive(Debug, Clone, PartialEq)]
pub struct PathAnchor {
    at: Vec<ScanCoordinate>,
    along: DVec2,
    /// Diameters that lie between phasors of one visit and of the next, so that a pupil
    /// sees none of both.
    apart: f64,
}

impl PathAnchor {
    /// `view` in head coordinates, then the poses of the frames, at least one.
    pub fn new(
        view: SurfaceView,
        part_from_head: impl IntoIterator<Item = Rigid>,
        wavelength_mm: f64,
    ) -> PathAnchor {
        let mut sum = ScanCoordinate {
            sensor: DVec2::ZERO,
            pupil: PupilPlace {
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
                // u is its own here, so the anchor's direction does not matter.
                let anchor = PoseAnchor::new(view, &from, DVec3::ZERO, wavelength_mm);
                let [a, b] = [from, pose].map(|pose| anchor.coordinate(&pose));
                let shift = b.pupil.shift - a.pupil.shift;
                let step = at_least(shift, largest, renewal(&view, &from, &pose));
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
        let across = |at: &ScanCoordinate| at.pupil.shift.dot(along.perp()).abs();
        PathAnchor {
            apart: 4.0 + 2.0 * at.iter().map(across).fold(0.0, f64::max),
            at,
            along,
        }
    }

    /// e: direction of the pupil's way over the field.
    pub fn along(&self) -> DVec2 {
        self.along
    }

    /// The references of the two strips that the pupil stands on at `place`, strips
    /// being `width` diameters wide; `pose` gives the poses of the path.
    pub fn references(
        &self,
        place: f64,
        width: f64,
        pose: impl Fn(f64) -> Rigid,
    ) -> [Reference; 2] {
        let way = self.coordinate(place).u;
        Strip::numbers(way, width).map(|number| {
            let visit = self.visit(place, Strip::middle(number, width), width);
            Reference {
                number,
                part_from_head: pose(visit.middle),
                at: self.coordinate(visit.middle),
                aside: visit.first as f64 * self.apart,
            }
        })
    }

    /// The visit of the pupil, on its way through `place`, to the strip of this middle.
    fn visit(&self, place: f64, middle: f64, width: f64) -> Visit {
        let last = self.at.len() - 1;
        let off = |node: usize| self.at[node].u - middle;
        let seen = |node: &usize| off(*node).abs() < width;
        let before = (place.max(0.0) as usize).min(last.saturating_sub(1));
        let entered = (0..=before).rev().find(|node| !seen(node));
        let first = entered.unwrap_or(0);
        // The way goes on as it went before its first node and after its last.
        let beyond = |node: usize, next: usize| {
            let step = off(next) - off(node);
            (step != 0.0).then(|| node as f64 - off(node) / step * (next as f64 - node as f64))
        };
        let before_all = (entered.is_none() && last > 0).then(|| beyond(0, 1));
        if let Some(crossing) = before_all.flatten().filter(|crossing| *crossing < 0.0) {
            return Visit {
                first,
                middle: crossing,
            };
        }
        let mut nearest = first;
        for node in first..last {
            // Out of the strip again, without a crossing.
            if node > before && !seen(&node) {
                return Visit {
                    first,
                    middle: nearest as f64,
                };
            }
            let crossed = off(node) * off(node + 1) <= 0.0 && off(node) != off(node + 1);
            if let Some(crossing) = beyond(node, node + 1).filter(|_| crossed) {
                return Visit {
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
        Visit {
            first,
            middle: middle.unwrap_or(nearest as f64),
        }
    }

    /// The pattern coordinate at a frame's number, or between two.
    pub fn coordinate(&self, place: f64) -> ScanCoordinate {
        let before = (place.max(0.0) as usize).min(self.at.len().saturating_sub(2));
        let from = self.at[before];
        let to = self.at[(before + 1).min(self.at.len() - 1)];
        let share = place - before as f64;
        ScanCoordinate {
            sensor: from.sensor + (to.sensor - from.sensor) * share,
            pupil: PupilPlace {
                shift: from.pupil.shift.lerp(to.pupil.shift, share),
                defocus: from.pupil.defocus + (to.pupil.defocus - from.pupil.defocus) * share,
            },
            u: from.u + (to.u - from.u) * share,
        }
    }
}

/// A stay of a strip in the pupil.
struct Visit {
    /// The last node of the path before it, or the path's first.
    first: usize,
    /// Where on the path the pupil stands in the strip's middle, or nearest to it.
    middle: f64,
}

/// Diameters by which the pupil must shift from one pose to another for references not to
/// be too far.
fn renewal(view: &SurfaceView, from: &Rigid, to: &Rigid) -> f64 {
    let motion = to.inverse() * *from;
    let turn = rotation_vector(&motion.rotation).length();
    let way = motion.point(view.point).distance(view.point);
    (turn + way / view.pupil_centre.distance(view.point)) / FARTHEST
}

/// `step`, or if it is shorter than `least` one of that length.
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
    use crate::speckle::motion::{Motion, Source, speckle_shift};

    /// A cylinder's top under a laser, watched obliquely; in focus.
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

    /// Head over a table that turns about x, RADIUS below the view.
    fn pose(angle: f64) -> Rigid {
        let centre = DVec3::Z * -RADIUS;
        let rotation = DMat3::from_axis_angle(DVec3::X, angle);
        let world_from_part = Rigid {
            rotation,
            translation: centre - rotation * centre,
        };
        world_from_part.inverse()
    }

    /// Every step, at 0° as at 350°, is the tensor formula's for the surface's way
    /// R·θ and turn θ; what the finite step leaves is its next order, θ/2 relative.
    #[test]
    fn each_step_of_a_full_turn_is_the_tensor_formula_s() {
        let step = 1e-3;
        let frames = (std::f64::consts::TAU / step) as usize;
        let anchor = PathAnchor::new(view(), (0..frames).map(|k| pose(step * k as f64)), 660e-6);
        let expected = speckle_shift(
            &view(),
            &Motion {
                part: DVec3::X.cross(DVec3::Z * RADIUS) * step,
                rotation: DVec3::X * step,
                ..Motion::default()
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
            // 400 sums of numbers up to 100.
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

    /// u(t) of paths that go on, come back, stand still, cross a strip in one step and go
    /// far in another: the reference of a strip stays the same as long as the pupil stands
    /// on it, strips come and go at its rim alone, and no two visits share phasors.
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
            let mut last: Option<[Reference; 2]> = None;
            let mut phasors: Vec<(f64, f64, f64)> = Vec::new();
            for place in (0..75_000).map(|i| fine * i as f64 - 0.5) {
                let u = anchor.coordinate(place).u;
                let both = anchor.references(place, width, pose);
                for now in &both {
                    let middle = Strip::middle(now.number, width);
                    assert!(now.at.sensor.is_finite() && now.at.pupil.shift.is_finite());
                    let place = now.part_from_head.translation.x;
                    assert!(place.is_finite(), "{which} {place}");
                    let before = last.iter().flatten().find(|r| r.number == now.number);
                    // The pupil, up to half a diameter beside its middle, is on the strip.
                    let step = (anchor.coordinate(place + fine).u - u).abs();
                    let stands = (u - middle).abs() < width - 2.0 * fine - step.min(0.5);
                    if let Some(before) = before.filter(|_| stands) {
                        assert_eq!(before, now, "{which} {place}");
                    }
                    let known = phasors
                        .iter()
                        .find(|p| p.0 == now.number && p.1 == now.aside);
                    match known {
                        Some(known) => assert_eq!(known.2, place, "{which}"),
                        None => phasors.push((now.number, now.aside, place)),
                    }
                }
                last = Some(both);
            }
        }
    }

    /// A turn about the line that halves the angle between laser and camera leaves
    /// the speckle in the pupil where it is. References stay within half a radian.
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
                assert!(turn < FARTHEST * (1.0 + 1e-6), "{place}: {turn}");
            }
        }
    }
}
