//! The profile without an image: laser rays of no width meet the part, and the
//! camera sees those points or does not.

use super::View;
use crate::accel::{Hit, Ray, WIDTH};
use crate::camera::{Camera, Projector};
use crate::laser::{CUTOFF_RADII, Fan, FanProfile};
use crate::math::{DVec2, DVec3, Rigid};
use std::f64::consts::FRAC_PI_2;

/// The line as an ideal camera would find it in one column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePoint {
    /// Column of the image.
    pub column: u32,
    /// Row coordinate of the line at the column's centre.
    pub row: f64,
    /// Of the surface in the middle of the line, towards the camera, mW/mm²/sr.
    pub radiance: f64,
}

/// Directions (laser frame, unit) in which the sheet is sampled: no two
/// neighbours are more than a column apart on a surface across the beam.
pub struct Sheet {
    directions: Vec<DVec3>,
}

/// A sheet is never cut into more rays than this many times the columns: where
/// the camera looks along it, the angles of a column have no lower bound.
const MOST_RAYS_PER_COLUMN: f64 = 8.0;

/// Where in a fan the pixels of a camera look.
pub(crate) struct SheetAngles<'a> {
    camera: &'a Camera,
    laser_from_camera: Rigid,
    /// At which the fan ends, to either side.
    half: f64,
}

