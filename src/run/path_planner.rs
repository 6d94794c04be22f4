//! Planned scan paths: straight passes with rotations of the head that measure features or the
//! complete surface.
//!
//! Candidate passes have sampled directions of the beam and rotations about it. Each candidate is
//! tested by rays from the surface to laser and camera, at the frame whose laser plane contains the
//! sample. [`shortest_path`] selects and orders candidates.

use super::light_survey::{CameraVisibility, Sighting};
use super::sensor_figures::SensorFigures;
use super::set_cover::{Candidate, Group, count_within, path_length, shortest_path, union_of};
use crate::accel::{Accel, Ray};
use crate::error::Result;
use crate::inspect::features::NominalFace;
use crate::math::{Aabb, DMat3, DVec2, DVec3, Rigid};
use crate::mesh::ProgressFn;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Fraction of the measuring range and of the field that passes use. The remainder overlaps.
const USED_FIELD_FRACTION: f64 = 0.9;
/// Fraction of the measurable samples of each feature, or of the surface, that a path measures. Full
/// coverage would add long passes for few samples.
const REQUIRED: f64 = 0.95;
/// Angle between tilts of the beam, and between directions of one tilt, degrees.
const ANGLE_STEP_DEG: f64 = 30.0;
/// Maximum number of passes of one orientation that tile the samples.
pub(crate) const MAX_PASSES: f64 = 1_000.0;
/// Number of samples per face of a feature, and on the complete surface.
const FACE_SAMPLES: usize = 400;
const SURFACE_SAMPLES: usize = 4000;

/// Position on the surface with its normal.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sample {
    point: DVec3,
    normal: DVec3,
    triangle: u32,
}

/// Surface of a feature, or of the complete part.
pub(crate) struct TargetSurface {
    /// Name of the feature; `None` for the part.
    pub name: Option<String>,
    area_mm2: f64,
    samples: Vec<Sample>,
}

/// Limits of the head: direction away from the part in which it may be, largest angle between this
/// direction and the beam (rad), and distance of the frames along a pass, mm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PathLimits {
    pub up: DVec3,
    pub max_tilt: f64,
    pub spacing: f64,
}

/// Pass of a planned path.
#[derive(Debug, Clone)]
pub(crate) struct PlannedPass {
    /// Pose of the laser at the first frame, part frame.
    start: Rigid,
    /// Displacement to the last frame, mm.
    travel: DVec3,
    /// Distance of the frames, mm.
    pub spacing: f64,
    /// Indices of the targets that the pass measures.
    pub targets: Vec<usize>,
}

/// Surface that no candidate pass measures.
#[derive(Debug, Clone, Serialize)]
pub struct HiddenSurface {
    /// Reason.
    pub reason: &'static str,
    /// Area, mm².
    pub area_mm2: f64,
}

/// Measured and hidden surface of a target.
#[derive(Debug, Clone, Serialize)]
pub struct TargetCoverage {
    /// Name of the feature; `null` for the complete part.
    pub feature: Option<String>,
    /// Area, mm².
    pub area_mm2: f64,
    /// Area that the path measures, mm².
    pub measured_mm2: f64,
    /// Area that no pass within the limits measures, by reason.
    pub hidden: Vec<HiddenSurface>,
}

/// Planned path.
#[derive(Clone)]
pub(crate) struct PlannedPath {
    pub passes: Vec<PlannedPass>,
    /// Length with the links between passes, mm.
    pub length_mm: f64,
    pub targets: Vec<TargetCoverage>,
}

impl TargetSurface {
    /// Samples the face of a feature.
    pub fn face(accel: &Accel, name: &str, face: &NominalFace) -> TargetSurface {
        let triangles = face.triangles.iter().map(|&t| (face.copy, t));
        TargetSurface::of(accel, Some(name.to_owned()), triangles, FACE_SAMPLES)
    }

    /// Samples the complete surface of the part.
    pub fn part(accel: &Accel) -> TargetSurface {
        let copies = 0..accel.poses().len() as u32;
        let count = accel.mesh().triangles.len() as u32;
        let triangles = copies.flat_map(|copy| (0..count).map(move |t| (copy, t)));
        TargetSurface::of(accel, None, triangles, SURFACE_SAMPLES)
    }

