//! What is doubtful about a peak: all flags of a frame are set here.

use super::neighbourhood::Neighbourhood;
use super::slope::{VARIANCE_OF_A_CLIMB, slope, touching};
use super::uncertainty::RowError;
use super::{Flags, Peak, PeakSettings};

/// A line is weak below this share of the median height of the frame's lines: a
/// Gaussian beam of which an edge leaves this is lit beyond 2.4 σ only.
pub const WEAK_SHARE: f64 = 0.05;

/// A line is weak below this many times the background's noise.
pub const WEAK_SNR: f64 = 10.0;

/// A line is wide above this many times the width of the frame's lines, climbing as it does.
pub const WIDE_RATIO: f64 = 2.0;

/// A line that is narrower, over five columns, than this share of those around, or these than
/// of what is expected, is the tail that an edge along it leaves: of a Gaussian cut beyond 1.5 σ. What the
/// lens adds to widths is left out; of lines that it makes more than twice as wide, squared, nothing is
/// said, as speckle's own width then decides.
pub const NARROW_RATIO: f64 = 0.4;

/// Of a line by itself: whether its column has another, is saturated, and has its window on the
/// sensor (`inside`).
pub(super) fn of_line(double: bool, saturated: bool, inside: bool) -> Flags {
    let mut flags = Flags::empty();
    flags.set(Flags::DOUBLE, double);
    flags.set(Flags::SATURATED, saturated);
    flags.set(Flags::BORDER, !inside);
    flags
}

/// Sets the flags that compare a line with its neighbours and with the others.
pub fn compare_neighbours(peaks: &mut [Peak], columns: usize, settings: &PeakSettings) {
    let expected_sigma = settings.expected_sigma;
    let of_lens = settings.lens_sigma.powi(2);
    let sharp = |sigma: f64| (sigma * sigma - of_lens).max(0.0).sqrt();
    let height = median(peaks.iter().map(|p| p.height));
    let sigma = median(peaks.iter().map(|p| p.sigma)).max(expected_sigma);
    let widths = Neighbourhood::new(columns, peaks.iter().map(|p| (p.column, p.sigma)));
    for i in 0..peaks.len() {
        let peak = &peaks[i];
        let before = i.checked_sub(1).map(|i| &peaks[i]);
        let before = before.filter(|before| touching(before, peak, sigma));
        let after = peaks
            .get(i + 1)
            .filter(|after| touching(peak, after, sigma));
        let first = peak.column == 0;
        let last = peak.column as usize + 1 == columns;
        let unbroken = (first || before.is_some()) && (last || after.is_some());
        let climb = slope(before, peak, after).powi(2) * VARIANCE_OF_A_CLIMB;
        let weak = peak.height < (WEAK_SHARE * height).max(WEAK_SNR * peak.noise);
        let wide = peak.sigma > WIDE_RATIO * (sigma * sigma + climb).sqrt();
        // A column by itself may be as narrow as a grain.
        let beside = widths.beside(peak.column).unwrap_or(peak.sigma);
        let around = widths.around(peak.column).1.unwrap_or(peak.sigma);
        let (beside, around) = (sharp(beside), sharp(around));
        let narrow = expected_sigma >= settings.lens_sigma
            && (beside < NARROW_RATIO * around || around < NARROW_RATIO * expected_sigma);
        let flags = &mut peaks[i].flags;
        flags.set(Flags::EDGE, !unbroken || narrow);
        flags.set(Flags::WEAK, weak);
        flags.set(Flags::WIDE, wide);
    }
}

/// Sets the flags that the uncertainties of a frame's peaks speak for: [`Flags::OUTSIDE`] of those
/// for which none is valid. Takes [`Flags::SATURATED`] from lines that keep enough of their light,
/// [`Flags::EDGE`] from those that can be compared with whole lines around them, and
/// [`Flags::WEAK`] from those that stand out from noise and are weak because an edge cuts them: what
/// is stated holds for them. Sets [`Flags::EDGE`] where one may cut the line unseen.
pub fn weigh(peaks: &mut [Peak], errors: &[RowError]) {
    for (peak, error) in peaks.iter_mut().zip(errors) {
        let flags = &mut peak.flags;
        if error.keeps_light {
            flags.remove(Flags::SATURATED);
        }
        if error.compared {
            flags.remove(Flags::EDGE);
        }
        if error.is_cut && peak.height >= WEAK_SNR * peak.noise {
            flags.remove(Flags::WEAK);
        }
        // Whether an edge is near is for neighbouring frames to say.
        let other = Flags::OUTSIDE | Flags::EDGE;
        let inside = flags.difference(other).is_empty() && error.is_valid;
        flags.set(Flags::OUTSIDE, !inside);
        if error.cut_unseen {
            flags.insert(Flags::EDGE);
        }
    }
}

/// The middle value, the upper of two; 0 of none.
pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    match values.is_empty() {
        true => 0.0,
        false => *values.select_nth_unstable_by(middle, f64::total_cmp).1,
    }
}
