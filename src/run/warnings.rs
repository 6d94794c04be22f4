//! Reasons that a scan gives no usable points. The warnings before the scan follow from the
//! geometry of the scene, those after it from the frames. Both use one wording.

use super::assessment::{Assessment, LightFractions};
use super::forecast::ResourceEstimate;
use super::housing::first_collision;
use super::light_survey::{LightSurvey, MeasuringRange, Miss, least_counts};
use super::passes::Passes;
use super::reflections::NOISE;
use super::sensor_figures::SensorFigures;
use super::simulation::Simulation;
use super::warning_kind::{Warning, WarningKind};
use crate::accel::{Accel, Ray};
use crate::error::{Error, Result};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::flags::count_flags;
use crate::math::DVec3;
use crate::plan::ModelConfig;
use crate::profile::Flags;
use crate::scene::{PathMotion, Scene, Unit};
use crate::surface::LayeredBrdf;
use rayon::prelude::*;
use std::f64::consts::PI;
use std::ops::Range;

/// Ratio of part size to field, or its inverse, above which the unit is probably wrong. The value
/// is the geometric mean of 100 and 1000. A part that fills the field gets a ratio of 1000 by the
/// most common mistake, metres instead of millimetres.
const ANOTHER_UNIT: f64 = 316.0;
/// Maximum number of poses at which the sensor is tested against the part.
const MOST_POSES: usize = 100_000;

/// Results that are known before a scan.
pub(crate) struct PreScanCheck {
    pub sensor: Option<SensorFigures>,
    pub assessment: Assessment,
    pub warnings: Vec<Warning>,
}

/// Returns the problems of a scan of these frames, including limits of its plan. Without problems
/// the warnings are empty.
pub(crate) fn foreseen_of(simulation: &Simulation, frames: Range<u32>) -> PreScanCheck {
    let Simulation {
        scene, accel, plan, ..
    } = simulation;
    let mut reasons = Vec::new();
    reasons.extend(mesh_incomplete(scene));
    reasons.extend(no_motion(scene, &frames));
    reasons.extend(sensor_and_part(scene, accel, &frames));
    reasons.extend(first_collision(scene, accel, &frames).map(|touch| {
        WarningKind::HousingTouchesPart {
            frame: touch.frame,
            place_mm: touch.place.to_array(),
        }
    }));
    reasons.extend(speckle_not_developed(scene));
    let survey = LightSurvey::of(scene, accel, frames.clone());
    let sensor = SensorFigures::of(scene, &survey);
    let width = sensor.as_ref().and_then(SensorFigures::width_at_center);
    reasons.extend(width.and_then(|mm| unit_doubtful(scene, accel, mm, ANOTHER_UNIT)));
    // The light matters only if lines are found in images.
    let images = !plan.geometry_only;
    let of_sensor = (&survey, sensor.as_ref());
    let assessment = Assessment::of((scene, accel), &frames, of_sensor, images);
    reasons.extend(visibility_warnings(scene, &survey, &assessment));
    if survey.miss.is_none() {
        reasons.extend(of_the_path(scene, frames.len(), &assessment));
    }
    let warnings = reasons.into_iter().map(Warning::from);
    PreScanCheck {
        sensor,
        assessment,
        warnings: warnings.chain(plan_warnings(plan)).collect(),
    }
}

/// Warns if path noise exceeds the sensor noise.
pub(super) fn plan_warnings(plan: &ModelConfig) -> Option<Warning> {
    let times = plan.reflections_noise.filter(|&times| times > NOISE)?;
    Some(WarningKind::ReflectionsNoisy { times }.into())
}

