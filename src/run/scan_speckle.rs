//! Speckle of a scan: the patterns, how they lie over the sensor, and how they
//! follow the part.

use super::lit_normal::lit_normal;
use super::surface_view::{in_camera, surface_view};
use crate::accel::Accel;
use crate::error::Result;
use crate::frame::{Patterns, Reference, Speckle, Strips};
use crate::math::Aperture;
use crate::math::{DVec2, DVec3, Rigid};
use crate::plan::rules::{CORRELATED, SpeckleStep};
use crate::profile::FrameStep;
use crate::scene::{Motion, Moves, Scene, SpeckleModel};
use crate::speckle::anchor::{PoseAnchor, Reference as PathReference, ScanCoordinate};
use crate::speckle::coordinate::GrainMap;
use crate::speckle::frame_field::{FrameFields, PupilPlace, field_spec, wide_field_spec};
use crate::speckle::lookup::{Coherence, Lookup, Method};
use crate::speckle::motion::overlap_correlation_defocused;
use crate::speckle::path::PathAnchor;
use crate::speckle::pattern::PatternSpec;
use crate::speckle::strips::Strip;

pub struct ScanSpeckle {
    source: PatternSource,
    /// `Some`: fields on the surface, of a pupil so many times as wide as the lens's.
    wider: Option<f64>,
    map: GrainMap,
    anchor: Anchor,
}

enum PatternSource {
    Frame {
        fields: FrameFields,
        /// Whether in strips that refer to other poses.
        strips: bool,
    },
    Ring(Lookup),
}

enum Anchor {
    /// Nothing turns: exact over any length.
    Pose(Box<PoseAnchor>),
    Path(PathAnchor),
}

impl Anchor {
    /// `place` is that of the pose on the path.
    fn coordinate(&self, place: f64, part_from_head: &Rigid) -> ScanCoordinate {
        match self {
            Anchor::Pose(anchor) => anchor.coordinate(part_from_head),
            Anchor::Path(anchor) => anchor.coordinate(place),
        }
    }

    /// The poses to which a pose's strips refer; `None` where they would not be limited.
    fn references(
        &self,
        scene: &Scene,
        place: f64,
        part_from_head: &Rigid,
        width: f64,
    ) -> Option<[PathReference; 2]> {
        match self {
            Anchor::Pose(anchor) => anchor.references(part_from_head, width),
            Anchor::Path(anchor) => {
                let pose = |place| scene.part_from_head_at(place);
                Some(anchor.references(place, width, pose))
            }
        }
    }

    fn along(&self) -> DVec2 {
        match self {
            Anchor::Pose(anchor) => anchor.along(),
            Anchor::Path(anchor) => anchor.along(),
        }
    }
}

