//! The pattern coordinate through a scan: a function of the pose alone, so that
//! frames can be rendered in any order and each surface point keeps its grains
//! while the laser sweeps over it.

use super::frame_field::PupilPlace;
use super::motion::{Motion, SurfaceView, defocus_phase, speckle_shift};
use super::strips::Strip;
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use glam::DQuat;

/// Where a pose looks the pattern up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanCoordinate {
    /// (s,t) in mm on the sensor, to be added to the pixel's own position.
    pub sensor: DVec2,
    /// The same for the pupil field, from the start of the scan: minus its shift
    /// A_p, in pupil diameters; and minus its defocus phase.
    pub pupil: PupilPlace,
    /// u, for a ring of slices: the part of `pupil.shift` along the shift that the
    /// scan makes.
    pub u: f64,
}

/// Fixes the pattern to the part.
///
/// ```text
/// (s,t) = m·Qᵀ·R₀·X          X: the view's point in part coordinates at this pose
/// A_p   = tensor formula of the motion a = −R₀·X, Ω = log(R·R₀ᵀ)
/// φ     = k·D²·n_o·a/(8·L_f²)
/// u     = e·(−A_p)/D         e: direction of −A_p for a step along the scan
/// ```
///
/// R is head_from_part, R₀ its value at the start, and the rest as in
/// [`motion`](super::motion); everything is evaluated at one view (usually the
/// middle of the field), which the head carries with it.
///
/// Exact, to the order of the tensor formula, for a head translated without
/// turning (R = R₀) in any direction and over any length: the coordinate is then
/// linear in the pose, its difference between two poses is −a_I and −A_p/D of the
/// motion between them, and `u` changes by δ for steps along the scan direction.
/// Two frames' fields, made for their `pupil`, correlate by γ(δ, φ). A ring of
/// slices has neither φ nor the part of A_p across e.
///
/// For a turned head the coordinate stays a continuous function of the pose (up to
/// turns of 180° from R₀) and a surface point under the view keeps its (s,t), but
/// its differences are those of the tensor formula only to a relative error of
/// about the angle of R·R₀ᵀ, because small turns and translations do not commute and
/// no function of the pose can follow them all. So a scan that turns needs one
/// anchor a pass.
///
/// **Out of focus** the pattern slips on the surface by m·d·(A_p − b), d = 1 −
/// L_f/L_o, b = Qᵀa (Yamaguchi 1981). A_p grows with the scan while d changes from
/// one surface point to the next, so that a displacement by it, taken from any
/// fixed pose, would in the end shear the grains without limit. So it is taken from
/// the references of [`strips`](super::strips): no grain is displaced by more than
/// a blur circle, d·m·D·|A_p − b|/|A_p|, which shears it by that over the depth's
/// own scale: D/L_o times the slope of the surface. There are none where the surface
/// moves but its speckle hardly crosses the pupil, |A_p| < |A_p − b|/4, or crosses it
/// only on a way of more than half the distance to the pupil: then strips never change
/// and nothing limits the shear.
///
/// In focus, points that are imaged with another magnification m′ than the view's
/// keep the grain size, but their grains slip against the surface by (m − m′)/m of
/// its way while they are lit; out of focus that is part of d·b, if m is that of
/// the plane in focus. A view that the tensor formula is singular at (grazing) has
/// constant `pupil` and `u`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseAnchor {
    view: SurfaceView,
    wavelength_mm: f64,
    reference: DMat3,
    start: PupilPlace,
    along: DVec2,
    /// Way of the head (its own frame) for which the pupil shifts by one diameter along
    /// `along`; `None` if strips do not limit the shear.
    per_diameter: Option<DVec3>,
}

/// A pose in which a strip of the pupil's plane filled the pupil.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reference {
    /// Which strip it is.
    pub number: f64,
    /// Where the head was.
    pub part_from_head: Rigid,
    /// The pattern coordinate of the pose.
    pub at: ScanCoordinate,
    /// Pupil diameters that the phasors lie aside of the plane's own; see
    /// [`Strip::aside`](super::strips::Strip::aside).
    pub aside: f64,
}