/// Returns the warnings after a scan, and their causes if the scan gives no valid points.
pub(crate) fn found(
    points: &[CloudPoint],
    frames: usize,
    foreseen: &[Warning],
    lost_fraction: f64,
) -> Vec<Warning> {
    let result = match points.iter().any(CloudPoint::is_valid) {
        true => None,
        false if points.is_empty() => Some(WarningKind::NothingMeasured { frames }),
        false => {
            // If several flags apply to all points, the first is used, because it explains the
            // others.
            let flags = count_flags(points).into_iter().rev();
            flags
                .max_by_key(|flag| flag.points)
                .map(|flag| WarningKind::EveryPointDoubtful {
                    points: points.len(),
                    flag: flag.name,
                    meaning: flag.meaning,
                    flagged: flag.points,
                })
        }
    };
    let saturated = points.iter().filter(|p| p.flags.contains(Flags::SATURATED));
    let saturated = saturated.count();
    let is_foreseen = |w: &Warning| matches!(w.reason, WarningKind::Saturated { .. });
    let too_many = saturated as f64 > lost_fraction * points.len() as f64;
    let unforeseen = result.is_none() && too_many && !foreseen.iter().any(is_foreseen);
    let result = result.or_else(|| {
        unforeseen.then_some(WarningKind::PointsSaturated {
            points: points.len(),
            saturated,
        })
    });
    let result = result.map(Warning::from).into_iter();
    result.chain(foreseen.iter().cloned()).collect()
}

/// Returns an error with all warnings if `strict` is set and there are any.
pub fn refuse(warnings: &[Warning], strict: bool) -> Result<()> {
    match warnings.is_empty() || !strict {
        true => Ok(()),
        false => Err(Error::Warned(
            warnings.iter().map(|w| w.message.clone()).collect(),
        )),
    }
}

fn mesh_incomplete(scene: &Scene) -> Option<WarningKind> {
    let shapes = { scene.mesh_ignored.iter() }.filter(|ignored| ignored.changes_shape);
    let ignored: Vec<String> = shapes.map(ToString::to_string).collect();
    (!ignored.is_empty()).then_some(WarningKind::MeshIncomplete { ignored })
}

fn no_motion(scene: &Scene, frames: &Range<u32>) -> Option<WarningKind> {
    let rests = match &scene.scan.motion {
        PathMotion::Linear { step } => *step == DVec3::ZERO,
        PathMotion::Rotary { step_deg, .. } => *step_deg == 0.0,
        PathMotion::Poses { poses, .. } => {
            let poses = &poses[frames.start as usize..frames.end as usize];
            poses.iter().all(|pose| *pose == poses[0])
        }
    };
    (rests && frames.len() > 1).then_some(WarningKind::NoMotion {
        frames: frames.len(),
    })
}

/// Warns of speckle that is not fully developed. Full development requires that heights within a
/// resolution cell vary by a quarter of the wavelength or more (Goodman 2007, section 3.2). The
/// cell is λ/(2a) wide for a pupil of half-angle a.
///
/// Facets of slope α deviate from their mean by at most α/2 of that width, α·λ/(4a). For α < a the
/// lobe is narrower than the pupil and full development is impossible.
fn speckle_not_developed(scene: &Scene) -> Option<WarningKind> {
    scene.speckle?;
    let lens = &scene.camera.lens;
    let pupil_half_angle = lens.pupil_diameter() / 2.0 / lens.focus_distance;
    let narrowest = scene.surface.glossy().map(LayeredBrdf::min_roughness);
    let roughness = narrowest.reduce(f64::min)?;
    (roughness < pupil_half_angle).then_some(WarningKind::SpeckleNotDeveloped {
        roughness,
        pupil_half_angle,
        quarter_wavelength_um: scene.laser.beam.wavelength * 1e3 / 4.0,
    })
}

