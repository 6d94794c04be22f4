//! Survey of the laser light along the path of a scan. Rays on the axis of the light are traced to
//! the part and from there to the camera.

use crate::accel::{Accel, Hit, Ray, WIDTH};
use crate::camera::Projector;
use crate::math::{Aabb, DVec2, DVec3, Rigid};
use crate::profile::{WEAK_SNR, detection_sigmas, least_height};
use crate::run::error_model::camera_from_laser;
use crate::scene::Scene;
use rayon::prelude::*;
use serde::Serialize;
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, TAU};
use std::ops::Range;

/// Range of distances at which the camera sees the laser light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeasuringRange {
    /// Smallest distance from the laser along the beam, mm.
    pub near_mm: f64,
    /// Largest distance from the laser along the beam, mm.
    pub far_mm: f64,
}

/// Number of rays of a line laser, uniformly distributed over its fan.
const RAYS: usize = 129;
/// Maximum number of traced frames, uniformly distributed over the frames that may light the part.
const MOST_FRAMES: usize = 512;
/// Maximum number of frames that are tested for light on the part, uniformly distributed over all.
const MOST_LOOKED_AT: usize = 100_000;

/// Result of a ray of laser light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum RayResult {
    /// The camera sees the hit.
    Seen(LineImage),
    /// The hit is nearer to the laser than the part of the ray within the sensor rows. The value is
    /// the distance to this part, mm along the beam.
    TooNear(f64),
    /// The hit is beyond the part of the ray within the sensor rows. The value is the distance to
    /// this part, mm along the beam.
    TooFar(f64),
    /// The camera sees no part of this ray.
    OutOfView,
    /// The surface at the hit faces away from the camera.
    FacesAway,
    /// The part occludes the hit from the camera.
    Hidden,
}

/// The line at one position of the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LineImage {
    /// Expected counts above black at the centre of the line, in focus and as if the sensor had no
    /// greatest count.
    pub counts: f64,
    /// Standard deviation of the line across its direction, over the standard deviation at the best
    /// focus.
    pub widening: f64,
}

/// Hit of a ray of laser light on the part, in the part's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LaserHit {
    pub frame: u32,
    pub point: DVec3,
    /// Normal on the side of the incident ray.
    pub normal: DVec3,
    /// Triangle index in the mesh.
    pub triangle: u32,
    pub fate: RayResult,
}

/// Results of the rays that hit the part.
#[derive(Debug, Default)]
pub(crate) struct LightSurvey {
    pub lit: Vec<LaserHit>,
    /// `None` if no ray hits the part.
    pub in_field: Option<InField>,
    /// `None` if the camera sees no laser light at any distance.
    pub range: Option<MeasuringRange>,
    /// Position of the light relative to the part if no ray hits the part.
    pub miss: Option<Miss>,
}

/// Fractions of the light on the part that are outside the measuring field, along the path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct InField {
    /// Fraction with hits nearer to the laser than the measuring range.
    pub nearer: f64,
    /// Fraction with hits beyond the measuring range.
    pub beyond: f64,
    /// Fraction with hits lateral to the field.
    pub beside: f64,
    /// Frame with the largest outside fraction, and this fraction; `None` if no light is outside.
    pub worst: Option<(u32, f64)>,
}

impl InField {
    fn of(by_frame: &[(u32, Vec<LaserHit>)]) -> Option<InField> {
        let all = by_frame.iter().map(|(_, lit)| lit.len()).sum::<usize>();
        let share = |of: fn(&RayResult) -> bool| {
            let lit = by_frame.iter().flat_map(|(_, lit)| lit);
            lit.filter(|lit| of(&lit.fate)).count() as f64 / all as f64
        };
        let nearer = |fate: &RayResult| matches!(fate, RayResult::TooNear(_));
        let beyond = |fate: &RayResult| matches!(fate, RayResult::TooFar(_));
        let beside = |fate: &RayResult| matches!(fate, RayResult::OutOfView);
        let outside = by_frame.iter().filter_map(|(frame, lit)| {
            let fates = lit.iter().map(|lit| lit.fate);
            let count = fates
                .filter(|f| nearer(f) || beyond(f) || beside(f))
                .count();
            (count > 0).then(|| (*frame, count as f64 / lit.len() as f64))
        });
        (all > 0).then(|| InField {
            nearer: share(nearer),
            beyond: share(beyond),
            beside: share(beside),
            // The first of several frames with the largest fraction.
            worst: outside.reduce(|a, b| if b.1 > a.1 { b } else { a }),
        })
    }
}