/// The patterns of a scan as a ring, ten slices a pupil diameter.
fn ring_spec(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        slices: 32,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

impl ScanSpeckle {
    /// `strips`: whether the surface of `accel` moves otherwise from place to place. `wider`: for
    /// fields on the surface, to go through the lens, of a pupil so many times as wide as the lens's.
    pub fn new(
        scene: &Scene,
        accel: &Accel,
        model: &SpeckleModel,
        strips: bool,
        wider: Option<f64>,
    ) -> Result<ScanSpeckle> {
        let wavelength = scene.laser.beam.wavelength;
        let grain = scene.camera.speckle_angle(wavelength);
        let distance = scene.camera.lens.image_distance();
        let in_focus = wider.is_some();
        let mut strips = strips;
        let mut anchor_of = anchor(scene, Follows::of(strips, in_focus), || {
            lit_normal(scene, accel)
        });
        let limited = || anchor_of.references(scene, 0.0, &scene.part_from_head(0), 1.0);
        if in_focus && strips && limited().is_none() {
            strips = false;
            anchor_of = anchor(scene, Follows::Surface, || lit_normal(scene, accel));
        }
        // Where surfaces differ in polarisation, samples weigh the patterns of both.
        let coherence = match scene.surface.polarisation_differs() {
            true => Coherence {
                polarisation_degree: 0.0,
                ..model.coherence
            },
            false => model.coherence,
        };
        let (source, map) = match model.method {
            Method::Field => {
                let spec = match wider {
                    None => field_spec(scene.seed, model.aperture),
                    Some(wider) => wide_field_spec(scene.seed, model.aperture, wider),
                };
                let fields = FrameFields::new(&spec, coherence)?;
                let map = fields.map(grain / wider.unwrap_or(1.0), distance);
                (PatternSource::Frame { fields, strips }, map)
            }
            Method::Trilinear => {
                let spec = ring_spec(scene.seed, model.aperture);
                let lookup = Lookup::new(&spec, model.method, coherence)?;
                let source = PatternSource::Ring(lookup);
                let map = GrainMap::new(spec.texels_per_speckle, grain, distance);
                (source, map)
            }
        };
        Ok(ScanSpeckle {
            source,
            wider,
            map,
            anchor: anchor_of,
        })
    }

    /// Bytes of the patterns that reading takes.
    pub fn memory(&self) -> usize {
        match &self.source {
            PatternSource::Ring(lookup) => lookup.memory(),
            PatternSource::Frame { fields, strips } => {
                let count = if *strips { 2 } else { 1 };
                count * fields.field_memory()
            }
        }
    }

    pub fn at(&self, scene: &Scene, place: f64, part_from_head: &Rigid) -> Speckle<'_> {
        let at = self.anchor.coordinate(place, part_from_head);
        let patterns = match &self.source {
            PatternSource::Frame { fields, strips } => {
                let wider = self.wider.unwrap_or(1.0);
                let width = fields.strip_width() * wider;
                let references = || (self.anchor).references(scene, place, part_from_head, width);
                match strips.then(references).flatten() {
                    Some(references) => Patterns::Strips {
                        fields,
                        strips: Box::new(self.strips(scene, &at, part_from_head, references)),
                    },
                    None => Patterns::Frame {
                        fields,
                        place: match self.wider {
                            None => at.pupil,
                            // The lens defocuses it.
                            Some(wider) => PupilPlace {
                                shift: on_sensor(at.pupil.shift) / wider,
                                defocus: 0.0,
                            },
                        },
                    },
                }
            }
            PatternSource::Ring(lookup) => Patterns::Ring {
                lookup,
                slice: at.u * lookup.slices_per_diameter(),
            },
        };
        Speckle {
            patterns,
            map: self.map,
            displacement: on_sensor(at.sensor),
            wider: self.wider,
        }
    }

    /// The strips of a pose, in the camera's frame.
    fn strips(
        &self,
        scene: &Scene,
        at: &ScanCoordinate,
        part_from_head: &Rigid,
        references: [PathReference; 2],
    ) -> Strips {
        let head_from_camera = scene.head_from_camera;
        let along = on_sensor(self.anchor.along());
        // In diameters of the fields' own pupil.
        let places = |shift: DVec2| on_sensor(shift) / self.wider.unwrap_or(1.0);
        let defocuses = f64::from(self.wider.is_none());
        Strips {
            pupil: places(at.pupil.shift),
            along,
            view: in_camera(&surface_view(scene, None), &head_from_camera.inverse()),
            strips: references.map(|reference| Reference {
                strip: Strip {
                    number: reference.number,
                    reference: places(reference.at.pupil.shift),
                    // A field on the surface is defocused by the lens.
                    defocus: (reference.at.pupil.defocus - at.pupil.defocus) * defocuses,
                    aside: along.perp() * (reference.aside / self.wider.unwrap_or(1.0)),
                },
                then_from_now: head_from_camera.inverse()
                    * reference.part_from_head.inverse()
                    * *part_from_head
                    * head_from_camera,
                displacement: on_sensor(reference.at.sensor),
            }),
        }
    }
}

/// A displacement as (columns, rows): a view's second axis points up, the sensor's
/// rows go down.
fn on_sensor(displacement: DVec2) -> DVec2 {
    DVec2::new(displacement.x, -displacement.y)
}