    /// Samples triangles, given with their instance, at equal area steps. The position in the
    /// triangle is a term of a low-discrepancy sequence (Roberts 2018).
    fn of(
        accel: &Accel,
        name: Option<String>,
        triangles: impl Iterator<Item = (u32, u32)> + Clone,
        count: usize,
    ) -> TargetSurface {
        let corners = |(copy, triangle): (u32, u32)| {
            let pose = accel.poses()[copy as usize];
            accel
                .mesh()
                .triangle(triangle as usize)
                .map(|p| pose.point(p))
        };
        let doubled = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
        let areas = triangles
            .clone()
            .map(|t| doubled(corners(t)).length() / 2.0);
        let area: f64 = areas.sum();
        let step = area / count as f64;
        let (mut passed, mut next, mut samples) = (0.0, step / 2.0, Vec::with_capacity(count));
        for of in triangles {
            let [a, b, c] = corners(of);
            let normal = doubled([a, b, c]);
            passed += normal.length() / 2.0;
            while next < passed && step > 0.0 {
                let i = samples.len() as f64;
                let uv = DVec2::new(0.754_877_666_246_693 * i, 0.569_840_290_998_053 * i).fract();
                let uv = if uv.x + uv.y > 1.0 { 1.0 - uv } else { uv };
                samples.push(Sample {
                    point: a + (b - a) * uv.x + (c - a) * uv.y,
                    normal: normal.normalize_or_zero(),
                    triangle: of.1,
                });
                next += step;
            }
        }
        TargetSurface {
            name,
            area_mm2: area,
            samples,
        }
    }
}

/// Rotations from the laser frame to the part frame within the limits.
fn orientations(limits: &PathLimits) -> Vec<DMat3> {
    let step = ANGLE_STEP_DEG.to_radians();
    let rings = 0..=((limits.max_tilt / step + 1e-9).floor() as usize);
    let x = match limits.up.x.abs() < 0.9 {
        true => DVec3::X,
        false => DVec3::Y,
    };
    let Some(base) = Rigid::from_z_and_x(DVec3::ZERO, limits.up, x) else {
        return Vec::new();
    };
    let directions = rings.flat_map(|ring| {
        let tilt = ring as f64 * step;
        let count = (std::f64::consts::TAU * tilt.sin() / step - 1e-9)
            .ceil()
            .max(1.0);
        (0..count as usize).map(move |i| {
            let azimuth = std::f64::consts::TAU * i as f64 / count;
            let (sin, cos) = azimuth.sin_cos();
            DVec3::new(tilt.sin() * cos, tilt.sin() * sin, tilt.cos())
        })
    });
    let rolls = |direction: DVec3| {
        let beam = -base.vector(direction);
        let hint = base.vector(DVec3::X);
        let hint = match hint.cross(beam).length() > 0.1 {
            true => hint,
            false => base.vector(DVec3::Y),
        };
        let first = Rigid::from_z_and_x(DVec3::ZERO, beam, hint);
        first.into_iter().flat_map(|Rigid { rotation, .. }| {
            let [x, y, z] = [rotation.x_axis, rotation.y_axis, rotation.z_axis];
            [(x, y), (y, -x), (-x, -y), (-y, x)].map(|(x, y)| DMat3::from_cols(x, y, z))
        })
    };
    directions.flat_map(rolls).collect()
}

/// Candidate pass with its orientation, and the results of all samples.
struct Stripe {
    rotation: DMat3,
    candidate: Candidate,
}

/// Window of a pass: centres along the line and along the beam, in the axes of the orientation.
#[derive(Clone, Copy)]
struct PassWindow {
    x: f64,
    z: f64,
}

/// Sensor dimensions that passes use, mm.
struct Dimensions {
    field_center: f64,
    range_center: f64,
    wide: f64,
    deep: f64,
    /// Length by which a pass begins before the first sample and ends after the last one.
    lead: f64,
}

struct Planner<'a> {
    scene: &'a Scene,
    accel: &'a Accel,
    targets: &'a [TargetSurface],
    samples: Vec<Sample>,
    dimensions: Dimensions,
}

