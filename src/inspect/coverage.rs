//! Surface coverage: the measured area of the CAD surface, and the causes of missing area.

use super::cloud::CloudPoint;
use crate::accel::{Accel, Ray};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3, Rigid};
use rayon::prelude::*;
use serde::Serialize;

/// Coverage class of a surface element. If the laser plane crosses an element several times, the
/// first variant that applies to any crossing is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fate {
    /// A valid point was measured.
    Measured,
    /// Lit and in view, but without a valid point: too dark, at grazing incidence, or saturated.
    WeakSignal,
    /// Lit, but occluded from the camera or facing away from it.
    HiddenFromCamera,
    /// Occluded from the laser or facing away from it.
    HiddenFromLaser,
    /// Never crossed by the laser plane within the fan and the field of view.
    OutsideScan,
}

impl Fate {
    /// All variants in order.
    pub const ALL: [Fate; 5] = [
        Fate::Measured,
        Fate::WeakSignal,
        Fate::HiddenFromCamera,
        Fate::HiddenFromLaser,
        Fate::OutsideScan,
    ];
}

/// Laser and camera poses of a frame, in the part frame.
#[derive(Debug, Clone, Copy)]
pub struct SensorPose {
    /// Pose of the laser.
    pub part_from_laser: Rigid,
    /// Pose of the camera.
    pub part_from_camera: Rigid,
}

/// Input of the coverage analysis.
pub struct ScanData<'a> {
    /// Ray tracer of the part.
    pub accel: &'a Accel,
    /// Ray tracer of the scanned part with objects that are not inspected, and the number of the
    /// part's triangles; `None` without objects.
    pub objects: Option<(&'a Accel, u32)>,
    /// Laser whose fan bounds the lit area.
    pub laser: &'a Laser,
    /// Camera whose sensor bounds the field of view.
    pub camera: &'a Camera,
    /// Poses of the frames from `first_frame` on.
    pub poses: &'a [SensorPose],
    /// Frame number of `poses[0]`.
    pub first_frame: u32,
    /// Points in the order of frames, then columns.
    pub points: &'a [CloudPoint],
}

/// Area of the CAD surface by coverage class.
#[derive(Debug, Clone, Serialize)]
pub struct SurfaceCoverage {
    /// Area of the complete part including internal faces, mm².
    pub area_mm2: f64,
    /// Fraction of the area for each class; the sum is 1.
    pub shares: Vec<(Fate, f64)>,
    /// Valid points per square millimetre of the measured surface.
    pub points_per_mm2: Option<f64>,
    /// Number of sample positions, distributed uniformly over the area. A fraction p has a standard
    /// error of about √(p(1 − p)/samples).
    pub samples: usize,
    /// Sample positions (mm, part frame) with their class.
    #[serde(skip)]
    pub places: Vec<(DVec3, Fate)>,
}

const MOST_SAMPLES: usize = 40_000;
const FEWEST_SAMPLES: usize = 2_000;
/// Maximum number of samples times frames, for a run time of a few seconds on one core.
const MOST_LOOKS: usize = 400_000_000;

/// Classifies sample positions distributed uniformly over the part. Returns `None` for a part
/// without area.
pub fn coverage(scanned: &ScanData) -> Option<SurfaceCoverage> {
    let wanted = MOST_LOOKS / scanned.poses.len().max(1);
    let places = sample_surface(scanned.accel, wanted.clamp(FEWEST_SAMPLES, MOST_SAMPLES))?;
    // Distance from the laser plane as n·p − c.
    let sheets: Vec<(DVec3, f64)> = scanned
        .poses
        .iter()
        .map(|pose| {
            let n = pose.part_from_laser.rotation.y_axis;
            (n, n.dot(pose.part_from_laser.translation))
        })
        .collect();
    let places_with_fate: Vec<(DVec3, Fate)> = places
        .points
        .par_iter()
        .map(|&(p, normal)| (p, scanned.fate(&sheets, p, normal)))
        .collect();
    let valid = scanned.points.iter().filter(|point| point.is_valid());
    Some(SurfaceCoverage::new(
        places.area,
        places_with_fate,
        valid.count(),
    ))
}

impl SurfaceCoverage {
    /// Returns the coverage of a surface with these sample positions and numbers of valid points.
    fn new(area: f64, places: Vec<(DVec3, Fate)>, valid: usize) -> SurfaceCoverage {
        let samples = places.len();
        let share = |fate: Fate| {
            let n = places.iter().filter(|(_, f)| *f == fate).count();
            n as f64 / samples as f64
        };
        let measured = area * share(Fate::Measured);
        SurfaceCoverage {
            area_mm2: area,
            shares: Fate::ALL.iter().map(|&fate| (fate, share(fate))).collect(),
            points_per_mm2: (measured > 0.0).then(|| valid as f64 / measured),
            samples,
            places,
        }
    }

    /// Returns the coverage by several cameras, with the number of valid points of all. A position has
    /// the first class that any camera gives it.
    pub(crate) fn of_cameras(all: &[&SurfaceCoverage], valid: usize) -> Option<SurfaceCoverage> {
        let (first, others) = all.split_first()?;
        let mut places = first.places.clone();
        for other in others {
            for ((_, fate), (_, found)) in places.iter_mut().zip(&other.places) {
                *fate = (*fate).min(*found);
            }
        }
        Some(SurfaceCoverage::new(first.area_mm2, places, valid))
    }
}

pub(crate) struct SurfaceSamples {
    area: f64,
    /// Positions with the unit normal of the triangle by its winding.
    pub points: Vec<(DVec3, DVec3)>,
}

