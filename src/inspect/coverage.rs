//! Which area of the CAD was measured, and why the rest was not.

use super::cloud::CloudPoint;
use crate::accel::{Accel, Ray};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3, Rigid};
use rayon::prelude::*;
use serde::Serialize;

/// What became of a piece of surface. In order: a piece that the sheet crosses
/// more than once has the first that holds for one of the crossings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fate {
    /// A valid point was found there.
    Measured,
    /// Lit and in view, but no valid point was found there: too dark, at grazing light
    /// for one, or saturated.
    WeakSignal,
    /// Lit, but something is between it and the camera, or it faces away.
    HiddenFromCamera,
    /// Something is between it and the laser, or it faces away.
    HiddenFromLaser,
    /// The sheet passed it outside the fan or the sensor, or never did.
    OutsideScan,
}

impl Fate {
    /// All, in their order.
    pub const ALL: [Fate; 5] = [
        Fate::Measured,
        Fate::WeakSignal,
        Fate::HiddenFromCamera,
        Fate::HiddenFromLaser,
        Fate::OutsideScan,
    ];
}

/// Laser and camera of a frame, in the part's frame.
#[derive(Debug, Clone, Copy)]
pub struct HeadPose {
    /// Where the laser stands.
    pub part_from_laser: Rigid,
    /// Where the camera stands.
    pub part_from_camera: Rigid,
}

/// A scan as coverage sees it.
pub struct Scanned<'a> {
    /// Rays against the part.
    pub accel: &'a Accel,
    /// Its fan bounds what is lit.
    pub laser: &'a Laser,
    /// Its sensor bounds what is in view.
    pub camera: &'a Camera,
    /// Of the frames from `first_frame` on.
    pub poses: &'a [HeadPose],
    /// Number of the frame of `poses[0]`.
    pub first_frame: u32,
    /// In order of frames, then columns.
    pub points: &'a [CloudPoint],
}

/// Area of the CAD by fate.
#[derive(Debug, Clone, Serialize)]
pub struct SurfaceCoverage {
    /// Of all of the part, inside faces too, mm².
    pub area_mm2: f64,
    /// Share of the area for each fate; their sum is 1.
    pub shares: Vec<(Fate, f64)>,
    /// Valid points per square millimetre of the measured surface.
    pub points_per_mm2: Option<f64>,
    /// Places that were looked at, spread evenly over the area: a share p is good
    /// to about √(p(1 − p)/samples).
    pub samples: usize,
    /// Each place (mm, in the part's frame) and what became of it.
    #[serde(skip)]
    pub places: Vec<(DVec3, Fate)>,
}

const MOST_SAMPLES: usize = 40_000;
const FEWEST_SAMPLES: usize = 2_000;
/// Samples times frames: what a few seconds of one core can look at.
const MOST_LOOKS: usize = 400_000_000;

/// Looks at places spread evenly over the part. `None` for one without area.
pub fn coverage(scanned: &Scanned) -> Option<SurfaceCoverage> {
    let wanted = MOST_LOOKS / scanned.poses.len().max(1);
    let places = spread(scanned.accel, wanted.clamp(FEWEST_SAMPLES, MOST_SAMPLES))?;
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
    let samples = places_with_fate.len();
    let share = |fate: Fate| {
        let n = places_with_fate.iter().filter(|(_, f)| *f == fate).count();
        n as f64 / samples as f64
    };
    let measured = places.area * share(Fate::Measured);
    let valid = scanned
        .points
        .iter()
        .filter(|point| point.is_valid())
        .count();
    Some(SurfaceCoverage {
        area_mm2: places.area,
        shares: Fate::ALL.iter().map(|&fate| (fate, share(fate))).collect(),
        points_per_mm2: (measured > 0.0).then(|| valid as f64 / measured),
        samples,
        places: places_with_fate,
    })
}

pub(crate) struct Places {
    area: f64,
    /// A point and the unit normal of its triangle, as that is wound.
    pub points: Vec<(DVec3, DVec3)>,
}

/// `n` points at equal steps of area along the part's triangles, copy by copy, and in
/// each at the next place of a low-discrepancy sequence (Roberts 2018).
pub(crate) fn spread(accel: &Accel, n: usize) -> Option<Places> {
    let mesh = accel.mesh();
    let triangles = || (0..mesh.triangles.len()).map(|t| mesh.triangle(t));
    let doubled = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
    let area_of_mesh: f64 = triangles().map(|t| doubled(t).length() / 2.0).sum();
    let area = area_of_mesh * accel.poses().len() as f64;
    if area.is_nan() || area <= 0.0 {
        return None;
    }
    // Area passed within a copy, the copy, and the point's number: in the order of the
    // first, the triangles are gone through once for all copies.
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
    Some(Places {
        area,
        points: points.collect(),
    })
}

impl Scanned<'_> {
    fn fate(&self, sheets: &[(DVec3, f64)], p: DVec3, normal: DVec3) -> Fate {
        let mut best = Fate::OutsideScan;
        let mut before: Option<f64> = None;
        for (frame, (n, c)) in sheets.iter().enumerate() {
            let here = n.dot(p) - c;
            // Crossed since the frame before: the nearer of the two saw it.
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

    /// `step`: how far the sheet moved over the place between two frames, mm.
    fn fate_in_frame(&self, p: DVec3, normal: DVec3, frame: usize, step: f64) -> Fate {
        let pose = &self.poses[frame];
        let laser = pose.part_from_laser.inverse().point(p);
        // On the sheet: the place lies beside it by up to half a step.
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
        // The side that faces the laser: meshes need not be wound rightly.
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
        Ray::between(from, to).is_some_and(|ray| self.accel.occluded(&[ray]) != 0)
    }

    /// Whether the frame or its neighbours have a valid point near `p`, in its column or the next ones.
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