/// Reason that the light misses the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Miss {
    /// In every frame the part is behind the laser.
    Behind,
    /// The laser plane passes the part: the nearest frame, and the distance, mm.
    PlaneMissesPart { frame: u32, by_mm: f64 },
    /// The plane crosses the bounding box, but outside the fan.
    OutsideFan,
}

/// Direction of laser light, and the part of it that the camera sees.
pub(crate) struct Direction {
    /// Unit vector in the laser frame.
    pub along: DVec3,
    /// Distances along it, mm, that are imaged between the first and last sensor row.
    in_rows: Option<[f64; 2]>,
    /// Distances along it, mm, that are imaged on the sensor.
    pub seen: Option<[f64; 2]>,
}

/// Bounding box of the part in a frame, in the laser frame.
struct PartInFrame {
    frame: u32,
    part: Aabb,
}

impl LightSurvey {
    /// Surveys the frames of a scan.
    pub fn of(scene: &Scene, accel: &Accel, frames: Range<u32>) -> LightSurvey {
        let directions = directions(scene);
        let corners = accel.bounds().corners();
        let place = |frame: u32| {
            let laser_from_part = part_from_laser(scene, frame).inverse();
            let part = Aabb::of(corners.map(|corner| laser_from_part.point(corner)));
            PartInFrame { frame, part }
        };
        let looked_at = even_subset(frames.len(), MOST_LOOKED_AT);
        let mut placed: Vec<PartInFrame> =
            looked_at.map(|i| place(frames.start + i as u32)).collect();
        if !placed.iter().any(PartInFrame::may_be_lit) {
            placed = with_crossings(placed, &place);
        }
        let near: Vec<&PartInFrame> = placed.iter().filter(|p| p.may_be_lit()).collect();
        let chosen: Vec<u32> = even_subset(near.len(), MOST_FRAMES)
            .map(|i| near[i].frame)
            .collect();
        let by_frame: Vec<(u32, Vec<LaserHit>)> = chosen
            .par_iter()
            .map(|&frame| (frame, lit_points(scene, accel, frame, &directions)))
            .collect();
        let in_field = InField::of(&by_frame);
        let lit: Vec<LaserHit> = by_frame.into_iter().flat_map(|(_, lit)| lit).collect();
        let seen = directions.iter().filter_map(|d| Some((d.along, d.seen?)));
        let range = seen.fold(None, |range: Option<[f64; 2]>, (d, [a, b])| {
            let [low, high] = range.unwrap_or([f64::INFINITY, 0.0]);
            Some([low.min(a * d.z), high.max(b * d.z)])
        });
        LightSurvey {
            miss: match lit.is_empty() {
                true => miss(scene, &placed, !near.is_empty()),
                false => None,
            },
            lit,
            in_field,
            range: range.map(|[near_mm, far_mm]| MeasuringRange { near_mm, far_mm }),
        }
    }
}

pub(crate) fn part_from_laser(scene: &Scene, frame: u32) -> Rigid {
    scene.part_from_head(frame) * scene.head_from_laser
}

/// Returns at most `most` of `count` indices, uniformly distributed, including the first and the
/// last.
pub(crate) fn even_subset(count: usize, most: usize) -> impl Iterator<Item = usize> {
    let chosen = count.min(most);
    (0..chosen).map(move |i| i * (count - 1) / (chosen - 1).max(1))
}

/// Maximum number of crossings of the part that are searched on a path too long to test every
/// frame.
const MAX_CROSSINGS: usize = 64;

