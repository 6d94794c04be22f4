//! Flags of the peaks of a frame: flags of single lines, flags from comparisons between lines, and
//! flags from uncertainties.

use super::neighbourhood::Neighbourhood;
use super::slope::{VARIANCE_OF_A_CLIMB, is_end, slope, touching};
use super::uncertainty::RowUncertainty;
use super::{Flags, Peak, PeakSettings};

/// Height below which a line is weak, as a fraction of the median height of the lines in the frame.
/// A Gaussian beam truncated to this fraction of its height is lit above 2.4 σ only.
pub const WEAK_SHARE: f64 = 0.05;

/// Height below which a line is weak, relative to the noise of the background.
pub const WEAK_SNR: f64 = 10.0;

/// Width above which a line is wide, relative to the other lines in the frame with equal slope.
pub const WIDE_RATIO: f64 = 2.0;

/// Width ratio below which a line is classified as a tail left by an edge.
///
/// The ratio compares the width over five columns with the surrounding lines, or the width of the
/// surrounding lines with the expected width. A Gaussian truncated at 1.5 σ has this ratio. The
/// lens contribution is subtracted from the widths. If the lens more than doubles the squared
/// width, the test is skipped, because speckle then dominates the width.
pub const NARROW_RATIO: f64 = 0.4;

/// Returns the flags of a single line. `double`: its column has another line. `saturated`: it
/// saturates. `inside`: its window is inside the image.
pub(super) fn line_flags(double: bool, saturated: bool, inside: bool) -> Flags {
    let mut flags = Flags::empty();
    flags.set(Flags::MULTIPLE_PEAKS, double);
    flags.set(Flags::SATURATED, saturated);
    flags.set(Flags::IMAGE_BORDER, !inside);
    flags
}

/// Sets the flags that compare a line with adjacent columns and with the other lines of the frame.
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
        let is_end = is_end(peak, [before.is_some(), after.is_some()], columns);
        let climb = slope(before, peak, after).powi(2) * VARIANCE_OF_A_CLIMB;
        let weak = peak.height < (WEAK_SHARE * height).max(WEAK_SNR * peak.noise);
        let wide = peak.sigma > WIDE_RATIO * (sigma * sigma + climb).sqrt();
        // A single column may be as narrow as a grain.
        let beside = widths.adjacent_width(peak.column).unwrap_or(peak.sigma);
        let around = widths.around(peak.column).1.unwrap_or(peak.sigma);
        let (beside, around) = (sharp(beside), sharp(around));
        let narrow = expected_sigma >= settings.lens_sigma
            && (beside < NARROW_RATIO * around || around < NARROW_RATIO * expected_sigma);
        let flags = &mut peaks[i].flags;
        flags.set(Flags::DISCONTINUITY, is_end || narrow);
        flags.set(Flags::LOW_SIGNAL, weak);
        flags.set(Flags::WIDE, wide);
    }
}

/// Updates the flags from the uncertainties of the peaks of a frame.
///
/// - [`Flags::UNCERTAINTY_NOT_VALID`] is set for peaks without a valid uncertainty.
/// - [`Flags::SATURATED`] is removed from lines that retain enough of their light.
/// - [`Flags::DISCONTINUITY`] is removed from lines that can be compared with complete lines around them. It
///   is set where an edge may truncate the line without a visible effect.
/// - [`Flags::LOW_SIGNAL`] is removed from lines above the noise that are weak because of an edge.
///
/// The stated uncertainty is valid for the lines from which a flag is removed.
pub fn update_flags_from_uncertainty(peaks: &mut [Peak], errors: &[RowUncertainty]) {
    for (peak, error) in peaks.iter_mut().zip(errors) {
        let flags = &mut peak.flags;
        if error.saturation_ok {
            flags.remove(Flags::SATURATED);
        }
        if error.has_reference_lines {
            flags.remove(Flags::DISCONTINUITY);
        }
        if error.is_cut && peak.height >= WEAK_SNR * peak.noise {
            flags.remove(Flags::LOW_SIGNAL);
        }
        // Neighbouring frames decide whether an edge is near.
        let other = Flags::UNCERTAINTY_NOT_VALID | Flags::DISCONTINUITY;
        let inside = flags.difference(other).is_empty() && error.is_valid;
        flags.set(Flags::UNCERTAINTY_NOT_VALID, !inside);
        if error.possible_truncation {
            flags.insert(Flags::DISCONTINUITY);
        }
    }
}

/// Returns the median, the upper of two central values; 0 for an empty iterator.
pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    match values.is_empty() {
        true => 0.0,
        false => *values.select_nth_unstable_by(middle, f64::total_cmp).1,
    }
}
