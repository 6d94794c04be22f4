//! Why a scan gives nothing, or nothing worth having: the same words before it, from the
//! geometry of the scene, and after it, from what the frames gave.

use super::assessment::{Assessment, LightFractions};
use super::forecast::Forecast;
use super::housing::touch;
use super::reason::{Reason, Warning};
use super::reflections::NOISE;
use super::sensor_figures::SensorFigures;
use super::simulation::Simulation;
use super::survey::{MeasuringRange, Miss, Survey, least_counts};
use crate::accel::{Accel, Ray};
use crate::error::{Error, Result};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::flags::count_flags;
use crate::math::DVec3;
use crate::plan::Plan;
use crate::profile::Flags;
use crate::scene::{Motion, Scene, Unit};
use crate::surface::Glossy;
use rayon::prelude::*;
use std::f64::consts::PI;
use std::ops::Range;

/// A part so many times the field, or so small a share of it, is in another unit: on a
/// scale of ratios half way between a part of 100 fields and one of 1000, as a part that
/// fills the field becomes by the most common mistake, metres for millimetres.
const ANOTHER_UNIT: f64 = 316.0;
/// Poses between which the sensor is followed through the part.
const MOST_POSES: usize = 100_000;

/// What is known before a scan.
pub(crate) struct Foreseen {
    pub sensor: Option<SensorFigures>,
    pub assessment: Assessment,
    pub warnings: Vec<Warning>,
}

/// What will spoil a scan of these frames, what its plan could not do as it should among it; empty for a good one.
pub(crate) fn foreseen_of(simulation: &Simulation, frames: Range<u32>) -> Foreseen {
    let Simulation {
        scene, accel, plan, ..
    } = simulation;
    let mut reasons = Vec::new();
    reasons.extend(mesh_incomplete(scene));
    reasons.extend(no_motion(scene, &frames));
    reasons.extend(sensor_and_part(scene, accel, &frames));
    reasons.extend(
        touch(scene, accel, &frames).map(|touch| Reason::HousingTouchesPart {
            frame: touch.frame,
            place_mm: touch.place.to_array(),
        }),
    );
    reasons.extend(speckle_not_developed(scene));
    let survey = Survey::of(scene, accel, frames.clone());
    let sensor = SensorFigures::of(scene, &survey);
    let width = sensor.as_ref().and_then(SensorFigures::width_at_center);
    reasons.extend(width.and_then(|mm| unit_doubtful(scene, accel, mm, ANOTHER_UNIT)));
    // Where lines are found in images, their light counts.
    let images = !plan.geometry_only;
    let of_sensor = (&survey, sensor.as_ref());
    let assessment = Assessment::of((scene, accel), &frames, of_sensor, images);
    reasons.extend(of_the_survey(scene, &survey, &assessment));
    if survey.miss.is_none() {
        reasons.extend(of_the_path(scene, frames.len(), &assessment));
    }
    let warnings = reasons.into_iter().map(Warning::from);
    Foreseen {
        sensor,
        assessment,
        warnings: warnings.chain(of_the_plan(plan)).collect(),
    }
}

/// What its paths leave of noise, if that is more than the sensor's own.
pub(super) fn of_the_plan(plan: &Plan) -> Option<Warning> {
    let times = plan.reflections_noise.filter(|&times| times > NOISE)?;
    Some(Reason::ReflectionsNoisy { times }.into())
}