/// What patterns move with.
#[derive(Clone, Copy, PartialEq)]
enum Follows {
    /// Speckle in the middle of the view.
    Middle,
    /// Speckle of each place of the surface.
    Places,
    /// The surface in the middle of the view, wherever the focus.
    Surface,
}

impl Follows {
    fn of(strips: bool, on_surface: bool) -> Follows {
        match (strips, on_surface) {
            (true, _) => Follows::Places,
            (false, false) => Follows::Middle,
            (false, true) => Follows::Surface,
        }
    }
}

/// What ties the patterns to the part along the scene's path. `normal` is that of the surface
/// (head's frame), across the beam if it is not known; it is asked for where it is used.
fn anchor(scene: &Scene, follows: Follows, normal: impl FnOnce() -> Option<DVec3>) -> Anchor {
    let mut view = surface_view(scene, None);
    if follows != Follows::Middle {
        view.normal = normal().unwrap_or(view.normal);
    }
    match follows {
        Follows::Middle => {}
        Follows::Places => view.magnification = scene.camera.lens.magnification(),
        Follows::Surface => view = view.in_focus(),
    }
    let scan = &scene.scan;
    let wavelength = scene.laser.beam.wavelength;
    let first = scene.part_from_head(0);
    let ways = |frame| {
        first
            .inverse()
            .vector(scene.part_from_head(frame).translation - first.translation)
    };
    let direction = match &scan.motion {
        _ if scan.turns() => {
            // A rotary table turns alike from each frame to the next.
            let frames = match scan.motion {
                Motion::Rotary { .. } => 2,
                _ => scan.frames,
            };
            let poses = (0..frames).map(|frame| scene.part_from_head(frame));
            return Anchor::Path(PathAnchor::new(view, poses, wavelength));
        }
        Motion::Linear { step } if scan.moves == Moves::Head => *step,
        Motion::Linear { step } => -*step,
        // The farthest from the first: the last may be there again.
        _ => (0..scan.frames)
            .map(ways)
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
            .unwrap_or(DVec3::ZERO),
    };
    Anchor::Pose(Box::new(PoseAnchor::new(
        view, &first, direction, wavelength,
    )))
}

/// What the scan does to speckle from one frame to others ever further from it, as far as
/// their patterns are correlated; `field`: whether the method reads fields, which alone have
/// strips. Frames apart grow by an eighth, between which a correlation changes little.
pub fn steps_of_speckle(scene: &Scene, field: bool) -> Vec<SpeckleStep> {
    let anchor = anchor(scene, Follows::Places, || None);
    let limited = anchor.references(scene, 0.0, &scene.part_from_head(0), 1.0);
    if !field || limited.is_none() {
        return Vec::new();
    }
    let frames = scene.scan.frames;
    // Only a path of poses goes otherwise from one place to the next.
    let starts = match scene.scan.motion {
        Motion::Poses { .. } => [0, 1, 2, 3]
            .map(|quarter| frames as u64 * quarter / 4)
            .to_vec(),
        _ => vec![0],
    };
    let mut steps = Vec::new();
    for from in starts {
        let mut apart = 1;
        // A path of one frame is judged by the way on from it.
        while apart == 1 || from + apart < frames as u64 {
            let step = step_of_speckle(scene, &anchor, from as f64, apart as f64);
            if step.gamma <= CORRELATED {
                break;
            }
            steps.push(step);
            apart += (apart / 8).max(1);
        }
    }
    steps
}

/// The ways of the surface in the middle of the view between the first of these places on the path and each of them.
pub fn frame_steps(scene: &Scene, places: impl Iterator<Item = f64>) -> Vec<FrameStep> {
    let mut anchored = None;
    let mut first = None;
    let step = |place: f64| {
        let from = *first.get_or_insert(place);
        if place == from {
            return FrameStep {
                across: 0.0,
                kept: 1.0,
            };
        }
        let anchor = anchored.get_or_insert_with(|| anchor(scene, Follows::Middle, || None));
        let view = surface_view(scene, None);
        let in_laser = scene.head_from_laser.inverse().point(view.point);
        let sigma = scene.laser.beam.radius(in_laser.length()) / 2.0;
        let step = step_of_speckle(scene, anchor, from, place - from);
        FrameStep {
            across: step.across_sheet / sigma,
            kept: step.gamma * along_line(scene, [from, place]),
        }
    };
    places.map(step).collect()
}