/// Warns if laser or camera is inside the part or passes through it.
fn sensor_and_part(scene: &Scene, accel: &Accel, frames: &Range<u32>) -> Vec<WarningKind> {
    let bodies = [
        ("laser", scene.head_from_laser.translation),
        (
            "camera",
            scene.head_from_camera.point(scene.camera.position()),
        ),
    ];
    let stride = frames.len().div_ceil(MOST_POSES).max(1);
    let mut reasons = Vec::new();
    for (body, in_head) in bodies {
        let at = |frame: u32| scene.part_from_head(frame).point(in_head);
        let is_cut = |from: u32, to: u32| {
            Ray::between(at(from), at(to)).is_some_and(|way| accel.occluded(&[way]) != 0)
        };
        let passes = Passes::of(scene, frames, in_head).frames;
        // A link into the part passes through its surface. Other starts are outside.
        let begins_inside = |i: usize| {
            let start = *passes[i].start();
            let may_enter = i == 0 || is_cut(*passes[i - 1].end(), start);
            (may_enter && is_inside(accel, at(start))).then_some(start)
        };
        if let Some(frame) = (0..passes.len()).find_map(begins_inside) {
            reasons.push(WarningKind::SensorInsidePart { body, frame });
            continue;
        }
        let through = passes.iter().find_map(|pass| {
            let chosen = pass.clone().step_by(stride).chain([*pass.end()]);
            let chosen: Vec<u32> = chosen.collect();
            let cut = chosen.windows(2).find(|pair| is_cut(pair[0], pair[1]))?;
            Some(cut[0])
        });
        reasons.extend(through.map(|frame| WarningKind::SensorThroughPart { body, frame }));
    }
    reasons
}

/// Returns whether a closed surface that faces outward encloses `p`. Its triangles then subtend the
/// entire solid angle 4π, otherwise a sum of 0. The solid angle of a triangle is from van Oosterom
/// & Strackee (1983).
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
        // A hole of one tenth of all directions is tolerated.
        solid_angle > 0.9 * 4.0 * PI
    })
}

/// Warns of a part whose size differs from the field by a factor of `limit` or more, and names the
/// unit in which it fits.
pub(super) fn unit_doubtful(
    scene: &Scene,
    accel: &Accel,
    field_mm: f64,
    limit: f64,
) -> Option<WarningKind> {
    let unit = scene.mesh_unit?;
    let part_mm = accel.bounds().size().max_element();
    let off = |ratio: f64| ratio.max(1.0 / ratio);
    let ratio = part_mm / field_mm;
    if !ratio.is_finite() || ratio <= 0.0 || off(ratio) < limit {
        return None;
    }
    let as_if = |other: &Unit| off(ratio * other.mm() / unit.mm());
    let likely = Unit::ALL
        .into_iter()
        .min_by(|a, b| as_if(a).total_cmp(&as_if(b)));
    Some(WarningKind::UnitDoubtful {
        part_mm,
        field_mm,
        unit,
        likely: likely.filter(|likely| as_if(likely) < limit),
    })
}

fn visibility_warnings(
    scene: &Scene,
    survey: &LightSurvey,
    assessment: &Assessment,
) -> Vec<WarningKind> {
    match survey.miss {
        Some(Miss::Behind) => return vec![WarningKind::LaserLooksAway],
        Some(Miss::PlaneMissesPart { frame, by_mm }) => {
            return vec![WarningKind::LightMissesPart { frame, by_mm }];
        }
        Some(Miss::OutsideFan) => return vec![WarningKind::LightBesidePart],
        None => {}
    }
    let Some(range) = survey.range else {
        return vec![WarningKind::CameraLooksAway];
    };
    match (&assessment.light, survey.lit.is_empty()) {
        (Some(light), _) => light_warnings(scene, light, range),
        (None, false) => vec![WarningKind::OutOfView],
        (None, true) => Vec::new(),
    }
}

