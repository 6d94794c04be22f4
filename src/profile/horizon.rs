//! Lines that an edge truncates gradually over many columns.
//!
//! An example is a horizon of the part at grazing incidence of the laser plane. The light decreases
//! so slowly that adjacent columns look alike. Therefore, lines are compared with the brightest
//! part of the frame.

use super::neighbourhood::Neighbourhood;
use super::slope::{LineSlope, VARIANCE_OF_A_CLIMB};
use super::truncation::{TruncatedGaussian, truncated_gaussian};
use super::{Flags, Peak};
use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::LazyLock;

/// Number of columns on either side over which light and width are averaged; the window contains a
/// few grains.
const AVERAGING_COLUMNS: usize = 8;
/// Minimum number of columns with a line, out of at most 65, in the brightest part of the frame.
const MIN_RUN_COLUMNS: usize = 32;

/// Ratio of light to width below which a line is compared with truncated lines.
///
/// On a Lambertian surface that turns away from the camera, light and line width decrease in
/// proportion. In addition, the light decreases with the cosine of the incidence angle. An edge
/// that leaves 0.4 of a line causes the additional loss of incidence at 45°. Below this ratio, an
/// intact surface is at grazing incidence. The value was chosen together with [`AVERAGING_COLUMNS`]
/// and [`UNFLAGGED_SHIFT_SIGMAS`] from sixteen settings on the ten scenes of
/// `tests/points/silent_outliers/scenes.rs`, and was tested on random scenes.
const LIGHT_TO_WIDTH: f64 = FRAC_1_SQRT_2;

/// Possible shift by an edge, in standard uncertainties, above which a point gets
/// [`Flags::DISCONTINUITY`].
///
/// An outlier deviates by three expanded uncertainties, which is six standard uncertainties. The
/// limit is half of this value, because light and width are averaged over columns between which
/// they change.
pub(super) const UNFLAGGED_SHIFT_SIGMAS: f64 = 3.0;

/// Returns the possible shift of the centroid of each peak by an edge, px.
///
/// The edge is assumed to cause the observed ratios of light and width between the surrounding
/// columns and the brightest part of the frame. The shift is 0 if the light or the width is too
/// large for an edge, or if no reference exists.
pub(super) fn offsets(peaks: &[Peak], runs: &[LineSlope]) -> Vec<f64> {
    let columns = peaks.last().map_or(0, |p| p.column as usize + 1);
    let single = |p: &Peak| {
        !p.flags
            .intersects(Flags::MULTIPLE_PEAKS | Flags::WIDE | Flags::IMAGE_BORDER)
    };
    let of = |square: &dyn Fn(&Peak, &LineSlope) -> f64| {
        let lines = peaks.iter().zip(runs).filter(|(p, _)| single(p));
        // `Neighbourhood` averages squares.
        Neighbourhood::new(
            columns,
            lines.map(|(p, run)| (p.column, square(p, run).max(0.0).sqrt())),
        )
    };
    let lights = of(&|p, _| p.intensity);
    let spreads =
        of(&|p, run| p.intensity * (p.sigma.powi(2) - run.slope.powi(2) * VARIANCE_OF_A_CLIMB));
    // Mean light, and variance of the light about the line centroids.
    let mean = |column: u32, reach: usize| {
        let (count, light) = lights.within(column, reach);
        let (light, spread) = (light?.powi(2), spreads.within(column, reach).1?.powi(2));
        (light > 0.0).then(|| (count, light, spread / light))
    };
    let stretches = peaks
        .iter()
        .filter_map(|p| mean(p.column, 4 * AVERAGING_COLUMNS));
    let brightest = stretches
        .filter(|&(count, ..)| count >= MIN_RUN_COLUMNS)
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let Some((_, whole_light, whole)) = brightest.filter(|&(.., variance)| variance > 0.0) else {
        return vec![0.0; peaks.len()];
    };
    let offset = |p: &Peak| {
        let (_, light, variance) = mean(p.column, AVERAGING_COLUMNS)?;
        let (light, width) = (light / whole_light, variance / whole);
        (light < LIGHT_TO_WIDTH * width.sqrt()).then(|| offset(light, width) * whole.sqrt())
    };
    peaks.iter().map(|p| offset(p).unwrap_or(0.0)).collect()
}

