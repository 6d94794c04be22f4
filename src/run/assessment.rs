//! Assessment of a scan in advance: the fraction of the part's surface that it measures, the loss
//! of light with its causes, and the path. `check`, `scan`, `sweep`, `view` and the service derive
//! their warnings from it.
//!
//! A path of one orientation cannot measure the underside of a part, walls along the beam, or
//! surface that the part itself hides from the laser. The fractions therefore refer to measurable
//! light and surface:
//!
//! - *light*: the light on the part that is within the camera's columns and on surface that the
//!   camera could see. Light outside the columns is no loss, as a fan is often wider than the
//!   field. Light on surface that no path in these orientations measures is stated separately. Such
//!   surface faces away from the camera, or the part occludes it in every orientation of the path.
//! - *measurable surface*: surface that a sensor in one of the orientations of the path measures
//!   from some position. Its weight is its area as viewed from the laser (area × cosine of the
//!   angle of incidence). Walls along the beam therefore have no weight, as for light.
//!
//! A position that several passes light gets the best result of all of them. A path does not have
//! to cover the entire part. It is displaced only if the field passes outside the part while
//! measurable surface is missed in the same direction, along the path or to its sides.

use super::light_survey::{
    CameraVisibility, LaserHit, LightSurvey, LineImage, RayResult, directions, even_subset,
    least_counts, part_from_laser,
};
use super::passes::{Passes, Sheets};
use super::sensor_figures::SensorFigures;
use crate::accel::Accel;
use crate::inspect::coverage;
use crate::math::{Aabb, DVec3, Rigid};
use crate::profile::max_usable_height;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;

/// Maximum number of lit positions that are traced through all passes.
const MAX_FOLLOWED: usize = 2000;
/// Number of sample positions on the part's surface.
const SURFACE_SAMPLES: usize = 2000;
/// Maximum number of head orientations in which surface may be measurable.
const MAX_ORIENTATIONS: usize = 8;
/// Maximum number of frames that are tested for a field outside the part.
const MAX_FRAMES: usize = 512;

/// Fractions of surface and light that a scan measures, and its path.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Assessment {
    /// `None` if no light falls on the part in the camera's columns.
    pub light: Option<LightFractions>,
    /// `None` if the sensor measures no surface of the part in any position.
    pub surface: Option<SurfaceFractions>,
    /// The path over the part.
    pub path: PathFigures,
}

/// A loss of light.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Loss {
    /// Fraction of the light.
    pub fraction: f64,
    /// Largest value of the loss. The unit depends on the loss: distance outside the range in mm,
    /// counts, or a ratio to the counts of a saturated pixel or to the width at the best focus.
    pub most: f64,
}

/// Fractions of the light on surface that the camera could see, in its columns. The fractions up to
/// `out_of_focus` add up to 1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct LightFractions {
    /// Light that gives valid points.
    pub valid: f64,
    /// Light nearer than the measuring range.
    pub too_near: Loss,
    /// Light beyond the measuring range.
    pub too_far: Loss,
    /// Light that the part hides from the camera here, but not from every position.
    pub occluded: Loss,
    /// Light too faint for valid points.
    pub too_dark: Loss,
    /// Light that saturates the sensor, so that points are flagged.
    pub saturated: Loss,
    /// Light whose image is much wider than at the best focus.
    pub out_of_focus: Loss,
    /// Fraction of all light in the columns that falls on surface that faces away from the camera.
    pub facing_away: f64,
    /// Fraction of all light in the columns that the part hides from the camera in every
    /// orientation of the path.
    pub hidden: f64,
}

/// Fractions of the measurable surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SurfaceFractions {
    /// Fraction of the part's area that is measurable from some position in an orientation of the
    /// path.
    pub measurable: f64,
    /// Fraction of the measurable surface that the laser plane passes within the field.
    pub in_field: f64,
    /// Fraction of the measurable surface that the laser plane passes outside the field.
    pub beside_field: f64,
    /// Fraction of the measurable surface that the laser plane never passes.
    pub not_passed: f64,
    /// Fraction of the measurable surface that gives valid points.
    pub measured: f64,
}

