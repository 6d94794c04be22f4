//! Numbers of points by flag.

use super::cloud::CloudPoint;
use crate::profile::Flags;

/// Number of points with a flag.
pub struct FlagCount {
    /// Name of the flag in outputs.
    pub name: &'static str,
    /// Description of the flag.
    pub meaning: &'static str,
    /// Number of points with the flag.
    pub points: usize,
}

/// Counts the points with each flag.
pub fn count_flags(points: &[CloudPoint]) -> Vec<FlagCount> {
    let count = |flag| points.iter().filter(|p| p.flags.contains(flag)).count();
    FLAGS
        .iter()
        .map(|&(flag, name, meaning)| FlagCount {
            name,
            meaning,
            points: count(flag),
        })
        .collect()
}

const FLAGS: [(Flags, &str, &str); 9] = [
    (
        Flags::SATURATED,
        "saturated",
        "at least half of the line's light is above the saturation level",
    ),
    (
        Flags::MULTIPLE_PEAKS,
        "multiple_peaks",
        "the column has a second line, from another surface or a reflection",
    ),
    (
        Flags::WIDE,
        "wide",
        "more than twice as wide as lines of equal slope in the frame",
    ),
    (
        Flags::LOW_SIGNAL,
        "low_signal",
        "near the noise, or much fainter than other lines of the frame and not at an edge",
    ),
    (
        Flags::IMAGE_BORDER,
        "image_border",
        "the border of the image truncates the line",
    ),
    (
        Flags::DISCONTINUITY,
        "discontinuity",
        "at an end or a step of the profile, or so narrow or dark that an edge may truncate the line",
    ),
    (
        Flags::UNCERTAINTY_NOT_VALID,
        "uncertainty_not_valid",
        "outside the domain of the stated uncertainty",
    ),
    (
        Flags::SUSPECTED_REFLECTION,
        "suspected_reflection",
        "possibly interreflection: wider than the other line of its column, only in a column with another line, or in front of much brighter points",
    ),
    (
        Flags::INTERPOLATED,
        "interpolated",
        "not measured: interpolated between the points on both sides of a gap",
    ),
];
