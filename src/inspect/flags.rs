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
        "the line loses half its light or more above the highest count the sensor gives",
    ),
    (
        Flags::MULTIPLE_PEAKS,
        "double",
        "the column holds another line: a second surface, or a ghost",
    ),
    (
        Flags::WIDE,
        "wide",
        "more than twice as wide as the frame's lines where they run as steeply",
    ),
    (
        Flags::LOW_SIGNAL,
        "weak",
        "near the noise, or much fainter than the frame's lines and not cut by an edge",
    ),
    (
        Flags::IMAGE_BORDER,
        "border",
        "cut off by the sensor's edge",
    ),
    (
        Flags::DISCONTINUITY,
        "edge",
        "at an end or a jump, or so narrow or dark that an edge may cut the line",
    ),
    (
        Flags::UNCERTAINTY_NOT_VALID,
        "outside",
        "outside the domain of the stated uncertainty",
    ),
    (
        Flags::SUSPECTED_REFLECTION,
        "ghost",
        "possibly a reflection: wider than the other line of its column, seen only beside it, or in the way of far brighter points",
    ),
    (
        Flags::INTERPOLATED,
        "filled",
        "not measured: on the line between the points on either side of a gap",
    ),
];