/// Returns `n` positions at equal area steps along the triangles of the part, instance by instance.
/// The position in the triangle is a term of a low-discrepancy sequence (Roberts 2018).
pub(crate) fn sample_surface(accel: &Accel, n: usize) -> Option<SurfaceSamples> {
    let mesh = accel.mesh();
    let triangles = || (0..mesh.triangles.len()).map(|t| mesh.triangle(t));
    let doubled = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
    let area_of_mesh: f64 = triangles().map(|t| doubled(t).length() / 2.0).sum();
    let area = area_of_mesh * accel.poses().len() as f64;
    if area.is_nan() || area <= 0.0 {
        return None;
    }
    // Accumulated area within an instance, instance, and index of the position. Sorted by area, all
    // instances are sampled in one pass over the triangles.
    let mut steps = Vec::with_capacity(n);
    let (mut copy, mut next) = (0, 0.5 * area / n as f64);
    for i in 0..n {
        while next >= area_of_mesh && copy + 1 < accel.poses().len() {
            next -= area_of_mesh;
            copy += 1;
        }
        steps.push((next, copy, i));
        next += area / n as f64;
    }
    steps.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut steps = steps.into_iter().peekable();
    let mut points = Vec::with_capacity(n);
    let mut passed = 0.0;
    for [a, b, c] in triangles() {
        let normal = doubled([a, b, c]);
        passed += normal.length() / 2.0;
        while let Some((_, copy, i)) = steps.next_if(|&(next, _, _)| next < passed) {
            let (u, v) = (
                (0.754_877_666_246_693 * i as f64).fract(),
                (0.569_840_290_998_053 * i as f64).fract(),
            );
            let (u, v) = if u + v > 1.0 {
                (1.0 - u, 1.0 - v)
            } else {
                (u, v)
            };
            let pose = &accel.poses()[copy];
            let point = pose.point(a + (b - a) * u + (c - a) * v);
            points.push((i, point, pose.vector(normal.normalize_or_zero())));
        }
    }
    points.sort_by_key(|&(i, _, _)| i);
    let points = points.into_iter().map(|(_, p, normal)| (p, normal));
    Some(SurfaceSamples {
        area,
        points: points.collect(),
    })
}

impl ScanData<'_> {
    fn fate(&self, sheets: &[(DVec3, f64)], p: DVec3, normal: DVec3) -> Fate {
        let mut best = Fate::OutsideScan;
        let mut before: Option<f64> = None;
        for (frame, (n, c)) in sheets.iter().enumerate() {
            let here = n.dot(p) - c;
            // The plane crossed the position between two frames; the nearer frame decides.
            if let Some(there) = before.filter(|there| (there < &0.0) != (here < 0.0)) {
                let nearer = if there.abs() < here.abs() {
                    frame - 1
                } else {
                    frame
                };
                best = best.min(self.fate_in_frame(p, normal, nearer, (there - here).abs()));
            }
            before = Some(here);
            if best == Fate::Measured {
                break;
            }
        }
        best
    }

    /// Returns the class in one frame. `step` is the motion of the laser plane at the position
    /// between two frames, mm.
    fn fate_in_frame(&self, p: DVec3, normal: DVec3, frame: usize, step: f64) -> Fate {
        let pose = &self.poses[frame];
        let laser = pose.part_from_laser.inverse().point(p);
        // Projected onto the laser plane, because the position is up to half a step away from it.
        let lit = self.laser.at(laser.with_y(0.0)).is_some();
        let camera_from_part = pose.part_from_camera.inverse();
        let resolution = self.camera.sensor.resolution.as_dvec2();
        let inside = |p: &DVec2| p.cmpge(DVec2::ZERO).all() && p.cmplt(resolution).all();
        let seen = self
            .camera
            .project(camera_from_part.point(p))
            .filter(inside);
        let Some(pixel) = seen.filter(|_| lit) else {
            return Fate::OutsideScan;
        };
        let (source, eye) = (
            pose.part_from_laser.translation,
            pose.part_from_camera.translation,
        );
        // The normal is oriented towards the laser, because meshes may have inconsistent winding.
        let normal = normal * normal.dot(source - p).signum();
        let start = p + normal * self.accel.resolution();
        if self.blocked(start, source) {
            return Fate::HiddenFromLaser;
        }
        if normal.dot(eye - p) <= 0.0 || self.blocked(start, eye) {
            return Fate::HiddenFromCamera;
        }
        let wide =
            (p - eye).length() * self.camera.sensor.pixel_pitch / self.camera.lens.image_distance();
        match self.has_point(p, frame, pixel.x, 2.0 * step.hypot(wide)) {
            true => Fate::Measured,
            false => Fate::WeakSignal,
        }
    }

    fn blocked(&self, from: DVec3, to: DVec3) -> bool {
        let by_object = |ray: Ray| {
            self.objects.is_some_and(|(accel, part)| {
                let [hit, ..] = accel.closest(&[ray], |_, _| true);
                hit.is_some_and(|hit| hit.face.triangle >= part)
            })
        };
        Ray::between(from, to).is_some_and(|ray| self.accel.occluded(&[ray]) != 0 || by_object(ray))
    }

    /// Returns whether the frame or an adjacent frame has a valid point near `p`, in its column or
    /// adjacent columns.
    fn has_point(&self, p: DVec3, frame: usize, column: f64, radius: f64) -> bool {
        let first_column = (column - 1.5).floor().max(0.0) as u32;
        let frame = self.first_frame as usize + frame;
        (frame.saturating_sub(1)..=frame + 1).any(|frame| {
            let from = self
                .points
                .partition_point(|q| (q.frame as usize, q.column) < (frame, first_column));
            self.points[from..]
                .iter()
                .take_while(|q| q.frame as usize == frame && q.column <= first_column + 4)
                .any(|q| q.is_valid() && q.position.distance(p) <= radius)
        })
    }
}
