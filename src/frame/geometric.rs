//! Profile without image simulation: laser rays of zero width hit the part, and visible hits are
//! projected.

use super::PoseView;
use crate::accel::{Hit, Ray, WIDTH};
use crate::camera::{Camera, Projector};
use crate::laser::{CUTOFF_RADII, Fan};
use crate::math::{DVec2, DVec3, Rigid};
use std::f64::consts::FRAC_PI_2;

/// Line position in one column as measured by an ideal camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IdealProfilePoint {
    /// Column of the image.
    pub column: u32,
    /// Row coordinate of the line at the column's centre.
    pub row: f64,
    /// Radiance at the line centre towards the camera, mW/mm²/sr.
    pub radiance: f64,
}

/// Unit directions (laser frame) in which the laser plane is sampled. On a surface perpendicular to
/// the beam, neighbouring rays are at most one column apart in the image.
pub struct LaserPlaneSampler {
    directions: Vec<DVec3>,
}

/// Maximum number of rays per column. If the camera looks along the laser plane, the angle per
/// column has no lower bound.
const MOST_RAYS_PER_COLUMN: f64 = 8.0;

/// Mapping from pixels to angles in the fan.
pub(crate) struct FanAngleRange<'a> {
    camera: &'a Camera,
    laser_from_camera: Rigid,
    /// Half angle of the fan.
    half: f64,
}

impl<'a> FanAngleRange<'a> {
    pub fn new(fan: &Fan, camera: &'a Camera, camera_from_laser: &Rigid) -> FanAngleRange<'a> {
        FanAngleRange {
            camera,
            laser_from_camera: camera_from_laser.inverse(),
            half: match fan.is_bounded() {
                true => fan.angle / 2.0,
                false => (CUTOFF_RADII * fan.angle / 2.0).min(FRAC_PI_2 - 1e-6),
            },
        }
    }

    /// Returns the fan angle at which a pixel's ray intersects the laser plane; the end of the fan
    /// if there is no intersection.
    fn at(&self, pixel: DVec2) -> f64 {
        let eye = self.laser_from_camera.translation;
        let direction = self.laser_from_camera.vector(self.camera.direction(pixel));
        let t = -eye.y / direction.y;
        let p = eye + direction * t;
        match t > 0.0 && p.is_finite() && p.z > 0.0 {
            true => p.x.atan2(p.z).clamp(-self.half, self.half),
            false => self.half.copysign(direction.x),
        }
    }

    /// Returns the minimum and maximum angle over the sensor, which are reached on its border.
    pub fn visible_angles(&self) -> [f64; 2] {
        let size = self.camera.sensor.resolution.as_dvec2();
        let corners = [DVec2::ZERO, size.with_y(0.0), size, size.with_x(0.0)];
        let border = (0..4).flat_map(|side| {
            let (from, to) = (corners[side], corners[(side + 1) % 4]);
            (0..16).map(move |i| from.lerp(to, i as f64 / 16.0))
        });
        border.fold([self.half, -self.half], |[low, high], pixel| {
            let angle = self.at(pixel);
            [low.min(angle), high.max(angle)]
        })
    }
}

impl LaserPlaneSampler {
    /// Samples the part of the fan in the field of view.
    pub fn new(fan: &Fan, camera: &Camera, camera_from_laser: &Rigid) -> LaserPlaneSampler {
        let angles = FanAngleRange::new(fan, camera, camera_from_laser);
        let half = angles.half;
        let resolution = camera.sensor.resolution;
        let (columns, rows) = (resolution.x as f64, resolution.y as f64);
        let (mut low, mut high, mut narrowest) = (half, -half, 2.0 * half);
        for row in (0..=16).map(|i| rows * i as f64 / 16.0) {
            let ends = [0.0, columns].map(|column| angles.at(DVec2::new(column, row)));
            let (a, b) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
            (low, high) = (low.min(a), high.max(b));
            if b > a {
                narrowest = narrowest.min(b - a);
            }
        }
        let span = (high - low).max(0.0);
        let rays = (span / narrowest).min(MOST_RAYS_PER_COLUMN) * columns;
        let steps = rays.ceil().max(1.0);
        let directions = (0..=steps as usize).map(|i| {
            let (x, z) = (low + span * i as f64 / steps).sin_cos();
            DVec3::new(x, 0.0, z)
        });
        LaserPlaneSampler {
            directions: directions.collect(),
        }
    }

    /// Returns the number of laser rays per profile, without the additional rays towards column
    /// centres.
    pub fn rays(&self) -> usize {
        self.directions.len()
    }