/// Returns the causes of an excessive loss of light.
fn light_warnings(
    scene: &Scene,
    light: &LightFractions,
    range: MeasuringRange,
) -> Vec<WarningKind> {
    let limits = &scene.warnings;
    let range_mm = [range.near_mm, range.far_mm];
    let &LightFractions {
        too_near,
        too_far,
        occluded,
        too_dark,
        saturated,
        out_of_focus,
        facing_away,
        hidden,
        valid,
    } = light;
    let above = WarningKind::AboveRange {
        share: too_near.fraction,
        by_mm: too_near.most,
        range_mm,
    };
    let below = WarningKind::BelowRange {
        share: too_far.fraction,
        by_mm: too_far.most,
        range_mm,
    };
    let behind = WarningKind::HiddenFromCamera {
        share: occluded.fraction,
    };
    let dark = WarningKind::TooDark {
        share: too_dark.fraction,
        counts: too_dark.most,
        least_counts: least_counts(scene),
    };
    let bright = WarningKind::Saturated {
        share: saturated.fraction,
        times: saturated.most,
    };
    let blurred = WarningKind::OutOfFocus {
        fraction: out_of_focus.fraction,
        times: out_of_focus.most,
        limit: limits.blur,
    };
    let causes = [
        (too_near, above),
        (too_far, below),
        (occluded, behind),
        (too_dark, dark),
        (saturated, bright),
        (out_of_focus, blurred),
    ];
    let causes = causes.into_iter();
    let mut reasons: Vec<WarningKind> = causes
        .filter(|(loss, _)| loss.fraction > limits.lost_fraction)
        .map(|(_, reason)| reason)
        .collect();
    let unseen = facing_away + hidden;
    if unseen > limits.hidden_fraction {
        reasons.push(match facing_away > hidden {
            true => WarningKind::FacesAway {
                fraction: facing_away,
            },
            false => WarningKind::HiddenFromCamera { share: hidden },
        });
    }
    let lost = 1.0 - valid;
    if reasons.is_empty() && lost > limits.unmeasured_fraction {
        reasons.push(WarningKind::SurfaceNotMeasured { fraction: lost });
    }
    reasons
}

/// Returns the problems of a path that lights the part.
fn of_the_path(scene: &Scene, frames: usize, assessment: &Assessment) -> Vec<WarningKind> {
    let limits = &scene.warnings;
    let path = &assessment.path;
    let mut reasons = Vec::new();
    let gap = path
        .gap
        .map(|gap| (gap, limits.pass_spacing * gap.field_mm));
    let gap = gap.filter(|(gap, limit_mm)| gap.spacing_mm > *limit_mm);
    // Without light in the field, the position of the light is the only cause.
    let surface = assessment.surface.filter(|_| assessment.light.is_some());
    if let Some(surface) = surface {
        let limit = limits.unmeasured_fraction;
        // Surface between passes is missed for a different reason.
        if gap.is_none() && path.field_beside_part.min(surface.beside_field) > limit {
            reasons.push(WarningKind::DisplacedSideways {
                field: path.field_beside_part,
                missed: surface.beside_field,
            });
        }
        if path.empty_frames.min(surface.not_passed) > limit {
            reasons.push(WarningKind::DisplacedAlongPath {
                frames: path.empty_frames,
                missed: surface.not_passed,
            });
        }
    }
    if surface.is_some() && path.empty_frames > limits.empty_frames_fraction {
        reasons.push(WarningKind::MostlyOutsidePart {
            frames: path.empty_frames,
            travel_mm: path.travel_mm,
        });
    }
    reasons.extend(gap.map(|(gap, limit_mm)| WarningKind::PassesTooFarApart {
        spacing_mm: gap.spacing_mm,
        field_mm: gap.field_mm,
        limit_mm,
    }));
    if let (Some(step_mm), Some(column_mm), Some(travel_mm)) =
        (path.step_mm, path.column_mm, path.travel_mm)
    {
        // Averaged frames make one profile.
        let averaged = f64::from(scene.measure.filters.average_frames);
        if frames > 1 && step_mm * averaged < limits.least_step * column_mm {
            reasons.push(WarningKind::StepsTooShort {
                step_mm,
                column_mm,
                travel_mm,
                poses: matches!(scene.scan.motion, PathMotion::Poses { .. }),
            });
        }
    }
    let hours = path.duration_s / 3600.0;
    if hours > limits.duration_h {
        reasons.push(WarningKind::LongPath {
            hours,
            frames,
            rate_hz: path.frame_rate_hz,
            limit_h: limits.duration_h,
        });
    }
    reasons
}

/// A simulation that takes long. `check` and `view` give this warning, as it depends on the
/// machine.
pub(crate) fn of_the_forecast(scene: &Scene, forecast: &ResourceEstimate) -> Option<Warning> {
    let (hours, limit_h) = (forecast.seconds / 3600.0, scene.warnings.duration_h);
    (hours > limit_h).then(|| {
        let frames = forecast.frames as usize;
        Warning::from(WarningKind::LongSimulation {
            hours,
            frames,
            limit_h,
        })
    })
}
