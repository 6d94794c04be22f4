//! Lines that an edge may cut over many columns, as a horizon of the part does that the sheet
//! grazes: what is left of them thins out so slowly that neighbours look alike. They are held
//! against the frame's brightest stretch instead.

use super::cut::{Left, beyond};
use super::neighbourhood::Neighbourhood;
use super::slope::{Run, VARIANCE_OF_A_CLIMB};
use super::{Flags, Peak};
use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::LazyLock;

/// Columns to either side over which light and width are averaged: speckle leaves a few grains.
const NEAR: usize = 8;
/// Columns, of some 65, in which the brightest stretch has a line.
const LEAST: usize = 32;

/// A surface that turns away from the camera loses as much light, by Lambert's law, as its line
/// loses width, but for the cosine of the light's incidence, by which it loses more. An edge that
/// leaves 0.4 of a line takes as much more as incidence at 45°: past this ratio of light to width,
/// a surface that is whole grazes the light. Chosen with [`NEAR`] and [`UNSAID`] among sixteen
/// settings on the ten scenes of `tests/silent_outliers/scenes.rs`, and tested on drawn ones.
const LIGHT_TO_WIDTH: f64 = FRAC_1_SQRT_2;

/// Standard uncertainties beyond which what an edge may have moved a point by does not go without
/// a word. Three expanded ones, six of these, are far off; half of that, since the shares are means
/// over columns between which they change.
pub(super) const UNSAID: f64 = 3.0;

/// How far off an edge would have moved the centroid of each peak if it left as much light and
/// width as the columns around have beside those of the brightest stretch, px; 0 where there is
/// too much of either for an edge, or nothing to compare with.
pub(super) fn offsets(peaks: &[Peak], runs: &[Run]) -> Vec<f64> {
    let columns = peaks.last().map_or(0, |p| p.column as usize + 1);
    let single = |p: &Peak| {
        !p.flags
            .intersects(Flags::DOUBLE | Flags::WIDE | Flags::BORDER)
    };
    let of = |square: &dyn Fn(&Peak, &Run) -> f64| {
        let lines = peaks.iter().zip(runs).filter(|(p, _)| single(p));
        // Means are of squares.
        Neighbourhood::new(
            columns,
            lines.map(|(p, run)| (p.column, square(p, run).max(0.0).sqrt())),
        )
    };
    let lights = of(&|p, _| p.intensity);
    let spreads =
        of(&|p, run| p.intensity * (p.sigma.powi(2) - run.slope.powi(2) * VARIANCE_OF_A_CLIMB));
    // Mean light, and the variance that all of it has about the lines' centroids.
    let mean = |column: u32, reach: usize| {
        let (count, light) = lights.within(column, reach);
        let (light, spread) = (light?.powi(2), spreads.within(column, reach).1?.powi(2));
        (light > 0.0).then(|| (count, light, spread / light))
    };
    let stretches = peaks.iter().filter_map(|p| mean(p.column, 4 * NEAR));
    let brightest = stretches
        .filter(|&(count, ..)| count >= LEAST)
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let Some((_, whole_light, whole)) = brightest.filter(|&(.., variance)| variance > 0.0) else {
        return vec![0.0; peaks.len()];
    };
    let offset = |p: &Peak| {
        let (_, light, variance) = mean(p.column, NEAR)?;
        let (light, width) = (light / whole_light, variance / whole);
        (light < LIGHT_TO_WIDTH * width.sqrt()).then(|| offset(light, width) * whole.sqrt())
    };
    peaks.iter().map(|p| offset(p).unwrap_or(0.0)).collect()
}

/// Remnants of a Gaussian of unit width at so many places from −6 to 6 σ: what is between two moves a
/// centroid by less than 1e-5 σ beside their mean, which is far less than a row's own error.
static REMNANTS: LazyLock<Vec<Left>> = LazyLock::new(|| {
    let places = 0..=4096;
    places
        .map(|i| beyond(-6.0 + 12.0 * i as f64 / 4096.0))
        .collect()
});

/// Of the remnants of a Gaussian of unit width that have this light and variance or more, the
/// greatest distance of the centroid from the whole line's.
fn offset(light: f64, variance: f64) -> f64 {
    // Both become less from one to the next.
    let next = REMNANTS.partition_point(|left| left.light > light && left.variance > variance);
    let (Some(next), Some(last)) = (REMNANTS.get(next), REMNANTS.get(next.wrapping_sub(1))) else {
        return beyond(if next == 0 { -6.0 } else { 6.0 }).off;
    };
    let share = |of: fn(&Left) -> f64, is: f64| (of(last) - is) / (of(last) - of(next));
    let share = share(|left| left.light, light).min(share(|left| left.variance, variance));
    last.off + share * (next.off - last.off)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of σ = 2 px of which an edge leaves less and less along 100 columns.
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
        offsets(&peaks, &vec![Run::default(); peaks.len()])
    }

    /// An edge that passes from −1 to 3 σ: each column's offset is that of its own remnant, to
    /// what 17 columns, 0.68 σ, change of it; where more than 0.4 is left, none is claimed.
    #[test]
    fn a_slow_cut_is_found_by_the_brightest_stretch() {
        let z = |along: f64| 4.0 * along - 1.0;
        let found = cut_line(|along| (beyond(z(along)).light, beyond(z(along)).variance));
        assert!(found[..130].iter().all(|&off| off == 0.0));
        for (column, off) in found.iter().enumerate().take(190).skip(142) {
            let z = z((column as f64 - 100.0) / 100.0);
            let (least, most) = (beyond(z - 0.34).off, beyond(z + 0.34).off);
            assert!((2.0 * least..2.0 * most).contains(off), "{column} {off}");
        }
    }

    /// Against the bisection of what the remnants leave.
    #[test]
    fn the_table_of_remnants_is_their_formula() {
        for i in 0..200 {
            for j in 0..50 {
                let (light, variance) = (1e-6f64.powf(i as f64 / 199.0), 0.02 * (j + 1) as f64);
                let (mut low, mut high) = (-6.0, 6.0);
                for _ in 0..60 {
                    let z = (low + high) / 2.0;
                    let left = beyond(z);
                    match left.light > light && left.variance > variance {
                        true => low = z,
                        false => high = z,
                    }
                }
                let (is, exact) = (offset(light, variance), beyond(low).off);
                assert!(
                    (is - exact).abs() < 1e-5,
                    "{light} {variance}: {is} {exact}"
                );
            }
        }
    }

    /// A surface that turns away from the camera loses light and width alike.
    #[test]
    fn a_foreshortened_line_is_not_taken_for_a_cut_one() {
        let found = cut_line(|along| (1.0 - 0.9 * along, (1.0 - 0.9 * along).powi(2)));
        assert!(found.iter().all(|&off| off == 0.0), "{found:?}");
        assert!(offsets(&[], &[]).is_empty());
    }
}
