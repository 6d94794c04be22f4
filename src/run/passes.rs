//! Division of the path of a scan into passes: sequences of frames without a jump or a turn.

use super::light_survey::part_from_laser;
use crate::math::DVec3;
use crate::scene::{PathMotion, Scene};
use std::ops::RangeInclusive;

/// Length above which a step leads to the next pass, in median steps.
const JUMP_STEPS: f64 = 10.0;
/// Cosine of the change of direction at which a pass ends: 45°.
const TURN_COSINE: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Maximum number of laser plane poses that are searched, uniformly distributed over the path.
const MAX_POSES: usize = 10_000;

/// The passes of a path, and its length.
pub(crate) struct Passes {
    /// First and last frame of each pass. Two passes have the frame of a turn in common.
    pub frames: Vec<RangeInclusive<u32>>,
    /// Median length of the steps along passes, mm; `None` for a rotary table, or if nothing moves.
    pub step: Option<f64>,
    /// Length along all passes, without the jumps between them, mm; `None` for a rotary table.
    pub travel: Option<f64>,
}

impl Passes {
    /// Divides the path. `reference` is the position in the head that is tracked over the part.
    pub fn of(scene: &Scene, frames: &std::ops::Range<u32>, reference: DVec3) -> Passes {
        let one = |step: Option<f64>, travel| Passes {
            frames: vec![frames.start..=frames.end - 1],
            step: step.filter(|&step| step > 0.0),
            travel,
        };
        match &scene.scan.motion {
            PathMotion::Linear { step } => {
                let step = step.length();
                one(Some(step), Some(step * (frames.len() - 1) as f64))
            }
            PathMotion::Rotary { .. } => one(None, None),
            PathMotion::Poses { .. } => {
                let position = |frame| scene.part_from_head(frame).point(reference);
                let positions: Vec<DVec3> = frames.clone().map(position).collect();
                Passes::of_positions(&positions, frames.start)
            }
        }
    }

    fn of_positions(positions: &[DVec3], first: u32) -> Passes {
        let steps: Vec<DVec3> = positions.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let mut lengths: Vec<f64> = steps.iter().map(|step| step.length()).collect();
        lengths.retain(|&length| length > 0.0);
        let median = lengths.len() / 2;
        let step = match lengths.is_empty() {
            true => None,
            false => Some(*lengths.select_nth_unstable_by(median, f64::total_cmp).1),
        };
        let jump = step.map_or(f64::INFINITY, |step| JUMP_STEPS * step);
        let mut passes = Vec::new();
        let (mut start, mut travel, mut before) = (0, 0.0, None::<DVec3>);
        for (i, &way) in steps.iter().enumerate() {
            let length = way.length();
            if length == 0.0 {
                continue;
            }
            let frame = first + i as u32;
            if length > jump {
                passes.push(first + start..=frame);
                start = i as u32 + 1;
                before = None;
                continue;
            }
            travel += length;
            let turns = before.is_some_and(|b| b.dot(way) < TURN_COSINE * b.length() * length);
            if turns {
                passes.push(first + start..=frame);
                start = i as u32;
            }
            before = Some(way);
        }
        passes.push(first + start..=first + steps.len() as u32);
        Passes {
            frames: passes,
            step,
            travel: Some(travel),
        }
    }
}

/// Laser plane at a pose, in the part's frame: n·p = c.
struct Sheet {
    frame: f64,
    normal: DVec3,
    offset: f64,
}

/// The laser plane along the passes.
pub(crate) struct Sheets(Vec<Vec<Sheet>>);

impl Sheets {
    pub fn of(scene: &Scene, passes: &Passes) -> Sheets {
        let all: usize = passes.frames.iter().map(|pass| pass.clone().count()).sum();
        let stride = all.div_ceil(MAX_POSES).max(1);
        let sheet = |frame: u32| {
            let part_from_laser = part_from_laser(scene, frame);
            let normal = part_from_laser.rotation.y_axis;
            Sheet {
                frame: f64::from(frame),
                normal,
                offset: normal.dot(part_from_laser.translation),
            }
        };
        let of_pass = |pass: &RangeInclusive<u32>| {
            let ends_on_stride = (pass.clone().count() - 1).is_multiple_of(stride);
            let last = (!ends_on_stride).then_some(*pass.end());
            pass.clone()
                .step_by(stride)
                .chain(last)
                .map(sheet)
                .collect()
        };
        Sheets(passes.frames.iter().map(of_pass).collect())
    }

    /// Returns the path parameters at which the laser plane passes through a point of the part.
    pub fn through(&self, point: DVec3) -> impl Iterator<Item = f64> + '_ {
        let distance = move |sheet: &Sheet| sheet.normal.dot(point) - sheet.offset;
        let between = move |pair: &[Sheet]| {
            let [before, after] = [distance(&pair[0]), distance(&pair[1])];
            let crossed = (before < 0.0) != (after < 0.0);
            let part = before / (before - after);
            crossed.then(|| pair[0].frame + part * (pair[1].frame - pair[0].frame))
        };
        self.0
            .iter()
            .flat_map(move |pass| pass.windows(2).filter_map(between))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Passes along y have random spacings and alternate in direction. Jumps or steps along x join
    /// them. The number of passes and their total length must be found.
    #[test]
    fn passes_end_at_jumps_and_turns() {
        for seed in 0..20 {
            let key = RngKey::new(seed, Purpose::Bootstrap);
            let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
            let (step, count) = (between(0, 0.05, 2.0), 2 + (between(1, 0.0, 4.0) as usize));
            let steps = 30 + between(2, 0.0, 40.0) as usize;
            let joined = seed.is_multiple_of(2);
            let aside = step * (between(3, 15.0, 25.0).floor());
            let (mut positions, mut x) = (Vec::new(), 0.0);
            for pass in 0..count {
                let y = |i: usize| {
                    step * if joined && pass % 2 == 1 {
                        steps - i
                    } else {
                        i
                    } as f64
                };
                positions.extend((0..=steps).map(|i| DVec3::new(x, y(i), 0.0)));
                if joined && pass + 1 < count {
                    let n = (aside / step).round() as usize;
                    positions
                        .extend((1..n).map(|i| DVec3::new(x + step * i as f64, y(steps), 0.0)));
                }
                x += aside;
            }
            let passes = Passes::of_positions(&positions, 7);
            let expected = if joined { 2 * count - 1 } else { count };
            assert_eq!(passes.frames.len(), expected, "{seed}: {:?}", passes.frames);
            assert_eq!(*passes.frames[0].start(), 7);
            let last = 7 + positions.len() as u32 - 1;
            assert_eq!(*passes.frames[expected - 1].end(), last);
            let along = count as f64 * steps as f64 * step;
            let across = if joined {
                (count - 1) as f64 * aside
            } else {
                0.0
            };
            let travel = passes.travel.unwrap();
            assert!(
                (travel - along - across).abs() < 1e-9 * along,
                "{seed}: {travel}"
            );
            assert!((passes.step.unwrap() - step).abs() < 1e-9 * step);
        }
    }
}
