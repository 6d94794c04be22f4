//! What spoils a scan, as numbers and in words.

use crate::inspect::chart::short;
use crate::scene::Unit;
use serde::Serialize;
use std::fmt;

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
