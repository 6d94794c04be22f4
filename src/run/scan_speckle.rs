//! Speckle of a scan: the patterns, their mapping to the sensor, and their motion with the part.

use super::lit_normal::lit_normal;
use super::surface_view::{in_camera, surface_view};
use crate::accel::Accel;
use crate::error::Result;
use crate::frame::{Speckle, SpeckleSource, StripReference, StripReferences};
use crate::math::Aperture;
use crate::math::{DVec2, DVec3, Rigid};
use crate::plan::rules::{CORRELATED, SpeckleStep};
use crate::profile::FrameStep;
use crate::scene::{MovingBody, PathMotion, Scene, SpeckleModel};
use crate::speckle::anchor::{PatternAnchor, PatternCoordinate, StripPose as PathReference};
use crate::speckle::coordinate::GrainMap;
use crate::speckle::frame_field::{FrameFields, PupilPosition, field_spec, wide_field_spec};
use crate::speckle::lookup::{Coherence, Method, SpeckleTexture};
use crate::speckle::motion::overlap_correlation_defocused;
use crate::speckle::path::PathAnchor;
use crate::speckle::pattern::PatternSpec;
use crate::speckle::strips::PupilStrip;

pub struct ScanSpeckle {
    source: PatternSource,
    /// Pupil diameter of the surface fields, relative to the lens pupil; `None` for fields in the
    /// image.
    pupil_scale: Option<f64>,
    map: GrainMap,
    anchor: Anchor,
}

enum PatternSource {
    Frame {
        fields: FrameFields,
        /// Whether the field is read in strips that refer to other poses.
        strips: bool,
    },
    Ring(SpeckleTexture),
}

enum Anchor {
    /// For motion without rotation; exact over any length.
    Pose(Box<PatternAnchor>),
    Path(PathAnchor),
}

impl Anchor {
    /// Returns the scan coordinate of a pose at a position on the path, in frames.
    fn coordinate(&self, place: f64, part_from_head: &Rigid) -> PatternCoordinate {
        match self {
            Anchor::Pose(anchor) => anchor.coordinate(part_from_head),
            Anchor::Path(anchor) => anchor.coordinate(place),
        }
    }

