//! Spurious points that would occlude points measured in other frames.

use super::cloud::{CloudPoint, of_frame};
use super::continuity::MIN_SHEET_DISTANCE_RADII;
use super::coverage::SensorPose;
use crate::laser::Laser;
use crate::math::{DVec3, Rigid};
use crate::profile::Flags;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

/// Minimum distance of a point above a line of sight, in standard uncertainties. Chance exceeds it
/// in one of 30 000 cases.
const SIGMAS: f64 = 4.0;
/// Maximum intensity of a suspected point relative to the occluded point. The value was chosen on
/// the development scenes of `examples/ghost_flags.rs`, and evaluated on other scenes.
const MAX_INTENSITY_RATIO: f64 = 0.2;
/// Minimum number of occluded points, because one point may be spurious. The value was chosen on
/// the development scenes too.
const MIN_OCCLUDED_POINTS: u32 = 2;

/// Sets [`Flags::SUSPECTED_REFLECTION`] for points that would occlude at least two far brighter
/// points of other frames.
///
/// Two points contradict each other if the line of sight from one to the camera passes below the
/// other. The line of sight would then cross the interior of the part. One of the two points is
/// spurious, usually the fainter one. `points` are in the order of frames, then columns. `scanned`
/// are all frames of the scan in order.
///
/// The point must be above the line of sight by more than its uncertainty plus the effect of the
/// beam width. Lasers without a fan are skipped, because their frames have one point each.
pub fn compare_lines_of_sight(
    points: &mut [CloudPoint],
    scanned: &[(u32, SensorPose)],
    laser: &Laser,
) {
    if laser.fan.is_none() {
        return;
    }
    let valid = points.iter().filter(|point| point.is_valid());
    let brightest = valid.fold(0.0, |most: f64, point| most.max(point.intensity));
    let profile = |(frame, pose): &(u32, SensorPose)| {
        FrameProfile::new(
            points,
            of_frame(points, *frame),
            pose,
            MAX_INTENSITY_RATIO * brightest,
        )
    };
    let profiles: Vec<FrameProfile> = scanned.par_iter().map(profile).collect();
    let sight = LinesOfSight {
        points,
        top: profiles.iter().map(|p| p.top).fold(f64::INFINITY, f64::min),
        profiles: &profiles,
        laser,
        hidden: points.iter().map(|_| AtomicU32::new(0)).collect(),
    };
    (0..profiles.len()).into_par_iter().for_each(|i| {
        sight.follow(i, (0..i).rev());
        sight.follow(i, i + 1..profiles.len());
    });
    let hidden = sight.hidden;
    for (point, hidden) in points.iter_mut().zip(hidden) {
        if hidden.into_inner() >= MIN_OCCLUDED_POINTS {
            point.flags.insert(Flags::SUSPECTED_REFLECTION);
        }
    }
}

/// Point in the laser plane of its frame.
#[derive(Clone, Copy)]
struct InSheet {
    /// Tangent of the fan angle.
    angle: f64,
    /// Distance along the laser axis, mm.
    far: f64,
    number: usize,
}

/// Points of a frame.
struct FrameProfile {
    laser_from_part: Rigid,
    camera_center: DVec3,
    range: Range<usize>,
    /// Points sorted by angle.
    all: Vec<InSheet>,
    /// Angular distance of adjacent columns (difference of tangents).
    pitch: f64,
    /// Minimum distance from the laser of faint points, mm, for strips of width `pitch` from the
    /// first angle on. Each entry includes the two adjacent strips; it is infinite without faint
    /// points.
    tops: Vec<f64>,
    /// Minimum over all faint points, mm.
    top: f64,
}

