//! Displacement and decorrelation of a speckle pattern when laser, part or camera move.
//!
//! One tensor formula covers in-plane, out-of-plane, tilt and camera motions (Yamaguchi 1981, Opt.
//! Acta 28, 1359; Sjödahl 1995, Appl. Opt. 34, 7998). Light scattered at the surface point x has
//! the phase k·(path from the laser + distance to the pupil). To first order, a motion changes this
//! phase by an amount that is linear across the surface. A linear phase across the surface shifts
//! the speckle field across the pupil by A_p:
//!
//! ```text
//! g     = C_s·(a − s) + (I − n_o n_oᵀ)/L_o·(a − c) + [Ω]ₓᵀ·(n_s − n_o)
//! A_p   = L_o·(TᵀQ)⁻¹·Tᵀ·g
//! δ     = |A_p| / D                  correlation of intensities γ(δ), the overlap law
//! a_I   = m·(b + (1 − L_f/L_o)·(A_p − b)),  b = Qᵀ(a − c)
//! ```
//!
//! n_s is the direction from the source to x, and n_o the direction from x to the pupil at distance
//! L_o. T is a basis of the surface, and Q a basis of the plane across n_o. C_s is the curvature of
//! the laser's wavefront ((I − n_s n_sᵀ)/L_s for a point source). Part, laser and camera move by a,
//! s and c, and the part rotates by Ω about x. L_f is the distance on which the lens is focused; in
//! focus, a_I is m·b.
//!
//! Valid range: motions much smaller than L_s, L_o and the radius of the wavefront, angles |Ω| ≪ 1,
//! and a lit area of many grains λL_o/D. A motion along the viewing ray also defocuses
//! ([`defocus_phase`]). γ(δ) is correct while this motion is much smaller than the longitudinal
//! grain 8λ(L_o/D)².

use crate::math::{DMat3, DVec2, DVec3};

/// Upper limit of the reported δ. Patterns are uncorrelated from δ = 1 on, and a finite number can
/// be wrapped and interpolated.
pub const MAX_DELTA: f64 = 1e6;

/// Wavefront of the laser at the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Source {
    /// Spherical wave from this point (mm).
    Point(DVec3),
    /// Any other wave: unit direction of travel, and the curvature tensor ∂(direction)/∂x (1/mm,
    /// symmetric). Zero curvature is a collimated beam or the waist of a beam. Away from the waist,
    /// a Gaussian beam has the curvature 1/R(z), R = z·(1 + (z_R/z)²), in each of its axes. Near
    /// the focus of a thin line, this differs strongly from 1/L_s.
    Wavefront {
        /// Direction of travel, unit vector.
        direction: DVec3,
        /// Curvature tensor, 1/mm.
        curvature_per_mm: DMat3,
    },
}

/// Surface point between laser and camera, in any frame (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceView {
    /// The surface point.
    pub point: DVec3,
    /// Unit surface normal; its sign does not matter.
    pub normal: DVec3,
    /// Wave that illuminates the point.
    pub source: Source,
    /// Centre of the lens pupil.
    pub pupil_centre: DVec3,
    /// Diameter of the pupil.
    pub pupil_diameter: f64,
    /// Direction in space that corresponds to the sensor's x axis. The first axis of Q is its
    /// component across the viewing ray; the second is n_o × the first.
    pub image_x: DVec3,
    /// Distance L_f from the pupil to the plane in focus.
    pub focus_distance: f64,
    /// Sensor mm per object mm in the basis Q; negative if the image is inverted in Q.
    pub magnification: f64,
}

impl SurfaceView {
    /// Returns the view with its point in focus.
    pub(crate) fn in_focus(&self) -> SurfaceView {
        SurfaceView {
            focus_distance: self.pupil_centre.distance(self.point),
            ..*self
        }
    }
}