    /// Returns the line in each column of a frame, in order of columns. If several points are
    /// visible in a column, the one with the highest radiance is returned.
    ///
    /// Valid if the surface is flat over the width of the line. The line has zero width here, so it
    /// does not bend around edges and is not truncated by them gradually. Columns may be missing
    /// near the ends of a line segment, within the distance of one ray.
    pub fn profile(&self, view: &PoseView) -> Vec<IdealProfilePoint> {
        let frame = ProfileFrame::new(view);
        let mut found = Vec::with_capacity(self.directions.len());
        for directions in self.directions.chunks(WIDTH) {
            let mut rays = [DVec3::Z; WIDTH];
            for (ray, &direction) in rays.iter_mut().zip(directions) {
                *ray = view.part_from_laser.vector(direction);
            }
            let hits = frame.trace(&rays[..directions.len()]);
            found.extend(
                hits[..directions.len()]
                    .iter()
                    .map(|hit| frame.visible_angles(*hit)),
            );
        }
        let mut columns = vec![None; view.camera.sensor.resolution.x as usize];
        let mut targets = Vec::with_capacity(WIDTH);
        for pair in found.windows(2) {
            let (Some(a), Some(b)) = (pair[0], pair[1]) else {
                continue;
            };
            // The range includes the lower end and excludes the higher one, so no centre is
            // processed twice.
            let (low, high) = (a.image.x.min(b.image.x), a.image.x.max(b.image.x));
            let end = (high - 0.5).ceil().min(columns.len() as f64);
            let mut column = (low - 0.5).ceil().max(0.0);
            while column < end {
                targets.push(ColumnRefinement {
                    column,
                    ends: [a, b],
                    rounds: 0,
                });
                // A single round may resolve no target.
                while targets.len() == WIDTH {
                    frame.refine_hits(&mut targets, &mut columns);
                }
                column += 1.0;
            }
        }
        while !targets.is_empty() {
            frame.refine_hits(&mut targets, &mut columns);
        }
        columns.into_iter().flatten().collect()
    }
}

/// Hit of a laser ray, and its image.
#[derive(Clone, Copy)]
struct LaserRayHit {
    hit: Hit,
    image: DVec2,
}

/// Centre of a column between the hits of two laser rays.
struct ColumnRefinement {
    /// Index of the column.
    column: f64,
    ends: [LaserRayHit; 2],
    /// Number of rays traced between them so far.
    rounds: u32,
}

/// Distance of a hit from a column's centre below which it represents the column, columns. The row
/// is computed along the hit triangle, which is exact unless an edge of the triangle is even
/// nearer.
const COLUMN_TOLERANCE_PX: f64 = 0.02;

/// Number of rays between two hits after which the surface counts as discontinuous at the column's
/// centre. The first rays follow the chord, the others bisect. Bisection from one column to
/// [`COLUMN_TOLERANCE_PX`] needs about half of this number.
const MAX_ITERATIONS: u32 = 16;
const SECANT_ITERATIONS: u32 = 3;

impl ColumnRefinement {
    fn center(&self) -> f64 {
        self.column + 0.5
    }

    /// Returns the relative position of the column's centre between the images of both ends.
    fn share(&self) -> f64 {
        let [a, b] = self.ends.map(|end| end.image.x);
        (self.center() - a) / (b - a)
    }

    /// Returns the point of the chord that is imaged at the column's centre, if both rays hit the
    /// same triangle.
    fn on_triangle(&self) -> Option<Hit> {
        let [a, b] = self.ends.map(|end| end.hit);
        (a.face == b.face).then(|| Hit {
            point: a.point.lerp(b.point, self.share()),
            ..a
        })
    }

    /// Returns the direction of the next ray.
    fn aim(&self, aperture: DVec3) -> DVec3 {
        let [a, b] = self.ends.map(|end| end.hit.point - aperture);
        let aim = match self.rounds < SECANT_ITERATIONS {
            true => a.lerp(b, self.share()),
            false => a.normalize_or_zero() + b.normalize_or_zero(),
        };
        aim.normalize_or(DVec3::Z)
    }

    /// Replaces the end on the side of `seen`. Returns false if the iteration limit is reached.
    fn bisect(&mut self, seen: LaserRayHit) -> bool {
        let low = (self.ends[0].image.x > self.ends[1].image.x) as usize;
        let side = match seen.image.x < self.center() {
            true => low,
            false => 1 - low,
        };
        self.ends[side] = seen;
        self.rounds += 1;
        self.rounds < MAX_ITERATIONS
    }
}

struct ProfileFrame<'a> {
    view: &'a PoseView<'a>,
    camera: Projector,
    camera_from_part: Rigid,
    laser_from_part: Rigid,
    rows: f64,
}

