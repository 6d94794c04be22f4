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
//! Valid for motions small against L_s, L_o and the radius of the wavefront, for
//! angles |Ω| ≪ 1, and for a lit area of many grains λL_o/D. A motion along the
//! viewing ray also defocuses ([`defocus_phase`]); γ(δ) alone is right while that is
//! much less than the longitudinal grain 8λ(L_o/D)².

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
        /// Unit vector.
        direction: DVec3,
        /// 1/mm.
        curvature_per_mm: DMat3,
    },
}

/// A surface point between laser and camera, in any frame (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceView {
    /// The surface point.
    pub point: DVec3,
    /// Unit surface normal; its sign does not matter.
    pub normal: DVec3,
    /// The wave that lights it.
    pub source: Source,
    /// Middle of the lens's pupil.
    pub pupil_centre: DVec3,
    /// Diameter of the pupil.
    pub pupil_diameter: f64,
    /// Direction in space that the sensor's x axis shows; Q's first axis is its
    /// part across the viewing ray, Q's second n_o × the first.
    pub image_x: DVec3,
    /// Distance L_f from the pupil to the plane in focus.
    pub focus_distance: f64,
    /// Sensor mm per object mm in the basis Q; negative if Q shows inverted.
    pub magnification: f64,
}

impl SurfaceView {
    /// The view with its point in focus.
    pub(crate) fn in_focus(&self) -> SurfaceView {
        SurfaceView {
            focus_distance: self.pupil_centre.distance(self.point),
            ..*self
        }
    }
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

/// Phase φ by which a change of the distance to the surface defocuses the pupil's
/// rim against its centre, φ = k·D²·ζ/(8·L_f²), ζ the motion of the part towards
/// the pupil (rad). Not in the tensor formula, whose terms are linear across the
/// pupil; one longitudinal grain, 8λ(L_f/D)², is φ = 2π.
///
/// It is the distance in focus that counts: light that meets at an image point comes
/// through the pupil point X from a surface point that lies (1 − L_o/L_f)·X beside
/// the chief ray, at an angle X/L_f to it, and its path changes by ζ·X²/(2·L_f²).
pub fn defocus_phase(view: &SurfaceView, motion: &Motion, wavelength_mm: f64) -> f64 {
    let Some(ray) = ViewRay::of(view) else {
        return 0.0;
    };
    let approach = (motion.part - motion.camera).dot(ray.direction);
    let half_angle = view.pupil_diameter / (2.0 * view.focus_distance);
    std::f64::consts::PI / wavelength_mm * half_angle * half_angle * approach
}

/// Intensity correlation with a shift of δ diameters across the pupil and a
/// defocus phase φ ([`defocus_phase`]), each pattern taken at its best lateral
/// place: γ(δ, φ) = |∫ exp(iφρ²) dA|²/π² over the overlap of two unit discs, ρ from
/// the overlap's middle. γ(δ, 0) is [`overlap_correlation`], γ(0, φ) is
/// (sin(φ/2)/(φ/2))². By quadrature to 1e-4; 0 for |φ| > 100, where γ < 4e-4.
pub fn overlap_correlation_defocused(delta: f64, phase: f64) -> f64 {
    const NODES: usize = 128;
    let delta = delta.abs();
    // Not `>=`: a NaN must not reach the sum either.
    if !(delta < 1.0 && phase.abs() <= 100.0) {
        return 0.0;
    }
    let node = |i: usize| (i as f64 + 0.5) / NODES as f64;
    let (mut re, mut im) = (0.0, 0.0);
    for i in 0..NODES {
        // x = (1 − δ)(1 − t²) smooths the lens's edge, a square root at its tip.
        let t = node(i);
        let x = (1.0 - delta) * (1.0 - t * t);
        let top = (1.0 - (x + delta).powi(2)).max(0.0).sqrt();
        let area = 2.0 * (1.0 - delta) * t * top;
        for j in 0..NODES {
            let (sin, cos) = (phase * (x * x + (top * node(j)).powi(2))).sin_cos();
            re += area * cos;
            im += area * sin;
        }
    }
    let quarter_plane = 4.0 / (NODES * NODES) as f64 / std::f64::consts::PI;
    (re * re + im * im) * quarter_plane * quarter_plane
}

/// Direction n_o and distance L_o of the pupil from a surface point; `None` where the point is the pupil's
/// centre (or not finite).
fn towards_pupil(view: &SurfaceView) -> Option<(DVec3, f64)> {
    let to_pupil = view.pupil_centre - view.point;
    Some((to_pupil.try_normalize()?, to_pupil.length()))
}

/// The viewing ray at a surface point: unit vector, length, basis Q across it.
pub(crate) struct ViewRay {
    pub direction: DVec3,
    pub length: f64,
    pub basis: [DVec3; 2],
}

impl ViewRay {
    /// `None` where the point is the pupil's centre (or not finite).
    pub fn of(view: &SurfaceView) -> Option<ViewRay> {
        let (direction, length) = towards_pupil(view)?;
        let across = view.image_x - direction * view.image_x.dot(direction);
        let x = across
            .try_normalize()
            .unwrap_or_else(|| direction.any_orthonormal_vector());
        Some(ViewRay {
            direction,
            length,
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

/// Q·A_p in mm, linear in the motion, not yet limited: not finite where
/// the formula is singular. (TᵀQ)⁻¹Tᵀ is written as the projection onto the plane
/// across n_o along the surface normal n, which is the same map without a basis
/// T: Q·A_p = L_o·(g − n·(g·n_o)/(n·n_o)). `source` is n_s and C_s at the point, the
/// viewing ray is n_o and L_o.
fn pupil_shift(
    view: &SurfaceView,
    (n_o, length): (DVec3, f64),
    (n_s, curvature): (DVec3, DMat3),
    motion: &Motion,
) -> DVec3 {
    let relative = motion.part - motion.camera;
    let g_times_length = length
        * (curvature * (motion.part - motion.laser) + (n_s - n_o).cross(motion.rotation))
        + relative
        - n_o * n_o.dot(relative);
    let slant = g_times_length.dot(n_o) / view.normal.dot(n_o);
    g_times_length - view.normal * slant
}

/// A_p on the plane across `axis` (unit vector) in which the pupil lies, in diameters, by each of
/// these motions: the shift along the viewing rays as the lens sees it. At most 1, past which no
/// light of the old field is left; zero where the formula is singular.
pub fn shifts_on_pupil<const N: usize>(
    view: &SurfaceView,
    motions: &[Motion; N],
    axis: DVec3,
) -> [DVec3; N] {
    let Some((ray, source)) = towards_pupil(view).zip(view.source.at(view.point)) else {
        return [DVec3::ZERO; N];
    };
    let (direction, _) = ray;
    let per_length = 1.0 / direction.dot(axis);
    std::array::from_fn(|i| {
        let across = pupil_shift(view, ray, source, &motions[i]);
        let slant = direction * (across.dot(axis) * per_length);
        let shift = (across - slant) / view.pupil_diameter;
        match shift.is_finite() {
            true => shift.clamp_length_max(1.0),
            false => DVec3::ZERO,
        }
    })
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
    let Some(source) = view.source.at(view.point) else {
        return lost;
    };
    let of_ray = (ray.direction, ray.length);
    let pupil = ray.project(pupil_shift(view, of_ray, source, motion));
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
mod tests;