/// What a scan gave, and why if that is nothing.
pub(crate) fn found(
    points: &[CloudPoint],
    frames: usize,
    foreseen: &[Warning],
    lost_fraction: f64,
) -> Vec<Warning> {
    let result = match points.iter().any(CloudPoint::is_valid) {
        true => None,
        false if points.is_empty() => Some(Reason::NothingMeasured { frames }),
        false => {
            // Of several that all have, the first, which says why the others are there.
            let flags = count_flags(points).into_iter().rev();
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
    let saturated = points.iter().filter(|p| p.flags.contains(Flags::SATURATED));
    let saturated = saturated.count();
    let is_foreseen = |w: &Warning| matches!(w.reason, Reason::Saturated { .. });
    let too_many = saturated as f64 > lost_fraction * points.len() as f64;
    let unforeseen = result.is_none() && too_many && !foreseen.iter().any(is_foreseen);
    let result = result.or_else(|| {
        unforeseen.then_some(Reason::PointsSaturated {
            points: points.len(),
            saturated,
        })
    });
    let result = result.map(Warning::from).into_iter();
    result.chain(foreseen.iter().cloned()).collect()
}

/// If `strict`, an error that says all of them, if there are any.
pub fn refuse(warnings: &[Warning], strict: bool) -> Result<()> {
    match warnings.is_empty() || !strict {
        true => Ok(()),
        false => Err(Error::Warned(
            warnings.iter().map(|w| w.message.clone()).collect(),
        )),
    }
}

fn mesh_incomplete(scene: &Scene) -> Option<Reason> {
    let shapes = { scene.mesh_ignored.iter() }.filter(|ignored| ignored.changes_shape);
    let ignored: Vec<String> = shapes.map(ToString::to_string).collect();
    (!ignored.is_empty()).then_some(Reason::MeshIncomplete { ignored })
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

/// Speckle is fully developed where heights within a grain of the surface, λ/(2a) wide for a pupil of half the
/// angle a, vary by a quarter of the wavelength or more (Goodman 2007, section 3.2). Facets of slope α rise
/// at most α/2 of that width about their mean, α·λ/(4a): for α < a, a lobe narrower than the pupil, it cannot be.
fn speckle_not_developed(scene: &Scene) -> Option<Reason> {
    scene.speckle?;
    let lens = &scene.camera.lens;
    let pupil_half_angle = lens.pupil_diameter() / 2.0 / lens.focus_distance;
    let narrowest = scene.surface.glossy().map(Glossy::narrowest);
    let roughness = narrowest.reduce(f64::min)?;
    (roughness < pupil_half_angle).then_some(Reason::SpeckleNotDeveloped {
        roughness,
        pupil_half_angle,
        quarter_wavelength_um: scene.laser.beam.wavelength * 1e3 / 4.0,
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

/// Warns of a part whose size differs from the field by a factor of `limit` or more, and names the unit in which it
/// fits.
pub(super) fn unit_doubtful(
    scene: &Scene,
    accel: &Accel,
    field_mm: f64,
    limit: f64,
) -> Option<Reason> {
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
    Some(Reason::UnitDoubtful {
        part_mm,
        field_mm,
        unit,
        likely: likely.filter(|likely| as_if(likely) < limit),
    })
}

fn of_the_survey(scene: &Scene, survey: &Survey, assessment: &Assessment) -> Vec<Reason> {
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
    match (&assessment.light, survey.lit.is_empty()) {
        (Some(light), _) => of_the_light(scene, light, range),
        (None, false) => vec![Reason::OutOfView],
        (None, true) => Vec::new(),
    }
}

/// The causes by which too much of the light is lost.
fn of_the_light(scene: &Scene, light: &LightFractions, range: MeasuringRange) -> Vec<Reason> {
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
    let above = Reason::AboveRange {
        share: too_near.fraction,
        by_mm: too_near.most,
        range_mm,
    };
    let below = Reason::BelowRange {
        share: too_far.fraction,
        by_mm: too_far.most,
        range_mm,
    };
    let behind = Reason::HiddenFromCamera {
        share: occluded.fraction,
    };
    let dark = Reason::TooDark {
        share: too_dark.fraction,
        counts: too_dark.most,
        least_counts: least_counts(scene),
    };
    let bright = Reason::Saturated {
        share: saturated.fraction,
        times: saturated.most,
    };
    let blurred = Reason::OutOfFocus {
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
    let mut reasons: Vec<Reason> = causes
        .filter(|(loss, _)| loss.fraction > limits.lost_fraction)
        .map(|(_, reason)| reason)
        .collect();
    let unseen = facing_away + hidden;
    if unseen > limits.hidden_fraction {
        reasons.push(match facing_away > hidden {
            true => Reason::FacesAway {
                fraction: facing_away,
            },
            false => Reason::HiddenFromCamera { share: hidden },
        });
    }
    let lost = 1.0 - valid;
    if reasons.is_empty() && lost > limits.unmeasured_fraction {
        reasons.push(Reason::SurfaceNotMeasured { fraction: lost });
    }
    reasons
}

/// Faults of a path that lights the part.
fn of_the_path(scene: &Scene, frames: usize, assessment: &Assessment) -> Vec<Reason> {
    let limits = &scene.warnings;
    let path = &assessment.path;
    let mut reasons = Vec::new();
    let gap = path
        .gap
        .map(|gap| (gap, limits.pass_spacing * gap.field_mm));
    let gap = gap.filter(|(gap, limit_mm)| gap.spacing_mm > *limit_mm);
    // Without light in the field, where it falls is the whole reason.
    let surface = assessment.surface.filter(|_| assessment.light.is_some());
    if let Some(surface) = surface {
        let limit = limits.unmeasured_fraction;
        // Surface between passes is missed for another reason.
        if gap.is_none() && path.field_beside_part.min(surface.beside_field) > limit {
            reasons.push(Reason::DisplacedSideways {
                field: path.field_beside_part,
                missed: surface.beside_field,
            });
        }
        if path.empty_frames.min(surface.not_passed) > limit {
            reasons.push(Reason::DisplacedAlongPath {
                frames: path.empty_frames,
                missed: surface.not_passed,
            });
        }
    }
    if surface.is_some() && path.empty_frames > limits.empty_frames_fraction {
        reasons.push(Reason::MostlyOutsidePart {
            frames: path.empty_frames,
            travel_mm: path.travel_mm,
        });
    }
    reasons.extend(gap.map(|(gap, limit_mm)| Reason::PassesTooFarApart {
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
            reasons.push(Reason::StepsTooShort {
                step_mm,
                column_mm,
                travel_mm,
                poses: matches!(scene.scan.motion, Motion::Poses { .. }),
            });
        }
    }
    let hours = path.duration_s / 3600.0;
    if hours > limits.duration_h {
        reasons.push(Reason::LongPath {
            hours,
            frames,
            rate_hz: path.frame_rate_hz,
            limit_h: limits.duration_h,
        });
    }
    reasons
}

/// A simulation that takes long. `check` and `view` give this warning, as it depends on the machine.
pub(crate) fn of_the_forecast(scene: &Scene, forecast: &Forecast) -> Option<Warning> {
    let (hours, limit_h) = (forecast.seconds / 3600.0, scene.warnings.duration_h);
    (hours > limit_h).then(|| {
        let frames = forecast.frames as usize;
        Warning::from(Reason::LongSimulation {
            hours,
            frames,
            limit_h,
        })
    })
}