/// The path over the part.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PathFigures {
    /// Number of passes.
    pub passes: usize,
    /// Length along the passes, mm; `None` for a rotary table.
    pub travel_mm: Option<f64>,
    /// Median step between consecutive frames, mm; `None` for a rotary table, or if nothing moves.
    pub step_mm: Option<f64>,
    /// Distance between columns at the centre of the range, mm.
    pub column_mm: Option<f64>,
    /// Frame rate: of the scene, or the highest of the sensor.
    pub frame_rate_hz: f64,
    /// Duration at this frame rate, s.
    pub duration_s: f64,
    /// Fraction of the frames whose field passes outside the box around the part.
    pub empty_frames: f64,
    /// Fraction of the field that passes outside this box in the other frames.
    pub field_beside_part: f64,
    /// Widest spacing of neighbouring passes with measurable surface between them; `None` for
    /// single passes.
    pub gap: Option<PassGap>,
}

/// Two neighbouring passes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PassGap {
    /// Distance between the passes, mm.
    pub spacing_mm: f64,
    /// Width of the field where the part is nearest to the laser, mm.
    pub field_mm: f64,
}

impl Assessment {
    pub(crate) fn of(
        (scene, accel): (&Scene, &Accel),
        frames: &Range<u32>,
        (survey, sensor): (&LightSurvey, Option<&SensorFigures>),
        images: bool,
    ) -> Assessment {
        let distance = sensor.map_or(scene.laser.beam.waist_distance, |sensor| {
            let [near, far] = sensor.ends();
            (near + far) / 2.0
        });
        let reference = scene.head_from_laser.point(DVec3::Z * distance);
        let passes = Passes::of(scene, frames, reference);
        let sheets = Sheets::of(scene, &passes);
        let valid = ValidityLimits::new(scene, images);
        let several = passes.frames.len() > 1 || scene.scan.turns();
        let orientations = Orientations::of((scene, accel), frames, distance);
        let followed = (&orientations, several.then_some(&sheets));
        let light = LightFractions::of((scene, accel), survey, &valid, followed);
        let surface = MeasurableSurface::of(accel, &orientations);
        let ways: Vec<Passing> = surface
            .points
            .par_iter()
            .map(|&(point, _)| Passing::of((scene, accel), &sheets, point))
            .collect();
        let measured = light.map_or(0.0, |light| light.valid);
        let gap = sensor.and_then(|sensor| {
            let field = field_at_part(sensor, scene, survey)?;
            let points = surface.points.iter().map(|(point, _)| *point);
            widest_gap(
                scene,
                &passes,
                reference,
                field,
                &points.collect::<Vec<_>>(),
            )
        });
        Assessment {
            light,
            surface: surface.fractions(&ways, measured),
            path: PathFigures::of((scene, accel), frames, &passes, sensor, gap),
        }
    }
}

/// Limits beyond which light gives no valid points.
struct ValidityLimits {
    least_counts: f64,
    /// Counts above black of a saturated pixel.
    full: f64,
    blinding: f64,
    blur: f64,
    images: bool,
}

/// Cause of a loss of light, with the value for [`Loss::most`].
enum Cause {
    TooNear(f64),
    TooFar(f64),
    Occluded,
    TooDark(f64),
    Saturated(f64),
    OutOfFocus(f64),
    FacesAway,
    Hidden,
}

impl ValidityLimits {
    fn new(scene: &Scene, images: bool) -> ValidityLimits {
        let sensor = &scene.camera.sensor;
        let full = f64::from(sensor.saturation_count()) - sensor.black_level_dn;
        let contrast = scene.speckle.map_or(0.0, |s| s.coherence.contrast());
        ValidityLimits {
            least_counts: least_counts(scene),
            full,
            blinding: full * max_usable_height(contrast * contrast),
            blur: scene.warnings.blur,
            images,
        }
    }

    /// Returns the cause of the loss; `None` for light that gives valid points, and for light
    /// outside the columns.
    fn lost(&self, fate: RayResult) -> Option<Cause> {
        match fate {
            RayResult::TooNear(by) => Some(Cause::TooNear(by)),
            RayResult::TooFar(by) => Some(Cause::TooFar(by)),
            RayResult::Hidden => Some(Cause::Occluded),
            RayResult::FacesAway => Some(Cause::FacesAway),
            RayResult::OutOfView => None,
            RayResult::Seen(line) => self.lost_in_image(line),
        }
    }

    fn lost_in_image(&self, LineImage { counts, widening }: LineImage) -> Option<Cause> {
        // Without images, no line has to be detected.
        if !self.images {
            return None;
        }
        let counts = counts / widening;
        if counts < self.least_counts {
            Some(Cause::TooDark(counts))
        } else if counts > self.blinding {
            Some(Cause::Saturated(counts / self.full))
        } else if widening > self.blur {
            Some(Cause::OutOfFocus(widening))
        } else {
            None
        }
    }
}

