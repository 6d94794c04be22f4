//! Pattern coordinate during a scan, as a function of the pose only. Frames can therefore be
//! rendered in any order, and each surface point keeps its grains while the laser moves over it.

use super::frame_field::PupilPosition;
use super::motion::{RigidMotion, SurfaceView, defocus_phase, speckle_shift};
use super::strips::PupilStrip;
use crate::math::{DMat3, DVec2, DVec3, Rigid, rotation_vector};

/// Pattern coordinate of a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatternCoordinate {
    /// (s,t) in mm on the sensor, to be added to the position of the pixel.
    pub sensor: DVec2,
    /// Pupil coordinate relative to the start of the scan: minus the shift A_p of the pupil field,
    /// in pupil diameters, and minus its defocus phase.
    pub pupil: PupilPosition,
    /// u, for a ring of slices: the component of `pupil.shift` along the pupil shift of a scan
    /// step.
    pub u: f64,
}

/// Pattern coordinate that is fixed to the part.
///
/// ```text
/// (s,t) = m·Qᵀ·R₀·X          X: the view's point in part coordinates at this pose
/// A_p   = tensor formula of the motion a = −R₀·X, Ω = log(R·R₀ᵀ)
/// φ     = k·D²·n_o·a/(8·L_f²)
/// u     = e·(−A_p)/D         e: direction of −A_p for a step along the scan
/// ```
///
/// R is head_from_part and R₀ its value at the start. The other symbols are defined in
/// [`motion`](super::motion). All quantities are evaluated at one view, usually the centre of the
/// field of view, which moves with the head.
///
/// For a head translated without rotation (R = R₀), the coordinate is exact to the order of the
/// tensor formula, in any direction and over any length. It is then linear in the pose: its
/// difference between two poses is −a_I and −A_p/D of the motion between them. For steps along the
/// scan direction, `u` changes by δ. The fields of two frames, computed for their `pupil`,
/// correlate by γ(δ, φ). A ring of slices includes only the component of A_p along e, and no φ.
///
/// For a rotated head, the coordinate is a continuous function of the pose, for rotations of less
/// than 180° from R₀. A surface point under the view keeps its (s,t). Compared with the tensor
/// formula, differences of the coordinate have a relative error of about the angle of R·R₀ᵀ. No
/// function of the pose can follow all small rotations and translations, because they do not
/// commute. A scan that rotates therefore needs one anchor per pass.
///
/// **Out of focus**, the pattern slips on the surface by m·d·(A_p − b), where d = 1 − L_f/L_o and b
/// = Qᵀa (Yamaguchi 1981). A_p grows with the scan, and d differs between surface points. A
/// displacement relative to a fixed pose would therefore shear the grains without limit. Instead,
/// the displacement is relative to the references of [`strips`](super::strips). They limit the
/// displacement of a grain to one blur circle, d·m·D·|A_p − b|/|A_p|. Divided by the depth range,
/// the resulting shear is D/L_o times the slope of the surface.
///
/// Two cases have no references; strips never change then, and the shear is not limited:
///
/// - The surface moves, but its speckle moves little across the pupil: |A_p| < |A_p − b|/4.
/// - A pupil shift by one diameter needs a displacement of more than half the distance to the
///   pupil.
///
/// In focus, points imaged with a magnification m′ other than the view's magnification m keep the
/// grain size. Their grains slip on the surface by (m − m′)/m of its displacement while they are
/// lit. Out of focus, this slip is part of d·b if m is the magnification of the plane in focus. If
/// the tensor formula is singular at the view (grazing), `pupil` and `u` are constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatternAnchor {
    view: SurfaceView,
    wavelength_mm: f64,
    reference: DMat3,
    start: PupilPosition,
    along: DVec2,
    /// Displacement of the head (head coordinates) that shifts the pupil by one diameter along
    /// `along`; `None` if strips do not limit the shear.
    per_diameter: Option<DVec3>,
}

/// Pose at which a strip of the phasor plane fills the pupil.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StripPose {
    /// Number of the strip.
    pub number: f64,
    /// Pose of the head.
    pub part_from_head: Rigid,
    /// Pattern coordinate of the pose.
    pub at: PatternCoordinate,
    /// Lateral offset of the strip's phasors on the plane, pupil diameters; see
    /// [`PupilStrip::phasor_offset`](super::strips::PupilStrip::phasor_offset).
    pub pupil_parallax: f64,
}

