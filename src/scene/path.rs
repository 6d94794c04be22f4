//! Path of a scan: poses of head and part in every frame and between frames.

use super::file::{HandEyeTable, MovingBody, RotaryTable, ScanTable};
use super::poses::{self, EXPECTED_COLUMNS, Layout, PoseList};
use super::resolver::Resolver;
use crate::error::input_file::{self, LARGEST_DATA};
use crate::error::{InputError, Place, Result, printable};
use crate::math::{DMat3, DVec3, Rigid};
use glam::DQuat;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::PathBuf;
use std::sync::Arc;

/// Motion of the moving body in the world. Its pose in frame k is motion(k) · its pose at rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScanPath {
    /// Number of frames, at least 1.
    pub frames: u32,
    /// Body that moves; the other body rests.
    #[doc(hidden)]
    pub moves: MovingBody,
    /// Motion relative to the pose at rest.
    #[doc(hidden)]
    pub motion: PathMotion,
    /// Position of the head at rest, where it has no rotation, mm.
    pub start: DVec3,
    /// Exposure time as a fraction of the frame period, 0 to 1; `None` without a frame rate.
    #[doc(hidden)]
    pub exposure_share: Option<f64>,
    /// Number of poses during one exposure whose light is averaged.
    #[doc(hidden)]
    pub motion_samples: u32,
}

/// Motion of a body in frame k, relative to its pose at rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PathMotion {
    /// Translation by k steps.
    Linear {
        /// Displacement between consecutive frames, mm.
        step: DVec3,
    },
    /// Right-handed rotation about an axis fixed in the world.
    Rotary {
        /// A point on the axis, mm.
        axis_point: DVec3,
        /// Direction of the axis, unit vector.
        axis_direction: DVec3,
        /// Rotation between consecutive frames.
        step_deg: f64,
        /// Rotation in frame 0.
        start_deg: f64,
    },
    /// One pose per frame, from a file.
    Poses {
        /// Path of the file.
        #[serde(serialize_with = "printable::in_json")]
        file: PathBuf,
        /// Poses, one per frame. They are too many to serialize.
        #[serde(skip)]
        poses: Arc<[Rigid]>,
    },
}

impl ScanPath {
    /// Returns a path of one frame with the head at the world origin.
    #[doc(hidden)]
    pub fn at_rest() -> ScanPath {
        ScanPath {
            frames: 1,
            moves: MovingBody::Head,
            motion: PathMotion::Linear { step: DVec3::ZERO },
            start: DVec3::ZERO,
            exposure_share: None,
            motion_samples: 1,
        }
    }
}

impl PathMotion {
    /// Returns the motion at a fractional frame number. Between listed poses, position and rotation
    /// change at constant speed. Beyond the ends, the motion of the last interval is extrapolated.
    fn at(&self, place: f64) -> Rigid {
        match self {
            PathMotion::Linear { step } => Rigid::translation(*step * place),
            PathMotion::Rotary {
                axis_point,
                axis_direction,
                step_deg,
                start_deg,
            } => {
                // Full turns are removed in degrees, where they are exact.
                let angle = ((start_deg + step_deg * place) % 360.0).to_radians();
                let rotation = DMat3::from_axis_angle(*axis_direction, angle);
                Rigid {
                    rotation,
                    translation: *axis_point - rotation * *axis_point,
                }
            }
            PathMotion::Poses { poses, .. } => {
                // A single pose defines no motion, so the body is at rest.
                if let [pose] = poses[..] {
                    return pose;
                }
                let before = (place.max(0.0) as usize).min(poses.len() - 2);
                let share = place - before as f64;
                match share {
                    // Returns the listed pose unchanged, without rounding.
                    0.0 => poses[before],
                    1.0 => poses[before + 1],
                    _ => between(&poses[before], &poses[before + 1], share),
                }
            }
        }
    }
}

/// Interpolates from `a` to `b` by the fraction `share`, along the shorter rotation.
fn between(a: &Rigid, b: &Rigid, share: f64) -> Rigid {
    let turn = DQuat::from_mat3(&(a.rotation.transpose() * b.rotation));
    let turn = if turn.w < 0.0 { -turn } else { turn }.to_scaled_axis();
    Rigid {
        rotation: a.rotation * DMat3::from_quat(DQuat::from_scaled_axis(turn * share)),
        translation: a.translation + (b.translation - a.translation) * share,
    }
}