/// Small motions of the three bodies in the frame of the [`SurfaceView`]. Only differences matter:
/// a scan head that carries laser and camera by v is `laser` = `camera` = v, or `part` = −v.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RigidMotion {
    /// Translation a of the part at the surface point (mm).
    pub part: DVec3,
    /// Rotation vector Ω of the part about the surface point (rad).
    pub rotation: DVec3,
    /// Translation s of the laser (mm). It moves a `Source::Wavefront` without rotating it.
    pub laser: DVec3,
    /// Translation c of the pupil (mm).
    pub camera: DVec3,
}

/// Effect of a [`RigidMotion`] on the speckle of one surface point.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpeckleShift {
    /// A_p: shift of the speckle field across the pupil, in the basis Q (mm).
    pub pupil: DVec2,
    /// δ = |A_p|/D, at most [`MAX_DELTA`].
    pub delta: f64,
    /// a_I: shift of the pattern on the sensor, in the basis Q (mm).
    pub sensor: DVec2,
}

/// Returns the intensity correlation of two speckle patterns whose pupil fields are shifted by δ
/// pupil diameters.
///
/// γ = μ², μ = (2/π)·(acos δ − δ·√(1−δ²)), the overlap of two discs; 0 for δ ≥ 1 (Goodman, *Speckle
/// Phenomena in Optics*). Valid for a uniformly lit circular pupil.
pub fn overlap_correlation(delta: f64) -> f64 {
    let delta = delta.abs();
    if delta >= 1.0 {
        return 0.0;
    }
    let mu = std::f64::consts::FRAC_2_PI * (delta.acos() - delta * (1.0 - delta * delta).sqrt());
    mu * mu
}

/// Returns the defocus phase φ of the pupil's rim relative to its centre, rad, caused by a change
/// of the distance to the surface.
///
/// φ = k·D²·ζ/(8·L_f²), where ζ is the motion of the part towards the pupil. The tensor formula
/// does not contain φ, because its terms are linear across the pupil. One longitudinal grain,
/// 8λ(L_f/D)², is φ = 2π.
///
/// The relevant distance is L_f, not L_o. Light that converges at an image point passes through the
/// pupil point X at an angle X/L_f to the chief ray. It starts from a surface point at the lateral
/// distance (1 − L_o/L_f)·X from the chief ray. Its path changes by ζ·X²/(2·L_f²).
pub fn defocus_phase(view: &SurfaceView, motion: &RigidMotion, wavelength_mm: f64) -> f64 {
    let Some(ray) = ViewRay::of(view) else {
        return 0.0;
    };
    let approach = (motion.part - motion.camera).dot(ray.direction);
    let half_angle = view.pupil_diameter / (2.0 * view.focus_distance);
    std::f64::consts::PI / wavelength_mm * half_angle * half_angle * approach
}