/// Returns whether the passes of one orientation that tile the targets are too many for planning,
/// as for a part in the wrong unit.
pub(crate) fn is_too_large(figures: &SensorFigures, targets: &[TargetSurface]) -> bool {
    let points = targets
        .iter()
        .flat_map(|t| t.samples.iter().map(|s| s.point));
    let size = Aabb::of(points).size().length();
    let [near, far] = figures.ends();
    let width = figures.width_at_center().unwrap_or(0.0);
    let passes =
        (size / (USED_FIELD_FRACTION * width)) * (size / (USED_FIELD_FRACTION * (far - near)));
    passes.is_nan() || passes > MAX_PASSES
}

/// Plans a path over targets.
///
/// # Errors
/// Errors of `watch`, which is called with the progress, from any thread.
pub(crate) fn plan(
    (scene, accel): (&Scene, &Accel),
    figures: &SensorFigures,
    targets: &[TargetSurface],
    limits: &PathLimits,
    watch: &ProgressFn,
) -> Result<PlannedPath> {
    let planner = Planner::new((scene, accel), figures, targets, limits);
    let (stripes, sightings) = planner.stripes(limits, &|share| watch(share / 2.0))?;
    let split = stripes.into_iter().map(|s| (s.rotation, s.candidate));
    let (rotations, candidates): (Vec<DMat3>, Vec<Candidate>) = split.unzip();
    let groups = planner.groups(&candidates);
    let path = shortest_path(&candidates, &groups, &|share| watch((1.0 + share) / 2.0))?;
    let measured = path.iter().map(|leg| &candidates[leg.0].covers[..]);
    let measured = union_of(measured, planner.words());
    let passes = path.iter().map(|&(i, reversed)| {
        let (rotation, candidate) = (rotations[i], &candidates[i]);
        let [first, last] = candidate.ends;
        let [first, last] = if reversed {
            [last, first]
        } else {
            [first, last]
        };
        let seen = groups.iter().enumerate();
        let seen = seen.filter(|(_, group)| count_within(&candidate.covers, &group.samples) > 0);
        PlannedPass {
            start: Rigid {
                rotation,
                translation: first,
            },
            travel: last - first,
            spacing: limits.spacing,
            targets: seen.map(|(target, _)| target).collect(),
        }
    });
    Ok(PlannedPath {
        passes: passes.collect(),
        length_mm: path_length(&candidates, &path),
        targets: planner.coverage(&groups, &measured, &sightings),
    })
}

