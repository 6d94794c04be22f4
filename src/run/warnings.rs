//! Why a scan gives nothing, or nothing worth having: the same words before it, from the
//! geometry of the scene, and after it, from what the frames gave.

use super::housing::touch;
use super::reason::{Reason, Warning};
use super::reflections::NOISE;
use super::sensor_figures::SensorFigures;
use super::simulation::Simulation;
use super::survey::{Fate, MeasuringRange, Miss, Survey, least_counts};
use crate::accel::{Accel, Ray};
use crate::error::{Error, Result};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::flags::count_flags;
use crate::math::DVec3;
use crate::plan::Plan;
use crate::profile::blinding_height;
use crate::scene::{Motion, Scene, Unit};
use crate::surface::Glossy;
use rayon::prelude::*;
use std::f64::consts::PI;
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

/// What is known before a scan.
pub(crate) struct Foreseen {
    pub sensor: Option<SensorFigures>,
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
    let survey = Survey::of(scene, accel, frames);
    let sensor = SensorFigures::of(scene, &survey);
    let width = sensor.as_ref().and_then(|sensor| {
        let [near, far] = sensor.ends();
        sensor.field_at((near + far) / 2.0)
    });
    reasons.extend(width.and_then(|width_mm| unit_doubtful(scene, accel, width_mm)));
    // Where lines are found in images, their light counts.
    reasons.extend(of_the_survey(scene, &survey, !plan.geometry_only));
    let warnings = reasons.into_iter().map(Warning::from);
    Foreseen {
        sensor,
        warnings: warnings.chain(of_the_plan(plan)).collect(),
    }
}

/// What its paths leave of noise, if that is more than the sensor's own.
pub(super) fn of_the_plan(plan: &Plan) -> Option<Warning> {
    let times = plan.reflections_noise.filter(|&times| times > NOISE)?;
    Some(Reason::ReflectionsNoisy { times }.into())
}

/// What a scan gave, and why if that is nothing.
pub(crate) fn found(points: &[CloudPoint], frames: usize, foreseen: &[Warning]) -> Vec<Warning> {
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
    // A fan may well be wider than the view.
    let in_view = |fate: &&Fate| **fate != Fate::OutOfView;
    let fates: Vec<Fate> = survey.fates.iter().filter(in_view).copied().collect();
    match (survey.fates.is_empty(), fates.is_empty()) {
        (true, _) => Vec::new(),
        (false, true) => vec![Reason::OutOfView],
        (false, false) => of_the_light(scene, &fates, range, images),
    }
}

/// Of light that falls on the part in view.
fn of_the_light(scene: &Scene, fates: &[Fate], range: MeasuringRange, images: bool) -> Vec<Reason> {
    let range_mm = [range.near_mm, range.far_mm];
    let sensor = &scene.camera.sensor;
    let least_counts = least_counts(scene);
    let full = sensor.saturation_count() as f64 - sensor.black_level_dn;
    let contrast = scene.speckle.map_or(0.0, |s| s.coherence.contrast());
    let blinding = full * blinding_height(contrast * contrast);
    // Share of the light with a fate, and the greatest number that goes with it.
    let of = |number: &dyn Fn(&Fate) -> Option<f64>| {
        let numbers: Vec<f64> = fates.iter().filter_map(number).collect();
        let greatest = numbers.iter().copied().fold(0.0, f64::max);
        (numbers.len() as f64 / fates.len() as f64, greatest)
    };
    let counts = |fate: &Fate, holds: &dyn Fn(f64) -> bool| match fate {
        Fate::Seen(counts) if images && holds(*counts) => Some(*counts),
        _ => None,
    };
    let near = of(&|fate| match fate {
        Fate::TooNear(by_mm) => Some(*by_mm),
        _ => None,
    });
    let far = of(&|fate| match fate {
        Fate::TooFar(by_mm) => Some(*by_mm),
        _ => None,
    });
    let hidden = of(&|fate| (*fate == Fate::Hidden).then_some(0.0));
    let dark = of(&|fate| counts(fate, &|c| c < least_counts));
    let bright = of(&|fate| counts(fate, &|c| c > blinding));
    let above = |(share, by_mm)| Reason::AboveRange {
        share,
        by_mm,
        range_mm,
    };
    let below = |(share, by_mm)| Reason::BelowRange {
        share,
        by_mm,
        range_mm,
    };
    let too_dark = |(share, counts)| Reason::TooDark {
        share,
        counts,
        least_counts,
    };
    let saturated = |(share, counts)| Reason::Saturated {
        share,
        times: counts / full,
    };
    let all = [
        (near.0, above(near)),
        (far.0, below(far)),
        (hidden.0, Reason::HiddenFromCamera { share: hidden.0 }),
        (dark.0, too_dark(dark)),
        (bright.0, saturated(bright)),
    ];
    let shares = || all.iter().map(|(share, _)| *share);
    if 1.0 - shares().sum::<f64>() >= WORTH_HAVING {
        return Vec::new();
    }
    let named = shares().fold(0.0, f64::max).min(WORTH_NAMING);
    let named = all.into_iter().filter(|(share, _)| *share >= named);
    named.map(|(_, reason)| reason).collect()
}