impl LightFractions {
    /// Computes the fractions. The laser planes are required if a position may be lit several
    /// times.
    fn of(
        (scene, accel): (&Scene, &Accel),
        survey: &LightSurvey,
        valid: &ValidityLimits,
        (orientations, sheets): (&Orientations, Option<&Sheets>),
    ) -> Option<LightFractions> {
        let in_view = |lit: &&LaserHit| lit.fate != RayResult::OutOfView;
        let lit: Vec<&LaserHit> = survey.lit.iter().filter(in_view).collect();
        let most = sheets.map_or(usize::MAX, |_| MAX_FOLLOWED);
        let followed: Vec<&LaserHit> = even_subset(lit.len(), most).map(|i| lit[i]).collect();
        let measured_elsewhere = |lit: &LaserHit| {
            sheets.is_some_and(|sheets| {
                sheets.through(lit.point).any(|frame| {
                    let pose = laser_at(scene, frame);
                    let follow = CameraVisibility::new(scene, accel, pose);
                    let fate = follow.fate_of(lit.point, lit.normal, lit.triangle);
                    fate.is_some_and(|fate| {
                        fate != RayResult::OutOfView && valid.lost(fate).is_none()
                    })
                })
            })
        };
        let cause = |lit: &&LaserHit| {
            let cause = valid.lost(lit.fate).filter(|_| !measured_elsewhere(lit))?;
            let visible = || orientations.measurable(lit.point, lit.normal).is_some();
            Some(match cause {
                Cause::Occluded if !visible() => Cause::Hidden,
                cause => cause,
            })
        };
        let causes: Vec<Option<Cause>> = followed.par_iter().map(cause).collect();
        LightFractions::of_causes(&causes)
    }

    fn of_causes(causes: &[Option<Cause>]) -> Option<LightFractions> {
        if causes.is_empty() {
            return None;
        }
        let count = |of: fn(&&Cause) -> bool| causes.iter().flatten().filter(of).count();
        let away = count(|cause| matches!(cause, Cause::FacesAway));
        let hidden = count(|cause| matches!(cause, Cause::Hidden));
        let facing = causes.len() - away - hidden;
        let mut fractions = LightFractions {
            facing_away: away as f64 / causes.len() as f64,
            hidden: hidden as f64 / causes.len() as f64,
            ..LightFractions::default()
        };
        let mut lost = 0;
        for cause in causes.iter().flatten() {
            let (loss, most) = match cause {
                Cause::TooNear(by) => (&mut fractions.too_near, *by),
                Cause::TooFar(by) => (&mut fractions.too_far, *by),
                Cause::Occluded => (&mut fractions.occluded, 0.0),
                Cause::TooDark(counts) => (&mut fractions.too_dark, *counts),
                Cause::Saturated(times) => (&mut fractions.saturated, *times),
                Cause::OutOfFocus(times) => (&mut fractions.out_of_focus, *times),
                Cause::FacesAway | Cause::Hidden => continue,
            };
            lost += 1;
            loss.fraction += 1.0;
            loss.most = loss.most.max(most);
        }
        for loss in [
            &mut fractions.too_near,
            &mut fractions.too_far,
            &mut fractions.occluded,
            &mut fractions.too_dark,
            &mut fractions.saturated,
            &mut fractions.out_of_focus,
        ] {
            loss.fraction /= facing.max(1) as f64;
        }
        if facing > 0 {
            fractions.valid = (facing - lost) as f64 / facing as f64;
        }
        Some(fractions)
    }
}

fn laser_at(scene: &Scene, frame: f64) -> Rigid {
    scene.part_from_head_at(frame) * scene.head_from_laser
}

/// Position of a surface point relative to the field when the laser plane passes it.
#[derive(Clone, Copy, PartialEq)]
enum Passing {
    InField,
    Beside,
    Never,
}

impl Passing {
    fn of((scene, accel): (&Scene, &Accel), sheets: &Sheets, point: DVec3) -> Passing {
        let mut way = Passing::Never;
        for frame in sheets.through(point) {
            if CameraVisibility::new(scene, accel, laser_at(scene, frame)).is_in_field(point) {
                return Passing::InField;
            }
            way = Passing::Beside;
        }
        way
    }
}

/// Orientations of the sensor along the path, independent of its position.
struct Orientations<'a> {
    follows: Vec<CameraVisibility<'a>>,
    /// Distance of the surface from the laser, mm.
    distance: f64,
}