/// Gaussians of unit width truncated at 4097 positions from −6 to 6 σ. The error of linear
/// interpolation of the centroid is below 1e-5 σ, well below the error of a row.
static REMNANTS: LazyLock<Vec<TruncatedGaussian>> = LazyLock::new(|| {
    let places = 0..=4096;
    places
        .map(|i| truncated_gaussian(-6.0 + 12.0 * i as f64 / 4096.0))
        .collect()
});

/// Returns the greatest centroid shift of a truncated Gaussian of unit width whose light and
/// variance are not below the given values.
fn offset(light: f64, variance: f64) -> f64 {
    // Light and variance both decrease along the table.
    let next = REMNANTS.partition_point(|left| left.light > light && left.variance > variance);
    let (Some(next), Some(last)) = (REMNANTS.get(next), REMNANTS.get(next.wrapping_sub(1))) else {
        return truncated_gaussian(if next == 0 { -6.0 } else { 6.0 }).centroid_shift;
    };
    let share =
        |of: fn(&TruncatedGaussian) -> f64, is: f64| (of(last) - is) / (of(last) - of(next));
    let share = share(|left| left.light, light).min(share(|left| left.variance, variance));
    last.centroid_shift + share * (next.centroid_shift - last.centroid_shift)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the shifts for a line of σ = 2 px that an edge gradually truncates over 100 columns.
    fn cut_line(share: impl Fn(f64) -> (f64, f64)) -> Vec<f64> {
        let peak = |column: u32| {
            let along = (column as f64 - 100.0) / 100.0;
            let (light, variance) = if along < 0.0 {
                (1.0, 1.0)
            } else {
                share(along)
            };
            Peak {
                column,
                row: 10.0,
                intensity: 1e4 * light,
                height: 1e3,
                sigma: 2.0 * variance.sqrt(),
                noise: 1.0,
                flags: Flags::empty(),
            }
        };
        let peaks: Vec<Peak> = (0..200).map(peak).collect();
        offsets(&peaks, &vec![LineSlope::default(); peaks.len()])
    }

    /// The shift of an edge that moves from −1 to 3 σ agrees with the truncation in each column.
    ///
    /// The tolerance is the change over 17 columns, 0.68 σ. Where more than 0.4 of the light
    /// remains, the shift is 0.
    #[test]
    fn a_slow_cut_is_found_by_the_brightest_stretch() {
        let z = |along: f64| 4.0 * along - 1.0;
        let found = cut_line(|along| {
            (
                truncated_gaussian(z(along)).light,
                truncated_gaussian(z(along)).variance,
            )
        });
        assert!(found[..130].iter().all(|&off| off == 0.0));
        for (column, off) in found.iter().enumerate().take(190).skip(142) {
            let z = z((column as f64 - 100.0) / 100.0);
            let (least, most) = (
                truncated_gaussian(z - 0.34).centroid_shift,
                truncated_gaussian(z + 0.34).centroid_shift,
            );
            assert!((2.0 * least..2.0 * most).contains(off), "{column} {off}");
        }
    }

    /// The table agrees with a bisection of the formula.
    #[test]
    fn the_table_of_remnants_is_their_formula() {
        for i in 0..200 {
            for j in 0..50 {
                let (light, variance) = (1e-6f64.powf(i as f64 / 199.0), 0.02 * (j + 1) as f64);
                let (mut low, mut high) = (-6.0, 6.0);
                for _ in 0..60 {
                    let z = (low + high) / 2.0;
                    let left = truncated_gaussian(z);
                    match left.light > light && left.variance > variance {
                        true => low = z,
                        false => high = z,
                    }
                }
                let (is, exact) = (
                    offset(light, variance),
                    truncated_gaussian(low).centroid_shift,
                );
                assert!(
                    (is - exact).abs() < 1e-5,
                    "{light} {variance}: {is} {exact}"
                );
            }
        }
    }

    /// A surface that turns away from the camera loses light and width in proportion and is not
    /// flagged.
    #[test]
    fn a_foreshortened_line_is_not_taken_for_a_cut_one() {
        let found = cut_line(|along| (1.0 - 0.9 * along, (1.0 - 0.9 * along).powi(2)));
        assert!(found.iter().all(|&off| off == 0.0), "{found:?}");
        assert!(offsets(&[], &[]).is_empty());
    }
}
