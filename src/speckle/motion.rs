//! How a speckle pattern moves and changes when laser, part or camera move.
//!
//! One tensor formula holds the in-plane, out-of-plane, tilt and camera motions
//! (Yamaguchi 1981, Opt. Acta 28, 1359; Sjödahl 1995, Appl. Opt. 34, 7998). The
//! light that scatters at the surface point x carries the phase
//! k·(path from the laser + distance to the pupil); a motion changes it by an
//! amount that is, to first order, linear across the surface, and a linear phase
//! across the surface is a shift A_p of the speckle field across the pupil:
//!
//! ```text
//! g     = C_s·(a − s) + (I − n_o n_oᵀ)/L_o·(a − c) + [Ω]ₓᵀ·(n_s − n_o)
//! A_p   = L_o·(TᵀQ)⁻¹·Tᵀ·g
//! δ     = |A_p| / D                  correlation of intensities γ(δ), the overlap law
//! a_I   = m·(b + (1 − L_f/L_o)·(A_p − b)),  b = Qᵀ(a − c)
//! ```
//!
//! n_s runs from the source to x, n_o from x to the pupil at distance L_o, T is a
//! basis of the surface, Q of the plane across n_o, C_s the curvature of the
//! laser's wavefront ((I − n_s n_sᵀ)/L_s for a point source); part, laser and
//! camera move by a, s, c and the part turns by Ω about x. L_f is the distance the
//! lens is focused on; in focus a_I is m·b.
//!
//! Valid for motions small against L_s, L_o and the radius of the wavefront, and
//! for angles |Ω| ≪ 1.

use crate::math::{DMat3, DVec2, DVec3};

/// δ past this is reported as this: the patterns share nothing from δ = 1 on,
/// and a finite number can be wrapped and interpolated.
pub const MAX_DELTA: f64 = 1e6;

/// The laser's wavefront where it meets the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Source {
    /// Spherical wave from this point (mm).
    Point(DVec3),
    /// Any other wave: unit direction of travel, and the curvature tensor
    /// ∂(direction)/∂x (1/mm, symmetric). Zero curvature is a collimated beam or a
    /// beam's waist; off the waist a Gaussian beam curves by 1/R(z),
    /// R = z·(1 + (z_R/z)²), in each of its axes, which near the focus of a thin
    /// line is far from 1/L_s.
    Wavefront {
        direction: DVec3,
        curvature_per_mm: DMat3,
    },
}

/// A surface point between laser and camera, in any frame (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceView {
    pub point: DVec3,
    /// Unit surface normal; its sign does not matter.
    pub normal: DVec3,
    pub source: Source,
    pub pupil_centre: DVec3,
    pub pupil_diameter: f64,
    /// Direction in space that the sensor's x axis shows; Q's first axis is its
    /// part across the viewing ray, Q's second n_o × the first.
    pub image_x: DVec3,
    /// Distance L_f from the pupil to the plane in focus.
    pub focus_distance: f64,
    /// Sensor mm per object mm in the basis Q; negative if Q shows inverted.
    pub magnification: f64,
}

/// Small motions of the three bodies in the frame of the [`SurfaceView`]. A scan
/// head that carries laser and camera by v is `laser` = `camera` = v, or the part
/// by −v: only differences count.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// Translation a of the part at the surface point (mm).
    pub part: DVec3,
    /// Rotation vector Ω of the part about the surface point (rad).
    pub rotation: DVec3,
    /// Translation s of the laser (mm); moves a `Source::Wavefront` without
    /// turning it.
    pub laser: DVec3,
    /// Translation c of the pupil (mm).
    pub camera: DVec3,
}

/// What a [`Motion`] does to the speckle of one surface point.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpeckleShift {
    /// A_p: shift of the speckle field across the pupil, in the basis Q (mm).
    pub pupil: DVec2,
    /// δ = |A_p|/D, at most [`MAX_DELTA`].
    pub delta: f64,
    /// a_I: shift of the pattern on the sensor, in the basis Q (mm).
    pub sensor: DVec2,
}