impl Orientations<'_> {
    fn of<'a>(
        (scene, accel): (&'a Scene, &'a Accel),
        frames: &Range<u32>,
        distance: f64,
    ) -> Orientations<'a> {
        let mut poses: Vec<Rigid> = Vec::new();
        for i in even_subset(frames.len(), MAX_ORIENTATIONS) {
            let pose = part_from_laser(scene, frames.start + i as u32);
            if poses.iter().all(|other| other.rotation != pose.rotation) {
                poses.push(pose);
            }
        }
        let follows = poses
            .into_iter()
            .map(|pose| CameraVisibility::new(scene, accel, pose));
        Orientations {
            follows: follows.collect(),
            distance,
        }
    }

    /// Returns the largest cosine of the angle of incidence; `None` if the point is measurable in
    /// no orientation.
    fn measurable(&self, point: DVec3, normal: DVec3) -> Option<f64> {
        let follows = self.follows.iter();
        let cosines = follows.filter_map(|follow| follow.measurable(point, normal, self.distance));
        cosines.reduce(f64::max)
    }
}

/// Measurable positions of the part with their weights, and their fraction of the area.
struct MeasurableSurface {
    points: Vec<(DVec3, f64)>,
    fraction: f64,
}

impl MeasurableSurface {
    fn of(accel: &Accel, orientations: &Orientations) -> MeasurableSurface {
        let samples = coverage::sample_surface(accel, SURFACE_SAMPLES);
        let samples = samples.map_or(Vec::new(), |samples| samples.points);
        let weighed = samples.par_iter().filter_map(|&(point, normal)| {
            // Triangles may be wound either way.
            let sides = [normal, -normal].into_iter();
            let weights = sides.filter_map(|normal| orientations.measurable(point, normal));
            Some((point, weights.reduce(f64::max)?))
        });
        let points: Vec<(DVec3, f64)> = weighed.collect();
        MeasurableSurface {
            fraction: points.len() as f64 / samples.len().max(1) as f64,
            points,
        }
    }

    fn fractions(&self, ways: &[Passing], valid: f64) -> Option<SurfaceFractions> {
        let of = |holds: &dyn Fn(Passing) -> bool| {
            let weights = self.points.iter().zip(ways);
            let weights = weights.filter(|(_, way)| holds(**way));
            // An empty sum is −0.0.
            weights.map(|((_, weight), _)| weight).sum::<f64>() + 0.0
        };
        let all = of(&|_| true);
        let fraction = |way| of(&|other| other == way) / all;
        (all > 0.0).then(|| SurfaceFractions {
            measurable: self.fraction,
            in_field: fraction(Passing::InField),
            beside_field: fraction(Passing::Beside),
            not_passed: fraction(Passing::Never),
            measured: fraction(Passing::InField) * valid,
        })
    }
}

impl PathFigures {
    fn of(
        (scene, accel): (&Scene, &Accel),
        frames: &Range<u32>,
        passes: &Passes,
        sensor: Option<&SensorFigures>,
        gap: Option<PassGap>,
    ) -> PathFigures {
        let exposure_s = scene.camera.sensor.exposure_ms * 1e-3;
        let given = scene.scan.exposure_share.map(|share| share / exposure_s);
        let fastest = sensor.map(|sensor| sensor.profiles_per_second);
        let rate = given.or(fastest).unwrap_or(1.0 / exposure_s);
        let [empty_frames, field_beside_part] = outside_part(scene, accel, frames);
        let column = sensor.and_then(|sensor| sensor.places.get(sensor.places.len() / 2));
        PathFigures {
            passes: passes.frames.len(),
            travel_mm: passes.travel,
            step_mm: passes.step,
            column_mm: column.map(|place| place.um_per_px[0] * 1e-3),
            frame_rate_hz: rate,
            duration_s: frames.len() as f64 / rate,
            empty_frames,
            field_beside_part,
            gap,
        }
    }
}

/// Returns the fraction of the frames whose field passes outside the box around the part, and the
/// fraction of the field that does so in the other frames.
fn outside_part(scene: &Scene, accel: &Accel, frames: &Range<u32>) -> [f64; 2] {
    let part = accel.bounds();
    let seen: Vec<DVec3> = directions(scene)
        .iter()
        .filter(|direction| direction.seen.is_some())
        .map(|direction| direction.along)
        .collect();
    if seen.is_empty() {
        return [0.0; 2];
    }
    let fractions: Vec<f64> = even_subset(frames.len(), MAX_FRAMES)
        .map(|i| {
            let pose = part_from_laser(scene, frames.start + i as u32);
            let hits = |along: &&DVec3| hits_box(&part, pose.translation, pose.vector(**along));
            seen.iter().filter(hits).count() as f64 / seen.len() as f64
        })
        .collect();
    let lit: Vec<f64> = fractions.iter().copied().filter(|&f| f > 0.0).collect();
    let beside = match lit.len() {
        0 => 0.0,
        n => 1.0 - lit.iter().sum::<f64>() / n as f64,
    };
    [1.0 - lit.len() as f64 / fractions.len() as f64, beside]
}

