//! What spoils a scan, as numbers and in words.

use crate::report::chart::short;
use crate::scene::Unit;
use serde::Serialize;
use std::fmt;

/// Something that spoils a scan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Warning {
    /// Why, for programs.
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
    NothingMeasured {
        /// Number of frames.
        frames: usize,
    },
    /// Every point has a flag; the one that most have.
    EveryPointDoubtful {
        /// Number of points.
        points: usize,
        /// Name of the flag.
        flag: &'static str,
        /// What it says of a point.
        meaning: &'static str,
        /// Points that carry it.
        flagged: usize,
    },
    /// The mesh's file has content that was not used and without which the part may have another shape.
    MeshIncomplete {
        /// Each in words.
        ignored: Vec<String>,
    },
    /// All frames are taken at the same place.
    NoMotion {
        /// Number of frames.
        frames: usize,
    },
    /// Largest size of the part over the width that the sensor measures.
    UnitDoubtful {
        /// Largest size of the part.
        part_mm: f64,
        /// Width that the sensor measures.
        field_mm: f64,
        /// Unit that the scene names for the mesh.
        unit: Unit,
        /// Unit in which the part would fit, if there is one.
        likely: Option<Unit>,
    },
    /// The laser's aperture or the camera's pupil is in the part in the scan's first frame.
    SensorInsidePart {
        /// What of the sensor, in words.
        body: &'static str,
    },
    /// It passes through the part's surface after this frame.
    SensorThroughPart {
        /// What of the sensor, in words.
        body: &'static str,
        /// Number of the frame.
        frame: u32,
    },
    /// The sensor's housing meets the part's surface.
    HousingTouchesPart {
        /// The first frame in which it does.
        frame: u32,
        /// Where, in the part's frame.
        place_mm: [f64; 3],
    },
    /// A lobe narrower than the lens's pupil, whose speckle is simulated as if fully developed.
    SpeckleNotDeveloped {
        /// Least roughness α of the surface.
        roughness: f64,
        /// Half the angle of the pupil as the part sees it, rad.
        pupil_half_angle: f64,
        /// A quarter of the wavelength.
        quarter_wavelength_um: f64,
    },
    /// More paths than are allowed would be needed to follow light that is reflected more than once without noise.
    ReflectionsNoisy {
        /// Noise of the paths over the sensor's own where either shows: 99 of 100 places have less.
        times: f64,
    },
    /// In every frame the part is behind the laser.
    LaserLooksAway,
    /// The light passes the part; its plane at the nearest by so much, in this frame.
    LightMissesPart {
        /// Number of the frame.
        frame: u32,
        /// Distance of the part from the plane.
        by_mm: f64,
    },
    /// The plane of light crosses the part's bounding box, its rays pass the part.
    LightBesidePart,
    /// The camera sees nothing of the laser's light, wherever it falls.
    CameraLooksAway,
    /// The lit surface is nearer than the range: its highest place by so much.
    AboveRange {
        /// Share of the light.
        share: f64,
        /// The farthest.
        by_mm: f64,
        /// Least and greatest distance from the laser that the camera sees.
        range_mm: [f64; 2],
    },
    /// The lit surface is behind the range: its lowest place by so much.
    BelowRange {
        /// Share of the light.
        share: f64,
        /// The farthest.
        by_mm: f64,
        /// Least and greatest distance from the laser that the camera sees.
        range_mm: [f64; 2],
    },
    /// All the light falls on the part beside what the camera sees.
    OutOfView,
    /// The part is between the lit surface and the camera.
    HiddenFromCamera {
        /// Share of the light.
        share: f64,
    },
    /// Expected counts above black in the middle of the line, at the most.
    TooDark {
        /// Share of the light.
        share: f64,
        /// Expected counts.
        counts: f64,
        /// Counts that a line needs to be found.
        least_counts: f64,
    },
    /// Expected counts in the middle of the line, at the most, over the highest the sensor gives.
    Saturated {
        /// Share of the light.
        share: f64,
        /// Ratio of the two.
        times: f64,
    },
}

impl From<Reason> for Warning {
    fn from(reason: Reason) -> Warning {
        Warning {
            message: reason.to_string(),
            reason,
        }
    }
}

/// So many times, or the share of.
fn times(ratio: f64) -> String {
    match ratio {
        r if r >= 1.0 => format!("{} times", short(r)),
        r => format!("1/{} of", short(1.0 / r)),
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let text = self.of_the_result().or_else(|| self.of_the_setup());
        f.write_str(&text.unwrap_or_else(|| self.of_the_light()))
    }
}

impl Reason {
    fn of_the_result(&self) -> Option<String> {
        Some(match self {
            Reason::NothingMeasured { frames } => {
                format!("Nothing was measured: no laser line was found in any of {frames} frames.")
            }
            Reason::EveryPointDoubtful {
                points,
                flag,
                meaning,
                flagged,
            } => format!(
                "None of the {points} points is valid: each has a flag, most of them ({flagged}) \
                 the flag {flag}: {meaning}."
            ),
            Reason::ReflectionsNoisy { times } => format!(
                "Light that is reflected more than once is followed by as many paths as are allowed, and their noise \
                 is still up to {} times the sensor's own: reflections are grainy, and points in them scatter farther \
                 than stated. Give a greater roughness, a shorter exposure, the mean of scans with several seeds, or \
                 plan.reflections = 1 for direct light alone.",
                short(*times)
            ),
            _ => return None,
        })
    }

