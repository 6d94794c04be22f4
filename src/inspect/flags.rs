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
        Flags::DOUBLE,
        "double",
        "the column holds another line: a second surface, or a ghost",
    ),
    (
        Flags::WIDE,
        "wide",
        "more than twice as wide as the frame's lines where they run as steeply",
    ),
    (
        Flags::WEAK,
        "weak",
        "near the noise, or much fainter than the frame's lines and not cut by an edge",
    ),
    (Flags::BORDER, "border", "cut off by the sensor's edge"),
    (
        Flags::EDGE,
        "edge",
        "at an end or a jump, or so narrow or dark that an edge may cut the line",
    ),
    (
        Flags::OUTSIDE,
        "outside",
        "outside the domain of the stated uncertainty",
    ),
    (
        Flags::GHOST,
        "ghost",
        "possibly a reflection: wider than the other line of its column, seen only beside it, or in the way of far brighter points",
    ),
    (
        Flags::FILLED,
        "filled",
        "not measured: on the line between the points on either side of a gap",
    ),
];
