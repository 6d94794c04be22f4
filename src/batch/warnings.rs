//! Why a scan gives nothing, or nothing worth having: the same words before it, from the
//! geometry of the scene, and after it, from what the frames gave.

use super::check::MeasuringRange;
use super::survey::{Fate, Miss, Survey, least_counts};
use crate::accel::{Accel, Ray};
use crate::error::{Error, Result};
use crate::inspect::chart::short;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::flags::count_flags;
use crate::math::DVec3;
use crate::profile::blinding_height;
use crate::scene::{Motion, Scene, Unit};
use rayon::prelude::*;
use serde::Serialize;
use std::f64::consts::PI;
use std::fmt;
use std::ops::Range;

/// Less of the light than this share gives points: a scan of a few stray ones.
const WORTH_HAVING: f64 = 0.01;
/// A reason is named if it holds for this share of the light, or for more than others.
const WORTH_NAMING: f64 = 0.1;
/// A part so many times the field, or so small a share of it, is in another unit: on a
/// scale of ratios half way between a part of 100 fields and one of 1000, as a part that
/// fills the field becomes by the most common mistake, metres for millimetres.
const ANOTHER_UNIT: f64 = 316.0;
/// Poses between which the sensor is followed through the part.
const MOST_POSES: usize = 100_000;

/// Something that spoils a scan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Warning {
    #[serde(flatten)]
    pub reason: Reason,
    /// In words, with what to do.
    pub message: String,
}