/// Largest |A_p − b|/|A_p| for which strips of the pupil field limit the shear.
const MAX_SLIP_RATIO: f64 = 4.0;

/// Rotation (rad), or displacement divided by the distance from the surface to the pupil, up to
/// which a reference represents the view. Cosines change by 10–50 % over this range.
pub(super) const MAX_VIEW_CHANGE_RAD: f64 = 0.5;

impl PatternAnchor {
    /// Creates an anchor. `view` is in head coordinates, and `start` is part_from_head at the start
    /// of the scan. `scan_step` is the displacement of the head per frame, in head coordinates. If
    /// it does not shift the pupil field, u follows the x axis of the basis Q.
    pub fn new(
        view: SurfaceView,
        start: &Rigid,
        scan_step: DVec3,
        wavelength_mm: f64,
    ) -> PatternAnchor {
        let step = speckle_shift(
            &view.in_focus(),
            &RigidMotion {
                part: -scan_step,
                ..RigidMotion::default()
            },
        );
        let slip = step.sensor - view.magnification * step.pupil;
        let most = MAX_SLIP_RATIO * view.magnification.abs() * step.pupil.length();
        let way = scan_step.length() / view.pupil_centre.distance(view.point);
        let within_reach = step.delta > 0.0 && way <= MAX_VIEW_CHANGE_RAD * step.delta;
        let limited = within_reach && slip.length() <= most;
        let mut anchor = PatternAnchor {
            view,
            wavelength_mm,
            reference: start.rotation.transpose(),
            start: PupilPosition {
                shift: DVec2::ZERO,
                defocus: 0.0,
            },
            along: -step.pupil.try_normalize().unwrap_or(DVec2::NEG_X),
            per_diameter: limited.then(|| scan_step / step.delta),
        };
        anchor.start = anchor.coordinate(start).pupil;
        anchor
    }

    /// Returns e, the direction in which the pupil moves over the field.
    pub fn along(&self) -> DVec2 {
        self.along
    }

    /// Returns the references of the two strips under the pupil, for strips of `width` diameters.
    /// Both references are poses on the scan path through `part_from_head`. Returns `None` if
    /// strips do not limit the shear.
    pub fn references(&self, part_from_head: &Rigid, width: f64) -> Option<[StripPose; 2]> {
        let per_diameter = self.per_diameter?;
        let way = self.coordinate(part_from_head).u;
        let reference = |number: f64| {
            let rest = PupilStrip::middle(number, width) - way;
            let pose = *part_from_head * Rigid::translation(per_diameter * rest);
            StripPose {
                number,
                part_from_head: pose,
                at: self.coordinate(&pose),
                pupil_parallax: 0.0,
            }
        };
        Some(PupilStrip::numbers(way, width).map(reference))
    }

    /// Returns the pattern coordinate of a pose of the head.
    pub fn coordinate(&self, part_from_head: &Rigid) -> PatternCoordinate {
        let anchored = self.reference * part_from_head.point(self.view.point);
        let turn = part_from_head.rotation.transpose() * self.reference.transpose();
        let motion = RigidMotion {
            part: -anchored,
            rotation: rotation_vector(&turn),
            ..RigidMotion::default()
        };
        let shift = speckle_shift(&self.view.in_focus(), &motion);
        let pupil = if self.view.pupil_diameter > 0.0 {
            -shift.pupil / self.view.pupil_diameter
        } else {
            DVec2::ZERO
        };
        let pupil = PupilPosition {
            shift: pupil - self.start.shift,
            defocus: -defocus_phase(&self.view, &motion, self.wavelength_mm) - self.start.defocus,
        };
        PatternCoordinate {
            sensor: -shift.sensor,
            pupil,
            u: pupil.shift.dot(self.along),
        }
    }
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

    /// Returns the motion of the part in the head frame from pose `a` to pose `b`, at the point of
    /// the view.
    fn motion_between(a: &Rigid, b: &Rigid) -> RigidMotion {
        let head_from_head = b.inverse() * *a;
        RigidMotion {
            part: head_from_head.point(view().point) - view().point,
            rotation: rotation_vector(&head_from_head.rotation),
            ..RigidMotion::default()
        }
    }