/// Interpolates `poses`, given at the times `known`, at the times `wanted`; both lists ascend. The
/// error is the first time outside `known`.
fn at_times(
    poses: &[Rigid],
    known: &[f64],
    wanted: &[f64],
) -> std::result::Result<Vec<Rigid>, f64> {
    let pose = |&time: &f64| {
        let after = known.partition_point(|&known| known < time);
        match known.get(after) {
            Some(&at) if at == time => Ok(poses[after]),
            Some(&at) if after > 0 => {
                let before = known[after - 1];
                let share = (time - before) / (at - before);
                Ok(between(&poses[after - 1], &poses[after], share))
            }
            _ => Err(time),
        }
    };
    wanted.iter().map(pose).collect()
}

impl ScanPath {
    /// Returns the pose of the head; `place` is a fractional frame number.
    pub fn world_from_head(&self, place: f64) -> Rigid {
        let rest = Rigid::translation(self.start);
        match self.moves {
            MovingBody::Head => self.motion.at(place) * rest,
            MovingBody::Part => rest,
        }
    }

    /// Returns the pose of the part, whose pose at rest is `rest`; `place` is as in
    /// [`world_from_head`](Self::world_from_head).
    pub fn world_from_part(&self, place: f64, rest: &Rigid) -> Rigid {
        match self.moves {
            MovingBody::Head => *rest,
            MovingBody::Part => self.motion.at(place) * *rest,
        }
    }

    /// Whether the relative orientation of head and part changes along the path.
    #[doc(hidden)]
    pub fn turns(&self) -> bool {
        match &self.motion {
            PathMotion::Linear { .. } => false,
            PathMotion::Rotary { step_deg, .. } => *step_deg != 0.0,
            PathMotion::Poses { poses, .. } => {
                poses.iter().any(|p| p.rotation != poses[0].rotation)
            }
        }
    }

    /// Returns the fractional frame numbers at which the light of a frame is sampled. They are
    /// centred on the frame number, which is the midpoint of the exposure.
    #[doc(hidden)]
    pub fn exposure_places(&self, frame: u32) -> impl Iterator<Item = f64> + use<> {
        let n = self.motion_samples as f64;
        let share = self.exposure_share.unwrap_or(0.0);
        (0..self.motion_samples).map(move |i| frame as f64 + share * ((i as f64 + 0.5) / n - 0.5))
    }
}

