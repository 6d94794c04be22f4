//! Average of a glossy BRDF over the pupil, and the resulting lateral shift of the blur.

use super::PoseView;
use crate::math::quadrature::gauss_legendre;
use crate::math::{Aperture, DVec2, DVec3, Rigid};
use crate::surface::{Lay, LayeredBrdf};
use std::f64::consts::PI;

/// Ratio of roughness α to the pupil half-angle a above which the BRDF at the pupil centre replaces
/// the pupil average. The average over the pupil then deviates by at most (a/α)², 9e-4, where light
/// turns by a right angle or less. GGX's D has the relative curvature −4/α² at its peak, and the
/// half vector turns by up to a.
const NARROW_LOBE_RATIO: f64 = 33.0;
/// Maximum number of points along each side of the pupil.
const MAX_PUPIL_POINTS_PER_SIDE: usize = 40;

/// Glossy surface as viewed through the pupil of the camera.
pub(super) struct PupilAveragedBrdf<'a> {
    view: &'a PoseView<'a>,
    surface: &'a LayeredBrdf,
    /// Pupil samples: position (part's frame, mm), position relative to the pupil centre (pupil
    /// radii, along the image's columns and rows) and weight.
    pupil: Vec<(DVec3, DVec2, f64)>,
    /// Unit normal of the pupil plane, part's frame.
    axis: DVec3,
    laser_from_camera: Rigid,
}

/// Returns points (disc radii, or half sides of the square) and weights (sum 1) of a cubature over
/// a pupil. The cubature is exact for polynomials of degree 2n − 1. On a disc it uses chords at
/// Chebyshev nodes of the second kind, weighted by chord length. Gauss–Legendre nodes lie on each
/// chord (Abramowitz & Stegun 1964, 25.4.40).
fn cubature_rule(aperture: Aperture, n: usize) -> Vec<(DVec2, f64)> {
    let along = gauss_legendre(n);
    let mut points = Vec::with_capacity(n * n);
    for k in 0..n {
        let (x, half, weight) = match aperture {
            Aperture::Square => (2.0 * along[k].0 - 1.0, 1.0, along[k].1),
            Aperture::Circle | Aperture::Ellipse(_) => {
                let (sin, cos) = (PI * (k + 1) as f64 / (n + 1) as f64).sin_cos();
                (cos, sin, 2.0 * sin * sin / (n + 1) as f64)
            }
        };
        let place = |y: f64| DVec2::new(x, (2.0 * y - 1.0) * half * aperture.ratio());
        points.extend(along.iter().map(|&(y, w)| (place(y), weight * w)));
    }
    points
}