/// Intensity correlation of two speckle patterns whose pupil fields are shifted
/// by δ pupil diameters: γ = μ², μ = (2/π)·(acos δ − δ·√(1−δ²)), the overlap of
/// two discs; 0 for δ ≥ 1 (Goodman, *Speckle Phenomena in Optics*). Circular
/// pupil, evenly lit.
pub fn overlap_correlation(delta: f64) -> f64 {
    let delta = delta.abs();
    if delta >= 1.0 {
        return 0.0;
    }
    let mu = std::f64::consts::FRAC_2_PI * (delta.acos() - delta * (1.0 - delta * delta).sqrt());
    mu * mu
}

/// The viewing ray at a surface point: unit vector, length, basis Q across it.
pub(super) struct ViewRay {
    pub direction: DVec3,
    pub length: f64,
    pub basis: [DVec3; 2],
}

impl ViewRay {
    /// `None` where the point is the pupil's centre (or not finite).
    pub fn of(view: &SurfaceView) -> Option<ViewRay> {
        let to_pupil = view.pupil_centre - view.point;
        let direction = to_pupil.try_normalize()?;
        let across = view.image_x - direction * view.image_x.dot(direction);
        let x = across
            .try_normalize()
            .unwrap_or_else(|| direction.any_orthonormal_vector());
        Some(ViewRay {
            direction,
            length: to_pupil.length(),
            basis: [x, direction.cross(x)],
        })
    }

    pub fn project(&self, v: DVec3) -> DVec2 {
        DVec2::new(self.basis[0].dot(v), self.basis[1].dot(v))
    }
}

impl Source {
    /// Direction n_s and curvature C_s at `x`; `None` at the source itself.
    fn at(&self, x: DVec3) -> Option<(DVec3, DMat3)> {
        match *self {
            Source::Point(source) => {
                let n = (x - source).try_normalize()?;
                let across = DMat3::IDENTITY - DMat3::from_cols(n * n.x, n * n.y, n * n.z);
                Some((n, across * (1.0 / (x - source).length())))
            }
            Source::Wavefront {
                direction,
                curvature_per_mm,
            } => Some((direction, curvature_per_mm)),
        }
    }
}

/// A_p in mm, linear in the motion, not yet limited: `None` or not finite where
/// the formula is singular. (TᵀQ)⁻¹Tᵀ is written as the projection onto the plane
/// across n_o along the surface normal n, which is the same map without a basis
/// T: Q·A_p = L_o·(g − n·(g·n_o)/(n·n_o)).
fn pupil_shift(view: &SurfaceView, ray: &ViewRay, motion: &Motion) -> Option<DVec2> {
    let (n_s, curvature) = view.source.at(view.point)?;
    let relative = motion.part - motion.camera;
    let g_times_length = ray.length
        * (curvature * (motion.part - motion.laser) + (n_s - ray.direction).cross(motion.rotation))
        + relative
        - ray.direction * ray.direction.dot(relative);
    let slant = g_times_length.dot(ray.direction) / view.normal.dot(ray.direction);
    Some(ray.project(g_times_length - view.normal * slant))
}