/// Returns the intensity correlation for a shift of δ diameters across the pupil and a defocus
/// phase φ ([`defocus_phase`]), with each pattern at its best lateral position.
///
/// γ(δ, φ) = |∫ exp(iφρ²) dA|²/π² over the overlap of two unit discs, where ρ is measured from the
/// centre of the overlap. γ(δ, 0) is [`overlap_correlation`], and γ(0, φ) is (sin(φ/2)/(φ/2))². The
/// integral is computed by quadrature, to 1e-4. The result is 0 for |φ| > 100, where γ < 4e-4.
pub fn overlap_correlation_defocused(delta: f64, phase: f64) -> f64 {
    const NODES: usize = 128;
    let delta = delta.abs();
    // A negated condition, so that NaN also returns 0.
    if !(delta < 1.0 && phase.abs() <= 100.0) {
        return 0.0;
    }
    let node = |i: usize| (i as f64 + 0.5) / NODES as f64;
    let (mut re, mut im) = (0.0, 0.0);
    for i in 0..NODES {
        // x = (1 − δ)(1 − t²) smooths the rim of the overlap, a square root at its tip.
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

/// Returns the direction n_o and distance L_o from a surface point to the pupil; `None` if the
/// point is the centre of the pupil or not finite.
fn towards_pupil(view: &SurfaceView) -> Option<(DVec3, f64)> {
    let to_pupil = view.pupil_centre - view.point;
    Some((to_pupil.try_normalize()?, to_pupil.length()))
}

/// Viewing ray at a surface point: unit direction, length and basis Q of the plane across it.
pub(crate) struct ViewRay {
    pub direction: DVec3,
    pub length: f64,
    pub basis: [DVec3; 2],
}

impl ViewRay {
    /// Computes the viewing ray; `None` if the point is the centre of the pupil or not finite.
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
    /// Returns the direction n_s and curvature C_s at `x`; `None` at the source itself.
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

/// Returns Q·A_p in mm, linear in the motion and without a limit. The result is not finite if the
/// formula is singular.
///
/// (TᵀQ)⁻¹Tᵀ is the projection onto the plane across n_o along the surface normal n, which needs no
/// basis T: Q·A_p = L_o·(g − n·(g·n_o)/(n·n_o)). The second argument is n_o and L_o, and the third
/// is n_s and C_s at the point.
fn pupil_shift(
    view: &SurfaceView,
    (n_o, length): (DVec3, f64),
    (n_s, curvature): (DVec3, DMat3),
    motion: &RigidMotion,
) -> DVec3 {
    let relative = motion.part - motion.camera;
    let g_times_length = length
        * (curvature * (motion.part - motion.laser) + (n_s - n_o).cross(motion.rotation))
        + relative
        - n_o * n_o.dot(relative);
    let slant = g_times_length.dot(n_o) / view.normal.dot(n_o);
    g_times_length - view.normal * slant
}

/// Returns A_p for each motion, projected along the viewing ray onto the pupil plane across `axis`
/// (unit vector), in pupil diameters. The length is limited to 1, because no light of the old field
/// remains in the pupil beyond it. The result is zero if the formula is singular.
pub fn shifts_on_pupil<const N: usize>(
    view: &SurfaceView,
    motions: &[RigidMotion; N],
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

/// Computes the shift of the speckle across the pupil and on the sensor (formula: see the module).
///
/// The result is always finite. The formula is singular for a grazing view and for a point at the
/// centre of the pupil or at the source. In these cases, and if |A_p| exceeds [`MAX_DELTA`]
/// diameters, any motion decorrelates fully: δ = `MAX_DELTA`, and `sensor` is the in-focus shift
/// m·b. The out-of-focus part has no meaning for an uncorrelated pattern. Without motion, all
/// shifts are zero.
pub fn speckle_shift(view: &SurfaceView, motion: &RigidMotion) -> SpeckleShift {
    let still = SpeckleShift {
        pupil: DVec2::ZERO,
        delta: 0.0,
        sensor: DVec2::ZERO,
    };
    if *motion == RigidMotion::default() {
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

/// Returns the correlation coordinate u = d₁ + d₂ + d₃ of Bergmann et al. (2016), in pupil
/// diameters.
///
/// The terms are lengths of shifts A_p. The camera's motion across the viewing ray gives d₁. The
/// part's motion across the ray, its rotation and the laser's motion give d₂. The part's motion
/// along the ray gives d₃. The sum is never below δ of [`speckle_shift`], which adds the vectors;
/// they are equal if all three are parallel. It is kept only for this comparison.
pub fn bergmann_scalar_sum(view: &SurfaceView, motion: &RigidMotion) -> f64 {
    let Some(ray) = ViewRay::of(view) else {
        return speckle_shift(view, motion).delta;
    };
    let along = |v: DVec3| ray.direction * ray.direction.dot(v);
    let camera = RigidMotion {
        camera: motion.camera,
        ..RigidMotion::default()
    };
    let surface = RigidMotion {
        part: motion.part - along(motion.part),
        camera: DVec3::ZERO,
        ..*motion
    };
    let distance = RigidMotion {
        part: along(motion.part),
        ..RigidMotion::default()
    };
    [camera, surface, distance]
        .iter()
        .map(|part| speckle_shift(view, part).delta)
        .sum::<f64>()
        .min(MAX_DELTA)
}

#[cfg(test)]
mod tests;