/// Returns the correlation that remains of a column's light when the surface moves along the line: its patterns then lie in
/// other columns.
fn along_line(scene: &Scene, places: [f64; 2]) -> f64 {
    let Some(model) = &scene.speckle else {
        return 1.0;
    };
    let point = surface_view(scene, None).point;
    let [now, then] = places.map(|place| scene.part_from_head_at(place));
    let camera_from_head = scene.head_from_camera.inverse();
    let column = |point: DVec3| {
        let pixel = scene.camera.project(camera_from_head.point(point));
        pixel.map(|pixel| pixel.x)
    };
    let moved = then.inverse().point(now.point(point));
    let Some((from, to)) = column(point).zip(column(moved)) else {
        return 0.0;
    };
    let grain = scene.camera.speckle_size(scene.laser.beam.wavelength);
    let grains = (to - from) * scene.camera.sensor.pixel_pitch / grain;
    model.aperture.field_correlation(DVec2::X * grains).powi(2)
}

/// What the way from the place `from` to that so many `frames` on does to speckle.
fn step_of_speckle(scene: &Scene, anchor: &Anchor, from: f64, frames: f64) -> SpeckleStep {
    let places = [from, from + frames];
    let poses = places.map(|place| scene.part_from_head_at(place));
    let [now, then] = [0, 1].map(|i| anchor.coordinate(places[i], &poses[i]));
    let delta = (then.pupil.shift - now.pupil.shift).length();
    let phase = then.pupil.defocus - now.pupil.defocus;
    let lens = &scene.camera.lens;
    let wavelength = scene.laser.beam.wavelength;
    let grain = scene.camera.speckle_size(wavelength);
    // −m·b and −A_p/D.
    let shift = lens.magnification() * lens.pupil_diameter() * (then.pupil.shift - now.pupil.shift);
    let slip = (then.sensor - now.sensor - shift).length();
    let point = surface_view(scene, None).point;
    let way = poses[0]
        .inverse()
        .vector(poses[1].point(point) - poses[0].point(point));
    SpeckleStep {
        frames: frames as u32,
        across_sheet: way.dot(scene.head_from_laser.rotation.y_axis),
        gamma: overlap_correlation_defocused(delta, phase),
        slip_grains: slip / grain,
        spread_grains: spread(scene, point, &poses) / scene.camera.speckle_angle(wavelength),
    }
}

/// Returns the largest difference between the motion of a corner's point and the motion of `point` (head's frame), in
/// direction cosines behind the lens.
///
/// The corners' points are taken at the distance of `point`. Motions differ where the part turns, off the axis, where
/// cosines change by (I − n·nᵀ)·a/L_o for a motion a, and with the local scale of the distortion.
fn spread(scene: &Scene, point: DVec3, poses: &[Rigid; 2]) -> f64 {
    let camera = &scene.camera;
    let head_from_camera = scene.head_from_camera;
    let [now, then] = poses.map(|part_from_head| part_from_head * head_from_camera);
    let then_from_now = then.inverse() * now;
    let point = head_from_camera.inverse().point(point);
    let cosines = |p: DVec3| {
        let behind = match &camera.lens.distortion {
            None => p,
            Some(distortion) => distortion.continued(p.truncate() / p.z).0.extend(1.0),
        };
        behind.normalize_or_zero().truncate()
    };
    let moved = |p: DVec3| cosines(then_from_now.point(p)) - cosines(p);
    let size = camera.sensor.resolution.as_dvec2();
    let corners = [DVec2::ZERO, size.with_y(0.0), size.with_x(0.0), size];
    let ways = corners.map(|corner| {
        let seen = camera.direction(corner);
        (moved(seen * (point.z / seen.z)) - moved(point)).length()
    });
    ways.into_iter().fold(0.0, f64::max)
}
