//! What is found of the laser line in a sensor column, and what may be asked of
//! the search.

use crate::math::DVec2;
use bitflags::bitflags;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// The line in one column.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Peak {
    /// Column of the image.
    pub column: u32,
    /// Row coordinate of the line; pixel j covers [j, j+1].
    pub row: f64,
    /// Sum of the counts above background within four line widths.
    pub intensity: f64,
    /// Counts above background of the highest pixel.
    pub height: f64,
    /// Standard deviation of the line across its length, px, before pixels
    /// integrate it (their 1/12 px² is taken off).
    pub sigma: f64,
    /// Standard deviation of the background's noise, counts; at least that of
    /// rounding, 1/√12.
    pub noise: f64,
    /// What may be wrong with it.
    pub flags: Flags,
}

impl Peak {
    /// (column, row), in the middle of its column.
    pub fn place(&self) -> DVec2 {
        DVec2::new(self.column as f64 + 0.5, self.row)
    }
}

bitflags! {
    /// What may be wrong with a peak. Serialised by names: "SATURATED | WIDE".
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub struct Flags: u16 {
        /// A pixel of the line reaches the highest count the sensor gives. Taken back
        /// of speckled lines that keep half their light, whose uncertainty is stated for it.
        const SATURATED = 1;
        /// The column holds another line: one that passes detection, has at
        /// least [`super::CANDIDATE_SHARE`] of the height of the column's
        /// highest, and is apart from it by the lines' width at half height.
        const DOUBLE = 1 << 1;
        /// Wider than [`super::WIDE_RATIO`] times the width of the frame's lines
        /// (their median, or [`PeakSettings::expected_sigma`]) and of its climb.
        const WIDE = 1 << 2;
        /// Lower than [`super::WEAK_SHARE`] of the median height of the frame's
        /// lines, or than [`super::WEAK_SNR`] times the noise. Taken back of those above
        /// this that an edge cuts, as their uncertainty says.
        const WEAK = 1 << 3;
        /// The window of four line widths to either side ends at the sensor's edge.
        const BORDER = 1 << 4;
        /// At an occlusion or a jump: a neighbouring column has no line, or one whose
        /// end is further off than [`super::JUMP_SIGMAS`] line widths (at least a
        /// pixel), which those of an unbroken surface are not, however steep it is;
        /// or an edge along the line leaves a tail of it, narrower than
        /// [`super::NARROW_RATIO`] of the lines around, or these than that of what is
        /// expected. Taken back where there are whole lines to compare with: what an edge
        /// does is then in the uncertainty. Set of lines so dark and narrow beside the frame's
        /// brightest stretch that an edge may have moved them further than is stated. In a cloud,
        /// taken back where neighbouring frames show that the surface goes on.
        const EDGE = 1 << 5;
        /// Outside the domain of the uncertainty that is stated for it. Not set
        /// by the search itself.
        const OUTSIDE = 1 << 6;
        /// Possibly a reflection: in a column with another line, one that is as narrow as is expected,
        /// this one is wider than that, or is seen in columns with another far more often than that is;
        /// or it goes on from such a line. So far it is found in the image alone; in the cloud of a whole scan it is
        /// also set of points that would hide others, which are far brighter and which other frames see behind them.
        const GHOST = 1 << 7;
        /// Not measured: it fills a gap between the points on either side.
        const FILLED = 1 << 8;
    }
}

impl Flags {
    /// Whether nothing is doubtful. That an uncertainty is not stated (OUTSIDE) does not
    /// make it so.
    pub fn is_valid(self) -> bool {
        self.difference(Flags::OUTSIDE).is_empty()
    }
}

/// Names joined by `|`; nothing without a flag.
impl fmt::Display for Flags {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        for (i, (name, _)) in self.iter_names().enumerate() {
            let bar = if i > 0 { "|" } else { "" };
            write!(f, "{bar}{name}")?;
        }
        Ok(())
    }
}

/// How the line's row is found to a fraction of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PeakFinder {
    /// Centre of gravity of the counts above background.
    #[default]
    Centroid,
    /// A Gaussian through the top pixels, by a parabola through their logarithms.
    LogParabola,
    /// Least-squares fit of a Gaussian, integrated over pixels, on a constant
    /// background.
    GaussianFit,
    /// Zero crossing of a smoothing derivative as long as the line is wide.
    DerivativeZero,
}

/// As scene files have it.
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
    /// All, in the order in which they are compared.
    pub const ALL: [PeakFinder; 4] = [
        PeakFinder::Centroid,
        PeakFinder::LogParabola,
        PeakFinder::GaussianFit,
        PeakFinder::DerivativeZero,
    ];
}

/// Which line of a column with several is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Choice {
    /// The highest.
    #[default]
    Strongest,
    /// That of the lowest row.
    First,
    /// That of the highest row.
    Last,
}

/// What [`super::find_peaks`] needs to know.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PeakSettings {
    /// How the line's row is found.
    pub finder: PeakFinder,
    /// Which line of several.
    pub choice: Choice,
    /// Counts above the background that the highest pixel of a line has at least; `None`: the height
    /// that noise reaches [`super::FALSE_PEAKS_PER_FRAME`] times per frame.
    pub threshold: Option<f64>,
    /// The count at which pixels saturate.
    pub max_count: u16,
    /// Least standard deviation that the calibration expects of an uncut line, px;
    /// 0 if it says nothing. A line is wide or cut if it is so beside the greater
    /// of this and the frame's median.
    pub expected_sigma: f64,
    /// Standard deviation that the lens's diffraction spreads every line by, also what an edge leaves of
    /// one, px; 0 if the image is sharp.
    pub lens_sigma: f64,
}

impl PeakSettings {
    /// The defaults, for an image of which nothing is known but its scale.
    pub fn new(max_count: u16) -> PeakSettings {
        PeakSettings {
            finder: PeakFinder::default(),
            choice: Choice::default(),
            threshold: None,
            max_count,
            expected_sigma: 0.0,
            lens_sigma: 0.0,
        }
    }
}