/// |A_p − b|/|A_p| up to which strips of the pupil field limit the shear.
const MOST_SLIP: f64 = 4.0;

/// Turn (rad), or way in distances from the surface to the pupil, after which a view
/// shows the surface otherwise: cosines have changed by a tenth to a half.
pub(super) const FARTHEST: f64 = 0.5;

impl PoseAnchor {
    /// `view` in head coordinates; `start` part_from_head at the start of the scan;
    /// `scan_step` the way of the head from frame to frame, in head coordinates. If
    /// it does not shift the pupil field, u follows the basis Q's x axis.
    pub fn new(
        view: SurfaceView,
        start: &Rigid,
        scan_step: DVec3,
        wavelength_mm: f64,
    ) -> PoseAnchor {
        let step = speckle_shift(
            &view.in_focus(),
            &Motion {
                part: -scan_step,
                ..Motion::default()
            },
        );
        let slip = step.sensor - view.magnification * step.pupil;
        let most = MOST_SLIP * view.magnification.abs() * step.pupil.length();
        let way = scan_step.length() / view.pupil_centre.distance(view.point);
        let within_reach = step.delta > 0.0 && way <= FARTHEST * step.delta;
        let limited = within_reach && slip.length() <= most;
        let mut anchor = PoseAnchor {
            view,
            wavelength_mm,
            reference: start.rotation.transpose(),
            start: PupilPlace {
                shift: DVec2::ZERO,
                defocus: 0.0,
            },
            along: -step.pupil.try_normalize().unwrap_or(DVec2::NEG_X),
            per_diameter: limited.then(|| scan_step / step.delta),
        };
        anchor.start = anchor.coordinate(start).pupil;
        anchor
    }

    /// e: direction of the pupil's way over the field.
    pub fn along(&self) -> DVec2 {
        self.along
    }

    /// The references of the two strips that the pupil stands on, if strips limit the
    /// shear: poses on the scan's way through this one.
    pub fn references(&self, part_from_head: &Rigid, width: f64) -> Option<[Reference; 2]> {
        let per_diameter = self.per_diameter?;
        let way = self.coordinate(part_from_head).u;
        let reference = |number: f64| {
            let rest = Strip::middle(number, width) - way;
            let pose = *part_from_head * Rigid::translation(per_diameter * rest);
            Reference {
                number,
                part_from_head: pose,
                at: self.coordinate(&pose),
                aside: 0.0,
            }
        };
        Some(Strip::numbers(way, width).map(reference))
    }

