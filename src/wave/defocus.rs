//! A line laser's light on a rough plane before or behind the plane in focus, by exact paths.
//!
//! The line has a Gaussian irradiance across it and an even one along it. The plane stands across the axis
//! at the distance L_o, the lens is focused at L_f, and nothing else tells that the image is out of
//! focus: each scatterer's paths to the pupil's points are those from where it is.
//!
//! All lengths are in grains h = λ·L_f/D of the plane in focus, D being the pupil's width: λ·d_PI/D on the
//! sensor. The diameter of the blur there is b = D·(L_f/L_o − 1), of both signs.

use super::columns::{Block, Window};
use super::image::{
    ImageGrid, Pupil, Scatterer, WaveImage, intensity_at_focus, pupil_field, pupil_samples,
};
use super::patch::{RoughPoint, lit, moved, patch_filling_view};
use crate::error::Result;
use crate::math::rng::{Key, Purpose};
use crate::math::{Aperture, DVec2, DVec3};
use crate::speckle::motion::Source;
use rayon::prelude::*;

/// The laser's wavelength, mm.
pub const WAVELENGTH: f64 = 660e-6;
/// Distance L_o from the pupil to the surface, mm.
pub const DISTANCE: f64 = 300.0;
/// Width D of the pupil, mm.
pub const PUPIL: f64 = 10.0;
/// Where the laser stands, mm: 30° beside the camera, on a plane across the line.
pub const LASER: DVec3 = DVec3::new(0.0, -125.0, 216.506_350_946_109_66);

/// Standard deviations of the line to which it is lit.
const LIT: f64 = 4.0;
/// Beside the window of the centroid, so that what the periodic image brings back of the lens's wings is
/// as little as 0.13/8 of the light, most of it outside the window.
const WINGS: f64 = 8.0;
/// Narrowest image: its pupil has as many samples across, and the circle's staircase of these is even to 0.2 %
/// of its area.
const NARROWEST: f64 = 65.0;

/// A line, a pupil and a defocus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DefocusedLine {
    /// Shape of the pupil; its width lies along the line, its height across it.
    pub aperture: Aperture,
    /// Standard deviation σ of the line's ideal image, grains.
    pub sigma: f64,
    /// Diameter b of the blur along the pupil's width, grains; above 0 where the surface is nearer than
    /// the focus.
    pub blur: f64,
    /// Square pixels along a grain.
    pub pixels_per_grain: usize,
}

impl DefocusedLine {
    /// Distance L_f at which the lens is focused, mm.
    pub fn focus_distance(&self) -> f64 {
        1.0 / (1.0 / DISTANCE - self.blur * WAVELENGTH / (PUPIL * PUPIL))
    }

    /// The grain on the surface, mm.
    pub fn grain_mm(&self) -> f64 {
        WAVELENGTH * DISTANCE / PUPIL
    }

    /// How far from the ideal line its centroid is taken, grains: four standard deviations, to the blur's edge
    /// and two grains of the pupil's height further.
    pub fn reach(&self) -> f64 {
        let height = self.aperture.ratio();
        LIT * self.sigma + 0.5 * self.blur.abs() * height + 2.0 / height
    }

    /// Where it is measured: the centroid within [`DefocusedLine::reach`]; contrast and grains over a grain or half a
    /// standard deviation of the line's mean image around the middle, and that deviation beside it.
    pub fn window(&self) -> Window {
        let pixels = self.pixels_per_grain as f64;
        let height = self.aperture.ratio();
        let beside = self.sigma.hypot(0.25 * self.blur * height);
        Window {
            reach: (self.reach() * pixels) as usize,
            middle: (pixels * (0.5 / height).max(0.25 * beside)) as usize,
            beside: (beside * pixels).ceil() as usize,
            lags: (3.0 * pixels / height) as usize,
        }
    }

