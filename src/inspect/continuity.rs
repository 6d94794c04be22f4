//! Whether the surface goes on where one frame alone cannot tell.

use super::cloud::{CloudPoint, of_frame};
use super::coverage::HeadPose;
use crate::laser::Laser;
use crate::math::DVec3;
use crate::profile::Flags;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;

/// Beam radii (1/e²) by which the sheet of another frame is off a point at least: an edge that
/// cuts the beam here is then 2 σ and more beyond the light there, or out of it.
pub(super) const APART: f64 = 2.0;

/// Standard uncertainties by which a point may lie off the straight line between those of the
/// frames before and after. Errors of three points make 1.22 standard ones of that distance;
/// what is off by more than three expanded uncertainties lies further from it.
const OFF_CHORD: f64 = 6.0;

/// Columns to either side whose light is averaged: speckle leaves a few grains.
const NEAR: u32 = 8;

/// Share of its light that a line has at the end of the surface: an edge through the middle of
/// the beam leaves as much.
const HALF: f64 = 0.5;

/// Sets and takes back [`Flags::EDGE`] by what the nearest frames before and after show that are
/// beyond the beam's reach. `points` are in the order of frames, then columns; `scanned` are the
/// frames that were taken, in order.
///
/// It is taken back where the surface goes on: where the columns beside have points too, and the
/// point lies on a line with those of its column in the two frames. A narrow line is then that
/// of a surface seen at a grazing view, which an edge would end to one side.
///
/// It is set where the surface ends to one side and half the light is missing beside the frame to
/// the other: an edge may cut the whole line, and nothing in its frame shows it.
pub fn compare_frames(points: &mut [CloudPoint], scanned: &[(u32, HeadPose)], laser: &Laser) {
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

/// Frames outside a piece of a scan of so many that [`compare_frames`] looks at for the piece's
/// points: with what these frames measure it sets the same flags as for the whole scan. `pose`:
/// of a frame.
pub fn frames_beside(
    piece: &Range<u32>,
    frames: u32,
    points: &[CloudPoint],
    pose: impl Fn(u32) -> HeadPose + Sync,
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

/// Whether the sheet of a frame is off a point by so much that the beam does not reach it.
fn is_apart(point: DVec3, pose: &HeadPose, laser: &Laser) -> bool {
    let in_laser = pose.part_from_laser.inverse().point(point);
    in_laser.y.abs() >= APART * laser.beam.radius(in_laser.length())
}

struct Cloud<'a> {
    points: &'a [CloudPoint],
    scanned: &'a [(u32, HeadPose)],
    /// Where the points of each of these frames are.
    of_frames: Vec<Range<usize>>,
    laser: &'a Laser,
}

impl Cloud<'_> {
    fn flags(&self, point: &CloudPoint) -> Flags {
        let number = |(frame, _): &(u32, HeadPose)| *frame;
        let Ok(i) = self.scanned.binary_search_by_key(&point.frame, number) else {
            return point.flags;
        };
        let apart = |&i: &usize| is_apart(point.position, &self.scanned[i].1, self.laser);
        let before = (0..i).rev().find(apart);
        let after = (i + 1..self.scanned.len()).find(apart);
        let mut flags = point.flags;
        if flags.contains(Flags::EDGE) && self.goes_on(point, [before, Some(i), after]) {
            flags.remove(Flags::EDGE);
        }
        if self.ends_dark(point.column, [before, Some(i), after]) {
            flags.insert(Flags::EDGE);
        }
        flags
    }

    /// Points of the i-th frame that was scanned.
    fn of_frame(&self, i: usize) -> &[CloudPoint] {
        &self.points[self.of_frames[i].clone()]
    }

    /// Of frames before and after, and the point's own.
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
        off.length() <= OFF_CHORD * point.sigma
    }

    fn ends_dark(&self, column: u32, [before, own, after]: [Option<usize>; 3]) -> bool {
        let light = |frame: Option<usize>| self.light(frame?, column);
        match (light(before), light(after)) {
            (Some(other), None) | (None, Some(other)) => {
                light(own).is_some_and(|here| here < HALF * other)
            }
            _ => false,
        }
    }

    /// Mean light of the lines around a column of a frame, counts; `None` where half the columns
    /// have none.
    fn light(&self, frame: usize, column: u32) -> Option<f64> {
        let points = self.of_frame(frame);
        let to = |column: u32| points.partition_point(|p| p.column < column);
        let lines = &points[to(column.saturating_sub(NEAR))..to(column + NEAR + 1)];
        let sum: f64 = lines.iter().map(|p| p.intensity).sum();
        (lines.len() > NEAR as usize).then(|| sum / lines.len() as f64)
    }
}

/// Whether nothing but an edge is suspected.
fn is_one_line(point: &CloudPoint) -> bool {
    let other = Flags::DOUBLE | Flags::WIDE | Flags::WEAK | Flags::BORDER;
    !point.flags.intersects(other)
}

#[cfg(test)]
#[path = "continuity_tests.rs"]
pub(super) mod tests;
