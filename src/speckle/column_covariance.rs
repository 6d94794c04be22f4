//! Covariance of the irradiance of pixel strips in one column, for many strips.

use super::theory::{effective_pixel_fraction, lagrange, triangle};
use crate::math::Aperture;
use crate::math::{DMat2, DVec2};

/// Table of R(v) = ∫Λ(x)·μ²(G·(x, v)) dx at uniform steps of v ≥ 0.
///
/// R is the covariance of a column's irradiance at two heights separated by v, integrated over the
/// width of the column. It is even in v. The [`strip_covariance`](super::theory::strip_covariance)
/// of strips of one column is therefore ∫Λ(y)·R(high·y + lag) dy, one integral instead of two.
#[derive(Debug, Clone)]
pub struct ColumnCovariance {
    /// Grains per pixel along the column.
    grains: f64,
    /// Fraction of the pixel that represents the full pixel.
    share: f64,
    /// R, beginning at v = −1 step.
    values: Vec<f64>,
}

/// Steps of v per grain. R has no frequency above √2 per grain (the diagonal of a square pupil). A
/// cubic through four steps therefore has an error below (2π√2/32)⁴·(9/16)/24 = 1.4e-4 of R(0).
const STEPS: f64 = 32.0;

impl ColumnCovariance {
    /// Creates the table for strips of pixels with `grains` per column and per row, in the axes of
    /// the pupil. The height of a strip plus the distance between strips is at most `reach` pixels.
    pub fn new(aperture: Aperture, grains: DMat2, reach: f64) -> ColumnCovariance {
        let across = [grains.x_axis.length(), grains.y_axis.length()];
        let share = effective_pixel_fraction(across);
        let columns = triangle(share * across[0]);
        // Grains larger than a million pixels are constant within a strip.
        let along = (share * across[1]).max(1e-6);
        let at = |step: f64| {
            let row = columns.iter().map(|&(x, w)| {
                let place = DVec2::new(x, step / (STEPS * along));
                let mu = aperture.field_correlation(share * (grains * place));
                w * mu * mu
            });
            row.sum::<f64>() * share
        };
        let steps = (reach * along * STEPS).ceil() as i32 + 2;
        ColumnCovariance {
            grains: along,
            share,
            values: (-1..=steps).map(|step| at(step as f64)).collect(),
        }
    }

    /// Returns R at a distance of v pixels.
    fn at(&self, v: f64) -> f64 {
        lagrange(&self.values, v.abs() * self.grains * STEPS)
    }

    /// Returns the covariances of strips `high` pixels high at each of the distances `lags`,
    /// pixels.
    pub fn of(&self, high: f64, lags: impl Iterator<Item = f64>) -> Vec<f64> {
        let rows = triangle(self.grains * high);
        let at = |lag: f64| {
            let row = rows.iter().map(|&(y, w)| w * self.at(high * y + lag));
            row.sum::<f64>() * self.share
        };
        lags.map(at).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use crate::speckle::theory::strip_covariance;

    /// Random grains of all sizes and directions are compared with the integral over both
    /// directions. The tolerance is the bound of the cubic, for a triangle of weight 1.
    #[test]
    fn it_is_the_double_integral() {
        let key = RngKey::new(11, Purpose::SpecklePattern);
        for case in 0..12 {
            let between =
                |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(8 * case + k);
            let turn = DMat2::from_angle(between(0, 0.0, 3.0));
            let long = between(1, -2.0, 1.5).exp();
            let grains = turn
                * DMat2::from_cols_array(&[long, 0.0, between(2, -0.5, 0.5) * long, 1.4 * long]);
            let parts = 1.0 + between(3, 0.0, 9.0).floor();
            let aperture = [Aperture::Circle, Aperture::Square][case as usize % 2];
            let table = ColumnCovariance::new(aperture, grains, 5.0);
            let bound = 1.4e-4 * table.at(0.0);
            for lag in [0.0, 1.0, 3.0, 3.0 * parts] {
                let lag = lag / parts;
                let found = table.of(1.0 / parts, std::iter::once(lag))[0];
                let sum = strip_covariance(aperture, grains, 1.0 / parts, DVec2::Y * lag);
                assert!(
                    (found - sum).abs() < bound,
                    "{grains} {parts} {lag}: {found} {sum}"
                );
            }
        }
    }
}
