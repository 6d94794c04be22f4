//! The pattern coordinate along a path on which the head turns against the part.

use super::anchor::{PoseAnchor, ScanCoordinate};
use super::frame_field::PupilPlace;
use super::motion::SurfaceView;
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
/// other steps shift across that direction does not decorrelate. Surface off the
/// view's point by a share ε of the radius it turns at slips by ε against its grains.
#[derive(Debug, Clone, PartialEq)]
pub struct PathAnchor {
    at: Vec<ScanCoordinate>,
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
                let step = b.pupil.shift - a.pupil.shift;
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
        PathAnchor { at }
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
}
