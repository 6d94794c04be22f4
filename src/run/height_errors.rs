//! How far heights are from others of the same columns, and how surely that is known.

use crate::math::DVec2;
use crate::profile::{Calibration, Flags, Peak};
use serde::Serialize;

/// Medians and percentiles, as single points at edges may be anywhere.
#[derive(Debug, Clone, Serialize)]
pub struct HeightErrors {
    /// Columns in which one of the two at least has a line that is valid but perhaps for an edge.
    pub points: usize,
    /// Median, µm; positive: nearer to the laser.
    pub bias_um: f64,
    /// Half of what holds the middle 68.3 of 100 differences, µm.
    pub noise_um: f64,
    /// 99 of 100 are within ± this, µm, points that one of the two lacks being beyond all;
    /// `None` if these are more, and without points.
    pub within_um: Option<f64>,
    /// Share that one of the two lacks.
    pub lost: f64,
    /// Differences, µm, in rising order; infinite where one of the two has no line.
    #[serde(skip)]
    sorted: Vec<f64>,
    /// Their sizes part by part: what is side by side errs alike.
    #[serde(skip)]
    parts: Vec<Vec<f64>>,
}

/// Confidence at which a share is at most what is said: one-sided, 95 %.
const CONFIDENCE_SIGMAS: f64 = 1.644_854;
/// Share of the points, those that err most, that tells how errors gather in few parts.
const LARGEST: f64 = 0.05;

impl HeightErrors {
    /// Of `found` against `truth`, part by part (frames, or columns of one), each in the order
    /// of columns. `sign`: of a height for a row.
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
            // Whether an edge is near is for the whole frame and its neighbours to say.
            let valid = |peak: Option<&Peak>| {
                peak.is_some_and(|peak| peak.flags.difference(Flags::EDGE).is_valid())
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
            bias_um: at_share(there, 0.5),
            noise_um: (at_share(there, 0.8413) - at_share(there, 0.1587)) / 2.0,
            within_um: Some(at_share(&sizes, 0.99))
                .filter(|um| um.is_finite() && !sizes.is_empty()),
            lost: missing as f64 / sorted.len().max(1) as f64,
            sorted,
            parts,
        }
    }

    /// 99 of 100 of the points that both have are within ± this, µm; `None` without any.
    pub fn within_of_both(&self) -> Option<f64> {
        let there = self.sorted.iter().filter(|d| d.is_finite());
        let mut sizes: Vec<f64> = there.map(|d| d.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        (!sizes.is_empty()).then(|| at_share(&sizes, 0.99))
    }

    /// Share of points beyond ± `um`, those that one of the two lacks among them.
    pub fn share_beyond(&self, um: f64) -> f64 {
        let beyond = self.sorted.iter().filter(|d| d.abs() > um).count();
        beyond as f64 / self.sorted.len().max(1) as f64
    }

    /// Upper limit, at 95 % confidence, of the share beyond ± `um` of all the points of which
    /// these are a part, `left` of them not looked at: the score interval (Wilson 1927) for as
    /// many independent points as tell as much (Korn and Graubard 1998), fewer than there are
    /// by the design effect, and more where few are left. 1 without
    /// points.
    pub fn share_at_most(&self, um: f64, left: f64) -> f64 {
        if self.points == 0 {
            return 1.0;
        }
        let share = self.share_beyond(um);
        let independent = self.points as f64 / (self.design_effect(um) * left.max(1e-9));
        let z2 = CONFIDENCE_SIGMAS * CONFIDENCE_SIGMAS / independent;
        let spread = (z2 * (share * (1.0 - share) + z2 / 4.0)).sqrt();
        ((share + z2 / 2.0 + spread) / (1.0 + z2)).min(1.0)
    }

    /// Variance of a share of points, taken part by part, over that of as many independent
    /// points (Kish 1965), at least 1: of those beyond ± `um`, or of the [`LARGEST`] if that
    /// is more, since those beyond may be too few to tell.
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

/// The value that so many of the others lie below; 0 of none.
pub(crate) fn at_share(sorted: &[f64], share: f64) -> f64 {
    match sorted {
        [] => 0.0,
        _ => sorted[((sorted.len() - 1) as f64 * share).round() as usize],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    /// Parts of 64 points of which runs err together: the limit of the share is passed by the
    /// true share of 2 % in 5 of 100 draws, in twice as many where the normal law of few runs is
    /// a rough one. Of 400 draws the number has a standard deviation below 6.
    #[test]
    fn a_share_is_at_most_what_is_said() {
        for run in [1, 4, 16] {
            let missed = (0..400).filter(|&draw| {
                let key = Key::new(draw, Purpose::SensorNoise).with(run as u64);
                let size = |i: usize| {
                    let u = key.uniform((i / run) as u64);
                    if u < 0.02 { 2.0 } else { u / 2.0 }
                };
                let parts = (0..48).map(|p| (0..64).map(|i| size(64 * p + i)).collect());
                let errors = HeightErrors::from_parts(parts.collect());
                errors.share_at_most(1.0, 1.0) < 0.02
            });
            let missed = missed.count();
            assert!((1..=40 + 3 * 6).contains(&missed), "{run}: {missed}");
        }
    }

    /// All points looked at: the share is known. None beyond of 300 independent ones: at most
    /// 0.9 %, z²/(n + z²).
    #[test]
    fn a_share_of_few_or_of_all_points() {
        let size = |i: usize| (i % 7) as f64;
        let some = HeightErrors::from_parts((0..300).map(|i| vec![size(i)]).collect());
        let z2 = CONFIDENCE_SIGMAS.powi(2);
        let limit = some.share_at_most(10.0, 1.0) - z2 / (300.0 + z2);
        assert!((-1e-12..1e-3).contains(&limit), "{limit}");
        let share = some.share_beyond(5.0);
        assert!((some.share_at_most(5.0, 0.0) - share).abs() < 1e-4);
        assert_eq!(
            HeightErrors::from_parts(Vec::new()).share_at_most(1.0, 1.0),
            1.0
        );
    }
}