    /// Width of the periodic image, grains: odd, so that as many samples as it is grains wide fill a square
    /// pupil exactly.
    fn side(&self) -> f64 {
        let height = self.aperture.ratio();
        let needed = (2.0 * self.reach() + WINGS / height).max(self.blur.abs() + WINGS);
        2.0 * (needed.max(NARROWEST) / 2.0).ceil() + 1.0
    }

    /// Terms of the sum of exact paths for an image of [`line_images`].
    pub fn terms(&self) -> f64 {
        let window = self.side();
        let [along, across] = self.cells();
        along as f64 * across as f64 * pupil_samples(window)
    }

    /// Columns of an image, in grains.
    pub fn columns_grains(&self) -> f64 {
        self.side()
    }

    /// Spacing of scatterers in grains. Each has an amplitude that is circular Gaussian, so the field is
    /// a Gaussian process; |H|², of which its covariance is the sum over the scatterers, is band-limited to
    /// a cycle a grain, for which two a grain are enough. Where each place of the image sees a blur full of
    /// them, 32 along it are.
    fn cells(&self) -> [usize; 2] {
        let spacing = 0.5f64.hypot(self.blur / 32.0);
        let across = spacing.min(self.sigma / 3.0);
        [self.side() / spacing, 2.0 * LIT * self.sigma / across].map(|n| n.ceil() as usize)
    }

    fn pupil(&self) -> Pupil {
        Pupil {
            centre: DVec3::Z * DISTANCE,
            right: DVec3::X,
            up: DVec3::Y,
            diameter: PUPIL,
            aperture: self.aperture,
        }
    }

    fn grid(&self) -> ImageGrid {
        let focus_distance = self.focus_distance();
        ImageGrid {
            pixels: self.side() as usize * self.pixels_per_grain,
            pixel_mm: WAVELENGTH * focus_distance / PUPIL / self.pixels_per_grain as f64,
            focus_distance,
        }
    }

    fn image(&self, scatterers: &[Scatterer]) -> Result<WaveImage> {
        let grid = self.grid();
        let field = pupil_field(scatterers, &self.pupil(), WAVELENGTH, &grid)?;
        Ok(intensity_at_focus(&field, &grid))
    }

    /// A rough surface: as long as the periodic image, so that each place of it sees all of its blur.
    fn surface(&self, key: Key) -> Vec<RoughPoint> {
        let grain = self.grain_mm();
        let size = DVec2::new(self.side(), 2.0 * LIT * self.sigma) * grain;
        let [along, across] = self.cells();
        patch_filling_view(
            DVec3::ZERO,
            DVec3::Z,
            [DVec3::X, DVec3::Y],
            size,
            // A little more, so that rounding does not add a cell.
            size / (DVec2::new(along as f64, across as f64) - 1e-6),
            WAVELENGTH,
        )
        .points(key)
    }

    /// The image of a surface as the laser lights it.
    fn seen(&self, points: &[RoughPoint]) -> Result<Block> {
        // Off the laser's sheet, which meets the plane at an angle.
        let normal = DVec3::new(0.0, LASER.z, -LASER.y) / LASER.length();
        let sigma = self.sigma * self.grain_mm() * normal.y;
        let scatterers = lit(points, &Source::Point(LASER), DVec3::ZERO, |x| {
            (-0.5 * (x.dot(normal) / sigma).powi(2)).exp()
        });
        let image = self.image(&scatterers)?;
        let pixels = image.grid.pixels as isize;
        // The middle row and as many to each side; of an even number one is left out.
        let half = (pixels - 1) / 2;
        let columns = (0..pixels).map(|i| i - pixels / 2);
        let light = columns.flat_map(|x| (-half..=half).map(move |y| (x, y)));
        Ok(Block {
            rows: 2 * half as usize + 1,
            light: light.map(|(x, y)| image.at(x, y)).collect(),
        })
    }
}