impl FrameProfile {
    /// Creates the profile. Points with an intensity below `faint` may be flagged.
    fn new(
        points: &[CloudPoint],
        range: Range<usize>,
        pose: &SensorPose,
        faint: f64,
    ) -> FrameProfile {
        let laser_from_part = pose.part_from_laser.inverse();
        let in_sheet = |number: usize| {
            let place = laser_from_part.point(points[number].position);
            (place.z > 0.0).then_some(InSheet {
                angle: place.x / place.z,
                far: place.z,
                number,
            })
        };
        let mut all: Vec<InSheet> = range.clone().filter_map(in_sheet).collect();
        let columns = |[a, b]: [&InSheet; 2]| points[b.number].column - points[a.number].column;
        let beside = all
            .windows(2)
            .filter(|pair| columns([&pair[0], &pair[1]]) == 1);
        let ways = beside.map(|pair| (pair[1].angle - pair[0].angle).abs());
        let (way, count) = ways.fold((0.0, 0), |(way, count), next| (way + next, count + 1));
        all.sort_by(|a, b| a.angle.total_cmp(&b.angle));
        let span = all.last().map_or(0.0, |last| last.angle - all[0].angle);
        let mut profile = FrameProfile {
            laser_from_part,
            camera_center: pose.part_from_camera.translation,
            range,
            all,
            // No sensor has more than 65536 columns, which bounds the number of strips.
            pitch: (way / f64::from(count.max(1))).max(span / 65536.0),
            tops: Vec::new(),
            top: f64::INFINITY,
        };
        for point in &profile.all {
            if points[point.number].intensity < faint {
                let strip = profile.strip(point.angle).unwrap_or(0);
                profile
                    .tops
                    .resize(profile.tops.len().max(strip + 2), f64::INFINITY);
                for top in &mut profile.tops[strip.saturating_sub(1)..strip + 2] {
                    *top = top.min(point.far);
                }
                profile.top = profile.top.min(point.far);
            }
        }
        profile
    }

    fn strip(&self, angle: f64) -> Option<usize> {
        let off = angle - self.all.first()?.angle;
        (off >= 0.0 && self.pitch > 0.0).then(|| (off / self.pitch) as usize)
    }

    /// Returns the points within one column of an angle.
    fn near(&self, angle: f64) -> &[InSheet] {
        let before = |angle: f64| self.all.partition_point(|p| p.angle < angle);
        &self.all[before(angle - self.pitch)..before(angle + self.pitch)]
    }
}

struct LinesOfSight<'a> {
    points: &'a [CloudPoint],
    profiles: &'a [FrameProfile],
    /// Minimum distance from the laser of all faint points, mm.
    top: f64,
    laser: &'a Laser,
    /// Number of far brighter points that each point would occlude.
    hidden: Vec<AtomicU32>,
}

