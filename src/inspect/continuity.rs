//! Continuity of the surface across frames, for points that a single frame cannot classify.

use super::cloud::{CloudPoint, of_frame};
use super::coverage::SensorPose;
use crate::laser::Laser;
use crate::math::DVec3;
use crate::profile::Flags;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;

/// Minimum distance between a point and the laser plane of a frame compared with it, in beam radii
/// (1/e²). An edge that truncates the beam at the point is then at least 2 σ from the beam of that
/// frame, or does not truncate it.
pub(super) const MIN_SHEET_DISTANCE_RADII: f64 = 2.0;

/// Maximum distance of a point from the chord between the points of the previous and the next
/// frame, in standard uncertainties. The errors of three points give this distance a standard
/// deviation of 1.22 standard uncertainties. Outliers above three expanded uncertainties exceed the
/// limit.
const MAX_CHORD_DEVIATION_SIGMAS: f64 = 6.0;

/// Number of columns on either side over which light is averaged; the window contains a few grains.
const ADJACENT_COLUMNS: u32 = 8;

/// Light fraction at the end of a surface: an edge through the beam axis leaves one half.
const TRUNCATED_LIGHT_FRACTION: f64 = 0.5;

/// Sets and removes [`Flags::DISCONTINUITY`] by comparison with the nearest frames before and after
/// that are outside the beam. `points` are in the order of frames, then columns. `scanned` are the
/// measured frames in order.
///
/// The flag is removed where the surface continues. The adjacent columns must have points, and the
/// point must be on the chord between the points of its column in both frames. A narrow line then
/// belongs to a surface at grazing view, since an edge would end the surface on one side.
///
/// The flag is set where the surface ends on one side and the frame on the other side has more than
/// twice the light. An edge may then truncate the complete line, which is not visible in its frame.
pub fn apply_cross_frame_flags(
    points: &mut [CloudPoint],
    scanned: &[(u32, SensorPose)],
    laser: &Laser,
) {
    let of_frames = scanned.iter().map(|&(frame, _)| of_frame(points, frame));
    let cloud = Cloud {
        points,
        of_frames: of_frames.collect(),
        scanned,
        laser,
    };
    let flags: Vec<Flags> = points.par_iter().map(|point| cloud.flags(point)).collect();
    for (point, flags) in points.iter_mut().zip(flags) {
        point.flags = flags;
    }
}

/// Returns the frames outside `piece` that [`apply_cross_frame_flags`] uses for the points of the
/// piece.
///
/// The scan has `frames` frames. With the points of the returned frames, the piece gets the flags
/// of the complete scan. `pose` returns the pose of a frame.
pub fn frames_beside(
    piece: &Range<u32>,
    frames: u32,
    points: &[CloudPoint],
    pose: impl Fn(u32) -> SensorPose + Sync,
    laser: &Laser,
) -> BTreeSet<u32> {
    if *piece == (0..frames) {
        return BTreeSet::new();
    }
    let of = |point: &CloudPoint| {
        let apart = |&frame: &u32| is_apart(point.position, &pose(frame), laser);
        let before = (0..point.frame).rev().find(apart);
        let after = (point.frame + 1..frames).find(apart);
        let found = [before, after].into_iter().flatten();
        found.filter(|frame| !piece.contains(frame))
    };
    points.par_iter().flat_map_iter(of).collect()
}

/// Returns whether a point is outside the beam of a frame.
fn is_apart(point: DVec3, pose: &SensorPose, laser: &Laser) -> bool {
    let in_laser = pose.part_from_laser.inverse().point(point);
    in_laser.y.abs() >= MIN_SHEET_DISTANCE_RADII * laser.radius(in_laser)
}

struct Cloud<'a> {
    points: &'a [CloudPoint],
    scanned: &'a [(u32, SensorPose)],
    /// Index ranges of the points of the scanned frames.
    of_frames: Vec<Range<usize>>,
    laser: &'a Laser,
}

impl Cloud<'_> {
    fn flags(&self, point: &CloudPoint) -> Flags {
        let number = |(frame, _): &(u32, SensorPose)| *frame;
        let Ok(i) = self.scanned.binary_search_by_key(&point.frame, number) else {
            return point.flags;
        };
        let apart = |&i: &usize| is_apart(point.position, &self.scanned[i].1, self.laser);
        let before = (0..i).rev().find(apart);
        let after = (i + 1..self.scanned.len()).find(apart);
        let mut flags = point.flags;
        if flags.contains(Flags::DISCONTINUITY) && self.goes_on(point, [before, Some(i), after]) {
            flags.remove(Flags::DISCONTINUITY);
        }
        if self.ends_dark(point.column, [before, Some(i), after]) {
            flags.insert(Flags::DISCONTINUITY);
        }
        flags
    }

    /// Returns the points of the scanned frame at index `i`.
    fn of_frame(&self, i: usize) -> &[CloudPoint] {
        &self.points[self.of_frames[i].clone()]
    }

    /// Returns whether the surface continues at `point`. The frames are the previous frame, the
    /// frame of the point, and the next frame.
    fn goes_on(&self, point: &CloudPoint, [before, own, after]: [Option<usize>; 3]) -> bool {
        let line = |frame: Option<usize>, column: Option<u32>| {
            let points = self.of_frame(frame?);
            let found = points.binary_search_by_key(&column?, |p| p.column);
            let found = &points[found.ok()?];
            is_one_line(found).then_some(found)
        };
        let beside = [point.column.checked_sub(1), point.column.checked_add(1)];
        if !is_one_line(point) || beside.iter().any(|&c| line(own, c).is_none()) {
            return false;
        }
        let column = Some(point.column);
        let (Some(before), Some(after)) = (line(before, column), line(after, column)) else {
            return false;
        };
        let Some(along) = (after.position - before.position).try_normalize() else {
            return false;
        };
        let off = (point.position - before.position).reject_from_normalized(along);
        off.length() <= MAX_CHORD_DEVIATION_SIGMAS * point.u_position
    }

    fn ends_dark(&self, column: u32, [before, own, after]: [Option<usize>; 3]) -> bool {
        let light = |frame: Option<usize>| self.light(frame?, column);
        match (light(before), light(after)) {
            (Some(other), None) | (None, Some(other)) => {
                light(own).is_some_and(|here| here < TRUNCATED_LIGHT_FRACTION * other)
            }
            _ => false,
        }
    }

    /// Returns the mean light of the lines around a column of a frame, counts. Returns `None` if
    /// half of the columns have no line.
    fn light(&self, frame: usize, column: u32) -> Option<f64> {
        let points = self.of_frame(frame);
        let to = |column: u32| points.partition_point(|p| p.column < column);
        let lines =
            &points[to(column.saturating_sub(ADJACENT_COLUMNS))..to(column + ADJACENT_COLUMNS + 1)];
        let sum: f64 = lines.iter().map(|p| p.intensity).sum();
        (lines.len() > ADJACENT_COLUMNS as usize).then(|| sum / lines.len() as f64)
    }
}

/// Returns whether the point has no other relevant flag than [`Flags::DISCONTINUITY`].
fn is_one_line(point: &CloudPoint) -> bool {
    let other = Flags::MULTIPLE_PEAKS | Flags::WIDE | Flags::LOW_SIGNAL | Flags::IMAGE_BORDER;
    !point.flags.intersects(other)
}

#[cfg(test)]
#[path = "continuity_tests.rs"]
pub(super) mod tests;