/// Shift of the speckle across the pupil and on the sensor (formula: see the
/// module). Always finite: where the formula is singular (grazing view, a point
/// at the pupil's or the source's centre) or |A_p| passes [`MAX_DELTA`] diameters,
/// any motion decorrelates fully, δ = `MAX_DELTA`, and `sensor` is the in-focus
/// shift m·b, the out-of-focus part of a pattern that shares nothing with the old
/// one being without meaning. No motion is no shift everywhere.
pub fn speckle_shift(view: &SurfaceView, motion: &Motion) -> SpeckleShift {
    let still = SpeckleShift {
        pupil: DVec2::ZERO,
        delta: 0.0,
        sensor: DVec2::ZERO,
    };
    if *motion == Motion::default() {
        return still;
    }
    let limit = MAX_DELTA * view.pupil_diameter;
    let lost = SpeckleShift {
        pupil: DVec2::new(limit, 0.0),
        delta: MAX_DELTA,
        ..still
    };
    let Some(ray) = ViewRay::of(view) else {
        return lost;
    };
    let body = ray.project(motion.part - motion.camera);
    let in_focus = Some(view.magnification * body)
        .filter(|a| a.is_finite())
        .unwrap_or(DVec2::ZERO);
    let lost = SpeckleShift {
        sensor: in_focus,
        ..lost
    };
    let Some(pupil) = pupil_shift(view, &ray, motion) else {
        return lost;
    };
    if !pupil.is_finite() {
        return lost;
    }
    if pupil.length() > limit {
        return SpeckleShift {
            pupil: pupil.normalize() * limit,
            ..lost
        };
    }
    let defocus = 1.0 - view.focus_distance / ray.length;
    let sensor = view.magnification * (body + defocus * (pupil - body));
    SpeckleShift {
        pupil,
        delta: if pupil == DVec2::ZERO {
            0.0
        } else {
            pupil.length() / view.pupil_diameter
        },
        sensor: if sensor.is_finite() { sensor } else { in_focus },
    }
}