impl<'a> Planner<'a> {
    fn new(
        (scene, accel): (&'a Scene, &'a Accel),
        figures: &SensorFigures,
        targets: &'a [TargetSurface],
        limits: &PathLimits,
    ) -> Planner<'a> {
        let [near, far] = figures.ends();
        let fields = figures.places.iter().map(|place| place.field_mm);
        let [low, high] = fields
            .reduce(|a, b| [a[0].max(b[0]), a[1].min(b[1])])
            .unwrap_or_default();
        let center = (near + far) / 2.0;
        Planner {
            scene,
            accel,
            targets,
            samples: targets
                .iter()
                .flat_map(|t| t.samples.iter().copied())
                .collect(),
            dimensions: Dimensions {
                field_center: (low + high) / 2.0,
                range_center: center,
                wide: USED_FIELD_FRACTION * (high - low),
                deep: USED_FIELD_FRACTION * (far - near),
                lead: (2.0 * scene.laser.radius(DVec3::Z * center)).max(limits.spacing),
            },
        }
    }

    fn words(&self) -> usize {
        self.samples.len().div_ceil(64)
    }

    /// Returns the indices of the samples of each target.
    fn ranges(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        self.targets.iter().scan(0, |first, target| {
            let range = *first..*first + target.samples.len();
            *first = range.end;
            Some(range)
        })
    }

    /// Returns the candidate passes, and the best result of every sample.
    fn stripes(
        &self,
        limits: &PathLimits,
        watch: &ProgressFn,
    ) -> Result<(Vec<Stripe>, Vec<Sighting>)> {
        let none = || (Vec::new(), vec![Sighting::OutsideField; self.samples.len()]);
        let orientations = orientations(limits);
        let done = AtomicUsize::new(0);
        let of_each = orientations.par_iter().map(|rotation| {
            watch(done.fetch_add(1, Ordering::Relaxed) as f64 / orientations.len() as f64)?;
            self.of_orientation(*rotation)
        });
        of_each.try_reduce(none, |(mut stripes, mut best), (more, results)| {
            stripes.extend(more);
            for (best, result) in best.iter_mut().zip(results) {
                *best = (*best).min(result);
            }
            Ok((stripes, best))
        })
    }

    fn of_orientation(&self, rotation: DMat3) -> Result<(Vec<Stripe>, Vec<Sighting>)> {
        let local: Vec<DVec3> = self
            .samples
            .iter()
            .map(|s| rotation.transpose() * s.point)
            .collect();
        let mut best = vec![Sighting::OutsideField; self.samples.len()];
        let mut stripes = Vec::new();
        for (window, only) in self.windows(&local) {
            let Dimensions { wide, deep, .. } = self.dimensions;
            let inside = |p: &DVec3| {
                (p.x - window.x).abs() <= wide / 2.0 && (p.z - window.z).abs() <= deep / 2.0
            };
            let within = (0..self.samples.len()).filter(|&i| inside(&local[i]));
            let free = self.free_intervals(rotation, window)?;
            let mut seen = Vec::new();
            for i in within {
                let y = local[i].y;
                let is_free = free.iter().any(|[low, high]| (*low..=*high).contains(&y));
                let result = match self.sighting(rotation, window, y, &self.samples[i]) {
                    Sighting::Measurable if !is_free => Sighting::HeadInPart,
                    result => result,
                };
                best[i] = best[i].min(result);
                if result == Sighting::Measurable {
                    seen.push(i);
                }
            }
            // In each interval, a pass over all samples of the window, and a pass over the samples of
            // one target.
            let ranges = [Some(0..self.samples.len()), only];
            for ([first, last], range) in free.iter().flat_map(|interval| {
                let ranges = ranges.iter().flatten();
                ranges.map(move |range| (*interval, range))
            }) {
                let ys = seen.iter().filter(|i| range.contains(i));
                let ys = ys.map(|&i| local[i].y);
                let ys = ys.filter(|y| (first..=last).contains(y));
                let [low, high] = ys.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], y| {
                    [low.min(y), high.max(y)]
                });
                if low > high {
                    continue;
                }
                let covered = seen.iter().filter(|&&i| (low..=high).contains(&local[i].y));
                let mut covers = vec![0; self.words()];
                covered.for_each(|&i| covers[i / 64] |= 1 << (i % 64));
                let lead = self.dimensions.lead;
                let ends = [(low - lead).max(first), (high + lead).min(last)];
                let ends = ends.map(|y| self.laser(rotation, window, y));
                stripes.push(Stripe {
                    rotation,
                    candidate: Candidate { ends, covers },
                });
            }
        }
        Ok((stripes, best))
    }

    /// Returns the intervals along a pass, in the axes of the orientation, in which laser, camera and
    /// corners of the housing are outside the part. Their ends are one lead before the surface.
    ///
    /// # Errors
    /// Too little memory for the intersections with the part.
    fn free_intervals(&self, rotation: DMat3, window: PassWindow) -> Result<Vec<[f64; 2]>> {
        let scene = self.scene;
        let laser_from_head = scene.head_from_laser.inverse();
        let camera = scene.head_from_camera.point(scene.camera.position());
        let housing = scene.housing.iter().flat_map(Aabb::corners);
        let bodies = [scene.head_from_laser.translation, camera];
        let bodies: Vec<DVec3> = bodies
            .into_iter()
            .chain(housing)
            .map(|body| laser_from_head.point(body))
            .collect();
        let travel = rotation.y_axis;
        let bounds = self.accel.bounds();
        let before = travel.dot(bounds.center()) - bounds.size().length();
        let ray = |i: usize| Ray {
            origin: self.laser(rotation, window, before - bodies[i].y) + rotation * bodies[i],
            direction: travel,
            t_max: f64::INFINITY,
        };
        let hits = self.accel.all_hits(ray, bodies.len(), usize::MAX)?;
        let lead = self.dimensions.lead;
        let mut occupied = Vec::new();
        for (i, body) in bodies.iter().enumerate() {
            let mut entered = Vec::new();
            let of_body = hits.starts[i]..hits.starts[i + 1];
            for (hit, entering) in hits.of(i).iter().zip(&hits.entering[of_body]) {
                let y = before - body.y + hit.distance;
                let from = match entering {
                    true => y,
                    false => entered.pop().unwrap_or(y),
                };
                if *entering {
                    entered.push(y);
                }
                occupied.push([from - lead, y + lead]);
            }
        }
        occupied.sort_by(|a: &[f64; 2], b| a[0].total_cmp(&b[0]));
        let mut free = Vec::new();
        let mut from = f64::NEG_INFINITY;
        for [low, high] in occupied {
            if low > from {
                free.push([from, low]);
            }
            from = from.max(high);
        }
        free.push([from, f64::INFINITY]);
        Ok(free)
    }

    /// Returns the position of the laser for a window and a position along the pass.
    fn laser(&self, rotation: DMat3, window: PassWindow, y: f64) -> DVec3 {
        let Dimensions {
            field_center,
            range_center,
            ..
        } = self.dimensions;
        rotation * DVec3::new(window.x - field_center, y, window.z - range_center)
    }

    fn sighting(&self, rotation: DMat3, window: PassWindow, y: f64, sample: &Sample) -> Sighting {
        let part_from_laser = Rigid {
            rotation,
            translation: self.laser(rotation, window, y),
        };
        let sensor = CameraVisibility::new(self.scene, self.accel, part_from_laser);
        sensor.sighting(sample.point, sample.normal, sample.triangle)
    }

    /// Returns windows that tile the samples, and windows at the centre of each target with the
    /// samples of the target.
    fn windows(&self, local: &[DVec3]) -> Vec<(PassWindow, Option<Range<usize>>)> {
        let Aabb {
            min: low,
            max: high,
        } = Aabb::of(local.iter().copied());
        let centers = |low: f64, high: f64, size: f64| {
            let count = ((high - low) / size).ceil().clamp(1.0, MAX_PASSES);
            let at = move |i: usize| low + (high - low) * (i as f64 + 0.5) / count;
            (0..count as usize).map(at).collect::<Vec<f64>>()
        };
        let Dimensions { wide, deep, .. } = self.dimensions;
        let along = centers(low.x, high.x, wide);
        let depths = centers(low.z, high.z, deep);
        let tiles = along
            .iter()
            .flat_map(|&x| depths.iter().map(move |&z| PassWindow { x, z }));
        let mut windows: Vec<_> = tiles.map(|window| (window, None)).collect();
        for (target, range) in self.targets.iter().zip(self.ranges()) {
            if target.name.is_some() && !range.is_empty() {
                let center = Aabb::of(local[range.clone()].iter().copied()).center();
                let window = PassWindow {
                    x: center.x,
                    z: center.z,
                };
                windows.push((window, Some(range)));
            }
        }
        windows
    }

    /// Returns the samples of every target with the required number.
    fn groups(&self, candidates: &[Candidate]) -> Vec<Group> {
        let all = union_of(candidates.iter().map(|c| &c.covers[..]), self.words());
        let of_target = |samples: Range<usize>| Group {
            required: (REQUIRED * count_within(&all, &samples) as f64).ceil() as usize,
            samples,
        };
        self.ranges().map(of_target).collect()
    }

    fn coverage(
        &self,
        groups: &[Group],
        measured: &[u64],
        sightings: &[Sighting],
    ) -> Vec<TargetCoverage> {
        let of_target = |(target, group): (&TargetSurface, &Group)| {
            let of_target = &sightings[group.samples.clone()];
            let area =
                |count: usize| target.area_mm2 * count as f64 / target.samples.len().max(1) as f64;
            let hidden = Sighting::HIDDEN.iter().map(|sighting| HiddenSurface {
                reason: sighting.reason(),
                area_mm2: area(of_target.iter().filter(|s| *s == sighting).count()),
            });
            TargetCoverage {
                feature: target.name.clone(),
                area_mm2: target.area_mm2,
                measured_mm2: area(count_within(measured, &group.samples)),
                hidden: hidden.filter(|hidden| hidden.area_mm2 > 0.0).collect(),
            }
        };
        self.targets.iter().zip(groups).map(of_target).collect()
    }
}

