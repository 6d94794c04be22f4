//! Peak of the laser line in a sensor column, and settings of the peak detection.

use crate::math::DVec2;
use bitflags::bitflags;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Laser line in one column.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Peak {
    /// Column of the image.
    pub column: u32,
    /// Row coordinate of the line, px; pixel j covers [j, j+1].
    pub row: f64,
    /// Sum of the counts above background within four line widths.
    pub intensity: f64,
    /// Height of the highest pixel above background, counts.
    pub height: f64,
    /// Standard deviation of the line across its length, px, before pixel integration (1/12 px² is
    /// subtracted).
    pub sigma: f64,
    /// Standard deviation of the background noise, counts; at least the standard deviation of
    /// rounding, 1/√12.
    pub noise: f64,
    /// Possible defects of the peak.
    pub flags: Flags,
}

impl Peak {
    /// Returns the sensor coordinates (column, row), at the centre of the column.
    pub fn place(&self) -> DVec2 {
        DVec2::new(self.column as f64 + 0.5, self.row)
    }
}

bitflags! {
    /// Possible defects of a peak. Serialised by name: "SATURATED | WIDE".
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub struct Flags: u16 {
        /// A pixel of the line reaches the maximum count of the sensor. The flag is removed from
        /// speckled lines that retain half of their light; their uncertainty includes the
        /// saturation.
        const SATURATED = 1;
        /// The column has another line. It exceeds the detection threshold and has at least
        /// [`super::CANDIDATE_SHARE`] of the height of the highest line in the column. The distance
        /// is at least the line width at half height.
        const MULTIPLE_PEAKS = 1 << 1;
        /// The line is wider than [`super::WIDE_RATIO`] times the expected width. The expected
        /// width combines the width of the lines in the frame (median, or
        /// [`PeakSettings::expected_sigma`]) and the slope of the line.
        const WIDE = 1 << 2;
        /// The line is lower than [`super::WEAK_SHARE`] of the median height of the lines in the
        /// frame, or than [`super::WEAK_SNR`] times the noise. The flag is removed from lines above
        /// this noise limit that an edge truncates; their uncertainty includes the truncation.
        const LOW_SIGNAL = 1 << 3;
        /// The window of four line widths on either side extends beyond the image.
        const IMAGE_BORDER = 1 << 4;
        /// The line is at an occlusion, a jump or an edge. One of the following conditions holds:
        ///
        /// - An adjacent column has no line.
        /// - The gap to the line of an adjacent column exceeds [`super::JUMP_SIGMAS`] line widths
        ///   (at least one pixel). Lines of an unbroken surface do not have such gaps at any slope.
        /// - An edge along the line leaves only a tail. The line is narrower than
        ///   [`super::NARROW_RATIO`] of the surrounding lines, or these are narrower than this
        ///   fraction of the expected width.
        /// - The line is dark and narrow compared with the brightest part of the frame. An edge may
        ///   have shifted it by more than the stated uncertainty.
        ///
        /// The flag is removed where complete lines are available for comparison; the effect of an
        /// edge is then part of the uncertainty. In a cloud, it is also removed where neighbouring
        /// frames show that the surface continues.
        const DISCONTINUITY = 1 << 5;
        /// The stated uncertainty is not valid for this peak. The search does not set this flag.
        const UNCERTAINTY_NOT_VALID = 1 << 6;
        /// The line may be caused by indirect light. A second line in the column is as narrow as
        /// expected, and this line is wider or occurs far more often together with another line. A
        /// continuation of such a line is flagged too. In the cloud of a complete scan, the flag is
        /// also set for points that would occlude far brighter points measured in other frames.
        const SUSPECTED_REFLECTION = 1 << 7;
        /// The point is not measured. It is interpolated in a gap between measured points.
        const INTERPOLATED = 1 << 8;
    }
}

impl Flags {
    /// Returns whether the peak has no defect. A missing uncertainty (UNCERTAINTY_NOT_VALID) is not
    /// a defect.
    pub fn is_valid(self) -> bool {
        self.difference(Flags::UNCERTAINTY_NOT_VALID).is_empty()
    }
}

/// Writes the names joined by `|`, or an empty string without flags.
impl fmt::Display for Flags {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        for (i, (name, _)) in self.iter_names().enumerate() {
            let bar = if i > 0 { "|" } else { "" };
            write!(f, "{bar}{name}")?;
        }
        Ok(())
    }
}

/// Estimator of the sub-pixel row of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PeakFinder {
    /// Centroid of the counts above background.
    #[default]
    Centroid,
    /// Gaussian through the top pixels, by a parabola through the logarithms of the counts.
    LogParabola,
    /// Pixel-integrated Gaussian on a constant background, fitted by least squares.
    GaussianFit,
    /// Zero crossing of a smoothing derivative whose length is matched to the line width.
    DerivativeZero,
}

/// Writes the name used in scene files.
impl fmt::Display for PeakFinder {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.pad(match self {
            PeakFinder::Centroid => "centroid",
            PeakFinder::LogParabola => "log-parabola",
            PeakFinder::GaussianFit => "gaussian-fit",
            PeakFinder::DerivativeZero => "derivative-zero",
        })
    }
}

impl PeakFinder {
    /// All estimators, in the order of comparisons.
    pub const ALL: [PeakFinder; 4] = [
        PeakFinder::Centroid,
        PeakFinder::LogParabola,
        PeakFinder::GaussianFit,
        PeakFinder::DerivativeZero,
    ];
}

/// Selection among several lines in a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PeakSelection {
    /// The highest line.
    #[default]
    Strongest,
    /// The line with the lowest row.
    First,
    /// The line with the highest row.
    Last,
}

/// Settings of [`super::find_peaks`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PeakSettings {
    /// Estimator of the row.
    pub finder: PeakFinder,
    /// Selection among several lines.
    pub choice: PeakSelection,
    /// Minimum height of the highest pixel of a line above background, counts. `None` selects the
    /// height that noise reaches [`super::FALSE_PEAKS_PER_FRAME`] times per frame.
    pub threshold: Option<f64>,
    /// Count at which pixels saturate.
    pub max_count: u16,
    /// Minimum standard deviation of a complete line expected from the calibration, px; 0 if
    /// unknown. The flags for wide and truncated lines refer to the greater of this value and the
    /// median of the frame.
    pub expected_sigma: f64,
    /// Standard deviation by which diffraction of the lens widens every line, px; 0 for sharp
    /// images. Truncated lines are widened too.
    pub lens_sigma: f64,
}

impl PeakSettings {
    /// Returns the default settings for an image with the given maximum count.
    pub fn new(max_count: u16) -> PeakSettings {
        PeakSettings {
            finder: PeakFinder::default(),
            choice: PeakSelection::default(),
            threshold: None,
            max_count,
            expected_sigma: 0.0,
            lens_sigma: 0.0,
        }
    }
}