/// Adds frames of a long path in which the laser plane crosses the box, if none of `placed` has
/// such a crossing. They lie between two frames with the box on opposite sides of the plane.
fn with_crossings(
    placed: Vec<PartInFrame>,
    place: &impl Fn(u32) -> PartInFrame,
) -> Vec<PartInFrame> {
    let side = |p: &PartInFrame| p.part.center().y > 0.0;
    let mut more = Vec::new();
    let changes = placed.windows(2);
    let changes = changes.filter(|pair| side(&pair[0]) != side(&pair[1]));
    for pair in changes.take(MAX_CROSSINGS) {
        let ends = [pair[0].frame, pair[1].frame];
        // The last frame for which `holds` has its value at `from`.
        let last = |from: u32, to: u32, holds: &dyn Fn(&PartInFrame) -> bool| {
            let (mut low, mut high) = (i64::from(from), i64::from(to));
            let at_start = holds(&place(from));
            while (high - low).abs() > 1 {
                let middle = (low + high) / 2;
                match holds(&place(middle as u32)) == at_start {
                    true => low = middle,
                    false => high = middle,
                }
            }
            low as u32
        };
        let crossed = last(ends[0], ends[1], &side);
        let lit = [crossed, crossed + 1]
            .into_iter()
            .find(|&f| place(f).may_be_lit());
        if let Some(lit) = lit {
            let [first, end] = ends.map(|end| last(lit, end, &PartInFrame::may_be_lit));
            let count = (end - first + 1) as usize;
            more.extend(even_subset(count, MOST_FRAMES).map(|i| place(first + i as u32)));
        }
    }
    more.extend(placed);
    more.sort_by_key(|placed| placed.frame);
    more
}

impl PartInFrame {
    /// Returns whether the laser plane crosses the box in front of the laser.
    fn may_be_lit(&self) -> bool {
        let Aabb { min, max } = self.part;
        max.z > 0.0 && min.y <= 0.0 && max.y >= 0.0
    }
}

/// Distance from the light's centre at which the light is negligible, in beam radii. The irradiance
/// there is 1/3000 of that at the centre.
const LIGHT_ENDS: f64 = 2.0;

/// Returns the reason that light misses the part if its central rays never hit the part; `None` if
/// the outer light hits it.
fn miss(scene: &Scene, placed: &[PartInFrame], crossed: bool) -> Option<Miss> {
    if crossed {
        return Some(Miss::OutsideFan);
    }
    let off = |p: &PartInFrame| p.part.min.y.max(-p.part.max.y);
    let before = placed.iter().filter(|p| p.part.max.z > 0.0);
    let nearest = before.min_by(|a, b| off(a).total_cmp(&off(b)));
    let Some(nearest) = nearest else {
        return Some(Miss::Behind);
    };
    let by_mm = off(nearest);
    let radius = scene.laser.beam.radius(nearest.part.center().z);
    (by_mm > LIGHT_ENDS * radius).then_some(Miss::PlaneMissesPart {
        frame: nearest.frame,
        by_mm,
    })
}