    /// Where sensor, path and part are.
    fn of_the_setup(&self) -> Option<String> {
        Some(match self {
            Reason::MeshIncomplete { ignored } => format!(
                "The part may have another shape than its file states, for these were not read: {}. Export the part \
                 from its program as plain triangles, with everything applied.",
                ignored.join("; ")
            ),
            Reason::NoMotion { frames } => format!(
                "Sensor and part do not move: all {frames} frames are taken at the same place. \
                 Give the path a step other than 0, or the scan one frame."
            ),
            Reason::UnitDoubtful {
                part_mm,
                field_mm,
                unit,
                likely,
            } => format!(
                "The part is {} mm long, {} the {} mm that the sensor sees across. The unit of \
                 its file, {unit}, is probably wrong{}",
                short(*part_mm),
                times(part_mm / field_mm),
                short(*field_mm),
                match likely {
                    Some(likely) => format!(": try part.mesh.unit = \"{likely}\"."),
                    None => "; see part.mesh.unit.".to_owned(),
                }
            ),
            Reason::SensorInsidePart { body } => format!(
                "The {body} is inside the part in the first frame. Move scan.start_mm or \
                 part.position_mm."
            ),
            Reason::SensorThroughPart { body, frame } => format!(
                "The {body} passes through the part's surface after frame {frame}. Move the path \
                 away from the part."
            ),
            Reason::HousingTouchesPart { frame, place_mm } => format!(
                "The sensor's housing (housing_mm) touches the part, first in frame {frame}, near ({}) mm of the part's \
                 frame. Move the path away from the part, or turn the sensor.",
                place_mm.map(short).join(", ")
            ),
            Reason::SpeckleNotDeveloped {
                roughness,
                pupil_half_angle,
                quarter_wavelength_um,
            } => format!(
                "The surface of roughness {} is too smooth for speckle as it is simulated: its facets are less \
                 steep than half the angle of the lens's pupil, {} rad, so that within a grain heights differ by less \
                 than a quarter of the wavelength, {} µm. Contrast and errors of points are less there than \
                 simulated. Give a greater roughness, a larger f-number, or speckle = false.",
                short(*roughness),
                short(*pupil_half_angle),
                short(*quarter_wavelength_um)
            ),
            Reason::LaserLooksAway => "The laser looks away from the part, which is behind it in \
                 every frame. Turn laser.direction round, or move the part."
                .to_owned(),
            Reason::LightMissesPart { frame, by_mm } => format!(
                "The laser's light never meets the part: at the nearest, in frame {frame}, it \
                 passes {} mm beside it. Change the path (scan) or part.position_mm.",
                short(*by_mm)
            ),
            Reason::LightBesidePart => "The laser's light never meets the part: its plane crosses \
                 the part's bounding box, but its rays pass the part by. Change part.position_mm \
                 or laser.line.fan_deg."
                .to_owned(),
            Reason::CameraLooksAway => "The camera looks away from the laser's light and sees \
                 nothing of it, wherever the part is. Point camera.look_at_mm at the laser's light."
                .to_owned(),
            _ => return None,
        })
    }

    /// What becomes of the light on the part.
    fn of_the_light(&self) -> String {
        let share = match self {
            Reason::AboveRange { share, .. }
            | Reason::BelowRange { share, .. }
            | Reason::HiddenFromCamera { share }
            | Reason::TooDark { share, .. }
            | Reason::Saturated { share, .. } => *share,
            _ => 1.0,
        };
        let light = match share {
            share if share > 0.995 => "All of the light".to_owned(),
            share => format!("{} % of the light", short(100.0 * share)),
        };
        let rest = match self {
            Reason::AboveRange {
                by_mm,
                range_mm: [near, far],
                ..
            } => format!(
                "falls on the part nearer to the laser than the measuring range, which is {} to \
                 {} mm from it along the beam: the part's top is {} mm above the near end. Move \
                 sensor and part apart: change part.position_mm or the path (scan).",
                short(*near),
                short(*far),
                short(*by_mm)
            ),
            Reason::BelowRange {
                by_mm,
                range_mm: [near, far],
                ..
            } => format!(
                "falls on the part beyond the measuring range, which is {} to {} mm from the \
                 laser along the beam: the part is up to {} mm below the far end. Move sensor and \
                 part together: change part.position_mm or the path (scan).",
                short(*near),
                short(*far),
                short(*by_mm)
            ),
            Reason::HiddenFromCamera { .. } => "falls where the part itself hides it from the \
                 camera. Turn the part, or move the camera nearer to the laser."
                .to_owned(),
            Reason::TooDark {
                counts,
                least_counts,
                ..
            } => format!(
                "gives too dark a line: at most {} counts above black are expected, and {} are \
                 needed to tell it from noise. Raise camera.exposure_ms or laser.power_mw.",
                short(*counts),
                short(*least_counts)
            ),
            Reason::Saturated { times, .. } => format!(
                "saturates the sensor: up to {0} times the counts of a full pixel are expected. \
                 Lower camera.exposure_ms or laser.power_mw to 1/{0} of what it is, or less.",
                short(*times)
            ),
            _ => "falls on the part to the side of what the camera sees. Change the path (scan), \
                 part.position_mm or camera.look_at_mm."
                .to_owned(),
        };
        format!("{light} {rest}")
    }
}
