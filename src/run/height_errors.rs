//! Height differences between two sets of peaks in the same columns, with confidence limits.

use crate::math::DVec2;
use crate::profile::{Calibration, Flags, Peak};
use serde::Serialize;

/// Height differences as medians and percentiles, because single points at edges may have any
/// error.
#[derive(Debug, Clone, Serialize)]
pub struct HeightErrors {
    /// Number of columns in which at least one set has a line without flags other than DISCONTINUITY.
    pub points: usize,
    /// Median, µm; positive towards the laser.
    pub median_error_um: f64,
    /// Half-width of the central 68.3 % of the differences, µm.
    pub half_width_68_um: f64,
    /// 99 % quantile of the absolute differences, µm. Points that one set lacks count as infinite;
    /// `None` if the quantile is infinite, and without points.
    pub percentile_99_um: Option<f64>,
    /// Fraction of points that one set lacks.
    pub lost: f64,
    /// Differences in ascending order, µm; infinite if one set has no line.
    #[serde(skip)]
    sorted: Vec<f64>,
    /// Absolute differences by part, because errors of adjacent columns are correlated.
    #[serde(skip)]
    parts: Vec<Vec<f64>>,
}

/// Normal quantile of the one-sided confidence level of 95 %.
const CONFIDENCE_SIGMAS: f64 = 1.644_854;
/// Fraction of the points with the largest errors that determines the clustering of errors in
/// parts.
const LARGEST: f64 = 0.05;

impl HeightErrors {
    /// Compares `found` with `truth` by part (frames, or column ranges of one), each in column
    /// order. `sign` is the sign of the height change per row.
    pub fn of(
        parts: &[(Vec<Peak>, Vec<Peak>)],
        calibration: &Calibration,
        sign: f64,
    ) -> HeightErrors {
        let um_per_px = |peak: &Peak| {
            let place = DVec2::new(peak.column as f64 + 0.5, peak.row);
            let jacobian = calibration.point_jacobian(place)?;
            Some(jacobian.by_pixel[1].length() * 1e3 * sign)
        };
        let difference = |found: Option<&Peak>, truth: Option<&Peak>| {
            // The flag DISCONTINUITY depends on the entire frame and its neighbours, so it is ignored here.
            let valid = |peak: Option<&Peak>| {
                peak.is_some_and(|peak| peak.flags.difference(Flags::DISCONTINUITY).is_valid())
            };
            if !valid(found) && !valid(truth) {
                return None;
            }
            match (found, truth) {
                (Some(found), Some(truth)) => Some((found.row - truth.row) * um_per_px(truth)?),
                _ => Some(f64::INFINITY),
            }
        };
        let part = |(found, truth): &(Vec<Peak>, Vec<Peak>)| {
            let mut differences = Vec::with_capacity(truth.len());
            let (mut found, mut truth) = (found.iter().peekable(), truth.iter().peekable());
            loop {
                let next = found.peek().into_iter().chain(truth.peek());
                let Some(column) = next.map(|peak| peak.column).min() else {
                    return differences;
                };
                let found = found.next_if(|peak| peak.column == column);
                let truth = truth.next_if(|peak| peak.column == column);
                differences.extend(difference(found, truth));
            }
        };
        HeightErrors::from_parts(parts.iter().map(part).collect())
    }

    fn from_parts(mut parts: Vec<Vec<f64>>) -> HeightErrors {
        let mut sorted = parts.concat();
        sorted.sort_by(f64::total_cmp);
        parts.iter_mut().flatten().for_each(|d| *d = d.abs());
        let missing = sorted.iter().filter(|d| d.is_infinite()).count();
        let there = &sorted[..sorted.len() - missing];
        let mut sizes = parts.concat();
        sizes.sort_by(f64::total_cmp);
        HeightErrors {
            points: sorted.len(),
            median_error_um: at_share(there, 0.5),
            half_width_68_um: (at_share(there, 0.8413) - at_share(there, 0.1587)) / 2.0,
            percentile_99_um: Some(at_share(&sizes, 0.99))
                .filter(|um| um.is_finite() && !sizes.is_empty()),
            lost: missing as f64 / sorted.len().max(1) as f64,
            sorted,
            parts,
        }
    }