impl<'a> SheetAngles<'a> {
    pub fn new(fan: &Fan, camera: &'a Camera, camera_from_laser: &Rigid) -> SheetAngles<'a> {
        SheetAngles {
            camera,
            laser_from_camera: camera_from_laser.inverse(),
            half: match fan.profile {
                FanProfile::Uniform => fan.angle / 2.0,
                FanProfile::Gaussian => (CUTOFF_RADII * fan.angle / 2.0).min(FRAC_PI_2 - 1e-6),
            },
        }
    }

    /// Angle at which a pixel's ray meets the sheet; its end if nowhere.
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

    /// The least and the greatest over the sensor, which are on its border.
    pub fn seen(&self) -> [f64; 2] {
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

impl Sheet {
    /// The part of the fan that the sensor can see.
    pub fn new(fan: &Fan, camera: &Camera, camera_from_laser: &Rigid) -> Sheet {
        let angles = SheetAngles::new(fan, camera, camera_from_laser);
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
        Sheet {
            directions: directions.collect(),
        }
    }

    /// Laser rays traced for a profile before those that aim at column centres.
    pub fn rays(&self) -> usize {
        self.directions.len()
    }

    /// The line in each column of a frame, in order of columns; where several
    /// points of the sheet are seen in one, the most brightly lit.
    ///
    /// Valid where the surface is flat over the line's width: the line has none
    /// here, so it neither bends round edges nor is cut off by them bit by bit. A
    /// column whose centre lies within a ray's distance of the end of a piece of
    /// line may be left out.
    pub fn profile(&self, view: &View) -> Vec<LinePoint> {
        let frame = Frame::new(view);
        let mut found = Vec::with_capacity(self.directions.len());
        for directions in self.directions.chunks(WIDTH) {
            let mut rays = [DVec3::Z; WIDTH];
            for (ray, &direction) in rays.iter_mut().zip(directions) {
                *ray = view.part_from_laser.vector(direction);
            }
            let hits = frame.trace(&rays[..directions.len()]);
            found.extend(hits[..directions.len()].iter().map(|hit| frame.seen(*hit)));
        }
        let mut columns = vec![None; view.camera.sensor.resolution.x as usize];
        let mut targets = Vec::with_capacity(WIDTH);
        for pair in found.windows(2) {
            let (Some(a), Some(b)) = (pair[0], pair[1]) else {
                continue;
            };
            // Centres from the lower column on and before the higher, so that none
            // is met twice.
            let (low, high) = (a.image.x.min(b.image.x), a.image.x.max(b.image.x));
            let end = (high - 0.5).ceil().min(columns.len() as f64);
            let mut column = (low - 0.5).ceil().max(0.0);
            while column < end {
                targets.push(Target {
                    column,
                    ends: [a, b],
                    rounds: 0,
                });
                // One round may settle none.
                while targets.len() == WIDTH {
                    frame.settle(&mut targets, &mut columns);
                }
                column += 1.0;
            }
        }
        while !targets.is_empty() {
            frame.settle(&mut targets, &mut columns);
        }
        columns.into_iter().flatten().collect()
    }
}

/// What a laser ray met, and where the camera images it.
#[derive(Clone, Copy)]
struct Seen {
    hit: Hit,
    image: DVec2,
}

/// The centre of a column, between what two laser rays met.
struct Target {
    /// Its number.
    column: f64,
    ends: [Seen; 2],
    /// Rays sent between them so far.
    rounds: u32,
}

/// A hit this near to a column's centre stands for it, columns. The row is taken
/// along the triangle that was hit: exact unless its edge is nearer still.
const NEAR_CENTER: f64 = 0.02;

/// Rays between two hits that do not close in on the column's centre, after which
/// the surface is taken to jump there. The first few follow the chord, the others
/// halve: from one column to [`NEAR_CENTER`], and twice as often for good measure.
const MOST_ROUNDS: u32 = 16;
const CHORD_ROUNDS: u32 = 3;

impl Target {
    fn center(&self) -> f64 {
        self.column + 0.5
    }

    /// Share of the way from one end's image to the other's.
    fn share(&self) -> f64 {
        let [a, b] = self.ends.map(|end| end.image.x);
        (self.center() - a) / (b - a)
    }

    /// Where the chord images at the centre, if it lies on a triangle that both
    /// rays met.
    fn on_triangle(&self) -> Option<Hit> {
        let [a, b] = self.ends.map(|end| end.hit);
        (a.face == b.face).then(|| Hit {
            point: a.point.lerp(b.point, self.share()),
            ..a
        })
    }

    /// Where the next ray goes.
    fn aim(&self, aperture: DVec3) -> DVec3 {
        let [a, b] = self.ends.map(|end| end.hit.point - aperture);
        let aim = match self.rounds < CHORD_ROUNDS {
            true => a.lerp(b, self.share()),
            false => a.normalize_or_zero() + b.normalize_or_zero(),
        };
        aim.normalize_or(DVec3::Z)
    }

    /// Closes in on the centre from the side of `seen`. False if it is no use.
    fn narrow(&mut self, seen: Seen) -> bool {
        let low = (self.ends[0].image.x > self.ends[1].image.x) as usize;
        let side = match seen.image.x < self.center() {
            true => low,
            false => 1 - low,
        };
        self.ends[side] = seen;
        self.rounds += 1;
        self.rounds < MOST_ROUNDS
    }
}

struct Frame<'a> {
    view: &'a View<'a>,
    camera: Projector,
    camera_from_part: Rigid,
    laser_from_part: Rigid,
    rows: f64,
}

impl<'a> Frame<'a> {
    fn new(view: &'a View<'a>) -> Frame<'a> {
        Frame {
            view,
            camera: view.camera.model().projector(),
            camera_from_part: view.part_from_camera.inverse(),
            laser_from_part: view.part_from_laser.inverse(),
            rows: view.camera.sensor.resolution.y as f64,
        }
    }

    /// What rays from the middle of the aperture meet.
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

    fn seen(&self, hit: Option<Hit>) -> Option<Seen> {
        let hit = hit?;
        let on_camera = self.camera_from_part.point(hit.point);
        let image = self.camera.project(on_camera)?;
        Some(Seen { hit, image })
    }

    /// Sends a ray to each target and enters those it settles; the others stay.
    fn settle(&self, targets: &mut Vec<Target>, columns: &mut [Option<LinePoint>]) {
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
            let Some(seen) = self.seen(hit) else {
                return false;
            };
            if (target.center() - seen.image.x).abs() > NEAR_CENTER {
                return target.narrow(seen);
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
            let best: &mut Option<LinePoint> = &mut columns[point.column as usize];
            let brighter = best.is_none_or(|b| b.radiance < point.radiance);
            if hidden >> i & 1 == 0 && brighter {
                *best = Some(point);
            }
        }
    }

    /// The line at a column's centre, from what is `seen` next to it, and the ray
    /// from there to the camera. `None` off the sensor and in the dark.
    fn line_point(&self, target: &Target, seen: &Seen, eye: DVec3) -> Option<(LinePoint, Ray)> {
        let Seen { hit, image } = seen;
        // A step along the line on the triangle, no longer than a pixel.
        let sheet = self.view.part_from_laser.rotation.y_axis;
        let [a, b] = target.ends.map(|end| end.hit.point);
        let step = sheet.cross(hit.normal) * ((b - a).length() * NEAR_CENTER).max(1e-6);
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
        let point = LinePoint {
            column: target.column as u32,
            row,
            radiance: bsdf * received,
        };
        (faces && (0.0..self.rows).contains(&row)).then_some((point, sight))
    }
}