impl PlannedPass {
    /// Returns the poses of the laser in all frames.
    pub fn poses(&self) -> impl Iterator<Item = Rigid> + '_ {
        let steps = (self.travel.length() / self.spacing).ceil().max(1.0);
        (0..=steps as usize).map(move |i| Rigid {
            rotation: self.start.rotation,
            translation: self.start.translation + self.travel * (i as f64 / steps),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::set_cover::exhaustive;
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use std::path::Path;
    use std::sync::Arc;

    /// Returns a scene of the 20 mm sensor with a part of random size.
    fn scene(seed: u64) -> Scene {
        let key = RngKey::new(seed, Purpose::Bootstrap);
        let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
        let [x, y, z] = [0, 1, 2].map(|i| between(i, 6.0, 24.0));
        let part = match seed % 3 {
            0 => format!(
                "step_block = {{ size_mm = [{x}, {y}, {z}], step_mm = {} }}",
                z / 3.0
            ),
            1 => format!(
                "cylinder = {{ radius_mm = {}, length_mm = {y}, chordal_deviation_um = 20 }}",
                x / 2.0
            ),
            _ => format!(
                "sphere = {{ radius_mm = {}, chordal_deviation_um = 20 }}",
                x / 2.0
            ),
        };
        scene_of(&part)
    }

    /// Returns a scene of the 20 mm sensor.
    fn scene_of(part: &str) -> Scene {
        let sensor = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/sensors/generic-20mm-405nm.toml"
        );
        let text = format!(
            "seed = 1\nspeckle = true\nsensor = \"{sensor}\"\n[part]\n{part}\nreflectance = 0.5\n\
             [scan]\nframes = 1\nstep_mm = 0\ndirection = [0, 1, 0]\n"
        );
        Scene::parse(&text, Path::new("")).unwrap()
    }

    const LIMITS: PathLimits = PathLimits {
        up: DVec3::Z,
        max_tilt: std::f64::consts::FRAC_PI_3,
        spacing: 1.0,
    };

    /// Returns the hierarchy, the figures of the sensor, and the complete surface with `count` samples.
    fn prepared(scene: &Scene, count: usize) -> (Accel, SensorFigures, [TargetSurface; 1]) {
        let mesh = Arc::new((*scene.mesh).clone());
        let accel = Accel::build(&mesh, 2).unwrap();
        let figures = SensorFigures::of_sensor(scene, &accel).unwrap();
        let triangles = (0..mesh.triangles.len() as u32).map(|t| (0, t));
        let targets = [TargetSurface::of(&accel, None, triangles, count)];
        (accel, figures, targets)
    }

    /// Returns the length of the planned path over the shortest path by exhaustive search over the
    /// same candidates: the `count` candidates with the most samples that no shorter candidate
    /// contains.
    fn excess_length(seed: u64, count: usize) -> f64 {
        let scene = scene(seed);
        let (accel, figures, targets) = prepared(&scene, 200);
        let limits = PathLimits {
            spacing: 0.1,
            ..LIMITS
        };
        let planner = Planner::new((&scene, &accel), &figures, &targets, &limits);
        let (stripes, _) = planner.stripes(&limits, &|_| Ok(())).unwrap();
        let mut all: Vec<Candidate> = stripes.into_iter().map(|s| s.candidate).collect();
        let everywhere = 0..planner.samples.len();
        all.sort_by_key(|c| std::cmp::Reverse(count_within(&c.covers, &everywhere)));
        let mut candidates: Vec<Candidate> = Vec::new();
        for candidate in all {
            let within = |other: &Candidate| {
                let mut words = candidate.covers.iter().zip(&other.covers);
                words.all(|(of, other)| of & !other == 0) && other.length() <= candidate.length()
            };
            if candidates.len() < count && !candidates.iter().any(within) {
                candidates.push(candidate);
            }
        }
        let groups = planner.groups(&candidates);
        let path = shortest_path(&candidates, &groups, &|_| Ok(())).unwrap();
        let covers = path.iter().map(|leg| &candidates[leg.0].covers[..]);
        let measured = union_of(covers, planner.words());
        assert!(count_within(&measured, &groups[0].samples) >= groups[0].required);
        let ratio = path_length(&candidates, &path) / exhaustive(&candidates, &groups);
        println!(
            "part {seed}: {} of {} passes, {ratio:.3} of the shortest path",
            path.len(),
            candidates.len()
        );
        ratio
    }

    #[test]
    fn paths_over_three_parts_are_nearly_the_shortest() {
        for seed in 0..3 {
            let ratio = excess_length(seed, 10);
            assert!((1.0 - 1e-9..=1.2).contains(&ratio), "{seed}: {ratio}");
        }
    }

    #[test]
    #[ignore = "minutes; part of make verify"]
    fn paths_over_ten_parts_are_nearly_the_shortest() {
        for seed in 0..10 {
            let ratio = excess_length(seed, 14);
            assert!((1.0 - 1e-9..=1.2).contains(&ratio), "{seed}: {ratio}");
        }
    }

    /// A step of 150 mm is higher than the sensor over its lower level. No pass brings laser or camera
    /// into the part or through its surface, and passes over both levels exist.
    #[test]
    fn the_sensor_does_not_pass_through_the_part() {
        let part = "step_block = { size_mm = [300, 300, 200], step_mm = 150 }";
        let scene = scene_of(part);
        let (accel, figures, targets) = prepared(&scene, 400);
        let planner = Planner::new((&scene, &accel), &figures, &targets, &LIMITS);
        let (stripes, sightings) = planner.stripes(&LIMITS, &|_| Ok(())).unwrap();
        let camera = scene.head_from_camera.point(scene.camera.position());
        let camera = scene.head_from_laser.inverse().point(camera);
        let ways = stripes.iter().flat_map(|stripe| {
            let ends = stripe.candidate.ends;
            [DVec3::ZERO, camera].map(|body| ends.map(|end| end + stripe.rotation * body))
        });
        let ways: Vec<[DVec3; 2]> = ways.collect();
        let rays: Vec<Ray> = ways
            .iter()
            .filter_map(|[a, b]| Ray::between(*a, *b))
            .collect();
        assert!(rays.len() > 100);
        let free = rays.chunks(16).all(|rays| accel.occluded(rays) == 0);
        assert!(free);
        let starts: Vec<DVec3> = ways.iter().map(|[a, _]| *a).collect();
        let mut inside = vec![false; starts.len()];
        accel.contains_points(|i| starts[i], &mut inside).unwrap();
        assert!(!inside.contains(&true));
        let level = |p: &Sample| (p.normal.z > 0.9).then_some((p.point.z / 75.0).round() as i32);
        let seen = planner.samples.iter().zip(&sightings);
        let seen = seen.filter(|(_, sighting)| **sighting == Sighting::Measurable);
        let mut levels: Vec<i32> = seen.filter_map(|(sample, _)| level(sample)).collect();
        levels.sort_unstable();
        levels.dedup();
        assert_eq!(levels.len(), 2);
        assert!(sightings.contains(&Sighting::HeadInPart));
    }

    /// All directions within the limit, each with four rotations about the beam. Frames are right
    /// handed, and tilts are at most the limit.
    #[test]
    fn orientations_are_within_the_limits() {
        for (up, tilt, count) in [
            (DVec3::Z, 0.0, 4),
            (DVec3::X, 60.0, 72),
            (DVec3::NEG_Y, 180.0, 192),
        ] {
            let limits = PathLimits {
                up,
                max_tilt: f64::to_radians(tilt),
                spacing: 0.1,
            };
            let all = orientations(&limits);
            assert_eq!(all.len(), count, "{up} {tilt}");
            for rotation in all {
                assert!((rotation.determinant() - 1.0).abs() < 1e-12);
                let angle = up.angle_between(-rotation.z_axis);
                assert!(angle <= limits.max_tilt + 1e-9, "{angle}");
            }
        }
    }
}
