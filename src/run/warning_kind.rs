//! Problems of a scan, as numbers and as text.

use crate::report::chart::short;
use crate::scene::Unit;
use serde::Serialize;
use std::fmt;

/// Remedies for a scan that takes long.
pub(super) const SHORTER_SCAN: &str = "Lower scan.frames and raise scan.step_mm, use model.geometry_only, \
     or divide the frames between machines (scan --shard).";

/// A problem of a scan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Warning {
    /// Machine-readable cause.
    #[serde(flatten)]
    pub reason: WarningKind,
    /// Text with the cause and a remedy.
    pub message: String,
}

/// Cause of a problem. Lengths are in mm.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "kebab-case")]
pub enum WarningKind {
    /// No line was found in any frame.
    NothingMeasured {
        /// Number of frames.
        frames: usize,
    },
    /// Every point has a flag. The fields name the most frequent flag.
    EveryPointDoubtful {
        /// Number of points.
        points: usize,
        /// Name of the flag.
        flag: &'static str,
        /// Meaning of the flag.
        meaning: &'static str,
        /// Number of points with the flag.
        flagged: usize,
    },
    /// Many points are saturated, although no warning before the scan predicted it.
    PointsSaturated {
        /// Number of points.
        points: usize,
        /// Points with the flag saturated.
        saturated: usize,
    },
    /// The mesh file has unused content, without which the shape of the part may differ.
    MeshIncomplete {
        /// Description of each unused item.
        ignored: Vec<String>,
    },
    /// All frames are taken at one position.
    NoMotion {
        /// Number of frames.
        frames: usize,
    },
    /// The size of the part does not fit the width of the measuring field; the unit may be wrong.
    UnitDoubtful {
        /// Largest dimension of the part.
        part_mm: f64,
        /// Width of the measuring field.
        field_mm: f64,
        /// Unit of the mesh that the scene states.
        unit: Unit,
        /// Unit in which the part would fit; `None` if there is no such unit.
        likely: Option<Unit>,
    },
    /// The laser aperture or the camera pupil is inside the part at the start of a pass.
    SensorInsidePart {
        /// Name of the component of the sensor.
        body: &'static str,
        /// Number of the first frame of the pass.
        frame: u32,
    },
    /// The laser aperture or the camera pupil passes through the part's surface after this frame.
    SensorThroughPart {
        /// Name of the component of the sensor.
        body: &'static str,
        /// Number of the frame.
        frame: u32,
    },
    /// The sensor housing intersects the part's surface.
    HousingTouchesPart {
        /// First frame with an intersection.
        frame: u32,
        /// Position of the intersection in the part's frame.
        place_mm: [f64; 3],
    },
    /// A lobe is narrower than the lens pupil, but its speckle is simulated as fully developed.
    SpeckleNotDeveloped {
        /// Smallest roughness α of the surface.
        roughness: f64,
        /// Half-angle of the pupil as viewed from the part, rad.
        pupil_half_angle: f64,
        /// Quarter of the wavelength, µm.
        quarter_wavelength_um: f64,
    },
    /// Indirect light would need more paths than the limit allows to be free of visible path noise.
    ReflectionsNoisy {
        /// Ratio of path noise to sensor noise where either is visible; 99 % quantile over pixel
        /// blocks.
        times: f64,
    },
    /// In every frame the part is behind the laser.
    LaserLooksAway,
    /// The light misses the part. The fields describe the closest approach.
    LightMissesPart {
        /// Number of the frame.
        frame: u32,
        /// Distance of the part from the laser plane.
        by_mm: f64,
    },
    /// The laser plane crosses the part's bounding box, but its rays miss the part.
    LightBesidePart,
    /// The camera sees no laser light at any distance.
    CameraLooksAway,
    /// The lit surface is nearer than the measuring range.
    AboveRange {
        /// Fraction of the light.
        share: f64,
        /// Largest distance from the measuring range.
        by_mm: f64,
        /// Smallest and largest distance from the laser that the camera sees.
        range_mm: [f64; 2],
    },
    /// The lit surface is beyond the measuring range.
    BelowRange {
        /// Fraction of the light.
        share: f64,
        /// Largest distance from the measuring range.
        by_mm: f64,
        /// Smallest and largest distance from the laser that the camera sees.
        range_mm: [f64; 2],
    },
    /// All light on the part is outside the camera's field of view.
    OutOfView,
    /// The part is between the lit surface and the camera.
    HiddenFromCamera {
        /// Fraction of the light.
        share: f64,
    },
    /// Most of the lit surface faces away from the camera.
    FacesAway {
        /// Fraction of the light.
        fraction: f64,
    },
    /// The line in the image is much wider than at the best focus.
    OutOfFocus {
        /// Fraction of the light.
        fraction: f64,
        /// Largest width, relative to the width at the best focus.
        times: f64,
        /// Accepted width, relative to the width at the best focus.
        limit: f64,
    },
    /// Several causes in combination leave surface within the field without valid points.
    SurfaceNotMeasured {
        /// Fraction of the surface within the field.
        fraction: f64,
    },
    /// The field passes to the side of the part while surface on its other side is outside the
    /// field.
    DisplacedSideways {
        /// Fraction of the field that passes outside the part.
        field: f64,
        /// Fraction of the measurable surface outside the field.
        missed: f64,
    },
    /// The path runs outside the part while part of its length is never passed.
    DisplacedAlongPath {
        /// Fraction of the frames that see nothing of the part.
        frames: f64,
        /// Fraction of the measurable surface that is never passed.
        missed: f64,
    },
    /// The part is outside the view of most frames.
    MostlyOutsidePart {
        /// Fraction of the frames.
        frames: f64,
        /// Length of the path, mm; `None` for a rotary table.
        travel_mm: Option<f64>,
    },
    /// Neighbouring passes leave surface between them that neither measures.
    PassesTooFarApart {
        /// Distance between the passes, mm.
        spacing_mm: f64,
        /// Width of the field where the part is nearest to the laser, mm.
        field_mm: f64,
        /// The largest accepted spacing, mm.
        limit_mm: f64,
    },
    /// The part is higher than the measuring range and is therefore measured in layers.
    DeeperThanRange {
        /// Height of the part along the beam.
        part_mm: f64,
        /// Depth of the measuring range.
        range_mm: f64,
        /// Number of layers.
        layers: usize,
        /// Distance of the lowest layer from the highest.
        lowered_mm: f64,
    },
    /// The path takes long at its frame rate.
    LongPath {
        /// Duration, h.
        hours: f64,
        /// Number of frames.
        frames: usize,
        /// Frames per second.
        rate_hz: f64,
        /// Accepted duration, h.
        limit_h: f64,
    },
    /// The simulation of the path takes long on this machine.
    LongSimulation {
        /// Forecast, h.
        hours: f64,
        /// Number of frames.
        frames: usize,
        /// Accepted duration, h.
        limit_h: f64,
    },
    /// Steps are much shorter than the distance between columns.
    StepsTooShort {
        /// Median step between consecutive frames, mm.
        step_mm: f64,
        /// Distance between columns, mm.
        column_mm: f64,
        /// Length of the path, mm.
        travel_mm: f64,
        /// Whether the poses are read from a file.
        poses: bool,
    },
    /// The counts above black at the centre of the line are too low.
    TooDark {
        /// Fraction of the light.
        share: f64,
        /// Largest expected counts.
        counts: f64,
        /// Counts that a line needs to be detected.
        least_counts: f64,
    },
    /// The expected counts at the centre of the line exceed the full scale of the sensor.
    Saturated {
        /// Fraction of the light.
        share: f64,
        /// Largest expected counts, relative to full scale.
        times: f64,
    },
}