    /// Returns the poses to which a pose's strips refer; `None` if strips cannot limit the shear.
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

/// Specification of the patterns of a scan as a ring, with ten slices per pupil diameter.
fn ring_spec(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        slices: 32,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

impl ScanSpeckle {
    /// Builds the patterns. With `strips`, the motion of the surface of `accel` varies with
    /// position. `wider` is for surface fields, which the lens then images: the ratio of the field
    /// pupil to the lens pupil.
    pub fn new(
        scene: &Scene,
        accel: &Accel,
        model: &SpeckleModel,
        strips: bool,
        pupil_scale: Option<f64>,
    ) -> Result<ScanSpeckle> {
        let wavelength = scene.laser.beam.wavelength;
        let grain = scene.camera.speckle_angle(wavelength);
        let distance = scene.camera.lens.image_distance();
        let in_focus = pupil_scale.is_some();
        let follows = PatternReference::of(strips, in_focus);
        let normal = (follows != PatternReference::Middle)
            .then(|| lit_normal(scene, accel))
            .flatten();
        let mut anchor_of = anchor(scene, follows, normal);
        let strips = strips
            && pupil_scale.is_none_or(|wider| {
                let width = model.aperture.extent() * wider;
                let now = scene.part_from_head(0);
                let references = anchor_of.references(scene, 0.0, &now, width);
                references
                    .is_some_and(|references| stretch(scene, normal, &references) <= MAX_STRETCH)
            });
        if in_focus && follows == PatternReference::Places && !strips {
            anchor_of = anchor(scene, PatternReference::Surface, normal);
        }
        // If polarisation differs between surfaces, samples weight the patterns of both
        // polarisations.
        let coherence = match scene.surface.polarisation_differs() {
            true => Coherence {
                polarisation_degree: 0.0,
                ..model.coherence
            },
            false => model.coherence,
        };
        let (source, map) = match model.method {
            Method::Field => {
                let spec = match pupil_scale {
                    None => field_spec(scene.camera_seed(), model.aperture),
                    Some(wider) => wide_field_spec(scene.camera_seed(), model.aperture, wider),
                };
                let fields = FrameFields::new(&spec, coherence)?;
                let map = fields.map(grain / pupil_scale.unwrap_or(1.0), distance);
                (PatternSource::Frame { fields, strips }, map)
            }
            Method::Trilinear => {
                let spec = ring_spec(scene.camera_seed(), model.aperture);
                let lookup = SpeckleTexture::new(&spec, model.method, coherence)?;
                let source = PatternSource::Ring(lookup);
                let map = GrainMap::new(spec.texels_per_speckle, grain, distance);
                (source, map)
            }
        };
        Ok(ScanSpeckle {
            source,
            pupil_scale,
            map,
            anchor: anchor_of,
        })
    }

    /// Returns the memory of the patterns that reading requires, bytes.
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
                let wider = self.pupil_scale.unwrap_or(1.0);
                let width = fields.strip_width() * wider;
                let references = || (self.anchor).references(scene, place, part_from_head, width);
                match strips.then(references).flatten() {
                    Some(references) => SpeckleSource::Strips {
                        fields,
                        strips: Box::new(self.strips(scene, &at, part_from_head, references)),
                    },
                    None => SpeckleSource::Frame {
                        fields,
                        place: match self.pupil_scale {
                            None => at.pupil,
                            // The lens applies the defocus.
                            Some(wider) => PupilPosition {
                                shift: on_sensor(at.pupil.shift) / wider,
                                defocus: 0.0,
                            },
                        },
                    },
                }
            }
            PatternSource::Ring(lookup) => SpeckleSource::Ring {
                lookup,
                slice: at.u * lookup.slices_per_diameter(),
            },
        };
        Speckle {
            patterns,
            map: self.map,
            displacement: on_sensor(at.sensor),
            pupil_scale: self.pupil_scale,
        }
    }

    /// Returns the strips of a pose in the camera's frame.
    fn strips(
        &self,
        scene: &Scene,
        at: &PatternCoordinate,
        part_from_head: &Rigid,
        references: [PathReference; 2],
    ) -> StripReferences {
        let head_from_camera = scene.head_from_camera;
        let along = on_sensor(self.anchor.along());
        // In diameters of the pupil of the fields.
        let places = |shift: DVec2| on_sensor(shift) / self.pupil_scale.unwrap_or(1.0);
        let defocuses = f64::from(self.pupil_scale.is_none());
        StripReferences {
            pupil: places(at.pupil.shift),
            along,
            view: in_camera(&surface_view(scene, None), &head_from_camera.inverse()),
            strips: references.map(|reference| StripReference {
                strip: PupilStrip {
                    number: reference.number,
                    reference: places(reference.at.pupil.shift),
                    // The lens applies the defocus of a field on the surface.
                    defocus: (reference.at.pupil.defocus - at.pupil.defocus) * defocuses,
                    phasor_offset: along.perp()
                        * (reference.pupil_parallax / self.pupil_scale.unwrap_or(1.0)),
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

/// Converts a displacement to (columns, rows). The second axis of a view points up, and sensor rows
/// increase downwards.
fn on_sensor(displacement: DVec2) -> DVec2 {
    DVec2::new(displacement.x, -displacement.y)
}

/// The motion that patterns follow.
#[derive(Clone, Copy, PartialEq)]
enum PatternReference {
    /// Speckle at the centre of the view.
    Middle,
    /// Speckle at each position on the surface.
    Places,
    /// The surface at the centre of the view, independent of the focus.
    Surface,
}

impl PatternReference {
    fn of(strips: bool, on_surface: bool) -> PatternReference {
        match (strips, on_surface) {
            (true, _) => PatternReference::Places,
            (false, false) => PatternReference::Middle,
            (false, true) => PatternReference::Surface,
        }
    }
}

/// Maximum [`stretch`] of fields that the lens defocuses.
///
/// The power of a strip is constant, so its spectral density in the pupil is inversely proportional
/// to the area into which the stretch maps it. The worst case is a strip in each half of the pupil.
/// The centroid of half a disc is 2/(3π) = 0.21 diameters from its centre. Areas that differ by 10 %
/// therefore displace the centroid of the light in the pupil by 0.05·0.21 = 0.01 diameters. This
/// displaces a defocused line by a hundredth of its blur diameter.
const MAX_STRETCH: f64 = 0.1;

/// Returns the logarithm of the ratio of the solid angles at which the camera sees a surface element
/// in two reference poses. The element is at the centre of the view in frame 0. `normal` is its
/// normal, see [`anchor`]. The value is infinite if the two poses show opposite sides of the element.
fn stretch(scene: &Scene, normal: Option<DVec3>, references: &[PathReference; 2]) -> f64 {
    let view = surface_view(scene, None);
    let normal = normal.unwrap_or(view.normal);
    let now = scene.part_from_head(0);
    let [a, b] = references.map(|reference| {
        let then_from_now = reference.part_from_head.inverse() * now;
        let to_pupil = view.pupil_centre - then_from_now.point(view.point);
        then_from_now.vector(normal).dot(to_pupil) / to_pupil.length().powi(3)
    });
    let ratio = a / b;
    if ratio > 0.0 {
        ratio.ln().abs()
    } else {
        f64::INFINITY
    }
}

/// Returns the anchor that ties the patterns to the part along the path. `normal` is the mean
/// surface normal (head's frame); `None` selects a surface perpendicular to the beam.
fn anchor(scene: &Scene, follows: PatternReference, normal: Option<DVec3>) -> Anchor {
    let mut view = surface_view(scene, None);
    if follows != PatternReference::Middle {
        view.normal = normal.unwrap_or(view.normal);
    }
    match follows {
        PatternReference::Middle => {}
        PatternReference::Places => view.magnification = scene.camera.lens.magnification(),
        PatternReference::Surface => view = view.in_focus(),
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
            // A rotary table turns by a constant angle per frame.
            let frames = match scan.motion {
                PathMotion::Rotary { .. } => 2,
                _ => scan.frames,
            };
            let poses = (0..frames).map(|frame| scene.part_from_head(frame));
            return Anchor::Path(PathAnchor::new(view, poses, wavelength));
        }
        PathMotion::Linear { step } if scan.moves == MovingBody::Head => *step,
        PathMotion::Linear { step } => -*step,
        // The frame farthest from the first, because the last frame may return to the first
        // position.
        _ => (0..scan.frames)
            .map(ways)
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
            .unwrap_or(DVec3::ZERO),
    };
    Anchor::Pose(Box::new(PatternAnchor::new(
        view, &first, direction, wavelength,
    )))
}

/// Returns the effect of the scan on speckle between a frame and frames at increasing distance. The
/// list ends where the patterns are uncorrelated. `field` states whether the method reads fields,
/// because only fields have strips. Distances increase by one eighth, over which a correlation
/// changes little.
pub fn speckle_steps(scene: &Scene, field: bool) -> Vec<SpeckleStep> {
    let anchor = anchor(scene, PatternReference::Places, None);
    let limited = anchor.references(scene, 0.0, &scene.part_from_head(0), 1.0);
    if !field || limited.is_none() {
        return Vec::new();
    }
    let frames = scene.scan.frames;
    // Only on a path of poses does the motion vary along the path.
    let starts = match scene.scan.motion {
        PathMotion::Poses { .. } => [0, 1, 2, 3]
            .map(|quarter| frames as u64 * quarter / 4)
            .to_vec(),
        _ => vec![0],
    };
    let mut steps = Vec::new();
    for from in starts {
        let mut apart = 1;
        // For a path of one frame, the motion after that frame is used.
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

/// Returns the displacement of the surface at the view centre from the first path position to each
/// of the given positions.
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
        let anchor = anchored.get_or_insert_with(|| anchor(scene, PatternReference::Middle, None));
        let view = surface_view(scene, None);
        let in_laser = scene.head_from_laser.inverse().point(view.point);
        let sigma = scene.laser.radius(in_laser) / 2.0;
        let step = step_of_speckle(scene, anchor, from, place - from);
        FrameStep {
            across: step.across_sheet / sigma,
            kept: step.gamma * along_line(scene, [from, place]),
        }
    };
    places.map(step).collect()
}

/// Returns the correlation that remains in a column when the surface moves along the line. The
/// patterns then move to other columns.
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

/// Returns the effect on speckle of the motion from the path position `from` to `from + frames`.
fn step_of_speckle(scene: &Scene, anchor: &Anchor, from: f64, frames: f64) -> SpeckleStep {
    let places = [from, from + frames];
    let poses = places.map(|place| scene.part_from_head_at(place));
    let [now, then] = [0, 1].map(|i| anchor.coordinate(places[i], &poses[i]));
    let delta = (then.pupil.shift - now.pupil.shift).length();
    let phase = then.pupil.defocus - now.pupil.defocus;
    let lens = &scene.camera.lens;
    let wavelength = scene.laser.beam.wavelength;
    let grain = scene.camera.speckle_size(wavelength);
    // Terms −m·b and −A_p/D.
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
        spread_grains: motion_spread(scene, point, &poses) / scene.camera.speckle_angle(wavelength),
    }
}

/// Returns the largest difference between the motion of a corner's point and the motion of `point`
/// (head's frame), in direction cosines behind the lens.
///
/// The corners' points are at the distance of `point`. Motions differ where the part turns, and off
/// the axis, where cosines change by (I − n·nᵀ)·a/L_o for a motion a. They also differ with the
/// local scale of the distortion.
fn motion_spread(scene: &Scene, point: DVec3, poses: &[Rigid; 2]) -> f64 {
    let camera = &scene.camera;
    let head_from_camera = scene.head_from_camera;
    let [now, then] = poses.map(|part_from_head| part_from_head * head_from_camera);
    let then_from_now = then.inverse() * now;
    let point = head_from_camera.inverse().point(point);
    let cosines = |p: DVec3| {
        let behind = match &camera.lens.distortion {
            None => p,
            Some(distortion) => distortion.continued(p.truncate() / p.z).extend(1.0),
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