/// Returns the directions of the laser light, with the part of each that the camera sees.
pub(crate) fn directions(scene: &Scene) -> Vec<Direction> {
    let camera_from_laser = camera_from_laser(scene);
    let projector = scene.camera.model().projector();
    let resolution = scene.camera.sensor.resolution.as_dvec2();
    let distances = distances(scene, &camera_from_laser.inverse());
    let angles: Vec<f64> = match &scene.laser.fan {
        None => vec![0.0],
        Some(fan) => {
            // A Gaussian fan ends at the 1/e² points, and never points backwards.
            let half = (fan.angle / 2.0).min(FRAC_PI_2 - 1e-6);
            let share = |i: usize| (i as f64 + 0.5) / RAYS as f64 * 2.0 - 1.0;
            (0..RAYS).map(|i| half * share(i)).collect()
        }
    };
    let direction = |angle: &f64| {
        let along = DVec3::new(angle.sin(), 0.0, angle.cos());
        let pixel = |t: f64| projector.project(camera_from_laser.point(along * t));
        let between = |x: f64, most: f64| (0.0..=most).contains(&x);
        let field = scene.field_of_view.as_ref();
        let in_range = |t: f64| field.is_none_or(|f| f.half_width(t * along.z).is_some());
        let in_field = |t: f64| field.is_none_or(|f| f.contains(along * t));
        let in_rows = |t: f64| in_range(t) && pixel(t).is_some_and(|p| between(p.y, resolution.y));
        let in_columns =
            |t: f64| in_field(t) && pixel(t).is_some_and(|p| between(p.x, resolution.x));
        Direction {
            along,
            in_rows: interval(&distances, &in_rows),
            seen: interval(&distances, &|t| in_rows(t) && in_columns(t)),
        }
    };
    angles.iter().map(direction).collect()
}

/// Returns the smallest and largest distance at which `sees` is true, to within rounding. The
/// search starts from `distances`. Returns `None` if `sees` is false at all of them.
fn interval(distances: &[f64], sees: &impl Fn(f64) -> bool) -> Option<[f64; 2]> {
    let first = distances.iter().position(|&t| sees(t))?;
    let last = distances.iter().rposition(|&t| sees(t))?;
    let before = first.checked_sub(1).map(|i| distances[i]);
    let after = distances.get(last + 1).copied();
    Some([
        edge(distances[first], before, sees),
        edge(distances[last], after, sees),
    ])
}

/// Returns the end of visibility between `inside` and `outside`; `inside` if `outside` is `None`.
fn edge(mut inside: f64, outside: Option<f64>, sees: &impl Fn(f64) -> bool) -> f64 {
    let mut outside = outside.unwrap_or(inside);
    for _ in 0..40 {
        let middle = (inside + outside) / 2.0;
        match sees(middle) {
            true => inside = middle,
            false => outside = middle,
        }
    }
    inside
}

/// Returns increasing distances from the laser. They are dense enough that no visible interval of
/// the light is missed. They include the laser plane points of 33 × 33 sensor points, and a wide
/// range of other distances.
fn distances(scene: &Scene, laser_from_camera: &Rigid) -> Vec<f64> {
    const NODES: usize = 33;
    let eye = laser_from_camera.translation;
    let resolution = scene.camera.sensor.resolution.as_dvec2();
    let nodes = (0..NODES * NODES).filter_map(|i| {
        let share = DVec2::new((i % NODES) as f64, (i / NODES) as f64) / (NODES - 1) as f64;
        let direction = laser_from_camera.vector(scene.camera.direction(resolution * share));
        let t = -eye.y / direction.y;
        let place = eye + direction * t;
        (t > 0.0 && place.is_finite()).then(|| place.x.hypot(place.z))
    });
    let others = (-150..=150).map(|i| eye.length() * 10f64.powf(i as f64 / 50.0));
    let field = scene.field_of_view.iter().flat_map(|f| f.distances());
    let mut all: Vec<f64> = nodes.chain(others).chain(field).collect();
    all.sort_by(f64::total_cmp);
    all
}

/// Returns the hits of the rays of a frame on the part.
fn lit_points(scene: &Scene, accel: &Accel, frame: u32, directions: &[Direction]) -> Vec<LaserHit> {
    let part_from_laser = part_from_laser(scene, frame);
    let follow = CameraVisibility::new(scene, accel, part_from_laser);
    let mut lit = Vec::new();
    for directions in directions.chunks(WIDTH) {
        let ray = |direction: &Direction| Ray {
            origin: part_from_laser.translation,
            direction: part_from_laser.vector(direction.along),
            t_max: f64::INFINITY,
        };
        let rays: Vec<Ray> = directions.iter().map(ray).collect();
        let hits = accel.closest(&rays, |_, _| true);
        let met = directions.iter().zip(hits);
        lit.extend(met.filter_map(|(direction, hit)| {
            let hit = hit?;
            Some(LaserHit {
                frame,
                point: hit.point,
                normal: hit.normal,
                triangle: hit.face.triangle,
                fate: follow.fate(direction, hit),
            })
        }));
    }
    lit
}