impl LinesOfSight<'_> {
    /// Follows the lines of sight from the points in a frame through the laser planes of other
    /// frames, until they are above all faint points.
    fn follow(&self, frame: usize, others: impl Iterator<Item = usize>) {
        let FrameProfile {
            camera_center: eye,
            range,
            ..
        } = &self.profiles[frame];
        let mut left: Vec<&CloudPoint> = self.points[range.clone()]
            .iter()
            .filter(|point| point.is_valid())
            .collect();
        for other in others {
            let profile = &self.profiles[other];
            if profile.laser_from_part == self.profiles[frame].laser_from_part {
                continue;
            }
            let eye = profile.laser_from_part.point(*eye);
            left.retain(|point| {
                let seen = profile.laser_from_part.point(point.position);
                let place = seen + (eye - seen) * (seen.y / (seen.y - eye.y));
                let between = seen.y * eye.y < 0.0;
                if between && seen.y.abs() >= MIN_SHEET_DISTANCE_RADII * self.laser.radius(seen) {
                    self.pass(point, eye - seen, place, profile);
                }
                between && place.z > self.top
            });
            if left.is_empty() {
                return;
            }
        }
    }

    /// Evaluates the intersection of a line of sight with a laser plane.
    fn pass(&self, seen: &CloudPoint, along: DVec3, place: DVec3, profile: &FrameProfile) {
        let angle = place.x / place.z;
        let top = profile
            .strip(angle)
            .and_then(|strip| profile.tops.get(strip));
        if top.is_none_or(|&top| place.z <= top) {
            return;
        }
        let beside =
            MIN_SHEET_DISTANCE_RADII * self.laser.radius(place) * (along.z / along.y).abs();
        let light = |point: &InSheet| self.points[point.number].intensity;
        let above = |point: &InSheet| {
            point.far + beside + SIGMAS * self.points[point.number].u_position < place.z
        };
        let near = profile.near(angle);
        if near.iter().all(above) {
            let fainter = near
                .iter()
                .filter(|point| light(point) < MAX_INTENSITY_RATIO * seen.intensity);
            fainter.for_each(|point| {
                self.hidden[point.number].fetch_add(1, Ordering::Relaxed);
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inspect::continuity::tests::{laser, pose, slope};

    const FRAMES: u32 = 40;
    const STEP: f64 = 0.25;

    /// Returns the flagged points of a flat floor 100 mm from the laser after a change. The viewing
    /// direction of the camera is along y at 45°.
    fn flagged(change: impl Fn(&mut CloudPoint) -> bool) -> Vec<[u32; 2]> {
        let mut points = slope(FRAMES, STEP);
        points.iter_mut().for_each(|point| point.position.z = 100.0);
        points.retain_mut(change);
        let scanned: Vec<_> = (0..FRAMES)
            .map(|frame| {
                let mut pose = pose(frame, STEP);
                pose.part_from_camera.translation += DVec3::new(1.0, -70.0, 30.0);
                (frame, pose)
            })
            .collect();
        compare_lines_of_sight(&mut points, &scanned, &laser());
        let ghosts = points
            .iter()
            .filter(|p| p.flags.contains(Flags::SUSPECTED_REFLECTION));
        ghosts.map(|point| [point.frame, point.column]).collect()
    }

    fn is_raised(point: &CloudPoint) -> bool {
        (18..22).contains(&point.frame) && (10..30).contains(&point.column)
    }

    /// Points raised by 3 mm in front of a visible floor are flagged if they are faint. The lines
    /// of sight pass through about twelve laser planes.
    #[test]
    fn what_hides_brighter_points_is_doubted() {
        let raised = |light: f64| {
            flagged(move |point| {
                if is_raised(point) {
                    point.position.z = 97.0;
                    point.intensity = light;
                }
                true
            })
        };
        let all: Vec<[u32; 2]> = (18..22)
            .flat_map(|f| (10..30).map(move |c| [f, c]))
            .collect();
        // Points at equal fan angle but closer to the laser are up to one column further inside.
        let found = raised(100.0);
        assert!(found.iter().all(|point| all.contains(point)));
        assert!(found.len() >= all.len() - 4 * 4, "{}", found.len());
        assert!(raised(0.5 * 1000.0).is_empty());
        assert!(raised(1000.0).is_empty());
    }

    /// A rib on a floor is not flagged, regardless of its intensity: no point of the floor behind
    /// it is measured.
    #[test]
    fn what_hides_what_is_not_measured_is_not() {
        let found = flagged(|point| {
            if is_raised(point) {
                point.position.z = 97.0;
                point.intensity = 100.0;
            }
            // The rib hides 3 mm of the floor from the camera, which is twelve frames.
            let hidden = (22..36).contains(&point.frame) && (8..32).contains(&point.column);
            !hidden
        });
        assert!(found.is_empty(), "{found:?}");
    }

    /// One occluded point is not sufficient, since it may be spurious. Flagged points are ignored.
    /// Dark areas of a floor are not flagged, because they occlude nothing.
    #[test]
    fn few_and_doubtful_points_say_nothing() {
        let behind = |count: u32| {
            flagged(move |point| {
                let raised = [point.frame, point.column] == [20, 20];
                if raised {
                    point.position.z = 97.0;
                    point.intensity = 100.0;
                }
                let seen = (25..25 + count).contains(&point.frame) && point.column == 20;
                raised || seen || point.column.abs_diff(20) > 6
            })
        };
        assert!(behind(1).is_empty());
        assert_eq!(behind(2), [[20, 20]]);
        let doubtful = flagged(|point| {
            match is_raised(point) {
                true => (point.position.z, point.intensity) = (97.0, 100.0),
                false => point.flags.insert(Flags::WIDE),
            }
            true
        });
        assert!(doubtful.is_empty());
        let dark = flagged(|point| {
            point.intensity = if is_raised(point) { 1.0 } else { 1000.0 };
            true
        });
        assert!(dark.is_empty());
    }
}