impl From<WarningKind> for Warning {
    fn from(reason: WarningKind) -> Warning {
        Warning {
            message: reason.to_string(),
            reason,
        }
    }
}

/// Formats a ratio as "n times" or "1/n of".
fn times(ratio: f64) -> String {
    match ratio {
        r if r >= 1.0 => format!("{} times", short(r)),
        r => format!("1/{} of", short(1.0 / r)),
    }
}

impl fmt::Display for WarningKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let text = self
            .result_warnings()
            .or_else(|| self.setup_warnings())
            .or_else(|| self.of_the_path())
            .or_else(|| self.of_the_duration());
        f.write_str(&text.unwrap_or_else(|| self.light_warnings()))
    }
}

impl WarningKind {
    fn result_warnings(&self) -> Option<String> {
        Some(match self {
            WarningKind::NothingMeasured { frames } => {
                format!("Nothing was measured: no laser line was found in any of {frames} frames.")
            }
            WarningKind::EveryPointDoubtful {
                points,
                flag,
                meaning,
                flagged,
            } => format!(
                "None of the {points} points is valid: each has a flag, most of them ({flagged}) \
                 the flag {flag}: {meaning}."
            ),
            WarningKind::PointsSaturated { points, saturated } => format!(
                "{saturated} of the {points} points are saturated and not valid. Lower camera.exposure_ms or \
                 laser.power_mw, or take several exposures (camera.hdr_exposures_ms)."
            ),
            WarningKind::ReflectionsNoisy { times } => format!(
                "Indirect light has the maximum number of paths, and their noise is up to {} times the sensor noise: \
                 reflections are grainy, and points in them scatter more than stated. Give a greater roughness, a \
                 shorter exposure, the mean of scans with several seeds, or model.max_bounces = 1 for direct light \
                 only.",
                short(*times)
            ),
            _ => return None,
        })
    }