    /// The pattern coordinate of a pose of the head.
    pub fn coordinate(&self, part_from_head: &Rigid) -> ScanCoordinate {
        let anchored = self.reference * part_from_head.point(self.view.point);
        let turn = part_from_head.rotation.transpose() * self.reference.transpose();
        let motion = Motion {
            part: -anchored,
            rotation: rotation_vector(&turn),
            ..Motion::default()
        };
        let shift = speckle_shift(&self.view.in_focus(), &motion);
        let pupil = if self.view.pupil_diameter > 0.0 {
            -shift.pupil / self.view.pupil_diameter
        } else {
            DVec2::ZERO
        };
        let pupil = PupilPlace {
            shift: pupil - self.start.shift,
            defocus: -defocus_phase(&self.view, &motion, self.wavelength_mm) - self.start.defocus,
        };
        ScanCoordinate {
            sensor: -shift.sensor,
            pupil,
            u: pupil.shift.dot(self.along),
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
        let pupil = (to.pupil.shift - from.pupil.shift) * D + shift.pupil;
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
        let anchor = PoseAnchor::new(view(), &start, scan, 660e-6);
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

    /// The way along the viewing ray is that of the formula for the motion between two
    /// poses; rounding as above.
    #[test]
    fn the_defocus_is_that_of_the_formula() {
        let scan = DVec3::new(0.1, 1.0, 0.2);
        let start = pose(TURN, FAR);
        let anchor = PoseAnchor::new(view(), &start, scan, 660e-6);
        let at = |n: f64| anchor.coordinate(&pose(TURN, FAR + start.vector(scan * n)));
        assert_eq!(at(0.0).pupil.shift, DVec2::ZERO);
        assert_eq!(at(0.0).pupil.defocus, 0.0);
        let (from, to) = (at(300.0), at(300.1));
        let motion = Motion {
            part: -scan * 0.1,
            ..Motion::default()
        };
        let phase = defocus_phase(&view(), &motion, 660e-6);
        let found = to.pupil.defocus - from.pupil.defocus;
        assert!(
            (found + phase).abs() < 1e-8 * phase.abs(),
            "{found} {phase}"
        );
    }

    /// The pupil stands in the middle of a strip in its reference, which lies on the
    /// scan's way; rounding of numbers up to 1e3.
    #[test]
    fn references_lie_on_the_way_where_their_strips_fill_the_pupil() {
        let scan = DVec3::new(0.1, 1.0, 0.2);
        let start = pose(TURN, FAR);
        let anchor = PoseAnchor::new(view(), &start, scan, 660e-6);
        for (way, width) in [(0.0, 1.0), (301.7, 1.0), (-17.3, 1.4)] {
            let here = pose(TURN, FAR + start.vector(scan * way));
            let u = anchor.coordinate(&here).u;
            for reference in anchor.references(&here, width).unwrap() {
                assert!((reference.at.u - Strip::middle(reference.number, width)).abs() < 1e-9);
                assert!((reference.at.u - u).abs() <= width * (1.0 + 1e-9));
                let moved = here.inverse() * reference.part_from_head;
                assert!(moved.translation.cross(scan).length() < 1e-9);
            }
        }
    }

    /// Light that converges on the pupil: A_p vanishes while the surface moves.
    #[test]
    fn speckle_that_moves_without_changing_does_not_slip() {
        let to_pupil = view().pupil_centre - view().point;
        let n = to_pupil.normalize();
        let across = DMat3::IDENTITY - DMat3::from_cols(n * n.x, n * n.y, n * n.z);
        let converging = SurfaceView {
            source: Source::Wavefront {
                direction: n,
                curvature_per_mm: across * (-1.0 / to_pupil.length()),
            },
            ..view()
        };
        let anchor = PoseAnchor::new(converging, &pose(TURN, FAR), DVec3::Y, 660e-6);
        assert_eq!(anchor.references(&pose(TURN, FAR), 1.0), None);
    }

    /// Parallel light, and ways along the viewing ray: A_p and slip are both zero but for rounding.
    #[test]
    fn a_way_along_the_viewing_ray_has_no_references() {
        for i in 0..20 {
            let direction = DVec3::new(0.3 - 0.03 * i as f64, 0.1, -1.0).normalize();
            let parallel = SurfaceView {
                source: Source::Wavefront {
                    direction,
                    curvature_per_mm: DMat3::ZERO,
                },
                ..view()
            };
            let way = (view().pupil_centre - view().point).normalize() * (0.1 + i as f64);
            let anchor = PoseAnchor::new(parallel, &pose(TURN, FAR), way, 660e-6);
            assert_eq!(anchor.references(&pose(TURN, FAR), 1.0), None, "{i}");
        }
    }

    #[test]
    fn a_small_step_with_a_turn_is_first_order_at_the_reference_orientation() {
        let start = pose(TURN, FAR);
        let anchor = PoseAnchor::new(view(), &start, DVec3::Y, 660e-6);
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
        let anchor = PoseAnchor::new(view(), &pose(TURN, FAR), DVec3::Y, 660e-6);
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
        let anchor = PoseAnchor::new(view(), &start, DVec3::Y, 660e-6);
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
        let anchor = PoseAnchor::new(grazing, &Rigid::IDENTITY, DVec3::Y, 660e-6);
        let c = anchor.coordinate(&pose(TURN, FAR));
        assert!(c.sensor.is_finite() && c.pupil.shift.is_finite() && c.u.is_finite());
        assert!(c.pupil.defocus.is_finite());
        let references = anchor.references(&pose(TURN, FAR), 1.0);
        assert!(references.is_none_or(|both| both.iter().all(|r| r.at.sensor.is_finite())));
    }
}