/// What spoils a scan. Lengths in mm.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "kebab-case")]
pub enum Reason {
    /// No line was found in any frame.
    NothingMeasured { frames: usize },
    /// Every point has a flag; the one that most have.
    EveryPointDoubtful {
        points: usize,
        flag: &'static str,
        meaning: &'static str,
        flagged: usize,
    },
    /// All frames are taken at the same place.
    NoMotion { frames: usize },
    /// Largest size of the part over the width that the sensor measures.
    UnitDoubtful {
        part_mm: f64,
        field_mm: f64,
        unit: Unit,
        likely: Option<Unit>,
    },
    /// The laser's aperture or the camera's pupil is in the part in the scan's first frame.
    SensorInsidePart { body: &'static str },
    /// It passes through the part's surface after this frame.
    SensorThroughPart { body: &'static str, frame: u32 },
    /// In every frame the part is behind the laser.
    LaserLooksAway,
    /// The light passes the part; its plane at the nearest by so much, in this frame.
    LightMissesPart { frame: u32, by_mm: f64 },
    /// The plane of light crosses the part's bounding box, its rays pass the part.
    LightBesidePart,
    /// The camera sees nothing of the laser's light, wherever it falls.
    CameraLooksAway,
    /// The lit surface is nearer than the range: its highest place by so much.
    AboveRange {
        share: f64,
        by_mm: f64,
        range_mm: [f64; 2],
    },
    /// The lit surface is behind the range: its lowest place by so much.
    BelowRange {
        share: f64,
        by_mm: f64,
        range_mm: [f64; 2],
    },
    /// All the light falls on the part beside what the camera sees.
    OutOfView,
    /// The part is between the lit surface and the camera.
    HiddenFromCamera { share: f64 },
    /// Expected counts above black in the middle of the line, at the most.
    TooDark {
        share: f64,
        counts: f64,
        least_counts: f64,
    },
    /// Expected counts in the middle of the line, at the most, over the highest the sensor gives.
    Saturated { share: f64, times: f64 },
}

impl From<Reason> for Warning {
    fn from(reason: Reason) -> Warning {
        Warning {
            message: reason.to_string(),
            reason,
        }
    }
}

fn times(ratio: f64) -> String {
    match ratio {
        r if r >= 1.0 => format!("{} times", short(r)),
        r => format!("1/{} of", short(1.0 / r)),
    }
}

fn of_the_light(share: f64) -> String {
    match share {
        s if s > 0.995 => "All of the light".into(),
        s => format!("{} % of the light", short(100.0 * s)),
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let range = |[near, far]: &[f64; 2]| format!("{} to {} mm", short(*near), short(*far));
        match self {
            Reason::NothingMeasured { frames } => {
                write!(
                    f,
                    "Nothing was measured: no laser line was found in any of {frames} frames."
                )
            }
            Reason::EveryPointDoubtful {
                points,
                flag,
                meaning,
                flagged,
            } => write!(
                f,
                "None of the {points} points is valid: each has a flag, most of them ({flagged}) \
                 the flag {flag}: {meaning}."
            ),
            Reason::NoMotion { frames } => write!(
                f,
                "Head and part do not move: all {frames} frames are taken at the same place. Give \
                 the path a step other than 0, or the scan one frame."
            ),
            Reason::UnitDoubtful {
                part_mm,
                field_mm,
                unit,
                likely,
            } => {
                write!(
                    f,
                    "The part is {} mm long, {} the {} mm that the sensor sees across. The unit \
                     of its file, {unit}, is probably wrong",
                    short(*part_mm),
                    times(part_mm / field_mm),
                    short(*field_mm)
                )?;
                match likely {
                    Some(likely) => write!(f, ": try part.mesh.unit = \"{likely}\"."),
                    None => write!(f, "; see part.mesh.unit."),
                }
            }
            Reason::SensorInsidePart { body } => write!(
                f,
                "The {body} is inside the part in the first frame. Move scan.start_mm or \
                 part.position_mm."
            ),
            Reason::SensorThroughPart { body, frame } => write!(
                f,
                "The {body} passes through the part's surface between frames {frame} and {}. Move \
                 the path away from the part.",
                frame + 1
            ),
            Reason::LaserLooksAway => write!(
                f,
                "The laser looks away from the part, which is behind it in every frame. Turn \
                 laser.direction round, or move the part."
            ),
            Reason::LightMissesPart { frame, by_mm } => write!(
                f,
                "The laser's light never meets the part: at the nearest, in frame {frame}, it \
                 passes {} mm beside it. Change the path (scan) or part.position_mm.",
                short(*by_mm)
            ),
            Reason::LightBesidePart => write!(
                f,
                "The laser's light never meets the part: its plane crosses the part's bounding \
                 box, but its rays pass beside the part. Change part.position_mm or \
                 laser.line.fan_deg."
            ),
            Reason::CameraLooksAway => write!(
                f,
                "The camera looks away from the laser's light and sees nothing of it, wherever \
                 the part is. Point camera.look_at_mm at the laser's light."
            ),
            Reason::AboveRange {
                share,
                by_mm,
                range_mm,
            } => write!(
                f,
                "{} falls on the part nearer to the laser than the measuring range, which is {} \
                 from it along the beam: the part's top is {} mm above the near end. Move sensor \
                 and part apart.",
                of_the_light(*share),
                range(range_mm),
                short(*by_mm)
            ),
            Reason::BelowRange {
                share,
                by_mm,
                range_mm,
            } => write!(
                f,
                "{} falls on the part behind the measuring range, which is {} from the laser \
                 along the beam: the part is up to {} mm below the far end. Move sensor and part \
                 together.",
                of_the_light(*share),
                range(range_mm),
                short(*by_mm)
            ),
            Reason::OutOfView => write!(
                f,
                "All of the light falls on the part to the side of what the camera sees. Change \
                 the path (scan), part.position_mm or camera.look_at_mm."
            ),
            Reason::HiddenFromCamera { share } => write!(
                f,
                "{} falls where the part itself hides it from the camera. Turn the part, or move \
                 the camera nearer to the laser.",
                of_the_light(*share)
            ),
            Reason::TooDark {
                share,
                counts,
                least_counts,
            } => write!(
                f,
                "{} gives too dark a line: at most {} counts above black are expected, and {} \
                 are needed to tell it from noise. Raise camera.exposure_ms or laser.power_mw.",
                of_the_light(*share),
                short(*counts),
                short(*least_counts)
            ),
            Reason::Saturated { share, times } => write!(
                f,
                "{} saturates the sensor: up to {} times the counts of a full pixel are \
                 expected. Lower camera.exposure_ms or laser.power_mw to 1/{} of what it is, or \
                 less.",
                of_the_light(*share),
                short(*times),
                short(*times)
            ),
        }
    }
}

/// What is known before a scan.
pub(super) struct Foreseen {
    pub range: Option<MeasuringRange>,
    pub warnings: Vec<Warning>,
}

/// What will spoil a scan of these frames; empty for a good one. `images`: lines are found
/// in images, so that their light counts.
pub(super) fn foreseen(scene: &Scene, accel: &Accel, frames: Range<u32>, images: bool) -> Foreseen {
    let mut reasons = Vec::new();
    reasons.extend(no_motion(scene, &frames));
    reasons.extend(sensor_and_part(scene, accel, &frames));
    let survey = Survey::of(scene, accel, frames);
    let range = survey.range;
    reasons.extend(range.and_then(|range| unit_doubtful(scene, accel, range.width_mm)));
    reasons.extend(of_the_survey(scene, &survey, images));
    Foreseen {
        range,
        warnings: reasons.into_iter().map(Warning::from).collect(),
    }
}

/// What a scan gave, and why if that is nothing.
pub(super) fn found(points: &[CloudPoint], frames: usize, foreseen: &[Warning]) -> Vec<Warning> {
    let result = match points.iter().any(CloudPoint::is_sound) {
        true => None,
        false if points.is_empty() => Some(Reason::NothingMeasured { frames }),
        false => {
            let flags = count_flags(points).into_iter();
            flags
                .max_by_key(|flag| flag.points)
                .map(|flag| Reason::EveryPointDoubtful {
                    points: points.len(),
                    flag: flag.name,
                    meaning: flag.meaning,
                    flagged: flag.points,
                })
        }
    };
    let result = result.map(Warning::from).into_iter();
    result.chain(foreseen.iter().cloned()).collect()
}

/// An error that says all of them, if there are any.
pub fn refuse(warnings: &[Warning]) -> Result<()> {
    match warnings.is_empty() {
        true => Ok(()),
        false => Err(Error::Warned(
            warnings.iter().map(|w| w.message.clone()).collect(),
        )),
    }
}

fn no_motion(scene: &Scene, frames: &Range<u32>) -> Option<Reason> {
    let rests = match &scene.scan.motion {
        Motion::Linear { step } => *step == DVec3::ZERO,
        Motion::Rotary { step_deg, .. } => *step_deg == 0.0,
        Motion::Poses { poses, .. } => {
            let poses = &poses[frames.start as usize..frames.end as usize];
            poses.iter().all(|pose| *pose == poses[0])
        }
    };
    (rests && frames.len() > 1).then_some(Reason::NoMotion {
        frames: frames.len(),
    })
}

/// Where laser and camera are in the part, or go through it.
fn sensor_and_part(scene: &Scene, accel: &Accel, frames: &Range<u32>) -> Vec<Reason> {
    let bodies = [
        ("laser", scene.head_from_laser.translation),
        ("camera", scene.head_from_camera.translation),
    ];
    let stride = frames.len().div_ceil(MOST_POSES).max(1);
    let mut reasons = Vec::new();
    for (body, in_head) in bodies {
        let at = |frame: u32| scene.part_from_head(frame).point(in_head);
        if is_inside(accel, at(frames.start)) {
            reasons.push(Reason::SensorInsidePart { body });
            continue;
        }
        let places: Vec<(u32, DVec3)> = frames
            .clone()
            .step_by(stride)
            .chain(frames.clone().last())
            .map(|frame| (frame, at(frame)))
            .collect();
        let through = places.windows(2).find(|pair| {
            let way = Ray::between(pair[0].1, pair[1].1);
            way.is_some_and(|way| accel.occluded(&[way]) != 0)
        });
        reasons.extend(through.map(|pair| Reason::SensorThroughPart {
            body,
            frame: pair[0].0,
        }));
    }
    reasons
}

/// Whether a closed surface that faces outward is around `p`: its triangles then fill the
/// whole solid angle 4π, else none of it. That of a triangle by van Oosterom & Strackee 1983.
fn is_inside(accel: &Accel, p: DVec3) -> bool {
    let mesh = accel.mesh();
    accel.poses().iter().any(|pose| {
        let p = pose.inverse().point(p);
        let bounds = mesh.bounds();
        if p.cmplt(bounds.min).any() || p.cmpgt(bounds.max).any() {
            return false;
        }
        let solid_angle: f64 = (0..mesh.triangles.len())
            .into_par_iter()
            .map(|i| {
                let [a, b, c] = mesh.triangle(i).map(|corner| corner - p);
                let (la, lb, lc) = (a.length(), b.length(), c.length());
                let volume = a.dot(b.cross(c));
                let rest = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
                2.0 * volume.atan2(rest)
            })
            .sum();
        // A hole of a tenth of all directions does not make a solid hollow.
        solid_angle > 0.9 * 4.0 * PI
    })
}

fn unit_doubtful(scene: &Scene, accel: &Accel, field_mm: f64) -> Option<Reason> {
    let unit = scene.mesh_unit?;
    let part_mm = accel.bounds().size().max_element();
    let off = |ratio: f64| ratio.max(1.0 / ratio);
    let ratio = part_mm / field_mm;
    if !ratio.is_finite() || ratio <= 0.0 || off(ratio) < ANOTHER_UNIT {
        return None;
    }
    let as_if = |other: &Unit| off(ratio * other.mm() / unit.mm());
    let likely = Unit::ALL
        .into_iter()
        .min_by(|a, b| as_if(a).total_cmp(&as_if(b)));
    Some(Reason::UnitDoubtful {
        part_mm,
        field_mm,
        unit,
        likely: likely.filter(|likely| as_if(likely) < ANOTHER_UNIT),
    })
}

fn of_the_survey(scene: &Scene, survey: &Survey, images: bool) -> Vec<Reason> {
    match survey.miss {
        Some(Miss::Behind) => return vec![Reason::LaserLooksAway],
        Some(Miss::Beside { frame, by_mm }) => {
            return vec![Reason::LightMissesPart { frame, by_mm }];
        }
        Some(Miss::OutsideFan) => return vec![Reason::LightBesidePart],
        None => {}
    }
    let Some(range) = survey.range else {
        return vec![Reason::CameraLooksAway];
    };
    let range_mm = [range.near_mm, range.far_mm];
    let least = least_counts(scene);
    let sensor = &scene.camera.sensor;
    let full = sensor.saturation_count() as f64 - sensor.black_level_dn;
    let contrast = scene.speckle.map_or(0.0, |s| s.coherence.contrast());
    let most = full * blinding_height(contrast * contrast);
    // A fan may well be wider than the view.
    let aside = survey.fates.iter().filter(|f| **f == Fate::OutOfView);
    let lit = (survey.fates.len() - aside.count()) as f64;
    if survey.fates.is_empty() {
        return Vec::new();
    }
    if lit == 0.0 {
        return vec![Reason::OutOfView];
    }
    // Share of the light in view with a fate, and the greatest number that goes with it.
    let of = |number: &dyn Fn(&Fate) -> Option<f64>| {
        let numbers: Vec<f64> = survey.fates.iter().filter_map(number).collect();
        let greatest = numbers.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (numbers.len() as f64 / lit, greatest)
    };
    let (near, above) = of(&|f| {
        if let Fate::TooNear(by) = f {
            Some(*by)
        } else {
            None
        }
    });
    let (far, below) = of(&|f| {
        if let Fate::TooFar(by) = f {
            Some(*by)
        } else {
            None
        }
    });
    let (hidden, _) = of(&|f| (*f == Fate::Hidden).then_some(0.0));
    let seen = |f: &Fate| {
        if let Fate::Seen(counts) = f {
            Some(*counts)
        } else {
            None
        }
    };
    let (dark, brightest) = of(&|f| seen(f).filter(|&c| images && c < least));
    let (bright, most_counts) = of(&|f| seen(f).filter(|&c| images && c > most));
    let all = [near, far, hidden, dark, bright];
    if 1.0 - all.iter().sum::<f64>() >= WORTH_HAVING {
        return Vec::new();
    }
    let reasons = [
        Reason::AboveRange {
            share: near,
            by_mm: above,
            range_mm,
        },
        Reason::BelowRange {
            share: far,
            by_mm: below,
            range_mm,
        },
        Reason::HiddenFromCamera { share: hidden },
        Reason::TooDark {
            share: dark,
            counts: brightest,
            least_counts: least,
        },
        Reason::Saturated {
            share: bright,
            times: most_counts / full,
        },
    ];
    let named = all.iter().copied().fold(0.0, f64::max).min(WORTH_NAMING);
    let named = all
        .into_iter()
        .zip(reasons)
        .filter(|(share, _)| *share >= named);
    named.map(|(_, reason)| reason).collect()
}
