//! A surface that sends light through the pupil unevenly: its mean over the pupil, and the
//! place in the pupil where the middle of the light passes.

use super::View;
use crate::math::quadrature::gauss_legendre;
use crate::math::{Aperture, DVec2, DVec3, Rigid};
use crate::surface::{Glossy, Lay};
use std::f64::consts::PI;

/// Ratio of α to half the pupil's angle from which on the pupil's middle stands for all of it: the
/// mean over a disc differs by the share (a/α)² at most, 9e-4, where light turns by a right angle or
/// less (GGX's D bends by −4/α² of itself at its peak, and the half vector turns by up to a).
const EVEN: f64 = 33.0;
/// Most points along each side of the pupil.
const MOST: usize = 40;

/// The glossy surface of a view, seen through its pupil.
pub(super) struct Gloss<'a> {
    view: &'a View<'a>,
    surface: &'a Glossy,
    /// Points of the pupil (part's frame, mm), from its middle (pupil radii, along the image's
    /// columns and rows), and their shares.
    pupil: Vec<(DVec3, DVec2, f64)>,
    /// Normal of the pupil's plane (part's frame), a unit vector.
    axis: DVec3,
    laser_from_camera: Rigid,
}

/// Points (radii of the disc, half sides of the square) and shares, sum 1, that integrate polynomials of degree
/// 2n − 1 over a pupil: chords at Chebyshev's nodes of the second kind, whose weights are their lengths,
/// and Gauss–Legendre's along each (Abramowitz & Stegun 1964, 25.4.40).
fn rule(aperture: Aperture, n: usize) -> Vec<(DVec2, f64)> {
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

impl<'a> Gloss<'a> {
    /// `skewed`: whether it matters where in the pupil light passes.
    pub fn new(view: &'a View<'a>, surface: &'a Glossy, skewed: bool) -> Gloss<'a> {
        let lens = &view.camera.lens;
        let radius = lens.pupil_diameter() / 2.0;
        let eye = view.part_from_camera.translation;
        let part = view.accel.bounds();
        // What is nearer than the focal length is not imaged.
        let distance = (eye.clamp(part.min, part.max) - eye).length();
        let half_angle = radius * lens.aperture.extent() / distance.max(lens.focal_length);
        let width = surface.narrowest() / half_angle;
        // GGX has double poles at ±iα: a rule of n nodes errs by about (w + √(1 + w²))⁻²ⁿ, here 1e-4.
        let nodes = match width > EVEN && !skewed {
            true => 1,
            false => 1 + (4.6 / width.asinh()).ceil() as usize,
        };
        let axes = view.part_from_camera.rotation;
        let point = |(u, share): (DVec2, f64)| {
            let off = axes.x_axis * u.x + axes.y_axis * u.y;
            (eye + off * radius, u, share)
        };
        Gloss {
            view,
            surface,
            pupil: rule(lens.aperture, nodes.min(MOST))
                .into_iter()
                .map(point)
                .collect(),
            axis: axes.z_axis,
            laser_from_camera: view.part_from_laser.inverse() * view.part_from_camera,
        }
    }

    /// Mean of the BRDF over the projected solid angle of the pupil, 1/sr: ∫f·cosθ_o dΩ / ∫cosθ_o dΩ,
    /// where θ_o is the angle to the surface normal. Vectors are in the part's frame.
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

    /// By how much (columns and rows, pixels) the middle of the light that the lens spreads lies beside where
    /// the ray through the pupil's middle falls: light through ⟨X⟩ of the pupil comes from that place of the
    /// plane in focus to which the way from ⟨X⟩ through the surface leads. The surface: the point seen at that place and
    /// its normal, laser's frame.
    pub fn skew(&self, place: DVec2, [seen, normal]: [DVec3; 2]) -> [f32; 2] {
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

    /// Whether the BRDF is the same over a pixel, within which the point seen moves by `moves` (mm) and the
    /// direction to it turns by `turns` (rad). The point, its normal and the moves are in the laser's frame.
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
                half + lay_turns <= self.surface.constant_turn()
            })
        })
    }

    /// Greatest difference of unit normals over which the BRDF is the same.
    pub fn constant_turn(&self) -> f32 {
        self.surface.constant_turn() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean 1, mean of u² a quarter of the width along each axis on a disc, a third on a square.
    #[test]
    fn the_pupils_rule_has_its_moments() {
        for (aperture, x2, y2) in [
            (Aperture::Circle, 0.25, 0.25),
            (Aperture::Ellipse(0.5), 0.25, 0.0625),
            (Aperture::Square, 1.0 / 3.0, 1.0 / 3.0),
        ] {
            for n in 2..12 {
                let rule = rule(aperture, n);
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