    /// Returns |difference of coordinates − tensor formula| relative to the formula's vectors:
    /// (sensor, pupil).
    fn mismatch(anchor: &PatternAnchor, a: &Rigid, b: &Rigid) -> (f64, f64) {
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
        let anchor = PatternAnchor::new(view(), &start, scan, 660e-6);
        for way in [scan * 0.02, scan * 700.0, DVec3::new(5.0, 0.3, -2.0)] {
            let end = pose(TURN, FAR + start.vector(way));
            let (sensor, pupil) = mismatch(&anchor, &start, &end);
            // Differences of numbers near 1e3 have errors of 1e-13; the shortest displacement is
            // 0.02.
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

    /// The defocus difference between two poses equals the formula for the motion between them. The
    /// tolerance covers rounding, as above.
    #[test]
    fn the_defocus_is_that_of_the_formula() {
        let scan = DVec3::new(0.1, 1.0, 0.2);
        let start = pose(TURN, FAR);
        let anchor = PatternAnchor::new(view(), &start, scan, 660e-6);
        let at = |n: f64| anchor.coordinate(&pose(TURN, FAR + start.vector(scan * n)));
        assert_eq!(at(0.0).pupil.shift, DVec2::ZERO);
        assert_eq!(at(0.0).pupil.defocus, 0.0);
        let (from, to) = (at(300.0), at(300.1));
        let motion = RigidMotion {
            part: -scan * 0.1,
            ..RigidMotion::default()
        };
        let phase = defocus_phase(&view(), &motion, 660e-6);
        let found = to.pupil.defocus - from.pupil.defocus;
        assert!(
            (found + phase).abs() < 1e-8 * phase.abs(),
            "{found} {phase}"
        );
    }

    /// At its reference, the pupil is centred on the strip, and the reference lies on the scan
    /// path. Tolerances cover the rounding of numbers up to 1e3.
    #[test]
    fn references_lie_on_the_way_where_their_strips_fill_the_pupil() {
        let scan = DVec3::new(0.1, 1.0, 0.2);
        let start = pose(TURN, FAR);
        let anchor = PatternAnchor::new(view(), &start, scan, 660e-6);
        for (way, width) in [(0.0, 1.0), (301.7, 1.0), (-17.3, 1.4)] {
            let here = pose(TURN, FAR + start.vector(scan * way));
            let u = anchor.coordinate(&here).u;
            for reference in anchor.references(&here, width).unwrap() {
                assert!(
                    (reference.at.u - PupilStrip::middle(reference.number, width)).abs() < 1e-9
                );
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
        let anchor = PatternAnchor::new(converging, &pose(TURN, FAR), DVec3::Y, 660e-6);
        assert_eq!(anchor.references(&pose(TURN, FAR), 1.0), None);
    }

    /// Parallel light and displacement along the viewing ray: A_p and the slip are both zero except
    /// for rounding.
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
            let anchor = PatternAnchor::new(parallel, &pose(TURN, FAR), way, 660e-6);
            assert_eq!(anchor.references(&pose(TURN, FAR), 1.0), None, "{i}");
        }
    }

    #[test]
    fn a_small_step_with_a_turn_is_first_order_at_the_reference_orientation() {
        let start = pose(TURN, FAR);
        let anchor = PatternAnchor::new(view(), &start, DVec3::Y, 660e-6);
        let mut last = (1.0, 1.0);
        for scale in [1e-2, 1e-3, 1e-4] {
            let step = pose(
                DVec3::new(1.0, -0.5, 0.3) * scale,
                DVec3::new(3.0, 9.0, -2.0) * scale,
            );
            let now = mismatch(&anchor, &start, &(start * step));
            // First-order agreement: the relative residual shrinks with the step.
            assert!(now.0 < last.0 * 0.2 && now.1 < last.1 * 0.2, "{now:?}");
            last = now;
        }
    }

    #[test]
    fn a_turned_head_is_off_by_about_the_angle() {
        let anchor = PatternAnchor::new(view(), &pose(TURN, FAR), DVec3::Y, 660e-6);
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
        let anchor = PatternAnchor::new(view(), &start, DVec3::Y, 660e-6);
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
        let anchor = PatternAnchor::new(grazing, &Rigid::IDENTITY, DVec3::Y, 660e-6);
        let c = anchor.coordinate(&pose(TURN, FAR));
        assert!(c.sensor.is_finite() && c.pupil.shift.is_finite() && c.u.is_finite());
        assert!(c.pupil.defocus.is_finite());
        let references = anchor.references(&pose(TURN, FAR), 1.0);
        assert!(references.is_none_or(|both| both.iter().all(|r| r.at.sensor.is_finite())));
    }
}
