//! The pattern coordinate through a scan: a function of the pose alone, so that
//! frames can be rendered in any order and each surface point keeps its grains
//! while the laser sweeps over it.

use super::motion::{Motion, SurfaceView, speckle_shift};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use glam::DQuat;

/// Where a pose looks the pattern up.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ScanCoordinate {
    /// (s,t) in mm on the sensor, to be added to the pixel's own position.
    pub sensor: DVec2,
    /// The same for the pupil field: minus its shift A_p, in pupil diameters.
    pub pupil: DVec2,
    /// u: the part of `pupil` along the shift that the scan direction makes.
    pub u: f64,
}

/// Fixes the pattern to the part.
///
/// ```text
/// (s,t) = m·Qᵀ·R₀·X          X: the view's point in part coordinates at this pose
/// A_p   = tensor formula of the motion a = −R₀·X, Ω = log(R·R₀ᵀ)
/// u     = e·(−A_p)/D         e: direction of −A_p for a step along the scan
/// ```
///
/// R is head_from_part, R₀ its value at the reference orientation, and the rest as
/// in [`motion`](super::motion); everything is evaluated at one view (usually
/// the middle of the field), which the head carries with it. The lens is taken in
/// focus.
///
/// Exact, to the order of the tensor formula, for a head translated without
/// turning (R = R₀) in any direction and over any length: the coordinate is then
/// linear in the pose, its difference between two poses is −a_I and −A_p/D of the
/// motion between them, and `u` changes by δ for steps along the scan direction.
/// A step in another direction changes `u` by less than δ, the part of A_p across
/// e being lost to the one-dimensional stack of slices; `sensor` still moves
/// fully, so what is lost is the boiling of the grains, not their travel.
///
/// For a turned head the coordinate stays a continuous function of the pose (up to
/// turns of 180° from R₀) and a surface point under the view keeps its (s,t), but
/// its differences are those of the tensor formula only to a relative error of
/// about the angle of R·R₀ᵀ, because small turns and translations do not commute and
/// no function of the pose can follow them all. So a scan that turns needs one
/// anchor a pass, with R₀ the orientation in the middle of the pass.
///
/// Points that are imaged with another magnification m′ than the view's keep the
/// grain size, but their grains slip against the surface by (m − m′)/m of its way
/// while they are lit. A view that the tensor formula is singular at (grazing) has
/// constant `pupil` and `u`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseAnchor {
    view: SurfaceView,
    reference: DMat3,
    along: DVec2,
}

impl PoseAnchor {
    /// `view` in head coordinates; `head_from_part` the reference orientation;
    /// `scan_direction` of the head, in head coordinates. If that direction does
    /// not shift the pupil field, u follows the basis Q's x axis.
    pub fn new(view: SurfaceView, head_from_part: DMat3, scan_direction: DVec3) -> PoseAnchor {
        let step = Motion {
            part: -scan_direction,
            ..Motion::default()
        };
        let view = SurfaceView {
            focus_distance: view.pupil_centre.distance(view.point),
            ..view
        };
        PoseAnchor {
            view,
            reference: head_from_part,
            along: -speckle_shift(&view, &step)
                .pupil
                .try_normalize()
                .unwrap_or(DVec2::NEG_X),
        }
    }

    /// The pattern coordinate of a pose of the head.
    pub fn coordinate(&self, part_from_head: &Rigid) -> ScanCoordinate {
        let anchored = self.reference * part_from_head.point(self.view.point);
        let turn = part_from_head.rotation.transpose() * self.reference.transpose();
        let shift = speckle_shift(
            &self.view,
            &Motion {
                part: -anchored,
                rotation: rotation_vector(&turn),
                ..Motion::default()
            },
        );
        let pupil = if self.view.pupil_diameter > 0.0 {
            -shift.pupil / self.view.pupil_diameter
        } else {
            DVec2::ZERO
        };
        ScanCoordinate {
            sensor: -shift.sensor,
            pupil,
            u: pupil.dot(self.along),
        }
    }
}