/// Images of independent rough surfaces, each as many columns as [`DefocusedLine::columns_grains`].
///
/// # Errors
/// As [`pupil_field`].
pub fn line_images(line: &DefocusedLine, surfaces: u64, seed: u64) -> Result<Vec<Block>> {
    let key = Key::new(seed, Purpose::WaveScatterers);
    let surfaces = (0..surfaces).into_par_iter();
    surfaces
        .map(|k| line.seen(&line.surface(key.with(k))))
        .collect()
}

/// Images of surfaces before and after each has moved by `way` (mm), under a laser and a camera that do
/// not.
///
/// # Errors
/// As [`pupil_field`].
pub fn line_images_moved(
    line: &DefocusedLine,
    way: DVec3,
    surfaces: u64,
    seed: u64,
) -> Result<Vec<[Block; 2]>> {
    let key = Key::new(seed, Purpose::WaveScatterers);
    let pair = |k| {
        let points = line.surface(key.with(k));
        let after = moved(&points, DVec3::ZERO, DVec3::ZERO, way);
        Ok([line.seen(&points)?, line.seen(&after)?])
    };
    (0..surfaces).into_par_iter().map(pair).collect()
}

/// Mean light of each row over the speckle of all surfaces, in rows as [`line_images`] has them and of the sum 1: the
/// incoherent sum of the images of scatterers across the line, each by exact paths.
///
/// # Errors
/// As [`pupil_field`].
pub fn mean_line(line: &DefocusedLine) -> Result<Vec<f64>> {
    // Points so close that their sum over a Gaussian line, and over what the pupil passes of
    // intensities, is the integral.
    let spacing = (line.sigma / 2.0).min(0.45);
    let last = (LIT * line.sigma / spacing) as i32;
    let images = (-last..=last).into_par_iter().map(|k| {
        let place = k as f64 * spacing;
        let scatterer = Scatterer {
            position: DVec3::Y * place * line.grain_mm(),
            amplitude: (-0.25 * (place / line.sigma).powi(2)).exp(),
            light_path: 0.0,
        };
        let image = line.image(&[scatterer])?;
        let pixels = image.grid.pixels as isize;
        let half = (pixels - 1) / 2;
        let row = |y: isize| {
            (0..pixels)
                .map(|x| image.at(x - pixels / 2, y))
                .sum::<f64>()
        };
        Ok((-half..=half).map(row).collect::<Vec<f64>>())
    });
    let mut sum: Vec<f64> = Vec::new();
    for rows in images.collect::<Result<Vec<_>>>()? {
        sum.resize(rows.len(), 0.0);
        sum.iter_mut().zip(rows).for_each(|(sum, row)| *sum += row);
    }
    let all: f64 = sum.iter().sum();
    Ok(sum.into_iter().map(|row| row / all).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::sinc;
    use crate::speckle::theory::defocus_noise;
    use crate::wave::columns::{Measured, line_figures};
    use std::f64::consts::TAU;

    fn line(aperture: Aperture, sigma: f64, blur: f64) -> DefocusedLine {
        DefocusedLine {
            aperture,
            sigma,
            blur,
            pixels_per_grain: 4,
        }
    }

    /// A square's transfer across the line is (1 − |ν|)·sinc(bν(1 − |ν|)) at ν cycles a grain (Hopkins 1955), the line's
    /// exp(−2π²σ²ν²), a pixel's sinc(ν/4); the image is periodic, so they are the terms of a
    /// series. The light past four standard deviations, e⁻⁸ of the peak, is missing, and L_f's cosines
    /// are 1 to (D/L)²: 1e-3 of the peak together.
    #[test]
    fn the_mean_line_behind_a_square_is_its_closed_form() {
        for (sigma, blur) in [(1.0, 0.0), (1.0, 4.0), (2.0, -8.0), (0.5, 4.0)] {
            let line = line(Aperture::Square, sigma, blur);
            let found = mean_line(&line).unwrap();
            let side = line.side();
            let transfer = |nu: f64| {
                let shared = 1.0 - nu;
                let spread = shared * sinc(blur * nu * shared) * sinc(nu / 4.0);
                spread * (-0.5 * (TAU * sigma * nu).powi(2)).exp()
            };
            let peak = found.iter().copied().fold(0.0, f64::max);
            for (row, found) in found.iter().enumerate() {
                let place = (row as f64 - (found_middle(&line)) as f64) / 4.0;
                let terms = (1..side as usize).map(|k| k as f64 / side);
                let waves = terms.map(|nu| 2.0 * transfer(nu) * (TAU * nu * place).cos());
                let expected = (1.0 + waves.sum::<f64>()) / (4.0 * side);
                assert!(
                    (found - expected).abs() < 1e-3 * peak,
                    "{line:?} {place}: {found} {expected}"
                );
            }
        }
    }

    fn found_middle(line: &DefocusedLine) -> usize {
        (line.side() as usize * line.pixels_per_grain - 1) / 2
    }

    /// Defocus adds κ²·b²·h/σ to the centroid's variance; contrast stays 1 but for pixels, 0.975; the mean of
    /// all images is the incoherent sum; and grains have the lengths of the simulations that this project
    /// began with, 2.11 h across and 0.91 h along a line of σ = 4h at b = 8σ, with what pixels add, 8 ln 2·2/(12·4²) of the square; two
    /// digits and Gaussian shapes leave 3 %. Five standard errors: of 46 surfaces or more one number in 10⁵ lies
    /// further off, fixed seeds.
    #[test]
    fn speckle_out_of_focus_is_that_of_theory() {
        let figures = |line: &DefocusedLine, seed| {
            let surfaces = (3000.0 / line.columns_grains()).ceil() as u64;
            line_figures(&line_images(line, surfaces, seed).unwrap(), &line.window())
        };
        let square = |m: Measured| (m.value.powi(2) / 16.0, 2.0 * m.value * m.error / 16.0);
        for aperture in [Aperture::Circle, Aperture::Square] {
            let blur = 8.0;
            let [sharp, blurred] = [0.0, blur].map(|blur| line(aperture, 2.0, blur));
            let (before, after) = (figures(&sharp, 1), figures(&blurred, 2));
            let ((before, e), (with, f)) = (square(before.noise), square(after.noise));
            let kappa = defocus_noise(aperture, 0.25, 2.0);
            let expected = (kappa * blur).powi(2) / 2.0;
            let (added, error) = (with - before, e.hypot(f));
            assert!(
                (added - expected).abs() < 5.0 * error,
                "{aperture:?}: {added} ± {error}, {expected}"
            );
            assert!(
                error < 0.06 * expected,
                "{aperture:?}: {error} of {expected}"
            );
            for contrast in [after.contrast, after.contrast_beside] {
                let off = (contrast.value / 0.975 - 1.0).abs();
                assert!(
                    off < 0.01 + 5.0 * contrast.error,
                    "{aperture:?}: {contrast:?}"
                );
            }
            let mean = mean_line(&blurred).unwrap();
            let reach = blurred.window().reach;
            let middle = found_middle(&blurred);
            let of_sum: f64 = mean[middle - reach..=middle + reach].iter().sum();
            let of_images: f64 = after.mean.iter().sum();
            let peak = mean[middle] / of_sum;
            for (found, exact) in after.mean.iter().zip(&mean[middle - reach..]) {
                let off = (found / of_images - exact / of_sum).abs() / peak;
                assert!(
                    off < 5.0 * after.light.error / after.light.value,
                    "{aperture:?}: {off}"
                );
            }
        }
        let wide = figures(&line(Aperture::Circle, 4.0, 32.0), 3);
        for (found, simulated) in [(wide.grain_across, 2.11f64), (wide.grain_along, 0.91)] {
            let expected = 4.0 * (simulated * simulated + 8.0 * 2f64.ln() / 96.0).sqrt();
            let off = (found.value - expected).abs();
            assert!(
                off < 0.03 * expected + 5.0 * found.error,
                "{found:?}: {expected}"
            );
        }
    }
}