impl<'a> ProfileFrame<'a> {
    fn new(view: &'a PoseView<'a>) -> ProfileFrame<'a> {
        ProfileFrame {
            view,
            camera: view.camera.model().projector(),
            camera_from_part: view.part_from_camera.inverse(),
            laser_from_part: view.part_from_laser.inverse(),
            rows: view.camera.sensor.resolution.y as f64,
        }
    }

    /// Traces rays from the centre of the aperture.
    fn trace(&self, directions: &[DVec3]) -> [Option<Hit>; WIDTH] {
        let mut rays = [Ray {
            origin: self.view.part_from_laser.translation,
            direction: DVec3::Z,
            t_max: f64::INFINITY,
        }; WIDTH];
        for (ray, &direction) in rays.iter_mut().zip(directions) {
            ray.direction = direction;
        }
        let rays = &rays[..directions.len()];
        self.view.accel.closest(rays, |_, _| true)
    }

    fn visible_angles(&self, hit: Option<Hit>) -> Option<LaserRayHit> {
        let hit = hit?;
        let on_camera = self.camera_from_part.point(hit.point);
        let image = self.camera.project(on_camera)?;
        Some(LaserRayHit { hit, image })
    }

    /// Traces a ray for each target and enters the points of resolved targets. Unresolved targets
    /// remain in the list.
    fn refine_hits(
        &self,
        targets: &mut Vec<ColumnRefinement>,
        columns: &mut [Option<IdealProfilePoint>],
    ) {
        let aperture = self.view.part_from_laser.translation;
        let mut aims = [DVec3::Z; WIDTH];
        let mut traced = 0;
        for target in targets.iter().filter(|t| t.on_triangle().is_none()) {
            aims[traced] = target.aim(aperture);
            traced += 1;
        }
        let mut hits = self.trace(&aims[..traced]).into_iter();

        let eye = self.view.part_from_camera.translation;
        let mut points = [None; WIDTH];
        let mut sights = [Ray {
            origin: eye,
            direction: DVec3::Z,
            t_max: 0.0,
        }; WIDTH];
        let mut count = 0;
        targets.retain_mut(|target| {
            let hit = target.on_triangle().or_else(|| hits.next().flatten());
            let Some(seen) = self.visible_angles(hit) else {
                return false;
            };
            if (target.center() - seen.image.x).abs() > COLUMN_TOLERANCE_PX {
                return target.bisect(seen);
            }
            if let Some((point, sight)) = self.line_point(target, &seen, eye) {
                points[count] = Some(point);
                sights[count] = sight;
                count += 1;
            }
            false
        });
        let hidden = self.view.accel.occluded(&sights[..count]);
        for (i, point) in points.into_iter().flatten().enumerate() {
            let best: &mut Option<IdealProfilePoint> = &mut columns[point.column as usize];
            let brighter = best.is_none_or(|b| b.radiance < point.radiance);
            if hidden >> i & 1 == 0 && brighter {
                *best = Some(point);
            }
        }
    }

    /// Returns the line at a column's centre, from the hit `seen` next to it, and the ray from the
    /// hit to the camera. `None` outside the sensor and in the dark.
    fn line_point(
        &self,
        target: &ColumnRefinement,
        seen: &LaserRayHit,
        eye: DVec3,
    ) -> Option<(IdealProfilePoint, Ray)> {
        let LaserRayHit { hit, image } = seen;
        // Step along the line on the triangle, at most one pixel long.
        let sheet = self.view.part_from_laser.rotation.y_axis;
        let [a, b] = target.ends.map(|end| end.hit.point);
        let step = sheet.cross(hit.normal) * ((b - a).length() * COLUMN_TOLERANCE_PX).max(1e-6);
        let on_camera = self.camera_from_part.point(hit.point + step);
        let across = self.camera.project(on_camera)? - *image;
        let row = image.y + (target.center() - image.x) * across.y / across.x;
        let light = self.view.laser.at(self.laser_from_part.point(hit.point))?;
        let normal = self.laser_from_part.vector(hit.normal);
        let received = -light.flux.dot(normal);
        let start = hit.point + hit.normal * self.view.accel.resolution();
        let sight = Ray::between(start, eye)?;
        let faces = sight.direction.dot(hit.normal) > 0.0 && received > 0.0;
        let towards_light = -light.flux.normalize_or_zero();
        let towards_light = self.view.part_from_laser.vector(towards_light);
        let surface = self.view.surface.of(hit.face.triangle);
        let bsdf = surface.bsdf(hit.point, hit.normal, towards_light, sight.direction);
        let point = IdealProfilePoint {
            column: target.column as u32,
            row,
            radiance: bsdf * received,
        };
        (faces && (0.0..self.rows).contains(&row)).then_some((point, sight))
    }
}