/// log of a rotation: axis times angle, the angle in [0, π].
pub fn rotation_vector(rotation: &DMat3) -> DVec3 {
    let q = DQuat::from_mat3(rotation);
    (if q.w < 0.0 { -q } else { q }).to_scaled_axis()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::speckle::motion::Source;

    const D: f64 = 8.0;

    fn view() -> SurfaceView {
        let point = DVec3::new(2.0, -1.0, 250.0);
        SurfaceView {
            point,
            normal: DVec3::new(0.1, 0.05, -1.0).normalize(),
            source: Source::Point(DVec3::new(2.0, 0.0, 10.0)),
            pupil_centre: DVec3::new(120.0, 5.0, 30.0),
            pupil_diameter: D,
            image_x: DVec3::X,
            focus_distance: 240.0,
            magnification: -0.3,
        }
    }

    fn pose(angles: DVec3, origin: DVec3) -> Rigid {
        Rigid::from_euler_xyz(angles, origin)
    }

    /// The motion of the part in the head's frame from pose `a` to pose `b`, at
    /// the view's point.
    fn motion_between(a: &Rigid, b: &Rigid) -> Motion {
        let head_from_head = b.inverse() * *a;
        Motion {
            part: head_from_head.point(view().point) - view().point,
            rotation: rotation_vector(&head_from_head.rotation),
            ..Motion::default()
        }
    }

    /// |difference of coordinates − tensor formula|, relative to the formula's
    /// vectors: (sensor, pupil).
    fn mismatch(anchor: &PoseAnchor, a: &Rigid, b: &Rigid) -> (f64, f64) {
        let [from, to] = [a, b].map(|p| anchor.coordinate(p));
        let in_focus = SurfaceView {
            focus_distance: view().pupil_centre.distance(view().point),
            ..view()
        };
        let shift = speckle_shift(&in_focus, &motion_between(a, b));
        let sensor = to.sensor - from.sensor + shift.sensor;
        let pupil = (to.pupil - from.pupil) * D + shift.pupil;
        (
            sensor.length() / shift.sensor.length(),
            pupil.length() / shift.pupil.length(),
        )
    }

    const TURN: DVec3 = DVec3::new(0.4, -2.0, 0.7);
    const FAR: DVec3 = DVec3::new(900.0, -40.0, 300.0);

    #[test]
    fn a_head_that_does_not_turn_gets_the_tensor_formula_over_any_length() {
        let scan = DVec3::new(0.1, 1.0, 0.0);
        let start = pose(TURN, FAR);
        let anchor = PoseAnchor::new(view(), start.rotation.transpose(), scan);
        for way in [scan * 0.02, scan * 700.0, DVec3::new(5.0, 0.3, -2.0)] {
            let end = pose(TURN, FAR + start.vector(way));
            let (sensor, pupil) = mismatch(&anchor, &start, &end);
            // Differences of numbers ~1e3 carry 1e-13; the shortest way is 0.02.
            assert!(sensor < 1e-9 && pupil < 1e-9, "{way}: {sensor} {pupil}");
        }
        let end = pose(TURN, FAR + start.vector(scan * 0.02));
        let du = anchor.coordinate(&end).u - anchor.coordinate(&start).u;
        let delta = speckle_shift(&view(), &motion_between(&start, &end)).delta;
        assert!(
            du > 0.0 && (du - delta).abs() < 1e-9 * delta,
            "{du} {delta}"
        );
    }

    #[test]
    fn a_small_step_with_a_turn_is_first_order_at_the_reference_orientation() {
        let start = pose(TURN, FAR);
        let reference = start.rotation.transpose();
        let anchor = PoseAnchor::new(view(), reference, DVec3::Y);
        let mut last = (1.0, 1.0);
        for scale in [1e-2, 1e-3, 1e-4] {
            let step = pose(
                DVec3::new(1.0, -0.5, 0.3) * scale,
                DVec3::new(3.0, 9.0, -2.0) * scale,
            );
            let now = mismatch(&anchor, &start, &(start * step));
            // First-order agreement: what is left shrinks with the step.
            assert!(now.0 < last.0 * 0.2 && now.1 < last.1 * 0.2, "{now:?}");
            last = now;
        }
    }

    #[test]
    fn a_turned_head_is_off_by_about_the_angle() {
        let reference = pose(TURN, FAR).rotation.transpose();
        let anchor = PoseAnchor::new(view(), reference, DVec3::Y);
        for angle in [0.01, 0.1] {
            let start = pose(TURN, FAR) * pose(DVec3::X * angle, DVec3::ZERO);
            let step = pose(DVec3::new(1e-6, 2e-6, 0.0), DVec3::new(1e-3, 4e-3, 1e-3));
            let (sensor, pupil) = mismatch(&anchor, &start, &(start * step));
            assert!(
                sensor < 1.5 * angle && pupil < 1.5 * angle,
                "{sensor} {pupil}"
            );
            assert!(sensor > 0.01 * angle, "{sensor}: the stated limit is gone");
        }
    }

    #[test]
    fn a_surface_point_keeps_its_place_however_the_head_turns_about_it() {
        let start = pose(TURN, FAR);
        let anchor = PoseAnchor::new(view(), start.rotation.transpose(), DVec3::Y);
        let held = start.point(view().point);
        for turn in [DVec3::new(0.0, 0.3, 0.0), DVec3::new(2.5, 0.0, 1.0)] {
            let rotation = pose(turn, DVec3::ZERO).rotation * start.rotation;
            let turned = Rigid {
                rotation,
                translation: held - rotation * view().point,
            };
            let moved = anchor.coordinate(&turned).sensor - anchor.coordinate(&start).sensor;
            assert!(moved.length() < 1e-9, "{moved}");
        }
    }

    #[test]
    fn a_grazing_reference_view_stays_finite() {
        let ray = (view().pupil_centre - view().point).normalize();
        let grazing = SurfaceView {
            normal: ray.any_orthonormal_vector(),
            ..view()
        };
        let anchor = PoseAnchor::new(grazing, DMat3::IDENTITY, DVec3::Y);
        let c = anchor.coordinate(&pose(TURN, FAR));
        assert!(c.sensor.is_finite() && c.pupil.is_finite() && c.u.is_finite());
    }
}