/// Returns whether a ray hits a box, which may have no thickness (slab method).
fn hits_box(part: &Aabb, origin: DVec3, direction: DVec3) -> bool {
    let (mut enters, mut leaves) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let [low, high] = [part.min[axis], part.max[axis]].map(|end| end - origin[axis]);
        if direction[axis] == 0.0 {
            if low > 0.0 || high < 0.0 {
                return false;
            }
            continue;
        }
        let [low, high] = [low / direction[axis], high / direction[axis]];
        enters = enters.max(low.min(high));
        leaves = leaves.min(low.max(high));
    }
    enters <= leaves
}

/// Returns the width of the field where lit surface in view is nearest to the laser. The field is
/// narrowest there.
fn field_at_part(sensor: &SensorFigures, scene: &Scene, survey: &LightSurvey) -> Option<f64> {
    let seen = survey.lit.iter().filter(|lit| {
        !matches!(
            lit.fate,
            RayResult::OutOfView | RayResult::TooNear(_) | RayResult::TooFar(_)
        )
    });
    let distance = |lit: &LaserHit| {
        let laser_from_part = part_from_laser(scene, lit.frame).inverse();
        laser_from_part.point(lit.point).z
    };
    let nearest = seen.map(distance).reduce(f64::min)?;
    let [near, far] = sensor.ends();
    sensor.field_at(nearest.clamp(near, far))
}

/// A pass in the part's frame.
struct Line {
    /// Centre of the pass.
    center: DVec3,
    /// Unit vectors along the travel, the laser line and the beam.
    axes: [DVec3; 3],
    half_length: f64,
}

impl Line {
    fn of(scene: &Scene, pass: &std::ops::RangeInclusive<u32>, reference: DVec3) -> Option<Line> {
        let [first, last] = [*pass.start(), *pass.end()];
        let at = |frame: u32| scene.part_from_head(frame).point(reference);
        let way = at(last) - at(first);
        let pose = part_from_laser(scene, first + (last - first) / 2);
        let axes = [
            way.try_normalize()?,
            pose.rotation.x_axis,
            pose.rotation.z_axis,
        ];
        // A pass along the laser line, like a transition between passes, leaves no gap at its
        // sides.
        let across = axes[0].dot(axes[1]).abs() < std::f64::consts::FRAC_1_SQRT_2;
        across.then(|| Line {
            center: (at(first) + at(last)) / 2.0,
            axes,
            half_length: way.length() / 2.0,
        })
    }
}

/// Returns the widest spacing of neighbouring passes that have measurable surface (`points`) where
/// their fields end.
fn widest_gap(
    scene: &Scene,
    passes: &Passes,
    reference: DVec3,
    field: f64,
    points: &[DVec3],
) -> Option<PassGap> {
    let lines: Vec<Line> = passes
        .frames
        .iter()
        .filter_map(|pass| Line::of(scene, pass, reference))
        .collect();
    let parallel = |a: DVec3, b: DVec3| a.dot(b) > 0.95;
    let spacing = |line: &Line| {
        let [along, side, beam] = line.axes;
        let aside = |other: &&Line| (other.center - line.center).dot(side);
        let neighbours = lines.iter().filter(|other| {
            let offset = other.center - line.center;
            parallel(side, other.axes[1])
                && parallel(beam, other.axes[2])
                && offset.dot(along).abs() < line.half_length + other.half_length
                && aside(other) > 0.05 * field
        });
        let next = neighbours.map(|other| aside(&other)).reduce(f64::min)?;
        // Ends of the two fields, which overlap or leave a gap.
        let ends = [field / 2.0, next - field / 2.0];
        let margin = 0.025 * field;
        let between = ends[0].min(ends[1]) - margin..ends[0].max(ends[1]) + margin;
        let in_gap = |point: &DVec3| {
            let offset = *point - line.center;
            between.contains(&offset.dot(side)) && offset.dot(along).abs() < line.half_length
        };
        points.iter().any(in_gap).then_some(next)
    };
    let spacing_mm = lines.iter().filter_map(spacing).reduce(f64::max)?;
    Some(PassGap {
        spacing_mm,
        field_mm: field,
    })
}