    /// Returns the 99 % quantile of the absolute differences of points in both sets, µm; `None`
    /// without any.
    pub fn within_of_both(&self) -> Option<f64> {
        let there = self.sorted.iter().filter(|d| d.is_finite());
        let mut sizes: Vec<f64> = there.map(|d| d.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        (!sizes.is_empty()).then(|| at_share(&sizes, 0.99))
    }

    /// Returns the fraction of points beyond ± `um`, including points that one set lacks.
    pub fn share_beyond(&self, um: f64) -> f64 {
        let beyond = self.sorted.iter().filter(|d| d.abs() > um).count();
        beyond as f64 / self.sorted.len().max(1) as f64
    }

    /// Returns an upper limit of the fraction of all points beyond ± `um`, at 95 % confidence. The
    /// sample leaves a fraction `left` of all points unevaluated. Returns 1 without points.
    ///
    /// The limit is from the score interval (Wilson 1927) with an effective number of points (Korn
    /// and Graubard 1998). The design effect reduces this number, and a small `left` increases it.
    pub fn exceedance_upper_95(&self, um: f64, left: f64) -> f64 {
        if self.points == 0 {
            return 1.0;
        }
        let share = self.share_beyond(um);
        let independent = self.points as f64 / (self.design_effect(um) * left.max(1e-9));
        let z2 = CONFIDENCE_SIGMAS * CONFIDENCE_SIGMAS / independent;
        let spread = (z2 * (share * (1.0 - share) + z2 / 4.0)).sqrt();
        ((share + z2 / 2.0 + spread) / (1.0 + z2)).min(1.0)
    }

    /// Returns the design effect (Kish 1965), at least 1. It is the variance of a fraction over
    /// parts, relative to the variance for independent points. It refers to the points beyond ±
    /// `um` or to the [`LARGEST`], whichever are more, because points beyond the limit may be too
    /// few for an estimate.
    fn design_effect(&self, um: f64) -> f64 {
        let mut sizes = self.parts.concat();
        sizes.sort_by(f64::total_cmp);
        let limit = um.min(at_share(&sizes, 1.0 - LARGEST));
        let beyond = |part: &Vec<f64>| part.iter().filter(|&&size| size > limit).count() as f64;
        let total: f64 = self.parts.iter().map(beyond).sum();
        let points = self.points as f64;
        let share = total / points;
        let used = self.parts.iter().filter(|part| !part.is_empty()).count() as f64;
        if used < 2.0 || share <= 0.0 || share >= 1.0 {
            return 1.0;
        }
        let excess = |part: &Vec<f64>| (beyond(part) - share * part.len() as f64).powi(2);
        let between: f64 = self.parts.iter().map(excess).sum();
        (between * used / (used - 1.0) / (points * share * (1.0 - share))).max(1.0)
    }
}

/// Returns a quantile of a sorted slice, for a probability; 0 for an empty slice.
pub(crate) fn at_share(sorted: &[f64], share: f64) -> f64 {
    match sorted {
        [] => 0.0,
        _ => sorted[((sorted.len() - 1) as f64 * share).round() as usize],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// In parts of 64 points, runs of points have equal errors. The upper limit is exceeded by the
    /// true fraction of 2 % in 5 % of the draws. It is exceeded twice as often where few runs make
    /// the normal approximation rough. The number among 400 draws has a standard deviation below 6.
    #[test]
    fn a_share_is_at_most_what_is_said() {
        for run in [1, 4, 16] {
            let missed = (0..400).filter(|&draw| {
                let key = RngKey::new(draw, Purpose::SensorNoise).with(run as u64);
                let size = |i: usize| {
                    let u = key.uniform((i / run) as u64);
                    if u < 0.02 { 2.0 } else { u / 2.0 }
                };
                let parts = (0..48).map(|p| (0..64).map(|i| size(64 * p + i)).collect());
                let errors = HeightErrors::from_parts(parts.collect());
                errors.exceedance_upper_95(1.0, 1.0) < 0.02
            });
            let missed = missed.count();
            assert!((1..=40 + 3 * 6).contains(&missed), "{run}: {missed}");
        }
    }

    /// If all points are evaluated, the fraction is exact. With none of 300 independent points
    /// beyond, the limit is 0.9 %, z²/(n + z²).
    #[test]
    fn a_share_of_few_or_of_all_points() {
        let size = |i: usize| (i % 7) as f64;
        let some = HeightErrors::from_parts((0..300).map(|i| vec![size(i)]).collect());
        let z2 = CONFIDENCE_SIGMAS.powi(2);
        let limit = some.exceedance_upper_95(10.0, 1.0) - z2 / (300.0 + z2);
        assert!((-1e-12..1e-3).contains(&limit), "{limit}");
        let share = some.share_beyond(5.0);
        assert!((some.exceedance_upper_95(5.0, 0.0) - share).abs() < 1e-4);
        assert_eq!(
            HeightErrors::from_parts(Vec::new()).exceedance_upper_95(1.0, 1.0),
            1.0
        );
    }
}