impl<'a> PupilAveragedBrdf<'a> {
    /// Samples the pupil. `skewed`: true if the centroid of the light in the pupil is needed.
    pub fn new(
        view: &'a PoseView<'a>,
        surface: &'a LayeredBrdf,
        skewed: bool,
    ) -> PupilAveragedBrdf<'a> {
        let lens = &view.camera.lens;
        let radius = lens.pupil_diameter() / 2.0;
        let eye = view.part_from_camera.translation;
        let part = view.accel.bounds();
        // Points nearer than the focal length are not imaged.
        let distance = (eye.clamp(part.min, part.max) - eye).length();
        let half_angle = radius * lens.aperture.extent() / distance.max(lens.focal_length);
        let width = surface.min_roughness() / half_angle;
        // GGX has double poles at ±iα. The error of a rule with n nodes is about (w + √(1 +
        // w²))⁻²ⁿ, here 1e-4.
        let nodes = match width > NARROW_LOBE_RATIO && !skewed {
            true => 1,
            false => 1 + (4.6 / width.asinh()).ceil() as usize,
        };
        let axes = view.part_from_camera.rotation;
        let point = |(u, share): (DVec2, f64)| {
            let off = axes.x_axis * u.x + axes.y_axis * u.y;
            (eye + off * radius, u, share)
        };
        PupilAveragedBrdf {
            view,
            surface,
            pupil: cubature_rule(lens.aperture, nodes.min(MAX_PUPIL_POINTS_PER_SIDE))
                .into_iter()
                .map(point)
                .collect(),
            axis: axes.z_axis,
            laser_from_camera: view.part_from_laser.inverse() * view.part_from_camera,
        }
    }

    /// Returns the mean of the BRDF over the projected solid angle of the pupil, sr⁻¹: ∫f·cosθ_o dΩ
    /// / ∫cosθ_o dΩ, where θ_o is the angle to the surface normal. Vectors are in the part's frame.
    pub fn bsdf(&self, point: DVec3, normal: DVec3, towards_light: DVec3) -> f64 {
        let lit = self.surface.lit(point, normal, towards_light);
        let (mut light, mut angle) = (0.0, 0.0);
        for (eye, _, weight) in &self.pupil {
            let sight = *eye - point;
            let distance = sight.length();
            let towards_eye = sight / distance;
            let on_pupil = towards_eye.dot(self.axis).abs();
            let on_surface = towards_eye.dot(normal).max(0.0);
            let projected = weight * on_surface * on_pupil / (distance * distance);
            light += projected * lit.bsdf(towards_eye);
            angle += projected;
        }
        match angle > 0.0 {
            true => light / angle,
            false => 0.0,
        }
    }

    /// Returns the offset of the blur centroid from the image of the chief ray, columns and rows in
    /// pixels. Light through the pupil centroid ⟨X⟩ follows the line from ⟨X⟩ through the surface
    /// point. The blur centroid is the image of the point where that line crosses the plane in
    /// focus. `seen` is the surface point at `place` and `normal` its normal, both in the laser's
    /// frame.
    pub fn pupil_centroid_shift(&self, place: DVec2, [seen, normal]: [DVec3; 2]) -> [f32; 2] {
        let view = self.view;
        let Some(section) = view.laser.section(seen) else {
            return [0.0; 2];
        };
        let to_part = &view.part_from_laser;
        let point = to_part.point(seen);
        let normal = to_part.vector(normal);
        let towards_light = -to_part.vector(section.flux.normalize_or_zero());
        let lit = self.surface.lit(point, normal, towards_light);
        let (mut sum, mut first) = (0.0, DVec2::ZERO);
        for &(eye, u, share) in &self.pupil {
            let through = share * lit.bsdf((eye - point).normalize());
            sum += through;
            first += u * through;
        }
        if sum <= 0.0 {
            return [0.0; 2];
        }
        let middle = first / sum * (view.camera.lens.pupil_diameter() / 2.0);
        let seen = self.laser_from_camera.inverse().point(seen);
        let behind = view.camera.sensor_point(place).z;
        let focus = 1.0 / view.camera.lens.focal_length - 1.0 / behind;
        let vergence = focus - 1.0 / seen.z;
        let moved = seen + (middle * vergence * seen.z).extend(0.0);
        let both = [seen, moved].map(|p| view.camera.project(p));
        match both {
            [Some(from), Some(to)] if (to - from).is_finite() => (to - from).as_vec2().to_array(),
            _ => [0.0; 2],
        }
    }

    /// Returns true if the BRDF is constant over a pixel. Across the pixel, the visible point moves
    /// by `moves` (mm) and the viewing direction turns by `turns` (rad). The point, its normal and
    /// the moves are in the laser's frame.
    pub fn is_constant_over(
        &self,
        [seen, normal]: [DVec3; 2],
        moves: [DVec3; 2],
        turns: [f64; 2],
    ) -> bool {
        let laser = self.view.laser;
        let light = |p: DVec3| {
            let section = laser.section(p)?;
            section.flux.try_normalize()
        };
        let Some(here) = light(seen) else {
            return false;
        };
        let eye = self.laser_from_camera.translation;
        let between = ((eye - seen).normalize() - here).length();
        let to_part = &self.view.part_from_laser;
        let lay = |p: DVec3| {
            let (point, normal) = (to_part.point(p), to_part.vector(normal));
            Lay::frame(self.surface.lay.as_ref(), point, normal)[0]
        };
        moves.iter().zip(turns).all(|(&step, turn)| {
            let there = seen + step;
            light(there).is_some_and(|light| {
                let half = ((light - here).length() + turn) / between;
                let lay_turns = (lay(there) - lay(seen)).length();
                half + lay_turns <= self.surface.max_normal_change_rad()
            })
        })
    }

    /// Returns the maximum difference of unit normals over which the BRDF counts as constant.
    pub fn max_normal_change_rad(&self) -> f32 {
        self.surface.max_normal_change_rad() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The weights sum to 1. The mean of u² is a quarter of the squared half width along each axis
    /// for a disc, and a third for a square.
    #[test]
    fn the_pupils_rule_has_its_moments() {
        for (aperture, x2, y2) in [
            (Aperture::Circle, 0.25, 0.25),
            (Aperture::Ellipse(0.5), 0.25, 0.0625),
            (Aperture::Square, 1.0 / 3.0, 1.0 / 3.0),
        ] {
            for n in 2..12 {
                let rule = cubature_rule(aperture, n);
                let mean = |f: &dyn Fn(DVec2) -> f64| -> f64 {
                    rule.iter().map(|&(u, share)| share * f(u)).sum()
                };
                let found = [
                    mean(&|_| 1.0),
                    mean(&|u| u.x),
                    mean(&|u| u.x * u.x),
                    mean(&|u| u.y * u.y),
                ];
                for (found, expected) in found.into_iter().zip([1.0, 0.0, x2, y2]) {
                    assert!((found - expected).abs() < 1e-12, "{aperture:?} {n} {found}");
                }
            }
        }
    }
}