    /// Returns the text for problems with the positions of sensor, path and part.
    fn setup_warnings(&self) -> Option<String> {
        Some(match self {
            WarningKind::MeshIncomplete { ignored } => format!(
                "The part may have another shape than its file states, for these were not read: {}. Export the part \
                 from its program as plain triangles, with everything applied.",
                ignored.join("; ")
            ),
            WarningKind::NoMotion { frames } => format!(
                "Sensor and part do not move: all {frames} frames are taken at the same place. \
                 Give the path a step other than 0, or the scan one frame."
            ),
            WarningKind::UnitDoubtful {
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
            WarningKind::SensorInsidePart { body, frame } => format!(
                "The {body} is inside the part in frame {frame}. Move the path (scan) or \
                 part.position_mm."
            ),
            WarningKind::SensorThroughPart { body, frame } => format!(
                "The {body} passes through the part's surface after frame {frame}. Move the path \
                 away from the part."
            ),
            WarningKind::HousingTouchesPart { frame, place_mm } => format!(
                "The sensor's housing (housing_bounds_mm) touches the part, first in frame {frame}, near ({}) mm of the part's \
                 frame. Move the path away from the part, or turn the sensor.",
                place_mm.map(short).join(", ")
            ),
            WarningKind::SpeckleNotDeveloped {
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
            _ => return self.view_warnings(),
        })
    }

    /// Returns the text for light that misses the part or the camera.
    fn view_warnings(&self) -> Option<String> {
        Some(match self {
            WarningKind::LaserLooksAway => {
                "The laser looks away from the part, which is behind it in \
                 every frame. Turn laser.direction round, or move the part."
                    .to_owned()
            }
            WarningKind::LightMissesPart { frame, by_mm } => format!(
                "The laser's light never hits the part. It is nearest in frame {frame}, at a \
                 distance of {} mm. Change the path (scan) or part.position_mm.",
                short(*by_mm)
            ),
            WarningKind::LightBesidePart => {
                "The laser's light never hits the part: its plane crosses \
                 the part's bounding box, but its rays miss the part. Change part.position_mm \
                 or laser.line.fan_deg."
                    .to_owned()
            }
            WarningKind::CameraLooksAway => {
                "The camera looks away from the laser's light and sees \
                 nothing of it, wherever the part is. Point camera.look_at_mm at the laser's light."
                    .to_owned()
            }
            _ => return None,
        })
    }

    /// Returns the text for problems with the path over the part.
    fn of_the_path(&self) -> Option<String> {
        let percent = |fraction: f64| short(100.0 * fraction);
        Some(match self {
            WarningKind::DisplacedSideways { field, missed } => format!(
                "{} % of the field passes to the side of the part, while {} % of the surface that the sensor could \
                 measure is outside the field on the other side. Move the path across its direction of travel: change \
                 scan.start_mm, scan.poses or part.position_mm.",
                percent(*field),
                percent(*missed)
            ),
            WarningKind::DisplacedAlongPath { frames, missed } => format!(
                "{} % of the frames see nothing of the part, while the laser plane never passes {} % of the surface \
                 that the sensor could measure. Move the path along its direction of travel, or extend it: change \
                 scan.start_mm, scan.poses or part.position_mm.",
                percent(*frames),
                percent(*missed)
            ),
            WarningKind::MostlyOutsidePart { frames, travel_mm } => format!(
                "{} % of the frames see nothing of the part{}. Shorten the path to the part: lower scan.frames or \
                 scan.step_mm, or remove the frames from scan.poses.",
                percent(*frames),
                travel_mm.map_or(String::new(), |mm| format!(
                    ": the path is {} mm long",
                    short(mm)
                ))
            ),
            WarningKind::PassesTooFarApart {
                spacing_mm,
                field_mm,
                limit_mm,
            } => format!(
                "Neighbouring passes are {} mm apart, and the field is {} mm wide at the top of the part: surface \
                 between them is not measured. Lower the distance between passes to {} mm or less, or turn to a \
                 sensor with a wider field.",
                short(*spacing_mm),
                short(*field_mm),
                short(*limit_mm)
            ),
            WarningKind::SurfaceNotMeasured { fraction } => format!(
                "{} % of the surface in the field gives no valid points, by several causes together; `check` lists \
                 them. Change the exposure, the focus, or the positions of sensor and part.",
                percent(*fraction)
            ),
            _ => return None,
        })
    }

    /// Returns the text for problems with the length and the steps of the path.
    fn of_the_duration(&self) -> Option<String> {
        Some(match self {
            WarningKind::DeeperThanRange {
                part_mm,
                range_mm,
                layers,
                lowered_mm,
            } => format!(
                "The part is {} mm high and the measuring range {} mm deep: the path has {layers} layers, and the \
                 sensor is {} mm lower in the last than in the first, where higher surface may be in its way. Use a \
                 sensor with a deeper range, turn the part (begin --up), or state housing_bounds_mm for `check` to test.",
                short(*part_mm),
                short(*range_mm),
                short(*lowered_mm)
            ),
            WarningKind::LongPath {
                hours,
                frames,
                rate_hz,
                limit_h,
            } => format!(
                "The path takes {} h: {frames} frames at {} Hz, and the limit is {} h (warnings.duration_h). Lower \
                 scan.frames and raise scan.step_mm, or raise scan.frame_rate_hz.",
                short(*hours),
                short(*rate_hz),
                short(*limit_h)
            ),
            WarningKind::LongSimulation {
                hours,
                frames,
                limit_h,
            } => format!(
                "The simulation of {frames} frames takes about {} h on this machine, and the limit is {} h \
                 (warnings.duration_h). {SHORTER_SCAN}",
                short(*hours),
                short(*limit_h)
            ),
            WarningKind::StepsTooShort {
                step_mm,
                column_mm,
                travel_mm,
                poses,
            } => format!(
                "The path advances {} µm from frame to frame, {} mm in all, and columns are {} µm apart: the frames \
                 show almost the same profile. {}",
                short(step_mm * 1e3),
                short(*travel_mm),
                short(column_mm * 1e3),
                match poses {
                    true =>
                        "Check the unit of scan.poses: a file in metres names its columns x_m,y_m,z_m, in its header \
                             or in scan.poses_columns.",
                    false => "Raise scan.step_mm, which is in millimetres, and lower scan.frames.",
                }
            ),
            _ => return None,
        })
    }

    /// Returns the text for problems with the light on the part.
    fn light_warnings(&self) -> String {
        let share = match self {
            WarningKind::AboveRange { share, .. }
            | WarningKind::BelowRange { share, .. }
            | WarningKind::HiddenFromCamera { share }
            | WarningKind::TooDark { share, .. }
            | WarningKind::Saturated { share, .. } => *share,
            WarningKind::FacesAway { fraction } | WarningKind::OutOfFocus { fraction, .. } => {
                *fraction
            }
            _ => 1.0,
        };
        let light = match share {
            share if share > 0.995 => "All of the light".to_owned(),
            share => format!("{} % of the light", short(100.0 * share)),
        };
        let rest = match self {
            WarningKind::AboveRange {
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
            WarningKind::BelowRange {
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
            WarningKind::HiddenFromCamera { .. } => {
                "falls where the part itself hides it from the \
                 camera. Turn the part, or move the camera nearer to the laser."
                    .to_owned()
            }
            WarningKind::FacesAway { .. } => {
                "falls on surface that faces away from the camera. Turn the part or the \
                 sensor, or move the camera nearer to the laser."
                    .to_owned()
            }
            _ => self.of_the_image().unwrap_or_else(|| {
                "falls on the part to the side of what the camera sees. Change the path (scan), \
                 part.position_mm or camera.look_at_mm."
                    .to_owned()
            }),
        };
        format!("{light} {rest}")
    }

    /// Returns the text for problems with the image of the line.
    fn of_the_image(&self) -> Option<String> {
        Some(match self {
            WarningKind::OutOfFocus { times, limit, .. } => format!(
                "is out of focus: its line in the image is up to {} times as wide as at the best focus, and {} times \
                 is the limit (warnings.blur). Set camera.focus = \"laser-plane\", which sets \
                 camera.focus_distance_mm and camera.tilt_deg, or bring the part to the distance in focus; a larger \
                 camera.f_number helps too.",
                short(*times),
                short(*limit)
            ),
            WarningKind::TooDark {
                counts,
                least_counts,
                ..
            } => format!(
                "gives too dark a line: at most {} counts above black are expected, and {} are \
                 needed to detect it. Raise camera.exposure_ms or laser.power_mw.",
                short(*counts),
                short(*least_counts)
            ),
            WarningKind::Saturated { times, .. } => format!(
                "saturates the sensor: up to {0} times the counts of a full pixel are expected. \
                 Lower camera.exposure_ms or laser.power_mw to at most 1/{0} of its value.",
                short(*times)
            ),
            _ => return None,
        })
    }
}