/// The seed's correlation coordinate u = d₁ + d₂ + d₃ (Bergmann et al. 2016), in
/// pupil diameters: the lengths of the shifts A_p by the camera's motion across
/// the viewing ray (d₁), by the part's motion across the ray, its rotation and
/// the laser's motion (d₂), and by the part's motion along the ray (d₃), added as
/// numbers. Never below δ of [`speckle_shift`], which adds the vectors; equal to
/// it when the three point the same way. Kept to compare the two.
pub fn seed_scalar_sum(view: &SurfaceView, motion: &Motion) -> f64 {
    let Some(ray) = ViewRay::of(view) else {
        return speckle_shift(view, motion).delta;
    };
    let along = |v: DVec3| ray.direction * ray.direction.dot(v);
    let camera = Motion {
        camera: motion.camera,
        ..Motion::default()
    };
    let surface = Motion {
        part: motion.part - along(motion.part),
        camera: DVec3::ZERO,
        ..*motion
    };
    let distance = Motion {
        part: along(motion.part),
        ..Motion::default()
    };
    [camera, surface, distance]
        .iter()
        .map(|part| speckle_shift(view, part).delta)
        .sum::<f64>()
        .min(MAX_DELTA)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The geometry of the reference values: λ = 660 nm, L_o = 300, L_s = 250,
    /// D = 10, point source 30° from the normal, camera along the normal.
    fn reference_view() -> SurfaceView {
        let angle = 30f64.to_radians();
        SurfaceView {
            point: DVec3::ZERO,
            normal: DVec3::Z,
            source: Source::Point(250.0 * DVec3::new(angle.sin(), 0.0, angle.cos())),
            pupil_centre: DVec3::new(0.0, 0.0, 300.0),
            pupil_diameter: 10.0,
            image_x: DVec3::X,
            focus_distance: 300.0,
            magnification: 1.0,
        }
    }

    fn oblique_view() -> SurfaceView {
        SurfaceView {
            point: DVec3::new(3.0, -2.0, 1.0),
            normal: DVec3::new(0.2, -0.1, 1.0).normalize(),
            source: Source::Point(DVec3::new(-90.0, 30.0, 220.0)),
            pupil_centre: DVec3::new(120.0, 40.0, 260.0),
            focus_distance: 270.0,
            magnification: -0.4,
            ..reference_view()
        }
    }

    fn turn_y(mrad: f64) -> Motion {
        Motion {
            rotation: DVec3::Y * mrad * 1e-3,
            ..Motion::default()
        }
    }

    #[test]
    fn the_overlap_law_has_its_tabled_values() {
        let table = [
            (0.0, 1.0),
            (0.05, 0.877),
            (0.1, 0.762),
            (0.2, 0.558),
            (0.3, 0.389),
            (0.5, 0.153),
            (0.7, 0.035),
            (1.0, 0.0),
            (MAX_DELTA, 0.0),
        ];
        for (delta, gamma) in table {
            let found = overlap_correlation(delta);
            assert!((found - gamma).abs() <= 0.0005 + 1e-12, "{delta}: {found}");
        }
    }

    #[test]
    fn a_tilt_shifts_the_pupil_field_by_the_reference_values() {
        for (mrad, delta, gamma) in [(3.0, 0.168, 0.620), (8.0, 0.448, 0.202)] {
            let shift = speckle_shift(&reference_view(), &turn_y(mrad));
            assert!((shift.delta - delta).abs() <= 0.0005, "{}", shift.delta);
            // γ falls by up to 2.5 per δ, and both are rounded to 3 places.
            assert!((overlap_correlation(shift.delta) - gamma).abs() <= 0.0005);
            assert_eq!(shift.sensor, DVec2::ZERO);
        }
    }

    #[test]
    fn an_out_of_focus_pattern_moves_by_the_reference_values() {
        let both = Motion {
            part: DVec3::X * 0.04,
            ..turn_y(2.0)
        };
        let table = [
            (280.0, turn_y(3.0), 112.0),
            (300.0, turn_y(3.0), 0.0),
            (320.0, turn_y(3.0), -112.0),
            (280.0, both, 117.0),
            (320.0, both, -37.0),
        ];
        for (focus_distance, motion, micrometres) in table {
            let view = SurfaceView {
                focus_distance,
                ..reference_view()
            };
            let shift = speckle_shift(&view, &motion);
            assert!(
                (shift.sensor - DVec2::X * micrometres * 1e-3).length() <= 0.05e-3,
                "{focus_distance}: {}",
                shift.sensor
            );
        }
    }

    /// The map without a basis T against L_o·(TᵀQ)⁻¹·Tᵀ·g as the module writes it.
    #[test]
    fn the_projection_is_the_tensor_formula_in_any_tangent_basis() {
        let view = oblique_view();
        let motion = Motion {
            part: DVec3::new(0.1, -0.2, 0.3),
            rotation: DVec3::new(1e-3, 2e-3, -3e-3),
            laser: DVec3::new(0.0, 0.4, 0.1),
            camera: DVec3::new(-0.2, 0.1, 0.2),
        };
        let ray = ViewRay::of(&view).unwrap();
        let (n_s, curvature) = view.source.at(view.point).unwrap();
        let body = motion.part - motion.camera;
        let g = curvature * (motion.part - motion.laser)
            + (body - ray.direction * ray.direction.dot(body)) / ray.length
            - motion.rotation.cross(n_s - ray.direction);
        let t1 = view.normal.cross(DVec3::new(0.3, 1.0, 0.0));
        let t2 = t1 * 0.5 + view.normal.cross(DVec3::X);
        let (q1, q2) = (ray.basis[0], ray.basis[1]);
        let tq = glam::DMat2::from_cols(
            DVec2::new(t1.dot(q1), t2.dot(q1)),
            DVec2::new(t1.dot(q2), t2.dot(q2)),
        );
        let expected = ray.length * (tq.inverse() * DVec2::new(t1.dot(g), t2.dot(g)));
        let found = speckle_shift(&view, &motion);
        assert!((found.pupil - expected).length() < 1e-12 * expected.length());
        let b = ray.project(body);
        let image = -0.4 * (b + (1.0 - 270.0 / ray.length) * (expected - b));
        assert!((found.sensor - image).length() < 1e-12);
    }

    #[test]
    fn the_camera_alone_moves_the_field_by_minus_its_way_and_a_head_like_the_part() {
        let view = oblique_view();
        let ray = ViewRay::of(&view).unwrap();
        let way = DVec3::new(0.3, -0.7, 0.2);
        let camera = Motion {
            camera: way,
            ..Motion::default()
        };
        let found = speckle_shift(&view, &camera).pupil;
        assert!((found + ray.project(way)).length() < 1e-12);
        let head = Motion {
            laser: way,
            ..camera
        };
        let part = Motion {
            part: -way,
            ..Motion::default()
        };
        let [head, part] = [head, part].map(|m| speckle_shift(&view, &m));
        assert!((head.pupil - part.pupil).length() < 1e-12);
        assert!((head.sensor - part.sensor).length() < 1e-15);
    }

    #[test]
    fn a_wavefront_with_a_point_sources_curvature_is_a_point_source() {
        let view = oblique_view();
        let (direction, curvature_per_mm) = view.source.at(view.point).unwrap();
        let wave = SurfaceView {
            source: Source::Wavefront {
                direction,
                curvature_per_mm,
            },
            ..view
        };
        let motion = Motion {
            part: DVec3::new(0.5, 0.1, -0.2),
            ..turn_y(1.0)
        };
        assert_eq!(speckle_shift(&view, &motion), speckle_shift(&wave, &motion));
    }

    #[test]
    fn the_seeds_sum_is_never_less_and_equal_for_one_kind_of_motion() {
        let view = oblique_view();
        let single = Motion {
            camera: DVec3::new(0.3, 0.2, 0.0),
            ..Motion::default()
        };
        let delta = speckle_shift(&view, &single).delta;
        assert!((seed_scalar_sum(&view, &single) - delta).abs() < 1e-15);
        // The camera follows the part: nothing moves across the pupil, yet the
        // scalars add up.
        let part = DVec3::new(0.3, 0.2, 0.0);
        let follow = Motion {
            part,
            laser: part,
            camera: part,
            ..Motion::default()
        };
        assert!(speckle_shift(&view, &follow).delta < 1e-15);
        assert!(seed_scalar_sum(&view, &follow) > 0.03);
    }

    #[test]
    fn singular_views_decorrelate_and_stay_finite() {
        let base = reference_view();
        let motion = Motion {
            part: DVec3::new(0.1, 0.02, 0.03),
            ..turn_y(3.0)
        };
        let with = |normal, pupil_centre, source| SurfaceView {
            normal,
            pupil_centre,
            source,
            focus_distance: 280.0,
            ..base
        };
        let views = [
            with(DVec3::X, base.pupil_centre, base.source),
            with(DVec3::new(1.0, 0.0, 1e-12), base.pupil_centre, base.source),
            with(DVec3::Z, DVec3::ZERO, base.source),
            with(DVec3::Z, base.pupil_centre, Source::Point(DVec3::ZERO)),
            with(
                DVec3::Z,
                base.pupil_centre,
                Source::Point(DVec3::Z * 1e-300),
            ),
            SurfaceView {
                pupil_diameter: 0.0,
                ..base
            },
        ];
        for view in views {
            let shift = speckle_shift(&view, &motion);
            assert_eq!(shift.delta, MAX_DELTA, "{view:?}");
            assert!(shift.pupil.is_finite() && shift.sensor.length() <= motion.part.length());
            assert!(shift.pupil.length() <= MAX_DELTA * view.pupil_diameter * 1.000_001);
            assert_eq!(overlap_correlation(shift.delta), 0.0);
            assert_eq!(seed_scalar_sum(&view, &motion), MAX_DELTA);
            let still = speckle_shift(&view, &Motion::default());
            assert_eq!((still.delta, still.sensor), (0.0, DVec2::ZERO));
        }
        // A point beside the pupil's centre, in its plane: the magnification there
        // has no value.
        let beside = SurfaceView {
            pupil_centre: DVec3::new(40.0, 0.0, 0.0),
            normal: DVec3::new(1.0, 0.0, 1.0).normalize(),
            magnification: f64::INFINITY,
            ..base
        };
        let shift = speckle_shift(&beside, &motion);
        assert!(shift.delta.is_finite() && shift.sensor.is_finite());
    }

    #[test]
    fn motions_of_many_pupil_diameters_keep_their_length() {
        let far = Motion {
            camera: DVec3::X * 5e4,
            ..Motion::default()
        };
        let shift = speckle_shift(&reference_view(), &far);
        assert!((shift.delta - 5e3).abs() < 1e-9);
        assert_eq!(overlap_correlation(shift.delta), 0.0);
    }
}