/// Result of a position on the surface when the laser plane passes through it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Sighting {
    /// Lit and visible, at angles of incidence up to 75°.
    Measurable,
    /// Lit and visible, but with laser, camera or housing inside the part or too close to it.
    HeadInPart,
    /// Lit and visible, but at a larger angle of incidence.
    Oblique,
    /// Lit, but occluded from the camera or facing away from it.
    HiddenFromCamera,
    /// Occluded from the laser or facing away from it.
    HiddenFromLaser,
    /// Outside the fan or the sensor.
    OutsideField,
}

/// Cosine of the largest angle of incidence, 75°.
const MIN_COSINE: f64 = 0.258_819;

impl Sighting {
    /// All results of a position that is not measurable.
    pub const HIDDEN: [Sighting; 5] = [
        Sighting::HeadInPart,
        Sighting::Oblique,
        Sighting::HiddenFromCamera,
        Sighting::HiddenFromLaser,
        Sighting::OutsideField,
    ];

    /// Returns the reason why a position is not measurable, for a sensor in any pose.
    pub fn reason(self) -> &'static str {
        match self {
            Sighting::Measurable => "measurable",
            Sighting::HeadInPart => "the sensor would touch the part or be inside it",
            Sighting::Oblique => "laser or camera at more than 75° from the normal",
            Sighting::HiddenFromCamera => "hidden from the camera wherever the laser reaches it",
            Sighting::HiddenFromLaser => "hidden from the laser within the limits of the head",
            Sighting::OutsideField => "outside the field of the sensor",
        }
    }
}

/// Tracer of light from the part to the camera, for one pose of the laser.
pub(crate) struct CameraVisibility<'a> {
    scene: &'a Scene,
    accel: &'a Accel,
    part_from_laser: Rigid,
    laser_from_part: Rigid,
    camera_from_laser: Rigid,
    projector: Projector,
    /// Position of the camera's pupil in the part's frame.
    camera_center: DVec3,
}