impl Resolver<'_> {
    /// Returns the path, and the bytes that represent a file of poses in the hash.
    pub(super) fn scan(&self, table: &ScanTable, exposure_ms: f64) -> Result<(ScanPath, Vec<u8>)> {
        let (exposure_share, motion_samples) = self.exposure(table, exposure_ms)?;
        let (motion, frames, hash) = match (&table.rotary, &table.poses) {
            (None, None) => (self.linear(table)?, self.frames(table)?, Vec::new()),
            (Some(rotary), None) => (self.rotary(rotary)?, self.frames(table)?, Vec::new()),
            (None, Some(file)) => {
                let absent = table.frames.is_none();
                self.check(
                    absent,
                    "scan.frames",
                    "no frames in addition to scan.poses: the file of poses has one line per frame",
                )?;
                let (file, poses, hash) = self.pose_of_each_frame(table, file)?;
                let frames = poses.len() as u32;
                let poses = poses.into();
                (PathMotion::Poses { file, poses }, frames, hash)
            }
            (Some(_), Some(_)) => {
                let expected = "exactly one of step_mm with direction, rotary, and poses";
                return Err(self.source.input_error("scan", expected));
            }
        };
        if table.rotary.is_some() || table.poses.is_some() {
            let expected = "no such key with scan.rotary or scan.poses, which define the path";
            self.check(table.step_mm.is_none(), "scan.step_mm", expected)?;
            self.check(table.direction.is_none(), "scan.direction", expected)?;
        }
        for (given, key) in [
            (table.poses_columns.is_some(), "scan.poses_columns"),
            (table.hand_eye.is_some(), "scan.hand_eye"),
            (table.frame_times.is_some(), "scan.frame_times"),
        ] {
            let expected = "none without scan.poses, whose file it describes";
            self.check(!given || table.poses.is_some(), key, expected)?;
        }
        let path = ScanPath {
            frames,
            moves: table.moving_body,
            motion,
            start: self.lengths(table.start_mm, "scan.start_mm")?.into(),
            exposure_share,
            motion_samples,
        };
        Ok((path, hash))
    }

    fn given<T>(&self, value: Option<T>, key: &str) -> Result<T> {
        value.ok_or_else(|| self.source.missing(key))
    }

    fn frames(&self, table: &ScanTable) -> Result<u32> {
        let frames = self.given(table.frames, "scan.frames")?;
        self.check(frames > 0, "scan.frames", "at least 1")?;
        Ok(frames)
    }

    fn linear(&self, table: &ScanTable) -> Result<PathMotion> {
        let direction = self.given(table.direction, "scan.direction")?;
        let direction = self.direction(direction, "scan.direction")?;
        let step = self.given(table.step_mm, "scan.step_mm")?;
        let [step] = self.lengths([step], "scan.step_mm")?;
        Ok(PathMotion::Linear {
            step: direction * step,
        })
    }

    fn rotary(&self, table: &RotaryTable) -> Result<PathMotion> {
        let angle = |value: f64, key: &str| {
            let holds = value.abs() <= 360.0;
            self.check(holds, key, "an angle from -360 to 360")
                .map(|()| value)
        };
        let axis_point = self.lengths(table.axis_point_mm, "scan.rotary.axis_point_mm")?;
        Ok(PathMotion::Rotary {
            axis_point: axis_point.into(),
            axis_direction: self.direction(table.axis_direction, "scan.rotary.axis_direction")?,
            step_deg: angle(table.step_deg, "scan.rotary.step_deg")?,
            start_deg: angle(table.start_deg, "scan.rotary.start_deg")?,
        })
    }

    /// Returns the pose of the moving body in every frame, from the file of poses.
    fn pose_of_each_frame(
        &self,
        table: &ScanTable,
        file: &str,
    ) -> Result<(PathBuf, Vec<Rigid>, Vec<u8>)> {
        let layout = match &table.poses_columns {
            Some(names) => {
                let layout = Layout::of(names.iter().map(String::as_str));
                let expected = |reason| format!("{EXPECTED_COLUMNS}; this list has {reason}");
                let wrong = |reason| {
                    self.source
                        .input_error("scan.poses_columns", &expected(reason))
                };
                Some(layout.map_err(wrong)?)
            }
            None => None,
        };
        let (file, list, mut hash) = self.poses(file, "scan.poses", layout)?;
        let mut poses = list.poses;
        if let Some(name) = &table.frame_times {
            let key = "scan.frame_times";
            let times = self.file(name, key, "a file of times")?;
            let bytes = input_file::read(&times, LARGEST_DATA, "times (CSV)")?;
            let expected = "a file of poses with a column time_s or time_ms";
            let known = list
                .times
                .ok_or_else(|| self.source.input_error(key, expected))?;
            let wanted = poses::read_times(&times, &bytes)?;
            poses = at_times(&poses, &known, &wanted).map_err(|time| {
                let found = format!("{time} s");
                let [first, last] = [known[0], known[known.len() - 1]];
                let expected = format!(
                    "times from {first} s to {last} s, as in {}",
                    printable::path(&file)
                );
                InputError::new(&times, Place::File, found, expected)
            })?;
            hash.extend(Sha256::digest(&bytes));
        }
        if let Some(hand_eye) = &table.hand_eye {
            let key = "scan.hand_eye";
            let expected = "no hand-eye transform with a moving part: part.position_mm and \
                            part.rotation_deg are its pose on the robot's flange";
            self.check(table.moving_body == MovingBody::Head, key, expected)?;
            let expected = "no hand-eye transform with scan.start_mm: scan.hand_eye.position_mm is the position of the head";
            self.check(table.start_mm == [0.0; 3], key, expected)?;
            let flange_from_head = self.hand_eye(hand_eye)?;
            for pose in &mut poses {
                *pose = *pose * flange_from_head;
            }
        }
        Ok((file, poses, hash))
    }

    fn hand_eye(&self, table: &HandEyeTable) -> Result<Rigid> {
        let position = self.lengths(table.position_mm, "scan.hand_eye.position_mm")?;
        let angles = table.rotation_deg;
        self.check(
            angles.iter().all(|angle| angle.abs() <= 360.0),
            "scan.hand_eye.rotation_deg",
            "angles from -360 to 360",
        )?;
        let angles = DVec3::from(angles).map(f64::to_radians);
        Ok(Rigid::from_euler_xyz(angles, position.into()))
    }

    /// Reads the poses of the file that `key` names. Returns its path, the poses, and the bytes
    /// that represent it in the hash.
    pub(super) fn poses(
        &self,
        file: &str,
        key: &str,
        layout: Option<Layout>,
    ) -> Result<(PathBuf, PoseList, Vec<u8>)> {
        let file = self.file(file, key, "a CSV file of poses")?;
        let bytes = input_file::read(&file, LARGEST_DATA, "poses (CSV)")?;
        let list = poses::read(&file, &bytes, layout)?;
        let hash = Sha256::digest(&bytes).to_vec();
        Ok((file, list, hash))
    }

    fn exposure(&self, table: &ScanTable, exposure_ms: f64) -> Result<(Option<f64>, u32)> {
        let share = match table.frame_rate_hz {
            Some(rate) => {
                let rate = self.positive(rate, "scan.frame_rate_hz")?;
                let share = exposure_ms * 1e-3 * rate;
                let expected = format!("at most one frame in the exposure of {exposure_ms} ms");
                self.check(share <= 1.0, "scan.frame_rate_hz", &expected)?;
                Some(share)
            }
            None => None,
        };
        let poses = table.motion_samples;
        let key = "scan.motion_samples";
        self.check((1..=64).contains(&poses), key, "from 1 to 64")?;
        let known = share.is_some() || poses == 1;
        self.check(known, key, "1, or scan.frame_rate_hz to be given")?;
        Ok((share, poses))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(moves: MovingBody, motion: PathMotion) -> ScanPath {
        ScanPath {
            frames: 5,
            moves,
            motion,
            start: DVec3::new(1.0, 2.0, 3.0),
            exposure_share: None,
            motion_samples: 1,
        }
    }

    fn rotary(step_deg: f64) -> PathMotion {
        PathMotion::Rotary {
            axis_point: DVec3::new(0.0, 5.0, -7.0),
            axis_direction: DVec3::X,
            step_deg,
            start_deg: 30.0,
        }
    }

    fn assert_close(a: &Rigid, b: &Rigid) {
        let turned = (a.rotation - b.rotation).to_cols_array();
        assert!(turned.iter().all(|x| x.abs() < 1e-14), "{a:?} {b:?}");
        assert!((a.translation - b.translation).length() < 1e-13);
    }

    #[test]
    fn a_rotary_table_turns_about_its_axis_and_keeps_the_points_on_it() {
        let path = path(MovingBody::Part, rotary(60.0));
        let rest = Rigid::translation(DVec3::new(4.0, 5.0, -5.0));
        // A rotation of 90° about x, in frame 1, maps y to z and z to −y.
        let part = path.world_from_part(1.0, &rest);
        assert!((part.translation - DVec3::new(4.0, 3.0, -7.0)).length() < 1e-14);
        assert!((part.vector(DVec3::Y) - DVec3::Z).length() < 1e-15);
        let on_axis = DVec3::new(9.0, 5.0, -7.0);
        assert!((path.motion.at(3.3).point(on_axis) - on_axis).length() < 1e-14);
        assert_eq!(path.world_from_head(1.0), Rigid::translation(path.start));
    }

    /// A rotation of the part equals the opposite rotation of the head.
    #[test]
    fn head_and_part_see_the_same_when_either_moves() {
        let rest = Rigid::from_euler_xyz(DVec3::new(0.1, 0.2, 0.3), DVec3::new(7.0, 8.0, 9.0));
        let part_from_head =
            |path: ScanPath| path.world_from_part(2.0, &rest).inverse() * path.world_from_head(2.0);
        let PathMotion::Rotary { axis_point, .. } = rotary(0.0) else {
            unreachable!()
        };
        let back = PathMotion::Rotary {
            axis_point,
            axis_direction: -DVec3::X,
            step_deg: 17.0,
            start_deg: 30.0,
        };
        assert_close(
            &part_from_head(path(MovingBody::Head, rotary(17.0))),
            &part_from_head(path(MovingBody::Part, back)),
        );
    }

    #[test]
    fn a_list_of_poses_is_met_exactly_joined_between_and_carried_on() {
        let pose = |angle, x| Rigid::from_euler_xyz(DVec3::Z * angle, DVec3::new(x, 0.0, 0.0));
        let list = |poses: Vec<Rigid>| PathMotion::Poses {
            file: PathBuf::new(),
            poses: poses.into(),
        };
        let motion = list(vec![pose(0.0, 0.0), pose(0.2, 1.0), pose(0.2, 5.0)]);
        assert_eq!(motion.at(0.0), pose(0.0, 0.0));
        assert_eq!(motion.at(1.0), pose(0.2, 1.0));
        assert_eq!(motion.at(2.0), pose(0.2, 5.0));
        assert_close(&motion.at(0.25), &pose(0.05, 0.25));
        assert_close(&motion.at(1.5), &pose(0.2, 3.0));
        assert_close(&motion.at(-0.5), &pose(-0.1, -0.5));
        assert_close(&motion.at(2.25), &pose(0.2, 6.0));
        for place in [-1.0, 0.0, 0.4, 1.0, 2.0] {
            assert_eq!(list(vec![pose(0.3, 2.0)]).at(place), pose(0.3, 2.0));
        }
    }

    #[test]
    fn the_poses_of_an_exposure_lie_about_the_frame() {
        let mut path = path(MovingBody::Head, rotary(1.0));
        path.exposure_share = Some(0.4);
        let places = |path: &ScanPath| path.exposure_places(7).collect::<Vec<_>>();
        assert_eq!(places(&path), [7.0]);
        path.motion_samples = 4;
        for (place, expected) in places(&path).into_iter().zip([6.85, 6.95, 7.05, 7.15]) {
            assert!((place - expected).abs() < 1e-14);
        }
    }
}