impl CameraVisibility<'_> {
    pub fn new<'a>(
        scene: &'a Scene,
        accel: &'a Accel,
        part_from_laser: Rigid,
    ) -> CameraVisibility<'a> {
        let laser_from_camera = scene.head_from_laser.inverse() * scene.head_from_camera;
        CameraVisibility {
            scene,
            accel,
            part_from_laser,
            laser_from_part: part_from_laser.inverse(),
            camera_from_laser: laser_from_camera.inverse(),
            projector: scene.camera.model().projector(),
            camera_center: part_from_laser.point(laser_from_camera.translation),
        }
    }

    fn fate(&self, direction: &Direction, hit: Hit) -> RayResult {
        let Some([near, far]) = direction.in_rows else {
            return RayResult::OutOfView;
        };
        if hit.t < near {
            return RayResult::TooNear((near - hit.t) * direction.along.z);
        }
        if hit.t > far {
            return RayResult::TooFar((hit.t - far) * direction.along.z);
        }
        if direction
            .seen
            .is_none_or(|[near, far]| hit.t < near || hit.t > far)
        {
            return RayResult::OutOfView;
        }
        self.towards_camera(hit.point, hit.normal, hit.face.triangle)
    }

    /// Returns the result of light at a point of the laser plane that the sensor images.
    fn towards_camera(&self, point: DVec3, normal: DVec3, triangle: u32) -> RayResult {
        if normal.dot(self.camera_center - point) <= 0.0 {
            return RayResult::FacesAway;
        }
        if self.blocked(point, normal, self.camera_center) {
            return RayResult::Hidden;
        }
        let seen = self.seen(point, normal, triangle);
        seen.map_or(RayResult::OutOfView, RayResult::Seen)
    }

    fn blocked(&self, point: DVec3, normal: DVec3, to: DVec3) -> bool {
        let start = point + normal * self.accel.resolution();
        Ray::between(start, to).is_some_and(|ray| self.accel.occluded(&[ray]) != 0)
    }

    /// Returns the result of light at a surface point when the laser plane passes through it at
    /// this pose. Returns `None` if the point is not lit or is not imaged on the sensor.
    pub fn fate_of(&self, point: DVec3, normal: DVec3, triangle: u32) -> Option<RayResult> {
        let in_laser = self.laser_from_part.point(point).with_y(0.0);
        self.scene.laser.section(in_laser)?;
        if !self.is_imaged(in_laser) || !self.is_lit(point, normal) {
            return None;
        }
        Some(self.towards_camera(point, normal, triangle))
    }

    /// Returns the result of a surface point when the laser plane passes through it at this pose. The
    /// normal may have either sign.
    pub fn sighting(&self, point: DVec3, normal: DVec3, triangle: u32) -> Sighting {
        let laser = self.part_from_laser.translation;
        let normal = normal * normal.dot(laser - point).signum();
        let in_laser = self.laser_from_part.point(point).with_y(0.0);
        if self.scene.laser.section(in_laser).is_none() || !self.is_imaged(in_laser) {
            return Sighting::OutsideField;
        }
        if !self.is_lit(point, normal) {
            return Sighting::HiddenFromLaser;
        }
        match self.towards_camera(point, normal, triangle) {
            RayResult::Seen(_) => {}
            RayResult::FacesAway | RayResult::Hidden => return Sighting::HiddenFromCamera,
            _ => return Sighting::OutsideField,
        }
        let cosine = |to: DVec3| normal.dot((to - point).normalize_or_zero());
        match cosine(laser).min(cosine(self.camera_center)) >= MIN_COSINE {
            true => Sighting::Measurable,
            false => Sighting::Oblique,
        }
    }

    fn is_lit(&self, point: DVec3, normal: DVec3) -> bool {
        let laser = self.part_from_laser.translation;
        normal.dot(laser - point) > 0.0 && !self.blocked(point, normal, laser)
    }

    fn is_imaged(&self, in_laser: DVec3) -> bool {
        let resolution = self.scene.camera.sensor.resolution.as_dvec2();
        let pixel = self
            .projector
            .project(self.camera_from_laser.point(in_laser));
        self.is_in_polygon(in_laser)
            && pixel.is_some_and(|p| p.cmpge(DVec2::ZERO).all() && p.cmple(resolution).all())
    }

    /// Returns whether a point of the laser plane is in the scene's field of view, if it has one.
    fn is_in_polygon(&self, in_laser: DVec3) -> bool {
        let field = self.scene.field_of_view.as_ref();
        field.is_none_or(|field| field.contains(in_laser))
    }

    /// Returns whether a point is within the fan, within the width of the field of view, and within
    /// the sensor columns.
    pub fn is_in_field(&self, point: DVec3) -> bool {
        let in_laser = self.laser_from_part.point(point).with_y(0.0);
        let columns = f64::from(self.scene.camera.sensor.resolution.x);
        let pixel = self
            .projector
            .project(self.camera_from_laser.point(in_laser));
        let field = self.scene.field_of_view.as_ref();
        let beside = field
            .and_then(|field| field.half_width(in_laser.z))
            .is_some_and(|half| in_laser.x.abs() > half);
        !beside
            && self.scene.laser.section(in_laser).is_some()
            && pixel.is_some_and(|p| (0.0..=columns).contains(&p.x))
    }

    /// Returns the cosine of the angle of incidence at a point that a sensor in this orientation
    /// could measure from some position. Such a point faces the beam and the camera, and neither is
    /// occluded. Returns `None` for other points.
    pub fn measurable(&self, point: DVec3, normal: DVec3, distance: f64) -> Option<f64> {
        let of_beam = self.part_from_laser.point(DVec3::Z * distance);
        let to_laser = self.part_from_laser.translation - of_beam;
        let to_camera = self.camera_center - of_beam;
        let cosine = normal.dot(to_laser.try_normalize()?);
        let free = |to: DVec3| !self.blocked(point, normal, point + to);
        let faces = cosine > 0.0 && normal.dot(to_camera) > 0.0;
        (faces && free(to_laser) && free(to_camera)).then_some(cosine)
    }

    /// Returns the line at a lit point. The counts are expected in the pixel at the centre of the
    /// line, which is a Gaussian of standard deviation σ px: ∫exp(−x²/2σ²) over one pixel is
    /// σ√(2π)·erf(1/(2√2·σ)).
    fn seen(&self, point: DVec3, normal: DVec3, triangle: u32) -> Option<LineImage> {
        let Scene {
            laser,
            camera,
            surface,
            ..
        } = self.scene;
        let place = self.laser_from_part.point(point).with_y(0.0);
        let light = laser.at(place)?;
        let received = -light.flux.dot(self.laser_from_part.vector(normal));
        let in_camera = self.camera_from_laser.point(place);
        let pixel = self.projector.project(in_camera)?;
        let beside = place + DVec3::Y * laser.section(place)?.radius;
        let beside = self
            .projector
            .project(self.camera_from_laser.point(beside))?;
        let sigma = (beside - pixel).length() / 2.0;
        let share = sigma * TAU.sqrt() * libm::erf(0.5 * FRAC_1_SQRT_2 / sigma);
        let towards_light = -light.flux.normalize_or_zero();
        let towards_light = self.laser_from_part.inverse().vector(towards_light);
        let towards_eye = (self.camera_center - point).normalize_or_zero();
        let surface = surface.of(triangle);
        let bsdf = surface.bsdf(point, normal, towards_light, towards_eye);
        let irradiance = bsdf * received * camera.pupil_solid_angle(pixel);
        let electrons = irradiance
            * camera
                .sensor
                .electrons_per_irradiance(laser.beam.wavelength);
        let counts = electrons * camera.sensor.gain_dn_per_e * share.min(1.0);
        Some(LineImage {
            counts: counts.max(0.0),
            widening: self.widening(sigma, in_camera)?,
        })
        .filter(|line| line.counts.is_finite() && line.widening.is_finite())
    }

    /// Returns the standard deviation of the image of a line of standard deviation `sigma` (px),
    /// relative to its value at the best focus.
    ///
    /// Four variances add: the line, a pixel (1/12), diffraction, and the defocused pupil, a disc
    /// of diameter b with variance b²/16. Diffraction at the image-side f-number N counts as a
    /// Gaussian of 0.45·λ·N (Zhang, Zerubia & Olivo-Marin 2007: 0.225·λ/NA).
    fn widening(&self, sigma: f64, in_camera: DVec3) -> Option<f64> {
        let Scene { laser, camera, .. } = self.scene;
        let pitch = camera.sensor.pixel_pitch;
        let blur = camera.defocus_blur(in_camera)? / pitch;
        let image_over_pupil = camera.lens.image_distance() / camera.lens.pupil_diameter();
        let diffraction = 0.45 * laser.beam.wavelength * image_over_pupil / pitch;
        let in_focus = sigma * sigma + 1.0 / 12.0 + diffraction * diffraction;
        Some(((in_focus + blur * blur / 16.0) / in_focus).sqrt())
    }
}

/// Returns the counts above black that a line needs for valid points. This is
/// `measure.threshold_dn` if the scene sets it. Otherwise the line must exceed the noise and be
/// free of the flag LOW_SIGNAL.
pub(crate) fn least_counts(scene: &Scene) -> f64 {
    if let Some(threshold) = scene.measure.threshold_dn {
        return threshold;
    }
    let sensor = &scene.camera.sensor;
    let noise = (sensor.dark_noise_e() * sensor.gain_dn_per_e).hypot(1.0 / 12f64.sqrt());
    let pixels = sensor.resolution.as_u64vec2().element_product();
    least_height(detection_sigmas(pixels as usize), noise).max(WEAK_SNR * noise)
}
